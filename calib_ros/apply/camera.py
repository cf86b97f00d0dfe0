# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A simulated camera, which photographs boards."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from calib_ros.apply.simulation import random_frame
from calib_ros.errors import InputError
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.pixels import seen_residuals
from calib_ros.kinematics import inverse, se3
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.se3 import FloatArray


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
