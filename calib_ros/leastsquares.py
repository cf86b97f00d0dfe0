# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Weighted nonlinear least squares on the vector residual of poses.

Residual of a sample: p_measured - p and the rotation vector from the model's orientation to the
measured one, both in world axes, weighted by the inverse of the measurement's covariance. Its
derivative with respect to the parameters is the error model's, with the sign reversed. The
orientation part leaves out the Jacobian of the logarithm: with equal weights on the three axes
the gradient does not change, because that Jacobian leaves the residual itself as it is.

Samples are visited in blocks that fit the cache. A block adds to the normal matrix, which has
the residual as its last row and column, so memory does not grow with the number of samples.
Rank and covariance come from a triangular factor of the Jacobian itself (a QR decomposition,
block by block), because the normal matrix squares its condition number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from calib_ros.chain import Chain
from calib_ros.differential import ErrorModel, orientation_error
from calib_ros.observations import Observations
from calib_ros.se3 import FloatArray

BLOCK = 1024
STEP_TOLERANCE = 1e-8
"""The fit has converged when a step moves the predictions by less (RMS; in sigma or, where it is
larger, in RMS residuals)."""
MAX_ITERATIONS = 50
PATIENCE = 3


class Samples:
    """Observations laid out for the solver: component first, sample last, weights at hand.

    Parameters
    ----------
    observations : Observations
    sigma_position, sigma_orientation : float
        Standard deviations [m, rad] of measurements that bring no covariance of their own.

    """

    def __init__(
        self, observations: Observations, sigma_position: float, sigma_orientation: float
    ) -> None:
        self.count = len(observations)
        self.joints = np.ascontiguousarray(observations.joints.T)
        self.positions = np.ascontiguousarray(observations.positions.T)
        self.rotations = np.ascontiguousarray(observations.rotations.transpose(2, 1, 0))
        self.oriented = bool(observations.oriented.any())
        self.rows = 3 * self.count + 3 * int(observations.oriented.sum())
        self.weights = (1.0 / sigma_position, 1.0 / sigma_orientation)
        self.whitening: FloatArray | None = None
        mixed = self.oriented and not observations.oriented.all()
        if mixed or observations.covariance is not None:
            self.whitening = _whitening(observations, sigma_position, sigma_orientation)

    def blocks(
        self, chain: Chain, names: Sequence[str]
    ) -> Iterator[tuple[FloatArray, FloatArray, ErrorModel]]:
        """Yield weighted rows of Jacobian and residual, a block of samples at a time.

        Yields
        ------
        shift : (P + 1, 3 B) or (P + 1, 6 B)
            Weighted derivative of the residual, transposed; the last row is the residual.
        turn : (P_rotational + 1, 3 B) or (0, 0)
            The same of the orientation where it is kept apart: rotational parameters only.
        model : ErrorModel
            Knows the order of the parameters in the rows.

        """
        model = ErrorModel(chain, names)
        for start in range(0, self.count, BLOCK):
            part = slice(start, start + BLOCK)
            axes, origin, shift, turn = model.linearise(self.joints[:, part])
            np.subtract(self.positions[:, part], origin, out=shift[-1])
            if self.oriented:
                turn[-1] = orientation_error(self.rotations[:, :, part], axes)
            if self.whitening is not None:
                yield self._whitened(shift, turn, part), np.zeros((0, 0)), model
                continue
            shift *= self.weights[0]
            flat = shift.reshape(len(shift), -1)
            if not self.oriented:
                yield flat, np.zeros((0, 0)), model
                continue
            turn *= self.weights[1]
            yield flat, turn.reshape(len(turn), -1), model

    def _whitened(self, shift: FloatArray, turn: FloatArray, part: slice) -> FloatArray:
        """Return (P + 1, 6 B): position and orientation rows mixed by each sample's whitening."""
        assert self.whitening is not None
        full = np.zeros((len(shift), 6, shift.shape[2]))
        full[:, :3] = shift
        full[: len(turn) - 1, 3:] = turn[:-1]
        full[-1, 3:] = turn[-1] if self.oriented else 0.0
        mixed = np.einsum('rsb,psb->prb', self.whitening[:, :, part], full, optimize=True)
        return np.ascontiguousarray(mixed).reshape(len(shift), -1)


def _whitening(
    observations: Observations, sigma_position: float, sigma_orientation: float
) -> FloatArray:
    """Return W (6, 6, N) with W^T W the inverse covariance; zero rows for what is not measured."""
    sigmas = np.repeat([sigma_position, sigma_orientation], 3)
    covariance = np.tile(np.diag(sigmas**2), (len(observations), 1, 1))
    if observations.covariance is not None:
        own = ~np.isnan(observations.covariance[:, 0, 0])
        covariance[own] = observations.covariance[own]
    covariance[~observations.oriented, 3:, :] = 0.0
    covariance[~observations.oriented, :, 3:] = 0.0
    covariance[~observations.oriented, 3:, 3:] = np.eye(3)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    whitening[~observations.oriented, 3:, :] = 0.0
    return np.ascontiguousarray(whitening.transpose(1, 2, 0))


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations H dx = g at one chain, and the sum of squared weighted residuals there."""

    matrix: FloatArray
    gradient: FloatArray
    cost: float

    def rms(self, samples: Samples) -> float:
        """Return the RMS of the weighted residuals, in sigma."""
        return float(np.sqrt(self.cost / samples.rows))


def normal_equations(chain: Chain, names: Sequence[str], samples: Samples) -> Normal:
    """Return the normal equations (P, P), (P,) and the sum of squared weighted residuals."""
    size = len(names) + 1
    total = np.zeros((size, size))
    order = np.arange(size)
    for shift, turn, model in samples.blocks(chain, names):
        total += shift @ shift.T
        if len(turn):
            inner = np.r_[: len(turn) - 1, size - 1]
            total[np.ix_(inner, inner)] += turn @ turn.T
        order = np.append(model.order, size - 1)
    total = total[np.ix_(order, order)]
    return Normal(total[:-1, :-1], total[:-1, -1], float(total[-1, -1]))


def triangular_factor(chain: Chain, names: Sequence[str], samples: Samples) -> FloatArray:
    """Return R (P, P), upper triangular, with R^T R the normal matrix."""
    size = len(names)
    factor = np.zeros((0, size))
    for shift, turn, model in samples.blocks(chain, names):
        rows = [factor, shift[model.order].T]
        if len(turn):
            oriented = np.zeros((turn.shape[1], size))
            rotational = model.order < model.rotations
            oriented[:, rotational] = turn[model.order[rotational]].T
            rows.append(oriented)
        factor = np.asarray(linalg.qr(np.concatenate(rows), mode='r', check_finite=False)[0])
        factor = factor[:size]
    if len(factor) < size:
        factor = np.concatenate([factor, np.zeros((size - len(factor), size))])
    return factor


@dataclass(frozen=True, eq=False)
class Fit:
    """The chain at the minimum of the weighted squares."""

    chain: Chain
    cost: float
    iterations: int
    converged: bool


def minimise(
    chain: Chain, names: Sequence[str], samples: Samples, tolerance: float = STEP_TOLERANCE
) -> Fit:
    """Fit the named parameters, relinearising until the step vanishes.

    Gauss-Newton with columns scaled to unit length. A step may raise the cost for a moment, as
    it must to get through a curved valley (watchdog; Chamberlain et al. 1982); when PATIENCE
    steps have not brought it below the best, the fit goes back there and steps are damped
    (Levenberg 1944, Marquardt 1963) until they lower it.
    """
    normal = normal_equations(chain, names, samples)
    if not names:
        return Fit(chain, normal.cost, 0, True)
    best, best_chain = normal, chain
    damping = 0.0
    patience = PATIENCE
    for iteration in range(1, MAX_ITERATIONS + 1):
        step = _solve(normal, damping)
        moved = float(np.sqrt(max(float(step @ normal.matrix @ step), 0.0) / samples.rows))
        settled = damping == 0.0 and moved < tolerance * max(1.0, normal.rms(samples))
        chain = chain.with_offsets(dict(zip(names, step, strict=True)))
        if settled:
            return Fit(chain, normal.cost, iteration, True)
        normal = normal_equations(chain, names, samples)
        if normal.cost <= best.cost * (1.0 + 1e-12):
            best, best_chain = normal, chain
            patience = PATIENCE if damping < 1e-9 else 0
            damping = damping / 10.0 if patience == 0 else 0.0
        elif patience > 0 and np.isfinite(normal.cost):
            patience -= 1
        elif damping > 1e12:  # nothing lowers the cost
            break
        else:
            normal, chain = best, best_chain
            damping = max(10.0 * damping, 1e-6)
    return Fit(best_chain, best.cost, iteration, False)


def _solve(normal: Normal, damping: float) -> FloatArray:
    """Return the damped step; a matrix that rounding made singular is damped a little more."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal.matrix), 1e-300))
    matrix = normal.matrix * np.outer(scale, scale)
    while True:
        try:
            factor = linalg.cho_factor(matrix + damping * np.eye(len(scale)), check_finite=False)
        except linalg.LinAlgError:
            damping = max(10.0 * damping, 1e-14)
            continue
        return np.asarray(scale * linalg.cho_solve(factor, scale * normal.gradient))
