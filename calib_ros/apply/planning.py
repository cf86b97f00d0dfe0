# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which poses to measure.

A pose with the rows A (m, P) of information (`design.py`) is judged by a matrix of m x m:

    d       ln det(M + A^T A) - ln det M = ln det(I + A C A^T)          (O1, Borm and Menq 1991)
    task    tr V C - tr V (M + A^T A)^-1 = tr (I + A C A^T)^-1 A C V C A^T
            with V the mean of J^T J over the poses of a task: tr V C is the mean squared error
    o2-o5   observability indices (`identifiability.observability`), from eigenvalues

Poses are chosen one by one, the best first, and then exchanged one by one while that helps
(Fedorov 1972, Mitchell 1974). The indices o2 to o5 say nothing while M is singular: there the
choice by `d` is where exchanges start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from calib_ros.apply.candidates import travel_times, visit_order
from calib_ros.apply.design import Candidates, Design, accuracy, information_of, predicted, times
from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.identification.observations import STILL
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import Shown

Criterion: TypeAlias = Literal['d', 'o2', 'o3', 'o4', 'o5', 'task']
CRITERIA: tuple[Criterion, ...] = get_args(Criterion)
Score: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]
"""Returns the worth (N,) of candidates from information (P, P) and their rows (N, m, P)."""

RIDGE = 1e-9
"""Information about everything, in that of an average candidate, that keeps M invertible."""
SWEEPS = 20
"""Most rounds of exchanges."""
GAIN = 1e-9
"""Least relative gain of an exchange."""
RANDOM_DRAWS = 25
"""Random choices that a plan is compared with."""
FIRST_COUNT = 25
"""Poses with which the search for the number that is needed begins."""


def choose(
    design: Design,
    candidates: FloatArray,
    count: int,
    criterion: Criterion = 'd',
    task: FloatArray | None = None,
    apart: float = STILL,
) -> NDArray[np.intp]:
    """Choose the poses to measure.

    Parameters
    ----------
    design : Design
        What is to be identified and what is known about it.
    candidates : (N, n)
        Joint values [rad or m] that the arm may be moved to.
    count : int
        How many of them.
    criterion : Criterion
        What is to be large, by its name.
    task : (T, n), optional
        Joint values at which the arm is to be accurate, for the criterion `task`.
    apart : float
        Least distance of two poses: of the joint that moves most [rad or m].

    Returns
    -------
    (count,)
        Indices of the chosen, the best first: with the first of them alone most is determined.

    Raises
    ------
    InputError
        With fewer candidates than poses, at that distance from each other.

    """
    if count < 1:
        raise ConfigError(f'at least one pose must be chosen, not {count}')
    space = Candidates(design, candidates)
    score = _score(space, criterion, task)
    first = score if criterion == 'task' else _by_determinant
    pick = _Pick(space, apart)
    for _ in range(count):
        pick.add(pick.best(first))
    for _ in range(SWEEPS):
        if not pick.exchange(score):
            break
    again = _Pick(space, apart)
    for _ in range(count):
        again.add(again.best(first, pick.chosen))
    return np.array(again.chosen)


class _Pick:
    """The candidates chosen so far, and the information that they bring."""

    def __init__(self, space: Candidates, apart: float) -> None:
        self._joints, self._rows = space.joints, space.rows
        self._start = space.known + RIDGE * np.eye(len(space.known))
        self._apart = apart
        self._near: list[NDArray[np.bool_]] = []
        self._blocked = np.zeros(len(space.rows), dtype=np.intp)
        self.information = self._start
        self.chosen: list[int] = []

    def best(self, score: Score, among: list[int] | None = None) -> int:
        """Return the best candidate that is free to be chosen."""
        worth = np.where(self._blocked > 0, -np.inf, score(self.information, self._rows))
        index = np.arange(len(worth)) if among is None else np.array(among)
        best = int(index[worth[index].argmax()])
        if self._blocked[best]:
            raise InputError(
                f'only {len(self.chosen)} of {len(worth)} candidates are {self._apart:g} apart '
                'from each other: give more candidates, or plan fewer poses'
            )
        return best

    def add(self, index: int, place: int | None = None) -> None:
        """Choose a candidate."""
        near = np.abs(self._joints - self._joints[index]).max(axis=1) <= self._apart
        place = len(self.chosen) if place is None else place
        self.chosen.insert(place, index)
        self._near.insert(place, near)
        self._blocked += near
        self.information = self.information + information_of(self._rows[index])

    def exchange(self, score: Score) -> bool:
        """Exchange every chosen candidate for the best one; return whether any was changed."""
        rows = self._rows[self.chosen]
        self.information = self._start + information_of(rows)  # no rounding left
        changed = False
        for place in range(len(self.chosen)):
            old = self.chosen.pop(place)
            self._blocked -= self._near.pop(place)
            self.information = self.information - information_of(self._rows[old])
            worth = np.where(self._blocked > 0, -np.inf, score(self.information, self._rows))
            new = int(worth.argmax())
            if worth[new] - worth[old] > GAIN * abs(worth[old]):
                changed = True
            else:
                new = old
            self.add(new, place)
        return changed


def _score(space: Candidates, criterion: Criterion, task: FloatArray | None) -> Score:
    """Return the score of a criterion."""
    if criterion not in CRITERIA:
        raise UnknownNameError('criterion', criterion, CRITERIA)
    if criterion == 'd':
        return _by_determinant
    if criterion == 'task':
        if task is None:
            raise ConfigError('the criterion "task" needs the poses of a task')
        wanted = space.of_task(task)
        return lambda information, rows: _by_task(information, rows, wanted)
    return lambda information, rows: _by_index(information, rows, criterion, space.factor)


def _by_determinant(information: FloatArray, rows: FloatArray) -> FloatArray:
    """Return ln det(I + A C A^T)."""
    seen = times(rows, _root(information))
    return np.asarray(np.linalg.slogdet(_with_unit(seen))[1])


def _by_task(information: FloatArray, rows: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return tr (I + A C A^T)^-1 A C V C A^T."""
    root = _root(information)
    seen = times(rows, root)
    spread = times(seen, root.T @ wanted @ root) @ np.swapaxes(seen, 1, 2)
    return np.asarray(np.trace(np.linalg.solve(_with_unit(seen), spread), axis1=1, axis2=2))


def _by_index(
    information: FloatArray, rows: FloatArray, criterion: Criterion, factor: FloatArray
) -> FloatArray:
    """Return an observability index of M + A^T A, in sigma per metre or radian."""
    back = times(rows, factor)
    total = factor.T @ information @ factor + np.swapaxes(back, 1, 2) @ back
    singular = np.sqrt(np.maximum(np.linalg.eigvalsh(total), 1e-300))
    smallest, largest = singular[:, 0], singular[:, -1]
    if criterion == 'o2':
        return np.asarray(smallest / largest)
    if criterion == 'o3':
        return np.asarray(smallest)
    if criterion == 'o4':
        return np.asarray(smallest**2 / largest)
    return np.asarray(1.0 / np.sum(1.0 / singular, axis=1))


def _root(information: FloatArray) -> FloatArray:
    """Return L (P, P) with L L^T = M^-1."""
    lower = linalg.cholesky(information, lower=True)
    return np.asarray(linalg.solve_triangular(lower, np.eye(len(lower)), lower=True).T)


def _with_unit(seen: FloatArray) -> FloatArray:
    """Return I + Y Y^T (N, m, m) of (N, m, P)."""
    return np.asarray(np.eye(seen.shape[1]) + seen @ np.swapaxes(seen, 1, 2))


def efficiency(
    design: Design, candidates: FloatArray, chosen: NDArray[np.intp], task: FloatArray | None
) -> float:
    """Return a lower bound of how good a choice is against the best of as many candidates.

    For the criterion `d`, or `task` with the poses of one, as a share of poses: with 0.9 even the
    best choice would need 90 % of them. Both criteria are convex, and the tangent at the choice
    (Kiefer and Wolfowitz 1960) bounds what the candidates with the steepest slopes would bring.
    """
    space = Candidates(design, candidates)
    ridge = RIDGE * np.eye(len(space.known))
    root = _root(space.known + information_of(space.rows[chosen]) + ridge)
    slope = root @ root.T
    if task is not None:
        slope = slope @ space.of_task(task) @ slope
    each = np.einsum('nmp,nmp->n', times(space.rows, slope), space.rows)
    start = float(np.sum(slope * space.known))
    steepest = np.sort(each)[-len(chosen) :]
    return float((start + each[chosen].sum()) / (start + steepest.sum()))


@dataclass(frozen=True, eq=False)
class Suggestion:
    """The next pose to measure, and what it brings.

    Attributes
    ----------
    joints : (n,)
        Joint values [rad or m].
    now, then : float
        Predicted RMS position error [m] at the task poses, without and with it; infinite while
        parameters are not determined.
    enough : bool
        Whether the wanted error is reached already.

    """

    joints: FloatArray
    now: float
    then: float
    enough: bool


def next_pose(
    design: Design,
    candidates: FloatArray,
    task: FloatArray,
    wanted: float,
    criterion: Criterion = 'd',
) -> Suggestion:
    """Return the next best pose of candidates (N, n), after those that the design knows.

    `task` (T, n) are poses at which the RMS error of position is to be `wanted` [m].
    """
    index = choose(design, candidates, 1, criterion, task)
    now, then = predicted(design, task), predicted(design.after(candidates[index]), task)
    return Suggestion(candidates[index[0]], now, then, now <= wanted)


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Shown):
    """Poses to measure, and what they promise.

    Attributes
    ----------
    joints : (K, n)
        Joint values [rad or m], the most telling first.
    visit : (K,)
        Their order of visit.
    travel : float
        Time of the moves [s].
    accuracy : (K,)
        Predicted RMS position error [m] with the first 1, 2, ... K of them.
    at_random : (K,)
        The same with candidates taken at random (median of draws).
    efficiency : float or None
        Lower bound against the best choice of as many candidates; None for o2 to o5, and
        with too few poses to determine all parameters.
    lacking : tuple of str
        Parameters that no choice of these candidates would determine; they are left out.

    """

    joints: FloatArray
    visit: NDArray[np.intp]
    travel: float
    accuracy: FloatArray
    at_random: FloatArray
    efficiency: float | None
    lacking: tuple[str, ...]


def plan(
    design: Design,
    candidates: FloatArray,
    task: FloatArray,
    count: int,
    criterion: Criterion = 'd',
    apart: float = STILL,
    velocities: FloatArray | None = None,
) -> Plan:
    """Plan a number of measurements; `choose` and `visit_order` say what the arguments mean."""
    excited = design.determined_by(candidates)
    chosen = choose(excited, candidates, count, criterion, task, apart)
    joints = candidates[chosen]
    speeds = np.ones(joints.shape[1]) if velocities is None else velocities
    visit = visit_order(joints, speeds)
    rng = np.random.default_rng(0)
    draws = [
        accuracy(excited, candidates[rng.permutation(len(candidates))[:count]], task)
        for _ in range(RANDOM_DRAWS)
    ]
    predictions = accuracy(excited, joints, task)
    bound = None
    if criterion in ('d', 'task') and np.isfinite(predictions[-1]):
        bound = efficiency(excited, candidates, chosen, task if criterion == 'task' else None)
    moves = travel_times(joints[visit], speeds)
    return Plan(
        joints,
        visit,
        float(np.diagonal(moves, 1).sum()),
        predictions,
        np.median(draws, axis=0),
        bound,
        tuple(name for name in design.names if name not in excited.names),
    )


def poses_needed(
    design: Design,
    candidates: FloatArray,
    task: FloatArray,
    wanted: float,
    criterion: Criterion = 'd',
    apart: float = STILL,
) -> int:
    """Return how many poses bring the RMS position error at task poses (T, n) to `wanted` [m].

    Raises
    ------
    InputError
        When not even all candidates do.

    """
    excited = design.determined_by(candidates)
    best = predicted(excited.after(candidates), task)
    if best > wanted:
        raise InputError(
            f'all {len(candidates)} candidates together predict {1e3 * best:.4f} mm, '
            f'{1e3 * wanted:g} mm are wanted: give more candidates or a better measurement'
        )
    count = FIRST_COUNT
    while True:
        count = min(count, len(candidates))
        chosen = choose(excited, candidates, count, criterion, task, apart)
        reached = np.flatnonzero(accuracy(excited, candidates[chosen], task) <= wanted)
        if reached.size:
            break
        count *= 2
    count = int(reached[0]) + 1
    while count > 1:  # the first of many are not quite the best of few
        fewer = choose(excited, candidates, count - 1, criterion, task, apart)
        if accuracy(excited, candidates[fewer], task)[-1] > wanted:
            break
        count -= 1
    return count


def in_words(plan: Plan, candidates: int, wanted_mm: float | None, needed: int | None) -> str:
    """Return what a plan promises: a table over the number of poses, and how good it is."""
    count = len(plan.joints)
    first = int(np.isfinite(plan.accuracy).sum())
    shown = np.unique(np.linspace(count - first + 1, count, min(first, 12)).round().astype(int))
    lines = ['predicted RMS position error [mm]', ' poses   planned   random']
    for number in shown.tolist():
        planned, random = (1e3 * each[number - 1] for each in (plan.accuracy, plan.at_random))
        by_chance = f'{random:8.4f}' if np.isfinite(random) else '       -'
        lines.append(f'{number:6} {planned:9.4f} {by_chance}')
    if not first:
        lines.append(f'{count:6}         - too few poses to determine all parameters')
    text = f'{count} of {candidates} candidates'
    if plan.efficiency is not None:
        text += f', at least {100.0 * plan.efficiency:.0f} % of what the best choice would bring'
    lines.append(f'{text}; moves take {plan.travel:.0f} s')
    if needed is not None:
        lines.append(f'{wanted_mm:g} mm: {needed} poses')
    if plan.lacking:
        lines.append(
            f'no choice of these candidates determines {", ".join(plan.lacking)}: move the joints '
            'further and in more combinations, or fix these parameters. The figures leave out '
            'what these bring, and hold only where the joints move as in the candidates'
        )
    lines.append('from the noise of the measurement alone; what the model lacks comes on top')
    return '\n'.join(lines)
