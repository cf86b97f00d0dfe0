# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fits that gross errors do not spoil, and whether chance explains the outliers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.levels import ALIKE, LEAST_ASIDE, NEARER, SURE
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.robust import Robust, reweighted, robust_fit
from calib_ros.estimation.system import System
from calib_ros.estimation.trimmed import squared_residuals, trimmed_start, trimmed_sum
from calib_ros.estimation.weights import INNER
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import ROUNDING

MANY = 100 * SOME_POSES
"""Samples that suffice to detect gross errors (benchmarks/end_to_end.py)."""
SUSPICIOUS = 1.2
"""Ratio of actual to expected residuals at which gross errors, or errors shared by a
configuration, may hide in them; a convention, which benchmarks/outliers.py does not tell from
1.5."""


def thorough_fit(chain: Chain, names: Sequence[str], system: System, loss: str) -> Robust:
    """Fit as `robust_fit`, then from the best half of the samples if that looks suspicious.

    More than MANY samples are thinned to choose between the two; all are fitted from there.
    """
    if system.count > MANY:
        few = thorough_fit(chain, names, system.spread(MANY), loss)
        return reweighted(few.fit.chain, names, system, loss, tolerance=0.1)
    first = robust_fit(chain, names, system, loss)
    suspicious = first.outliers.any() or first.fit.normal.rms(system) > SUSPICIOUS
    if loss != 'redescending' or not suspicious:
        return first
    second = reweighted(trimmed_start(chain, names, system), names, system, loss)
    sums = [trimmed_sum(robust.fit.chain, system) for robust in (first, second)]
    another = sums[0] > ALIKE**2 * sums[1]
    spare = system.rows - system.count_free(names)
    if another and chance_of_outliers(second, first.fit.chain, names, system, spare) < 1.0 - SURE:
        first = second
    return _with_explained(first, names, system)


def _with_explained(found: Robust, names: Sequence[str], system: System) -> Robust:
    """Return a fit with the samples left out, if that explains most of them at a small price.

    What the model lacks looks like gross errors at the only poses in a part of the joint range, if
    the others decide alone. Gross errors keep their residuals in any fit, or spoil the others':
    an arm that bends made these up to three times as large.
    """
    out = found.outliers
    if out.sum() < LEAST_ASIDE:
        return found
    plain = minimise(found.fit.chain, names, system)
    bounded = reweighted(plain.chain, names, system, 'huber')
    before, after = (squared_residuals(robust.fit.chain, system) for robust in (found, bounded))
    share = max(1.0 - system.count_free(names) / system.rows, ROUNDING)
    price = np.sqrt(after[~out].sum() / max(before[~out].sum(), ROUNDING)) / share
    left = price * np.sqrt(after / np.maximum(before, ROUNDING))
    if price > 1.0 / NEARER or np.median(left[out]) > NEARER:
        return found
    nearer = np.where(out & (left < NEARER), INNER, np.inf)
    return reweighted(bounded.fit.chain, names, system, found.loss, np.split(nearer, system.ends))


def chance_of_outliers(
    robust: Robust, near: Chain, names: Sequence[str], system: System, spare: int
) -> float:
    """Return the probability that a fit leaves so many samples out by chance, at most.

    The F test of a shift of each of them (Cook and Weisberg 1982), times the number of ways to
    choose them, with a tail bound (Chernoff 1952), because it may underflow. The fit to all, found
    from a chain `near` it, has `spare` equations beyond those that the parameters take.
    """
    out = int(robust.outliers.sum())
    if not out:
        return 0.0
    least = minimise(near, names, system, tolerance=1e-3).normal.cost
    share = robust.fit.normal.cost / max(least, 1e-300)
    shifts = 0.5 * system.rows * out / system.count
    left = 0.5 * spare - shifts
    if left <= 0.0 or share >= left / (left + shifts):
        return 1.0
    mean = left / (left + shifts)
    ways = -special.betaln(out + 1.0, system.count - out + 1.0) - np.log(system.count + 1.0)
    tail = left * np.log(max(share, 1e-300) / mean)
    tail += shifts * np.log((1.0 - share) / (1.0 - mean))
    return float(np.exp(min(tail + ways, 0.0)))
