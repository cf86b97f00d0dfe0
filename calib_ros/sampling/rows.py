# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A bounded buffer of stamped rows of numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics.se3 import FloatArray

Stamps = NDArray[np.int64]


class Rows:
    """Stamped rows of numbers in one growing block of memory, up to a capacity."""

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

    def keep(self, index: NDArray[np.generic]) -> None:
        """Keep only the rows of a mask or an index, in its order."""
        stamps = self.stamps[index]
        self._values[: len(stamps)] = self.values[index]
        self._stamps[: len(stamps)] = stamps
        self.count = len(stamps)

    def release(self, count: int) -> None:
        """Let go the first rows."""
        left = self.count - count
        self._values[:left] = self._values[count : self.count]
        self._stamps[:left] = self._stamps[count : self.count]
        self.count = left

    def sort(self) -> int:
        """Put the rows in the order of their stamps, one row a stamp; return how many went.

        Of equal stamps the smallest values win, so that the order of arrival does not choose.
        """
        before = self.count
        if before > 1 and not (np.diff(self.stamps) > 0).all():
            order = np.lexsort((*self.values.T[::-1], self.stamps))
            stamps = self.stamps[order]
            self.keep(order[np.concatenate([[True], np.diff(stamps) > 0])])
        return before - self.count
