# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recent joint samples: where the joints were at a stamp, and when they stood still.

Everything is a function of the samples held, by their header stamps; the order of arrival does
not matter. Several publishers may each name part of the joints: each part is a track of its own,
interpolated on its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics.se3 import FloatArray

Stamps = NDArray[np.int64]

MOVED = 1e-3
"""A joint has moved, in one sense or the other, when its value [rad or m] changed by more."""
LAGS = 4
"""Samples within the window with which the present one is compared."""
FEWEST = 8
"""Fewest samples that tell the noise of joints."""
MOST_SPREAD = 2.0
"""Largest spread [noise] of joints that stand; a motion is in the spread, not in the noise."""

APART = 'joint samples too far apart'
CAUSES = ('', 'no joint sample before', 'no joint sample after', APART)
"""Why there are no joint values at a stamp; the first entry stands for none."""


class Rows:
    """Stamped rows of numbers in one growing block of memory, up to a capacity."""

    def __init__(self, width: int, capacity: int) -> None:
        self.capacity = capacity
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

    def append(self, stamp_ns: int, row: Sequence[float]) -> None:
        """Add a row, NaN where it is shorter; the caller has seen that there is room."""
        if self.count == len(self._stamps):
            size = min(2 * self.count, self.capacity)
            self._stamps = np.resize(self._stamps, size)
            self._values = np.resize(self._values, (size, self._values.shape[1]))
        self._stamps[self.count] = stamp_ns
        self._values[self.count, : len(row)] = row
        self._values[self.count, len(row) :] = np.nan
        self.count += 1

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


@dataclass(frozen=True, eq=False)
class Motion:
    """Joint values (N, n), their velocities and accelerations at N stamps.

    `approach` (N, n) holds the signs of the last moves; `cause` (N,) is an index of CAUSES, and
    where it is not zero the values count for nothing.
    """

    joints: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    approach: FloatArray
    cause: NDArray[np.intp]


class Track:
    """Recent samples of all joints.

    Parameters
    ----------
    revolute : (n,) bool
        True for the joints whose values are angles.
    max_gap : float
        Longest time [s] between two samples to interpolate between.
    capacity : int
        Samples that are kept of one publisher.

    """

    def __init__(self, revolute: Sequence[bool], max_gap: float, capacity: int) -> None:
        self._revolute = np.array(revolute, dtype=bool)
        self._max_gap_ns = round(max_gap * 1e9)
        self._capacity = capacity
        self._parts: dict[tuple[int, ...], Rows] = {}
        self._came = np.zeros(len(revolute))  # signs of the last moves before the samples held
        self.horizon_ns = 0
        """Samples before this stamp have been let go."""

    @property
    def newest_ns(self) -> int:
        """Return the stamp up to which every joint that anybody names has been heard."""
        heard = self._heard()
        return int(heard[heard > 0].min(initial=np.iinfo(np.int64).max)) if heard.any() else 0

    def _heard(self) -> Stamps:
        """Return (n,) the newest stamp of each joint, zero where nobody has named it."""
        heard = np.zeros(len(self._revolute), dtype=np.int64)
        for columns, rows in self._parts.items():
            if rows.count:
                index = list(columns)
                heard[index] = np.maximum(heard[index], rows.stamps.max())
        return heard

    def room(self, columns: tuple[int, ...]) -> int:
        """Return for how many more samples of some joints there is room."""
        rows = self._parts.get(columns)
        return self._capacity if rows is None else self._capacity - rows.count

    @property
    def missing(self) -> tuple[int, ...]:
        """Return the joints that no publisher has named."""
        named = {column for part in self._parts for column in part}
        return tuple(k for k in range(len(self._revolute)) if k not in named)

    def silent(self, time_ns: int) -> tuple[int, ...]:
        """Return the joints that were last heard so much earlier than others were."""
        heard = self._heard()
        return tuple(np.flatnonzero((heard > 0) & (heard < heard.max() - time_ns)).tolist())

    def add(self, columns: tuple[int, ...], stamp_ns: int, values: Sequence[float]) -> None:
        """Take the values of some joints, given by their numbers in the chain."""
        self._rows(columns).append(stamp_ns, values)

    def extend(self, columns: tuple[int, ...], stamps: Stamps, values: FloatArray) -> None:
        """Take values (M, k) of some joints at stamps (M,)."""
        self._rows(columns).extend(stamps, values)

    def _rows(self, columns: tuple[int, ...]) -> Rows:
        rows = self._parts.get(columns)
        if rows is None:
            rows = self._parts[columns] = Rows(len(columns), self._capacity)
        return rows

    def sort(self) -> int:
        """Put all samples in order; return how many had the stamp of another one."""
        return sum(rows.sort() for rows in self._parts.values())

    def at(self, stamps: Stamps, standing: bool = False) -> Motion:
        """Return the motion at stamps (N,), after `sort`.

        While the arm stands joint values are interpolated linearly: a cubic beside the end of a
        stop would hold a part of the move.
        """
        shape = (len(stamps), len(self._revolute))
        joints, velocity, acceleration, approach = (np.zeros(shape) for _ in range(4))
        for columns, rows in self._by_size():
            index = list(columns)
            revolute = self._revolute[index]
            why, first, last = self._brackets(rows.stamps, stamps)
            found = _interpolated(rows, stamps, first, last, revolute, standing)
            came = _approach(rows.values, first, found[0], self._came[index], revolute)
            good = np.ix_(why == 0, index)
            for whole, part in zip(
                (joints, velocity, acceleration, approach), (*found, came), strict=True
            ):
                whole[good] = part[why == 0]
        return Motion(joints, velocity, acceleration, approach, self.causes(stamps))

    def causes(self, stamps: Stamps) -> NDArray[np.intp]:
        """Return (N,) why there are no joint values at stamps, as indices of CAUSES."""
        cause = np.full((len(stamps), len(self._revolute)), 1, dtype=np.intp)
        for columns, rows in self._by_size():
            index = list(columns)
            why = self._brackets(rows.stamps, stamps)[0]
            worse = cause[:, index] != 0
            cause[:, index] = np.where(worse, why[:, np.newaxis], cause[:, index])
        return np.asarray(cause.max(axis=1, initial=0))

    def _by_size(self) -> list[tuple[tuple[int, ...], Rows]]:
        """Return the parts; a joint that several name is taken from the last that has it."""
        return sorted(self._parts.items(), key=lambda item: len(item[0]))

    def _brackets(
        self, known: Stamps, stamps: Stamps
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Return causes (N,) and the samples before and after each stamp."""
        nowhere = np.zeros(len(stamps), dtype=np.intp)
        if len(known) == 0:
            return nowhere + 1, nowhere, nowhere
        after = np.searchsorted(known, stamps, side='left')
        last = np.minimum(after, len(known) - 1)
        hit = known[last] == stamps
        first = np.where(hit, last, np.maximum(after - 1, 0))
        cause = np.select(
            [hit, after == len(known), after == 0, known[last] - known[first] > self._max_gap_ns],
            [0, 2, 1, 3],
            0,
        )
        return cause.astype(np.intp), first.astype(np.intp), last.astype(np.intp)

    def standing(self, still: float, window: float) -> Stamps:
        """Return (K, 2) from when to when all joints stood, after `sort`.

        A joint stands where its value [rad or m] has stayed within `still` during a window [s]. Of
        several publishers that name it one must show that, and none that is heard the contrary.
        """
        stands = {
            columns: _standing(
                rows.stamps,
                _continuous(rows.values, self._revolute[list(columns)]),
                still,
                round(window * 1e9),
                self._max_gap_ns,
            )
            for columns, rows in self._parts.items()
        }
        common: Stamps | None = None
        named = [tuple(c for c in stands if k in c) for k in range(len(self._revolute))]
        for several in dict.fromkeys(filter(None, named)):
            found = _union([stands[columns] for columns in several])
            for columns in several if len(several) > 1 else ():
                unheard = _unheard(self._parts[columns].stamps, self._max_gap_ns)
                found = _intersection(found, _union([stands[columns], unheard]))
            common = found if common is None else _intersection(common, found)
        return np.zeros((0, 2), dtype=np.int64) if common is None else common

    def noise_at_rest(self, time_ns: int) -> float | None:
        """Return the standard deviation [rad or m] of the noisiest joint, after `sort`.

        Second differences of the last samples of some time show it, with no motion in them (von
        Neumann 1941). None where they are too few, or spread more than that: the arm moves.
        """
        largest = None
        for columns, rows in self._parts.items():
            first = int(np.searchsorted(rows.stamps, self.newest_ns - time_ns))
            values = rows.values[max(0, min(first, rows.count - FEWEST)) :]
            if len(values) < FEWEST:
                return None
            values = _continuous(values, self._revolute[list(columns)])
            noise = np.sqrt((np.diff(values, 2, axis=0) ** 2).mean(axis=0) / 6.0)
            if (values.std(axis=0) > MOST_SPREAD * noise).any():
                return None
            largest = max(largest or 0.0, float(noise.max()))
        return largest

    def release(self, before_ns: int) -> int:
        """Let go the samples before a stamp, after `sort`; return how many.

        The last one is kept, unless others name the joints of a publisher that has fallen silent.
        """
        gone = 0
        heard = self._heard()
        for columns, rows in tuple(self._parts.items()):
            index = list(columns)
            cut = int(np.searchsorted(rows.stamps, before_ns))
            if 0 < cut == rows.count and (heard[index] > rows.stamps[-1]).all():
                del self._parts[columns]
                gone += cut
                continue
            cut = min(cut, rows.count - 1)
            if cut <= 0:
                continue
            here = np.array([cut])
            came = _approach(
                rows.values, here, rows.values[here], self._came[index], self._revolute[index]
            )
            self._came[index] = came[0]
            rows.keep(np.arange(cut, rows.count))
            gone += cut
        self.horizon_ns = max(self.horizon_ns, before_ns)
        return gone

    def halve(self) -> int:
        """Let go the older half of the samples, after `sort`; return how many."""
        middle = [int(rows.stamps[rows.count // 2]) for rows in self._parts.values() if rows.full]
        return self.release(max(middle, default=0))

    def clear(self) -> None:
        """Forget all samples."""
        self._parts.clear()
        self._came[:] = 0.0
        self.horizon_ns = 0

    def samples(self) -> tuple[Stamps, FloatArray]:
        """Return stamps (M,) and joint values (M, n) where the main publisher was heard."""
        if self.missing:
            return np.zeros(0, dtype=np.int64), np.zeros((0, len(self._revolute)))
        main = max(self._parts.items(), key=lambda item: len(item[0]))[1]
        motion = self.at(main.stamps)
        good = motion.cause == 0
        return main.stamps[good], motion.joints[good]


def _interpolated(
    rows: Rows,
    stamps: Stamps,
    first: NDArray[np.intp],
    last: NDArray[np.intp],
    revolute: NDArray[np.bool_],
    straight: bool,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return values, velocities and accelerations (N, n) of the cubic through four samples.

    Two before and two after the stamp (Lagrange). At the ends of the recording and beside equal
    stamps, where there are fewer, values are interpolated linearly; with `straight` everywhere.
    """
    known, values = rows.stamps, rows.values
    nothing = np.zeros((len(stamps), values.shape[1]))
    if rows.count == 0:
        return nothing, nothing, nothing
    origin = values[first]
    span = (known[last] - known[first]) * 1e-9
    share = (stamps - known[first]) * 1e-9 / np.maximum(span, 1e-9)
    step = unwrapped(values[last] - origin, revolute)
    joints = origin + share[:, np.newaxis] * step
    velocity = step / np.maximum(span, 1e-9)[:, np.newaxis]
    if straight:
        return joints, velocity, nothing
    before, behind = first - 1, np.maximum(last, first + 1) + 1
    inner = (before >= 0) & (behind < rows.count)
    near = np.stack([first - 1, first, np.maximum(last, first + 1), behind])[:, inner]
    if not near.size:
        return joints, velocity, nothing
    times = (known[near] - stamps[inner]) * 1e-9  # (4, N)
    # A cubic over a pause in the samples would follow nothing that was measured.
    even = np.diff(times, axis=0).max(axis=0) < 3.0 * np.diff(times, axis=0).min(axis=0)
    inner[inner] = even
    near, times = near[:, even], times[:, even]
    heights = unwrapped(values[near] - origin[inner], revolute)  # (4, N, n)
    at, slope, bend = _lagrange(times)
    joints[inner] = origin[inner] + np.einsum('kn,knj->nj', at, heights)
    velocity[inner] = np.einsum('kn,knj->nj', slope, heights)
    acceleration = nothing.copy()
    acceleration[inner] = np.einsum('kn,knj->nj', bend, heights)
    return joints, velocity, acceleration


def _lagrange(times: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the weights (4, N) of four heights for value, slope and bend at time zero."""
    at, slope, bend = (np.empty_like(times) for _ in range(3))
    for k in range(4):
        a, b, c = (times[i] for i in range(4) if i != k)
        below = (times[k] - a) * (times[k] - b) * (times[k] - c)
        at[k] = -a * b * c / below
        slope[k] = (a * b + b * c + c * a) / below
        bend[k] = -2.0 * (a + b + c) / below
    return at, slope, bend


def unwrapped(steps: FloatArray, revolute: NDArray[np.bool_]) -> FloatArray:
    """Return differences of joint values; a driver may count angles within one turn."""
    turn = np.round(steps / (2.0 * np.pi)) * (2.0 * np.pi)
    return np.asarray(steps - np.where(revolute, turn, 0.0))


def _continuous(values: FloatArray, revolute: NDArray[np.bool_]) -> FloatArray:
    """Return joint values (M, n) in sequence without jumps of a turn."""
    steps = unwrapped(np.diff(values, axis=0), revolute)
    return np.asarray(values[:1] + np.cumsum(np.vstack([0.0 * values[:1], steps]), axis=0))


def _approach(
    values: FloatArray,
    first: NDArray[np.intp],
    now: FloatArray,
    came: FloatArray,
    revolute: NDArray[np.bool_],
) -> FloatArray:
    """Return the signs (N, n) of the last move of each joint before it stood as it does now.

    The last of the samples (M, n) up to index `first` (N,) from which a joint has moved tells;
    where there is none, `came` (n,) holds the signs from before them.
    """
    if len(values) == 0:
        return np.tile(came, (len(now), 1))
    path = _continuous(values, revolute)
    now = path[first] + unwrapped(now - path[first], revolute)
    there = _last_outside(path, first, now - MOVED, now + MOVED)
    signs = np.sign(now - np.take_along_axis(path, there, axis=0))
    return np.asarray(np.where(there >= 0, signs, came))


def _last_outside(
    values: FloatArray, last: NDArray[np.intp], low: FloatArray, high: FloatArray
) -> NDArray[np.intp]:
    """Return the index (N, n) of the last value (M, n) up to `last` (N,) beyond low or high.

    It is -1 where there is none. By the extremes of blocks of 1, 2, 4, ... values: first over
    ever larger blocks to the one that holds it, then into the half that does.
    """
    lows, highs = [values], [values]
    while len(lows[-1]) > 1:
        even = len(lows[-1]) // 2 * 2
        lows.append(np.minimum(lows[-1][:even:2], lows[-1][1:even:2]))
        highs.append(np.maximum(highs[-1][:even:2], highs[-1][1:even:2]))
    shape, low, high = low.shape, low.ravel(), high.ravel()
    column = np.tile(np.arange(shape[1]), shape[0])
    end = np.repeat(last + 1, shape[1])  # what comes before is still to be searched
    found, sizes = np.full(len(end), -1), np.zeros(len(end), dtype=np.intp)

    def outside(level: int, block: NDArray[np.intp], here: NDArray[np.intp]) -> NDArray[np.bool_]:
        where = (block, column[here])
        return np.asarray((lows[level][where] < low[here]) | (highs[level][where] > high[here]))

    for level in range(len(lows)):
        here = np.flatnonzero((found < 0) & (end >> level & 1 == 1))
        block = (end[here] >> level) - 1
        hit = outside(level, block, here)
        found[here[hit]], sizes[here[hit]] = block[hit], level
        end[here[~hit]] -= 1 << level
    for level in reversed(range(len(lows) - 1)):
        here = np.flatnonzero(sizes > level)
        block = 2 * found[here] + 1
        found[here] = np.where(outside(level, block, here), block, block - 1)
    return found.reshape(shape)


def _standing(
    stamps: Stamps, values: FloatArray, still: float, window_ns: int, max_gap_ns: int
) -> Stamps:
    """Return (K, 2) from when to when the joints of one publisher stood."""
    if len(stamps) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    index = np.arange(len(stamps))
    gap = np.concatenate([[True], np.diff(stamps) > max_gap_ns])
    begin = index[gap][np.cumsum(gap) - 1]  # where the samples without a gap begin
    quiet = np.ones(len(stamps), dtype=bool)
    joints = values.T.copy()  # numpy is slow over a short last axis
    back = begin
    for lag in range(1, LAGS + 1):
        back = np.searchsorted(stamps, stamps - window_ns * lag // LAGS)
        back = np.maximum(np.minimum(back, index - 1), begin)
        quiet &= np.abs(joints - np.take(joints, back, axis=1)).max(axis=0) <= still
    starts = np.flatnonzero(quiet & ~np.concatenate([[False], quiet[:-1]]) | (quiet & gap))
    ends = np.flatnonzero(quiet & ~(np.concatenate([quiet[1:], [False]])))
    ends = np.union1d(ends, np.flatnonzero(quiet & np.concatenate([gap[1:], [False]])))
    found = np.stack([stamps[back[starts]], stamps[ends]], axis=1)
    found[1:, 0] = np.maximum(found[1:, 0], found[:-1, 1])  # a twitch parts two stands
    return np.asarray(found[found[:, 0] < found[:, 1]], dtype=np.int64)


def _unheard(stamps: Stamps, max_gap_ns: int) -> Stamps:
    """Return (K, 2) when a publisher was not heard; what it shows before and after overlaps."""
    limits = np.iinfo(np.int64)
    gaps = np.flatnonzero(np.diff(stamps) > max_gap_ns)
    begins = np.concatenate([[limits.min], stamps[gaps] - 1, stamps[-1:] - 1])
    ends = np.concatenate([stamps[:1] + 1, stamps[gaps + 1] + 1, [limits.max]])
    return np.stack([begins, ends], axis=1)


def _union(several: Sequence[Stamps]) -> Stamps:
    """Return (K, 2) the intervals of sorted lists, those that overlap as one."""
    if len(several) == 1:
        return several[0]
    found = np.concatenate(several)
    found = found[np.argsort(found[:, 0], kind='stable')]
    ends = np.maximum.accumulate(found[:, 1])
    apart = found[1:, 0] >= ends[:-1]
    firsts = np.concatenate([np.ones(len(found[:1]), dtype=bool), apart])
    lasts = np.concatenate([apart, np.ones(len(found[:1]), dtype=bool)])
    return np.stack([found[firsts, 0], ends[lasts]], axis=1)


def _intersection(first: Stamps, second: Stamps) -> Stamps:
    """Return (K, 2) what two sorted lists of intervals have in common."""
    starts = np.maximum(first[:, np.newaxis, 0], second[np.newaxis, :, 0])
    ends = np.minimum(first[:, np.newaxis, 1], second[np.newaxis, :, 1])
    chosen = starts < ends
    return np.stack([starts[chosen], ends[chosen]], axis=1)
