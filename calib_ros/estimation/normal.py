# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Normal equations of a system, and the triangular factor of its Jacobian."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.linalg import lapack

from calib_ros.estimation.system import System
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray, Index

Folds: TypeAlias = Sequence[Index]  # fold number (N,) of every sample, set by set


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
            if columns.size:  # LAPACK prints about none
                factor = np.triu(lapack.dgeqrf(columns.T, 32 * size, overwrite_a=True)[0][:size])
    if len(factor) < size:
        factor = np.concatenate([factor, np.zeros((size - len(factor), size))])
    return factor


def solved_step(matrix: FloatArray, gradient: FloatArray, damping: float = 0.0) -> FloatArray:
    """Return the damped step (P,) by a matrix (P, P) and gradient (P,).

    More damping is added if rounding made the matrix singular. NaN if the matrix overflows.
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
