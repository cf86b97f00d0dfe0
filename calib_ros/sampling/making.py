# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples of measurements and of the motion of the joints at their time."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from operator import itemgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.interpolation import unwrapped
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.slices import Stamps, StreamKey
from calib_ros.sampling.stops import averages, mean_of_each
from calib_ros.sampling.track import Motion

DISTANCE, POSITION = slice(0, 1), slice(0, 3)
QUAT, COVARIANCE = slice(3, 7), slice(7, 43)
ROW_WIDTH = COVARIANCE.stop
Numbered: TypeAlias = tuple[int, Sample]
"""A sample with the number of the round or the stop in which it was taken."""
VIBRATING = 'measurements: still vibrating, or a spike'
RESTLESS = 'measurements: a stop that spreads more than the noise'


class Matched(NamedTuple):
    """Measurements of one stream, in the order of their stamps, and the motion at these.

    Numbers (N,) are of their rounds or stops, values (N, ROW_WIDTH) are stamped late by a delay.
    """

    key: StreamKey
    numbers: NDArray[np.intp]
    stamps: Stamps
    values: FloatArray
    motion: Motion
    delay_ns: int


class Maker:
    """Makes samples, up to a capacity, and no two of one stream with the same stamp."""

    def __init__(self, revolute: NDArray[np.bool_], capacity: int) -> None:
        self._revolute, self._capacity = revolute, capacity
        self._taken: dict[StreamKey, set[int]] = {}
        self.fresh: list[Sample] = []
        """Samples that nobody has taken yet."""
        self._calm: int | None = None  # how many of them came before a stop that was not at rest
        self._shaken = math.inf  # the number of that stop
        self.dropped: Counter[str] = Counter()

    def of_each(self, found: Matched) -> Iterator[Numbered]:
        """Yield a sample of each of some measurements."""
        key, numbers, stamps, values, motion, delay_ns = found
        oriented = ~np.isnan(values[:, QUAT.start])
        rotations = np.tile(np.eye(3), (len(values), 1, 1))
        rotations[oriented] = se3.from_quat(values[oriented, QUAT])
        for k, stamp_ns in enumerate(stamps.tolist()):
            yield from self._made(
                int(numbers[k]),
                key,
                stamp_ns,
                values[k : k + 1],
                position=values[k, DISTANCE if key.distance else POSITION].copy(),
                rotation=rotations[k] if oriented[k] else None,
                joints=motion.joints[k].copy(),
                approach=motion.approach[k].copy(),
                velocity=motion.velocity[k].copy(),
                acceleration=motion.acceleration[k].copy(),
                delay=1e-9 * delay_ns,
            )

    def of_stops(self, found: Matched, sigma: float) -> Iterator[Numbered]:
        """Yield a sample of the measurements of each stop, unless these spread too much.

        They scatter by `sigma` [m].
        """
        key, numbers, stamps, values, motion, delay_ns = found
        begins = np.flatnonzero(np.diff(numbers, prepend=-1))
        counts = np.diff(begins, append=len(values))
        joints = motion.joints[begins]
        steps = unwrapped(motion.joints - np.repeat(joints, counts, axis=0), self._revolute)
        if key.images:
            joints = joints + mean_of_each(steps, begins, np.ones(len(steps), dtype=bool))
            yield from self._of_images(found, begins, joints)
            return
        turned = ~np.isnan(values[:, QUAT]).any(axis=1)
        own = values[:, COVARIANCE].reshape(-1, 6, 6)[:, range(3), range(3)].mean(axis=1)
        variances = np.add.reduceat(own, begins) / counts  # of NaN where any has none
        sigmas = np.where(np.isnan(variances), sigma, np.sqrt(variances))
        means = averages(values[:, DISTANCE if key.distance else POSITION], begins, sigmas)
        rotations = np.tile(np.eye(3), (len(values), 1, 1))
        rotations[turned] = se3.from_quat(values[turned, QUAT])
        oriented = np.logical_and.reduceat(turned, begins)
        # the chordal mean (Moakher 2002)
        rotations = se3.nearest_rotation(mean_of_each(rotations, begins, means.used))
        joints = joints + mean_of_each(steps, begins, means.used)
        since = (stamps - np.repeat(stamps[begins], counts)).astype(np.float64)
        times = stamps[begins] + np.rint(mean_of_each(since, begins, means.used)).astype(np.int64)
        for k, (begin, count) in enumerate(zip(begins.tolist(), counts.tolist(), strict=True)):
            number, used = int(numbers[begin]), means.used[begin : begin + count]
            left_out = count - int(np.count_nonzero(used))
            if left_out or not means.rests[k]:
                self._shaken = min(self._shaken, number)
            if not means.rests[k]:
                self.dropped[RESTLESS] += count
                continue
            if left_out:
                self.dropped[VIBRATING] += left_out
            yield from self._made(
                number,
                key,
                int(times[k]),
                values[begin : begin + count][used],
                position=means.values[k].copy(),  # a view would keep all stops
                rotation=rotations[k].copy() if oriented[k] else None,
                joints=joints[k].copy(),
                approach=motion.approach[begin].copy(),
                delay=1e-9 * delay_ns,
                spread=float(means.spreads[k]),
            )

    def _of_images(
        self, found: Matched, begins: NDArray[np.intp], joints: FloatArray
    ) -> Iterator[Numbered]:
        """Yield a sample of the images of each stop, of which one will be looked at."""
        key, numbers, stamps, values, motion, delay_ns = found
        ends = np.append(begins[1:], len(values))
        for k, (begin, end) in enumerate(zip(begins.tolist(), ends.tolist(), strict=True)):
            middle = (begin + end) // 2
            yield from self._made(
                int(numbers[begin]),
                key,
                int(stamps[middle]),
                values[middle : middle + 1],
                position=np.full(3, np.nan),
                joints=joints[k].copy(),
                approach=motion.approach[begin].copy(),
                delay=1e-9 * delay_ns,
                images=tuple(values[begin:end, 0].astype(int).tolist()),
            )

    def in_socket(self, place: str, stamps: Stamps, motion: Motion) -> None:
        """Make a sample of a ball that sits in a socket, at stamps (N,) while the arm stands."""
        steps = unwrapped(motion.joints - motion.joints[0], self._revolute)
        sample = Sample(
            stamp_ns=int(stamps[-1]),
            joints=motion.joints[0] + steps.mean(axis=0),
            approach=motion.approach[0].copy(),
            device=place,
            socket=True,
        )
        self.remember([sample])
        self.fresh.append(sample)

    def _made(
        self,
        number: int,
        key: StreamKey,
        stamp_ns: int,
        rows: FloatArray,
        position: FloatArray,
        **more: Any,
    ) -> Iterator[Numbered]:
        """Yield a sample of measurements (N, ROW_WIDTH), unless there is one or no room."""
        known = self._taken.setdefault(key, set())
        if stamp_ns in known:
            self.dropped['measurements: a pose with this stamp is there already'] += len(rows)
            return
        if len(known) >= self._capacity:
            self.dropped['measurements: the memory for poses is full'] += len(rows)
            return
        known.add(stamp_ns)
        covariance = None
        if not np.isnan(rows[:, COVARIANCE]).any():
            covariance = rows[:, COVARIANCE].mean(axis=0).reshape(6, 6)
        sample = Sample(
            stamp_ns=stamp_ns,
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

    def add(self, found: list[Numbered]) -> None:
        """Keep samples for who takes them, in the order of their rounds or stops."""
        found.sort(key=itemgetter(0))
        calm = sum(number < self._shaken for number, _ in found)
        if self._calm is None and calm < len(found):
            self._calm = len(self.fresh) + calm
        self._shaken = math.inf
        self.fresh += [sample for _, sample in found]

    def take(self) -> tuple[list[Sample], int]:
        """Return the samples made since the last call, and how many since a stop was restless."""
        fresh, calm = self.fresh, self._calm
        self.fresh, self._calm = [], None
        return fresh, 0 if calm is None else len(fresh) - calm

    @property
    def unrest(self) -> int:
        """Return how many measurements at stops were not at rest."""
        return self.dropped[VIBRATING] + self.dropped[RESTLESS]

    def has(self, key: StreamKey) -> bool:
        """Tell whether there is a sample of a stream."""
        return bool(self._taken.get(key))

    def remember(self, samples: Sequence[Sample]) -> None:
        """Make no other samples of the stamps of these."""
        for sample in samples:
            self._taken.setdefault(_key(sample), set()).add(sample.stamp_ns)

    def forget(self, sample: Sample) -> None:
        """Allow a sample of the same stamp again."""
        self._taken.get(_key(sample), set()).discard(sample.stamp_ns)


def _key(sample: Sample) -> StreamKey:
    return StreamKey(
        sample.device,
        sample.target,
        sample.validation,
        sample.distance is not None,
        sample.eye_in_hand,
        sample.frame_id,
        sample.view is not None,
    )
