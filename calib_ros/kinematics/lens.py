# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The camera: from points in its frame to pixels, with derivatives.

A pinhole with the distortion of Brown (1971), `plumb_bob` in ROS: z looks forward, x to the right
and y down in the image. With x = X / Z, y = Y / Z and r^2 = x^2 + y^2

    u = cx + fx (x c + 2 p1 x y + p2 (r^2 + 2 x^2))        c = 1 + k1 r^2 + k2 r^4 + k3 r^6
    v = cy + fy (y c + p1 (r^2 + 2 y^2) + 2 p2 x y)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros.errors import ConfigError, InputError
from calib_ros.kinematics.parameter import LENS_KINDS
from calib_ros.kinematics.se3 import ROUNDING, ROUNDS, FloatArray
from calib_ros.values import SAME


@dataclass(frozen=True)
class Lens:
    """Focal lengths and centre [px], and distortion; `fixed` if they must not be fitted."""

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
        for kind in LENS_KINDS:
            if not np.isfinite(getattr(self, kind)):
                raise ConfigError(f'{kind} of a camera must be a finite number')
        if min(self.fx, self.fy) <= 0.0:
            raise ConfigError('fx and fy of a camera must be positive, as focal lengths [px] are')

    @property
    def values(self) -> dict[str, float]:
        """Return the parameters by their names."""
        return {kind: float(getattr(self, kind)) for kind in LENS_KINDS}

    def moved(self, offsets: Mapping[str, float]) -> Lens:
        """Return the lens with offsets added to its parameters.

        Focal lengths stay positive, so that a fit can recover.
        """
        added = {kind: getattr(self, kind) + offsets[kind] for kind in offsets}
        added |= {kind: max(added[kind], SAME) for kind in ('fx', 'fy') if kind in added}
        return replace(self, **added) if added else self

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return pixels (2, B) of points (3, B) [m], and their derivative (2, 3, B) [px/m].

        Points behind the camera appear at the side, so that a fit can recover.
        """
        inverse = 1.0 / np.maximum(points[2], SAME)
        x, y = points[0] * inverse, points[1] * inverse
        across, along, both = x * x, y * y, x * y
        square = across + along
        radial = 1.0 + square * (self.k1 + square * (self.k2 + square * self.k3))
        slope = 2.0 * self.k1 + square * (4.0 * self.k2 + square * (6.0 * self.k3))
        p1, p2 = 2.0 * self.p1, 2.0 * self.p2
        mixed = both * slope + (p1 * x + p2 * y)
        pixels = np.empty((2, len(x)))
        by_point = np.empty((2, 3, len(x)))
        pixels[0] = self.cx + self.fx * (
            x * radial + p1 * both + self.p2 * (square + 2.0 * across)
        )
        pixels[1] = self.cy + self.fy * (y * radial + p2 * both + self.p1 * (square + 2.0 * along))
        by_point[0, 0] = radial + across * slope + (p1 * y + 3.0 * p2 * x)
        by_point[1, 1] = radial + along * slope + (3.0 * p1 * y + p2 * x)
        by_point[0, 1] = by_point[1, 0] = mixed
        by_point[0, :2] *= self.fx * inverse
        by_point[1, :2] *= self.fy * inverse
        by_point[:, 2] = -(by_point[:, 0] * x + by_point[:, 1] * y)
        return pixels, by_point

    def by_lens(
        self, points: FloatArray, pixels: FloatArray, kinds: Sequence[str], out: FloatArray
    ) -> None:
        """Write the derivatives (K, 2, B) of the pixels of points by lens parameters."""
        if not kinds:
            return
        plane = points[:2] / np.maximum(points[2], SAME)
        across, along = plane * plane
        square = across + along
        focal = np.array([[self.fx], [self.fy]])
        both = 2.0 * focal * plane[0] * plane[1]
        rows = dict(zip(kinds, out, strict=True))
        radial = focal * plane
        for kind in ('k1', 'k2', 'k3'):
            radial *= square
            if kind in rows:
                rows[kind][:] = radial
        for kind, row in rows.items():
            if kind == 'p1':
                row[0], row[1] = both[0], self.fy * (square + 2.0 * along)
            elif kind == 'p2':
                row[0], row[1] = self.fx * (square + 2.0 * across), both[1]
            elif kind in ('fx', 'cx'):
                row[0], row[1] = (pixels[0] - self.cx) / self.fx if kind == 'fx' else 1.0, 0.0
            elif kind in ('fy', 'cy'):
                row[0], row[1] = 0.0, (pixels[1] - self.cy) / self.fy if kind == 'fy' else 1.0

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Return the points (N, 2) at depth 1 of pixels (N, 2), by Newton steps."""
        target = np.ascontiguousarray(pixels.T)
        points = np.ones((3, len(pixels)))
        points[0], points[1] = (target[0] - self.cx) / self.fx, (target[1] - self.cy) / self.fy
        for _ in range(ROUNDS):
            seen, ((a, b, _), (c, d, _)) = self.project(points)
            size = a * d - b * c
            turned = size <= 0.0  # beyond the edge of the polynomial
            u, v = (target - seen) / np.where(turned, 1.0, size)
            step = np.where(turned, 0.0, [d * u - b * v, a * v - c * u])
            points[:2] += step
            if np.abs(step).max(initial=0.0) < ROUNDING:
                break
        return np.asarray(points[:2].T)


def require_lens(lens: Lens | None, camera: str) -> Lens:
    """Return the lens of a camera, or raise InputError without one."""
    if lens is None:
        raise InputError(
            f'pixels need the intrinsics of their camera ({camera}): give them (--intrinsics FILE,'
            ' as camera_calibration writes it)'
        )
    return lens
