# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A chart of nights: the growth of an RMS error from one to the next (docs/history.md).

The RMS error r of one, with nu degrees of freedom, is compared with the pooled
square s^2 of earlier nights. If nothing has changed r^2 / s^2 has an F distribution, which makes
it a normal variable z, independent of earlier ones. Two cumulative sums (CUSUM; Page 1954),

    S_0 = 0        S = max(0, S + z - k)

detect shifts of about 2 k: a small k slow changes, a large one jumps. S > h raises an alarm. The
mean number of nights until a false alarm follows from a discretised Markov chain of S (Brook and
Evans 1972); each chart gets half of the wanted rate. Both restart after an alarm, and where errors
have fallen as clearly, as after a new calibration: the same sums of -z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import special

from calib_ros.errors import InputError
from calib_ros.kinematics.se3 import FloatArray

SLOPES = (0.5, 2.0)
"""References k of both charts, by Page (1954) half of the shifts to detect soonest: of one and
four standard deviations."""


@dataclass(frozen=True, eq=False)
class Drift:
    """Result of a chart of one robot: nights of `alarms`, and the night `since` which, for each.

    `sums` (N, 2) are shares of the heights of both charts.
    """

    sums: FloatArray
    alarms: tuple[int, ...]
    since: tuple[int, ...]


def drift(rms: Sequence[float], freedom: Sequence[float], years: float) -> Drift:
    """Find the nights since which an arm is worse.

    Errors of the nights (N,) are in any unit, with their degrees of freedom (N,) as in
    `Verification.freedom`; `years` pass between two false alarms, with a night each day.
    """
    errors, nus = np.asarray(rms, dtype=float), np.asarray(freedom, dtype=float)
    if errors.shape != nus.shape or not (np.isfinite(errors) & (errors > 0.0) & (nus > 0.0)).all():
        raise InputError('errors and degrees of freedom of nights must be as many, and positive')
    limits = [limit(slope, len(SLOPES) * years * 365.25) for slope in SLOPES]
    shares = np.zeros((len(errors), len(SLOPES)))
    alarms, since = [], []
    squares = known = 0.0
    sums, fallen = np.zeros(len(SLOPES)), np.zeros(len(SLOPES))
    starts = np.zeros(len(SLOPES), dtype=int)
    for night, (error, nu) in enumerate(zip(errors.tolist(), nus.tolist(), strict=True)):
        if known:
            ratio = error**2 / (squares / known)
            z = -special.ndtri(max(float(special.fdtrc(nu, known, ratio)), 1e-300))
            starts = np.where(sums > 0.0, starts, night)
            sums = np.maximum(0.0, sums + z - np.array(SLOPES))
            fallen = np.maximum(0.0, fallen - z - np.array(SLOPES))
            shares[night] = sums / limits
            if grown := bool((sums > limits).any()):
                alarms.append(night)
                since.append(int(starts[np.argmax(shares[night])]))
            better = bool((fallen > limits).any())
            if grown or better:
                squares = known = 0.0
                sums[:] = fallen[:] = 0.0
            if better:  # a night chosen for its small error would make later ones large
                continue
        squares, known = squares + nu * error**2, known + nu
    return Drift(shares, tuple(alarms), tuple(since))


def run_length(slope: float, height: float) -> float:
    """Return the mean number of normal values until a one-sided CUSUM exceeds a height.

    More states change it by less than a hundredth (test_chart.py).
    """
    states = 200  # of the Markov chain
    width = 2.0 * height / (2 * states - 1)
    middles = width * np.arange(states)
    upper = middles[np.newaxis] - middles[:, np.newaxis] + 0.5 * width + slope
    stays = special.ndtr(upper)
    stays[:, 1:] -= special.ndtr(upper[:, 1:] - width)
    return float(np.linalg.solve(np.eye(states) - stays, np.ones(states))[0])


@cache
def limit(slope: float, nights: float) -> float:
    """Return the height that a CUSUM exceeds by chance after so many nights on average."""
    from scipy import optimize  # slow to import, rarely needed

    def less(height: float) -> float:
        return float(np.log(run_length(slope, height) / nights))

    top = 1.0
    while less(top) < 0.0:  # run lengths grow exponentially with the height
        top *= 2.0
    return float(optimize.brentq(less, 1e-3, top, xtol=1e-4))
