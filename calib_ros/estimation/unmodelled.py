# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of the arm that no parameter explains: how far its joints turn and their axes tilt.

docs/model.md (What no parameter explains) gives the reasons. Waves of size s, with the parameters
integrated out, have the log evidence

    (p^T (W + I / s^2)^-1 p - log det(I + s^2 W)) / 2

with the products W of their columns and p of these with the residuals, both beside the parameters.

The rest is random, from stop to stop. With the columns Q of the posterior, and of waves that show,
scaled by a root of the covariance, the residuals r have the covariance B V B + B - B^2, B = I -
Q Q^T. In

    V = v_0 I_position + v_1 I_orientation + v_2 K_turns + v_3 K_tilts

K holds the products, stop by stop, of the columns of turns of all joints about their axes, or of
tilts. If a test finds r^T K r larger than white noise allows, sizes v >= 0 equate these forms with
their expected values (MINQUE, Rao 1971).

Waves and considered effects (`evidence.py`) also move the fitted parameters: those of columns A
and expected squares S add H^-1 (J^T A S A^T J) H^-1 to the covariance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from calib_ros.estimation.configurations import configurations
from calib_ros.estimation.gain import about_nominal
from calib_ros.estimation.gross_errors import SUSPICIOUS
from calib_ros.estimation.joint_errors import (
    Unmodelled,
    axis_parameters,
    turns_and_tilts,
    wobble_columns,
)
from calib_ros.estimation.levels import CERTAIN, CONFIDENT, SEVERAL
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.posterior import Posterior
from calib_ros.estimation.quadratic_forms import nonnegative
from calib_ros.estimation.samples import gram
from calib_ros.estimation.sizes import LEAST_SIZE, REFUTED, SHOWN, SPREAD, TYPICAL, solved
from calib_ros.estimation.stops import gathered
from calib_ros.estimation.system import System
from calib_ros.estimation.uncertainty import covariance
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray, Index


def unmodelled_errors(
    posterior: Posterior, factor: FloatArray, system: System
) -> tuple[Unmodelled, FloatArray]:
    """Return what no parameter explains; random turns and tilts are zero without evidence.

    Then follow the expected squares (F, F) that considered effects and waves add to the F
    parameters of the fit with that `factor` (F, F), the first of the posterior's names. Parameters
    held at nominal have no prior: the fit includes them already.
    """
    chain, names = posterior.chain, posterior.names
    count, own = len(names), len(factor)
    every = tuple(dict.fromkeys((*names, *axis_parameters(chain))))
    units, stride = gathered(chain, every, system, SOME_POSES)
    used = [part for part in units.parts if part.any()]
    rows = np.concatenate([np.zeros((len(every) + 1, 0, len(units))), *used], axis=1)
    part_of = np.arange(len(used)).repeat([part.shape[1] for part in used])
    random = turns_and_tilts(chain, every, rows)
    rows = np.concatenate([rows[:count], wobble_columns(random[1], units.joints), rows[-1:]])
    products = np.array([gram(rows[:, part_of == k]) for k in range(len(used))])
    groups = configurations(units.joints)
    sizes = _sizes(posterior, rows, (part_of, groups), products, random)
    rest = [k for k, name in enumerate(names) if name in posterior.priors and k >= own]
    along = stride * products.sum(axis=0)[:own, :-1]
    middle = along[:, rest] @ posterior.square[np.ix_(rest, rest)] @ along[:, rest].T
    followed = covariance(factor) @ along[:, count:]
    return sizes._replace(names=names[:own], followed=followed), covariance(factor, middle)


def _sizes(
    posterior: Posterior,
    rows: FloatArray,
    owners: tuple[Index, Index],
    products: FloatArray,
    random: Sequence[FloatArray],
) -> Unmodelled:
    """Return the sizes of turns, tilts and waves, and whether they show.

    From weighted rows (P + T + 1, c, n), those of T waves and the residual last, of parts (c,) and
    configurations (n,), their `products` by part, and rows of `random` turns and tilts.
    """
    part_of, groups = owners
    given = np.array([posterior.priors.get(name, np.inf) for name in posterior.names]) ** -2.0
    counts = np.bincount(part_of, rows.any(axis=0).sum(axis=1))
    none = np.zeros(len(rows) - 1 - len(given))
    offsets, precision = np.append(posterior.offsets, none), given
    for _ in range(SEVERAL):
        variances, shift = _variances(products, offsets, precision, counts)
        if not variances.all():
            return Unmodelled(waves=TYPICAL['drive'])
        left = rows[-1] - np.tensordot(shift, rows[: len(shift)], 1)
        often = _shared(left, part_of, groups)
        total = np.tensordot(1.0 / (often * variances), products, 1)
        waves, found = _size_of_waves(*about_nominal(total[:-1], offsets), given)
        if found is None:
            break
        precision = np.append(given, none + found**-2.0)
    own = np.s_[: len(precision)]
    total = np.tensordot(1.0 / variances, products, 1)
    matrix, vector = about_nominal(total[:-1], offsets)
    mean, root = solved(matrix[own, own], vector[own], precision)
    scale = np.sqrt(variances)[part_of, np.newaxis]
    left = rows[-1] + np.tensordot(offsets[own] - mean, rows[own], 1)
    every = *random, np.tensordot(root.T, rows[own], 1), left[np.newaxis]
    turned, tilted, basis, residual = (
        np.ascontiguousarray((each / scale).transpose(2, 1, 0)) for each in every
    )
    whites = rows.any(axis=0).T & (part_of == np.arange(len(variances))[:, np.newaxis, np.newaxis])
    kernels = [*whites[..., np.newaxis] * np.eye(len(part_of))]
    kernels += [each @ np.swapaxes(each, 1, 2) for each in (turned, tilted)]
    (turns, tilts), sure = _random(np.array(kernels), basis, residual[..., 0], variances)
    return Unmodelled(float(turns), float(tilts), waves, shown=found is not None, random=sure)


def _size_of_waves(
    matrix: FloatArray, vector: FloatArray, given: FloatArray
) -> tuple[float, float | None]:
    """Return the size of waves that counts, and the most probable one if waves show.

    From normal matrix and vector of P parameters, with prior precisions `given` (P,), and waves.
    """
    own, waves, typical = np.s_[: len(given)], np.s_[len(given) :], TYPICAL['drive']
    mean, root = solved(matrix[own, own], vector[own], given)
    along = matrix[waves, own] @ root
    known, axes = np.linalg.eigh(matrix[waves, waves] - along @ along.T)
    pulled = (vector[waves] - matrix[waves, own] @ mean) @ axes
    tried = typical * np.geomspace(LEAST_SIZE, 1.0 / LEAST_SIZE, 201)  # the typical one amidst
    seen = np.outer(tried**2, np.maximum(known, 0.0))
    squares = np.outer(tried**2, pulled**2) / (1.0 + seen)
    odds = 0.5 * (squares - np.log1p(seen)).sum(axis=1)  # against none
    likely = odds - 0.5 * (np.log(tried / typical) / np.log(SPREAD)) ** 2
    best = np.argmax(likely)
    found = float(tried[best]) if odds[best] > SHOWN else None
    weights = np.exp(likely - likely[best])
    if odds[best] - odds[len(tried) // 2] >= 2.0 * REFUTED:  # less is unusual
        return found or 0.0, found
    most = tried[np.searchsorted(np.cumsum(weights), CONFIDENT * weights.sum())]
    return min(float(most), max(typical, found or 0.0)), found


def _variances(
    products: FloatArray, offsets: FloatArray, precision: FloatArray, counts: FloatArray | Index
) -> tuple[FloatArray, FloatArray]:
    """Return the variance (K,) of noise by part of so many rows; zero if they are too few.

    By the products of the first P columns, with the prior `precision` (P,) of their `offsets`, and
    their change (P,).
    """
    own = np.s_[: len(precision)]
    variances, pulled = np.ones(len(products)), offsets[own] * precision
    for _ in range(SEVERAL):
        total = np.tensordot(1.0 / variances, products, 1)
        mean, root = solved(total[own, own], total[own, -1] - pulled, precision)
        taken = np.tensordot(products[:, own, own], root @ root.T) / variances
        left = products[:, -1, -1] - 2.0 * products[:, -1, own] @ mean
        left += mean @ products[:, own, own] @ mean
        if not (taken < counts).all():
            return np.zeros(len(products)), mean
        # waves must not be found in the rounding of poses that a fit meets exactly
        variances = np.maximum(left / (counts - taken), HALF_THE_DIGITS)
    return variances, mean


def _shared(left: FloatArray, part_of: Index, groups: Index) -> FloatArray:
    """Return how many times (K,) the squares of residuals (c, n) grow if summed by group (n,).

    Targets at one stop, and visits to it, share errors of the arm, and tell no more than one.
    """
    summed = np.array([(np.bincount(groups, row) ** 2).sum() for row in left])
    ratio = np.bincount(part_of, summed) / np.bincount(part_of, (left**2).sum(axis=1))
    return np.where(ratio > SUSPICIOUS, ratio, 1.0)


def _random(
    kernels: FloatArray, basis: FloatArray, residual: FloatArray, variances: FloatArray
) -> tuple[FloatArray, bool]:
    """Return the standard deviations (2,) of the last two kernels (K + 2, n, c, c), if by a test.

    For the posterior's columns (n, c, P), scaled, and its residuals (n, c), and the noise (K,).
    Turns that the test would not tell from noise, else tilts, have its size beyond the sigma.
    """
    listed = kernels.reshape(len(kernels), -1)
    taken = listed @ (basis @ np.swapaxes(basis, 1, 2)).ravel()
    values = listed @ (residual[:, :, np.newaxis] * residual[:, np.newaxis]).ravel()
    pairs, white, arm = listed @ listed.T, np.s_[:-2], np.s_[-2:]
    excess = (values + taken - np.einsum('knii->k', kernels))[arm]
    sizes = np.diag(pairs)  # white kernels have nothing in common
    own = sizes[arm] - (pairs[arm, white] ** 2 / sizes[white]).sum(axis=1)
    clear = np.where(own > HALF_THE_DIGITS * sizes[arm], own, np.inf)  # not white but for rounding
    limit = special.ndtri(0.5 + 0.5 * CERTAIN) * np.sqrt(2.0 * clear)
    if not (excess > limit).any():
        beyond = np.where(variances > SUSPICIOUS**2, 1.0 - 1.0 / variances, 0.0)
        squares = (pairs[arm, white] @ beyond) / np.maximum(sizes[arm], 1e-300)
        hidden = squares * own <= limit  # the test would not tell them from noise
        hidden[1] &= not hidden[0]
        return np.sqrt(squares * hidden), False
    flat, spread = (x.reshape(*x.shape[:-3], -1, x.shape[-1]) for x in (basis, kernels @ basis))
    inner = flat.T @ spread
    cross, both = (x @ x.T for x in (x.reshape(len(kernels), -1) for x in (spread, inner)))
    values -= taken - np.tensordot(inner, inner[white].sum(axis=0))
    return np.sqrt(nonnegative(pairs - 2.0 * cross + both, values)[arm]), True
