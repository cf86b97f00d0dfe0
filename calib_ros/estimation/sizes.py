# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of the errors of each kind: the most probable given the data (`evidence.py`)."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import special
from scipy.linalg import lapack

from calib_ros.estimation.levels import CONFIDENT
from calib_ros.kinematics.effects import EXPECTED
from calib_ros.kinematics.se3 import ROUNDING, ROUNDS, FloatArray

TYPICAL = {
    'length': 5e-4,
    'angle': 1e-3,
    'drive': EXPECTED['gear'],
    'harmonic': EXPECTED['gear'],
    'coupling': 1e-3,
    'frame': 1e-3,
}
TYPICAL |= {group: EXPECTED[group] for group in ('ratio', 'gravity', 'compliance', 'backlash')}
"""Size [m, rad] of the errors that arms, and frames said to be known, have, by group."""
SPREAD = 10.0
"""Factor between the error sizes of one arm and TYPICAL (one standard deviation;
benchmarks/harm.py)."""
TAILS = 3.0  # degrees of freedom of the prior (benchmarks/harm.py)
SHOWN, REFUTED = 0.5 * special.ndtri(CONFIDENT) ** 2, special.logit(CONFIDENT)
"""Logarithms of the ratio of probabilities beyond which effects show, and from which those of
usual size are refuted."""
SETTLED = 0.02  # change of the log of a size at convergence; a convention
LEAST_SIZE = SPREAD**-3
"""Smallest size searched, relative to TYPICAL; its inverse is the largest."""


def solved(
    matrix: FloatArray, vector: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean (P,) and a root (P, P) of the covariance."""
    inverse = lapack.dtrtri(_factor(matrix, precision), lower=1, overwrite_c=1)[0]
    return inverse.T @ (inverse @ vector), inverse.T


def mixed(
    solutions: Sequence[tuple[FloatArray, FloatArray]], weights: Sequence[float]
) -> tuple[FloatArray, FloatArray]:
    """Return mean (P,) and covariance (P, P) of a weighted mixture of means and roots."""
    shares = np.divide(weights, np.sum(weights))
    mean = shares @ [each for each, _ in solutions]
    parts = [np.column_stack([root, each - mean]) for each, root in solutions]
    root = np.concatenate([np.sqrt(w) * part for w, part in zip(shares, parts, strict=True)], 1)
    return mean, root @ root.T


def _factor(matrix: FloatArray, precision: FloatArray) -> FloatArray:
    """Return the lower triangular factor (P, P) of a matrix and precisions (P,).

    Rounding does not depend on the scale of the columns.
    """
    posterior = matrix.copy()
    diagonal = posterior.reshape(-1)[:: len(matrix) + 1]  # a view
    diagonal += precision
    diagonal += ROUNDING * np.maximum(diagonal, 1e-300)  # never singular
    factor, failed = lapack.dpotrf(posterior.T, lower=1, overwrite_a=1)
    if failed or not np.isfinite(diagonal.sum()):
        raise np.linalg.LinAlgError('singular posterior')
    return np.asarray(factor)


class Evidence:
    """Evidence of the data for sizes of the errors."""

    def __init__(
        self,
        matrix: FloatArray,
        vector: FloatArray,
        given: FloatArray,
        groups: Sequence[str | None],
        typical: Mapping[str, float],
    ) -> None:
        self._matrix, self._vector, self._given = matrix, vector, given
        self._names = [*dict.fromkeys(group for group in groups if group is not None)]
        rows = [[group == name for group in groups] for name in self._names]
        self._member = np.array(rows, dtype=float).reshape(len(rows), len(groups))
        self._typical = np.log([typical[name] for name in self._names])
        self._own = np.array([group in ('length', 'angle') for group in groups])
        self._tails = np.ones(len(groups))

    def most_probable(self, considered: set[str | None]) -> tuple[FloatArray, FloatArray]:
        """Return the log size of each group (G,), and the curvature (G,) there.

        Considered effects have size zero if the data rule out the usual size and show no effect.
        """
        size, width = self._typical.copy(), np.log(SPREAD) ** -2
        if self._own.sum() == self._member.sum():
            mean, variance = self._means(self._weight(size - np.log(LEAST_SIZE)))
            surely = np.maximum(np.abs(mean) - 2.0 * np.sqrt(variance), 0.0)
            self._lengthen(surely**2, 1.0, size)
        for _ in range(ROUNDS):
            weight = self._weight(size)
            mean, variance = self._means(weight)
            gamma = (self._member - weight * variance).sum(axis=1)
            slope = weight @ mean**2 - gamma - width * (size - self._typical)
            step = slope / (2.0 * np.maximum(gamma, 0.0) + width)
            step = np.maximum(np.minimum(step, 1.0), -1.0)  # np.clip is slow
            last, size = size, self._within(size + step)
            self._lengthen(mean**2 + variance, 0.0, size)
            if np.abs(size - last).max(initial=0.0) < SETTLED:
                break
        for k, name in enumerate(self._names):
            if name in considered:
                tried = np.tile(size, (3, 1))
                tried[1:, k] = self._typical[k] + np.log(LEAST_SIZE), self._typical[k]
                here, without, usual = self._log_evidence(tried).tolist()
                if not here - without > SHOWN and without - usual > REFUTED:
                    size = tried[1]
        return size, 2.0 * np.maximum(gamma, 0.0) + width

    def odds_against(
        self, usual: Evidence, size: FloatArray, considered: set[str | None]
    ) -> tuple[float, FloatArray, FloatArray]:
        """Return the log odds against the usual evidence at log sizes (G,); mean (P,), covariance.

        The most probable sizes are searched anew; those found may also be likelier by the usual.
        """
        found, _ = self.most_probable(considered)
        alike = copy.copy(usual)
        alike._tails = self._tails[: len(usual._tails)]
        usually = max(usual._probable(size), alike._probable(found[: len(size)]))
        odds = self._probable(found) - usually
        precision = self.widened(found).precision(found)
        mean, root = solved(self._matrix, self._vector, precision)
        return odds, mean, root @ root.T

    def _probable(self, size: FloatArray) -> float:
        """Return the log probability of data and log sizes (G,), but for a constant (Laplace)."""
        mean, root = solved(self._matrix, self._vector, self.precision(size))
        fit = mean @ self._vector - 0.5 * mean @ self._matrix @ mean
        known = self._member.any(axis=0)
        sizes = self._member.T @ size
        squares = np.where(known, mean * np.exp(-sizes), 0.0) ** 2
        tails = 0.5 * (TAILS + 1.0) * np.log1p(squares / TAILS)
        usual = np.where(self._own, tails, 0.5 * squares).sum() + sizes[known].sum()
        given = self._given > 0.0
        usual += (
            0.5 * (self._given * mean**2)[given].sum() - 0.5 * np.log(self._given[given]).sum()
        )
        usual += 0.5 * (((size - self._typical) / np.log(SPREAD)) ** 2).sum()
        return float(fit - usual + np.log(np.abs(np.diag(root))).sum())

    def sigma_points(self, size: FloatArray, slope: FloatArray) -> list[tuple[float, FloatArray]]:
        """Return plausible log sizes with their weights, from the curvature (G,).

        One group differs at a time, up and down, by as much as makes means right to second order
        (unscented transform, Julier and Uhlmann 1997), weighted by their evidence. Groups of size
        zero stay so, and so does the scale of the device. Play, which frames and zeros make up for
        if joints come from one side, is at most usual, or as large as most probable.
        """
        arms = np.array([name in TYPICAL for name in self._names], dtype=bool)
        some = np.flatnonzero(arms & (size > self._typical + np.log(LEAST_SIZE)))
        if not len(some):
            return [(1.0, size)]
        steps = (np.sqrt(len(some) / slope) * np.eye(len(size)))[some]
        tried = self._within(size + np.stack([steps, -steps], axis=1).reshape(-1, len(size)))
        play = np.array([name == 'backlash' for name in self._names])
        tried = np.minimum(tried, np.where(play, np.maximum(size, self._typical), np.inf))
        unusual = (((tried - self._typical) / np.log(SPREAD)) ** 2).sum(axis=1)
        likely = self._log_evidence(tried) - 0.5 * unusual
        upper = special.expit(likely[::2] - likely[1::2])
        weights = np.stack([upper, 1.0 - upper], axis=1).ravel() / len(some)
        return list(zip(weights.tolist(), tried, strict=True))

    def _within(self, size: FloatArray) -> FloatArray:
        """Return log sizes (G,) clipped to the searched range."""
        most = -np.log(LEAST_SIZE)
        return np.asarray(np.maximum(np.minimum(size, self._typical + most), self._typical - most))

    def widened(self, size: FloatArray) -> Evidence:
        """Return it with variances averaged over the tails of the prior, for log sizes (G,)."""
        found = copy.copy(self)
        for _ in range(ROUNDS):
            mean, variance = found._means(found._weight(size))
            last = found._tails
            found._lengthen(mean**2 + variance, 0.0, size, TAILS - 1.0)
            if np.abs(np.log(found._tails / last)).max(initial=0.0) < SETTLED:
                break
        return found

    def _means(self, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return means and variances (P,) for inverse variances (G, P) by group."""
        mean, root = solved(self._matrix, self._vector, self._given + weight.sum(axis=0))
        return mean, np.einsum('pk,pk->p', root, root)

    def precision(self, size: FloatArray) -> FloatArray:
        """Return the prior precision (..., P) of the parameters for log sizes (..., G)."""
        return np.asarray(self._given + self._weight(size).sum(axis=-2))

    def named(self, size: FloatArray) -> dict[str, float]:
        """Return the size [m, rad] of each group from log sizes (G,)."""
        return dict(zip(self._names, np.exp(size).tolist(), strict=True))

    def _lengthen(
        self, squares: FloatArray, more: float, size: FloatArray, freedom: float = TAILS + 1.0
    ) -> None:
        """Set the tails of the prior for offsets of expected squares (P,), plus `more` sizes.

        Effects have none: drives of one make are alike.
        """
        far = self._member.T @ np.exp(-2.0 * size) * squares + more
        self._tails = np.where(self._own, freedom / (TAILS + far), 1.0)

    def _weight(self, size: FloatArray) -> FloatArray:
        """Return the inverse variances (..., G, P) of the parameters of each group."""
        return np.asarray(self._member * self._tails * np.exp(-2.0 * size)[..., np.newaxis])

    def _log_evidence(self, sizes: FloatArray) -> FloatArray:
        """Return the log evidence of log sizes (S, G)."""
        factors = [_factor(self._matrix, each) for each in self.precision(sizes)]
        seen = [lapack.dtrtrs(each, self._vector, lower=1)[0] for each in factors]
        fit = 0.5 * (np.array(seen) ** 2).sum(axis=1)
        volume = np.log([np.diag(each) for each in factors]).sum(axis=1)
        return np.asarray(fit - volume - sizes @ self._member.sum(axis=1))
