# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A simulated robot cell: an arm with known errors, measured while it stands."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import InputError
from calib_ros.estimation.identifiability import structurally_independent
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.pixels import seen_residuals
from calib_ros.kinematics import inverse, se3
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.lens import Lens
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


@dataclass(frozen=True)
class Camera:
    """A camera, and boards held up to `tilt` from facing it: px, m, rad."""

    lens: Lens = field(
        default=Lens(1350.0, 1355.0, 795.0, 605.0, -0.12, 0.15, 0.001, -0.001, -0.05)
    )
    width: int = 1600
    height: int = 1200
    depth: float = 0.7
    tilt: float = 0.7


def before_camera(
    chain: Chain, camera: Camera, points: FloatArray, on_flange: bool, rng: np.random.Generator
) -> Chain:
    """Return the chain with frames that let a camera see a board in reach of the arm.

    Camera or board is on the flange; the board has `points` (M, 3) [m].
    """
    mounted = random_frame(rng, 0.1).matrix
    bare = replace(chain, base=Frame(), tool=Frame())
    held = bare.forward(chain.random_joints(1, rng))[0] @ mounted
    seen = _facing(camera, points, 1, rng)[0]
    base = se3.invert(held @ seen) if on_flange else seen @ se3.invert(held)
    lens = camera.lens
    return replace(
        chain,
        base=Frame(base, lens=None if on_flange else lens),
        tool=Frame(mounted, lens=lens if on_flange else None),
    )


def photograph(
    chain: Chain,
    camera: Camera,
    points: FloatArray,
    on_flange: bool,
    count: int,
    rng: np.random.Generator,
    noise: float = 0.0,
    tries: int = 2000,
) -> Observations:
    """Return images of all points (M, 3) of a board, with Gaussian noise [px].

    The board faces the camera from anywhere in its view, with random joint values. After `tries`
    it counts as out of reach.
    """
    size = len(points)
    joints = np.zeros((0, len(chain.joints)))
    exact = np.zeros((0, size, 2))
    for _ in range(0, tries, count):
        if len(joints) == count:
            break
        wanted = _facing(camera, points, count, rng)
        if on_flange:
            wanted = se3.invert(wanted)
        found = inverse.solve(chain, wanted, chain.random_joints(count, rng))
        drawn = found.joints[found.converged]
        number = np.repeat(np.arange(len(drawn)), size)
        rows = Observations.from_pixels(
            drawn[number],
            np.zeros((len(number), 2)),
            np.tile(points, (len(drawn), 1)),
            number,
            on_flange,
        )
        pixels = -seen_residuals(chain, rows)[0].reshape(len(drawn), size, 2)
        good = ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(axis=(1, 2))
        joints = np.concatenate([joints, drawn[good]])[:count]
        exact = np.concatenate([exact, pixels[good]])[:count]
    if len(joints) < count:
        raise InputError(
            f'of {tries} places before the camera the arm reaches {len(joints)}, expected'
            f' {count}: place the camera elsewhere'
        )
    number = np.repeat(np.arange(count), size)
    pixels = exact.reshape(-1, 2) + rng.normal(scale=noise, size=(count * size, 2))
    return Observations.from_pixels(
        joints[number], pixels, np.tile(points, (count, 1)), number, on_flange
    )


def _facing(
    camera: Camera, points: FloatArray, count: int, rng: np.random.Generator
) -> FloatArray:
    """Return poses (count, 4, 4) of a board facing a camera, randomly turned."""
    depth = camera.depth * rng.uniform(0.7, 1.3, count)
    aside = rng.uniform(-0.25, 0.25, (count, 2)) * depth[:, np.newaxis]
    tilts = np.column_stack([rng.uniform(-camera.tilt, camera.tilt, (count, 2)), np.zeros(count)])
    turns = np.column_stack([np.zeros((count, 2)), rng.uniform(-np.pi, np.pi, count)])
    turned = se3.exp_rotation(tilts) @ se3.exp_rotation(turns)
    middle = np.column_stack([aside, depth])
    return se3.transform(turned, middle - turned @ points.mean(axis=0))


def drive(
    configurations: FloatArray, cell: Cell, start_ns: int
) -> tuple[NDArray[np.int64], FloatArray, NDArray[np.int64]]:
    """Move an arm smoothly from one configuration (K, n) to the next, standing at each.

    Returns stamps (M,) [ns] and joint values (M, n) at the joint rate, and the stamps
    (K * poses_per_dwell,) [ns] of the poses, within the stops.
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
    stamps, pose_stamps = (
        start_ns + np.round(each * 1e9).astype(np.int64) for each in (times, pose_times)
    )
    return stamps, joints, pose_stamps
