# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stops of the arm: which become samples (docs/model.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib_ros.kinematics.se3 import Flags, FloatArray
from calib_ros.sampling.buffers import Rows
from calib_ros.sampling.interpolation import unwrapped
from calib_ros.sampling.slices import Stamps
from calib_ros.settings import Settings

MOVING = 'the arm was moving'  # why a measurement is not used
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
