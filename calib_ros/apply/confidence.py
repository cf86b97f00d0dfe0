# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Confidence limits of the RMS position error over poses like those measured.

The sum of squares over K configurations with errors e_k is approximated by theta / nu chi2(nu)
(Satterthwaite 1946) with

    S = mean of e_k e_k^T        g = 2 tr S^2 / (tr S)^2        nu = 2 K / max(g, c^2)

For Gaussian errors of equal size nu lies between K (g = 2: all errors in one direction) and 3 K
(isotropic). It is smaller if errors vary over the workspace, as under compliance and eccentricity:
c^2 is the variance of the squared errors over their squared mean, estimated with g for one more
configuration and raised by SAFETY standard deviations, because few configurations rarely include
the worst places. Measurements of one configuration share its error and count as one. Limits are
one-sided, each at the wanted confidence.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from calib_ros.kinematics.se3 import FloatArray, Index

SAFETY = 4.0
"""So many make limits of 95 % hold in 95 % where places differ (benchmarks/verification.py)."""


def rms_limits(
    rms: float, freedom: FloatArray, confidence: float
) -> tuple[FloatArray, FloatArray]:
    """Return the one-sided limits (N,) of an RMS found with (N,) degrees of freedom."""
    lower, upper = (
        rms / np.sqrt(special.chdtri(freedom, 1.0 - level) / freedom)
        for level in (confidence, 1.0 - confidence)
    )
    return lower, upper


def rms_interval(errors: FloatArray, group: Index, confidence: float) -> tuple[float, float]:
    """Return the one-sided limits [m] of the RMS of errors (N, 3) over poses like these.

    `group` (N,) are the configurations, of which each counts for one. With a single one nothing
    is known: (0, inf).
    """
    moments = moments_of(errors, np.unique(group, return_inverse=True)[1])
    if len(moments) < 2:
        return 0.0, np.inf
    rms = float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
    if rms == 0.0:
        return 0.0, 0.0
    freedom = np.array([freedom_of(moments) * len(moments)])
    lower, upper = rms_limits(rms, freedom, confidence)
    return float(lower[0]), float(upper[0])


def freedom_of(moments: FloatArray) -> float:
    """Return the degrees of freedom of one of the configurations with moments (K, 3, 3)."""
    spread, count = moments.mean(axis=0), len(moments)
    squares = np.trace(moments, axis1=1, axis2=2)
    normal = 2.0 * np.trace(spread @ spread) / np.trace(spread) ** 2
    scatter = squares.var(ddof=1) / squares.mean() ** 2
    scatter = ((count - 1) * scatter + normal) / count
    scatter *= 1.0 + SAFETY * np.sqrt(scatter / count)
    return float(2.0 / max(normal, scatter))


def moments_of(errors: FloatArray, group: Index) -> FloatArray:
    """Return the mean of e e^T (K, 3, 3) [m^2] of errors (N, 3) [m] over each configuration."""
    each = errors[:, :, np.newaxis] * errors[:, np.newaxis]
    sums = np.zeros((int(group.max()) + 1, 3, 3))
    np.add.at(sums, group, each)
    return sums / np.bincount(group)[:, np.newaxis, np.newaxis]
