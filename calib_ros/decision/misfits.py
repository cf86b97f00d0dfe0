# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a fit leaves: gross errors, or behaviour of the arm that its model lacks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import special

from calib_ros.decision.reasons import Reason, Rule
from calib_ros.decision.steps import EXPLAINED
from calib_ros.estimation.configurations import STILL
from calib_ros.estimation.considered import travels
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.gain import gain_share
from calib_ros.estimation.gross_errors import SUSPICIOUS
from calib_ros.estimation.levels import NEARER, SURE, TELLING
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.system import stacked
from calib_ros.estimation.visits import numbered
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray, norms
from calib_ros.settings import EXCEPTION
from calib_ros.shown import two_digits

ADVICE = (
    ': device errors do not depend on joint values, so the arm has an effect that the model '
    'lacks. Look for effects (model auto), or fit these poses too (loss none)'
)


@dataclass(frozen=True)
class Outlier:
    """A sample with a gross error: its place, and its size in sigmas along one axis."""

    set: int
    sample: int
    stamp_ns: int
    size: float


def outliers_of(fitted: Fitted) -> tuple[Outlier, ...]:
    """Return the samples that a robust fit excludes."""
    robust = fitted.robust
    sets = zip(fitted.problem.sets, robust.distances, robust.inliers, strict=True)
    return tuple(
        Outlier(number, k, int(each.stamps_ns[k]), float(distances[k]))
        for number, (each, distances, good) in enumerate(sets)
        for k in np.flatnonzero(~good).tolist()
    )


def arms_own(fitted: Fitted) -> Reason | None:
    """Return which joint moves in outliers only, so that these are the arm's own, or None."""
    problem, kept = fitted.problem, ~fitted.robust.outliers
    if kept.all() or any(each.socket for each in problem.sets):
        return None
    joints = np.concatenate([each.joints for each in problem.sets])
    whole = np.ptp(joints, axis=0)
    left = np.ptp(joints[kept], axis=0) if kept.any() else 0.0 * whole
    for name, part, all_of_it in zip(problem.chain.joint_names, left, whole, strict=True):
        if all_of_it > 10.0 * STILL and part < EXCEPTION * all_of_it:
            text = f'{name} moves only in poses set aside as gross errors'
            return Reason(Rule.OWN_BEHAVIOUR, text, ADVICE)
    return None


def loose_target(sets: Sequence[Observations]) -> str:
    """Return which of three or more targets moves against the others, whatever the arm does.

    By the variance of their distances at the same configurations, without a tenth that may be
    gross errors, against that of the steadiest pair.
    """
    if len(sets) < 3:
        return ''
    places: list[dict[int, FloatArray]] = []
    varies: dict[tuple[str, str, str], tuple[float, int]] = {}
    for each, number in zip(sets, numbered(sets), strict=True):
        points = each.distances is None and each.pixels is None and not each.inverse
        places.append(dict(zip(number.tolist(), each.positions, strict=True)) if points else {})
    for (one, its), (other, others) in combinations(zip(sets, places, strict=True), 2):
        both = its.keys() & others.keys()
        if one.base == other.base and one.tool != other.tool and len(both) >= TELLING:
            apart = norms(np.array([its[k] - others[k] for k in both]))
            off = np.sort(np.abs(apart - np.median(apart)))[: -int(EXCEPTION * len(both)) or None]
            varies[one.tool, other.tool, one.base] = float(off @ off) / len(off), len(off)
    least = min((variance for variance, _ in varies.values()), default=0.0)
    chance = (1.0 - SURE) / max(len(varies) * (len(varies) - 1), 1)  # of one pair against another
    wide = {
        pair: variance
        for pair, (variance, free) in varies.items()
        if variance > least * max(special.fdtri(free, free, 1.0 - chance), 1.0 / NEARER)
    }
    if not wide:
        return ''
    (name, often), *_ = Counter(tool for pair in wide for tool in pair[:2]).most_common()
    widest = max(wide, key=lambda pair: wide[pair])
    which = name if often == len(wide) > 1 else f'{widest[0]} or {widest[1]}'
    far, usual = (two_digits(1e3 * np.sqrt(each)) for each in (max(wide.values()), least))
    return (
        f'the target {which} is loose, or badly seen from some sides: its distance from another '
        f'varies by {far} mm (RMS), {usual} mm is usual. Fasten it, or leave it out'
    )


def coupling_share(fitted: Fitted) -> float:
    """Return the share of the residuals that couplings of the wrist explain, if most of it.

    Beside scales of travel, which linear joints rather have.
    """
    problem, chain = fitted.problem, fitted.chain
    known = [name for name, _ in chain.effects]
    scaled = [name for name in travels(chain) if name not in known]
    added = tuple(n for n in effects.members(problem.chain, 'coupling') if n not in known)
    if not added or fitted.noise.position < SUSPICIOUS:  # nothing is left to explain
        return 0.0
    chain = chain.with_effects([*known, *scaled, *added])
    share = explained_share(problem, chain, [*fitted.names, *scaled], added)
    return share if share >= EXPLAINED else 0.0


def explained_share(
    problem: Problem,
    chain: Chain,
    fitted: Sequence[str],
    added: Sequence[str],
    sets: Sequence[Observations] = (),
) -> float:
    """Return the share of the residual squares that added parameters explain, linearly.

    Of the problem's sets, or of others.
    """
    few = [each.spread() for each in sets or problem.sets]
    rows = problem.system(few).rows_of(chain, (*fitted, *added))
    return gain_share(stacked(rows), len(fitted))
