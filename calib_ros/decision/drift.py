# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Can drift of the device explain a gain? A randomisation test by shifts in time.

Of residuals r, columns A added to the columns F of the previous model explain the share

    (e(F, A) - e(F)) / (|r|^2 - e(F))        e(X) = r^T X (X^T X + L)^-1 X^T r

where L holds the inverse variances of priors. It is compared with the share of residuals shifted
in time (docs/model.md, Judgement). Each series is closed to a circle by its mirror image, and its
slowest, non-stationary part is removed: a few cosines over the session. Samples of one stop move
together, as their sum; pixels also with their first moments.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from calib_ros.estimation.configurations import group_means
from calib_ros.estimation.gain import inverse_root
from calib_ros.estimation.levels import SEVERAL
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.estimation.samples import gram, summed
from calib_ros.estimation.system import System
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray, Index, norms

SLOW = SEVERAL
"""Cosines removed from a series at most, one per ten stops (benchmarks/drift.py)."""
SHIFTS = 2 * SOME_POSES
"""Shifts tried at most, forwards and backwards; the first is zero (benchmarks/drift.py)."""


ShiftProducts: TypeAlias = tuple[FloatArray, FloatArray]
"""X^T X (P, P) of detrended columns X, and X^T r (P, S) by shift."""


class Shifts:
    """Residuals shifted in time, every set by the same share of its length.

    The system's samples are in the order in which they were taken; those of one stop move
    together. The residuals (c, N) of each set are weighted.
    """

    def __init__(self, system: System, residuals: Sequence[FloatArray]) -> None:
        self._stops = []  # of each set, where they begin, and weights of their rows
        for seen in (samples.observations for samples in system.sets):
            begins = np.flatnonzero(np.diff(seen.stops, prepend=-1))
            self._stops.append((begins, _weights(seen)))
        count = min(SHIFTS, 2 * max(len(begins) for begins, _ in self._stops))
        self._shifted, self._energy = list[FloatArray](), np.zeros(count)
        for stops, residual in zip(self._stops, residuals, strict=True):
            series = _by_stop(residual, *stops)
            length = series.shape[1]
            circle = np.concatenate([series, series[:, ::-1], series], axis=1)
            every = sliding_window_view(circle, length, axis=1).swapaxes(0, 1)
            starts = np.arange(count) * 2 * length // count
            moved = every[starts].reshape(count, -1)
            slow = moved.reshape(-1, length) @ slow_cosines(length).T
            self._energy += norms(moved) ** 2 - norms(slow.reshape(count, -1)) ** 2
            self._shifted.append(moved)  # columns lack the slowest part

    def columns(self, columns: Iterable[Sequence[FloatArray]]) -> ShiftProducts:
        """Return the products of weighted columns, (P, c, N) for each set, in one or more lots."""
        lots = []
        for lot in columns:
            parts = []
            for stops, column in zip(self._stops, lot, strict=True):
                rest = _by_stop(column, *stops)
                slow, whole = slow_cosines(rest.shape[-1]), norms(rest.reshape(len(rest), -1))
                rest -= rest @ slow.T @ slow
                parts.append(rest.reshape(len(rest), -1))
                parts[-1][norms(parts[-1]) <= HALF_THE_DIGITS * whole] = 0.0  # rounding
            lots.append(parts)
        every = [np.concatenate(parts) for parts in zip(*lots, strict=True)]
        pairs = zip(every, self._shifted, strict=True)
        own, cross = sum(map(gram, every)), sum(rows @ moved.T for rows, moved in pairs)
        return np.asarray(own), np.asarray(cross)

    def shares(
        self,
        columns: ShiftProducts,
        inverse: FloatArray,
        known: Sequence[int],
        groups: Sequence[Sequence[int]],
    ) -> FloatArray:
        """Return the share (G, S), by shift, that each group (G, K) explains beside known columns.

        Each group is taken alone. `inverse` (P,) is 1 / sigma of the priors of all columns, zero
        without a prior.
        """
        every, moved = columns[0] + np.diag(inverse**2), columns[1]
        matrix = every[np.ix_(known, known)]
        root = inverse_root(matrix, np.diag(matrix))
        removed = root.T @ moved[known]
        which = np.array(groups)
        cross = every[which][:, :, known] @ root  # (G, K, P)
        products = moved[which] - cross @ removed
        own = every[which[:, :, np.newaxis], which[:, np.newaxis]]
        size = np.einsum('gkk->gk', own)
        roots = inverse_root(own - cross @ np.swapaxes(cross, 1, 2), size)
        explained = ((np.swapaxes(roots, 1, 2) @ products) ** 2).sum(axis=1)
        left = np.maximum(self._energy - (removed**2).sum(axis=0), 1e-300)
        return np.asarray(explained / left)


def _by_stop(values: FloatArray, begins: Index, weights: FloatArray) -> FloatArray:
    """Return sums over each stop (..., m c, n) of values (..., c, N) with weights (m, N)."""
    return np.concatenate([summed(each * values, begins) for each in weights], axis=-2)


def _weights(observations: Observations) -> FloatArray:
    """Return the weights (m, N) of the rows of each stop: the inverse root of their number.

    Pixels also get their image coordinates as weights, with mean square 1 in each stop: sums
    detect only shifts of the camera, first moments its whole pose.
    """
    stops = observations.stops
    root = 1.0 / np.sqrt(np.bincount(stops))[stops]
    if observations.pixels is None:
        return root[np.newaxis]
    centred = observations.pixels - group_means(observations.pixels, stops)[stops]
    centred /= np.maximum(np.sqrt(group_means(centred**2, stops)[stops]), 1e-9)  # in a line
    return np.concatenate([root[np.newaxis], root * centred.T])


def slow_cosines(length: int) -> FloatArray:
    """Return the constant and slowest cosines (K, length) of a series, orthonormal."""
    order = np.arange(1 + min(SLOW, length // 10))
    waves = np.cos(np.pi * np.outer(order, (np.arange(length) + 0.5) / length))
    return np.asarray(waves / np.linalg.norm(waves, axis=1, keepdims=True))


def chance(shares: FloatArray) -> float:
    """Return the share of shifted residuals explained as well as the unshifted, first of (S,)."""
    return float(np.mean(shares[1:] >= shares[0]))


def chance_of_gain(
    chain: Chain, before: Sequence[str], added: Sequence[str], system: System
) -> float:
    """Return the probability that the gain by added parameters is chance.

    The system is linearised at a chain fitted with the parameters before.
    """
    if not added:
        return 1.0
    names = [*before, *added]
    rows = system.rows_of(chain, names)
    shifts = Shifts(system, [each[-1] for each in rows])
    prior = system.prior
    inverse = np.zeros(len(names)) if prior is None else prior.rows(chain, names)[0]
    columns = shifts.columns([[each[:-1] for each in rows]])
    known, new = np.split(np.arange(len(names)), [len(before)])
    return chance(shifts.shares(columns, inverse, known.tolist(), [new.tolist()])[0])
