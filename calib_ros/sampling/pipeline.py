# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The path of messages: past stray stamps, in slices of time, into buffers and to samples."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from calib_ros.kinematics.chain import Chain
from calib_ros.sampling.collector import Collector
from calib_ros.sampling.delay import Clocks
from calib_ros.sampling.hints import Hint, unmeasured, unsettled
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.slices import JOINTS, NO_ACCIDENT, POSES, Piece, Slice
from calib_ros.sampling.stops import MOVING
from calib_ros.settings import Settings

STRAY = 'stamp far from those before and after (do the clocks of all publishers agree?)'


class Gate:
    """Distinguishes stray stamps from a moved clock: more than `far` [s] away.

    A message far from the last ones of all streams is held. If its stream returns, the stamp was
    stray and the message is dropped; if it stays away, the clock was moved, a bag is played again
    or there was a pause, and all held messages pass in order.
    """

    def __init__(self, far: float) -> None:
        self._far_ns = round(far * 1e9)
        self._last: dict[str, int] = {}
        self._held: list[tuple[str, int, Slice]] = []
        self.dropped: Counter[str] = Counter()  # messages with stray stamps

    def held(self, kind: str) -> int:
        """Return the number of held messages of a kind."""
        return sum(each[0] == kind for each in self._held)

    def through(self, given: Slice) -> Iterator[tuple[Slice, bool]]:
        """Yield what may pass now, and whether the joints' clock was moved before it.

        Held messages pass with a later message, in order of arrival.
        """
        begin, end = 0, len(given)
        while begin < end:
            left = given.between(begin, end)
            count = self._plain(left)
            if count:
                yield left.between(0, count), False
            else:
                count = 1
                found, moved = self._admitted(left.between(0, 1))
                yield from ((each, moved) for each in found)
            begin += count

    def release(self) -> list[Slice]:
        """Return the held messages: no later one can decide."""
        found, self._held = self._held, []
        return [item for _, _, item in found]

    def _plain(self, given: Slice) -> int:
        """Pass messages up to the first that must be held, or releases others."""
        times, numbers = given.times, np.arange(len(given))
        near = np.zeros(len(given), dtype=bool)  # to the last one of any kind
        for kind, which in ((JOINTS, given.joints), (POSES, ~given.joints)):
            before = np.maximum.accumulate(np.where(which, numbers, -1))
            before = np.concatenate([[-1], before[:-1]])
            known = np.where(before < 0, self._last.get(kind, 0), times[before])
            seen = (before >= 0) | (kind in self._last)
            near |= seen & (np.abs(times - known) <= self._far_ns)
        for kind, time_ns, _ in self._held:
            near &= given.joints != (kind == JOINTS)
            near &= np.abs(times - time_ns) > self._far_ns
        count = int(np.argmin(np.append(near, False)))
        for kind in (JOINTS, POSES):
            where = given.where(kind)
            passed = int(np.searchsorted(where, count))
            if passed:
                self._last[kind] = int(times[where[passed - 1]])
        return count

    def _admitted(self, given: Slice) -> tuple[list[Slice], bool]:
        """Take one message; return what passes, and whether the joints' clock was moved."""
        kind, time_ns = JOINTS if given.joints[0] else POSES, int(given.times[0])
        if self._is_near(time_ns):
            self._last[kind] = time_ns
            found = [*self._now_near(), given]
            self._last[kind] = time_ns
            if strays := self.held(kind):
                self.dropped[f'{kind}: {STRAY}'] += strays
                self._held = [each for each in self._held if each[0] != kind]
            return found, False
        self._held.append((kind, time_ns, given))
        if self.held(kind) < NO_ACCIDENT:
            return [], False
        moved = [time for other, time, _ in self._held if other == kind]

        def passes(each: tuple[str, int, Slice]) -> bool:
            return min(abs(each[1] - time) for time in moved) <= self._far_ns or each[0] == kind

        freed = [each for each in self._held if passes(each)]
        self._held = [each for each in self._held if not passes(each)]
        self._last.update((other, time) for other, time, _ in freed)
        return [item for *_, item in freed], any(other == JOINTS for other, *_ in freed)

    def _is_near(self, time_ns: int) -> bool:
        lasts = self._last.values()
        return not lasts or any(abs(time_ns - last) <= self._far_ns for last in lasts)

    def _now_near(self) -> list[Slice]:
        found = []
        for each in tuple(self._held):
            if self._is_near(each[1]):
                self._last[each[0]] = each[1]
                self._held.remove(each)
                found.append(each[2])
        return found


class Pipeline:
    """Takes messages in slices up to joint states that require work.

    `taken` is called with new samples, and returns their total number.
    """

    def __init__(
        self, chain: Chain, settings: Settings, taken: Callable[[Sequence[Sample]], int]
    ) -> None:
        self._taken = taken
        self.collector = Collector([j.type == 'revolute' for j in chain.joints], settings)
        self.collector.holding = settings.mode == 'continuous' and settings.delay == 0.0
        self.clocks = Clocks(chain, settings)
        # a stamp ahead by more than `lateness` would settle what has not arrived; joint states up
        # to `max_gap` apart belong together
        self.gate = Gate(max(settings.lateness + settings.max_gap, Settings.lateness))
        self._delay_ns = round(settings.delay * 1e9)
        self._newest = {JOINTS: 0, POSES: 0}

    def take(self, pieces: Sequence[Piece]) -> None:
        """Take messages; an error loses only the slice that causes it."""
        error: Exception | None = None
        come = self.gate.through(Slice.of(pieces, self._delay_ns)) if pieces else ()
        for passed, moved in come:
            if moved and passed.times[0] < self.collector.track.horizon_ns:
                self.collector.start_anew()
            for given in self._up_to_work(passed):
                try:
                    self._keep(given)
                except Exception as err:
                    error = error or err
        if error is not None:
            raise error

    def finish(self) -> None:
        """Make samples of all waiting messages; no more will arrive."""
        for held in self.gate.release():
            for given in self._up_to_work(held):
                self._keep(given)
        self.clocks.find(self.collector, None)
        self.collector.finish()
        self.hand_over()

    def flush(self) -> None:
        """Make samples of everything that has arrived, as if nothing were late."""
        self.collector.flush()
        self.hand_over()

    def hand_over(self) -> None:
        """Hand over the samples made."""
        made, shaken = self.collector.sampler.take()
        count = self._taken(made)
        self.clocks.wake(self.collector.sampler.unrest, count - shaken, count)

    def hints(self, measurements: int) -> list[Hint]:
        """Return what looks wrong with the stamps, given the number of measurements."""
        found = self.collector.astray() or self.clocks.hints()
        return found + self.clocks.stuck() + self.collector.hints(measurements)

    def unsettled(self) -> list[Hint]:
        """Return what looks wrong with measurements at stops, if no stamps explain it."""
        sampler, missed = self.collector.sampler, self.collector.unmeasured
        found = unsettled(sampler.restless, sampler.restless + sampler.rested)
        between = 0 if sampler.rested else self.collector.unused[f'{POSES}: {MOVING}']
        return found + (unmeasured(missed, between) if sampler.rested or between else [])

    def _up_to_work(self, given: Slice) -> Iterator[Slice]:
        begin = 0
        while begin < len(given):
            left = given.between(begin, len(given))
            count = self.collector.reach(left, self.clocks.calm(left))
            yield left.between(0, count)
            begin += count

    def _keep(self, given: Slice) -> None:
        for kind in (JOINTS, POSES):
            times = given.times[given.where(kind)]
            if len(times):
                newest = np.maximum(np.maximum.accumulate(times), self._newest[kind])
                self._newest[kind] = int(newest[-1])
                if back := int((times < newest).sum()):  # nothing is lost by it
                    note = f'{kind} with a stamp older than the one before'
                    self.collector.notes[note] += back
        self.clocks.take(given.pieces)
        rounds = self.collector.take(given)
        if rounds:
            self.clocks.find(self.collector, rounds[-1])
            self.collector.round(rounds)
        self.hand_over()
        if rounds:
            self.clocks.look(rounds[-1])
