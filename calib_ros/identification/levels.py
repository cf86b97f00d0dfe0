# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How sure claims are, in three steps, and what chance explains."""

from __future__ import annotations

from scipy import special

from calib_ros.kinematics.se3 import HALF_THE_DIGITS

CONFIDENT = 0.95
"""Of intervals, and of gains: one in twenty is allowed to be chance."""
CERTAIN = 0.99
"""Of what is held against a result, and where several tests are made."""
SURE = 0.999
"""Of what changes the model or the noise: hundreds of tests are made in the life of a cell."""
ALIKE = 1.5
"""Ratio of two RMS errors up to which they are of one size (benchmarks/recalibration.py)."""
NEARER = 0.3
"""Ratio of two errors from which what leaves the smaller one explains clearly more
(benchmarks/mistakes.py)."""
MOST_OUTLIERS = 0.35
"""Share of gross errors beyond which nothing is believed: half of the samples must tell the
rest."""
TELLING = 8
"""Values from which on their spread tells anything: it is known to a quarter, (2 n)^-1/2."""
KNOWN = 1.0 / HALF_THE_DIGITS
"""Degrees of freedom that are as good as infinite."""
SCALE = 1e-4
"""Standard deviation of a device's scale: trackers have 1e-5, cameras and motion capture 1e-3."""
UNUSUAL = 1.0 - special.ndtr(1.0)
"""Share of the devices that are out of scale: of a size that is right within a factor, those
beyond it."""
OUT_OF_SCALE = 25.0 * SCALE
"""Standard deviation of the scale of these, half of which are worse (within a factor of ten)."""
PRINTED = 5e-3
"""The same of a printed board."""


def chance_of(squares: float, rank: int, freedom: float) -> float:
    """Return the probability of squares as large in `rank` directions of noise alone.

    `freedom` are the degrees of freedom from which the size of the noise was estimated.
    """
    return float(special.fdtrc(rank, min(freedom, KNOWN), max(squares, 0.0) / rank))
