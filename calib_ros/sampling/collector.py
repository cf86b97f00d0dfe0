# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From recent joint samples and measurements to samples for the identification.

Messages wait in bounded buffers until everything about their time has come: `lateness` after the
newest joint sample. Then a stop of the arm becomes one sample of each stream (mode `dwell`), or
every measurement becomes one (mode `continuous`), or nothing does unless it is asked for (mode
`triggered`). All decisions are taken by header stamps, so a replay takes the same samples as the
live robot, and whatever is not used is counted by its cause.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.interpolation import unwrapped
from calib_ros.sampling.making import WIDTH, Maker
from calib_ros.sampling.names import MOST_NAMES
from calib_ros.sampling.rests import Rests
from calib_ros.sampling.rows import Rows, Stamps
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.slices import JOINTS, Slice, StreamKey
from calib_ros.sampling.strays import JUMP
from calib_ros.sampling.track import CAUSES, Track
from calib_ros.settings import Settings

WINDOW = 0.1
"""Time [s] during which joints must have stayed where they are to be standing."""
ADVANCE_NS = 500_000_000
"""Time of the newest joint sample between two rounds of taking samples."""
MOST_STREAMS = MOST_NAMES
"""Streams of measurements that are told apart: a tracker may number markers without end."""
TOO_MANY = f'poses: of one more than {MOST_STREAMS} targets, or frames'


class Collector:
    """Bounded buffers of joint samples and measurements, and what they are made into.

    Parameters
    ----------
    revolute : (n,) bool
        True for the joints whose values are angles.
    settings : Settings

    """

    def __init__(self, revolute: Sequence[bool], settings: Settings) -> None:
        self.settings = settings
        self._revolute = np.array(revolute, dtype=bool)
        self.track = Track(revolute, settings.max_gap, settings.joint_buffer)
        self._waiting: dict[StreamKey, Rows] = {}
        self._stops = Rows(1 + len(revolute), settings.pose_buffer)  # how long, and where
        self._lateness_ns = round(settings.lateness * 1e9)
        self._newest_ns = 0  # the last joint sample
        self._advanced_ns = 0  # that at the last round
        self._settled_ns = 0  # measurements before have been dealt with
        self._sampled_ns = 0  # a stop that stands at this moment has been sampled
        self.rests = Rests()
        self._backwards = 0
        self.delay_ns = round(settings.delay * 1e9)
        """How much later than the joints' the stamps of measurements are."""
        self.holding = False
        """True while the delay is being looked for, so that nothing may be taken."""
        self.maker = Maker(self._revolute, settings.pose_buffer)
        self.dropped = self.maker.dropped
        self.unused: Counter[str] = Counter()
        """What no sample is made of in the ordinary course of things, by cause."""
        self.notes: Counter[str] = Counter()

    @property
    def images(self) -> set[int]:
        """Return the numbers of the images that wait for their time."""
        found = [rows.values[:, 0] for key, rows in self._waiting.items() if key.images]
        return {int(number) for numbers in found for number in numbers.tolist()}

    @property
    def waiting(self) -> int:
        """Return how many measurements wait for their time."""
        return sum(rows.count for rows in self._waiting.values())

    def known(self, now_ns: int | None) -> tuple[Stamps, FloatArray, list[Any]]:
        """Return stamps and joint values, and stamps and rows (N, WIDTH) of waiting positions.

        Only those older by `lateness` than the stamp `now_ns`, of which all has come; None: all.
        """
        self._sort()
        until = np.iinfo(np.int64).max if now_ns is None else now_ns - self._lateness_ns
        stamps, joints = self.track.samples()
        complete = stamps <= until
        positions = [
            (rows.stamps[rows.stamps <= until], rows.values[rows.stamps <= until])
            for key, rows in self._waiting.items()
            if not (key.distance or key.eye_in_hand or key.images)
        ]
        return stamps[complete], joints[complete], positions

    def reach(self, given: Slice) -> int:
        """Return how many of the first messages come up to one that gives something to do."""
        if self.track.full:
            self._make_room()
        count = len(given)
        joints = given.where(JOINTS)
        stamps = given.times[joints]
        late = joints[stamps < self.track.horizon_ns]
        if len(late):  # one by one
            count = max(int(late[0]), 1)
        due = joints[stamps >= self._advanced_ns + ADVANCE_NS]
        count = int(min([count, *(due[:1] + 1).tolist()]))
        for columns in {each.key for each in given.pieces if not isinstance(each.key, StreamKey)}:
            room = self.track.room(columns)
            if room <= len(joints):
                places = [each.places for each in given.pieces if each.key == columns]
                full = np.sort(np.concatenate(places))[room - 1 : room] - given.begin
                count = int(min([count, *(full + 1).tolist()]))
        return count

    def take(self, given: Slice) -> bool:
        """Take messages up to one that gives something to do; return whether it is a round."""
        joints = given.where(JOINTS)
        if len(joints):
            newest = int(given.times[joints[-1]])
            if newest < self.track.horizon_ns:
                self._backwards += 1
                if self._backwards < JUMP:
                    self.dropped['joints: later than lateness allows'] += 1
                    return False
                self.start_anew()
            self._backwards = 0
            self._newest_ns = newest
        for key, _, stamps, numbers in given.pieces:
            if isinstance(key, StreamKey):
                self._extend(key, stamps, numbers)
            else:
                self.track.extend(key, stamps, numbers)
        return self._newest_ns - self._advanced_ns >= ADVANCE_NS

    def round(self) -> None:
        """Make samples of what is complete."""
        self._advanced_ns = self._newest_ns
        if not self.holding:
            self._round(self._complete_ns)

    def _extend(self, key: StreamKey, stamps: Stamps, numbers: FloatArray) -> None:
        """Take measurements: numbers (M, w) at stamps (M,)."""
        rows = self._stream(key)
        if rows is None:
            self.dropped[TOO_MANY] += len(stamps)
            return
        due = np.flatnonzero(stamps - self.delay_ns > self._settled_ns)
        taken = due[: rows.capacity - rows.count]
        if len(due) < len(stamps):
            self.dropped['poses: later than lateness allows'] += len(stamps) - len(due)
        if len(taken) < len(due):
            self.dropped['poses: pose buffer full'] += len(due) - len(taken)
        rows.extend(stamps[taken], numbers[taken])

    def _stream(self, key: StreamKey) -> Rows | None:
        """Return the buffer of a stream; None when too many others are in use."""
        rows = self._waiting.get(key)
        if rows is None:
            if len(self._waiting) >= MOST_STREAMS:  # forget those without any use
                idle = [key for key, rows in self._waiting.items() if not rows.count]
                for each in idle:
                    if not self.maker.has(each):
                        del self._waiting[each]
            if len(self._waiting) >= MOST_STREAMS:
                return None
            rows = self._waiting[key] = Rows(WIDTH, self.settings.pose_buffer)
        return rows

    def flush(self) -> None:
        """Make samples of everything that has come on both sides, as if nothing came late."""
        newest = [int(rows.stamps.max()) for rows in self._waiting.values() if rows.count]
        if newest:
            self._round(min(self.track.newest_ns, min(newest) - self.delay_ns), ends_here=True)

    def finish(self) -> None:
        """Deal with everything; nothing more will come."""
        self._round(self.track.newest_ns, ends_here=True)
        for rows in self._waiting.values():
            if rows.count:
                self._count_causes(self.track.causes(rows.stamps - self.delay_ns))
                rows.keep(np.zeros(rows.count, dtype=bool))

    def state(self) -> str:
        """Return in words what the arm does, as far as samples are concerned."""
        self._sort()
        newest = self.track.newest_ns
        if not newest or self.track.missing:
            return 'waiting for joint states'
        if self.holding:
            return 'looking for the delay of the measurements: keep the arm moving'
        if self.settings.mode == 'continuous':
            return 'every measurement is taken'
        stands = self.track.standing(self.settings.still, WINDOW)
        if not len(stands) or stands[-1, 1] < newest:
            return 'the arm is moving'
        if stands[-1, 0] <= self._sampled_ns:
            return 'the arm stands and is sampled: move on'
        return f'the arm stands for {1e-9 * (newest - int(stands[-1, 0])):.1f} s'

    def capture(self, place: str = '') -> tuple[int, str]:
        """Take one sample of each stream now; return how many, and why not more in words.

        With a place the target sits in a socket there, and nothing needs to be measured.
        """
        if self.settings.mode == 'continuous':
            return 0, 'every measurement is taken in mode continuous'
        self._sort()
        stands = self.track.standing(self.settings.still, WINDOW)
        newest = self.track.newest_ns
        if not newest:
            return 0, 'no joint states have come'
        if not (self.waiting or place):
            return 0, 'no measurements have come since the last sample'
        shortest = round(self.settings.shortest_stop * 1e9)
        if not len(stands) or stands[-1, 1] < newest or newest - stands[-1, 0] < shortest:
            return 0, (
                f'the arm has not stood for {self.settings.shortest_stop:g} s yet '
                f'(no joint further than {self.settings.still:g} rad or m)'
            )
        begin = int(stands[-1, 0])
        if place:
            stamps = self.track.samples()[0]
            stamps = stamps[stamps >= begin]
            self.maker.in_socket(place, stamps, self.track.at(stamps, standing=True))
            return 1, ''
        self._round(begin)  # a stop before is not waited for any longer
        before, dropped = len(self.maker.fresh), self.dropped.copy()
        self._average(begin, newest)
        count = len(self.maker.fresh) - before
        if count:
            self._sampled_ns = self._settled_ns = newest
        causes = ', '.join(dict.fromkeys(self.dropped - dropped))
        return count, '' if count else causes or 'no measurement within this stop'

    @property
    def _complete_ns(self) -> int:
        """Return the stamp of the joints up to which all has come, and stops can be told."""
        late = self._lateness_ns + max(self.delay_ns, 0)
        return self.track.newest_ns - max(late, round(WINDOW * 1e9))

    def _round(self, until: int, ends_here: bool = False) -> None:
        """Make samples of everything up to a stamp of the joints.

        With `ends_here` a stop that goes on is taken to end.
        """
        self._sort()
        if until <= self._settled_ns:
            return
        if self.settings.mode == 'continuous':
            self._take_each(until)
        else:
            until = self._take_stops(until, ends_here)
        self._settled_ns = max(self._settled_ns, until)
        margin = round((WINDOW + self.settings.max_gap) * 1e9)
        self.track.release(min(until, self._complete_ns) - margin)

    def _sort(self) -> None:
        twice = self.track.sort()
        if twice:
            self.dropped['joints: same stamp twice'] += twice
        for rows in self._waiting.values():
            twice = rows.sort()
            if twice:
                self.dropped['poses: same stamp twice'] += twice

    def _take_each(self, until: int) -> None:
        """Make a sample of every measurement up to a stamp of the joints."""
        for key, rows in sorted(self._waiting.items()):
            stamps = rows.stamps - self.delay_ns
            due = stamps <= until
            if not due.any():
                continue
            motion = self.track.at(stamps[due])
            self._count_causes(motion.cause)
            good = motion.cause == 0
            stamps, values = rows.stamps[due][good], rows.values[due][good]
            self.maker.of_each(key, stamps, values, motion.rows(good), self.delay_ns)
            rows.keep(~due)

    def _take_stops(self, until: int, ends_here: bool) -> int:
        """Make samples of the stops that end before a stamp; return what has been dealt with."""
        settings = self.settings
        shortest, longest = (
            round(time * 1e9) for time in (settings.shortest_stop, settings.longest_stop)
        )
        newest = self.track.newest_ns
        done = self._settled_ns
        stands = self.track.standing(settings.still, WINDOW)
        found = bool((np.diff(stands) >= shortest).any())
        self.rests.note(None if found else self.track.noise_at_rest(ADVANCE_NS))
        for begin, end in stands.tolist():
            goes_on = end >= newest
            if ends_here:
                end, goes_on = min(end, until), False
            begin = max(begin, done)
            if begin > until or end <= done:
                continue
            done = self._drop(done, begin, 'the arm was moving')
            if begin <= self._sampled_ns:  # the rest of a stop that has been sampled
                done = self._drop(done, min(end, until), 'of a stop that is sampled already')
                self._sampled_ns = max(self._sampled_ns, done)
                continue
            if settings.mode == 'triggered':
                done = self._drop(done, min(end, until), 'nobody asked for them')
                continue
            last = min(end, begin + longest)
            if last > until or (goes_on and last == end):
                return int(begin)
            if last - begin < shortest:
                done = self._drop(done, last, 'the stop was too short')
                continue
            if self._is_known(begin, last):
                done = self._sampled_ns = self._drop(
                    done, last, 'of a stop that is sampled already'
                )
            else:
                self._average(begin, last)
                done = self._sampled_ns = last
            if end > last:
                done = self._drop(done, min(end, until), 'of a stop that is sampled already')
                self._sampled_ns = done
        return self._drop(done, until, 'the arm was moving')

    def _drop(self, after: int, until: int, why: str) -> int:
        """Drop what was measured after a stamp and until another; return the latter."""
        for rows in self._waiting.values():
            stamps = rows.stamps - self.delay_ns
            due = stamps <= until
            if due.any():
                cause = self.track.causes(stamps[due])
                self._count_causes(cause)
                fine = int((cause == 0).sum())
                if fine:
                    self.unused[f'poses: {why}'] += fine
                rows.keep(~due)
        return until if until > after else after

    def _is_known(self, begin: int, end: int) -> bool:
        """Tell whether a stop was sampled before the clock jumped back; if not, remember it."""
        where = self.track.at(np.array([(begin + end) // 2]), standing=True).joints[0]
        begins, lengths = self._stops.stamps, self._stops.values[:, 0]
        meets = (begins <= end) & (begins + lengths.astype(np.int64) >= begin)
        steps = unwrapped(self._stops.values[meets, 1:] - where, self._revolute)
        if (np.abs(steps).max(axis=1) <= 2.0 * self.settings.still).any():
            return True
        if not self._stops.full:
            self._stops.extend(np.array([begin]), np.array([[end - begin, *where]]))
        return False

    def _average(self, begin: int, end: int) -> None:
        """Make one sample of each stream from what was measured in a stop."""
        self.rests.sampled += 1
        calm = begin + round(self.settings.settle * 1e9)
        for key, rows in sorted(self._waiting.items()):
            stamps = rows.stamps - self.delay_ns
            due = stamps <= end
            inside = due & (stamps >= calm)
            motion = self.track.at(stamps[inside], standing=True)
            good = np.flatnonzero(inside)[motion.cause == 0]
            early = int((due & ~inside).sum())
            if early:
                self.unused['poses: the arm had just stopped'] += early
            self._count_causes(motion.cause)
            if len(good):
                if key.images and len(good) > 1:
                    self.unused['poses: of a stop of which one image is used'] += len(good) - 1
                self.maker.of_stop(
                    key,
                    rows.stamps[good],
                    rows.values[good],
                    motion.rows(motion.cause == 0),
                    self.delay_ns,
                    self.settings.sigma_position,
                )
            rows.keep(~due)

    def forget(self, sample: Sample) -> None:
        """Allow a sample of the same stamp again."""
        self.maker.forget(sample)
        since = sample.stamp_ns - round(1e9 * sample.delay) - self._stops.stamps
        self._stops.keep((since < 0) | (since > self._stops.values[:, 0]))

    def _count_causes(self, cause: NDArray[np.intp]) -> None:
        for k, text in enumerate(CAUSES[1:], start=1):
            count = int((cause == k).sum())
            if count:
                self.dropped[f'poses: {text}'] += count

    def _make_room(self) -> None:
        """Let go the older half of the samples of some joints; nothing may be held any longer."""
        self._round(self._complete_ns)
        if self.track.full:
            self.notes['joint samples let go, the joint buffer was full'] += self.track.halve()

    def start_anew(self) -> None:
        """Go on after the clock jumped back: finish what came before, keep the samples."""
        self.finish()
        self.notes['the clock jumped back'] += 1
        self.track.clear()
        self._newest_ns = self._advanced_ns = self._settled_ns = self._sampled_ns = 0
