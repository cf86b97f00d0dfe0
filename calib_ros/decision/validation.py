# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Judging a result on poses that were not fitted: held out, in folds, or place by place."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from calib_ros.decision.comparison import Comparison, Residuals, compare, joined, residuals
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.evidence import Posterior
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.identifiability import drawn, independent_in
from calib_ros.estimation.leastsquares import System, leave_fold_out, minimise
from calib_ros.estimation.levels import ALIKE, SURE, TELLING
from calib_ros.estimation.observations import Observations, numbered
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.robust import OUTLIER, distances_of
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import parameters_of
from calib_ros.kinematics.se3 import Flags, FloatArray, Index


def validate(
    fitted: Fitted, before: Chain, explained: Flags | None = None
) -> tuple[Comparison | None, str]:
    """Judge a fitted chain and that before on pairs that were not fitted.

    Held-out pairs are outliers if they are far from the prediction and not `explained` (N,) by a
    simpler model. In cross-validation, configurations are dealt to the folds one by one, so that
    none is on both sides. Outliers keep their weight of the whole fit in the folds; they are
    judged too.
    """
    problem = fitted.problem
    repeated = _repeated(problem)
    if not repeated.all():
        comparison = replace(compare(before, fitted.chain, problem.judging), repeated=repeated)
        if count_distinct(comparison.after.configurations[~repeated]) > 1:
            return _of_held_out(fitted, comparison, explained)
    places = _places(problem)
    if len(places) > 1 and all(each.socket for each in problem.sets):
        return _leave_one_place_out(fitted, before, places)
    note = ', because fewer than two held-out poses are new' if len(repeated) else ''
    return _cross_validate(fitted, before, note)


def _of_held_out(
    fitted: Fitted, comparison: Comparison, explained: Flags | None
) -> tuple[Comparison, str]:
    problem = fitted.problem
    if problem.loss != 'none':
        judged, new = ~comparison.counting, comparison.counting
        ends = np.cumsum([len(each) for each in problem.judging])[:-1]
        pairs = zip(problem.judging, np.split(new, ends), strict=True)
        sets = [each.select(rows) for each, rows in pairs if rows.any()]
        far = distances_of(fitted.chain, fitted.names, problem.system(sets))
        judged[new] = np.concatenate(far) <= OUTLIER
        judged |= np.False_ if explained is None else explained
        comparison = replace(comparison, judged=judged)
    text = f'{comparison.counting.sum():,} held-out poses{comparison.omitted}'
    if repeats := int((~comparison.counting).sum()):
        text += f'; not counted because they repeat fitted poses: {repeats}'
    return comparison, text


def _cross_validate(fitted: Fitted, before: Chain, note: str) -> tuple[Comparison | None, str]:
    problem, names = fitted.problem, fitted.names
    groups = problem.configurations
    count = count_distinct(np.concatenate(groups))
    rows = sum(
        count_distinct(group) * each.width
        for group, each in zip(groups, problem.sets, strict=True)
    )
    folds = _fold_count(problem, names, count, rows)
    if folds < 2:
        return None, 'nothing: too few poses to hold any out'
    frames = [name for name in names if before.owns_frame(name)]
    numbers = [group % folds for group in groups]
    order = [np.argsort(each, kind='stable') for each in numbers]
    by_fold = fitted.system.select(order), [*map(np.sort, numbers)]  # sorted once
    fits = (before, frames), (fitted.chain, names)
    chains = zip(*(leave_fold_out(one, some, *by_fold) for one, some in fits), strict=True)
    first, second = fold_residuals(chains, problem.sets, groups, numbers)
    judged = Comparison(first, second, ~fitted.robust.outliers)
    over = f'{folds}-fold cross-validation over {count:,} different poses'
    return judged, f'{over}{note}{judged.omitted}'


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


def _repeated(problem: Problem) -> Flags:  # held-out pairs (N,)
    if not problem.judging:
        return np.zeros(0, dtype=bool)
    numbers = numbered(problem.all_sets)
    count = len(problem.sets)
    return np.isin(np.concatenate(numbers[count:]), np.concatenate(numbers[:count]))


def _fold_count(problem: Problem, names: Sequence[str], count: int, rows: int) -> int:
    """Return the number of folds; 0 if all configurations are needed for the fit.

    The other folds must determine the fit, with some equations to spare. If they do so only with
    priors, one configuration is left out at a time.
    """
    known = dict(problem.model.effects)
    names = [name for name in names if name not in known]  # effects have priors
    folds = min(problem.folds, count)
    if folds > 1 and rows * (folds - 1) // folds >= len(names) + TELLING:
        return folds
    folds = count
    unknown = set(names) - problem.informed
    if len(unknown) == len(names) or rows * (folds - 1) // folds < len(unknown) + TELLING:
        return 0
    return folds


def _places(problem: Problem) -> list[set[str]]:
    places = [{base} for base in dict.fromkeys(each.base for each in problem.sets)]
    for first, second, _ in problem.separations:
        one, other = (next(p for p in places if base in p) for base in (first, second))
        if one is not other:
            one |= other
            places.remove(other)
    return places


def _leave_one_place_out(
    fitted: Fitted, before: Chain, places: Sequence[set[str]]
) -> tuple[Comparison, str]:
    """Judge both chains on places of sockets that were not fitted.

    The unknown positions of a place's sockets are fitted to its own pairs, with arm and tool of
    the others. Outliers keep their weight of the whole fit.
    """
    problem, names = fitted.problem, fitted.names
    pairs = list(zip(problem.sets, fitted.system.sets, strict=True))

    def part(place: set[str], inside: bool) -> System:
        chosen = [samples for each, samples in pairs if (each.base in place) == inside]
        known = {samples.observations.base for samples in chosen}
        apart = tuple(pair for pair in fitted.system.separations if {*pair[:2]} <= known)
        return replace(fitted.system, sets=tuple(chosen), separations=apart)

    frames = [name for name in names if before.owns_frame(name)]
    anywhere, rows = drawn(problem.model, names, problem.sets)
    chains: list[list[Chain]] = [[], []]
    for place in places:
        own = [n for base in sorted(place) for n in parameters_of(base)[:3] if n in problem.free]
        others, left = part(place, inside=False), part(place, inside=True)
        rest = [name for name in names if name not in own]
        seen = zip(rows, problem.sets, strict=True)
        which = [names.index(name) for name in rest]
        there = [each[:, which] for each, one in seen if one.base not in place]
        # without this place a gauge may be free; frames come first, so they are the same alone
        known = independent_in([*there, others.separation_rows(anywhere, rest)[0]], rest)
        kept = {*known, *problem.prior_sigmas}
        fits = (before, frames), (fitted.chain, names)
        for found, (chain, wanted) in zip(chains, fits, strict=True):
            rest = [name for name in wanted if name in kept and name not in own]
            found.append(minimise(minimise(chain, rest, others).chain, own, left).chain)
    number = {base: k for k, place in enumerate(places) for base in place}
    groups = np.concatenate([np.full(len(each), number[each.base]) for each in problem.sets])
    first, second = (
        joined([residuals(side[number[each.base]], each) for each in problem.sets], groups)
        for side in chains
    )
    judged = Comparison(first, second, ~fitted.robust.outliers)
    return judged, f'leaving out one of {len(places)} places at a time{judged.omitted}'


def held_out_excess(
    fitted: Fitted, posterior: Posterior, judged: Comparison | None
) -> tuple[float, float]:
    """Return by how much held-out positions are further off than noise and expected errors.

    Then follows the factor by which the expected errors are too small (after Birge 1932). They
    are 0 and 1 unless more than chance (99.9 %) makes them so.
    """
    problem, sets = fitted.problem, fitted.problem.judging
    if judged is None or judged.repeated is None:
        return 0.0, 1.0
    if any(each.distances is not None or each.pixels is not None for each in sets):
        return 0.0, 1.0
    sigmas, found = (problem.sigma_position, problem.sigma_orientation), judged.figures[1].rms_mm
    squares = [each.covariances(sigmas) for each in sets]
    noise = fitted.noise.position * _rms_mm(squares, judged.deciding)
    if found <= ALIKE * noise:  # noise alone, as nearly always
        return 0.0, 1.0
    squares = [posterior.expected(each.joints, each.base, each.tool) for each in sets]
    expected = _rms_mm(squares, judged.deciding)
    if not expected:  # computed, without noise
        return 0.0, 1.0
    likely, by_arm = float(np.hypot(noise, expected)), expected**2 / (noise**2 + expected**2)
    alone = (1.0 - by_arm**2) / (3.0 * np.count_nonzero(judged.deciding))
    freedom = 1.0 / (alone + by_arm**2 * _alike(posterior, sets))  # Satterthwaite 1946
    if found <= likely * max(ALIKE, np.sqrt(special.chdtri(freedom, 1.0 - SURE) / freedom)):
        return 0.0, 1.0
    return found / likely, float(np.sqrt(found**2 - noise**2)) / expected


def _alike(posterior: Posterior, sets: Sequence[Observations]) -> float:
    """Return one by the number of positions that the arm's errors make independent: they share."""
    few, seen = [each.spread() for each in sets], []
    for each in few:
        model = ErrorModel(posterior.chain, posterior.names, each.base, each.tool)
        seen.append(model.jacobian(each.joints)[:, :3].reshape(-1, len(posterior.names)))
    rows = np.concatenate(seen)
    shared = posterior.square @ (rows.T @ rows)
    return float(np.trace(shared @ shared) / np.trace(shared) ** 2)


def _rms_mm(squares: Sequence[FloatArray], which: Flags) -> float:
    """Return the RMS length [mm] of positions with expected squares (N, 6, 6) of their errors."""
    traces = np.trace(np.concatenate(squares)[which, :3, :3], axis1=1, axis2=2)
    return 1e3 * float(np.sqrt(traces.mean()))
