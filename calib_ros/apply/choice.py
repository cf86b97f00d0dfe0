# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which of many candidates to measure.

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
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from calib_ros.apply.design import Candidates, Design, information_of, times
from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.identification.configurations import STILL
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray
from calib_ros.progress import Told, nobody
from calib_ros.settings import CRITERIA, Criterion

Score: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]
"""Returns the worth (N,) of candidates from information (P, P) and their rows (N, m, P)."""


def choose(
    design: Design,
    candidates: FloatArray,
    count: int,
    criterion: Criterion = 'd',
    task: FloatArray | None = None,
    apart: float = STILL,
    told: Told = nobody,
) -> NDArray[np.intp]:
    """Choose poses to measure among candidates (N, n) [rad or m].

    Return the indices (count,) of the chosen, the best first: with the first of them alone most
    is determined. The criterion `task` asks for joint values (T, n) at which the arm is to be
    accurate. Two poses are `apart` by so much [rad or m] of the joint that moves most.
    """
    if count < 1:
        raise ConfigError(f'at least one pose must be chosen, not {count}')
    space = Candidates(design, candidates)
    score = _score(space, criterion, task)
    first = score if criterion == 'task' else _by_determinant
    pick = _Pick(space, apart)
    told(f'{count} poses')
    for _ in range(count):
        pick.add(pick.best(first))
    rounds = 1
    while pick.exchange(score):
        rounds += 1
        told(f'{count} poses, exchange {rounds}')
    again = _Pick(space, apart)
    for _ in range(count):
        again.add(again.best(first, pick.chosen))
    return np.array(again.chosen)


class _Pick:
    """The candidates chosen so far, and the information that they bring."""

    def __init__(self, space: Candidates, apart: float) -> None:
        self._joints, self._rows = space.joints, space.rows
        self._start = space.known + HALF_THE_DIGITS * np.eye(len(space.known))  # invertible
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
            if worth[new] - worth[old] > HALF_THE_DIGITS * abs(worth[old]):
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
    if criterion != 'task':
        return partial(_by_index, criterion=criterion, factor=space.factor)
    if task is None:
        raise ConfigError('the criterion "task" needs the poses of a task')
    return partial(_by_task, wanted=space.of_task(task))


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
    found = {
        'o2': smallest / largest,
        'o3': smallest,
        'o4': smallest**2 / largest,
        'o5': 1.0 / np.sum(1.0 / singular, axis=1),
    }
    return np.asarray(found[criterion])


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
    ridge = HALF_THE_DIGITS * np.eye(len(space.known))
    root = _root(space.known + information_of(space.rows[chosen]) + ridge)
    slope = root @ root.T
    if task is not None:
        slope = slope @ space.of_task(task) @ slope
    each = np.einsum('nmp,nmp->n', times(space.rows, slope), space.rows)
    start = float(np.sum(slope * space.known))
    steepest = np.sort(each)[-len(chosen) :]
    return float((start + each[chosen].sum()) / (start + steepest.sum()))
