# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Weighted nonlinear least squares on the vector residual of poses.

Residual of a sample: p_measured - p and the rotation vector from the model's orientation to the
measured one, both in world axes, weighted by the inverse of the measurement's covariance. Its
derivative with respect to the parameters is the error model's, with the sign reversed. The
orientation part leaves out the Jacobian of the logarithm: with equal weights on the three axes
the gradient does not change, because that Jacobian leaves the residual itself as it is. A measured
distance has the residual L - |p|, and its derivative is the position's along p. Pixels of a board
have a module of their own (`pixels.py`).

Samples are visited in blocks that fit the cache. A block adds to the normal matrix, which has
the residual as its last row and column, so memory does not grow with the number of samples.
The rank comes from a triangular factor of the Jacobian itself (a QR decomposition, block by
block), because the normal matrix squares its condition number; so does the covariance, unless
that matrix is well conditioned.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from calib_ros.identification.observations import Observations
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel, orientation_error
from calib_ros.kinematics.lens import at_the_board, require_lens, view
from calib_ros.kinematics.parameter import Parameter, parameters_of
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import Shown

BLOCK = 1024
STEP_TOLERANCE = 1e-6
"""The fit has converged when a step moves the predictions by less (RMS; in sigma or, where it is
larger, in RMS residuals)."""
PATIENCE = 3
"""Steps in succession that may raise the cost before they are damped."""
MOST_ITERATIONS = 1000
"""Iterations after which a fit that still progresses is given up; curved valleys need 400."""
STALLED = 50
"""Iterations in which the cost must fall by LEAST_FALL, or the step left to go by half."""
LEAST_FALL = 1e-3
DAMPED, UNDAMPED = 1e-6, 1e-12
"""Damping, of columns of unit length, with which it begins and below which it ends."""
WELL_CONDITIONED = 1e9
"""Condition of the scaled normal matrix up to which a covariance from it has 6 digits or more."""
SEPARATION_SIGMA = 1e-5
"""Standard deviation [m] of a known distance between sockets."""
SMALL_STEP = 1e-3
"""Step [m or rad] whose second order, half its square, is a thousandth of a millimetre at most."""


class Samples:
    """One set of observations laid out for the solver: component first, sample last.

    Parameters
    ----------
    observations : Observations
    sigma_position, sigma_orientation : float
        Standard deviations [m, rad] of measurements that bring no covariance of their own.

    """

    def __init__(
        self, observations: Observations, sigma_position: float, sigma_orientation: float
    ) -> None:
        self.observations = observations
        self.count = len(observations)
        self.joints = np.ascontiguousarray(observations.joints.T)
        self.positions = np.ascontiguousarray(observations.positions.T)
        self.rotations = np.ascontiguousarray(observations.rotations.transpose(2, 1, 0))
        approach = observations.approach
        self.approach = None if approach is None else np.ascontiguousarray(approach.T)
        self.distances = observations.distances
        self.oriented = bool(observations.oriented.any()) and self.distances is None
        width = 3 if self.distances is None else 1
        self.rows = width * self.count + 3 * int(observations.oriented.sum()) * self.oriented
        self.sigmas = (sigma_position, sigma_orientation)
        self.whitening: FloatArray | None = None
        mixed = self.oriented and not observations.oriented.all()
        if mixed or (observations.covariance is not None and self.distances is None):
            self.whitening = _whitening(observations, sigma_position, sigma_orientation)
        self.weights: FloatArray | None = None
        """Square roots of the weights (N,) of a robust loss; None where all count fully."""

    def select(self, index: NDArray[np.generic]) -> Samples:
        """Return the samples chosen by a mask or by indices, with their weights."""
        few = type(self)(self.observations.select(index), *self.sigmas)
        few.weights = None if self.weights is None else self.weights[index]
        return few

    def blocks(
        self, chain: Chain, names: Sequence[str]
    ) -> Iterator[tuple[FloatArray, FloatArray, ErrorModel]]:
        """Yield weighted rows of Jacobian and residual, a block of samples at a time.

        Yields
        ------
        shift : (P + 1, rows)
            Weighted derivative of the residual, transposed; the last row is the residual.
        turn : (P_rotational + 1, 3 B) or (0, 0)
            The same of the orientation where it is kept apart: rotational parameters only.
        model : ErrorModel
            Knows the order of the parameters in the rows.

        """
        model = ErrorModel(chain, names, self.observations.base, self.observations.tool)
        nothing = np.zeros((0, 0))
        joints, velocity = self.moving(chain)
        for start in range(0, self.count, BLOCK):
            part = slice(start, start + BLOCK)
            approach = None if self.approach is None else self.approach[:, part]
            moving = None if velocity is None else velocity[:, part]
            axes, origin, shift, turn = model.linearise(joints[:, part], approach, moving)
            if self.distances is not None:
                shift = _along(origin, shift, self.distances[part], self.observations.plane)
            else:
                np.subtract(self.positions[:, part], origin, out=shift[-1])
            if self.oriented:
                turn[-1] = orientation_error(self.rotations[:, :, part], axes)
            if self.weights is not None:
                shift *= self.weights[part]
                if self.oriented:
                    turn *= self.weights[part]
            if self.whitening is not None:
                yield self._whitened(shift, turn, part), nothing, model
                continue
            shift /= self.sigmas[0]
            flat = shift.reshape(len(shift), -1)
            if not self.oriented:
                yield flat, nothing, model
                continue
            turn /= self.sigmas[1]
            yield flat, turn.reshape(len(turn), -1), model

    def moving(self, chain: Chain) -> tuple[FloatArray, FloatArray | None]:
        """Return joint values (n, N) at the device's delay, and velocities where it has one."""
        delay = chain.frame(self.observations.base).delay
        if self.observations.velocity is None or delay is None:
            return self.joints, None
        then = self.observations.earlier(delay)
        velocity = np.ascontiguousarray(np.asarray(then.velocity).T)
        return np.ascontiguousarray(then.joints.T), velocity

    def parts(self, chain: Chain, names: Sequence[str]) -> Iterator[tuple[FloatArray, ...]]:
        """Yield the same rows by position and orientation, (P + 1, c, B) each, a block at a time.

        Parameters stand in the order of their names, the residual last. Where orientation is
        whitened together with the position, or not measured, there is one part only.
        """
        for shift, turn, model in self.blocks(chain, names):
            order = [*model.order, len(names)]
            found = [shift[order]]
            if len(turn):
                full = np.zeros((len(names) + 1, turn.shape[1]))
                full[: model.rotations] = turn[:-1]
                full[-1] = turn[-1]
                found.append(full[order])
            count = shift.shape[1] // self.width
            yield tuple(part.reshape(len(part), -1, count) for part in found)

    @property
    def width(self) -> int:
        """Return the number of rows of a sample's position, or of all of it where whitened."""
        return 1 if self.distances is not None else 6 if self.whitening is not None else 3

    def rows_of(self, chain: Chain, names: Sequence[str]) -> FloatArray:
        """Return (N, 6, 3 or 1, P + 1) the weighted rows sample by sample, the residual last."""
        found = [np.concatenate(parts, axis=1) for parts in self.parts(chain, names)]
        return np.concatenate(found, axis=2).transpose(2, 1, 0)

    def _whitened(self, shift: FloatArray, turn: FloatArray, part: slice) -> FloatArray:
        """Return (P + 1, 6 B): position and orientation rows mixed by each sample's whitening."""
        assert self.whitening is not None
        full = np.zeros((len(shift), 6, shift.shape[2]))
        full[:, :3] = shift
        full[: len(turn) - 1, 3:] = turn[:-1]
        full[-1, 3:] = turn[-1] if self.oriented else 0.0
        mixed = np.einsum('rsb,psb->prb', self.whitening[:, :, part], full, optimize=True)
        return np.ascontiguousarray(mixed).reshape(len(shift), -1)

    def position_errors(self, residuals: FloatArray) -> FloatArray:
        """Return position errors (N, 3) [m] of weighted residuals (rows,), sample by sample.

        Of distances the error is the first component.
        """
        rows = residuals.reshape(self.count, -1)
        if self.whitening is not None:  # lower triangular, so that position is not mixed
            mixing = self.whitening[:3, :3].transpose(2, 0, 1)
            return np.asarray(np.linalg.solve(mixing, rows[:, :3, np.newaxis])[..., 0])
        errors = np.zeros((self.count, 3))
        width = 1 if self.distances is not None else 3
        errors[:, :width] = self.sigmas[0] * rows[:, :width]
        return errors

    def whitened_residuals(self, chain: Chain) -> tuple[FloatArray, FloatArray]:
        """Return the residuals in sigma: position (N, 3 or 1), orientation (N, 3).

        NaN where nothing was measured. Samples with covariances of their own are whitened as a
        whole; their two parts are then only nearly those of position and orientation.
        """
        position, orientation = residual_arrays(chain, self.observations)
        if self.whitening is not None:
            both = np.concatenate([position, np.nan_to_num(orientation)], axis=1)
            both = np.einsum('rsn,ns->nr', self.whitening, both)
            position, turned = both[:, :3], both[:, 3:]
            return position, np.where(self.observations.oriented[:, None], turned, np.nan)
        return position / self.sigmas[0], orientation / self.sigmas[1]

    def misfits(self, chain: Chain) -> Iterator[tuple[FloatArray, NDArray[np.intp] | slice]]:
        """Yield residuals (M, c) in sigma that tell gross errors, and the (N,) row of each sample.

        NaN where nothing was measured.
        """
        for part in self.whitened_residuals(chain):
            yield part, slice(None)


def residual_arrays(chain: Chain, observations: Observations) -> tuple[FloatArray, FloatArray]:
    """Return measured minus predicted: position (N, 3) [m], rotation vector (N, 3) [rad].

    Measured distances give (N, 1). Rotation vectors are NaN where none was measured.
    """
    delay = chain.frame(observations.base).delay
    then = observations if delay is None else observations.earlier(delay)
    distances = observations.distances
    position = np.empty((len(then), 3 if distances is None else 1))
    orientation = np.full((len(then), 3), np.nan)
    oriented = observations.oriented & (distances is None)
    for start in range(0, len(then), BLOCK):
        part = slice(start, start + BLOCK)
        q = np.ascontiguousarray(then.joints[part].T)
        came = None if then.approach is None else np.ascontiguousarray(then.approach[part].T)
        axes, origin = chain.trace(
            chain.effective(q, came), base=observations.base, tool=observations.tool
        )
        if distances is not None:
            length = origin[2] if observations.plane else np.linalg.norm(origin, axis=0)
            position[part, 0] = distances[part] - length
            continue
        position[part] = observations.positions[part] - origin.T
        if oriented[part].any():
            measured = np.ascontiguousarray(observations.rotations[part].transpose(2, 1, 0))
            orientation[part] = orientation_error(measured, axes).T
    orientation[~oriented] = np.nan
    return position, orientation


def seen_residuals(chain: Chain, observations: Observations) -> tuple[FloatArray, FloatArray]:
    """Return measured minus predicted: pixels (N, 2), and the same at the board (N, 3) [m]."""
    camera = observations.camera
    lens = require_lens(chain.frame(camera).lens, camera)
    delay = chain.frame(observations.base).delay
    then = observations if delay is None else observations.earlier(delay)
    first = np.flatnonzero(np.diff(then.images, prepend=-1))
    assert then.pixels is not None
    assert then.points is not None
    q = np.ascontiguousarray(then.joints[first].T)
    came = None if then.approach is None else np.ascontiguousarray(then.approach[first].T)
    axes, origin = chain.trace(chain.effective(q, came), base=then.base, tool=then.tool)
    pixels, shifts = np.empty((len(then), 2)), np.empty((len(then), 3))
    for start in range(0, len(then), BLOCK):
        part = slice(start, start + BLOCK)
        owner = then.images[part]
        seen = view(
            lens,
            [axis[:, owner] for axis in axes],
            origin[:, owner],
            then.points[part].T,
            then.on_flange,
        )
        residual = then.pixels[part].T - seen.pixels
        pixels[part], shifts[part] = residual.T, at_the_board(seen, residual)
    return pixels, shifts


def _along(
    origin: FloatArray, shift: FloatArray, distances: FloatArray, plane: bool
) -> FloatArray:
    """Return (P + 1, 1, B): position columns along the line of sight, and L - |p|.

    Over a plane they are along its normal z.
    """
    if plane:
        along = np.ascontiguousarray(shift[:, 2:])
        along[-1, 0] = distances - origin[2]
        return along
    length = np.maximum(np.linalg.norm(origin, axis=0), 1e-12)
    along = np.einsum('pcb,cb->pb', shift, origin / length)[:, np.newaxis]
    along[-1, 0] = distances - length
    return np.ascontiguousarray(along)


def _whitening(
    observations: Observations, sigma_position: float, sigma_orientation: float
) -> FloatArray:
    """Return W (6, 6, N) with W^T W the inverse covariance; zero rows for what is not measured."""
    covariance = observations.covariances((sigma_position, sigma_orientation))
    covariance[~observations.oriented, 3:, :] = 0.0
    covariance[~observations.oriented, :, 3:] = 0.0
    covariance[~observations.oriented, 3:, 3:] = np.eye(3)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    whitening[~observations.oriented, 3:, :] = 0.0
    return np.ascontiguousarray(whitening.transpose(1, 2, 0))


@dataclass(frozen=True)
class Prior:
    """Gaussian priors: standard deviations [m or rad] of parameters about the nominal chain.

    `noise` is the size of the noise in the sigmas that weigh the data: where these are too small,
    priors count for more.
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
    """What is fitted: sets of samples, and priors if there are any."""

    sets: tuple[Samples, ...]
    prior: Prior | None = None
    separations: tuple[tuple[str, str, float], ...] = ()

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
            residual[i] = (distance - length) / SEPARATION_SIGMA
            for frame, sign in ((first, -1.0), (second, 1.0)):
                for k, name in enumerate(parameters_of(frame)[:3]):
                    if name in column:
                        rows[i, column[name]] = sign * apart[k] / length
        return rows / SEPARATION_SIGMA, residual

    @property
    def count(self) -> int:
        """Return the number of samples."""
        return sum(samples.count for samples in self.sets)

    @property
    def rows(self) -> int:
        """Return the number of measured equations."""
        return sum(samples.rows for samples in self.sets)


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations H dx = g at one chain, and the sum of squared weighted residuals there.

    `parts` holds the shares of H by position and by orientation.
    """

    matrix: FloatArray
    gradient: FloatArray
    cost: float
    parts: tuple[FloatArray, FloatArray]

    def factor(self) -> FloatArray | None:
        """Return R (P, P) with R^T R = H; None where H has lost too many digits for it."""
        scale = np.sqrt(np.diag(self.matrix))
        if not (scale.all() and np.isfinite(scale).all()):
            return None
        scaled = self.matrix / np.outer(scale, scale)
        sizes = np.linalg.eigvalsh(scaled) if len(scaled) else np.ones(1)
        if not sizes[-1] < WELL_CONDITIONED * sizes[0]:
            return None
        return np.asarray(np.linalg.cholesky(scaled).T * scale)

    def rms(self, system: System) -> float:
        """Return the RMS of the weighted residuals, in sigma."""
        return float(np.sqrt(self.cost / system.rows))


def normal_equations(chain: Chain, names: Sequence[str], system: System) -> Normal:
    """Return the normal equations (P, P), (P,) and the sum of squared weighted residuals."""
    size = len(names) + 1
    by_position, by_orientation = np.zeros((2, size, size))
    order = np.arange(size)
    for samples in system.sets:
        for shift, turn, model in samples.blocks(chain, names):
            by_position += shift @ shift.T
            if len(turn):
                products, last = turn @ turn.T, len(turn) - 1
                by_orientation[:last, :last] += products[:-1, :-1]
                by_orientation[:last, -1] += products[:-1, -1]
                by_orientation[-1, -1] += products[-1, -1]
            order[:-1] = model.order
    by_orientation[-1, :-1] = by_orientation[:-1, -1]
    by_position, by_orientation = (
        part[order[:, np.newaxis], order] for part in (by_position, by_orientation)
    )
    total = by_position + by_orientation
    extra, residual = system.extra_rows(chain, names)
    if len(extra):
        total[:-1, :-1] += extra.T @ extra
        total[:-1, -1] += extra.T @ residual
        total[-1, -1] += residual @ residual
    return Normal(
        total[:-1, :-1],
        total[:-1, -1],
        float(total[-1, -1]),
        (by_position[:-1, :-1], by_orientation[:-1, :-1]),
    )


def factor_of(chain: Chain, names: Sequence[str], system: System) -> FloatArray:
    """Return R (P, P), upper triangular, with R^T R the normal matrix, by the shortest way."""
    factor = normal_equations(chain, names, system).factor()
    return triangular_factor(chain, names, system) if factor is None else factor


def factor_of_some(factor: FloatArray, which: Sequence[int]) -> FloatArray:
    """Return R (K, K) of some of the columns of a factor R (P, P)."""
    if len(which) == len(factor):
        return factor
    return np.asarray(np.linalg.qr(factor[:, which], mode='r'))


def triangular_factor(
    chain: Chain, names: Sequence[str], system: System, priors: bool = True
) -> FloatArray:
    """Return R (P, P), upper triangular, with R^T R the normal matrix; without priors if asked."""
    size = len(names)
    factor = system.extra_rows(chain, names)[0] if priors else np.zeros((0, size))
    for samples in system.sets:
        for shift, turn, model in samples.blocks(chain, names):
            known, wide = len(factor), shift.shape[1]
            columns = np.zeros((size, known + wide + turn.shape[1]))
            columns[:, :known] = factor.T
            columns[:, known : known + wide] = shift[model.order]
            if len(turn):
                rotational = model.order < model.rotations
                columns[rotational, known + wide :] = turn[model.order[rotational]]
            factor = np.triu(lapack.dgeqrf(columns.T, 32 * size, overwrite_a=True)[0][:size])
    if len(factor) < size:
        factor = np.concatenate([factor, np.zeros((size - len(factor), size))])
    return factor


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Shown):
    """The chain at the minimum of the weighted squares, and the last normal equations there."""

    chain: Chain
    normal: Normal
    iterations: int
    converged: bool


def minimise(
    chain: Chain,
    names: Sequence[str],
    system: System,
    tolerance: float = STEP_TOLERANCE,
    iterations: int = MOST_ITERATIONS,
) -> Fit:
    """Fit the named parameters, relinearising until the step vanishes.

    Gauss-Newton with columns scaled to unit length. A step may raise the cost for a moment, as
    it must to get through a curved valley (watchdog; Chamberlain et al. 1982); when PATIENCE
    steps have not brought it below the best, the fit goes back there and steps are damped
    (Levenberg 1944, Marquardt 1963), by the ratio of the gain to the one foreseen (Nielsen 1999).
    It has converged when the step left to go, undamped, vanishes, however far the damped ones go.
    It ends as well, not converged, where STALLED iterations bring no progress.
    """
    normal = normal_equations(chain, names, system)
    if not names:
        return Fit(chain, normal, 0, True)
    best, best_chain = normal, chain
    damping, growth = 0.0, 2.0
    patience = PATIENCE
    stalled, least_cost, least_left = 0, np.inf, np.inf
    iteration = 0
    while iteration < iterations and stalled < STALLED:
        iteration += 1
        step = _solve(normal, 0.0)
        left = float(np.sqrt(max(float(step @ normal.matrix @ step), 0.0) / system.rows))
        settled = left < tolerance * max(1.0, normal.rms(system))
        if damping > 0.0 and not settled:
            step = _solve(normal, damping)
        chain = chain.with_offsets(dict(zip(names, step, strict=True)))
        if settled:
            return Fit(chain, normal, iteration, True)
        stalled += 1
        if best.cost < (1.0 - LEAST_FALL) * least_cost or left < 0.5 * least_left:
            stalled, least_cost, least_left = 0, best.cost, min(left, least_left)
        foreseen = float(step @ (2.0 * normal.gradient - normal.matrix @ step))
        normal = normal_equations(chain, names, system)
        gain = best.cost - normal.cost
        if gain >= -1e-12 * best.cost:
            best, best_chain = normal, chain
            growth = 2.0
            if damping > UNDAMPED:
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain / foreseen - 1.0) ** 3)
            else:
                damping, patience = 0.0, PATIENCE
        elif patience > 0 and np.isfinite(normal.cost):
            patience -= 1
        elif damping > 1e12:  # nothing lowers the cost
            break
        else:
            normal, chain = best, best_chain
            patience = 0
            damping, growth = max(growth * damping, DAMPED), 2.0 * growth
    return Fit(best_chain, best, iteration, False)


def without_each(
    chain: Chain,
    names: Sequence[str],
    systems: Sequence[System],
    others: Callable[[int], System],
) -> Iterator[Chain]:
    """Yield the chain fitted to all systems but one, for each one in turn.

    `chain` is the fit to all of them. One Gauss-Newton step from there, with the normal equations
    of all less those of the one, visits every sample only once. Where that step is too long to be
    trusted, the fit is done on `others(k)`, all samples but those of system k.
    """
    if not names:
        yield from [chain] * len(systems)
        return
    curved = [
        k for k, name in enumerate(names) if not Parameter(name).of_lens
    ]  # pixels are linear in a lens
    parts = [normal_equations(chain, names, System(system.sets)) for system in systems]
    extra, residual = systems[0].extra_rows(chain, names)  # the same in every part
    matrix = np.sum([part.matrix for part in parts], axis=0) + extra.T @ extra
    gradient = np.sum([part.gradient for part in parts], axis=0) + extra.T @ residual
    for k, part in enumerate(parts):
        rest = Normal(matrix - part.matrix, gradient - part.gradient, 0.0, part.parts)
        step = _solve(rest, 0.0)
        if np.abs(step[curved]).max(initial=0.0) > SMALL_STEP:
            yield minimise(chain, names, others(k), tolerance=1e-3).chain
        else:
            yield chain.with_offsets(dict(zip(names, step, strict=True)))


def _solve(normal: Normal, damping: float) -> FloatArray:
    """Return the damped step; a matrix that rounding made singular is damped a little more."""
    size = np.arange(len(normal.matrix))
    scale = 1.0 / np.sqrt(np.maximum(normal.matrix[size, size], 1e-300))
    matrix = normal.matrix * scale * scale[:, np.newaxis]
    unit = matrix[size, size]
    while True:
        matrix[size, size] = unit + damping
        _, step, failed = lapack.dposv(matrix, scale * normal.gradient)
        if not failed:
            return np.asarray(scale * step)
        damping = max(10.0 * damping, 1e-14)
