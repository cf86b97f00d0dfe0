# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The choice of poses to measure.

Poses are chosen one by one, best first, and then exchanged one by one while that helps (Fedorov
1972, Mitchell 1974). The observability indices o2 to o5 are undefined while the information is
singular: exchanges then start from the choice by `d`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calib_ros.annotated import Count, NotNegative, as_annotated, check_fields
from calib_ros.apply.design import Candidates, Design, accuracy, information_of, predicted
from calib_ros.apply.worth import Pick, Worth, root_of_covariance
from calib_ros.errors import InputError
from calib_ros.estimation.configurations import STILL
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray, Index
from calib_ros.progress import Notify, quiet
from calib_ros.settings import Criterion
from calib_ros.shown import rounded


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
    def _first(self) -> Worth:
        space = Candidates(self.design, self.candidates)
        return Worth(space, 'task' if self.criterion == 'task' else 'd', self.task)

    @as_annotated
    def best(self, count: Count) -> Index:
        """Return the indices (count,) of the chosen poses, the most informative first."""
        return self.exchanged(self.quick(count))

    def quick(self, count: int) -> Index:
        """Return the indices (count,) of poses chosen one by one, without exchanges."""
        self.progress(f'{count} poses')
        pick = Pick(self._first.space, self.apart)
        for _ in range(count):
            pick.add(pick.best(self._first))
        return pick.in_order(self._first)

    def exchanged(self, chosen: Index) -> Index:
        """Return the indices (K,) of poses after exchanges, the most informative first."""
        worth = Worth(self._first.space, self.criterion, self.task)
        pick = Pick(self._first.space, self.apart)
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
        root = root_of_covariance(space.known + information_of(space.rows[chosen]) + ridge)
        slope = root @ root.T
        if self._first.wanted is not None:
            slope = slope @ self._first.wanted @ slope
        each = space.traces(slope)
        start = float(np.sum(slope * space.known))
        steepest = np.sort(each)[-len(chosen) :]
        return float((start + each[chosen].sum()) / (start + steepest.sum()))


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
