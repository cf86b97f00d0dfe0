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
from calib_ros.values import MOST_NAMES

WATCH_NS = round(5e9 * LEAST_MOTION)
"""Time over which a watch looks."""
DENSE_NS = round(0.8e9 * STEP)
"""Time between two samples that it keeps; nearer ones tell no more of speeds."""
EARLY = SMOOTHING / 2.0**0.5
"""Time [s] by which measurements of a stop may be stamped too early: the accuracy of one delay. Of
what then shows the arm leaving, most is left out as spikes; the rest moves the mean by less than
the noise of a measurement."""


class Sparse(Rows):
    """Rows no nearer to each other than DENSE_NS."""

    _last_ns = 0

    def take(self, pieces: Sequence[Piece]) -> None:
        """Take what is in pieces, as far as there is room."""
        stamps, numbers = merged(pieces, self.width)
        chosen: list[int] = []
        for i, stamp_ns in enumerate(stamps.tolist()):
            if abs(stamp_ns - self._last_ns) >= DENSE_NS:
                self._last_ns = stamp_ns
                chosen.append(i)
        del chosen[self.capacity - self.count :]
        self.extend(stamps[chosen], numbers[chosen])


class Watch:
    """Joint values and poses while the arm moves, to see whether the clocks agree.

    Once that is seen it sleeps until measurements at stops show unrest: where a clock was moved
    they do, and are left out or refused. Without stops it is `sleepless`.
    """

    def __init__(self, chain: Chain, sleepless: bool, settings: Settings) -> None:
        self._chain = chain
        self._sleepless, self._max_gap = sleepless, settings.max_gap
        self._capacity = settings.pose_buffer
        self._joints = Sparse(len(chain.joints), self._capacity)
        self._poses: dict[StreamKey, Sparse] = {}
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

    def take(self, pieces: Sequence[Piece]) -> None:
        """Take values of all joints, and measured positions with the rotation if known."""
        if not self.awake:
            return
        joints = []
        for each in pieces:
            key = each.key
            if not isinstance(key, StreamKey):
                if len(key) == len(self._chain.joints):
                    joints.append(each)
            elif key.is_place and (key in self._poses or len(self._poses) < MOST_NAMES):
                self._poses.setdefault(key, Sparse(7, self._capacity)).take([each])
        if joints:
            self._joints.take(joints)

    @property
    def begun_ns(self) -> int | None:
        """Return the first stamp since the last look."""
        return int(self._joints.stamps[0]) if self._joints.count else None

    def look(self, now_ns: int) -> None:
        """Look what the motion shows if it is time to, and begin anew."""
        if not (self.awake and self.begun_ns and abs(now_ns - self.begun_ns) > WATCH_NS):
            return
        joints, poses = self._joints, self._poses.values()
        for rows in (joints, *poses):
            rows.sort()
        measured = [(rows.stamps, rows.values) for rows in poses]
        found = _delay_of(self._chain, (joints.stamps, joints.values), measured, self._max_gap)
        joints.release(joints.count)
        self._poses.clear()
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
        best = _delay_of(self._chain, *collector.known(now_ns), self.settings.max_gap)
        if best is not None and not best.rivals:
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
    streams: Sequence[tuple[Stamps, FloatArray]],
    max_gap: float,
) -> Delay | None:
    """Return how late poses are, by the stream that shows it best.

    Rows (N, 7 or more) of each stream have NaN where no rotation is known.
    """
    found = []
    for stamps, rows in streams:
        oriented = len(rows) > 0 and not np.isnan(rows[:, QUAT]).any()
        rotations = se3.from_quat(rows[:, QUAT]) if oriented else None
        delay = find_delay(chain, *joints, stamps, rows[:, POSITION], rotations, max_gap)
        found += [] if delay is None else [delay]
    return max(found, key=lambda delay: (not delay.rivals, delay.correlation), default=None)
