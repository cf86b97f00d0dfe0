# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether the clocks of joint states and measurements agree, as far as the motion shows."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.collector import Collector
from calib_ros.sampling.delay import LEAST_MOTION, SMOOTHING, STEP, Delay, find_delay
from calib_ros.sampling.hints import Hint, ambiguous, disagreement, moved
from calib_ros.sampling.making import POSITION, QUAT
from calib_ros.sampling.rows import Rows, Stamps
from calib_ros.sampling.slices import JOINTS, Piece, Slice, StreamKey, merged
from calib_ros.settings import Settings
from calib_ros.shown import NAMED

WATCH_NS = round(5e9 * LEAST_MOTION)
"""Time over which a watch looks."""
DENSE_NS = round(0.8e9 * STEP)
"""Time between two samples that it keeps; nearer ones tell no more of speeds."""
EARLY = SMOOTHING / 2.0**0.5
"""Time [s] by which measurements of a stop may be stamped too early: the accuracy of one delay. Of
what then shows the arm leaving, most is left out as spikes; the rest moves the mean by less than
the noise of a measurement."""


class Watch:
    """Joint values and poses while the arm moves, to see whether the clocks agree.

    Once that is seen it sleeps until measurements at stops show unrest: where a clock was moved
    they do, and are left out or refused. Without stops it is `sleepless`.
    """

    def __init__(self, chain: Chain, sleepless: bool, settings: Settings) -> None:
        self._chain = chain
        self._sleepless, self._max_gap = sleepless, settings.max_gap
        self._joints = Rows(len(chain.joints), settings.pose_buffer)
        self._poses = Rows(7, settings.pose_buffer)
        self._last_ns = [0, 0]
        self._unrest = 0
        self._taken = self._agreed = 0
        self.awake = True
        self.delay: Delay | None = None
        """The last one seen."""
        self.unclear: Delay | None = None
        """One with rivals, while no other was seen."""
        self.moves: deque[tuple[float, int]] = deque(maxlen=NAMED)
        """By how much [s] it changed, and after how many samples at least."""

    def wake(self, unrest: int, calm: int, taken: int) -> None:
        """Watch again if more measurements at stops were not at rest.

        Before the first of these there were `calm` samples; so many are `taken` by now.
        """
        if unrest > self._unrest and not self.awake:
            self.awake, self._agreed = True, calm
        self._unrest, self._taken = unrest, taken

    def take(self, joints: Sequence[Piece], poses: Sequence[Piece]) -> None:
        """Take values of all joints, and measured positions, each with the rotation if known."""
        if not self.awake:
            return
        for k, rows, pieces in ((0, self._joints, joints), (1, self._poses, poses)):
            room = rows.capacity - rows.count
            if not pieces or not room:
                continue
            stamps, numbers = merged(pieces, rows.width)
            chosen: list[int] = []
            last = self._last_ns[k]
            for i, stamp_ns in enumerate(stamps.tolist()):
                if abs(stamp_ns - last) >= DENSE_NS:
                    last = stamp_ns
                    chosen.append(i)
            self._last_ns[k] = last
            rows.extend(stamps[chosen[:room]], numbers[chosen[:room]])

    @property
    def begun_ns(self) -> int | None:
        """Return the first stamp since the last look."""
        return int(self._joints.stamps[0]) if self._joints.count else None

    def look(self, now_ns: int) -> None:
        """Look what the motion shows if it is time to, and begin anew."""
        if not (self.awake and self.begun_ns and abs(now_ns - self.begun_ns) > WATCH_NS):
            return
        joints, poses = self._joints, self._poses
        for rows in (joints, poses):
            rows.sort()
        both = (joints.stamps, joints.values), (poses.stamps, poses.values)
        found = _delay_of(self._chain, *both, self._max_gap)
        for rows in (joints, poses):
            rows.release(rows.count)
        if found is None:
            return
        known = self.delay
        every = (found.seconds, *found.rivals)
        # Speeds over SMOOTHING tell no finer difference.
        if known is None or min(abs(each - known.seconds) for each in every) > SMOOTHING:
            if found.rivals:
                self.unclear = found if known is None else None
                return
            if known is not None:
                self.moves.append((found.seconds - known.seconds, self._agreed))
            self.delay, self.unclear = found, None
        self._agreed = self._taken
        self.awake = self._sleepless


class Clocks:
    """Looks for the delay of the measurements: to use it in motion, and to warn of it at stops."""

    def __init__(self, chain: Chain, settings: Settings) -> None:
        self.settings = settings
        self._chain = chain
        self._continuous = settings.mode == 'continuous'
        self.watch = Watch(chain, self._continuous, settings)
        self._found: Delay | None = None  # in the motion that is sampled
        self._looked_ns = 0

    @property
    def delay(self) -> Delay | None:
        """Return how late the measurements are stamped, as far as the motion shows."""
        if not self._continuous:
            return self.watch.delay
        return None if self._found is None or self._found.rivals else self._found

    def take(self, given: Slice) -> None:
        """Take messages."""
        if self.watch.awake:
            joints, poses = [], []
            for each in given.pieces:
                if not isinstance(each.key, StreamKey):
                    if len(each.key) == len(self._chain.joints):
                        joints.append(each)
                elif not (each.key.distance or each.key.eye_in_hand or each.key.images):
                    poses.append(each)
            self.watch.take(joints, poses)

    def calm(self, given: Slice) -> tuple[int, int]:
        """Return stamps of joints between which there is nothing to look for."""
        begun = self.watch.begun_ns
        if begun is None:
            begun = int(given.times[given.where(JOINTS)[:1]].sum())
        return begun - WATCH_NS, begun + WATCH_NS

    def find(self, collector: Collector, now_ns: int | None) -> None:
        """Look for the delay after some time of motion, until it shows.

        Nothing is sampled before; at the end (None) what has come must do.
        """
        if not collector.holding:
            return
        if now_ns is not None and 0 <= now_ns - self._looked_ns < 1e9 * LEAST_MOTION:
            return
        self._looked_ns = now_ns or 0
        self._found = self._find(collector, now_ns)
        collector.holding = self.delay is None and now_ns is not None

    def _find(self, collector: Collector, now_ns: int | None) -> Delay | None:
        """Return how late the waiting measurements are; from now on the collector uses it.

        One that has rivals is not used.
        """
        known, positions = collector.known(now_ns)
        gap = self.settings.max_gap
        delays = [_delay_of(self._chain, known, measured, gap) for measured in positions]
        found = [each for each in delays if each is not None]
        if not found:
            return None
        best = max(found, key=lambda delay: (not delay.rivals, delay.correlation))
        if not best.rivals:
            collector.delay_ns = round(best.seconds * 1e9)
        return best

    def hints(self) -> list[Hint]:
        """Return what looks wrong with the clocks."""
        found = []
        delay, known = self.delay, self.settings.delay
        if self.watch.moves:
            found.append(moved(self.watch.moves))
        elif delay is not None and not self._continuous and self._spoils(delay.seconds):
            found.append(disagreement(delay.seconds, known))  # in motion it is fitted
        unclear = self._found if self._continuous else self.watch.unclear
        if unclear is not None and unclear.rivals and not known:
            delays = (unclear.seconds, *unclear.rivals)
            if self._continuous or all(map(self._spoils, delays)):
                found.append(ambiguous(delays))
        return found

    def _spoils(self, delay: float) -> bool:
        """Tell whether a delay [s] spoils stops."""
        return not -EARLY <= delay - self.settings.delay <= self.settings.settle


def _delay_of(
    chain: Chain,
    joints: tuple[Stamps, FloatArray],
    measured: tuple[Stamps, FloatArray],
    max_gap: float,
) -> Delay | None:
    """Return how late poses are: rows (N, 7 or more), with NaN where no rotation is known."""
    stamps, rows = measured
    oriented = len(rows) > 0 and not np.isnan(rows[:, QUAT]).any()
    rotations = se3.from_quat(rows[:, QUAT]) if oriented else None
    return find_delay(chain, *joints, stamps, rows[:, POSITION], rotations, max_gap)
