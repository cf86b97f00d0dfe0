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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from calib_ros.estimation.levels import SEVERAL
from calib_ros.estimation.samples import Samples
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import Parameter, parameters_of
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, ROUNDING, ROUNDS, FloatArray, Index
from calib_ros.settings import EXACT, Settings
from calib_ros.shown import Shown

Folds: TypeAlias = Sequence[Index]  # fold number (N,) of every sample, set by set
STEP_TOLERANCE = 1e-6
"""Convergence: the RMS step of the predictions in sigma or, if larger, in RMS residuals. A
thousandth of the uncertainty with a million rows."""
PATIENCE = SEVERAL  # successive steps that may raise the cost before steps are damped
SMALL_STEP = math.sqrt(EXACT)
"""Step [m or rad] whose second-order error, half its square, is negligible."""


@dataclass(frozen=True)
class Prior:
    """Gaussian priors: standard deviations [m or rad] of parameters about the nominal chain.

    `noise` scales the sigmas of the data: if these are too small, priors count for more.
    """

    nominal: Chain
    sigmas: Mapping[str, float] = field(default_factory=dict)
    noise: float = 1.0

    def rows(self, chain: Chain, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Return noise / sigma (P,), zero without a prior, and the weighted residual (P,)."""
        inverse = np.array(
            [self.noise / self.sigmas[n] if n in self.sigmas else 0.0 for n in names]
        )
        offsets = np.array(
            [chain.offset(n, self.nominal) if n in self.sigmas else 0.0 for n in names]
        )
        return inverse, -offsets * inverse


@dataclass(frozen=True, eq=False, repr=False)
class System(Shown):
    """Sets of samples to fit, with priors and known socket separations."""

    sets: tuple[Samples, ...]
    prior: Prior | None = None
    separations: tuple[tuple[str, str, float], ...] = ()
    sigma_scale: float = 0.0
    """Relative standard deviation of these; 0 for that of devices [m] by default."""

    def extra_rows(self, chain: Chain, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Return Jacobian (R, P) and residual (R,) in sigma of priors and known separations."""
        rows, residual = self.separation_rows(chain, names)
        if self.prior is not None:
            inverse, offsets = self.prior.rows(chain, names)
            rows, residual = np.vstack([np.diag(inverse), rows]), np.append(offsets, residual)
        return rows, residual

    def separation_rows(self, chain: Chain, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Return Jacobian (S, P) and residual (S,) in sigma of the known separations."""
        rows = np.zeros((len(self.separations), len(names)))
        residual = np.zeros(len(self.separations))
        column = {name: k for k, name in enumerate(names)}
        for i, (first, second, distance) in enumerate(self.separations):
            apart = chain.frame(second).matrix[:3, 3] - chain.frame(first).matrix[:3, 3]
            length = max(float(np.linalg.norm(apart)), 1e-12)
            residual[i] = distance - length
            for frame, sign in ((first, -1.0), (second, 1.0)):
                for k, name in enumerate(parameters_of(frame)[:3]):
                    if name in column:
                        rows[i, column[name]] = sign * apart[k] / length
        known = np.array([distance for *_, distance in self.separations])
        sigmas = self.sigma_scale * known if self.sigma_scale else Settings.sigma_position
        return (rows.T / sigmas).T, residual / sigmas

    def select(self, chosen: Sequence[NDArray[np.generic]]) -> System:
        """Return chosen samples and their weights, by masks (N,) or indices (K,) for each set."""
        pairs = zip(self.sets, chosen, strict=True)
        return replace(self, sets=tuple(samples.select(index) for samples, index in pairs))

    def spread(self, most: int) -> System:
        """Return every k-th sample of each set: at most `most` in all, or one of each set."""
        share = -(-self.count // most)
        return self.select([np.arange(0, samples.count, share) for samples in self.sets])

    def weighted(self, weights: Sequence[FloatArray | None]) -> System:
        """Return the samples with weights (N,) for each set; None for ones."""
        pairs = zip(self.sets, weights, strict=True)
        return replace(self, sets=tuple(samples.weighted(each) for samples, each in pairs))

    def rows_of(self, chain: Chain, names: Sequence[str]) -> list[FloatArray]:
        """Return the weighted rows (P + 1, c, N) of each set, the residual last."""
        return [samples.rows_of(chain, names) for samples in self.sets]

    @property
    def count(self) -> int:
        """Return the number of samples."""
        return sum(samples.count for samples in self.sets)

    @property
    def rows(self) -> int:
        """Return the number of measured equations."""
        return sum(samples.rows for samples in self.sets)


def stacked(rows: Sequence[FloatArray]) -> FloatArray:
    """Return the rows (P, c, N) of all sets as one array (R, P)."""
    return np.concatenate([each.reshape(len(each), -1) for each in rows], axis=1).T


def row_samples(rows: Sequence[FloatArray]) -> Index:
    """Return the sample number (R,), over all sets, of each row of `stacked`."""
    ends = np.cumsum([each.shape[2] for each in rows]).tolist()
    numbers = [np.arange(end - each.shape[2], end) for end, each in zip(ends, rows, strict=True)]
    return np.concatenate(
        [np.tile(each, part.shape[1]) for each, part in zip(numbers, rows, strict=True)]
    )


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations H dx = g at one chain, with the sum of squared weighted residuals.

    `products` (2, P + 1, P + 1) are those of the measured position and orientation rows, the
    residual last.
    """

    matrix: FloatArray
    gradient: FloatArray
    cost: float
    products: FloatArray

    @property
    def parts(self) -> FloatArray:
        """Return the shares (2, P, P) of H by position and orientation."""
        return self.products[:, :-1, :-1]

    def after(self, step: FloatArray) -> Normal:
        """Return the equations after a step (P,) that leaves the Jacobian as it is."""
        along = np.append(-step, 1.0)
        products = self.products.copy()
        products[:, -1] = products[:, :, -1] = self.products @ along
        products[:, -1, -1] = products[:, -1] @ along
        moved = self.matrix @ step
        cost = self.cost + float(step @ (moved - 2.0 * self.gradient))
        return Normal(self.matrix, self.gradient - moved, max(cost, 0.0), products)  # by rounding

    def factor(self) -> FloatArray | None:
        """Return R (P, P) with R^T R = H; None if H has lost too many digits."""
        scale = np.sqrt(np.diag(self.matrix))
        if not (scale.all() and np.isfinite(scale).all()):
            return None
        scaled = self.matrix / np.outer(scale, scale)
        sizes = np.linalg.eigvalsh(scaled) if len(scaled) else np.ones(1)
        if not np.finfo(float).eps * sizes[-1] < 1e-6 * sizes[0]:  # the covariance has 6 digits
            return None
        return np.asarray(np.linalg.cholesky(scaled).T * scale)

    def rms(self, system: System) -> float:
        """Return the RMS weighted residual in sigma."""
        return float(np.sqrt(self.cost / system.rows))


def normal_equations(chain: Chain, names: Sequence[str], system: System) -> Normal:
    """Return the normal equations (P, P), (P,) with priors and separations."""
    products = products_of(chain, names, system)[0]
    total = products.sum(axis=0)
    extra, residual = system.extra_rows(chain, names)
    if len(extra):
        rows = np.column_stack([extra, residual])
        total += rows.T @ rows
    return Normal(total[:-1, :-1], total[:-1, -1], float(total[-1, -1]), products)


def products_of(
    chain: Chain, names: Sequence[str], system: System, folds: Folds | None = None
) -> FloatArray:
    """Return products (K, 2, P + 1, P + 1) of measured rows by fold; K = 1 without folds.

    By position and orientation, the residual last.
    """
    count = 1 if folds is None else 1 + max(int(each.max(initial=0)) for each in folds)
    found = np.zeros((count, 2, len(names) + 1, len(names) + 1))
    for number, samples in enumerate(system.sets):
        found += samples.products(chain, names, count, None if folds is None else folds[number])
    return found


def factor_of(
    chain: Chain, names: Sequence[str], system: System, normal: Normal | None = None
) -> FloatArray:
    """Return R (P, P), upper triangular, with R^T R the normal matrix; `normal` if known."""
    factor = (normal or normal_equations(chain, names, system)).factor()
    return triangular_factor(chain, names, system) if factor is None else factor


def triangular_factor(chain: Chain, names: Sequence[str], system: System) -> FloatArray:
    """Return R (P, P), upper triangular, with R^T R the normal matrix."""
    size = len(names)
    factor = system.extra_rows(chain, names)[0]
    for samples in system.sets:
        for parts in samples.parts(chain, names):
            rows = [part[:-1].reshape(size, -1) for part in parts]
            columns = np.concatenate([factor.T, *rows], axis=1)
            factor = np.triu(lapack.dgeqrf(columns.T, 32 * size, overwrite_a=True)[0][:size])
    if len(factor) < size:
        factor = np.concatenate([factor, np.zeros((size - len(factor), size))])
    return factor


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
    step = _solve(normal.matrix, normal.gradient)
    left = float(np.sqrt(max(float(step @ normal.matrix @ step), 0.0) / system.rows))
    settled = left < tolerance * max(1.0, normal.rms(system))
    if damping > 0.0 and not settled:
        step = _solve(normal.matrix, normal.gradient, damping)
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
        step = _solve(normal[:-1, :-1], normal[:-1, -1])
        near = chain.with_offsets(dict(zip(names, step, strict=True)))
        if np.abs(step[curved]).max(initial=0.0) > SMALL_STEP:
            few = system.select([numbers != k for numbers in folds])
            near = minimise(near, names, few, tolerance=1e-3).chain
        yield near


def _solve(matrix: FloatArray, gradient: FloatArray, damping: float = 0.0) -> FloatArray:
    """Return the damped step; more damping is added if rounding made the matrix singular.

    NaN if the matrix overflows.
    """
    size = np.arange(len(matrix))
    if not len(size):
        return gradient
    scale = 1.0 / np.sqrt(np.maximum(matrix[size, size], 1e-300))
    scaled = matrix * scale * scale[:, np.newaxis]
    if not np.isfinite(scaled).all():
        return np.full(len(matrix), np.nan)
    unit = scaled[size, size]
    while True:
        scaled[size, size] = unit + damping
        _, step, failed = lapack.dposv(scaled, scale * gradient)
        if not failed:
            return np.asarray(scale * step)
        damping = max(10.0 * damping, 1e-14)
