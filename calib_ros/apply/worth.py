# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The worth of candidates by a criterion, and those chosen by it so far.

A pose with the rows A (m, P) of information (`design.py`) is judged by an m x m matrix:

    d       ln det(M + A^T A) - ln det M = ln det(I + A C A^T)          (O1, Borm and Menq 1991)
    task    tr V C - tr V (M + A^T A)^-1 = tr (I + A C A^T)^-1 A C V C A^T
            with V the mean of J^T J over the poses of a task: tr V C is the mean squared error
    o2-o5   observability indices (`observability.py`), from eigenvalues

A trace over A^T A, quick for all candidates at once, bounds `d` and `task` from above: only
candidates with a bound above the best are judged in full.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from calib_ros.apply.design import Candidates, information_of, times
from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.observability import indices_of
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, Flags, FloatArray, Index
from calib_ros.settings import Criterion

INDICES: tuple[Criterion, ...] = ('o2', 'o3', 'o4', 'o5')


class Pick:
    """The candidates chosen so far, and their information."""

    def __init__(self, space: Candidates, apart: float) -> None:
        self._joints, self._rows, self._apart = space.joints, space.rows, apart
        self._start = space.known + HALF_THE_DIGITS * np.eye(len(space.known))  # invertible
        self._near: list[Flags] = []
        self._blocked = np.zeros(len(space.rows), dtype=np.intp)
        self.information = self._start
        self.chosen: list[int] = []

    def best(self, worth: Worth) -> int:
        """Return the most informative candidate that is apart from those chosen."""
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
        """Choose a candidate, as the last one or at a place."""
        near = np.abs(self._joints - self._joints[index]).max(axis=1) <= self._apart
        place = len(self.chosen) if place is None else place
        self.chosen.insert(place, index)
        self._near.insert(place, near)
        self._blocked += near
        self.information = self.information + information_of(self._rows[index])

    def exchange(self, worth: Worth) -> bool:
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

    def in_order(self, worth: Worth) -> Index:
        """Return the indices (K,) of the chosen candidates, best first."""
        left, ordered, information = list(self.chosen), [], self._start
        while left:
            best = left.pop(int(worth.of(information, self._rows[left]).argmax()))
            information = information + information_of(self._rows[best])
            ordered.append(best)
        return np.array(ordered)


class Worth:
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
        root = root_of_covariance(information)
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
        root = root_of_covariance(information)
        inverse = root @ root.T
        if self.wanted is None:
            return np.asarray(6.0 * np.log1p(self.space.traces(inverse) / 6.0))
        return self.space.traces(inverse @ self.wanted @ inverse)  # without (I + A C A^T)^-1


def root_of_covariance(information: FloatArray) -> FloatArray:
    """Return L (P, P) with L L^T = M^-1, for information M (P, P)."""
    lower = linalg.cholesky(information, lower=True)
    return np.asarray(linalg.solve_triangular(lower, np.eye(len(lower)), lower=True).T)
