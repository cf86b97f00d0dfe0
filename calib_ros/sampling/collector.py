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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.delay import Delay, find_delay
from calib_ros.sampling.messages import Reading
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.stops import Mean, RestlessError, average
from calib_ros.sampling.strays import JUMP
from calib_ros.sampling.track import CAUSES, Motion, Rows, Stamps, Track, unwrapped
from calib_ros.settings import Settings

WINDOW = 0.1
"""Time [s] during which joints must have stayed where they are to be standing."""
ADVANCE_NS = 500_000_000
"""Time of the newest joint sample between two rounds of taking samples."""
STILL = 6.0
"""What `still` must be at least [noise of the joints] for a stop to show as one."""
MOST_RESTS = 1000
"""Rests in which no stop shows that are counted."""
MOST_STREAMS = 50
"""Streams of measurements that are told apart: a tracker may number its markers without end."""
_DISTANCE, _POSITION, _QUAT, _COVARIANCE = slice(0, 1), slice(0, 3), slice(3, 7), slice(7, 43)
_WIDTH = 43
TOO_MANY = f'poses: of one more than {MOST_STREAMS} targets, or frames'
VIBRATING = 'poses: still vibrating, or a spike'
RESTLESS = 'poses: a stop that spreads more than the noise'
_ONE = np.ones(1, dtype=bool)
_FOREVER = np.iinfo(np.int64).max


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
        self._track = Track(revolute, settings.max_gap, settings.joint_buffer)
        self._waiting: dict[StreamKey, Rows] = {}
        self._taken: dict[StreamKey, set[int]] = {}
        self._stops = Rows(1 + len(revolute), settings.pose_buffer)  # how long, and where
        self._lateness_ns = round(settings.lateness * 1e9)
        self._advanced_ns = 0  # the newest joint sample at the last round
        self._settled_ns = 0  # measurements before have been dealt with
        self._sampled_ns = 0  # a stop that stands at this moment has been sampled
        self._stopped = 0  # how many stops were sampled
        self._unseen: list[float] = []  # noise of the joints at rests in which no stop shows
        self._rests = False
        self._backwards = 0
        self._fresh: list[Sample] = []
        self.delay_ns = round(settings.delay * 1e9)
        """How much later than the joints' the stamps of measurements are."""
        self.holding = False
        """True while nothing may be taken because the delay is being looked for."""
        self.dropped: Counter[str] = Counter()
        self.unused: Counter[str] = Counter()
        """What no sample is made of in the ordinary course of things, by cause."""
        self.notes: Counter[str] = Counter()

    @property
    def track(self) -> Track:
        """Return the recent joint samples."""
        return self._track

    @property
    def waiting(self) -> int:
        """Return how many measurements wait for their time."""
        return sum(rows.count for rows in self._waiting.values())

    def find_delay(self, chain: Chain, now_ns: int | None) -> Delay | None:
        """Return how late the waiting measurements are, and take it into account from now on.

        One that has rivals is not taken into account.
        Only what is older by `lateness` than the stamp `now_ns` counts, of which all has come;
        None: everything counts.
        """
        self._sort()
        stamps, joints = self._track.samples()
        until = _FOREVER if now_ns is None else now_ns - self._lateness_ns
        complete = stamps <= until
        found = []
        for key, rows in self._waiting.items():
            if key.distance or key.eye_in_hand:
                continue
            known = rows.stamps <= until
            values = rows.values[known]
            oriented = not np.isnan(values[:, _QUAT]).any()
            rotations = se3.from_quat(values[:, _QUAT]) if oriented and len(values) else None
            found.append(
                find_delay(
                    chain,
                    stamps[complete],
                    joints[complete],
                    rows.stamps[known],
                    values[:, _POSITION],
                    rotations,
                )
            )
        convincing = [delay for delay in found if delay is not None]
        if not convincing:
            return None
        best = max(convincing, key=lambda delay: (not delay.rivals, delay.correlation))
        if not best.rivals:
            self.delay_ns = round(best.seconds * 1e9)
        return best

    def take(self) -> list[Sample]:
        """Return the samples made since the last call."""
        fresh, self._fresh = self._fresh, []
        return fresh

    def add_joints(self, columns: tuple[int, ...], stamp_ns: int, values: Sequence[float]) -> None:
        """Take the values of some joints, given by their numbers in the chain."""
        if stamp_ns < self._track.horizon_ns:
            self._backwards += 1
            if self._backwards < JUMP:
                self.dropped['joints: later than lateness allows'] += 1
                return
            self.start_anew()
        self._backwards = 0
        if not self._track.room(columns):
            self._make_room(columns)
        self._track.add(columns, stamp_ns, values)
        if stamp_ns - self._advanced_ns >= ADVANCE_NS:
            self._advanced_ns = stamp_ns
            if not self.holding:
                self._round(self._complete_ns)

    def uneventful(
        self, columns: tuple[int, ...], stamps: Stamps, among: int
    ) -> NDArray[np.bool_]:
        """Return (M,) which joint samples would only be added, whatever the others do.

        The others may be of the same joints: there must be room for as many as come `among` them.
        """
        quiet = (stamps >= self._track.horizon_ns) & (stamps - self._advanced_ns < ADVANCE_NS)
        return quiet & (self._track.room(columns) >= among)

    def extend_joints(self, columns: tuple[int, ...], stamps: Stamps, values: FloatArray) -> None:
        """Take uneventful joint samples: values (M, k) at stamps (M,)."""
        self._backwards = 0
        self._track.extend(columns, stamps, values)

    def extend(self, key: StreamKey, stamps: Stamps, numbers: FloatArray) -> None:
        """Take measurements with nothing eventful between them: numbers (M, w) at stamps (M,)."""
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
            if len(self._waiting) >= MOST_STREAMS:
                self._forget_idle()
            if len(self._waiting) >= MOST_STREAMS:
                return None
            rows = self._waiting[key] = Rows(_WIDTH, self.settings.pose_buffer)
        return rows

    def _forget_idle(self) -> None:
        """Forget the streams of which nothing waits and no sample was made."""
        for key in [key for key, rows in self._waiting.items() if not rows.count]:
            if not self._taken.get(key):
                del self._waiting[key]
                self._taken.pop(key, None)

    def add(self, key: StreamKey, reading: Reading) -> None:
        """Take a measurement."""
        rows = self._stream(key)
        if rows is None:
            self.dropped[TOO_MANY] += 1
            return
        if reading.stamp_ns - self.delay_ns <= self._settled_ns:
            self.dropped['poses: later than lateness allows'] += 1
            return
        if rows.full:
            self.dropped['poses: pose buffer full'] += 1
            return
        rows.append(reading.stamp_ns, reading.numbers)

    def flush(self) -> None:
        """Make samples of everything that has come on both sides, as if nothing came late."""
        newest = [int(rows.stamps.max()) for rows in self._waiting.values() if rows.count]
        if newest:
            self._round(min(self._track.newest_ns, min(newest) - self.delay_ns), ends_here=True)

    def finish(self) -> None:
        """Deal with everything; nothing more will come."""
        self._round(self._track.newest_ns, ends_here=True)
        for rows in self._waiting.values():
            if rows.count:
                self._count_causes(self._track.causes(rows.stamps - self.delay_ns))
                rows.keep(np.zeros(rows.count, dtype=bool))

    def state(self) -> str:
        """Return in words what the arm does, as far as samples are concerned."""
        self._sort()
        newest = self._track.newest_ns
        if not newest or self._track.missing:
            return 'waiting for joint states'
        if self.holding:
            return 'looking for the delay of the measurements: keep the arm moving'
        if self.settings.mode == 'continuous':
            return 'every measurement is taken'
        stands = self._track.standing(self.settings.still, WINDOW)
        if not len(stands) or stands[-1, 1] < newest:
            return 'the arm is moving'
        if stands[-1, 0] <= self._sampled_ns:
            return 'the arm stands and is sampled: move on'
        return f'the arm stands for {1e-9 * (newest - int(stands[-1, 0])):.1f} s'

    @property
    def still_needed(self) -> float | None:
        """Return what `still` must be at least where more rests passed unseen than not."""
        if len(self._unseen) <= self._stopped:
            return None
        needed = STILL * float(np.median(self._unseen))
        return needed if needed > self.settings.still else None

    @property
    def unrest(self) -> int:
        """Return how many measurements at stops were not at rest."""
        return self.dropped[VIBRATING] + self.dropped[RESTLESS]

    def capture(self) -> tuple[int, str]:
        """Take one sample of each stream now; return how many, and why not more in words."""
        if self.settings.mode == 'continuous':
            return 0, 'every measurement is taken in mode continuous'
        self._sort()
        stands = self._track.standing(self.settings.still, WINDOW)
        newest = self._track.newest_ns
        if not newest:
            return 0, 'no joint states have come'
        if not self.waiting:
            return 0, 'no measurements have come since the last sample'
        shortest = round(self.settings.shortest_stop * 1e9)
        if not len(stands) or stands[-1, 1] < newest or newest - stands[-1, 0] < shortest:
            return 0, (
                f'the arm has not stood for {self.settings.shortest_stop:g} s yet '
                f'(no joint further than {self.settings.still:g} rad or m)'
            )
        begin = int(stands[-1, 0])
        self._round(begin)  # a stop before is not waited for any longer
        before, dropped = len(self._fresh), self.dropped.copy()
        self._average(begin, newest)
        count = len(self._fresh) - before
        if count:
            self._sampled_ns = self._settled_ns = newest
        causes = ', '.join(dict.fromkeys(self.dropped - dropped))
        return count, '' if count else causes or 'no measurement within this stop'

    # Rounds

    @property
    def _complete_ns(self) -> int:
        """Return the stamp of the joints up to which all has come, and stops can be told."""
        late = self._lateness_ns + max(self.delay_ns, 0)
        return self._track.newest_ns - max(late, round(WINDOW * 1e9))

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
        self._track.release(min(until, self._complete_ns) - margin)

    def _sort(self) -> None:
        twice = self._track.sort()
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
            motion = self._track.at(stamps[due])
            self._count_causes(motion.cause)
            known, values = rows.stamps[due], rows.values[due]
            oriented = ~np.isnan(values[:, _QUAT.start])
            rotations = np.tile(np.eye(3), (len(values), 1, 1))
            rotations[oriented] = se3.from_quat(values[oriented, _QUAT])
            for k in np.flatnonzero(motion.cause == 0).tolist():
                value = values[k, _DISTANCE if key.distance else _POSITION]
                mean = Mean(_ONE, value, rotations[k] if oriented[k] else None, 0.0)
                self._make(key, int(known[k]), mean, values[k : k + 1], motion, k)
            rows.keep(~due)

    def _take_stops(self, until: int, ends_here: bool) -> int:
        """Make samples of the stops that end before a stamp; return what has been dealt with."""
        settings = self.settings
        shortest, longest = (
            round(time * 1e9) for time in (settings.shortest_stop, settings.longest_stop)
        )
        newest = self._track.newest_ns
        done = self._settled_ns
        stands = self._track.standing(settings.still, WINDOW)
        self._look_for_rest(bool((np.diff(stands) >= shortest).any()))
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

    def _look_for_rest(self, found: bool) -> None:
        """Note the noise of the joints where they rest though no stop is `found`."""
        noise = None if found else self._track.noise_at_rest(ADVANCE_NS)
        before, self._rests = self._rests, noise is not None
        if noise is not None and not before and len(self._unseen) < MOST_RESTS:
            self._unseen.append(noise)

    def _drop(self, after: int, until: int, why: str) -> int:
        """Drop what was measured after a stamp and until another; return the latter."""
        for rows in self._waiting.values():
            stamps = rows.stamps - self.delay_ns
            due = stamps <= until
            if due.any():
                cause = self._track.causes(stamps[due])
                self._count_causes(cause)
                fine = int((cause == 0).sum())
                if fine:
                    self.unused[f'poses: {why}'] += fine
                rows.keep(~due)
        return until if until > after else after

    def _is_known(self, begin: int, end: int) -> bool:
        """Tell whether a stop was sampled before the clock jumped back; if not, remember it."""
        where = self._track.at(np.array([(begin + end) // 2]), standing=True).joints[0]
        begins, lengths = self._stops.stamps, self._stops.values[:, 0]
        meets = (begins <= end) & (begins + lengths.astype(np.int64) >= begin)
        steps = unwrapped(self._stops.values[meets, 1:] - where, self._revolute)
        if (np.abs(steps).max(axis=1) <= 2.0 * self.settings.still).any():
            return True
        if not self._stops.full:
            self._stops.append(begin, [end - begin, *where])
        return False

    def _average(self, begin: int, end: int) -> None:
        """Make one sample of each stream from what was measured in a stop."""
        self._stopped += 1
        calm = begin + round(self.settings.settle * 1e9)
        for key, rows in sorted(self._waiting.items()):
            stamps = rows.stamps - self.delay_ns
            due = stamps <= end
            inside = due & (stamps >= calm)
            motion = self._track.at(stamps[inside], standing=True)
            good = np.flatnonzero(inside)[motion.cause == 0]
            early = int((due & ~inside).sum())
            if early:
                self.unused['poses: the arm had just stopped'] += early
            self._count_causes(motion.cause)
            if len(good):
                self._average_one(key, rows, good, self._chosen(motion))
            rows.keep(~due)

    def _average_one(
        self, key: StreamKey, rows: Rows, good: NDArray[np.intp], motion: Motion
    ) -> None:
        values = rows.values[good]
        measured = values[:, _DISTANCE if key.distance else _POSITION]
        oriented = not np.isnan(values[:, _QUAT]).any()
        rotations = se3.from_quat(values[:, _QUAT]) if oriented else None
        sigma = self.settings.sigma_position
        if not np.isnan(values[:, _COVARIANCE]).any():
            own = values[:, _COVARIANCE].reshape(-1, 6, 6)[:, range(3), range(3)]
            sigma = float(np.sqrt(own.mean()))
        try:
            mean = average(measured, rotations, sigma)
        except RestlessError:
            self.dropped[RESTLESS] += len(good)
            return
        left_out = int((~mean.used).sum())
        if left_out:
            self.dropped[VIBRATING] += left_out
        stamp = round(float((rows.stamps[good][mean.used] - rows.stamps[good][0]).mean()))
        self._make(key, int(rows.stamps[good][0]) + stamp, mean, values[mean.used], motion, None)

    @staticmethod
    def _chosen(motion: Motion) -> Motion:
        good = motion.cause == 0
        return Motion(
            motion.joints[good],
            motion.velocity[good],
            motion.acceleration[good],
            motion.approach[good],
            motion.cause[good],
        )

    def _make(
        self,
        key: StreamKey,
        stamp_ns: int,
        mean: Mean,
        rows: FloatArray,
        motion: Motion,
        which: int | None,
    ) -> None:
        """Add a sample, from one measurement (`which`) or from the mean of a stop."""
        known = self._taken.setdefault(key, set())
        if stamp_ns in known:
            self.dropped['poses: a sample with this stamp is there already'] += len(rows)
            return
        if len(known) >= self.settings.pose_buffer:
            self.dropped['poses: the memory for samples is full'] += len(rows)
            return
        known.add(stamp_ns)
        covariance = None
        if not np.isnan(rows[:, _COVARIANCE]).any():
            covariance = rows[:, _COVARIANCE].mean(axis=0).reshape(6, 6)
        if which is None:
            steps = unwrapped(motion.joints[mean.used] - motion.joints[0], self._revolute)
            joints = motion.joints[0] + steps.mean(axis=0)
            velocity = acceleration = None
            approach = motion.approach[0].copy()  # a view would keep the whole stop
        else:
            joints, approach, velocity, acceleration = (
                each[which].copy()
                for each in (motion.joints, motion.approach, motion.velocity, motion.acceleration)
            )
        self._fresh.append(
            Sample(
                stamp_ns=stamp_ns,
                joints=joints,
                approach=approach,
                position=None if key.distance else mean.value,
                rotation=mean.rotation,
                distance=float(mean.value[0]) if key.distance else None,
                covariance=covariance,
                velocity=velocity,
                acceleration=acceleration,
                device=key.device,
                target=key.target,
                frame_id=key.frame_id,
                validation=key.validation,
                eye_in_hand=key.eye_in_hand,
                delay=1e-9 * self.delay_ns,
                count=len(rows),
                spread=mean.spread,
            )
        )

    def remember(self, samples: Sequence[Sample]) -> None:
        """Allow no other samples of the stamps of these."""
        for sample in samples:
            self._taken.setdefault(_key(sample), set()).add(sample.stamp_ns)

    def forget(self, sample: Sample) -> None:
        """Allow a sample of the same stamp again."""
        self._taken.get(_key(sample), set()).discard(sample.stamp_ns)
        since = sample.stamp_ns - round(1e9 * sample.delay) - self._stops.stamps
        self._stops.keep((since < 0) | (since > self._stops.values[:, 0]))

    def _count_causes(self, cause: NDArray[np.intp]) -> None:
        for k, text in enumerate(CAUSES[1:], start=1):
            count = int((cause == k).sum())
            if count:
                self.dropped[f'poses: {text}'] += count

    # Buffers

    def _make_room(self, columns: tuple[int, ...]) -> None:
        """Let go the older half of the samples of some joints; nothing may be held any longer."""
        self._round(self._complete_ns)
        if not self._track.room(columns):
            self.notes['joint samples let go, the joint buffer was full'] += self._track.halve()

    def start_anew(self) -> None:
        """Go on after the clock jumped back: finish what came before, keep the samples."""
        self.finish()
        self.notes['the clock jumped back'] += 1
        self._track.clear()
        self._advanced_ns = self._settled_ns = self._sampled_ns = 0


def _key(sample: Sample) -> StreamKey:
    return StreamKey(
        sample.device,
        sample.target,
        sample.validation,
        sample.distance is not None,
        sample.eye_in_hand,
        sample.frame_id,
    )
