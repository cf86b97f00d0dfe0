# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An arm tried on some samples: base and tool in closed form, then refined by least squares."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby

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
from calib_ros.estimation.start import closed_frames, flange, free_in
from calib_ros.estimation.system import System
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.lens import require_lens
from calib_ros.kinematics.parameter import IN_A_FRAME
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.kinematics.walk import BLOCK
from calib_ros.settings import EXCEPTION, LEVER


@dataclass(frozen=True, eq=False)
class Trial:
    """A chain with frames fitted to some samples, and the spread of positions [m].

    The smaller of the spreads of flange and measured positions: if metres are taken for
    millimetres, or radians for degrees, every error is small. `arms` are the poses (N, 4, 4) of
    the bare arm, `found` holds frames (C, 4, 4) of many trials, of which this is one `number`.
    """

    start: Chain
    sets: Sets
    arms: tuple[FloatArray, ...]
    spread: float = 1.0
    found: Chain | None = None
    number: int = 0

    @cached_property
    def chain(self) -> Chain:
        """Return the chain in the frames found."""
        chain, found = self.start, self.found
        if found is None:
            return chain
        for each in self.sets:
            for name in (each.base, each.tool):
                frame = found.frame(name)
                chain = chain.with_frame(name, replace(frame, matrix=frame.matrix[self.number]))
        return chain

    @property
    def error(self) -> float:
        """Return the error [m] that a usual share of the samples is within."""
        return float(_usual(self._sizes))

    @property
    def whole(self) -> float:
        """Return the RMS error of all samples in units of the spread."""
        return float(np.sqrt(np.mean(self._sizes**2))) / max(self.spread, 1e-9)

    @property
    def share(self) -> float:
        """Return the error in units of the spread."""
        return self.error / max(self.spread, 1e-9)

    @cached_property
    def _sizes(self) -> FloatArray:
        pairs = zip(self.sets, self.arms, strict=True)
        return np.concatenate([sample_errors(self.chain, each, arm) for each, arm in pairs])


def trial_of(chain: Chain, sets: Sets) -> Trial:
    """Return the chain with frames for some samples in closed form, set by set."""
    return trials_of(((chain, sets),))[0]


def trials_of(tried: Iterable[tuple[Chain, Sets]]) -> list[Trial]:
    """Return what `trial_of` returns of each chain and its samples.

    Samples that are as many, of one kind and in the same frames are computed at once.
    """
    tried, alike = [*tried], dict[tuple[object, ...], list[int]]()
    for number, (chain, sets) in enumerate(tried):
        ends = [(e, chain.all_frames.get(e.base), chain.all_frames.get(e.tool)) for e in sets]
        kind = ((len(e), e.seen, e.base, e.tool, id(base), id(tool)) for e, base, tool in ends)
        alike.setdefault((*kind,), []).append(number)
    found: dict[int, Trial] = {}
    for numbers in alike.values():
        most = max(1, 4 * BLOCK // max(map(len, tried[numbers[0]][1])))
        for first in range(0, len(numbers), most):
            some = numbers[first : first + most]
            found |= zip(some, _at_once([tried[k] for k in some]), strict=True)
    return [found[number] for number in range(len(tried))]


def _at_once(tried: Sequence[tuple[Chain, Sets]]) -> Iterator[Trial]:
    """Yield the trials of chains in the same frames with C times as many samples of one kind."""
    chains, samples = zip(*tried, strict=True)
    found, spreads, seen = chains[0], list[FloatArray](), list[tuple[Observations, FloatArray]]()
    for every in zip(*samples, strict=True):
        one = every[0]
        names = ('joints', 'positions', 'rotations', 'oriented', *('points',) * one.seen)
        each = one.changed(**{name: np.array([getattr(e, name) for e in every]) for name in names})
        alike = [[*run] for _, run in groupby(range(len(every)), lambda k: id(chains[k]))]
        runs = ((chains[run[0]], each.changed(joints=each.joints[run])) for run in alike)
        arm = np.concatenate([flange(*run) for run in runs])
        known = found.all_frames  # other robots have only a base and a tool
        alone = replace(found, base=known.get(one.base), tool=known.get(one.tool))
        base, tool = _nearest(alone, each.changed(base='base', tool='tool'), arm)
        found = found.with_frame(one.base, replace(alone.frame('base'), matrix=base))
        found = found.with_frame(one.tool, replace(alone.frame('tool'), matrix=tool))
        places = arm[..., :3, 3], each.positions
        measured = places[: 1 if one.socket or one.seen else 2]  # a socket measures nothing
        spreads.append(np.min([np.sqrt(e.var(axis=1).sum(axis=1)) for e in measured], axis=0))
        seen.append((each, arm))
    errors = _usual(np.concatenate([sample_errors(found, *each) for each in seen], axis=1))
    spread = np.median(spreads, axis=0)
    for k, (chain, sets) in enumerate(tried):
        arms = tuple(arm[k] for _, arm in seen)
        trial = Trial(chain, sets, arms, float(spread[k]), found, k)
        vars(trial)['error'] = float(errors[k])
        yield trial


def _nearest(chain: Chain, each: Observations, arm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return base and tool (C, 4, 4) of the closed forms nearest to samples (C, N).

    `arm` (C, N, 4, 4) are the poses of the bare arm.
    """
    forms = closed_frames(chain, each, arm)
    sizes = _errors(forms, each, arm)
    best = _usual(sizes).argmin(axis=0), np.arange(len(arm))
    usual = _last(sizes) + 1
    if usual >= 2 * IN_A_FRAME:  # base and tool explain fewer
        rows = best[1][:, np.newaxis], np.argsort(sizes[best], axis=1)[:, :usual]
        names = ('positions', 'rotations', 'oriented', *('points',) * each.seen)
        few = each.changed(**{name: getattr(each, name)[rows] for name in names})
        # a gross error would hide a mistake
        more = closed_frames(chain, few, arm[rows])
        sizes = np.concatenate([sizes, _errors(more, each, arm)])
        forms = np.concatenate([forms, more], axis=1)
        best = _usual(sizes).argmin(axis=0), best[1]
    base, tool = forms
    return base[best], tool[best]


def _last(sizes: FloatArray) -> int:
    """Return the place in order of the last of a usual share of sizes (..., N)."""
    return int((1.0 - MOST_OUTLIERS) * (sizes.shape[-1] - 1))


def _usual(sizes: FloatArray) -> FloatArray:
    """Return the sizes (...,) that a usual share of (..., N) is within; np.quantile is slow."""
    last = _last(sizes)
    return np.asarray(np.partition(sizes, last)[..., last])


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
    before = seen.stamps_ns < stamp_ns
    if min(np.count_nonzero(before), np.count_nonzero(~before)) < 2 * IN_A_FRAME:
        return False
    sides = [in_frames(problem, arm, (seen.select(rows),)) for rows in (before, ~before)]
    return all(side.error <= fault_limit(problem) for side in sides)


def misfit_set(problem: Problem, chain: Chain, sets: Sets) -> tuple[Sets, str]:
    """Return the largest set that the arm does not explain, and its name if it explains others.

    Another device or session may have other units or conventions.
    """
    if len(sets) == 1:
        return sets, ''
    most = fault_limit(problem)
    wrong = [each for each in sets if in_frames(problem, chain, (each,)).error > most]
    largest = max(wrong or sets, key=len)
    return (largest,), set_in_words(sets, largest) if 0 < len(wrong) < len(sets) else ''


def set_in_words(sets: Sequence[Observations], one: Observations) -> str:
    """Return which of several sets one is, by the frames that not all share."""
    if len(sets) == 1:
        return ''
    shared = set.intersection(*({each.base, each.tool} for each in sets))
    own = ', '.join(sorted({one.base, one.tool} - shared))
    which = f'with {own}' if own else f'of {len(one)} poses'
    return f'in the measurements {which} alone, '


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
    """Return the errors (..., N) [m] of samples, given poses (..., N, 4, 4) of the bare arm."""
    ends = chain.frame(each.base).matrix, chain.frame(each.tool).matrix
    return _errors(ends, each, arm)


def _errors(ends: Iterable[FloatArray], each: Observations, arm: FloatArray) -> FloatArray:
    """Return what `sample_errors` does, given base and tool (..., 4, 4)."""
    base, tool = ends
    found = arm.reshape(*arm.shape[:-3], -1, 4) @ tool
    found = found.reshape(*found.shape[:-2], -1, 4, 4)
    places = found[..., :3, 3]
    if each.points is not None:  # seen
        places = places + np.einsum('...nij,...nj->...ni', found[..., :3, :3], each.points)
    turn = base[..., :3, :3]
    left = each.positions - places @ np.swapaxes(turn, -1, -2) - base[..., np.newaxis, :3, 3]
    away = np.sqrt(np.einsum('...nj,...nj->...n', left, left))
    if each.oriented.any():
        seen = np.swapaxes(each.rotations, -1, -2)
        back = (seen.reshape(*seen.shape[:-3], -1, 3) @ turn).reshape(*away.shape, 3, 3)
        turned = se3.angles_between(back, np.swapaxes(found[..., :3, :3], -1, -2))
        away = away + LEVER * np.where(each.oriented, turned, 0.0)
    return np.asarray(away)
