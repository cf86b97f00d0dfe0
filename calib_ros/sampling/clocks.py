# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The clocks of joint states and measurements: watched, and their delay used or reported."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from calib_ros.estimation.levels import SEVERAL
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.sampling.buffers import Rows
from calib_ros.sampling.clock_hints import ambiguous, clocks_moved, disagreement, stuck
from calib_ros.sampling.collector import Collector
from calib_ros.sampling.delay import LEAST_MOTION, SMOOTHING, STEP, Delay, find_delay
from calib_ros.sampling.hints import Hint
from calib_ros.sampling.sampler import POSITION_SLICE, QUAT_SLICE
from calib_ros.sampling.slices import JointIndices, Piece, Series, StreamKey
from calib_ros.sampling.track import Track
from calib_ros.settings import Settings
from calib_ros.shown import NAMED
from calib_ros.values import MOST_NAMES

WATCH_NS = round(5e9 * LEAST_MOTION)  # time between two evaluations of the motion
DENSE_NS = round(0.8e9 * STEP)
"""Interval in which one sample is kept; more add nothing to speeds."""
EARLY = SMOOTHING / 2.0**0.5
"""How early [s] measurements of a stop may be stamped: the accuracy of one delay. Most that
shows the arm leaving is rejected as spikes; the rest moves the mean by less than the noise."""


class Clocks:
    """Estimation of the measurement delay: used in motion, reported at stops.

    Joint values and poses are watched while the arm moves. Once the clocks agree this pauses until
    measurements at stops show unrest, as they do if a clock was moved. In mode continuous, without
    stops, it goes on.
    """

    def __init__(self, chain: Chain, settings: Settings) -> None:
        self.settings = settings
        self._chain = chain
        self._revolute = [joint.type == 'revolute' for joint in chain.joints]
        self._continuous = settings.mode == 'continuous'
        self._found: Delay | None = None  # in the motion that is sampled
        self._searched_ns = self._looked_ns = 0  # when it last did; 0 to begin with the next round
        self._joints: dict[JointIndices, Rows] = {}
        self._poses: dict[StreamKey, Rows] = {}
        self._unrest = self._taken = self._agreed = 0
        self._awake = True
        self._seen: Delay | None = None
        self._unclear: Delay | None = None  # with rivals, before a clear one
        self._moves: deque[tuple[float, int]] = deque(maxlen=NAMED)
        """Changes of the delay [s], and the least number of samples before."""
        self._deaf = 0  # how often targets moved while no joint did
        self._stuck = False  # whether they did last, and no joint has moved since

    @property
    def delay(self) -> Delay | None:
        """Return the delay of the measurement stamps, if the motion shows it."""
        if not self._continuous:
            return self._seen
        return None if self._found is None or self._found.rivals else self._found

    def wake(self, unrest: int, calm: int, taken: int) -> bool:
        """Watch again if more measurements at stops were not at rest; tell whether it begins.

        There were `calm` samples before the first of these, and `taken` by now.
        """
        woken = unrest > self._unrest and not self._awake
        if woken:
            self._awake, self._agreed, self._looked_ns = True, calm, 0
        self._unrest, self._taken = unrest, taken
        return woken

    def take(self, pieces: Sequence[Piece]) -> None:
        """Watch joint values, and measured positions with the rotation if known."""
        capacity = self.settings.pose_buffer
        for key, _, stamps, numbers in pieces if self._awake else ():
            if not isinstance(key, StreamKey):
                rows = self._joints.setdefault(key, Rows(len(key), capacity))
            elif key.is_place and (key in self._poses or len(self._poses) < MOST_NAMES):
                rows = self._poses.setdefault(key, Rows(7, capacity))
            else:
                continue
            last = rows.stamps[-1:] if rows.count else np.array([-DENSE_NS])
            fresh = np.flatnonzero(np.diff(stamps // DENSE_NS, prepend=last // DENSE_NS))
            fresh = fresh[: rows.capacity - rows.count]
            rows.extend(stamps[fresh], numbers[fresh, : rows.width])

    def due(self, now_ns: int) -> bool:
        """Tell whether it is time to evaluate the motion."""
        return not 0 <= now_ns - self._looked_ns <= WATCH_NS

    def look(self, now_ns: int) -> None:
        """Evaluate the motion if it is due, and start again unless it was too little."""
        if not self.due(now_ns):
            return
        track = Track(self._revolute, self.settings.max_gap, self.settings.pose_buffer)
        for columns, rows in self._joints.items():
            track.extend(columns, rows.stamps, rows.values)
        track.sort()
        joints = track.samples()
        little = bool(self._looked_ns) and len(joints[0]) > 0 and not self._evaluate(joints)
        self._looked_ns = now_ns
        if not little or np.ptp(joints[0]) > SEVERAL * WATCH_NS:
            self._joints.clear()
            self._poses.clear()

    def _evaluate(self, joints: Series) -> bool:
        """Tell whether the motion shows a delay; between long stops it may take longer."""
        poses = self._poses.values()
        for rows in poses:
            rows.sort()
        measured = [(rows.stamps, rows.values) for rows in poses]
        latest = joints[1][joints[0] > self._looked_ns]
        stand = len(latest) > 0 and bool(np.ptp(latest, axis=0).max() <= self.settings.still)
        deaf = stand and bool(poses) and all(map(self._moves_much, poses))
        self._deaf += deaf
        self._stuck = deaf or (stand and self._stuck)
        found = self._delay_of(joints, measured)
        if found is None:
            return False
        known = self._seen
        every = (found.seconds, *found.rivals)  # SMOOTHING is the resolution of speeds
        least = max(SMOOTHING, found.within, known.within if known else 0.0)
        if known is None or min(abs(each - known.seconds) for each in every) > least:
            if found.rivals:
                self._unclear = found if known is None else None
                return True
            if known is not None:
                self._moves.append((found.seconds - known.seconds, self._agreed))
            self._seen, self._unclear = found, None
        elif found.within < known.within and not found.rivals:
            self._seen = found  # known better
        self._agreed = self._taken
        self._awake = self._continuous
        return True

    def _moves_much(self, rows: Rows) -> bool:
        """Tell whether a target moves by more than errors are."""
        places = rows.values[rows.stamps > self._looked_ns, POSITION_SLICE]
        if not len(places):
            return False
        far = np.linalg.norm(places - np.median(places, axis=0), axis=1)
        return bool(np.median(far) > self.settings.largest_error)

    def find(self, collector: Collector, now_ns: int | None) -> None:
        """Estimate the delay for a collector, at intervals until it is clear.

        Nothing is sampled before, nor for WATCH_NS while it is known roughly; at the end (None)
        the data so far must do. Ambiguous delays are not used.
        """
        if not collector.holding:
            return
        if now_ns is not None and 0 <= now_ns - self._searched_ns < 1e9 * LEAST_MOTION:
            return
        self._searched_ns = now_ns or 0
        joints, streams = collector.recent_series(now_ns)
        self._found, rough = self._delay_of(joints, streams), True
        if self.delay is not None:
            collector.delay_ns = round(self.delay.seconds * 1e9)
            rough = self.delay.within > SMOOTHING and bool(np.ptp(joints[0]) < WATCH_NS)
        collector.holding = rough and now_ns is not None

    def _delay_of(self, joints: Series, streams: Sequence[Series]) -> Delay | None:
        """Return the delay of poses, by the stream that shows it best.

        Rows (N, 7 or more) of each stream have NaN if the rotation is unknown.
        """
        found = []
        for stamps, rows in streams:
            places = rows[:, POSITION_SLICE]
            fresh = 1 + np.flatnonzero((places[1:] != places[:-1]).any(axis=1))
            stamps, rows = stamps[fresh], rows[fresh]  # others are held, without a target
            oriented = len(rows) > 0 and not np.isnan(rows[:, QUAT_SLICE]).any()
            turns = se3.from_quat(rows[:, QUAT_SLICE]) if oriented else None
            positions, max_gap = rows[:, POSITION_SLICE], self.settings.max_gap
            delay = find_delay(self._chain, *joints, stamps, positions, turns, max_gap)
            found += [] if delay is None else [delay]
        return max(found, key=lambda delay: (not delay.rivals, delay.correlation), default=None)

    def hints(self) -> list[Hint]:
        """Return what looks wrong with the clocks."""
        found = []
        delay, known = self.delay, self.settings.delay
        if self._moves:
            found.append(clocks_moved(self._moves))
        elif delay is not None and not self._continuous:  # in motion it is fitted
            within = max(delay.within - SMOOTHING, 0.0)  # of measurements at stops alone
            if self._spoils(delay.seconds, within):
                found.append(disagreement(delay.seconds, known))
        unclear = self._found if self._continuous else self._unclear
        if unclear is not None and unclear.rivals and not known:
            delays = (unclear.seconds, *unclear.rivals)
            if self._continuous or all(map(self._spoils, delays)):
                found.append(ambiguous(delays))
        return found

    def stuck(self) -> list[Hint]:
        """Report that a target moved while no joint did."""
        return [stuck(1e-9 * WATCH_NS * self._deaf, self._stuck)] if self._deaf else []

    def _spoils(self, delay: float, within: float = 0.0) -> bool:
        more = delay - self.settings.delay
        return not -EARLY - within <= more <= self.settings.settle + within
