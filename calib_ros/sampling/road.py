# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The road of messages: past stray stamps, by slices of time, into the buffers and to samples."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from calib_ros.kinematics.chain import Chain
from calib_ros.sampling.clocks import Clocks
from calib_ros.sampling.collector import Collector
from calib_ros.sampling.hints import Hint, apart
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.slices import JOINTS, POSES, Piece, Slice
from calib_ros.sampling.strays import Gate
from calib_ros.sampling.track import CAUSES
from calib_ros.sampling.waiting import TOO_LATE
from calib_ros.settings import Settings


class Road:
    """Keeps messages by slices up to a joint state after which there is something to do.

    `taken` is called with the samples made, and returns how many there are now.
    """

    def __init__(
        self, chain: Chain, settings: Settings, taken: Callable[[Sequence[Sample]], int]
    ) -> None:
        self._taken = taken
        self.collector = Collector([j.type == 'revolute' for j in chain.joints], settings)
        self.collector.holding = settings.mode == 'continuous' and settings.delay == 0.0
        self.clocks = Clocks(chain, settings)
        # A stamp ahead by more than `lateness` would settle what has not come yet; joint states
        # up to `max_gap` apart belong together.
        self.gate = Gate(max(settings.lateness + settings.max_gap, Settings.lateness))
        self.notes: Counter[str] = Counter()
        self._delay_ns = round(settings.delay * 1e9)
        self._newest = {JOINTS: 0, POSES: 0}

    def take(self, pieces: Sequence[Piece]) -> None:
        """Take messages. An error costs the slice that makes it, and none after it."""
        error: Exception | None = None
        for given in self._slices(pieces):
            try:
                self._keep(given)
            except Exception as err:
                error = error or err
        if error is not None:
            raise error

    def finish(self) -> None:
        """Make samples of everything that still waits; nothing more will come."""
        for held in self.gate.release():
            for given in self._up_to_work(held):
                self._keep(given)
        self.clocks.find(self.collector, None)
        self.collector.finish()
        self.hand_over()

    def flush(self) -> None:
        """Make samples of everything that has come, as if nothing came late."""
        self.collector.flush()
        self.hand_over()

    def hand_over(self) -> None:
        """Hand over the samples made."""
        made, shaken = self.collector.maker.take()
        count = self._taken(made)
        self.clocks.watch.wake(self.collector.maker.unrest, count - shaken, count)

    def hints(self, measurements: int) -> list[Hint]:
        """Return what looks wrong with the stamps, of so many measurements."""
        ahead = 1e-9 * (self._newest[POSES] - self._newest[JOINTS])
        collector, lateness = self.collector, self.clocks.settings.lateness
        causes = (TOO_LATE, *(f'{POSES}: {cause}' for cause in CAUSES[1:3]))
        unmatched = sum(collector.dropped[cause] for cause in causes)
        hint = apart(collector.waiting.count, unmatched, measurements, ahead, lateness)
        found = [hint] if hint is not None and all(self._newest.values()) else []
        return found + self.clocks.hints() + collector.hints(measurements)

    def _slices(self, pieces: Sequence[Piece]) -> Iterator[Slice]:
        """Yield messages up to one that gives something to do, when those before are kept."""
        if not pieces:
            return
        for passed, moved in self.gate.through(Slice.of(pieces, self._delay_ns)):
            if moved and passed.times[0] < self.collector.track.horizon_ns:
                self.collector.start_anew()
            yield from self._up_to_work(passed)

    def _up_to_work(self, given: Slice) -> Iterator[Slice]:
        begin = 0
        while begin < len(given):
            left = given.between(begin, len(given))
            count = self.collector.reach(left, self.clocks.calm(left))
            yield left.between(0, count)
            begin += count

    def _keep(self, given: Slice) -> None:
        """Keep messages, and do what the last one gives to do."""
        for kind in (JOINTS, POSES):
            times = given.times[given.where(kind)]
            if len(times):
                newest = np.maximum(np.maximum.accumulate(times), self._newest[kind])
                self._newest[kind] = int(newest[-1])
                if back := int((times < newest).sum()):  # nothing is lost by it
                    self.notes[f'{kind} with a stamp older than the one before'] += back
        self.clocks.watch.take(given.pieces)
        rounds = self.collector.take(given)
        if rounds:
            self.clocks.find(self.collector, rounds[-1])
            self.collector.round(rounds)
        self.hand_over()
        if rounds:
            self.clocks.watch.look(rounds[-1])
