# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements that wait for their time, in a bounded buffer for each stream."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np

from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.rows import Rows, Stamps
from calib_ros.sampling.slices import Slice, StreamKey
from calib_ros.values import MOST_NAMES

TOO_LATE = 'measurements: later than lateness allows'
TOO_MANY = f'measurements: of one more than {MOST_NAMES} targets, or frames'


class Waiting(dict[StreamKey, Rows]):
    """The buffers by stream, of rows (N, width) each.

    A tracker may number markers without end: a stream without any use is forgotten, unless
    samples of it are `kept`.
    """

    def __init__(
        self, width: int, capacity: int, dropped: Counter[str], kept: Callable[[StreamKey], bool]
    ) -> None:
        super().__init__()
        self._width, self._capacity = width, capacity
        self._dropped, self._kept = dropped, kept

    @property
    def count(self) -> int:
        """Return how many measurements wait."""
        return sum(rows.count for rows in self.values())

    @property
    def images(self) -> set[int]:
        """Return the numbers of the images that wait."""
        found = [rows.values[:, 0] for key, rows in self.items() if key.images]
        return {int(number) for numbers in found for number in numbers.tolist()}

    def extend(self, key: StreamKey, stamps: Stamps, numbers: FloatArray, after_ns: int) -> None:
        """Take measurements: numbers (M, w) at stamps (M,), those after a stamp."""
        rows = self._stream(key)
        if rows is None:
            self._dropped[TOO_MANY] += len(stamps)
            return
        due = np.flatnonzero(stamps > after_ns)
        taken = due[: rows.capacity - rows.count]
        if len(due) < len(stamps):
            self._dropped[TOO_LATE] += len(stamps) - len(due)
        if len(taken) < len(due):
            self._dropped['measurements: pose buffer full'] += len(due) - len(taken)
        rows.extend(stamps[taken], numbers[taken])

    def room(self, given: Slice) -> int | None:
        """Return up to where there is room for messages; None where it must be made."""
        streams = [each for each in given.pieces if isinstance(each.key, StreamKey)]
        if len(self.keys() | {each.key for each in streams}) > MOST_NAMES:
            return None
        end = len(given)
        for key, places, *_ in streams:
            assert isinstance(key, StreamKey)
            room = self._capacity - (self[key].count if key in self else 0)
            end = int(min([end, *(places[room : room + 1] - given.begin).tolist()]))
        return end

    def _stream(self, key: StreamKey) -> Rows | None:
        """Return the buffer of a stream; None when too many others are in use."""
        if key not in self:
            if len(self) >= MOST_NAMES:  # forget those without any use
                for each in [each for each, rows in self.items() if not rows.count]:
                    if not self._kept(each):
                        del self[each]
            if len(self) >= MOST_NAMES:
                return None
            self[key] = Rows(self._width, self._capacity)
        return self[key]
