# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Levels of confidence, thresholds by convention, and chance."""

from __future__ import annotations

from scipy import special

from calib_ros.kinematics.parameter import IN_A_FRAME
from calib_ros.kinematics.se3 import HALF_THE_DIGITS

CONFIDENT = 0.95
"""Confidence of intervals and gains: one in twenty may be chance. A convention, as all three
are."""
CERTAIN = 0.99  # confidence of evidence against a result, and of several tests
SURE = 0.999
"""Confidence of changes of model or noise: the life of a cell makes hundreds of tests."""
ALIKE = 1.5
"""Ratio of RMS errors that count as equal; a convention (benchmarks/recalibration.py does not tell
it from 1)."""
NEARER = 0.3
"""Ratio of two errors at which the smaller one counts as a clearly better explanation
(benchmarks/mistakes.py)."""
CLEARLY = 5.0
"""Ratio of two sizes that clearly differ: distances of configurations and of visits to one,
steps of rounding, rest of orientations and of positions: 9 make an arm 2.8 times worse, 30
eight times (docs/mistakes.md)."""
MOST_OUTLIERS = 0.35
"""Share of gross errors beyond which nothing is accepted: most samples must support the fit. A fit
withstands 40 % (benchmarks/outliers.py)."""
TELLING = 8  # values needed for a spread: known to a quarter, (2 n)^-1/2
FEW = TELLING // 2  # values without which nothing is known of a spread: to a third
LEAST_ASIDE = 1 + IN_A_FRAME // 3
"""Stops or rows before and after a single event: the freedoms of a frame explain the positions of
fewer, which are gross errors."""
SEVERAL = 3
"""Causes searched for one after the other: changes of an arm, simultaneous mistakes, harmonics. A
convention: benchmarks/recalibration.py changes one, mistakes.py makes three, and the errors of
real_robots.py are the same with 1."""
TRIED = 2 * SEVERAL
"""Best candidates of a rough search that are examined closely (benchmarks/mistakes.py)."""
KNOWN = 1.0 / HALF_THE_DIGITS  # degrees of freedom that count as infinite
SCALE = 1e-4
"""Standard deviation of a device's scale: trackers have 1e-5, cameras and motion capture 1e-3
(assumed)."""
UNUSUAL = 1.0 - special.ndtr(1.0)
"""Share of devices out of scale: beyond one standard deviation."""
LARGEST_SCALE = 10.0 * SCALE
"""More than any arm grows: by 40 degrees, if all aluminium (23 ppm a degree)."""
OUT_OF_SCALE = 25.0 * SCALE
"""Standard deviation of the scale of these; half are worse (within a factor of ten)."""
PRINTED = 5e-3  # scale of a printed board (assumed): 1 mm of 200


def chance_of(squares: float, rank: int, freedom: float) -> float:
    """Return the probability of such squares in `rank` directions, or one, by noise alone.

    `freedom` are the degrees of freedom of the noise estimate.
    """
    rank = max(rank, 1)
    return float(special.fdtrc(rank, min(freedom, KNOWN), max(squares, 0.0) / rank))
