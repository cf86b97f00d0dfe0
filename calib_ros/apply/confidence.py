# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Confidence intervals of an RMS error, and the verdict by them (docs/verification.md).

The sum of squares over K configurations with errors e_k is approximated by theta / nu chi2(nu)
(Satterthwaite 1946) with

    S = mean of e_k e_k^T        g = 2 tr S^2 / (tr S)^2        nu = 2 K / max(g, c^2)

c^2 is the variance of the squared errors over their squared mean, estimated with g for one more
configuration and raised by SAFETY standard deviations, because few configurations rarely include
the worst places. With the wanted RMS error as limit the verdict is

    PASS        the whole interval is within the limit
    FAIL        the whole interval is beyond it
    UNDECIDED   the limit lies in the interval: more poses are needed
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias

import numpy as np
from scipy import special

from calib_ros.decision import mistakes
from calib_ros.decision.comparison import Comparison, along_base, compare
from calib_ros.errors import MOST_ENTRIES
from calib_ros.estimation.configurations import renumber
from calib_ros.estimation.levels import CONFIDENT
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics.se3 import FloatArray, Index, norms
from calib_ros.settings import Settings
from calib_ros.values import SAME

Verdict: TypeAlias = Literal['PASS', 'FAIL', 'UNDECIDED', 'holds', 'does not hold', 'no verdict']
STANDS: dict[Verdict, Verdict] = {'PASS': 'holds', 'FAIL': 'does not hold'}
DECIDING = 10 * MOST_ENTRIES  # largest number of configurations reported as deciding
SAFETY = 4.0
"""Intervals of 95 % then hold in 95 % if places differ (benchmarks/verification.py)."""


def rms_limits(
    rms: float, freedom: FloatArray, confidence: float
) -> tuple[FloatArray, FloatArray]:
    """Return the limits (N,) of the interval of an RMS with (N,) degrees of freedom.

    Beyond each limit lies half of what the interval may miss; the upper one may be inf.
    """
    with np.errstate(divide='ignore'):
        lower, upper = (
            rms / np.sqrt(special.chdtri(freedom, miss) / freedom)
            for miss in (0.5 - 0.5 * confidence, 0.5 + 0.5 * confidence)
        )
    return lower, upper


def rms_interval(errors: FloatArray, group: Index) -> tuple[float, float]:
    """Return the 95 % interval [m] of the RMS of errors (N, 3) over poses like these.

    Repeats in a configuration, by `group` (N,), share its error: those with shares w of the pairs
    tell as much as 1 / sum w^2 alike. With a single one the limits are (0, inf).
    """
    number = renumber(group)
    moments, shares = moments_of(errors, number), np.bincount(number) / len(number)
    if len(moments) < 2:
        return 0.0, np.inf
    rms = float(np.sqrt(np.mean(norms(errors) ** 2)))
    freedom = np.array([freedom_of(moments) / np.sum(shares**2)])
    lower, upper = rms_limits(rms, freedom, CONFIDENT)
    return float(lower[0]), float(upper[0])


@lru_cache(maxsize=4)  # fitted and judged, before and after: a report asks several times
def interval_of(which: Comparison, when: int) -> tuple[float, float]:
    """Return the 95 % interval [m] of the RMS before (0) or after (1), without outliers."""
    residuals, mask = (which.before, which.after)[when], which.deciding
    return rms_interval(residuals.position[mask], residuals.configurations[mask])


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


def compared(limit: float, lower: float, upper: float) -> Literal['PASS', 'FAIL', 'UNDECIDED']:
    """Return the verdict on an RMS error by its interval."""
    return 'PASS' if upper <= limit else 'FAIL' if lower > limit else 'UNDECIDED'


@dataclass(frozen=True, eq=False, repr=False)
class Judgement:
    """Errors of new measurements before and after a correction, and the verdict."""

    comparison: Comparison
    """Residuals by the nominal and by the calibrated arm, along the axes of its base."""
    limit: float | None
    """The tolerance, or else the largest error [m] of a calibration that holds, if known."""
    confidence: float
    """Of the interval."""
    rms: float
    lower: float
    upper: float
    """RMS position error [m] over poses like these, and its interval."""
    freedom: float
    """Degrees of freedom of that error."""
    verdict: Verdict
    """Without a tolerance 'holds' and 'does not hold' instead of PASS and FAIL, or 'no verdict' if
    the former error is unknown; no verdict either if fitted measurements look good, or if a
    `mistake` explains them."""
    needed: int | None
    """Configurations that would decide with the same RMS error; None if not even DECIDING."""
    reused: float
    """Share of the measurements that the calibration was fitted to (`Calibration.reused`)."""
    mistake: mistakes.Diagnosis | None
    """What explains measurements that are further off than any arm."""

    @property
    def failed(self) -> bool:
        """Tell whether the error is beyond the limit."""
        return self.verdict in ('FAIL', 'does not hold')

    @property
    def group(self) -> Index:
        """Return the configuration (N,) of each measurement; `configurations` counts them."""
        return self.comparison.before.configurations

    @property
    def configurations(self) -> int:
        """Return the number of different configurations."""
        return int(self.group.max()) + 1


def judge(
    arm: Calibration,
    sets: Sequence[Observations],
    found: Comparison | None = None,
    tolerance: float | None = None,
    confidence: float = CONFIDENT,
    lost: int = 0,
    of_messages: bool = False,
) -> Judgement:
    """Judge a calibrated arm by its errors at new measurements, in its frames if not given.

    Each configuration counts once, however often it was measured; fitted frames have absorbed the
    errors of `lost` ones. Without a `tolerance` [m] the limit is that of the calibration. Remedies
    of a mistake are those of messages or of tables.
    """
    found = found or along_base(compare(arm.before, arm.chain, sets), arm.chain, sets)
    moments = moments_of(found.after.position, found.before.configurations)
    rms, numbers, freedom, lower, upper = limits_of(moments, lost, confidence, DECIDING)
    angle = 1e-3 * (found.figures[1].rms_mrad or 0.0)
    mistake = _mistake(arm, sets, rms, angle, of_messages)
    reused, limit = arm.reused(sets), tolerance or arm.limit(sets, found.figures[0].rms_mm)
    verdict: Verdict = 'no verdict'
    if limit is not None and not mistake:
        verdict = compared(limit, lower[0], upper[0])
        decided = numbers[(upper <= limit) | (lower > limit)]
    if reused and verdict != 'FAIL':
        verdict = 'no verdict'
    return Judgement(
        comparison=found,
        limit=limit,
        confidence=confidence,
        rms=rms,
        lower=float(lower[0]),
        upper=float(upper[0]),
        freedom=float(freedom[0]),
        verdict=STANDS.get(verdict, verdict) if tolerance is None else verdict,
        needed=None if verdict == 'no verdict' or not decided.size else int(decided[0]),
        reused=reused,
        mistake=mistake,
    )


def _mistake(
    arm: Calibration, sets: Sequence[Observations], error: float, angle: float, of_messages: bool
) -> mistakes.Diagnosis | None:
    if error <= Settings.largest_error and angle <= Settings.largest_angle:
        return None
    problem = Problem(arm.before, sets[0], more=sets[1:], of_messages=of_messages)
    found = mistakes.diagnose(problem, far=True) or mistakes.diagnose_alone(problem, arm.chain)
    known = error > Settings.largest_error or (found and found.alone)  # else positions fit
    return found if known else None
