# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamped rows of numbers: in buffers, and as messages by slices of time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib_ros.identification.levels import CONFIDENT
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.settings import Settings
from calib_ros.values import MOST_NAMES

Stamps: TypeAlias = NDArray[np.int64]
Series: TypeAlias = tuple[Stamps, FloatArray]
"""Stamps (N,), and rows (N, w) or values (N,) at them."""


AS_FLOATS = 8.0 * float(np.finfo(np.float32).eps)
"""Difference, relative as well, of values that are the same: they may have been floats, and have
gone through some roundings."""


class Rows:
    """Stamped rows of numbers in one growing block of memory, up to a capacity."""

    def __init__(self, width: int, capacity: int) -> None:
        self.width, self.capacity = width, capacity
        self.count = self.contrary = 0  # rows held; rows let go for another with other values
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
        """Keep only the rows of a mask (N,) or an index (K,), in its order."""
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
            stamps, values = self.stamps[order], self.values[order]
            again = np.diff(stamps) == 0
            near = np.isclose(
                values[1:][again], values[:-1][again], AS_FLOATS, AS_FLOATS, equal_nan=True
            )
            self.contrary += int((~near.all(axis=1)).sum())
            self.keep(order[np.concatenate([[True], ~again])])
        return before - self.count


JOINTS, POSES = 'joints', 'measurements'
NO_ACCIDENT = round(1.0 / (1.0 - CONFIDENT))
"""So many messages that differ from the others are no accident: one in so many may be."""
SILENCE = 5.0 * Settings.lateness
"""A joint or topic that was active and is silent for this long [s] is reported."""


class StreamKey(NamedTuple):
    """What one stream of measurements is of: device, target, and whether it only judges.

    What is measured in another frame is another stream.
    """

    device: str
    target: str
    validation: bool
    distance: bool
    eye_in_hand: bool
    frame_id: str = ''
    images: bool = False

    @property
    def is_place(self) -> bool:
        """Tell whether it says where the target is in the frame of its device."""
        return not (self.distance or self.eye_in_hand or self.images)


Columns: TypeAlias = tuple[int, ...]
"""The numbers in the chain of the joints that a message names."""


class Piece(NamedTuple):
    """Messages of one stream: places (N,) in the order of arrival, stamps (N,), numbers (N, w)."""

    key: Columns | StreamKey
    places: Index
    stamps: Stamps
    numbers: FloatArray

    @property
    def kind(self) -> str:
        """Return what is said: where joints are, or what was measured."""
        return POSES if isinstance(self.key, StreamKey) else JOINTS

    def cut(self, begin: int, end: int) -> Piece:
        """Return what has its place from `begin` on and before `end`."""
        part = slice(*np.searchsorted(self.places, (begin, end)).tolist())
        return Piece(self.key, self.places[part], self.stamps[part], self.numbers[part])


@dataclass(frozen=True, eq=False)
class Slice:
    """Messages in the order in which they came; places count from the first one of a batch."""

    pieces: tuple[Piece, ...]  # by stream, the first to come first
    begin: int  # the place of the first message here
    joints: Flags  # (N,) messages that are joint states
    times: Stamps  # (N,) all stamps on the clock of the joints [ns]

    @classmethod
    def of(cls, pieces: Sequence[Piece], delay_ns: int = 0) -> Slice:
        """Put pieces in order; measurements are stamped late by `delay_ns`."""
        lengths = [len(each.places) for each in pieces]
        order = np.argsort(np.concatenate([each.places for each in pieces]), kind='stable')
        joints = np.repeat([each.kind == JOINTS for each in pieces], lengths)
        times = np.concatenate([each.stamps for each in pieces]) - np.where(joints, 0, delay_ns)
        ranks = np.split(np.argsort(order), np.cumsum(lengths)[:-1])
        ranked = [each._replace(places=own) for each, own in zip(pieces, ranks, strict=True)]
        return cls(_by_arrival(ranked), 0, joints[order], times[order])

    def __len__(self) -> int:
        """Return how many messages there are."""
        return len(self.times)

    def between(self, begin: int, end: int) -> Slice:
        """Return the messages from the one of a number on and before that of another."""
        pieces = [each.cut(self.begin + begin, self.begin + end) for each in self.pieces]
        part = slice(begin, end)
        return Slice(_by_arrival(pieces), self.begin + begin, self.joints[part], self.times[part])

    def where(self, kind: str) -> Index:
        """Return the numbers (K,) of the messages of a kind."""
        return np.flatnonzero(self.joints if kind == JOINTS else ~self.joints)


def _by_arrival(pieces: Sequence[Piece]) -> tuple[Piece, ...]:
    present = [each for each in pieces if len(each.places)]
    return tuple(sorted(present, key=lambda each: int(each.places[0])))


TOO_LATE = 'measurements: later than lateness allows'
TOO_MANY = f'measurements: beyond {MOST_NAMES} targets or frames'


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
        self.last_ns: dict[StreamKey, int] = {}
        """Stamps of the last measurements to come, by stream."""
        self.unmatched: Counter[StreamKey] = Counter()
        """How many have found no joint states since the last that did, by stream."""

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
        if key not in self and len(self) >= MOST_NAMES:  # forget those without any use
            for each in [each for each, rows in self.items() if not rows.count]:
                if not self._kept(each):
                    del self[each], self.last_ns[each], self.unmatched[each]
        if key not in self:
            if len(self) >= MOST_NAMES:
                self._dropped[TOO_MANY] += len(stamps)
                return
            self[key] = Rows(self._width, self._capacity)
        rows = self[key]
        due = np.flatnonzero(stamps > after_ns)
        taken = due[: rows.capacity - rows.count]
        self.last_ns[key] = int(stamps[-1])
        if len(due) < len(stamps):
            self._dropped[TOO_LATE] += len(stamps) - len(due)
            self.unmatched[key] += len(stamps) - len(due)
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
