# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stops of the arm: which become samples, and the means measured at them (docs/model.md)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib_ros.estimation.configurations import SCATTER
from calib_ros.estimation.levels import FEW, MOST_OUTLIERS, TELLING
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.sampling.buffers import Rows
from calib_ros.sampling.interpolation import unwrapped
from calib_ros.sampling.slices import NO_ACCIDENT, Stamps
from calib_ros.settings import EXCEPTION, Settings

MOVING = 'the arm was moving'  # why a measurement is not used
MOST_SPREAD = 2.0
"""Largest spread [noise] of measurements and joints at a stop. A convention."""
NEAR = 2.0 * MOST_SPREAD
"""Distance [noise] to the later half within which a measurement has settled."""
SPIKE = 3.0 * MOST_SPREAD
"""Distance [noise] from the median beyond which a single measurement is rejected."""


@dataclass(frozen=True, eq=False)
class Means:
    """Means of the measurements at S stops."""

    used: Flags  # (N,) measurements used
    rests: Flags  # (S,) False if measurements spread more than noise
    values: FloatArray  # (S, 3) or (S, 1) [m]
    spreads: FloatArray  # (S,) RMS of one coordinate about the mean [m]
    doubled: Flags  # (S,) True if measurements are of two places by turns


def averages(values: FloatArray, begins: Index, sigmas: FloatArray) -> Means:
    """Average positions (N, 3) or distances (N, 1) [m] of each stop, in stamp order.

    Stops begin at `begins` (S,); `sigmas` (S,) [m] are the expected ones of a coordinate.
    """
    used, limits = np.ones(len(values), dtype=bool), np.full(len(begins), np.inf)
    rests = np.ones(len(begins), dtype=bool)
    ends = np.append(begins[1:], len(values))
    for k in np.flatnonzero(ends - begins >= FEW).tolist():
        part = slice(begins[k], ends[k])
        noise = max(sigmas[k], _noise(values[part]))
        limits[k] = MOST_SPREAD * noise
        reach = noise * np.sqrt(values.shape[1])
        settled = used[part]
        settled[: _settled(values[part], reach)] = False
        middle = np.median(values[part][settled], axis=0)
        spikes = np.linalg.norm(values[part] - middle, axis=1) > SPIKE * reach
        rests[k] = (spikes & settled).sum() <= MOST_OUTLIERS * settled.sum()  # else in two places
        settled &= ~spikes
    means = mean_of_each(values, begins, used)
    squares = (values - np.repeat(means, ends - begins, axis=0)) ** 2
    spreads = np.sqrt(mean_of_each(squares, begins, used).mean(axis=1))
    doubled = (ends - begins >= TELLING) & (spreads > MOST_SPREAD * sigmas)
    for k in np.flatnonzero(doubled).tolist():
        part = slice(begins[k], ends[k])
        doubled[k] = _in_two_places(values[part][used[part]])
    return Means(used, rests & (spreads <= limits), means, spreads, doubled)


def mean_of_each(rows: FloatArray, begins: Index, used: Flags) -> FloatArray:
    """Return the means (S, ...) of the used rows (N, ...) of each stop, zero if none."""
    shape = (-1,) + (1,) * (rows.ndim - 1)
    counts = np.maximum(np.add.reduceat(used, begins, dtype=np.intp), 1)
    return np.asarray(np.add.reduceat(rows * used.reshape(shape), begins) / counts.reshape(shape))


def _noise(values: FloatArray) -> float:
    """Return the standard deviation of a coordinate, RMS over them, from successive differences.

    The second ones have less of a motion in them, the first ones fewer spikes.
    """
    first, second = (np.median(np.abs(np.diff(values, k, axis=0)), axis=0) for k in (1, 2))
    noise = np.minimum(first / np.sqrt(2.0), second / np.sqrt(6.0))
    return float(1.4826 * np.sqrt((noise**2).mean()))  # the median: spikes do not count


def _in_two_places(values: FloatArray) -> bool:
    """Tell whether values lie in two heaps, ten times their size apart, as no noise does.

    The rest of the variance within the heaps is 4 % then; 36 % of Gaussian noise, 19 % of a swing.
    """
    along = (values - values.mean(axis=0)) @ np.linalg.svd(values - values.mean(axis=0))[2][0]
    heaps = along[along > 0.0], along[along <= 0.0]
    within = sum(((heap - heap.mean()) ** 2).sum() for heap in heaps if heap.size)
    return bool(within < 0.5 * EXCEPTION * (along**2).sum())


def _settled(values: FloatArray, reach: float) -> int:
    """Return the number of measurements before all stay near the later half."""
    half = len(values) // 2
    far = np.linalg.norm(values[:half] - np.median(values[half:], axis=0), axis=1) > NEAR * reach
    # vibration, not a spike: two of three in a row are far
    pairs = far & (np.append(far[1:], False) | np.append(far[2:], [False, False]))
    last = np.flatnonzero(pairs)
    return int(last[-1]) + 2 if last.size else 0


SAMPLED = 'of a stop that already has its pose'


@dataclass
class Schedule:
    """What to do with measurements up to successive stamps.

    Those up to each of the `ends` are unused because of `why`; if that is empty they are used from
    `begins`.
    """

    done_ns: int  # measurements before this are settled
    sampled_ns: int  # a stop at this moment has been sampled
    since_ns: int  # begin of the stop that goes on
    ends: list[int] = field(default_factory=list)
    why: list[str] = field(default_factory=list)
    begins: list[int] = field(default_factory=list)

    def add(self, until: int, why: str, begin: int = 0) -> None:
        """Handle the measurements up to a stamp."""
        if until > self.done_ns:
            self.done_ns = until
            self.ends.append(until)
            self.why.append(why)
            self.begins.append(begin)
        if why == SAMPLED:
            self.sampled_ns = max(self.sampled_ns, self.done_ns)

    @property
    def stops(self) -> list[int]:
        """Return the indices of the stops that give samples."""
        return [k for k, why in enumerate(self.why) if not why]

    def of_stands(
        self,
        stands: Stamps,
        until: int,
        newest: int | None,
        settings: Settings,
        measured: Callable[[int, int], bool],
    ) -> None:
        """Plan for stands (K, 2) up to a stamp; without the newest stamp all of them end there.

        `measured` tells whether there are measurements between two stamps. What is longer than
        `longest_stop` is divided; the first part with any is the stop.
        """
        settle = round(settings.settle * 1e9)
        shortest = round(settings.shortest_stop * 1e9)
        longest = round(settings.longest_stop * 1e9)
        for first, end in stands.tolist():
            goes_on = newest is not None and end >= newest
            if newest is None:
                end = min(end, until)
            begin = max(first, self.done_ns)
            if begin > until or end <= self.done_ns:
                continue
            self.add(begin, MOVING)
            if begin == first:  # else the track may have forgotten its begin
                self.since_ns = first
            if begin <= self.sampled_ns:
                self.add(min(end, until), SAMPLED)
                continue
            if settings.mode == 'triggered':
                self.add(min(end, until), 'not requested')
                continue
            while begin < end:
                last = min(end, begin + longest)
                if last > until or (goes_on and last == end):
                    return  # not over yet
                calm = max(self.since_ns + settle, begin + 1)  # the last part includes its end
                if last - self.since_ns < shortest:
                    self.add(last, 'the stop was too short')
                elif measured(calm, last):
                    self.add(last, '', calm)
                    self.add(min(end, until), SAMPLED)
                    break
                else:
                    self.add(last, '' if begin == first else MOVING, calm)
                begin = last
        if until > self.done_ns:
            self.since_ns = until
        self.add(until, MOVING)


class SampledStops:
    """Sampled stops: after the clock jumped back, they are not sampled again."""

    def __init__(self, revolute: Flags, capacity: int) -> None:
        self._revolute = revolute
        self._stops = Rows(1 + len(revolute), capacity)  # length and joint values
        self._last_ns = 0  # latest end

    def seen_before(self, begin: int, end: int, where: FloatArray, near: float) -> bool:
        """Tell whether a stop at joint values (n,) was sampled before; remember it if not."""
        if begin <= self._last_ns:
            begins, lengths = self._stops.stamps, self._stops.values[:, 0]
            meets = (begins <= end) & (begins + lengths.astype(np.int64) >= begin)
            steps = unwrapped(self._stops.values[meets, 1:] - where, self._revolute)
            if (np.abs(steps).max(axis=1) <= near).any():
                return True
        if not self._stops.full:
            self._stops.extend(np.array([begin]), np.array([[end - begin, *where]]))
            self._last_ns = max(self._last_ns, end)
        return False

    def forget(self, stamp_ns: int) -> None:
        """Forget the stop at a joint stamp."""
        since = stamp_ns - self._stops.stamps
        self._stops.keep((since < 0) | (since > self._stops.values[:, 0]))


class Rests:
    """Number of stops `sampled`, and joint noise at rests that no stop shows.

    They are missed if the joint values are noisier than `still`. At most `capacity` are counted.
    Values that jump are at no rest, and go on doing so.
    """

    def __init__(self, capacity: int) -> None:
        self.sampled = 0
        self._capacity = capacity
        self._unseen: list[float] = []
        self._resting = False
        self._jumps = deque[float](maxlen=NO_ACCIDENT)  # noise larger than any at rest
        self._swings: list[float] = []
        self.swing = 0.0  # by how much [rad or m] joints at rest jump with each sample

    def note(self, noise: float | None) -> None:
        """Note the noise of joints at an undetected rest, None while they move."""
        before, self._resting = self._resting, noise is not None
        if noise is None or SPIKE * noise <= SCATTER:
            self._jumps.clear()
        else:
            self._jumps.append(noise)
        if noise is not None and not before and len(self._unseen) < self._capacity:
            self._unseen.append(noise)

    def note_swings(self, swings: Sequence[float | None]) -> None:
        """Note by how much joints at rest jump to and fro, None while they move."""
        for swing in swings:
            if swing is not None and not self.swing:
                self._swings = [*self._swings, swing] if swing else []
                if len(self._swings) == NO_ACCIDENT:
                    self.swing = float(np.median(self._swings))

    def needed(self, still: float) -> float | None:
        """Return the least `still` that detects most rests; None if it does already."""
        jumping = len(self._jumps) == NO_ACCIDENT
        if len(self._unseen) <= self.sampled and not jumping:
            return None
        needed = SPIKE * float(np.median(self._jumps if jumping else self._unseen))
        return needed if needed > still else None


def seen_stops(
    stands: Stamps, rounds: Sequence[int], settled_ns: int, late_ns: int, shortest_ns: int
) -> list[bool]:
    """Tell for each round whether it shows a stop that earlier ones have not settled.

    Stands are (K, 2); each round settles what is older than its stamp by `late_ns`.
    """
    times = np.array(rounds)[:, np.newaxis]
    settled = np.concatenate([[[settled_ns]], times[:-1] - late_ns])
    lengths = np.minimum(stands[:, 1], times) - stands[:, 0]
    found = ((lengths >= shortest_ns) & (stands[:, 1] > settled)).any(axis=1)
    return [bool(each) for each in found]
