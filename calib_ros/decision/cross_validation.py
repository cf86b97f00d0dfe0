# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Cross-validation: every configuration is judged by a fit without it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from calib_ros.decision.comparison import Comparison
from calib_ros.decision.residuals import Residuals, joined, residuals
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.evidence import Inference
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.leastsquares import leave_fold_out
from calib_ros.estimation.levels import TELLING
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Learned, Problem
from calib_ros.estimation.system import System
from calib_ros.estimation.visits import stations
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import Index


def cross_validate(fitted: Fitted, before: Chain, note: str) -> tuple[Comparison | None, str]:
    """Judge both chains on folds of configurations that were not fitted; None if too few.

    Between few stations an arm imitates a moved device: all poses of one are in the same fold.
    A `note`, why not by held-out pairs, ends the text.
    """
    problem, names, system = fitted.problem, fitted.names, fitted.system
    rows = sum(
        count_distinct(group) * each.width
        for group, each in zip(problem.configurations, problem.sets, strict=True)
    )
    groups, kind = stations(problem.sets), 'poses'
    count = count_distinct(np.concatenate(groups))
    if count < count_distinct(np.concatenate(problem.configurations)):
        kind, system = 'stations', _with_usual_priors(fitted)
    folds = _fold_count(problem, names, count, rows)
    if folds < 2:
        return None, 'nothing: too few poses to hold any out'
    numbers = [group % folds for group in groups]
    order = [np.argsort(each, kind='stable') for each in numbers]
    by_fold = system.select(order), [*map(np.sort, numbers)]  # sorted once
    fits = (before, fitted.frames), (fitted.chain, names)
    chains = zip(*(leave_fold_out(one, some, *by_fold) for one, some in fits), strict=True)
    pair = fold_residuals(chains, problem.sets, groups, numbers)
    judged = Comparison(*pair, ~fitted.robust.outliers, kind=kind)
    over = f'{folds}-fold cross-validation over {count:,} different {kind}'
    return judged, f'{over}{note}{judged.omitted}'


def _with_usual_priors(fitted: Fitted) -> System:
    """Return the system with priors, because some stations may not determine the fit."""
    problem = fitted.problem
    if problem.learned is None:
        found = Inference(fitted, fitted.size).likeliest().priors
        arm = (n for n in fitted.names if not problem.model.owns_frame(n))
        priors = {n: min(found[n], problem.common_sense(n)) for n in arm}
        problem = replace(problem, learned=Learned(priors, fitted.size))
    return replace(fitted.system, prior=problem.system(()).prior)


def fold_residuals(
    chains: Iterable[tuple[Chain, Chain]],
    sets: Sequence[Observations],
    groups: Sequence[Index],
    folds: Sequence[Index],
) -> tuple[Residuals, Residuals]:
    """Return the residuals of every fold by its own two chains, before and after.

    `groups` and `folds` hold the configuration and the fold of every pair (N,), set by set.
    """
    pieces: tuple[list[Residuals], list[Residuals]] = ([], [])
    for k, pair in enumerate(chains):
        for each, numbers in zip(sets, folds, strict=True):
            out = each.select(np.flatnonzero(numbers == k))
            for side, chain in zip(pieces, pair, strict=True):
                side.append(residuals(chain, out))
    index = np.argsort(np.argsort(np.concatenate(folds), kind='stable'))
    before, after = (joined(side, np.concatenate(groups), index) for side in pieces)
    return before, after


def _fold_count(problem: Problem, names: Sequence[str], count: int, rows: int) -> int:
    """Return the number of folds; 0 if all configurations are needed for the fit.

    The other folds must determine the fit, with some equations to spare. If they do so only with
    priors tighter than common sense, one configuration is left out at a time.
    """
    known, given = dict(problem.model.effects), problem.given
    names = [name for name in names if name not in known]  # effects have priors
    folds = min(problem.folds, count)
    if folds > 1 and rows * (folds - 1) // folds >= len(names) + TELLING:
        return folds
    free = sum(given.get(name, np.inf) >= problem.common_sense(name) for name in names)
    enough = free < len(names) and rows * (count - 1) // count >= free + TELLING
    return count if enough else 0
