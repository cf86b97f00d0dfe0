# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamped rows of numbers in bounded buffers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.account import Cause, Lost
from calib_ros.sampling.clock_offset import ClockOffset
from calib_ros.sampling.slices import POSES, Stamps, StreamKey
from calib_ros.values import MOST_NAMES

AS_FLOATS = 8.0 * float(np.finfo(np.float32).eps)
"""Relative and absolute difference of equal values, which may have been rounded to float."""


class Rows:
    """Stamped rows of numbers in one growing array, up to a capacity."""

    def __init__(self, width: int, capacity: int) -> None:
        self.width, self.capacity = width, capacity
        self.count = 0
        self._stamps = np.empty(min(1024, capacity), dtype=np.int64)
        self._values = np.empty((len(self._stamps), width))

    @property
    def full(self) -> bool:
        """Tell whether there is no room for another row."""
        return self.count == self.capacity

    @property
    def stamps(self) -> Stamps:
        """Return the stamps (M,) in the order of arrival."""
        return self._stamps[: self.count]

    @property
    def values(self) -> FloatArray:
        """Return the rows (M, width) in the order of arrival."""
        return self._values[: self.count]

    def extend(self, stamps: Stamps, rows: FloatArray) -> None:
        """Add rows (M, at most width), NaN where they are shorter; there is room for them."""
        end = self.count + len(stamps)
        if end > len(self._stamps):
            size = min(max(2 * self.count, end), self.capacity)
            self._stamps = np.resize(self._stamps, size)
            self._values = np.resize(self._values, (size, self._values.shape[1]))
        width = rows.shape[1]
        self._stamps[self.count : end] = stamps
        self._values[self.count : end, :width] = rows
        self._values[self.count : end, width:] = np.nan
        self.count = end

    def keep(self, index: NDArray[np.generic] | slice) -> None:
        """Keep only the rows of a mask (N,), a slice or an index (K,), in its order."""
        stamps = self.stamps[index]
        self._values[: len(stamps)] = self.values[index]
        self._stamps[: len(stamps)] = stamps
        self.count = len(stamps)

    def sort(self) -> tuple[int, int]:
        """Sort the rows by stamp, one row each; return how many were dropped as equal or contrary.

        Of equal stamps the row with most values is kept, or the smallest values, so that the order
        of arrival does not matter.
        """
        if (np.diff(self.stamps) > 0).all():
            return 0, 0
        missing = np.isnan(self.values)  # rotations and covariances that others have
        order = np.lexsort((*self.values.T[::-1], missing.sum(axis=1), self.stamps))
        again = np.diff(self.stamps[order]) == 0
        after, before = self.values[order[1:][again]], self.values[order[:-1][again]]
        near = np.isclose(after, before, AS_FLOATS, AS_FLOATS)
        near = (near | np.isnan(after) | np.isnan(before)).all(axis=1)
        self.keep(order[np.concatenate([[True], ~again])])
        return int(near.sum()), int((~near).sum())


TOO_LATE = Lost('later than lateness allows')
TOO_MANY = Cause(POSES, f'beyond {MOST_NAMES} targets or frames')


class Waiting(dict[StreamKey, Rows]):
    """Buffers of rows (N, width) by stream.

    A tracker may number markers without end: unused streams are forgotten, unless samples of them
    are `kept`.
    """

    def __init__(
        self, width: int, capacity: int, dropped: Counter[Cause], kept: Callable[[StreamKey], bool]
    ) -> None:
        self._width, self._capacity = width, capacity
        self._dropped, self._kept = dropped, kept
        self.apart: dict[StreamKey, ClockOffset] = {}

    @property
    def count(self) -> int:
        """Return the number of waiting measurements."""
        return sum(rows.count for rows in self.values())

    @property
    def images(self) -> set[int]:
        """Return the numbers of waiting images."""
        found = [rows.values[:, 0] for key, rows in self.items() if key.images]
        return {int(number) for numbers in found for number in numbers.tolist()}

    def extend(self, key: StreamKey, stamps: Stamps, numbers: FloatArray, after_ns: int) -> bool:
        """Take measurements: numbers (M, w) at stamps (M,), those after `after_ns`.

        Returns False if the stream is one too many.
        """
        if key not in self and len(self) >= MOST_NAMES:  # forget those without any use
            for each in [each for each, rows in self.items() if not rows.count]:
                if not self._kept(each):
                    del self[each], self.apart[each]
        if key not in self:
            if len(self) >= MOST_NAMES:
                self._dropped[TOO_MANY] += len(stamps)
                return False
            self[key], self.apart[key] = Rows(self._width, self._capacity), ClockOffset()
        rows = self[key]
        due = np.flatnonzero(stamps > after_ns)
        taken = due[: rows.capacity - rows.count]
        if len(due) < len(stamps):
            self._dropped[Cause(POSES, TOO_LATE)] += len(stamps) - len(due)
        if len(taken) < len(due):
            self._dropped[Cause(POSES, Lost('pose buffer full'))] += len(due) - len(taken)
        rows.extend(stamps[taken], numbers[taken])
        return True
