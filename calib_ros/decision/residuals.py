# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Residuals of poses and their figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib_ros.estimation.observations import Observations
from calib_ros.estimation.pixels import seen_residuals
from calib_ros.estimation.samples import residual_arrays
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import Flags, FloatArray, Index, norms


@dataclass(frozen=True)
class ErrorFigures:
    """Figures of position errors over a set of poses."""

    count: int
    rms_mm: float
    mean_mm: float
    max_mm: float
    mean_plus_3_sigma_mm: float
    rms_mrad: float | None
    rms_px: float | None = None


@dataclass(frozen=True, eq=False)
class Residuals:
    """Measured minus predicted: position (N, 3) [m] and rotation vector (N, 3) [rad].

    Both in the world; the rotation is NaN where not measured. `configurations` (N,) are the
    configuration numbers. For board points the position is the shortest shift that explains the
    residual in `pixels` (N, 2), which are NaN otherwise.
    """

    position: FloatArray
    orientation: FloatArray
    configurations: Index
    pixels: FloatArray

    def figures(self, which: Flags) -> ErrorFigures:
        """Return RMS, mean and maximum over the pairs of a mask (N,)."""
        parts = self.orientation, self.pixels
        angle, away = (norms(part[which & ~np.isnan(part[:, 0])]) for part in parts)
        distance, angle = 1e3 * norms(self.position[which]), 1e3 * angle
        return ErrorFigures(
            len(distance),
            float(np.sqrt(np.mean(distance**2))),
            float(distance.mean()),
            float(distance.max()),
            float(distance.mean() + 3.0 * distance.std(ddof=int(len(distance) > 1))),
            float(np.sqrt(np.mean(angle**2))) if angle.size else None,
            float(np.sqrt(np.mean(away**2))) if away.size else None,
        )


def residuals(chain: Chain, observations: Observations) -> Residuals:
    """Return measured minus predicted for every pair, without what stamps that jitter explain."""
    pixels = np.full((len(observations), 2), np.nan)
    if observations.pixels is not None:
        pixels, position = seen_residuals(chain, observations)
        orientation = np.full((len(observations), 3), np.nan)
    else:
        position, orientation = residual_arrays(chain, observations)
    if position.shape[1] == 1:  # a distance
        position = np.pad(position, ((0, 0), (0, 2)))
    if observations.punctual is not None:
        both = np.hstack([position, np.nan_to_num(orientation)])
        both = np.einsum('nij,nj->ni', observations.punctual, both)
        position, orientation = both[:, :3], both[:, 3:] + 0.0 * orientation
    return Residuals(position, orientation, observations.configurations, pixels)


def by_axes(vectors: FloatArray, axes: FloatArray) -> FloatArray:
    """Return vectors (N, 3) along other axes (N, 3, 3)."""
    return np.asarray(np.einsum('nc,ncd->nd', vectors, axes))


def axes_of(chain: Chain, observations: Observations) -> FloatArray:
    """Return the axes (N, 3, 3) of the arm's base in those of the residuals."""
    base = chain.frame(observations.base).matrix[:3, :3]
    if not observations.seen:
        return np.broadcast_to(base, (len(observations), 3, 3))
    seen = chain.forward(
        observations.joints, observations.approach, observations.base, observations.tool
    )
    return np.asarray(np.swapaxes(seen[:, :3, :3], 1, 2) @ base)


def joined(
    pieces: Sequence[Residuals], configurations: Index, index: Index | None = None
) -> Residuals:
    """Return the residuals of all pieces, or those at an index (K,), with configurations (N,)."""

    def rows(name: str) -> FloatArray:
        found = np.concatenate([getattr(piece, name) for piece in pieces])
        if index is None or np.isnan(found[:, 0]).all():  # or nothing was measured
            return found
        return found.take(index, axis=0)

    return Residuals(rows('position'), rows('orientation'), configurations, rows('pixels'))
