# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A board in the images of a camera.

A camera is at one end of a chain, a board at the other. A twist (v, w) of the board in the world
moves a point of it by v + w x arm; a moving camera sees the opposite.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.se3 import FloatArray, Index, cross
from calib_ros.values import SAME


@dataclass(frozen=True, eq=False)
class Projection:
    """Points of a board in a camera.

    `points` and `arm` (3, C) [m] are in the camera's frame, from the camera and from the chain's
    end; `pixels` (2, C); `by_shift` (2, 3, C) is the derivative by a shift [m] of the chain's end,
    along the camera's axes; `axes` (3, 3, C) are those of a camera at the chain's end, in the
    world.
    """

    points: FloatArray
    arm: FloatArray
    pixels: FloatArray
    by_shift: FloatArray
    axes: FloatArray | None

    def by_twist(self, out: FloatArray) -> None:
        """Write the derivatives (6, 2, C) by shift [m] and turn [rad] along the camera's axes."""
        out[:3] = self.by_shift.transpose(1, 0, 2)
        cross(self.arm, self.by_shift, out[3:].transpose(1, 0, 2))

    def at_the_board(self, residual: FloatArray) -> FloatArray:
        """Return the shortest shifts (C, 3) [m] in the world for residuals (2, C).

        Points behind the camera shift along the one direction in which it sees them.
        """
        length = np.linalg.norm(self.by_shift, axis=1)
        first, second = self.by_shift / length[:, np.newaxis]
        u, v = residual / length
        mixed = (first * second).sum(axis=0)
        scale = 1.0 / np.maximum(1.0 - mixed * mixed, SAME)
        shift = first * ((u - mixed * v) * scale) + second * ((v - mixed * u) * scale)
        if self.axes is not None:
            shift = np.einsum('kcn,kn->cn', self.axes, shift)
        return np.asarray(shift.T)


def view(
    lens: Lens,
    axes: FloatArray,
    origin: FloatArray,
    owner: Index,
    points: FloatArray,
    on_flange: bool,
) -> Projection:
    """Return the view of points (3, C) [m] of a board in some images, `owner` (C,) of the points.

    `axes` (3, 3, M) and `origin` (3, M) are those of the end of the chain, for each image: the
    board in a camera that is the world, or with the camera `on_flange` the camera in a board that
    is the world. The first index counts the axes.
    """
    placed = np.concatenate([axes.reshape(9, -1), origin]).take(owner, axis=1)
    turned = placed[:9].reshape(3, 3, -1)
    if on_flange:
        inside = np.einsum('kcn,cn->kn', turned, points - placed[9:])
        pixels, by_point = lens.project(inside)
        return Projection(inside, inside, pixels, -by_point, turned)
    arm = np.einsum('kcn,kn->cn', turned, points)
    inside = arm + placed[9:]
    pixels, by_point = lens.project(inside)
    return Projection(inside, arm, pixels, by_point, None)
