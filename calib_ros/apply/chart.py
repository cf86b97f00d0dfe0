# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Does an arm get worse from night to night? A chart of verification errors.

A night's RMS error r with nu degrees of freedom is held against the pooled square s^2 of nights
before: r^2 / s^2 has an F distribution where nothing has changed, with nu and all of their degrees
of freedom, which makes it a normal variable z, independent of those before. Two cumulative sums
(CUSUM; Page 1954),

    S_0 = 0        S = max(0, S + z - k)

detect shifts of about 2 k: a small k slow changes, a large one jumps. S > h raises an alarm. The
mean number of nights until a false alarm follows from a discretised Markov chain of S (Brook and
Evans 1972); h is set from the wanted number of years between false alarms. Two charts per robot
double the rate of false alarms, so each gets half. Both restart after an alarm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import optimize, special

from calib_ros.errors import InputError
from calib_ros.kinematics.se3 import FloatArray

SLOPES = (0.5, 2.0)
"""References k: shifts of one and of four standard deviations show soonest."""


@dataclass(frozen=True, eq=False)
class Drift:
    """What a chart of one robot shows: nights of `alarms`, and the night `since` which, for each.

    `scores` (N,) are errors against those before as normal variables, NaN in the first night and
    in the first after an alarm; `sums` (N, 2) shares of the heights of both charts.
    """

    scores: FloatArray
    sums: FloatArray
    alarms: tuple[int, ...]
    since: tuple[int, ...]


def drift(rms: Sequence[float], freedom: Sequence[float], years: float) -> Drift:
    """Find the nights since which an arm is worse.

    Errors of the nights (N,) are in any unit, with their degrees of freedom (N,) as of
    `Verification.freedom`; `years` pass between two false alarms, with a night each day.
    """
    errors, nus = np.asarray(rms, dtype=float), np.asarray(freedom, dtype=float)
    if errors.shape != nus.shape or not (np.isfinite(errors) & (errors > 0.0) & (nus > 0.0)).all():
        raise InputError('errors and degrees of freedom of nights must be as many, and positive')
    limits = [limit(slope, len(SLOPES) * years * 365.25) for slope in SLOPES]
    scores, shares = np.full(len(errors), np.nan), np.zeros((len(errors), len(SLOPES)))
    alarms, since = [], []
    squares = known = 0.0
    sums, starts = np.zeros(len(SLOPES)), np.zeros(len(SLOPES), dtype=int)
    for night, (error, nu) in enumerate(zip(errors.tolist(), nus.tolist(), strict=True)):
        if known:
            ratio = error**2 / (squares / known)
            chance = max(float(special.fdtrc(nu, known, ratio)), 1e-300)
            scores[night] = -special.ndtri(chance)
            starts = np.where(sums > 0.0, starts, night)
            sums = np.maximum(0.0, sums + scores[night] - np.array(SLOPES))
            shares[night] = sums / limits
            if (shares[night] > 1.0).any():
                alarms.append(night)
                since.append(int(starts[np.argmax(shares[night])]))
                squares = known = 0.0
                sums[:] = 0.0
        squares, known = squares + nu * error**2, known + nu
    return Drift(scores, shares, tuple(alarms), tuple(since))


def run_length(slope: float, height: float, states: int = 200) -> float:
    """Return after how many normal values a one-sided CUSUM exceeds a height, on average.

    More states of the Markov chain change it by less than a hundredth (test_chart.py).
    """
    width = 2.0 * height / (2 * states - 1)
    middles = width * np.arange(states)
    upper = middles[np.newaxis] - middles[:, np.newaxis] + 0.5 * width + slope
    stays = special.ndtr(upper)
    stays[:, 1:] -= special.ndtr(upper[:, 1:] - width)
    return float(np.linalg.solve(np.eye(states) - stays, np.ones(states))[0])


@cache
def limit(slope: float, nights: float) -> float:
    """Return the height that a CUSUM exceeds after so many nights, on average, by chance."""

    def less(height: float) -> float:
        return float(np.log(run_length(slope, height) / nights))

    top = 1.0
    while less(top) < 0.0:  # not far beyond: run lengths grow by powers of the height
        top *= 2.0
    return float(optimize.brentq(less, 1e-3, top, xtol=1e-4))
