# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples of measurements and of the motion of the joints at their time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.interpolation import unwrapped
from calib_ros.sampling.rows import Stamps
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.slices import StreamKey
from calib_ros.sampling.stops import RestlessError, average
from calib_ros.sampling.track import Motion

DISTANCE, POSITION = slice(0, 1), slice(0, 3)
QUAT, COVARIANCE = slice(3, 7), slice(7, 43)
WIDTH = COVARIANCE.stop
VIBRATING = 'poses: still vibrating, or a spike'
RESTLESS = 'poses: a stop that spreads more than the noise'


class Maker:
    """Makes samples, no two of one stream with the same stamp.

    Parameters
    ----------
    revolute : (n,) bool
        True for the joints whose values are angles.
    capacity : int
        Samples that are made of one stream at most.

    """

    def __init__(self, revolute: NDArray[np.bool_], capacity: int) -> None:
        self._revolute, self._capacity = revolute, capacity
        self._taken: dict[StreamKey, set[int]] = {}
        self.fresh: list[Sample] = []
        """Samples that nobody has taken yet."""
        self.dropped: Counter[str] = Counter()

    def of_each(
        self, key: StreamKey, stamps: Stamps, values: FloatArray, motion: Motion, delay_ns: int
    ) -> None:
        """Make a sample of each of some measurements: values (N, WIDTH) at stamps (N,)."""
        oriented = ~np.isnan(values[:, QUAT.start])
        rotations = np.tile(np.eye(3), (len(values), 1, 1))
        rotations[oriented] = se3.from_quat(values[oriented, QUAT])
        for k, stamp_ns in enumerate(stamps.tolist()):
            self._add(
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

    def of_stop(
        self,
        key: StreamKey,
        stamps: Stamps,
        values: FloatArray,
        motion: Motion,
        delay_ns: int,
        sigma: float,
    ) -> None:
        """Make one sample of the measurements of a stop, which scatter by `sigma` [m]."""
        if key.images:
            self._of_images(key, stamps, values, motion, delay_ns)
            return
        oriented = not np.isnan(values[:, QUAT]).any()
        rotations = se3.from_quat(values[:, QUAT]) if oriented else None
        if not np.isnan(values[:, COVARIANCE]).any():
            own = values[:, COVARIANCE].reshape(-1, 6, 6)[:, range(3), range(3)]
            sigma = float(np.sqrt(own.mean()))
        try:
            mean = average(values[:, DISTANCE if key.distance else POSITION], rotations, sigma)
        except RestlessError:
            self.dropped[RESTLESS] += len(values)
            return
        left_out = int((~mean.used).sum())
        if left_out:
            self.dropped[VIBRATING] += left_out
        steps = unwrapped(motion.joints[mean.used] - motion.joints[0], self._revolute)
        self._add(
            key,
            int(stamps[0]) + round(float((stamps[mean.used] - stamps[0]).mean())),
            values[mean.used],
            position=mean.value,
            rotation=mean.rotation,
            joints=motion.joints[0] + steps.mean(axis=0),
            approach=motion.approach[0].copy(),  # a view would keep the whole stop
            delay=1e-9 * delay_ns,
            spread=mean.spread,
        )

    def _of_images(
        self, key: StreamKey, stamps: Stamps, values: FloatArray, motion: Motion, delay_ns: int
    ) -> None:
        """Make a sample of the images of a stop, of which one will be looked at."""
        middle = len(stamps) // 2
        steps = unwrapped(motion.joints - motion.joints[0], self._revolute)
        self._add(
            key,
            int(stamps[middle]),
            values[middle : middle + 1],
            position=np.full(3, np.nan),
            joints=motion.joints[0] + steps.mean(axis=0),
            approach=motion.approach[0].copy(),
            delay=1e-9 * delay_ns,
            images=tuple(values[:, 0].astype(int).tolist()),
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

    def _add(
        self, key: StreamKey, stamp_ns: int, rows: FloatArray, position: FloatArray, **more: Any
    ) -> None:
        """Add a sample of measurements (N, WIDTH), unless there is one or no room."""
        known = self._taken.setdefault(key, set())
        if stamp_ns in known:
            self.dropped['poses: a sample with this stamp is there already'] += len(rows)
            return
        if len(known) >= self._capacity:
            self.dropped['poses: the memory for samples is full'] += len(rows)
            return
        known.add(stamp_ns)
        covariance = None
        if not np.isnan(rows[:, COVARIANCE]).any():
            covariance = rows[:, COVARIANCE].mean(axis=0).reshape(6, 6)
        self.fresh.append(
            Sample(
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
        )

    def take(self) -> list[Sample]:
        """Return the samples made since the last call."""
        fresh, self.fresh = self.fresh, []
        return fresh

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
