# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Weighted nonlinear least squares on the pose residuals.

Samples are visited in blocks that fit the cache. A block adds to the normal matrix, which has the
residual as its last row and column, so memory does not grow with the number of samples. The rank
is found from a triangular factor of the Jacobian (QR, block by block), because the normal matrix
squares its condition number; so is the covariance, unless that matrix is well conditioned.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib_ros.estimation.levels import SEVERAL
from calib_ros.estimation.normal import Folds, Normal, normal_equations, products_of, solved_step
from calib_ros.estimation.system import System
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, ROUNDING, ROUNDS, FloatArray
from calib_ros.settings import EXACT
from calib_ros.shown import Shown

STEP_TOLERANCE = 1e-6
"""Convergence: the RMS step of the predictions in sigma or, if larger, in RMS residuals. A
thousandth of the uncertainty with a million rows."""
PATIENCE = SEVERAL  # successive steps that may raise the cost before steps are damped
SMALL_STEP = math.sqrt(EXACT)
"""Step [m or rad] whose second-order error, half its square, is negligible."""


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Shown):
    """The chain at the minimum, and the normal equations, linearised before the last step.

    `next_step_rms` is the RMS step of the predictions (as `STEP_TOLERANCE`) to expect next: at
    most the last one, or ten times as much as if it were as much shorter again.
    """

    chain: Chain
    normal: Normal
    converged: bool
    next_step_rms: float = 0.0


def minimise(
    chain: Chain,
    names: Sequence[str],
    system: System,
    tolerance: float = STEP_TOLERANCE,
    iterations: int = 1000,
) -> Fit:
    """Fit the named parameters, relinearising until the step vanishes.

    Gauss-Newton with columns scaled to unit length. A step may raise the cost for a moment, as it
    must to get through a curved valley (watchdog; Chamberlain et al. 1982). If PATIENCE steps have
    not brought it far enough below the best (Armijo 1966), as if they oscillate, the fit returns
    there and damps its steps (Levenberg 1944, Marquardt 1963) by the ratio of actual to predicted
    gain (Nielsen 1999). It has converged when the undamped step vanishes. It ends without
    convergence after ROUNDS iterations without progress (a thousandth of the cost, or half of the
    remaining step), when numbers overflow, or after `iterations`; curved valleys need 400.
    """
    normal = normal_equations(chain, names, system)
    if not names:
        return Fit(chain, normal, True)
    best, best_chain = normal, chain
    damping, growth, patience, expected, last = 0.0, 2.0, PATIENCE, 0.0, 0.0
    iteration, stalled, least_cost, least_left = 0, 0, np.inf, np.inf
    while iteration < iterations and stalled < ROUNDS:
        iteration += 1
        step, left, settled = _next(normal, system, tolerance, damping)
        if not np.isfinite(step).all():
            break
        chain = chain.with_offsets(dict(zip(names, step, strict=True)))
        if settled:
            left = min(left, 10.0 * left**2 / (last or left or 1.0))
            return Fit(chain, normal.after(step), True, left)
        stalled, last = stalled + 1, left
        if best.cost < 0.999 * least_cost or left < 0.5 * least_left:
            stalled, least_cost, least_left = 0, best.cost, min(left, least_left)
        predicted = float(step @ (2.0 * normal.gradient - normal.matrix @ step))
        expected = predicted if normal is best else expected
        normal = normal_equations(chain, names, system)
        gain = best.cost - normal.cost
        if gain >= -ROUNDING * best.cost:
            best, best_chain, growth = normal, chain, 2.0
            if damping > ROUNDING:
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain / predicted - 1.0) ** 3)
            elif gain > 1e-4 * expected:
                damping, patience = 0.0, PATIENCE
            elif patience > 0:
                patience -= 1
            else:
                damping = HALF_THE_DIGITS
        elif patience > 0 and np.isfinite(normal.cost):
            patience -= 1
        elif damping > 1e12:  # nothing lowers the cost
            break
        else:
            normal, chain = best, best_chain
            patience = 0
            damping, growth = max(growth * damping, HALF_THE_DIGITS), 2.0 * growth
    return Fit(best_chain, best, False)


def _next(
    normal: Normal, system: System, tolerance: float, damping: float
) -> tuple[FloatArray, float, bool]:
    """Return the next step, the RMS move of predictions by the undamped step, and convergence."""
    step = solved_step(normal.matrix, normal.gradient)
    left = float(np.sqrt(max(float(step @ normal.matrix @ step), 0.0) / system.rows))
    settled = left < tolerance * max(1.0, normal.rms(system))
    if damping > 0.0 and not settled:
        step = solved_step(normal.matrix, normal.gradient, damping)
    return step, left, settled


def leave_fold_out(
    chain: Chain, names: Sequence[str], system: System, folds: Folds
) -> Iterator[Chain]:
    """Yield, for each fold in turn, the chain fitted to all other samples.

    `chain` is the fit to all of them. One Gauss-Newton step from there, with the normal equations
    of all samples minus those of the fold, visits every sample only once. If that step is too long
    to be accurate, the samples are fitted.
    """
    curved = [k for k, name in enumerate(names) if not Parameter(name).of_lens]  # pixels are not
    parts = products_of(chain, names, system, folds).sum(axis=1)
    extra = np.column_stack(system.extra_rows(chain, names))
    rest = parts.sum(axis=0) + extra.T @ extra - parts
    for k, normal in enumerate(rest):
        step = solved_step(normal[:-1, :-1], normal[:-1, -1])
        near = chain.with_offsets(dict(zip(names, step, strict=True)))
        if np.abs(step[curved]).max(initial=0.0) > SMALL_STEP:
            few = system.select([numbers != k for numbers in folds])
            near = minimise(near, names, few, tolerance=1e-3).chain
        yield near
