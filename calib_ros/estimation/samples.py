# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples of one set of observations for the solver: weighted rows, block by block.

Residual of a sample: p_measured - p and the rotation vector from the model's orientation to the
measured one, both in world axes, weighted by the inverse covariance of the measurement; of a point
seen from the flange, in the axes of the camera, as its covariance. Its derivative by the
parameters is minus that of the error model. With equal weights on the three axes the orientation
part omits the Jacobian of the logarithm, which leaves the residual itself, and the gradient, as
they are. A measured distance has the residual L - |p|, and its derivative is the
position's along p. Pixels of a board are in `pixels.py`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib_ros.estimation.observations import Observations
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel, orientation_error
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.kinematics.walk import BLOCK as BLOCK

Both: TypeAlias = tuple[FloatArray, FloatArray]
"""Residuals by position and orientation, or in the image and at the board."""


class Samples:
    """One set of observations laid out for the solver: component first, sample last.

    The sigmas [m, rad] are those of measurements without a covariance. `moments` has one row per
    linearised joint values: the observations, or one of each image.
    """

    def __init__(
        self, observations: Observations, sigma_position: float, sigma_orientation: float
    ) -> None:
        self.observations = self.moments = observations
        self.count = len(observations)
        self.joints, self._circle = observations.by_joint
        self.positions = np.ascontiguousarray(observations.positions.T)
        self.points = np.ascontiguousarray(observations.given.T) if observations.seen else None
        approach = observations.approach
        self.approach = None if approach is None else np.ascontiguousarray(approach.T)
        self.distances = observations.distances
        self.oriented = bool(observations.oriented.any()) and self.distances is None
        turned = observations.rotations.transpose(2, 1, 0)
        self.rotations = np.ascontiguousarray(turned) if self.oriented else turned
        width = 3 if self.distances is None else 1
        self.rows = width * self.count + 3 * int(observations.oriented.sum()) * self.oriented
        self.sigmas = (sigma_position, sigma_orientation)
        self.whitening: FloatArray | None = None
        mixed = self.oriented and not observations.oriented.all()
        if mixed or (observations.covariance is not None and self.distances is None):
            self.whitening = _whitening(observations, sigma_position, sigma_orientation)
        self.weights: FloatArray | None = None
        """Square roots of the robust weights (N,); None for ones."""

    def select(self, index: NDArray[np.generic]) -> Samples:
        """Return the samples chosen by a mask (N,) or indices (K,), with their weights."""
        few = self.of(self.observations.select(index))
        few.weights = None if self.weights is None else self.weights[index]
        return few

    def of(self, observations: Observations) -> Samples:
        """Return samples of other observations, with these weights."""
        found = type(self)(observations, *self.sigmas)
        found.weights = self.weights
        return found

    def weighted(self, weights: FloatArray | None) -> Samples:
        """Return the samples with robust weights (N,); None for ones."""
        found = copy.copy(self)
        found.weights = None if weights is None else np.sqrt(weights)
        return found

    def products(
        self, chain: Chain, names: Sequence[str], count: int = 1, folds: Index | None = None
    ) -> FloatArray:
        """Return products (K, 2, P + 1, P + 1) of rows by fold (N,) (`products_of`)."""
        samples, ends = self, np.array([0, self.count])
        if folds is not None:
            ends = np.append(0, np.cumsum(np.bincount(folds, minlength=count)))
            if (np.diff(folds) < 0).any():
                samples = self.select(np.argsort(folds, kind='stable'))
        model = ErrorModel(chain, names, self.observations.base, self.observations.tool)
        effects = model.spread
        by_motion = np.argsort(model.order[effects], kind='stable')
        motions, place = model.order[effects[by_motion]], np.append(model.order, -1)
        place[:-1] += len(effects)
        place[effects[by_motion]] = np.arange(len(effects))
        size, done = len(effects) + model.motions + 1, 0
        found = np.zeros((count, 2, size, size))
        for parts, phi in samples._motions(model):
            width = phi.shape[1]
            cuts = np.minimum(np.maximum(ends - done, 0), width).tolist()  # np.clip is slow
            done += width
            phi = phi[by_motion]
            for fold, (first, last) in enumerate(pairwise(cuts)):
                block = slice(first, last)
                for k, rows in enumerate(parts if first < last else ()):
                    _add_products(found[fold, k], rows[..., block], phi[:, block], motions)
        return found[:, :, place[:, np.newaxis], place]

    def sums(
        self, chain: Chain, names: Sequence[str], groups: Index
    ) -> Iterator[tuple[Index, tuple[FloatArray, ...]]]:
        """Yield numbers (n,) of successive groups, and summed rows (P + 1, c, n) by part."""
        first = 0
        for block in self.parts(chain, names):
            index = groups[first : first + block[0].shape[2]]
            first += len(index)
            begins = np.flatnonzero(np.diff(index, prepend=-1))
            yield index[begins], tuple(summed(part, begins) for part in block)

    def moving(self, chain: Chain) -> tuple[FloatArray, FloatArray | None]:
        """Return joint values (n, N) at the device's delay, and velocities if it has one."""
        delay = chain.frame(self.observations.base).delay
        if self.moments.velocity is None or delay is None:
            return self.joints, None
        then = self.moments.earlier(delay)
        velocity = np.ascontiguousarray(np.asarray(then.velocity).T)
        return np.ascontiguousarray(then.joints.T), velocity

    def parts(self, chain: Chain, names: Sequence[str]) -> Iterator[tuple[FloatArray, ...]]:
        """Yield the weighted rows by position and orientation, (P + 1, c, B) each, in blocks.

        Derivatives by the parameters in the order of their names, the residual last. Without a
        separate orientation there is one part. The next block may take the memory of the last.
        """
        model = ErrorModel(chain, names, self.observations.base, self.observations.tool)
        order, found = np.append(model.order, model.motions), tuple[FloatArray, ...]()
        for motions, phi in self._motions(model):
            if not found or found[0].shape[2] != phi.shape[1]:
                found = tuple(np.empty((len(order), *rows.shape[1:])) for rows in motions)
            for rows, own in zip(motions, found, strict=True):
                rows.take(order, axis=0, out=own, mode='clip')
                model.multiply(own, phi)
            yield found

    def _motions(self, model: ErrorModel) -> Iterator[tuple[tuple[FloatArray, ...], FloatArray]]:
        """Yield blocks of `parts` by motion, (M + 1, c, B), and phi (E, B) of the effects."""
        joints, velocity = self.moving(model.chain)
        out = None
        for start in range(0, max(self.count, 1), BLOCK):
            part = slice(start, start + BLOCK)
            if start + BLOCK > self.count:
                out = None  # the last is shorter
            approach = None if self.approach is None else self.approach[:, part]
            moving = None if velocity is None else velocity[:, part]
            circle = self._circle[:, :, part] if joints is self.joints else None
            points = None if self.points is None else self.points[:, part]
            axes, origin, *found, phi = model.linearise(
                joints[:, part], approach, moving, out, points, circle
            )
            out = found[0], found[1]
            shift = found[0]
            if self.distances is not None:
                shift = _range_rows(origin, shift, self.distances[part], self.observations.plane)
            else:
                np.subtract(self.positions[:, part], origin, out=shift[-1])
            if points is not None:
                shift = np.einsum('kcb,pcb->pkb', axes, shift)
            weights = 1.0 if self.weights is None else self.weights[part]
            if not self.oriented and self.whitening is None:
                shift *= weights / self.sigmas[0]
                yield (shift,), phi
                continue
            turn = np.zeros_like(shift)
            turn[: model.rotations] = found[1][:-1]
            if self.oriented:
                turn[-1] = orientation_error(self.rotations[:, :, part], axes)
            if self.whitening is not None:
                if self.observations.covariance is not None:
                    back = se3.left_jacobian_inverse(-turn[-1].T)
                    turn[:-1] = np.einsum('bij,pjb->pib', back, turn[:-1], optimize=True)
                both = np.concatenate([shift, turn], axis=1) * weights
                whitening = self.whitening[:, :, part]
                mixed = np.einsum('rsb,psb->prb', whitening, both, optimize=True)
                yield (np.ascontiguousarray(mixed),), phi
                continue
            shift *= weights / self.sigmas[0]
            turn *= weights / self.sigmas[1]
            yield (shift, turn), phi

    @property
    def width(self) -> int:
        """Return the number of rows of a sample: of its position, or of all if whitened."""
        return 1 if self.distances is not None else 6 if self.whitening is not None else 3

    def rows_of(self, chain: Chain, names: Sequence[str]) -> FloatArray:
        """Return the weighted rows (P + 1, c, N) sample by sample, the residual last."""
        found = [np.concatenate(parts, axis=1) for parts in self.parts(chain, names)]
        return found[0] if len(found) == 1 else np.concatenate(found, axis=2)

    def position_errors(self, residuals: FloatArray) -> FloatArray:
        """Return position errors (N, 3) [m] of weighted residuals (rows,).

        Residuals are ordered component by component, as rows; of distances the error is the first.
        """
        rows = residuals.reshape(-1, self.count).T
        if self.whitening is not None:  # lower triangular: no orientation in it
            mixing = self.whitening[:3, :3].transpose(2, 0, 1)
            return np.asarray(np.linalg.solve(mixing, rows[:, :3, np.newaxis])[..., 0])
        errors = np.zeros((self.count, 3))
        width = 1 if self.distances is not None else 3
        errors[:, :width] = self.sigmas[0] * rows[:, :width]
        return errors

    def whitened_residuals(self, chain: Chain) -> Both:
        """Return the residuals by a chain `in_sigma`."""
        return self.in_sigma(*residual_arrays(chain, self.observations))

    def in_sigma(self, position: FloatArray, orientation: FloatArray) -> Both:
        """Return residuals in sigma: position (N, 3 or 1), orientation (N, 3).

        NaN where not measured. With covariances, samples are whitened as a whole, so the two parts
        are only approximate.
        """
        if self.whitening is not None:
            both = np.concatenate([position, np.nan_to_num(orientation)], axis=1)
            both = np.einsum('rsn,ns->nr', self.whitening, both)
            position, turned = both[:, :3], both[:, 3:]
            return position, np.where(self.observations.oriented[:, None], turned, np.nan)
        turned = orientation / self.sigmas[1] if self.oriented else orientation
        return position / self.sigmas[0], turned

    def misfits(self, chain: Chain) -> Iterator[tuple[FloatArray, Index | slice]]:
        """Yield residuals (M, c) in sigma, NaN if not measured, and each sample's row (N,)."""
        for part in self.whitened_residuals(chain)[: 1 + self.oriented]:
            yield part, slice(None)


def summed(values: FloatArray, begins: Index) -> FloatArray:
    """Return the sums (..., n) of values (..., N) over successive groups that begin there (n,)."""
    alone = len(begins) == values.shape[-1]
    return values if alone else np.add.reduceat(values, begins, axis=-1)


def gram(rows: FloatArray) -> FloatArray:
    """Return the products (P, P) of rows (P, c, N)."""
    flat = rows.reshape(len(rows), -1)
    return np.asarray(flat @ flat.T)


def _add_products(found: FloatArray, rows: FloatArray, phi: FloatArray, motions: Index) -> None:
    """Add the products of effects, then motions (M + 1, c, N), to those `found`.

    Unless samples are few, the rows of effects with phi (E, N), in the order of their `motions`
    (E,), are not formed: their products are those of phi, weighted by the products of two motions
    at each sample.
    """
    if len(motions) and rows.shape[2] < BLOCK // 4:
        rows, motions = np.concatenate([rows[motions] * phi[:, np.newaxis], rows]), motions[:0]
    count = len(motions)
    found[count:, count:] += gram(rows)
    if not count:
        return
    ends = [*np.flatnonzero(np.diff(motions, prepend=-1)).tolist(), count]
    weighted = np.empty((len(found), rows.shape[2]))
    for number, (first, last) in enumerate(pairwise(ends)):
        weights = np.einsum('pcn,cn->pn', rows, rows[motions[first]], out=weighted[count:])
        for other, end in pairwise(ends[number:]):
            np.multiply(phi[other:end], weights[motions[other]], out=weighted[other:end])
        products = phi[first:last] @ weighted[first:].T
        found[first:last, first:] += products
        found[last:, first:last] += products[:, last - first :].T


def cached(find: Callable[[Chain, Observations], Both]) -> Callable[[Chain, Observations], Both]:
    """Cache the residuals of the last chain in the observations."""

    @wraps(find)
    def found(chain: Chain, observations: Observations) -> Both:
        known = vars(observations).get('_residuals')
        if known is None or known[0] is not chain:
            known = vars(observations)['_residuals'] = (chain, find(chain, observations))
            for each in known[1]:
                each.setflags(write=False)
        arrays: Both = known[1]
        return arrays

    return found


@cached
def residual_arrays(chain: Chain, observations: Observations) -> Both:
    """Return measured minus predicted: position (N, 3) [m], rotation vector (N, 3) [rad].

    Distances give (N, 1). Rotation vectors are NaN where not measured.
    """
    turned = observations.oriented
    alike = observations.changed(covariance=None, oriented=np.full_like(turned, turned.any()))
    vars(alike)['by_joint'] = observations.by_joint
    plain = Samples(alike, 1.0, 1.0)
    rows = plain.rows_of(chain, ())[0].T
    position = np.ascontiguousarray(rows[:, :3])
    orientation = np.full((len(rows), 3), np.nan)
    if plain.oriented:
        orientation[turned] = rows[turned, 3:]
    return position, orientation


def _range_rows(
    origin: FloatArray, shift: FloatArray, distances: FloatArray, plane: bool
) -> FloatArray:
    """Return rows (P + 1, 1, B) along the line of sight or a plane's normal z, and L - |p|."""
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
    """Return W (6, 6, N) with W^T W the inverse covariance; zero rows if not measured."""
    covariance = observations.covariances((sigma_position, sigma_orientation))
    covariance[~observations.oriented, 3:, :] = 0.0
    covariance[~observations.oriented, 3:, 3:] = np.eye(3)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    whitening[~observations.oriented, 3:, :] = 0.0
    return np.ascontiguousarray(whitening.transpose(1, 2, 0))
