# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples from measurements and the joint motion at their time."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from operator import itemgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from calib_ros.estimation.configurations import STILL
from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.sampling.account import Cause, Lost
from calib_ros.sampling.interpolation import unwrapped
from calib_ros.sampling.means import averages, mean_of_each
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.slices import POSES, Stamps, StreamKey
from calib_ros.sampling.track import Motion
from calib_ros.settings import Settings

DISTANCE_SLICE, POSITION_SLICE = slice(0, 1), slice(0, 3)
QUAT_SLICE, COVARIANCE_SLICE = slice(3, 7), slice(7, 43)
ROW_WIDTH = COVARIANCE_SLICE.stop
Numbered: TypeAlias = tuple[int, Sample]  # A sample with the number of its round or stop
VIBRATING = Cause(POSES, 'still vibrating, or a spike')
RESTLESS = Cause(POSES, 'a stop with more spread than noise')
TWICE = 'same stamp twice'


class Found(NamedTuple):
    """Measurements (N,) of one stream, with the numbers of their rounds or stops.

    Stops, or single measurements of a moving arm, begin at `begins` (S,), approached with the
    signs `approach` (S, n). Measurements are late by `delay` [s] and scatter by `sigma` [m].
    """

    key: StreamKey
    numbers: Index
    stamps: Stamps
    values: FloatArray
    begins: Index
    motion: Motion
    approach: FloatArray
    delay: float
    sigma: float


class Sampler:
    """Makes samples, up to a capacity, and no two of one stream with the same stamp.

    A second one elsewhere, after a simulation began again, gets the next free nanosecond.
    """

    def __init__(self, revolute: Flags, capacity: int) -> None:
        self._revolute, self._capacity = revolute, capacity
        self._taken: dict[StreamKey, dict[int, FloatArray]] = {}  # joints (n,) by stamp
        self.fresh: list[Sample] = []  # samples not taken yet
        self._calm: int | None = None  # fresh samples before the first stop not at rest
        self._shaken = math.inf  # the number of that stop
        self.dropped: Counter[Cause] = Counter()
        self.rested = self.restless = 0  # stops with measurements at rest, and not
        self.doubled: list[float] = []  # spreads [m] of those in several places by turns

    def samples(self, found: Found) -> Iterator[Numbered]:
        """Yield a sample of the measurements of each stop, unless they spread too much."""
        key, numbers, stamps, values, begins, motion, approach, delay, sigma = found
        counts = np.diff(begins, append=len(values))
        if key.images:
            yield from self._of_images(found)
            return
        turned = ~np.isnan(values[:, QUAT_SLICE]).any(axis=1)
        positions = values[:, DISTANCE_SLICE if key.distance else POSITION_SLICE]
        means = averages(positions, begins, _sigmas(values, begins, sigma))
        rotations = np.tile(np.eye(3), (len(values), 1, 1))
        rotations[turned] = se3.from_quat(values[turned, QUAT_SLICE])
        oriented = np.logical_and.reduceat(turned, begins).tolist()
        if motion.velocity is None:  # the chordal mean (Moakher 2002)
            rotations = se3.nearest_rotation(mean_of_each(rotations, begins, means.used))
        joints = self._mean(motion.joints, begins, means.used)
        since = (stamps - np.repeat(stamps[begins], counts)).astype(np.float64)
        times = stamps[begins] + np.rint(mean_of_each(since, begins, means.used)).astype(np.int64)
        spikes = np.add.reduceat(~means.used, begins, dtype=np.intp)
        each = (begins, counts, numbers[begins], times, spikes, means.rests, means.spreads)
        for k, row in enumerate(zip(*(part.tolist() for part in each), strict=True)):
            begin, count, number, stamp_ns, left_out, rests, spread = row
            if means.doubled[k]:
                self.doubled.append(spread)
                rests &= spread <= Settings.largest_error  # else the mean is far from each
            if left_out or not rests:
                self._shaken = min(self._shaken, number)
            if not rests:
                self.dropped[RESTLESS] += count
                self.restless += 1
                continue
            self.rested += 1
            rows = values[begin : begin + count]
            if left_out:
                self.dropped[VIBRATING] += left_out
                rows = rows[means.used[begin : begin + count]]
            known = number, key, stamp_ns, rows
            yield from self._made(
                *known,
                position=means.values[k],
                rotation=rotations[k] if oriented[k] else None,
                joints=joints[k],
                approach=approach[k],
                velocity=None if motion.velocity is None else motion.velocity[k],
                acceleration=None if motion.acceleration is None else motion.acceleration[k],
                delay=delay,
                spread=spread,
            )

    def _of_images(self, found: Found) -> Iterator[Numbered]:
        key, numbers, stamps, values, begins, motion, approach, delay, _ = found
        ends = np.append(begins[1:], len(values))
        joints = self._mean(motion.joints, begins, np.ones(len(values), dtype=bool))
        for k, (begin, end) in enumerate(zip(begins.tolist(), ends.tolist(), strict=True)):
            middle = (begin + end) // 2
            yield from self._made(
                int(numbers[begin]),
                key,
                int(stamps[middle]),
                values[middle : middle + 1],
                position=np.full(3, np.nan),
                joints=joints[k],
                approach=approach[k],
                delay=delay,
                images=tuple(values[begin:end, 0].astype(int).tolist()),
            )

    def _mean(self, joints: FloatArray, begins: Index, used: Flags) -> FloatArray:
        """Return the mean joint values (S, n) of the used rows (N, n) of each stop."""
        first = joints[begins]
        counts = np.diff(begins, append=len(joints))
        steps = unwrapped(joints - np.repeat(first, counts, axis=0), self._revolute)
        return np.asarray(first + mean_of_each(steps, begins, used))

    def in_socket(
        self, place: str, stamp_ns: int, joints: FloatArray, approach: FloatArray
    ) -> bool:
        """Make a sample of a ball in a socket, at joint values (N, n) while the arm stands.

        Approached with the signs `approach` (n,). Returns False if one exists.
        """
        mean = joints[0] + unwrapped(joints - joints[0], self._revolute).mean(axis=0)
        free = self._free(StreamKey(place, '', False, False, False), stamp_ns, mean)
        if free is None:
            return False
        sample = Sample(stamp_ns=free, joints=mean, approach=approach, device=place, socket=True)
        self.remember([sample])
        self.fresh.append(sample)
        return True

    def _free(self, key: StreamKey, stamp_ns: int, joints: FloatArray) -> int | None:
        """Return the stamp or the next free one; None if there is a sample at these joints."""
        known = self._taken.setdefault(key, {})
        while stamp_ns in known:
            if np.abs(unwrapped(joints - known[stamp_ns], self._revolute)).max() <= STILL:
                return None
            stamp_ns += 1
        return stamp_ns

    def _made(
        self,
        number: int,
        key: StreamKey,
        stamp_ns: int,
        rows: FloatArray,
        position: FloatArray,
        joints: FloatArray,
        **more: Any,
    ) -> Iterator[Numbered]:
        """Yield a sample of measurements (N, ROW_WIDTH), unless one exists or memory is full."""
        free = self._free(key, stamp_ns, joints)
        known = self._taken[key]
        if free is None or len(known) >= self._capacity:
            why = TWICE if free is None else Lost('the memory for poses is full')
            self.dropped[Cause(POSES, why)] += len(rows)
            return
        known[free] = joints
        covariance = None
        if not np.isnan(rows[:, COVARIANCE_SLICE]).any():
            covariance = rows[:, COVARIANCE_SLICE].mean(axis=0).reshape(6, 6)
        sample = Sample(
            stamp_ns=free,
            joints=joints,
            position=None if key.distance else position,
            distance=float(position[0]) if key.distance else None,
            covariance=covariance,
            device=key.device,
            target=key.target,
            frame_id=key.frame_id,
            validation=key.validation,
            eye_in_hand=key.eye_in_hand,
            count=len(rows),
            **more,
        )
        yield number, sample

    def add(self, found: list[Numbered]) -> int | None:
        """Keep samples in the order of their stops; return the first stop not at rest."""
        found.sort(key=itemgetter(0))
        calm = sum(number < self._shaken for number, _ in found)
        if self._calm is None and calm < len(found):
            self._calm = len(self.fresh) + calm
        self.fresh += [sample for _, sample in found]
        first, self._shaken = self._shaken, math.inf
        return None if first == math.inf else int(first)

    def take(self) -> tuple[list[Sample], int]:
        """Return the samples since the last call, and their number since a restless stop."""
        fresh, calm = self.fresh, self._calm
        self.fresh, self._calm = [], None
        return fresh, 0 if calm is None else len(fresh) - calm

    @property
    def unrest(self) -> int:
        """Return the number of measurements at stops that were not at rest."""
        return self.dropped[VIBRATING] + self.dropped[RESTLESS]

    def has(self, key: StreamKey) -> bool:
        """Tell whether a stream has a sample."""
        return bool(self._taken.get(key))

    def remember(self, samples: Sequence[Sample]) -> None:
        """Make no other samples with the stamps of these."""
        for sample in samples:
            self._taken.setdefault(_key(sample), {})[sample.stamp_ns] = sample.joints

    def forget(self, sample: Sample) -> None:
        """Allow another sample with the stamp of this one."""
        self._taken.get(_key(sample), {}).pop(sample.stamp_ns, None)


def _sigmas(values: FloatArray, begins: Index, sigma: float) -> FloatArray:
    """Return the sigmas (S,) [m] of stops by their covariances, `sigma` if one is missing."""
    own = values[:, COVARIANCE_SLICE].reshape(-1, 6, 6)[:, range(3), range(3)].mean(axis=1)
    variances = np.add.reduceat(own, begins) / np.diff(begins, append=len(values))
    return np.where(np.isnan(variances), sigma, np.sqrt(variances))


def _key(sample: Sample) -> StreamKey:
    return StreamKey(
        device=sample.device,
        target=sample.target,
        validation=sample.validation,
        distance=sample.distance is not None,
        eye_in_hand=sample.eye_in_hand,
        frame_id=sample.frame_id,
        images=sample.view is not None,
    )
