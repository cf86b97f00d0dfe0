# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recent joint samples: joint values at a stamp, and when the joints stood still.

Everything depends on header stamps only, not on the order of arrival. Each publisher may name some
of the joints; each part is interpolated on its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from calib_ros.estimation.levels import TELLING
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.sampling.buffers import AS_FLOATS, Rows
from calib_ros.sampling.interpolation import continuous, interpolated, last_moves
from calib_ros.sampling.intervals import intersection, silences, standing_intervals, union
from calib_ros.sampling.means import MOST_SPREAD
from calib_ros.sampling.slices import SILENCE, Series, Stamps
from calib_ros.settings import EXCEPTION

APART = 'joint states too far apart'
CAUSES = ('', APART, 'no joint state before', 'no joint state after')
"""Why there are no joint values at a stamp; the first entry means there are.

Of several publishers of a joint the first cause counts, so none of one that became silent."""
Brackets: TypeAlias = tuple[Index, Index, Index]
"""Causes (N,), and the indices of samples before and after each stamp."""


class Motion(NamedTuple):
    """Joint values (N, n), with velocities and accelerations unless at rest."""

    joints: FloatArray
    velocity: FloatArray | None = None
    acceleration: FloatArray | None = None


class Track:
    """Recent samples of all joints; `revolute` (n,) ones have angles as values.

    It interpolates over at most `max_gap` [s], and keeps up to a capacity per publisher.
    """

    def __init__(self, revolute: Sequence[bool], max_gap: float, capacity: int) -> None:
        self._revolute = np.array(revolute, dtype=bool)
        self._max_gap_ns = round(max_gap * 1e9)
        self._capacity = capacity
        self._parts: dict[tuple[int, ...], Rows] = {}
        self._earlier: dict[tuple[int, ...], FloatArray] = {}
        """Signs (k,) of the last moves before the samples, by publisher."""
        self.horizon_ns = 0  # samples before this stamp have been dropped
        self.noisiest = Counter[int]()  # how often each joint had most noise at rest

    @property
    def newest_ns(self) -> int:
        """Return the stamp up to which all named joints have been received."""
        newest = self._newest()
        return int(newest[newest > 0].min()) if newest.any() else 0

    def _newest(self) -> Stamps:
        """Return the newest stamp of each joint (n,), zero if never named."""
        newest = np.zeros(len(self._revolute), dtype=np.int64)
        for columns, rows in self._parts.items():
            index = list(columns)
            newest[index] = np.maximum(newest[index], rows.stamps.max())
        return newest

    def room(self, columns: tuple[int, ...]) -> int:
        """Return how many more samples of some joints fit."""
        rows = self._parts.get(columns)
        return self._capacity if rows is None else self._capacity - rows.count

    @property
    def full(self) -> bool:
        """Tell whether a publisher has no room for more samples."""
        return any(rows.full for rows in self._parts.values())

    @property
    def missing(self) -> tuple[int, ...]:
        """Return the joints that no publisher has named."""
        named = {column for part in self._parts for column in part}
        return tuple(k for k in range(len(self._revolute)) if k not in named)

    def silent(self, time_ns: int = round(1e9 * SILENCE)) -> tuple[int, ...]:
        """Return the joints last received so much [ns] earlier than others."""
        newest = self._newest()
        return tuple(np.flatnonzero((newest > 0) & (newest < newest.max() - time_ns)).tolist())

    def extend(self, columns: tuple[int, ...], stamps: Stamps, values: FloatArray) -> None:
        """Take values (M, k) of some joints at stamps (M,)."""
        rows = self._parts.get(columns)
        if rows is None:
            rows = self._parts[columns] = Rows(len(columns), self._capacity)
            self._earlier[columns] = np.zeros(len(columns))
        rows.extend(stamps, values)

    def bears_on(self, columns: tuple[int, ...], stamps: Stamps) -> Stamps:
        """Return since when (M,) joint values change as samples at stamps (M,) come by turns.

        Since the last but one before it that had come by then (see `interpolated`).
        """
        known = self._parts[columns].stamps if columns in self._parts else stamps[:0]
        every = np.concatenate([np.zeros(2, dtype=np.int64), np.sort(known), stamps])
        newest = np.maximum.accumulate(every)
        second = np.maximum.accumulate(np.minimum(every[1:], newest[:-1]))
        return np.asarray(second[np.maximum(np.searchsorted(newest, stamps), 2) - 2])

    def sort(self) -> tuple[int, int]:
        """Sort all samples, as `Rows.sort`."""
        dropped = [rows.sort() for rows in self._parts.values()]
        return sum(equal for equal, _ in dropped), sum(contrary for _, contrary in dropped)

    def at(self, stamps: Stamps, standing: bool = False) -> Motion:
        """Return the motion at stamps (N,) where it is known (`causes`), after `sort`.

        At rest joint values are interpolated linearly: a cubic at the end of a stop would include
        part of the move.
        """
        found = np.zeros((3, len(stamps), len(self._revolute)))
        for index, rows, (why, first, last) in self._around(stamps):
            part = interpolated(rows, stamps, first, last, self._revolute[index], standing)
            for whole, each in zip(found, part, strict=True):
                whole[np.ix_(why == 0, index)] = each[why == 0]
        return Motion(found[0]) if standing else Motion(*found)

    def approach(self, stamps: Stamps, joints: FloatArray) -> FloatArray:
        """Return the signs (N, n) of the last moves before joint values (N, n) at stamps (N,)."""
        found = np.zeros(joints.shape)
        for index, rows, (why, first, _) in self._around(stamps):
            revolute, earlier = self._revolute[index], self._earlier[tuple(index)]
            signs = last_moves(rows.values, first, joints[:, index], earlier, revolute)
            known = (signs != 0.0) & (why == 0)[:, np.newaxis]
            found[:, index] = np.where(known, signs, found[:, index])
        return found

    def causes(self, stamps: Stamps) -> Index:
        """Return why there are no joint values at stamps (N,), as indices of CAUSES."""
        cause = np.full((len(stamps), len(self._revolute)), len(CAUSES) - 1, dtype=np.intp)
        for index, _, (why, *_) in self._around(stamps):
            cause[:, index] = np.minimum(cause[:, index], why[:, np.newaxis])
        return np.asarray(cause.max(axis=1, initial=0))

    def _around(self, stamps: Stamps) -> Iterator[tuple[list[int], Rows, Brackets]]:
        """Yield joints, samples and brackets of stamps (N,) by part, the last one overriding."""
        for columns in self._by_size():
            rows = self._parts[columns]
            yield list(columns), rows, self._brackets(rows.stamps, stamps)

    def _by_size(self) -> list[tuple[int, ...]]:
        """Return the joints of each part, the main one last, whichever came first."""
        return sorted(self._parts, key=lambda columns: (len(columns), columns))

    def _brackets(self, known: Stamps, stamps: Stamps) -> Brackets:
        after = np.searchsorted(known, stamps, side='left')
        last = np.minimum(after, len(known) - 1)
        hit = known[last] == stamps
        first = np.where(hit, last, np.maximum(after - 1, 0))
        apart = known[last] - known[first] > self._max_gap_ns
        cause = np.select([hit, after == len(known), after == 0, apart], [0, 3, 2, 1])
        return cause.astype(np.intp), first.astype(np.intp), last.astype(np.intp)

    def standing(self, still: float, window: float) -> Stamps:
        """Return the intervals (K, 2) in which all joints stood, after `sort`.

        A joint stands if its value [rad or m] stayed within `still` during a window [s]. Of
        several publishers of a joint, one must show that, and none that was received the contrary.
        """
        stands, limits = {}, (still, round(window * 1e9), self._max_gap_ns)
        for columns, rows in self._parts.items():
            values = continuous(rows.values, self._revolute[list(columns)])
            stands[columns] = standing_intervals(rows.stamps, values, *limits)
        common: Stamps | None = None
        named = [tuple(c for c in stands if k in c) for k in range(len(self._revolute))]
        for several in dict.fromkeys(filter(None, named)):
            found = union([stands[columns] for columns in several])
            for columns in several if len(several) > 1 else ():
                silence = silences(self._parts[columns].stamps, self._max_gap_ns)
                found = intersection(found, union([stands[columns], silence]))
            common = found if common is None else intersection(common, found)
        return np.zeros((0, 2), dtype=np.int64) if common is None else common

    def noise_at_rest(self, time_ns: int, newest_ns: int) -> float | None:
        """Return the standard deviation [rad or m] of the noisiest joint, after `sort`.

        From second differences of the samples of some time before a stamp, free of motion (von
        Neumann 1941). None with too few samples, or more spread than that: the arm moves.
        """
        found = np.zeros(len(self._revolute))
        for columns, rows in self._parts.items():
            (first,), (end,) = self._bounds(rows, time_ns, np.array([newest_ns]))
            if end - first < TELLING:
                return None
            values = continuous(rows.values[first:end], self._revolute[list(columns)])
            noise = np.sqrt((np.diff(values, 2, axis=0) ** 2).mean(axis=0) / 6.0)
            if (values.std(axis=0) > MOST_SPREAD * noise).any():
                return None
            found[list(columns)] = noise
        self.noisiest[int(found.argmax())] += 1
        return float(found.max()) if self._parts else None

    def swings_at_rest(self, time_ns: int, rounds: Sequence[int]) -> list[float | None]:
        """Return by how much [rad or m] joints jump to and fro with each sample, or zero.

        In some time before each of the stamps, after `sort`; None if they do so in motion.
        """
        found, stamps = np.zeros(len(rounds)), np.array(rounds, dtype=np.int64)
        for rows in self._parts.values():
            bounds = self._bounds(rows, time_ns, stamps)
            found = np.maximum(found, _swings(rows.values, *bounds))
        return [
            None if swing and self.noise_at_rest(time_ns, now) is None else swing
            for swing, now in zip(found.tolist(), rounds, strict=True)
        ]

    @staticmethod
    def _bounds(rows: Rows, time_ns: int, newest_ns: Stamps) -> tuple[Index, Index]:
        """Return the bounds (K,) of the rows in some time before stamps (K,), a few at least."""
        end = np.searchsorted(rows.stamps, newest_ns, 'right')
        first = np.searchsorted(rows.stamps, newest_ns - time_ns)
        return np.maximum(0, np.minimum(first, end - TELLING)), end

    def release(self, before_ns: int) -> int:
        """Drop the samples before the last one up to a stamp, after `sort`; return how many.

        That one is kept, unless others name the joints of a publisher that has become silent.
        """
        dropped = 0
        newest = self._newest()
        for columns, rows in tuple(self._parts.items()):
            index = list(columns)
            last_ns = rows.stamps[-1]
            if last_ns < before_ns and (newest[index] > last_ns).all():
                del self._parts[columns]
                dropped += rows.count
                continue
            cut = int(np.searchsorted(rows.stamps, before_ns, 'right')) - 1
            if cut <= 0:
                continue
            cuts = np.array([cut])
            earlier, revolute = self._earlier[columns], self._revolute[index]
            signs = last_moves(rows.values, cuts, rows.values[cuts], earlier, revolute)
            self._earlier[columns] = signs[0]
            rows.keep(slice(cut, None))
            dropped += cut
        self.horizon_ns = max(self.horizon_ns, before_ns)
        return dropped

    def halve(self) -> int:
        """Drop the older half of the samples, after `sort`; return how many."""
        middle = [int(rows.stamps[rows.count // 2]) for rows in self._parts.values() if rows.full]
        return self.release(max(middle, default=0))

    def samples(self) -> Series:
        """Return stamps (M,) and joint values (M, n) of the main publisher."""
        if self.missing:
            return np.zeros(0, dtype=np.int64), np.zeros((0, len(self._revolute)))
        main = self._parts[self._by_size()[-1]]
        stamps = main.stamps[self.causes(main.stamps) == 0]
        return stamps, self.at(stamps).joints


def _swings(values: FloatArray, first: Index, end: Index) -> FloatArray:
    """Return by how much (K,) joints jump to and fro with each of samples (M, n), or zero.

    From `first` (K,) to `end`. The products of second differences with the next one, and the one
    after it, are -2/3 and 1/6 of their squares for noise, -1 and 1 for two publishers.
    """
    found, enough = np.zeros(len(first)), end - first >= TELLING
    if not enough.any():
        return found
    first, end = first[enough], end[enough]
    left, sums = np.diff(values, 2, axis=0), []
    for after in range(3):
        products = np.zeros_like(values)
        products[: len(left) - after] = left[after:] * left[: len(left) - after]
        bounds = np.column_stack([first, end - 2 - after]).ravel()
        sums.append(np.add.reduceat(products, bounds)[::2])
    squares, turned, again = sums
    least = (1.0 - EXCEPTION) * squares
    squares[(-turned <= least) | (again <= least)] = 0.0
    found[enough] = 0.5 * np.sqrt(squares.max(axis=1) / (end - first))
    return np.where(found > AS_FLOATS, found, 0.0)
