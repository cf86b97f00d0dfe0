# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A simulated robot cell: an arm with known errors, measured while it stands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.estimation.identifiability import structurally_independent
from calib_ros.estimation.observations import Observations
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray


@dataclass(frozen=True)
class Cell:
    """Arm, motion and measurement of a simulated cell: m, rad, s, Hz."""

    length_error: float = 5e-4
    angle_error: float = 1e-3
    noise_position: float = 5e-5
    noise_orientation: float = 2e-4
    move: float = 1.0
    dwell: float = 0.5
    joint_rate: float = 100.0
    poses_per_dwell: int = 3


def faulty(chain: Chain, cell: Cell, rng: np.random.Generator) -> Chain:
    """Return a chain with normally distributed errors, and arbitrary frames.

    Gauge freedoms get no errors, so that errors can be compared with identified ones.
    """
    independent = structurally_independent(chain, chain.parameter_names)
    names = [Parameter(name) for name in independent if not chain.owns_frame(name)]
    sizes = [cell.length_error if each.is_length else cell.angle_error for each in names]
    offsets = dict(zip(names, rng.normal(scale=sizes), strict=True))
    return replace(
        chain.with_offsets(offsets), base=random_frame(rng, 2.0), tool=random_frame(rng, 0.2)
    )


def random_frame(rng: np.random.Generator, reach: float) -> Frame:
    """Return a randomly turned frame, within `reach` [m] along each axis."""
    quat = rng.normal(size=4)
    rotation = se3.from_quat(quat / np.linalg.norm(quat))
    return Frame(se3.transform(rotation, rng.uniform(-reach, reach, 3)))


def measure(
    chain: Chain,
    joints: FloatArray,
    rng: np.random.Generator,
    noise_position: float = 0.0,
    noise_orientation: float = 0.0,
    oriented: bool = True,
    approach: FloatArray | None = None,
) -> Observations:
    """Measure the poses of a chain at joint values (N, n) with Gaussian noise.

    `approach` (N, n) holds the signs of the preceding moves, for backlash.
    """
    poses = chain.forward(joints, approach)
    positions = poses[:, :3, 3] + rng.normal(scale=noise_position, size=(len(joints), 3))
    turns = se3.exp_rotation(rng.normal(scale=noise_orientation, size=(len(joints), 3)))
    return Observations.from_arrays(
        joints, positions, turns @ poses[:, :3, :3] if oriented else None
    )


def motion(
    configurations: FloatArray, move: float, dwell: float
) -> Callable[[FloatArray], FloatArray]:
    """Return a function of times (N,) [s]: joint values (N, n) along configurations (K, n).

    The arm stands there for `dwell` [s], and moves smoothly to the next one in `move` [s].
    """
    period, last = move + dwell, len(configurations) - 1

    def joints(times: FloatArray) -> FloatArray:
        leg = np.clip((np.asarray(times) / period).astype(int), 0, last)
        share = np.clip((times - leg * period - dwell) / move, 0.0, 1.0)[:, np.newaxis]
        share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        step = configurations[np.minimum(leg + 1, last)] - configurations[leg]
        return np.asarray(configurations[leg] + share * step)

    return joints


def drive(
    configurations: FloatArray, cell: Cell, start_ns: int
) -> tuple[NDArray[np.int64], FloatArray, NDArray[np.int64]]:
    """Move an arm smoothly from one configuration (K, n) to the next, standing at each.

    Returns stamps (M,) [ns] and joint values (M, n) at the joint rate, and the stamps
    (K * poses_per_dwell,) [ns] of the poses, within the stops.
    """
    period = cell.move + cell.dwell
    times = np.arange(0.0, period * len(configurations), 1.0 / cell.joint_rate)
    joints = motion(configurations, cell.move, cell.dwell)(times)
    within = cell.dwell * np.arange(1, cell.poses_per_dwell + 1) / (cell.poses_per_dwell + 1)
    pose_times = (np.arange(len(configurations))[:, None] * period + within).ravel()
    stamps, pose_stamps = (
        start_ns + np.round(each * 1e9).astype(np.int64) for each in (times, pose_times)
    )
    return stamps, joints, pose_stamps
