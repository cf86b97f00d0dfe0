# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Can drift of the device explain a gain?

A tracker drifts, so successive errors are similar. Poses along a path change as slowly, and a
model can follow the drift: it then gains even on poses left out between fitted ones. But drift
does not depend on joint values: shifted in time against them, it would be explained equally well.
So the residuals are shifted in time by every possible amount, and the model is fitted to each.
Whatever the autocorrelation of stationary errors, the unshifted gain has any rank among the
shifted ones with equal probability (a randomisation test); a true model explains most unshifted.

Of residuals r, columns A beside the columns F of the model before them explain the share

    (e(F, A) - e(F)) / (|r|^2 - e(F))        e(X) = r^T X (X^T X + L)^-1 X^T r

where L holds the inverse variances of priors. A series is closed to a circle by its mirror image.
Its slowest part, which is not stationary, is removed from residuals and columns: a few cosines
over the session. Samples of one stop move together, as their sum; those of pixels also with their
first moments. All shifts of X^T r are one circular correlation, computed by fast Fourier
transforms.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from calib_ros.identification.leastsquares import System
from calib_ros.identification.levels import SEVERAL
from calib_ros.identification.observations import SOME_POSES, Observations
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, ROUNDING, FloatArray

SLOW = SEVERAL
"""Cosines that are taken out of a series at most; no more than one for ten stops
(benchmarks/drift.py)."""
SHIFTS = 2 * SOME_POSES
"""Shifts that are tried at most, forwards and backwards; the first of them is none
(benchmarks/drift.py)."""


Columns: TypeAlias = tuple[FloatArray, FloatArray]
"""X^T X (P, P) of columns X without their slowest part, with the normal matrix of the priors, and
X^T r (P, S) by shift."""


class Shifts:
    """Residuals moved in time, those of every set by the same share of its length.

    Parameters
    ----------
    system : System
        Samples in the order in which they were taken; those of one stop move together.
    residuals : sequence of (c, N)
        Weighted residuals of each set, sample by sample.

    """

    def __init__(self, system: System, residuals: Sequence[FloatArray]) -> None:
        numbers = [samples.observations.stops for samples in system.sets]
        self._begins = [np.flatnonzero(np.diff(each, prepend=-1)) for each in numbers]
        count = min(SHIFTS, 2 * max(len(begins) for begins in self._begins))
        self._share = np.arange(count) / count
        self._weights = [
            _weights(samples.observations, begins)
            for samples, begins in zip(system.sets, self._begins, strict=True)
        ]
        self._circles: list[NDArray[np.complex128]] = []
        self._energy = np.zeros(count)
        for begins, weights, residual in zip(self._begins, self._weights, residuals, strict=True):
            series = _by_stop(residual, begins, weights)
            circle = np.concatenate([series, series[:, ::-1]], axis=1)
            length = len(begins)
            again = np.concatenate([circle, series], axis=1)  # as far as a moved series reaches
            self._circles.append(fft.rfft(again, _period(length)))
            squares = np.concatenate([[0.0], np.cumsum(np.tile((circle**2).sum(axis=0), 2))])
            slow = _correlated(slow_cosines(length)[:, np.newaxis], self._circles[-1], each=True)
            energy = squares[length : 3 * length] - squares[: 2 * length]
            self._energy += self._sampled(energy - (slow**2).sum(axis=(0, 1)))

    def columns(self, columns: Iterable[Sequence[FloatArray]], inverse: FloatArray) -> Columns:
        """Return the products of weighted columns, (P, c, N) for each set.

        They may come in several lots; `inverse` (P,) is 1 / sigma of the priors of all of them,
        zero without one.
        """
        rows, products = [], []
        for lot in columns:
            parts = []
            products.append(np.zeros((len(lot[0]), len(self._share))))
            for begins, weights, circle, column in zip(
                self._begins, self._weights, self._circles, lot, strict=True
            ):
                series = _by_stop(column, begins, weights)
                whole = np.linalg.norm(series, axis=(1, 2))
                slow = slow_cosines(len(begins))
                series -= series @ slow.T @ slow
                rounding = np.linalg.norm(series, axis=(1, 2)) <= HALF_THE_DIGITS * whole
                series[rounding] = 0.0
                products[-1] += self._sampled(_correlated(series, circle))
                parts.append(series.reshape(len(series), -1))
            rows.append(np.concatenate(parts, axis=1))
        every = np.concatenate(rows)
        return every @ every.T + np.diag(inverse**2), np.concatenate(products)

    def shares(
        self, columns: Columns, known: Sequence[int], groups: Sequence[Sequence[int]]
    ) -> FloatArray:
        """Return the share (G, S) that each group (G, K) of columns explains beside those known.

        By shift; each group is taken by itself.
        """
        every, moved = columns
        matrix = every[np.ix_(known, known)]
        root = inverse_root(matrix, np.diag(matrix))
        gone = root.T @ moved[known]
        which = np.array(groups)
        cross = every[which][:, :, known] @ root  # (G, K, P)
        products = moved[which] - cross @ gone
        own = every[which[:, :, np.newaxis], which[:, np.newaxis]]
        size = np.einsum('gkk->gk', own)
        mine = inverse_root(own - cross @ np.swapaxes(cross, 1, 2), size)
        found = ((np.swapaxes(mine, 1, 2) @ products) ** 2).sum(axis=1)
        left = np.maximum(self._energy - (gone**2).sum(axis=0), 1e-300)
        return np.asarray(found / left)

    def _sampled(self, shifted: FloatArray) -> FloatArray:
        """Return (..., S) of all shifts (..., 2 n) of a set."""
        return shifted[..., (self._share * shifted.shape[-1]).astype(int)]


def _by_stop(values: FloatArray, begins: NDArray[np.intp], weights: FloatArray) -> FloatArray:
    """Return (..., m c, n) the sums over each stop of (..., c, N) with weights (m, N)."""
    parts = [each * values for each in weights]
    if len(begins) < values.shape[-1]:
        parts = [np.add.reduceat(part, begins, axis=-1) for part in parts]
    return np.asarray(np.concatenate(parts, axis=-2))


def _weights(observations: Observations, begins: NDArray[np.intp]) -> FloatArray:
    """Return the weights (m, N) of the rows of each stop: one by the root of their number.

    Of pixels also where they are, of mean square 1 in each stop: their sum tells of a shift alone,
    with the first moments of the whole pose of the camera.
    """
    count = np.diff(begins, append=len(observations))
    number = np.repeat(np.arange(len(begins)), count)
    root = 1.0 / np.sqrt(count)[number]
    if observations.pixels is None:
        return root[np.newaxis]

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray((np.add.reduceat(values, begins) / count[:, np.newaxis])[number])

    centred = observations.pixels - mean(observations.pixels)
    centred /= np.maximum(np.sqrt(mean(centred**2)), 1e-9)  # corners in a line
    return np.concatenate([root[np.newaxis], root * centred.T])


def slow_cosines(length: int) -> FloatArray:
    """Return (K, length) orthonormal: the constant and the slowest cosines of a series."""
    order = np.arange(1 + min(SLOW, length // 10))
    waves = np.cos(np.pi * np.outer(order, (np.arange(length) + 0.5) / length))
    return np.asarray(waves / np.linalg.norm(waves, axis=1, keepdims=True))


def _period(length: int) -> int:
    """Return the period of the transforms of a series: that of its circle where that is fast."""
    circle = 2 * length
    if fft.next_fast_len(circle, real=True) == circle:
        return circle
    return int(fft.next_fast_len(3 * length, real=True))


def _correlated(
    series: FloatArray, circle: NDArray[np.complex128], each: bool = False
) -> FloatArray:
    """Return (P, 2 n) the products of series (P, c, n) with the circle (c, K) moved by each shift.

    Summed over the components c; (P, c, 2 n) of `each` if asked.
    """
    length = _period(series.shape[-1])
    spectrum = fft.rfft(series, length)
    np.conj(spectrum, out=spectrum)
    found = fft.irfft(np.einsum('pck,ck->pck' if each else 'pck,ck->pk', spectrum, circle), length)
    return np.asarray(found[..., : 2 * series.shape[-1]])


def inverse_root(matrix: FloatArray, size: FloatArray) -> FloatArray:
    """Return T (..., P, P), T T^T being the inverse of (..., P, P) in the directions that count.

    Those are seen with columns scaled to squared lengths `size` (..., P); others are zero.
    """
    scale = 1.0 / np.sqrt(np.maximum(size, 1e-300))
    sizes, vectors = np.linalg.eigh(matrix * (scale[..., np.newaxis] * scale[..., np.newaxis, :]))
    good = sizes > ROUNDING
    lengths = good / np.sqrt(np.where(good, sizes, 1.0))
    return np.asarray(scale[..., np.newaxis] * vectors * lengths[..., np.newaxis, :])


def chance(shares: FloatArray) -> float:
    """Return how often moved residuals are as well explained as those in place, by shares (S,).

    The first is that of those in place.
    """
    return float(np.mean(shares[1:] >= shares[0]))


def chance_of_gain(
    chain: Chain, before: Sequence[str], added: Sequence[str], system: System
) -> float:
    """Return how probable it is that what parameters explain beside those before is chance.

    The system is linearised at a chain that is fitted by those before.
    """
    if not added:
        return 1.0
    names = [*before, *added]
    rows = system.rows_of(chain, names)
    shifts = Shifts(system, [each[-1] for each in rows])
    prior = system.prior
    inverse = np.zeros(len(names)) if prior is None else prior.rows(chain, names)[0]
    columns = shifts.columns([[each[:-1] for each in rows]], inverse)
    numbers = range(len(names))
    return chance(shifts.shares(columns, numbers[: len(before)], [numbers[len(before) :]])[0])
