# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recent joint samples and measurements, matched to samples for the identification.

Messages wait in bounded buffers until everything of their time has arrived: `lateness` after the
newest joint sample. Then a stop of the arm becomes one sample of each stream (mode `dwell`), every
measurement becomes one (`continuous`), or only requested ones do (`triggered`). All decisions use
header stamps, so a replay takes the same samples as the live robot. Unused messages are counted by
cause.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from calib_ros.kinematics.se3 import Index
from calib_ros.sampling.account import Cause, Lost
from calib_ros.sampling.buffers import TOO_LATE, Rows, Waiting
from calib_ros.sampling.clock_hints import apart, ended
from calib_ros.sampling.hints import Hint, by_turns, restless, sparse
from calib_ros.sampling.rests import Rests
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.sampler import ROW_WIDTH, TWICE, Found, Numbered, Sampler
from calib_ros.sampling.slices import JOINTS, NO_ACCIDENT, POSES, Series, Slice, Stamps, StreamKey
from calib_ros.sampling.stops import SAMPLED, SampledStops, Schedule, seen_stops
from calib_ros.sampling.track import APART, CAUSES, Track
from calib_ros.settings import Settings
from calib_ros.values import MOST_NAMES

REST_S = 0.5 * Settings.shortest_stop  # time [s] without motion after which joints stand
CONTRARY = Lost('different values with the same stamp (two publishers, or stamps too coarse?)')
ADVANCE_NS = round(5e9 * REST_S)  # time between two rounds of sampling, by joint stamps


class Collector:
    """Bounded buffers of joint samples and measurements, and the samples made from them.

    `revolute` (n,) joints have angles as values.
    """

    def __init__(self, revolute: Sequence[bool], settings: Settings) -> None:
        self.settings = settings
        self._revolute = np.array(revolute, dtype=bool)
        self.track = Track(revolute, settings.max_gap, settings.joint_buffer)
        self._known = SampledStops(self._revolute, settings.pose_buffer)
        self._lateness_ns = round(settings.lateness * 1e9)
        self._newest_ns = 0  # the last joint sample
        self._advanced_ns = 0  # the same at the last round
        self._settled_ns = 0  # measurements before this are settled
        self._sampled_ns = 0  # a stop at this moment has been sampled
        self._seated_ns = 0  # the ball was captured in a socket at this moment
        self._since_ns = 0  # begin of the stop that goes on
        self._shaken_ns = 0  # end of the first stop of the last rounds that was not at rest
        self.rests = Rests(settings.pose_buffer)
        self.unmeasured = 0  # stops without a measurement since the last one with any
        self._backwards = 0
        self.delay_ns = round(settings.delay * 1e9)
        """Delay of measurement stamps after joint stamps."""
        self.holding = False  # true while the delay is estimated and nothing is sampled
        self.sampler = Sampler(self._revolute, settings.pose_buffer)
        self.dropped = self.sampler.dropped
        self.waiting = Waiting(ROW_WIDTH, settings.pose_buffer, self.dropped, self.sampler.has)
        self.unused: Counter[Cause] = Counter()  # messages normally not used, by cause
        self.notes: Counter[str] = Counter()

    def recent_series(self, now_ns: int | None) -> tuple[Series, list[Series]]:
        """Return stamps and joint values, and stamps and rows (N, ROW_WIDTH) of waiting positions.

        Only complete ones, older than the stamp `now_ns` by `lateness`; None: all.
        """
        self._sort()
        until = np.iinfo(np.int64).max if now_ns is None else now_ns - self._lateness_ns
        places = (rows for key, rows in self.waiting.items() if key.is_place)
        every = [self.track.samples(), *((rows.stamps, rows.values) for rows in places)]
        joints, *positions = [(t[t <= until], values[t <= until]) for t, values in every]
        return joints, positions

    def reach(self, given: Slice, due: Callable[[int], bool]) -> tuple[int, list[int]]:
        """Return how many messages to take up to the next that requires work, and its rounds.

        These are stamps of joint samples. All but the last are made up for with it, unless others
        have work at one of them (`due`), a message is late for them, or there is no room.
        """
        if self.track.full:  # sample before the older half is dropped
            self._round(self._complete_ns)
        if self.track.full:
            self.notes['joint states dropped, the joint buffer was full'] += self.track.halve()
        times, joints = given.times, given.where(JOINTS)
        late = joints[times[joints] < self.track.horizon_ns][:1]  # handled one by one
        ends: list[int] = [len(given), *np.maximum(late, 1).tolist()]
        for columns in {each.key for each in given.pieces if not isinstance(each.key, StreamKey)}:
            places = [each.places for each in given.pieces if each.key == columns]
            full = np.sort(np.concatenate(places))[self.track.room(columns) - 1 :][:1]
            ends += (full - given.begin + 1).tolist()
        rounds, last = [], self._advanced_ns
        joints = joints[joints < min(ends)]
        for k, stamp in zip(joints.tolist(), times[joints].tolist(), strict=True):
            if stamp - last >= ADVANCE_NS:
                rounds.append(k)
                last = stamp
                if self.holding or due(stamp):
                    break
        if len(rounds) > 1:
            alike = self._alike(given, rounds[0] + 1)
            rounds = [k for k in rounds if k < max(alike, rounds[1])]
        return (rounds[-1] + 1 if rounds else min(ends)), times[rounds].tolist()

    def _alike(self, given: Slice, begin: int) -> int:
        """Return the end of the messages that give the same before or after a round."""
        fullest = max((rows.count for rows in self.waiting.values()), default=0)
        streams = len(self.waiting) + len(given.pieces)
        if fullest + len(given) > self.settings.pose_buffer or streams > MOST_NAMES:
            return begin
        delay_ns = self.delay_ns - round(self.settings.delay * 1e9)  # beyond that of the slice
        since = given.times - delay_ns  # what each message bears on
        for key, places, stamps, _ in given.pieces:
            if not isinstance(key, StreamKey):
                since[places - given.begin] = self.track.bears_on(key, stamps)
        newest = np.maximum.accumulate(np.where(given.joints, given.times, self._newest_ns))
        late = since <= np.append(self._newest_ns, newest[:-1]) - self._late_ns
        return begin + int(np.argmax(np.append(late[begin:], True)))

    def take(self, given: Slice) -> None:
        """Take messages that need no work before the last one."""
        joints = given.where(JOINTS)
        last = np.maximum.accumulate(np.where(given.joints, np.arange(len(given)), -1))
        before = np.where(last < 0, self._newest_ns, given.times[last])
        if len(joints):
            newest = int(given.times[joints[-1]])
            if newest < self.track.horizon_ns:
                self._backwards += 1
                if self._backwards < NO_ACCIDENT:
                    self.dropped[Cause(JOINTS, TOO_LATE)] += 1
                    return
                self.start_anew()
            self._backwards = 0
            self._newest_ns = newest
        for key, places, stamps, numbers in given.pieces:
            if isinstance(key, StreamKey):
                after, at = self._settled_ns + self.delay_ns, before[places - given.begin]
                if self.waiting.extend(key, stamps, numbers, after):
                    self.waiting.apart[key].note(stamps - self.delay_ns, at, self._lateness_ns)
            else:
                self.track.extend(key, stamps, numbers)

    def round(self, rounds: Sequence[int]) -> None:
        """Make samples of what is complete, for rounds at joint stamps."""
        self._advanced_ns = rounds[-1]
        if not self.holding:
            self._round(self._complete_ns, rounds)

    def shaken_round(self, rounds: Sequence[int]) -> int:
        """Return which of the last rounds settled the first stop that was not at rest."""
        settled = np.array(rounds) - self._late_ns
        return min(int(np.searchsorted(settled, self._shaken_ns)), len(rounds) - 1)

    def hints(self, measurements: int, names: Sequence[str]) -> list[Hint]:
        """Return what looks wrong with the states of joints, given the number of measurements."""
        between = self.dropped[Cause(POSES, APART)]
        shared = self.dropped[Cause(JOINTS, CONTRARY)]
        found = sparse(between, measurements, self.settings.max_gap, shared)
        needed = self.rests.needed(self.settings.still)
        if self.rests.swing:
            return [*found, by_turns(self.rests.swing)]
        if found or needed is None:  # of too rare joint states the noise is not known
            return found
        most, every = self.track.noisiest.most_common(1), self.track.noisiest.total()
        one = ''.join(f', above all {names[k]}' for k, often in most if 2 * often > every)
        return [restless(needed, self.settings.still, one)]

    def clock_hints(self) -> list[Hint]:
        """Report clocks that differ or differed by too much, or joint states that have ended."""
        found = self.waiting.apart.values()
        if seconds := max((each.seconds for each in found), key=abs, default=0.0):
            return [apart(seconds)]
        now = self._newest_ns, self._lateness_ns
        seconds = max((each.alone(*now) for each in found), default=0.0)
        return [ended(seconds)] if seconds else []

    def flush(self) -> None:
        """Make samples of everything that has arrived, as if nothing were late."""
        newest = [int(rows.stamps.max()) for rows in self.waiting.values() if rows.count]
        if newest:
            self._round(min(self.track.newest_ns, min(newest) - self.delay_ns), ends_here=True)

    def finish(self) -> None:
        """Process everything; nothing more will arrive."""
        self._round(self.track.newest_ns, ends_here=True)
        for rows in self.waiting.values():
            if rows.count:
                self._count_causes(self.track.causes(rows.stamps - self.delay_ns))
                rows.keep(slice(0))

    def state(self) -> str:
        """Return the state of sampling, for display."""
        self._sort()
        newest = self.track.newest_ns
        if not newest or self.track.missing:
            return 'waiting for joint states'
        if self.holding:
            return 'estimating the measurement delay: keep the arm moving'
        if self.settings.mode == 'continuous':
            return 'every measurement is taken'
        stands = self.track.standing(self.settings.still, REST_S)
        if not len(stands) or stands[-1, 1] < newest:
            long = max(1.0, self.settings.settle + self.settings.shortest_stop)
            ask = f': let it stand at each pose for {long:g} s'
            known = self.sampler.rested or self._seated_ns
            return f'the arm is moving{"" if known else ask}'
        if stands[-1, 0] <= max(self._sampled_ns, self._seated_ns):
            return 'the arm stands and its pose is measured: move on'
        seated = self._seated_ns > 0 and not self.waiting.count  # in sockets only, so far
        asked = seated or self.settings.mode == 'triggered'
        settled = stands[-1, 0] < self._settled_ns
        if settled and not asked and not self._measured(self._settled_ns, newest):
            return 'the arm stands, and nothing has been measured yet'
        ask = ': call ~/capture' * asked
        return f'the arm stands for {1e-9 * (newest - self._begin(stands)):.1f} s{ask}'

    def capture(self, place: str = '') -> tuple[int, str]:
        """Take one sample of each stream now; return their number, or why there is none.

        With a place the target is in a socket there, and no measurement is needed.
        """
        if self.settings.mode == 'continuous':
            return 0, 'every measurement is taken in mode continuous'
        self._sort()
        stands = self.track.standing(self.settings.still, REST_S)
        newest = self.track.newest_ns
        if not newest:
            return 0, 'no joint states of this arm received: see ~/status'
        shortest = round(self.settings.shortest_stop * 1e9)
        stopped = len(stands) and stands[-1, 1] >= newest
        if not stopped or newest - self._begin(stands) < shortest:
            return 0, (
                f'the arm has not been still for {self.settings.shortest_stop:g} s yet '
                f'(joints within {self.settings.still:g} rad or m)'
            )
        if not (self.waiting.count or place):
            return 0, 'no measurements since the last pose'
        begin = self._begin(stands)
        if place:
            stamps = self.track.samples()[0]
            stamps = stamps[stamps >= begin]
            joints = self.track.at(stamps, standing=True).joints
            approach = self.track.approach(stamps[:1], joints[:1])[0]
            if not self.sampler.in_socket(place, int(stamps[-1]), joints, approach):
                return 0, 'it was captured already, and no joint states came since'
            self._seated_ns = newest
            return 1, ''
        self._round(begin)  # end earlier stops
        before, dropped = len(self.sampler.fresh), self.dropped.copy()
        plan = Schedule(self._settled_ns, self._sampled_ns, self._since_ns)
        plan.add(newest, '', begin + round(self.settings.settle * 1e9))
        self._carry_out(plan)
        count = len(self.sampler.fresh) - before
        if count:
            self._sampled_ns = self._settled_ns = newest
        causes = ', '.join(dict.fromkeys(self.dropped - dropped))
        return count, '' if count else causes or 'no measurement within this stop'

    def _begin(self, stands: Stamps) -> int:
        """Return the begin of the last of the stands (K, 2), even if the track forgot it."""
        known = int(stands[-1, 0])
        return min(known, self._since_ns) if known < self._settled_ns else known

    @property
    def _late_ns(self) -> int:
        """Return the age relative to joints at which measurements are complete [ns]."""
        return max(self._lateness_ns + max(self.delay_ns, 0), round(REST_S * 1e9))

    @property
    def _complete_ns(self) -> int:
        """Return the joint stamp up to which everything has arrived and stops are certain."""
        return self.track.newest_ns - self._late_ns

    def _round(self, until: int, rounds: Sequence[int] = (), ends_here: bool = False) -> None:
        """Make samples of everything up to a joint stamp; `ends_here` ends an ongoing stop."""
        self._sort()
        if until <= self._settled_ns:
            return
        self.rests.note_swings(self.track.swings_at_rest(ADVANCE_NS, rounds))
        plan = Schedule(self._settled_ns, self._sampled_ns, self._since_ns)
        if self.settings.mode == 'continuous':
            for end in (*(each - self._late_ns for each in rounds[:-1]), until):
                plan.add(min(end, until), '')
        else:
            self._plan_stops(plan, until, rounds or (self.track.newest_ns,), ends_here)
        self._carry_out(plan)
        self._sampled_ns, self._settled_ns = plan.sampled_ns, plan.done_ns
        self._since_ns = plan.since_ns
        margin = round((REST_S + self.settings.max_gap) * 1e9)
        self.track.release(min(plan.done_ns, self._complete_ns) - margin)

    def _sort(self) -> None:
        kept: list[tuple[str, Track | Rows, bool]] = [(JOINTS, self.track, False)]
        kept += [(POSES, rows, key.images) for key, rows in self.waiting.items()]
        for kind, rows, numbered in kept:
            equal, contrary = rows.sort()
            if numbered:  # image numbers always differ
                equal, contrary = equal + contrary, 0
            self.unused += Counter({Cause(kind, TWICE): equal})
            self.dropped += Counter({Cause(kind, CONTRARY): contrary})

    def _plan_stops(
        self, plan: Schedule, until: int, rounds: Sequence[int], ends_here: bool
    ) -> None:
        settings = self.settings
        stands = self.track.standing(settings.still, REST_S)
        shortest = round(settings.shortest_stop * 1e9)
        seen = seen_stops(stands, rounds, self._settled_ns, self._late_ns, shortest)
        for found, now in zip(seen, rounds, strict=True):
            self.rests.note(None if found else self.track.noise_at_rest(ADVANCE_NS, now))
        newest = None if ends_here else self.track.newest_ns
        plan.of_stands(stands, until, newest, settings, self._measured)
        if stops := plan.stops:
            spans = [(plan.begins[k], plan.ends[k]) for k in stops]
            where = self.track.at(np.sum(spans, axis=1) // 2, standing=True).joints
            for k, span, joints in zip(stops, spans, where, strict=True):
                near = 2.0 * settings.still
                if self._measured(*span) and self._known.seen_before(*span, joints, near):
                    plan.why[k] = SAMPLED

    def _measured(self, begin: int, end: int) -> bool:
        """Tell whether measurements wait between two joint stamps."""
        for rows in self.waiting.values():
            stamps = rows.stamps - self.delay_ns
            if np.searchsorted(stamps, begin) < np.searchsorted(stamps, end, 'right'):
                return True
        return False

    def _carry_out(self, plan: Schedule) -> None:
        self.rests.sampled += len(plan.stops)
        moving = self.settings.mode == 'continuous'
        ends, calm = np.array(plan.ends), np.array(plan.begins)
        wanted = np.array([not why for why in plan.why], dtype=bool)
        found: list[Numbered] = []
        measured: set[int] = set()
        for key, rows in sorted(self.waiting.items()):
            stamps = rows.stamps - self.delay_ns
            due = int(np.searchsorted(stamps, plan.done_ns, 'right')) if plan.ends else 0
            if not due:
                continue
            stamps = stamps[:due]
            numbers = np.searchsorted(ends, stamps)
            cause = self.track.causes(stamps)
            self._count_causes(cause)
            known, inside = cause == 0, wanted[numbers]
            for k, count in Counter(numbers[known & ~inside].tolist()).items():
                self.unused[Cause(POSES, plan.why[k])] += count
            early = known & inside & (stamps < calm[numbers])
            self.unused += Counter({Cause(POSES, 'the arm had just stopped'): int(early.sum())})
            good = np.flatnonzero(known & inside & ~early)
            if len(good):
                more = len(good) - len(np.unique(numbers[good]))
                if key.images and more:
                    self.unused[Cause(POSES, 'another image of a stop that has one')] += more
                motion = self.track.at(stamps[good], standing=not moving)
                measured.update(numbers[good].tolist())
                begins = np.flatnonzero(np.diff(numbers[good], prepend=-1))
                begins = np.arange(len(good)) if moving else begins
                approach = self.track.approach(stamps[good[begins]], motion.joints[begins])
                seen = key, numbers[good], rows.stamps[good], rows.values[good], begins
                noise = 1e-9 * self.delay_ns, self.settings.sigma_position
                found += self.sampler.samples(Found(*seen, motion, approach, *noise))
            rows.keep(slice(due, None))
        for stop in () if moving else plan.stops:
            self.unmeasured = 0 if stop in measured else self.unmeasured + 1
        first = self.sampler.add(found)
        if first is not None:
            self._shaken_ns = plan.ends[first]

    def forget(self, sample: Sample) -> None:
        """Allow another sample with the stamp of this one."""
        self.sampler.forget(sample)
        self._known.forget(sample.stamp_ns - round(1e9 * sample.delay))

    def _count_causes(self, cause: Index) -> None:
        for k, count in sorted(Counter(cause[cause > 0].tolist()).items()):
            self.dropped[Cause(POSES, CAUSES[k])] += count

    def start_anew(self) -> None:
        """Continue after the clock jumped back: finish earlier messages, keep the samples."""
        self.finish()
        self.notes['the clock jumped back'] += 1
        settings = self.settings
        self.track = Track(self._revolute.tolist(), settings.max_gap, settings.joint_buffer)
        self._newest_ns = self._advanced_ns = 0
        self._settled_ns = self._sampled_ns = self._seated_ns = self._since_ns = 0
