# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The camera: from points in its frame to pixels, with derivatives.

A pinhole with the distortion of Brown (1971), as ROS names it `plumb_bob`: z looks forward, x to
the right and y down in the image. With x = X / Z, y = Y / Z and r^2 = x^2 + y^2

    u = cx + fx (x c + 2 p1 x y + p2 (r^2 + 2 x^2))        c = 1 + k1 r^2 + k2 r^4 + k3 r^6
    v = cy + fy (y c + p1 (r^2 + 2 y^2) + 2 p2 x y)

A camera is at one end of a chain, a board at the other. Moving and turning the board by a twist
(v, w) in the world moves a point of it by v + w x arm; a camera that moves sees the opposite.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros.errors import ConfigError, InputError
from calib_ros.kinematics.parameter import LENS_KINDS
from calib_ros.kinematics.se3 import FloatArray

NEAREST = 1e-6
"""Depth [m] up to which a point is taken to be in front of the camera."""


@dataclass(frozen=True)
class Lens:
    """Focal lengths and centre [px], and distortion; `fixed` when they must not be fitted."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    fixed: bool = True

    def __post_init__(self) -> None:
        """Refuse what no camera has."""
        for kind in LENS_KINDS:
            if not np.isfinite(getattr(self, kind)):
                raise ConfigError(f'{kind} of a camera must be a finite number')

    @property
    def values(self) -> dict[str, float]:
        """Return the parameters by their names."""
        return {kind: float(getattr(self, kind)) for kind in LENS_KINDS}

    def moved(self, offsets: Mapping[str, float]) -> Lens:
        """Return the lens with offsets added to its parameters."""
        added = {kind: getattr(self, kind) + offsets[kind] for kind in offsets}
        return replace(self, **added) if added else self

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return pixels (2, B) of points (3, B) [m], and their derivative (2, 3, B) [px/m].

        What is behind the camera is seen as at the side, so that a fit finds its way back.
        """
        depth = np.maximum(points[2], NEAREST)
        x, y = points[0] / depth, points[1] / depth
        square = x * x + y * y
        radial = 1.0 + square * (self.k1 + square * (self.k2 + square * self.k3))
        slope = 2.0 * (self.k1 + square * (2.0 * self.k2 + square * 3.0 * self.k3))
        both = x * y
        pixels = np.stack(
            [
                x * radial + 2.0 * self.p1 * both + self.p2 * (square + 2.0 * x * x),
                y * radial + self.p1 * (square + 2.0 * y * y) + 2.0 * self.p2 * both,
            ]
        )
        mixed = both * slope + 2.0 * (self.p1 * x + self.p2 * y)
        by_plane = np.array(
            [
                [radial + x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x, mixed],
                [mixed, radial + y * y * slope + 6.0 * self.p1 * y + 2.0 * self.p2 * x],
            ]
        )
        focal = np.array([self.fx, self.fy])[:, np.newaxis]
        by_plane *= focal[:, np.newaxis] / depth
        last = -(by_plane[:, 0] * x + by_plane[:, 1] * y)
        by_point = np.concatenate([by_plane, last[:, np.newaxis]], axis=1)
        return focal * pixels + np.array([[self.cx], [self.cy]]), by_point

    def by_lens(self, points: FloatArray, kinds: Sequence[str]) -> FloatArray:
        """Return the derivatives (K, 2, B) of pixels by parameters of the lens."""
        depth = np.maximum(points[2], NEAREST)
        x, y = points[0] / depth, points[1] / depth
        square = x * x + y * y
        plain = self.moved({'fx': 1.0 - self.fx, 'fy': 1.0 - self.fy})
        u, v = plain.moved({'cx': -self.cx, 'cy': -self.cy}).project(points)[0]
        zero, one = np.zeros_like(x), np.ones_like(x)
        both = 2.0 * x * y
        columns = {
            'fx': (u, zero),
            'fy': (zero, v),
            'cx': (one, zero),
            'cy': (zero, one),
            'p1': (self.fx * both, self.fy * (square + 2.0 * y * y)),
            'p2': (self.fx * (square + 2.0 * x * x), self.fy * both),
        }
        power = one
        for kind in ('k1', 'k2', 'k3'):
            power = power * square
            columns[kind] = (self.fx * x * power, self.fy * y * power)
        return np.array([columns[kind] for kind in kinds]).reshape(len(kinds), 2, len(x))

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Return (N, 2) the points at depth 1 of pixels (N, 2), by Newton steps."""
        centre, focal = np.array([self.cx, self.cy]), np.array([self.fx, self.fy])
        found = (pixels - centre) / focal
        for _ in range(20):
            points = np.concatenate([found, np.ones((len(found), 1))], axis=1).T
            seen, by_point = self.project(points)
            matrices = by_point[:, :2].transpose(2, 0, 1)
            turned = np.linalg.det(matrices) <= 0.0  # beyond the edge of the polynomial
            matrices[turned] = np.diag(focal)
            step = np.linalg.solve(matrices, (pixels - seen.T)[..., np.newaxis])[..., 0]
            found = found + np.where(turned[:, np.newaxis], 0.0, step)
            if np.abs(step).max(initial=0.0) < 1e-12:
                break
        return np.asarray(found)


@dataclass(frozen=True, eq=False)
class View:
    """Points of a board as a camera sees them.

    Attributes
    ----------
    points : (3, C)
        In the camera's frame [m].
    pixels : (2, C)
    by_twist : (6, 2, C)
        Derivative by the shift [m] and turn [rad] in the world of what is at the chain's end.

    """

    points: FloatArray
    pixels: FloatArray
    by_twist: FloatArray


def view(
    lens: Lens, axes: Sequence[FloatArray], origin: FloatArray, points: FloatArray, on_flange: bool
) -> View:
    """Return what a camera sees of points (3, C) of a board.

    Parameters
    ----------
    lens : Lens
        Of the camera.
    axes, origin : three (3, C), (3, C)
        Of what is at the end of the chain, for each point: the board in a camera that is the
        world, or with the camera `on_flange` the camera in a board that is the world.
    points : (3, C)
        In the frame of the board [m].
    on_flange : bool
        Where the camera is.

    """
    if on_flange:
        arm = points - origin
        inside = np.stack([(axis * arm).sum(axis=0) for axis in axes])
        pixels, by_point = lens.project(inside)
        along = -np.einsum('skc,kwc->swc', by_point, np.stack(axes))
    else:
        arm = axes[0] * points[0] + axes[1] * points[1] + axes[2] * points[2]
        inside = arm + origin
        pixels, along = lens.project(inside)
    by_twist = np.empty((6, *pixels.shape))
    by_twist[:3] = along.transpose(1, 0, 2)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        by_twist[3 + k] = arm[i] * along[:, j] - arm[j] * along[:, i]
    return View(inside, pixels, by_twist)


def at_the_board(seen: View, residual: FloatArray) -> FloatArray:
    """Return the shortest shifts (C, 3) [m] of points that pixel residuals (2, C) amount to."""
    along = seen.by_twist[:3].transpose(2, 1, 0)  # (C, 2, 3)
    square = along @ along.transpose(0, 2, 1)
    weights = np.linalg.solve(square, residual.T[..., np.newaxis])
    return np.asarray((along.transpose(0, 2, 1) @ weights)[..., 0])


def require_lens(lens: Lens | None, camera: str) -> Lens:
    """Return the lens of a camera, which pixels cannot be used without."""
    if lens is None:
        raise InputError(
            f'pixels need the intrinsics of their camera ({camera}): give them (--intrinsics FILE,'
            ' as camera_calibration writes it)'
        )
    return lens
