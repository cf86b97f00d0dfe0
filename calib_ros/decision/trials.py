# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An arm tried on some samples: base and tool in closed form, then refined by least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calib_ros.decision.undoing import Sets
from calib_ros.estimation.identifiability import excited
from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.levels import CLEARLY, MOST_OUTLIERS
from calib_ros.estimation.normal import factor_of
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.resection import board_poses
from calib_ros.estimation.samples import Samples
from calib_ros.estimation.start import closed_forms, flange, free_in
from calib_ros.estimation.system import System
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.lens import require_lens
from calib_ros.kinematics.parameter import IN_A_FRAME
from calib_ros.kinematics.se3 import Flags, FloatArray
from calib_ros.settings import EXCEPTION, LEVER


@dataclass(frozen=True, eq=False)
class Trial:
    """A chain with frames fitted to some samples, and the spread of positions [m].

    The smaller of the spreads of flange and measured positions: if metres are taken for
    millimetres, or radians for degrees, every error is small. `arms` are the poses (N, 4, 4) of
    the bare arm.
    """

    chain: Chain
    sets: Sets
    arms: tuple[FloatArray, ...]
    spread: float = 1.0

    @cached_property
    def error(self) -> float:
        """Return the error [m] that a usual share of the samples is within."""
        pairs = zip(self.sets, self.arms, strict=True)
        sizes = [sample_errors(self.chain, each, arm) for each, arm in pairs]
        return _usual(np.concatenate(sizes))

    @property
    def share(self) -> float:
        """Return the error in units of the spread."""
        return self.error / max(self.spread, 1e-9)


def trial_of(chain: Chain, sets: Sets) -> Trial:
    """Return the chain with frames for some samples in closed form, set by set."""
    spreads, arms = [], []
    for each in sets:
        alone = each.changed(base='base', tool='tool')
        arm = flange(chain, alone)
        known = chain.all_frames  # other robots have only a base and a tool
        own = replace(chain, base=known.get(each.base), tool=known.get(each.tool))
        best = _nearest(own, alone, arm, np.ones(len(alone), dtype=bool))
        away = sample_errors(best.chain, alone, arm)  # a gross error would hide a mistake
        usual = away <= _usual(away)
        if np.count_nonzero(usual) >= 2 * IN_A_FRAME:  # base and tool explain fewer
            best = min(best, _nearest(own, alone, arm, usual), key=lambda one: one.error)
        places = arm[:, :3, 3]
        fixed = each.socket or each.seen
        seen = places if fixed else each.positions  # sockets measure nothing
        spreads.append(min(float(np.sqrt(one.var(axis=0).sum())) for one in (places, seen)))
        chain = chain.with_frame(each.base, best.chain.frame('base'))
        chain = chain.with_frame(each.tool, best.chain.frame('tool'))
        arms.append(arm)
    return Trial(chain, sets, tuple(arms), float(np.median(spreads)))


def _usual(sizes: FloatArray) -> float:
    """Return the size that a usual share of (N,) is within; np.quantile is slow."""
    last = int((1.0 - MOST_OUTLIERS) * (len(sizes) - 1))
    return float(np.partition(sizes, last)[last])


def as_poses(problem: Problem, each: Observations) -> Observations:
    """Return the measurements, boards in images as poses."""
    if each.pixels is None:
        return each
    return board_poses(each, require_lens(problem.chain.frame(each.camera).lens, each.camera))


def in_frames(problem: Problem, chain: Chain, sets: Sets) -> Trial:
    """Return the arm as given, in the frames that suit it best."""
    return refine_trial(problem, trial_of(chain, tuple(each.spread() for each in sets)))


def position_fault_limit(problem: Problem) -> float:
    """Return the largest error [m] of positions of a faulty arm.

    Of a tiny one a tenth of its longest length or of their spread, but not less than clearly
    beyond the sigma.
    """
    alone = [e for e in problem.sets if e.distances is None and e.pixels is None]
    placed = [e.given for e in alone if not (e.socket or e.seen)]
    if not placed:
        return problem.largest_error
    sizes = [float(np.sqrt(each.var(axis=0).sum())) for each in placed]
    sizes += [abs(length) for joint in problem.chain.joints for length in (joint.a, joint.d)]
    tenth = EXCEPTION * max(sizes)
    return min(problem.largest_error, max(tenth, CLEARLY * problem.sigma_position))


def fault_limit(problem: Problem) -> float:
    """Return the largest error [m] of a faulty arm, with that of its orientation.

    Of positions alone in proportion to the arm, if it is tiny.
    """
    most, size = problem.largest_error, position_fault_limit(problem)
    whole = most + LEVER * problem.largest_angle / 3.0
    tiny = size < most and not any(each.oriented.any() for each in problem.sets)
    return whole * size / most if tiny else whole


def fits_each_side(problem: Problem, seen: Observations, stamp_ns: int) -> bool:
    """Tell whether the arm as given fits both samples before a stamp and those from there on.

    Each in frames of their own; false if these explain too few samples anyway.
    """
    if seen.pixels is not None or seen.distances is not None or seen.socket:
        return False
    arm = replace(problem.chain, base=None, tool=None, frames=())
    alone, before = replace(seen, base='base', tool='tool'), seen.stamps_ns < stamp_ns
    if min(np.count_nonzero(before), np.count_nonzero(~before)) < 2 * IN_A_FRAME:
        return False
    sides = [in_frames(problem, arm, (alone.select(rows),)) for rows in (before, ~before)]
    return all(side.error <= fault_limit(problem) for side in sides)


def misfit_set(problem: Problem, chain: Chain, sets: Sets) -> tuple[Sets, str]:
    """Return the largest set that the arm does not explain, and its name if it explains others.

    Another device or session may have other units or conventions.
    """
    trials = [in_frames(problem, chain, (each,)) for each in sets] if len(sets) > 1 else []
    errors = np.array([trial.error for trial in trials])
    wrong = np.flatnonzero(errors > fault_limit(problem)).tolist()
    worst = max(wrong or range(len(sets)), key=lambda k: len(sets[k]))
    if not 0 < len(wrong) < len(sets):
        return (sets[worst],), ''
    return (sets[worst],), set_in_words(sets, sets[worst])


def set_in_words(sets: Sequence[Observations], one: Observations) -> str:
    """Return which of several sets one is, by the frames that not all share."""
    if len(sets) == 1:
        return ''
    shared = set.intersection(*({each.base, each.tool} for each in sets))
    own = ', '.join(sorted({one.base, one.tool} - shared))
    which = f'with {own}' if own else f'of {len(one)} poses'
    return f'in the measurements {which} alone, '


def _nearest(chain: Chain, each: Observations, arm: FloatArray, rows: Flags) -> Trial:
    """Return the best closed form of some rows (N,), judged by all of them."""
    starts = closed_forms(chain, each.select(rows), arm[rows])
    return min((Trial(s, (each,), (arm,)) for s in starts), key=lambda one: one.error)


def refine_trial(problem: Problem, trial: Trial) -> Trial:
    """Return the trial with frames refined by least squares on the samples near it."""
    chain, sets = trial.chain, trial.sets
    sigmas = problem.sigma_position, problem.sigma_orientation
    pairs = zip(sets, trial.arms, strict=True)
    usual = [e.select(sample_errors(chain, e, arm) <= CLEARLY * trial.error) for e, arm in pairs]
    system = System(tuple(Samples(each, *sigmas) for each in usual))
    sockets = {each.base for each in sets if each.socket}
    every = free_in(chain, dict.fromkeys(name for each in sets for name in (each.base, each.tool)))
    names = [name for name in every if name.is_length or name.owner not in sockets]
    known = excited(factor_of(chain, names, system), names)
    fitted = minimise(chain, known, system, tolerance=1e-2, iterations=12).chain
    polished = Trial(fitted, sets, trial.arms, trial.spread)
    return min(trial, polished, key=lambda one: one.error)


def sample_errors(chain: Chain, each: Observations, arm: FloatArray) -> FloatArray:
    """Return the errors (N,) [m] of samples, given the poses (N, 4, 4) of the bare arm."""
    found = chain.frame(each.base).matrix @ arm @ chain.frame(each.tool).matrix
    left = each.positions - found[:, :3, 3]
    if each.seen:
        left = left - np.einsum('nij,nj->ni', found[:, :3, :3], each.given)
    away = np.linalg.norm(left, axis=1)
    if each.oriented.any():
        turns = se3.angles_between(found[:, :3, :3], each.rotations)
        away = away + LEVER * np.where(each.oriented, turns, 0.0)
    return np.asarray(away)
