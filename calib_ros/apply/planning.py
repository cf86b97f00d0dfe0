# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Choice of poses to measure, and the expected accuracy.

A pose with the rows A (m, P) of information (`design.py`) is judged by an m x m matrix:

    d       ln det(M + A^T A) - ln det M = ln det(I + A C A^T)          (O1, Borm and Menq 1991)
    task    tr V C - tr V (M + A^T A)^-1 = tr (I + A C A^T)^-1 A C V C A^T
            with V the mean of J^T J over the poses of a task: tr V C is the mean squared error
    o2-o5   observability indices (`observability.py`), from eigenvalues

Poses are chosen one by one, best first, and then exchanged one by one while that helps (Fedorov
1972, Mitchell 1974). A trace over A^T A, quick for all candidates at once, bounds `d` and `task`
from above: only candidates with a bound above the best are judged in full. The indices o2 to o5
are undefined while M is singular: exchanges then start from the choice by `d`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import linalg

from calib_ros.annotated import Count, NotNegative, as_annotated, check_fields
from calib_ros.apply.candidates import travel_times, visit_order
from calib_ros.apply.design import (
    Candidates,
    Design,
    accuracy,
    information_of,
    predicted,
    times,
    triangular,
)
from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.configurations import STILL
from calib_ros.estimation.identifiability import independent
from calib_ros.estimation.observability import indices_of
from calib_ros.kinematics.limits import check_limits
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, Flags, FloatArray, Index
from calib_ros.progress import Notify, quiet
from calib_ros.settings import Criterion
from calib_ros.shown import Shown, as_frame, rounded

INDICES: tuple[Criterion, ...] = ('o2', 'o3', 'o4', 'o5')


@dataclass(frozen=True, eq=False)
class Choice:
    """What poses to measure are chosen from, and by what; as in `plan`."""

    design: Design
    candidates: FloatArray
    criterion: Criterion = 'd'
    task: FloatArray | None = None
    apart: NotNegative = STILL
    progress: Notify = quiet

    def __post_init__(self) -> None:
        check_fields(self)

    @cached_property
    def _first(self) -> _Worth:
        space = Candidates(self.design, self.candidates)
        return _Worth(space, 'task' if self.criterion == 'task' else 'd', self.task)

    @as_annotated
    def best(self, count: Count) -> Index:
        """Return the indices (count,) of the chosen poses, the most informative first."""
        return self.exchanged(self.quick(count))

    def quick(self, count: int) -> Index:
        """Return the indices (count,) of poses chosen one by one, without exchanges."""
        self.progress(f'{count} poses')
        pick = _Pick(self._first.space, self.apart)
        for _ in range(count):
            pick.add(pick.best(self._first))
        return pick.in_order(self._first)

    def exchanged(self, chosen: Index) -> Index:
        """Return the indices (K,) of poses after exchanges, the most informative first."""
        worth = _Worth(self._first.space, self.criterion, self.task)
        pick = _Pick(self._first.space, self.apart)
        for index in chosen.tolist():
            pick.add(index)
        rounds = 1
        while pick.exchange(worth):
            rounds += 1
            self.progress(f'{len(chosen)} poses, exchange {rounds}')
        return pick.in_order(self._first)

    def efficiency(self, chosen: Index) -> float:
        """Return a lower bound of the quality of poses (K,) relative to the best of that number.

        For the criteria `d` and `task`, as a share of poses: with 0.9 even the best choice would
        need 90 % of them. Both criteria are convex, and the tangent at the choice (Kiefer and
        Wolfowitz 1960) bounds the gain of the candidates with the steepest slopes.
        """
        space = self._first.space
        ridge = HALF_THE_DIGITS * np.eye(len(space.known))
        root = _root(space.known + information_of(space.rows[chosen]) + ridge)
        slope = root @ root.T
        if self._first.wanted is not None:
            slope = slope @ self._first.wanted @ slope
        each = space.traces(slope)
        start = float(np.sum(slope * space.known))
        steepest = np.sort(each)[-len(chosen) :]
        return float((start + each[chosen].sum()) / (start + steepest.sum()))


class _Pick:
    """The candidates chosen so far, and their information."""

    def __init__(self, space: Candidates, apart: float) -> None:
        self._joints, self._rows, self._apart = space.joints, space.rows, apart
        self._start = space.known + HALF_THE_DIGITS * np.eye(len(space.known))  # invertible
        self._near: list[Flags] = []
        self._blocked = np.zeros(len(space.rows), dtype=np.intp)
        self.information = self._start
        self.chosen: list[int] = []

    def best(self, worth: _Worth) -> int:
        free = np.flatnonzero(self._blocked == 0)
        if not free.size:
            raise InputError(
                f'only {len(self.chosen)} of {len(self._rows)} candidates are {self._apart:g} '
                'apart from each other (--apart): give more candidates (--draw, --candidates), or '
                'plan fewer poses'
            )
        most = worth.at_most(self.information)[free]
        few = min(int(np.sqrt(free.size)), free.size - 1)
        likely = free[np.argpartition(-most, few)[: few + 1]]
        least = worth.of(self.information, self._rows[likely]).max()
        promising = free[most >= least - HALF_THE_DIGITS * abs(least)]
        return int(promising[worth.of(self.information, self._rows[promising]).argmax()])

    def add(self, index: int, place: int | None = None) -> None:
        near = np.abs(self._joints - self._joints[index]).max(axis=1) <= self._apart
        place = len(self.chosen) if place is None else place
        self.chosen.insert(place, index)
        self._near.insert(place, near)
        self._blocked += near
        self.information = self.information + information_of(self._rows[index])

    def exchange(self, worth: _Worth) -> bool:
        """Exchange chosen candidates for better ones; return whether any changed."""
        rows = self._rows[self.chosen]
        self.information = self._start + information_of(rows)  # no rounding left
        changed = False
        for place in range(len(self.chosen)):
            old = self.chosen.pop(place)
            self._blocked -= self._near.pop(place)
            self.information = self.information - information_of(self._rows[old])
            new = self.best(worth)
            ours, theirs = worth.of(self.information, self._rows[[new, old]])
            if ours - theirs > HALF_THE_DIGITS * abs(theirs):
                changed = True
            else:
                new = old
            self.add(new, place)
        return changed

    def in_order(self, worth: _Worth) -> Index:
        """Return the chosen candidates, best first."""
        left, ordered, information = list(self.chosen), [], self._start
        while left:
            best = left.pop(int(worth.of(information, self._rows[left]).argmax()))
            information = information + information_of(self._rows[best])
            ordered.append(best)
        return np.array(ordered)


class _Worth:
    """Worth of candidates by a criterion."""

    def __init__(self, space: Candidates, criterion: Criterion, task: FloatArray | None) -> None:
        self._criterion, self.space, self.wanted = criterion, space, None
        if criterion == 'task':
            if task is None:
                raise ConfigError('the criterion "task" needs the poses of a task')
            self.wanted = space.of_task(task)

    def of(self, information: FloatArray, rows: FloatArray) -> FloatArray:
        """Return the worth (N,) of candidates with rows (N, m, P) beside information (P, P)."""
        if self._criterion in INDICES:
            # of M + A^T A, in sigma per metre or radian
            factor = self.space.factor
            back = times(rows, factor)
            total = factor.T @ information @ factor + np.swapaxes(back, 1, 2) @ back
            singular = np.sqrt(np.maximum(np.linalg.eigvalsh(total), 1e-300))
            return indices_of(singular)[self._criterion]
        root = _root(information)
        seen = times(rows, root)
        turned = np.swapaxes(seen, 1, 2)
        whole = np.eye(seen.shape[1]) + seen @ turned
        if self.wanted is None:
            return np.asarray(np.linalg.slogdet(whole)[1])
        spread = times(seen, root.T @ self.wanted @ root) @ turned
        return np.asarray(np.trace(np.linalg.solve(whole, spread), axis1=1, axis2=2))

    def at_most(self, information: FloatArray) -> FloatArray:
        """Return upper bounds (N,): ln det(I + S) <= m ln(1 + tr S / m), m <= 6."""
        if self._criterion in INDICES:  # every candidate is judged in full
            return np.full(len(self.space.rows), np.inf)
        root = _root(information)
        inverse = root @ root.T
        if self.wanted is None:
            return np.asarray(6.0 * np.log1p(self.space.traces(inverse) / 6.0))
        return self.space.traces(inverse @ self.wanted @ inverse)  # without (I + A C A^T)^-1


def _root(information: FloatArray) -> FloatArray:
    """Return L (P, P) with L L^T = M^-1."""
    lower = linalg.cholesky(information, lower=True)
    return np.asarray(linalg.solve_triangular(lower, np.eye(len(lower)), lower=True).T)


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Shown):
    """Poses to measure, and the accuracy to expect."""

    joints: FloatArray
    """(K, n) joint values [rad or m], the most informative first."""
    visit: Index
    """(K,) visiting order."""
    travel: float
    """Time of all moves [s]."""
    accuracy: FloatArray
    """(K,) predicted RMS position error [m] with the first 1, 2, ... K of them."""
    at_random: FloatArray
    """(K,) the same with candidates taken at random (median of draws)."""
    efficiency: float | None
    """Lower bound relative to the best choice of as many candidates; None for o2 to o5 and for
    too few poses to determine all parameters."""
    lacking: tuple[str, ...]
    """Parameters that no choice of these candidates would determine; they are ignored."""
    least: int = 1
    """With fewer poses some parameter is certainly undetermined: each has so many rows."""

    def to_frame(self) -> Any:
        """Return the joint values [rad or m] in visiting order as a pandas.DataFrame.

        `telling` is the rank of a pose by information, from 1.
        """
        columns = {f'q{k}': column[self.visit] for k, column in enumerate(self.joints.T, 1)}
        return as_frame({'telling': self.visit + 1, **columns})


@as_annotated
def plan(
    design: Design,
    candidates: FloatArray,
    task: FloatArray,
    count: Count,
    criterion: Criterion = 'd',
    apart: NotNegative = STILL,
    velocities: FloatArray | None = None,
    draws: Count = 25,
    progress: Notify = quiet,
    chosen: Index | None = None,
) -> Plan:
    """Plan `count` measurements, and compare them with as many at random (`draws`).

    `candidates` (N, n) and the `task` (M, n), where the arm must be accurate, are joint values
    [rad or m]; `velocities` (n,) are the largest rates. `criterion` is d, task, or o2 to o5. Any
    two poses differ by at least `apart` [rad or m] in the joint that moves most. `chosen` (count,)
    are indices already found.

    Raises InputError if the candidates do not suffice or joint values are beyond their limits,
    ConfigError for a count below one or rates that are not positive.
    """
    candidates, task = map(design.chain.joint_values, (candidates, task))
    if not len(candidates) or not len(task):
        raise InputError('a plan needs candidates, and at least one pose of the task')
    check_limits(candidates, design.chain, lambda k, i: f'candidates[{k}, {i}]: ')
    check_limits(task, design.chain, lambda k, i: f'task[{k}, {i}]: ')
    joints = candidates.shape[1]
    speeds = np.ones(joints) if velocities is None else velocities
    if speeds.shape != (joints,) or not (speeds > 0.0).all():
        raise ConfigError(f'velocities must be {joints} positive numbers, not {speeds}')
    last = len(candidates) - 1
    if chosen is not None and (chosen.shape != (count,) or not set(chosen) <= {*range(last + 1)}):
        raise ConfigError(
            f'chosen must be {count} numbers from 0 to {last}, not {chosen.tolist()!r:.60}'
        )
    excited = design.determined_by(candidates)
    choice = Choice(excited, candidates, criterion, task, apart, progress)
    chosen = choice.best(count) if chosen is None else chosen
    found = candidates[chosen]
    visit = visit_order(found, speeds)
    rng = np.random.default_rng(0)
    orders = [rng.permutation(len(candidates))[:count] for _ in range(draws)]
    at_random = [accuracy(excited, candidates[order], task) for order in orders]
    predictions = accuracy(excited, found, task)
    unknown = len(excited.names) - len(independent(triangular(excited.known), excited.names))
    bound = None
    if criterion in ('d', 'task') and np.isfinite(predictions[-1]):
        bound = choice.efficiency(chosen)
    moves = travel_times(found[visit], speeds)
    return Plan(
        found,
        visit,
        float(np.diagonal(moves, 1).sum()),
        predictions,
        np.median(at_random, axis=0),
        bound,
        tuple(name for name in design.names if name not in excited.names),
        -(-unknown // excited.rows(candidates[:1]).shape[1]),
    )


def fewest(choice: Choice, wanted: float) -> Index:
    """Return the indices (K,) of the fewest poses with the accuracy `wanted`, best first.

    That is the predicted RMS position error [m] at the poses of the task.
    """
    candidates, task = choice.candidates, choice.task
    if task is None:
        raise InputError('give the poses at which the accuracy is wanted, as the task')
    choice = replace(choice, design=choice.design.determined_by(candidates))
    excited = choice.design
    best = predicted(excited.after(candidates), task)
    if best > wanted:
        raise InputError(
            f'all {len(candidates)} candidates together predict {rounded(1e3 * best)} mm, '
            f'but {1e3 * wanted:g} mm is wanted: give more candidates (--draw, --candidates), a '
            'more accurate device (--sigma-position), or a larger --accuracy'
        )
    count = len(excited.names)  # poses determine several parameters each
    while True:
        count = min(count, len(candidates))
        found = choice.quick(count)
        errors = accuracy(excited, candidates[found], task)
        if errors[-1] <= wanted:
            break
        growth = (errors[-1] / wanted) ** 2  # errors fall with the root of the number
        count = max(count + 1, int(count * min(growth, 2.0)))
    reached = int(np.flatnonzero(errors <= wanted)[0]) + 1
    while reached > 1:  # the first of many are not the best of few
        start = found[:reached] if reached < len(found) else found[: reached - 1]
        for begin in (start, None):  # quick first
            fewer = choice.exchanged(choice.quick(len(start)) if begin is None else begin)
            errors = accuracy(excited, candidates[fewer], task)
            if errors[-1] <= wanted:
                break
        else:
            break
        found, reached = fewer, int(np.flatnonzero(errors <= wanted)[0]) + 1
    return found[:reached]


def accuracy_in_words(plan: Plan) -> list[str]:
    """Return the lines of a table: the expected accuracy by number of poses."""
    count = len(plan.joints)
    first = int(np.isfinite(plan.accuracy).sum())
    shown = np.unique(np.linspace(count - first + 1, count, min(first, 12)).round().astype(int))
    head = 'predicted RMS position error [mm], from measurement noise alone'
    lines = [head, ' poses   planned   random']
    for number in shown.tolist():
        planned, random = (1e3 * each[number - 1] for each in (plan.accuracy, plan.at_random))
        by_chance = rounded(random) if np.isfinite(random) else '-'
        lines.append(f'{number:6} {rounded(planned):>9} {by_chance:>8}')
    if not first:
        why = f'too few poses to determine all parameters: at least {plan.least} are needed'
        lines.append(f'{count:6}         - {why}')
    return lines


def outlook(plan: Plan, candidates: int, wanted_mm: float | None, needed: int | None) -> list[str]:
    """Return the efficiency of a plan, how many poses are needed, and what it leaves open."""
    text = f'{len(plan.joints)} of {candidates} candidates'
    if plan.efficiency is not None:
        text += f', at least {100.0 * plan.efficiency:.0f} % as good as the best choice'
    lines = [f'{text}; moves take {plan.travel:.0f} s']
    if needed is not None:
        lines.append(f'{needed} poses reach {wanted_mm:g} mm')
    if plan.lacking:
        lines.append(
            f'no choice of these candidates determines {", ".join(plan.lacking)}: move the joints '
            'further and in more combinations, or fix these parameters. The figures ignore these '
            'parameters, and hold only where the joints move as in the candidates'
        )
    return lines
