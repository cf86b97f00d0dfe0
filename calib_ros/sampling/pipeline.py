# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The path of messages: past stray stamps, in slices of time, into buffers and to samples."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from calib_ros.kinematics.chain import Chain
from calib_ros.sampling.account import Cause
from calib_ros.sampling.clocks import Clocks
from calib_ros.sampling.collector import Collector
from calib_ros.sampling.gate import Gate
from calib_ros.sampling.hints import Hint, unmeasured, unsettled, unstopped
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.sample_hints import of_two_places
from calib_ros.sampling.slices import JOINTS, POSES, Piece, Slice
from calib_ros.sampling.stops import MOVING
from calib_ros.settings import EXCEPTION, Settings


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
        self._names = chain.joint_names
        self._newest = {JOINTS: 0, POSES: 0}

    def take(self, pieces: Sequence[Piece]) -> None:
        """Take messages; an error loses only the slice that causes it."""
        if pieces:
            self._pass(self.gate.admit(Slice.of(pieces, self._delay_ns)))

    def finish(self) -> None:
        """Make samples of all waiting messages; no more will arrive."""
        self._pass((held, False) for held in self.gate.release())
        self.clocks.find(self.collector, None)
        self.collector.finish()
        self.hand_over()

    def flush(self) -> None:
        """Make samples of everything that has arrived, as if nothing were late."""
        self.collector.flush()
        self.hand_over()

    def hand_over(self) -> bool:
        """Hand over the samples made; tell whether they give reason to watch the clocks."""
        made, shaken = self.collector.sampler.take()
        count = self._taken(made)
        return self.clocks.wake(self.collector.sampler.unrest, count - shaken, count)

    def hints(self, measurements: int) -> list[Hint]:
        """Return what looks wrong with the stamps, given the number of measurements."""
        found = self.collector.clock_hints() or self.clocks.hints()
        return found + self.clocks.stuck() + self.collector.hints(measurements, self._names)

    def unsettled(self) -> list[Hint]:
        """Return what looks wrong with measurements at stops, if no stamps explain it."""
        sampler, missed = self.collector.sampler, self.collector.unmeasured
        stops = sampler.restless + sampler.rested
        far = [spread for spread in sampler.doubled if spread > Settings.largest_error]
        found = of_two_places(far, EXCEPTION * stops)  # these gave no pose
        most = 0.5 * (sampler.rested + len(far))
        found = found or of_two_places(sampler.doubled, most)  # by regular turns
        found = found or unsettled(sampler.restless, stops)
        between = 0 if sampler.rested else self.collector.unused[Cause(POSES, MOVING)]
        return found + (unmeasured(missed, between) if sampler.rested or between else [])

    def unstopped(self, known: int) -> list[Hint]:
        """Tell of motion with hardly any stop, by the `known` poses; mode continuous takes all."""
        if self.collector.settings.mode != 'dwell':
            return []
        moving = self.collector.unused[Cause(POSES, MOVING)]
        return unstopped(known, moving)

    def _pass(self, come: Iterable[tuple[Slice, bool]]) -> None:
        error: Exception | None = None
        for left, back in come:
            if back:
                self.collector.start_anew()
            while len(left):
                count, rounds = self.collector.reach(left, self.clocks.due)
                try:
                    self._keep(left.between(0, count), rounds)
                except Exception as err:
                    error = error or err
                left = left.between(count, len(left))
        if error is not None:
            raise error

    def _keep(self, given: Slice, rounds: Sequence[int]) -> None:
        for kind in (JOINTS, POSES):
            times = given.times[given.where(kind)]
            if len(times):
                newest = np.maximum(np.maximum.accumulate(times), self._newest[kind])
                self._newest[kind] = int(newest[-1])
                if back := int((times < newest).sum()):  # nothing is lost by it
                    note = f'{kind} with a stamp older than the one before'
                    self.collector.notes[note] += back
        self.clocks.take(given.pieces)
        self.collector.take(given)
        if rounds:
            self.clocks.find(self.collector, rounds[-1])
            self.collector.round(rounds)
        woken = self.hand_over()
        if woken and rounds:  # from the round on that had reason to, as if taken by itself
            since = rounds[self.collector.shaken_round(rounds)]
            self.clocks.look(since)
            place = int(np.argmax(given.joints & (given.times == since)))
            self.clocks.take(given.between(place + 1, len(given)).pieces)
        if rounds:
            self.clocks.look(rounds[-1])
