# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Confidence of claims, in three levels, and what chance explains."""

from __future__ import annotations

from scipy import special

from calib_ros.kinematics.parameter import IN_A_FRAME
from calib_ros.kinematics.se3 import HALF_THE_DIGITS

CONFIDENT = 0.95
"""Of intervals, and of gains: one in twenty is allowed to be chance. A convention, as all three
are."""
INTERVAL = 0.5 + 0.5 * CONFIDENT
"""One-sided confidence of each limit of an interval."""
CERTAIN = 0.99
"""Of what is held against a result, and where several tests are made."""
SURE = 0.999
"""Of what changes the model or the noise: hundreds of tests are made in the life of a cell."""
ALIKE = 1.5
"""Ratio of two RMS errors up to which they are of one size; a convention, which
benchmarks/recalibration.py does not tell from 1."""
NEARER = 0.3
"""Ratio of two errors from which what leaves the smaller one explains clearly more
(benchmarks/mistakes.py)."""
CLEARLY = 5.0
"""Ratio of two sizes from which on they are clearly two: distances of configurations and of the
visits of one, steps of rounding, what is left of orientations and of positions: 9 make an arm 2.8
times worse, 30 eight times (docs/mistakes.md)."""
MOST_OUTLIERS = 0.35
"""Share of gross errors beyond which nothing is believed: half of the samples must tell the
rest. A fit stands 40 % (benchmarks/outliers.py)."""
TELLING = 8
"""Values from which on their spread tells anything: it is known to a quarter, (2 n)^-1/2."""
FEW = TELLING // 2
"""Values with fewer of which nothing can be said about their spread: it is known to a third."""
LEAST_ASIDE = 1 + IN_A_FRAME // 3
"""Stops or rows before and after what happened once: the freedoms of a frame explain the positions
of fewer, which are gross errors."""
SEVERAL = 3
"""Causes that are looked for one after the other: what needs more is something else. Changes of an
arm, mistakes at once, and harmonics, before all of them are tried. A convention:
benchmarks/recalibration.py changes one, mistakes.py makes three, and errors of real_robots.py are
the same with 1."""
TRIED = 2 * SEVERAL
"""Candidates, the best by a rough look, that are looked at closely (benchmarks/mistakes.py)."""
KNOWN = 1.0 / HALF_THE_DIGITS
"""Degrees of freedom that are as good as infinite."""
SCALE = 1e-4
"""Standard deviation of a device's scale: trackers have 1e-5, cameras and motion capture 1e-3
(assumed)."""
UNUSUAL = 1.0 - special.ndtr(1.0)
"""Share of the devices that are out of scale: of a size that is right within a factor, those
beyond it."""
OUT_OF_SCALE = 25.0 * SCALE
"""Standard deviation of the scale of these, half of which are worse (within a factor of ten)."""
PRINTED = 5e-3
"""The same of a printed board (assumed): 1 mm of 200."""


def chance_of(squares: float, rank: int, freedom: float) -> float:
    """Return the probability of squares as large in `rank` directions of noise alone.

    `freedom` are the degrees of freedom from which the size of the noise was estimated.
    """
    return float(special.fdtrc(rank, min(freedom, KNOWN), max(squares, 0.0) / rank))
