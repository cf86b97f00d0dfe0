# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Confidence intervals of an RMS error (docs/verification.md).

The sum of squares over K configurations with errors e_k is approximated by theta / nu chi2(nu)
(Satterthwaite 1946) with

    S = mean of e_k e_k^T        g = 2 tr S^2 / (tr S)^2        nu = 2 K / max(g, c^2)

c^2 is the variance of the squared errors over their squared mean, estimated with g for one more
configuration and raised by SAFETY standard deviations, because few configurations rarely include
the worst places.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import special

from calib_ros.decision.comparison import Comparison
from calib_ros.estimation.configurations import renumber
from calib_ros.estimation.levels import CONFIDENT
from calib_ros.kinematics.se3 import FloatArray, Index, norms
from calib_ros.values import SAME

SAFETY = 4.0
"""Intervals of 95 % then hold in 95 % if places differ (benchmarks/verification.py)."""


def rms_limits(
    rms: float, freedom: FloatArray, confidence: float
) -> tuple[FloatArray, FloatArray]:
    """Return the limits (N,) of the interval of an RMS with (N,) degrees of freedom.

    Beyond each limit lies half of what the interval may miss; the upper one may be inf, and is
    below one degree of freedom: fewer bound nothing.
    """
    with np.errstate(divide='ignore'):
        lower, upper = (
            rms / np.sqrt(special.chdtri(freedom, miss) / freedom)
            for miss in (0.5 - 0.5 * confidence, 0.5 + 0.5 * confidence)
        )
    return lower, np.where(freedom < 1.0, np.inf, upper)


def rms_interval(errors: FloatArray, group: Index, together: float = 1.0) -> tuple[float, float]:
    """Return the 95 % interval [m] of the RMS of errors (N, 3) over poses like these.

    Repeats in a configuration, by `group` (N,), share its error: those with shares w of the pairs
    tell as much as 1 / sum w^2 alike, and so many configurations as are `together` as one. With a
    single one the limits are (0, inf).
    """
    number = renumber(group)
    moments, shares = moments_of(errors, number), np.bincount(number) / len(number)
    if len(moments) < 2:
        return 0.0, np.inf
    rms = float(np.sqrt(np.mean(norms(errors) ** 2)))
    freedom = np.array([freedom_of(moments) / np.sum(shares**2) / together])
    lower, upper = rms_limits(rms, freedom, CONFIDENT)
    return float(lower[0]), float(upper[0])


@lru_cache(maxsize=4)  # fitted and judged, before and after: a report asks several times
def interval_of(which: Comparison, when: int) -> tuple[float, float]:
    """Return the 95 % interval [m] of the RMS before (0) or after (1), without outliers."""
    residuals, mask = (which.before, which.after)[when], which.deciding
    errors, numbers = residuals.position[mask], residuals.configurations[mask]
    return rms_interval(errors, numbers, which.together)


def freedom_of(moments: FloatArray) -> float:
    """Return the degrees of freedom per configuration, with moments (K, 3, 3)."""
    spread, count = moments.mean(axis=0), len(moments)
    squares = np.trace(moments, axis1=1, axis2=2)
    normal = 2.0 * np.trace(spread @ spread) / np.trace(spread) ** 2
    scatter = squares.var(ddof=1) / squares.mean() ** 2
    scatter = ((count - 1) * scatter + normal) / count
    scatter *= 1.0 + SAFETY * np.sqrt(scatter / count)
    return float(2.0 / max(normal, scatter))


def moments_of(errors: FloatArray, group: Index) -> FloatArray:
    """Return the mean of e e^T (K, 3, 3) [m^2] of errors (N, 3) [m] over each configuration."""
    sums = np.array([[np.bincount(group, a * b) for b in errors.T] for a in errors.T])
    sums /= np.bincount(group)
    return sums.transpose(2, 0, 1) + SAME**2 * np.eye(3)  # without noise


def limits_of(
    moments: FloatArray, lost: int, confidence: float, most: int = 0
) -> tuple[float, Index, FloatArray, FloatArray, FloatArray]:
    """Return the RMS error [m] of configurations with moments (K, 3, 3), each counted once.

    And for numbers (N,) of them, from K up to `most`, the freedom and limits. Fitted frames have
    absorbed the errors of `lost` ones. Of a single one the upper limit is inf.
    """
    rms, count = rms_of(moments, lost), len(moments)
    numbers = np.unique(np.geomspace(count, max(count, most), 200).round().astype(int))
    freedom = (freedom_of(moments) if count > 1 else 3.0) * (numbers - lost)  # or its coordinates
    lower, upper = rms_limits(rms, freedom, confidence)
    return rms, numbers, freedom, lower, np.where(numbers > 1, upper, np.inf)


def rms_of(moments: FloatArray, lost: int) -> float:
    """Return the RMS error [m] of configurations (K, 3, 3), of which fitted frames absorb some."""
    return float(np.sqrt(np.trace(moments.sum(axis=0)) / max(len(moments) - lost, 1)))
