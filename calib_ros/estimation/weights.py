# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The distance of each sample, and its weight in a robust fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from calib_ros.estimation.leastsquares import STEP_TOLERANCE
from calib_ros.estimation.system import System
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray, norms

OUTLIER = 6.0
"""Distance [scale] beyond which a sample is named as an outlier, at half its weight; a convention
(Hampel 1974)."""
INNER, OUTER = OUTLIER - 1.0, OUTLIER + 1.0
"""Distances [scale] at which a sample begins to lose weight, and has none left. Of Gaussian
errors in three directions 2 of 100,000 lie beyond the first."""


def weights_of(distance: FloatArray, loss: str) -> FloatArray:
    """Return the weights (N,) of samples at distances (N,)."""
    if loss == 'none':
        return np.ones(len(distance))
    if loss == 'huber':
        return np.minimum(1.0, INNER / np.maximum(distance, 1e-12))
    return np.clip((OUTER - distance) / (OUTER - INNER), 0.0, 1.0)


def distances_of(chain: Chain, names: Sequence[str], system: System) -> tuple[FloatArray, ...]:
    """Return the distance (N,) of every sample, set by set."""
    share = max(1.0 - len(names) / system.rows, 0.1)  # residuals are shorter than errors
    found = []
    for samples in system.sets:
        largest = np.zeros(samples.count)
        for part, row in samples.misfits(chain):
            length = norms(part) / np.sqrt(share)
            known = ~np.isnan(length)
            if known.any():
                usual = np.sqrt(special.chdtri(part.shape[1], 0.5))  # median of standard normals
                scale = np.median(length[known]) / usual
                size = np.where(known, length, 0.0) / max(scale, STEP_TOLERANCE)  # else rounding
                largest = np.maximum(largest, size[row])
        found.append(largest)
    return tuple(found)
