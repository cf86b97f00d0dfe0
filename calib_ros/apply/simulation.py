# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A simulated robot cell: an arm with known errors, measured while it stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.identification.identifiability import structurally_independent
from calib_ros.identification.observations import Observations
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray


@dataclass(frozen=True)
class Cell:
    """How the simulated arm is made, moved and measured: m, rad, s, Hz."""

    length_error: float = 5e-4
    angle_error: float = 1e-3
    noise_position: float = 5e-5
    noise_orientation: float = 2e-4
    move: float = 1.0
    dwell: float = 0.5
    joint_rate: float = 100.0
    poses_per_dwell: int = 3


def faulty(chain: Chain, cell: Cell, rng: np.random.Generator) -> Chain:
    """Return a chain with normally distributed errors, and frames anywhere.

    Only parameters that are no gauge freedoms get errors, so that they can be compared with
    identified ones.
    """
    names = [
        name
        for name in structurally_independent(chain, chain.parameter_names)
        if Parameter(name).owner not in ('base', 'tool')
    ]
    sizes = [
        cell.length_error if Parameter(name).is_length else cell.angle_error for name in names
    ]
    offsets = dict(zip(names, rng.normal(scale=sizes), strict=True))
    return replace(
        chain.with_offsets(offsets), base=random_frame(rng, 2.0), tool=random_frame(rng, 0.2)
    )


def random_frame(rng: np.random.Generator, reach: float) -> Frame:
    """Return a frame turned anyhow, within `reach` [m] along each axis."""
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
) -> Observations:
    """Measure the poses of a chain at joint values (N, n) with normally distributed noise."""
    poses = chain.forward(joints)
    positions = poses[:, :3, 3] + rng.normal(scale=noise_position, size=(len(joints), 3))
    turns = se3.exp_rotation(rng.normal(scale=noise_orientation, size=(len(joints), 3)))
    return Observations.from_arrays(
        joints, positions, turns @ poses[:, :3, :3] if oriented else None
    )


def drive(
    configurations: FloatArray, cell: Cell, start_ns: int
) -> tuple[NDArray[np.int64], FloatArray, NDArray[np.int64]]:
    """Move an arm smoothly from one configuration (K, n) to the next, standing at each.

    Returns
    -------
    stamps_ns, joints : (M,), (M, n)
        Joint samples at the joint rate.
    pose_stamps_ns : (K * poses_per_dwell,)
        When the poses are measured, within the dwells.

    """
    period = cell.move + cell.dwell
    times = np.arange(0.0, period * len(configurations), 1.0 / cell.joint_rate)
    leg = np.minimum((times / period).astype(int), len(configurations) - 1)
    share = np.clip((times - leg * period - cell.dwell) / cell.move, 0.0, 1.0)
    share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    ahead = np.minimum(leg + 1, len(configurations) - 1)
    step = configurations[ahead] - configurations[leg]
    joints = configurations[leg] + share[:, None] * step
    within = cell.dwell * np.arange(1, cell.poses_per_dwell + 1) / (cell.poses_per_dwell + 1)
    pose_times = (np.arange(len(configurations))[:, None] * period + within).ravel()
    return _stamps(times, start_ns), joints, _stamps(pose_times, start_ns)


def _stamps(times: Sequence[float] | FloatArray, start_ns: int) -> NDArray[np.int64]:
    return start_ns + np.round(np.asarray(times) * 1e9).astype(np.int64)
