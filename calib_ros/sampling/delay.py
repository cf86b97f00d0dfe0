# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimation of the delay of a device's stamps from the motion itself.

The speed of the target by joints and chain and the speed by the measurements are the same signal.
Angular speed depends on no frame; linear speed is that of the flange, close enough to the target's
for a start. The lag of highest correlation is refined by a parabola; in motion the identification
then fits the rest as a parameter (`base.delay`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib_ros.estimation.levels import ALIKE, MOST_OUTLIERS, TELLING
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.sampling.buffers import Rows
from calib_ros.sampling.collector import Collector
from calib_ros.sampling.hints import Hint, ambiguous, clocks_moved, disagreement, stuck
from calib_ros.sampling.sampler import POSITION_SLICE, QUAT_SLICE
from calib_ros.sampling.slices import JOINTS, Piece, Series, Slice, Stamps, StreamKey
from calib_ros.settings import EXCEPTION, Settings
from calib_ros.shown import NAMED
from calib_ros.values import MOST_NAMES

SMOOTHING = 0.5 * Settings.max_gap
"""Time over which speeds are computed [s]; short compared with moves, long with the noise."""
STEP = SMOOTHING / 10.0  # sampling time of the speeds [s]
LEAST_MOTION = 3.0 * Settings.lateness
"""Motion needed [s], so that most of it is compared at every delay."""
ALIKE_ENOUGH = float(np.sqrt(1.0 - MOST_OUTLIERS))
"""Least correlation: the share of unexplained variance is that of outliers."""
RISE = EXCEPTION * (1.0 - ALIKE_ENOUGH)
"""Least rise of a correlation peak above a valley: a tenth of what it may lack."""
MOST_TIME = 100.0 * LEAST_MOTION
"""Longest motion evaluated [s], the latest: it must not grow with gaps in the stamps."""


@dataclass(frozen=True)
class Delay:
    """Delay of measurement stamps after joint stamps, and its certainty."""

    seconds: float
    correlation: float
    rivals: tuple[float, ...] = ()  # [s] explain repetitive motion nearly as well


def find_delay(
    chain: Chain,
    joint_stamps: Stamps,
    joints: FloatArray,
    stamps: Stamps,
    positions: FloatArray,
    rotations: FloatArray | None,
    max_gap: float = Settings.lateness,
) -> Delay | None:
    """Return the delay of measurements (N) to joint samples (M), None if unclear or too long.

    Stamps are in order, joints (M, n), positions (N, 3), rotations (N, 3, 3). Between joint
    samples further apart than `max_gap` [s] their motion is unknown.
    """
    if len(joint_stamps) < TELLING or len(stamps) < TELLING:
        return None
    start = joint_stamps[0]
    joint_times, times = (joint_stamps - start) * 1e-9, (stamps - start) * 1e-9
    farthest = Settings.lateness + Settings.max_gap  # beyond it, stamps show a moved clock
    begin = max(joint_times[0], times[0] - farthest)
    end = min(joint_times[-1], times[-1] + farthest)
    if end - begin < LEAST_MOTION:
        return None
    begin = max(begin, end - MOST_TIME)
    grid = np.arange(begin, end, STEP)
    coarse = np.interp(grid, joint_times, np.arange(len(joint_times)))
    known_motion = np.diff(joint_times, append=np.inf)[coarse.astype(int)] <= max_gap
    if known_motion.sum() * STEP < LEAST_MOTION:
        return None
    nearest = np.unique(np.round(coarse).astype(int))
    if len(nearest) < TELLING:  # a gap
        return None
    poses = chain.forward(joints[nearest])
    turns = None if rotations is None else poses[:, :3, :3]
    first = _speed(joint_times[nearest], poses[:, :3, 3], turns)
    by_joints = np.interp(grid, *first)
    moving = known_motion & (by_joints > EXCEPTION * np.percentile(by_joints, 95))
    if moving.sum() * STEP < LEAST_MOTION:
        return None
    second = _speed(times, positions, rotations)
    most = round(farthest / STEP)
    lags = STEP * np.arange(-most, most + 1)
    wide = begin + STEP * np.arange(-most, len(grid) + most)
    known = int(np.sum(wide < second[0][0])), int(np.sum(wide <= second[0][-1]))
    score = _correlations(by_joints, np.interp(wide, *second), known)
    best = int(np.argmax(score))
    if score[best] < ALIKE_ENOUGH or best in (0, len(lags) - 1):
        return None
    left, middle, right = score[best - 1 : best + 2]
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    others = peaks(score, RISE)
    apart = np.sqrt(1.0 - np.maximum(score, 0.0) ** 2)
    rivals = others[(others != best) & (apart[others] < ALIKE * apart[best])]
    seconds = float(lags[best] + shift * STEP)
    return Delay(seconds, float(score[best]), tuple(lags[rivals].tolist()))


def peaks(score: FloatArray, rise: float) -> Index:
    """Return peaks of correlations (N,) that rise this much above the valleys to higher ones.

    As scipy.signal.find_peaks, which takes 0.4 s and 35 MB to load.
    """
    padded = np.pad(score, 1, constant_values=-1.0)
    found = []
    tops = (padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:])
    for k in (np.flatnonzero(tops) + 1).tolist():
        higher = np.flatnonzero(padded > padded[k])
        begin = int(max(higher[higher < k], default=0))
        end = int(min(higher[higher > k], default=len(score) + 1))
        valley = max(padded[begin:k].min(), padded[k + 1 : end + 1].min())
        if padded[k] - valley >= rise:
            found.append(k - 1)
    return np.array(found, dtype=np.intp)


def _speed(
    times: FloatArray, positions: FloatArray, rotations: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return times and speeds over SMOOTHING, angular if rotations (N, 3, 3) are given."""
    behind = np.searchsorted(times, times + SMOOTHING)
    behind = np.minimum(np.maximum(behind, np.arange(len(times)) + 1), len(times) - 1)
    first = np.flatnonzero(times[behind] > times)
    last = behind[first]
    span = times[last] - times[first]
    if rotations is not None:
        turn = np.swapaxes(rotations[first], 1, 2) @ rotations[last]
        way = np.linalg.norm(se3.log_rotation(turn), axis=1)
    else:
        way = np.linalg.norm(positions[last] - positions[first], axis=1)
    return 0.5 * (times[first] + times[last]), way / span


def _correlations(first: FloatArray, second: FloatArray, known: tuple[int, int]) -> FloatArray:
    """Return the correlations of a signal (N,) with the windows (N,) of a longer one.

    The latter is known between two indices; -1 if the overlap is too short.
    """
    lags = np.arange(len(second) - len(first) + 1)
    begin, end = (np.clip(each - lags, 0, len(first)) for each in known)
    count = np.maximum(end - begin, 1)
    one, other = first - first.mean(), np.zeros(len(second))
    part = slice(*known)
    other[part] = second[part] - second[part].mean()

    def total(values: FloatArray, shift: Index | int = 0) -> FloatArray:
        running = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray(running[end + shift] - running[begin + shift])

    means = total(one) / count, total(other, lags) / count
    squares = total(one**2) - count * means[0] ** 2
    squares *= total(other**2, lags) - count * means[1] ** 2
    products = np.correlate(other, one, 'valid') - count * means[0] * means[1]
    least = np.finfo(float).eps * (one @ one) * (other @ other)
    good = (count * STEP >= LEAST_MOTION) & (squares > least)
    return np.where(good, products / np.sqrt(np.where(good, squares, 1.0)), -1.0)


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
        self._continuous = settings.mode == 'continuous'
        self._found: Delay | None = None  # in the motion that is sampled
        self._looked_ns = 0
        self._joints = Rows(len(chain.joints), settings.pose_buffer)
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

    def wake(self, unrest: int, calm: int, taken: int) -> None:
        """Watch again if more measurements at stops were not at rest.

        There were `calm` samples before the first of these, and `taken` by now.
        """
        if unrest > self._unrest and not self._awake:
            self._awake, self._agreed = True, calm
        self._unrest, self._taken = unrest, taken

    def take(self, pieces: Sequence[Piece]) -> None:
        """Watch values of all joints, and measured positions with the rotation if known."""
        for key, _, stamps, numbers in pieces if self._awake else ():
            rows = self._joints
            if isinstance(key, StreamKey):
                if not key.is_place or (key not in self._poses and len(self._poses) == MOST_NAMES):
                    continue
                rows = self._poses.setdefault(key, Rows(7, rows.capacity))
            elif len(key) < rows.width:
                continue
            last = rows.stamps[-1:] if rows.count else np.array([-DENSE_NS])
            fresh = np.flatnonzero(np.diff(stamps // DENSE_NS, prepend=last // DENSE_NS))
            fresh = fresh[: rows.capacity - rows.count]
            rows.extend(stamps[fresh], numbers[fresh, : rows.width])

    @property
    def _begun_ns(self) -> int | None:
        return int(self._joints.stamps[0]) if self._joints.count else None

    def calm(self, given: Slice) -> tuple[int, int]:
        """Return joint stamps between which nothing needs to be evaluated."""
        begun = self._begun_ns
        if begun is None:
            begun = int(given.times[given.where(JOINTS)[:1]].sum())
        return begun - WATCH_NS, begun + WATCH_NS

    def look(self, now_ns: int) -> None:
        """Evaluate the motion if it is time to, and start again."""
        if not (self._awake and self._begun_ns and abs(now_ns - self._begun_ns) > WATCH_NS):
            return
        joints, poses = self._joints, self._poses.values()
        for rows in (joints, *poses):
            rows.sort()
        measured = [(rows.stamps, rows.values) for rows in poses]
        stand = np.ptp(joints.values, axis=0).max() <= self.settings.still
        deaf = stand and bool(poses) and all(map(self._moves_much, poses))
        self._deaf += deaf
        self._stuck = deaf or (stand and self._stuck)
        found = self._delay_of((joints.stamps, joints.values), measured)
        joints.release(joints.count)
        self._poses.clear()
        if found is None:
            return
        known = self._seen
        every = (found.seconds, *found.rivals)  # SMOOTHING is the resolution of speeds
        if known is None or min(abs(each - known.seconds) for each in every) > SMOOTHING:
            if found.rivals:
                self._unclear = found if known is None else None
                return
            if known is not None:
                self._moves.append((found.seconds - known.seconds, self._agreed))
            self._seen, self._unclear = found, None
        self._agreed = self._taken
        self._awake = self._continuous

    def _moves_much(self, rows: Rows) -> bool:
        """Tell whether a target moves by more than errors are."""
        places = rows.values[:, POSITION_SLICE]
        far = np.linalg.norm(places - np.median(places, axis=0), axis=1)
        return bool(np.median(far) > self.settings.largest_error)

    def find(self, collector: Collector, now_ns: int | None) -> None:
        """Estimate the delay for a collector, at intervals until it is clear.

        Nothing is sampled before; at the end (None) the data so far must do. Ambiguous delays are
        not used.
        """
        if not collector.holding:
            return
        if now_ns is not None and 0 <= now_ns - self._looked_ns < 1e9 * LEAST_MOTION:
            return
        self._looked_ns = now_ns or 0
        self._found = self._delay_of(*collector.known(now_ns))
        if self.delay is not None:
            collector.delay_ns = round(self.delay.seconds * 1e9)
        collector.holding = self.delay is None and now_ns is not None

    def _delay_of(self, joints: Series, streams: Sequence[Series]) -> Delay | None:
        """Return the delay of poses, by the stream that shows it best.

        Rows (N, 7 or more) of each stream have NaN if the rotation is unknown.
        """
        found = []
        for stamps, rows in streams:
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
        elif delay is not None and not self._continuous and self._spoils(delay.seconds):
            found.append(disagreement(delay.seconds, known))  # in motion it is fitted
        unclear = self._found if self._continuous else self._unclear
        if unclear is not None and unclear.rivals and not known:
            delays = (unclear.seconds, *unclear.rivals)
            if self._continuous or all(map(self._spoils, delays)):
                found.append(ambiguous(delays))
        return found

    def stuck(self) -> list[Hint]:
        """Report that a target moved while no joint did."""
        return [stuck(1e-9 * WATCH_NS * self._deaf, self._stuck)] if self._deaf else []

    def _spoils(self, delay: float) -> bool:
        return not -EARLY <= delay - self.settings.delay <= self.settings.settle
