# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Noise that differs by direction: range against angles of a tracker, depth of a camera.

One sigma is given for all directions of a device. Least squares is right all the same, but its
standard deviations are not where a parameter shows in one direction only. So residuals are turned
into the axes of the device, and these into their principal axes, or into the line of sight and
what is across. With the rows of direction a alone, J_a and r_a, and H the normal matrix,

    E |r_a|^2 = sum_b v_b |B_ab|^2      B_aa = I - J_a H^-1 J_a^T,  B_ab = -J_a H^-1 J_b^T

gives the variances v (MINQUE, Rao 1971). Where Bartlett's test (1937) finds that they differ, the
covariance of the parameters is H^-1 (sum_a v_a J_a^T J_a) H^-1. Twice its size in one
direction shows in 60 poses at the level of one in a million, at which nothing is lost where noise
is alike. Such noise looks shared by
neighbours (`shared_errors.py`), as fewer components tell than are counted: what is left of it
shows in rows that are weighed by direction.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import special

from calib_ros.identification.leastsquares import System, gram
from calib_ros.identification.levels import SURE
from calib_ros.identification.samples import Samples
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray

ALONG = ((0,), (1, 2))
"""Components of the line of sight, and across."""
PRINCIPAL = ((0,), (1,), (2,))


class Directions(NamedTuple):
    """Noise of one part by direction.

    `variances` (D,) in units of the sigma given, their degrees of `freedom` (D,), and the products
    `middles` (D, P, P) of the rows in each direction, times these variances. `shapes` (N, 3, 3)
    are the covariances of each set's samples in units of the sigma given.
    """

    variances: FloatArray
    freedom: FloatArray
    middles: FloatArray
    shapes: tuple[FloatArray, ...]


def by_direction(
    chain: Chain, names: Sequence[str], system: System, factor: FloatArray, part: int
) -> Directions | None:
    """Return the noise of a part (0 position, 1 orientation) by direction, None where it is alike.

    `factor` R (P, P) is that of the weighted Jacobian with all priors.
    """
    sets = [each for each in system.sets if _of_one_sigma(each)]
    if len(sets) < len(system.sets) or len({_device(each) for each in sets}) > 1:
        return None
    if part and not all(each.oriented for each in sets):
        return None
    seen = np.zeros((3, 3))
    for each in sets:
        own = np.nan_to_num(_weighted(each, each.whitened_residuals(chain)[part]))
        own = np.einsum('nai,na->ni', _axes(each), own)
        seen += own.T @ own
    main = np.linalg.eigh(seen)[1]
    found: list[tuple[float, Directions]] = []
    for groups, freedoms in ((PRINCIPAL, 5), (ALONG, 1)):
        frames = [_axes(each) @ main if groups is PRINCIPAL else _sights(each) for each in sets]
        products, count = _products(chain, names, sets, frames, part, groups)
        told = _variances(products, count, factor)
        if told is None:
            continue
        sizes = np.repeat(told.variances, [len(group) for group in groups])
        shapes = tuple((axes * sizes) @ np.swapaxes(axes, 1, 2) for axes in frames)
        found.append((_chance(told, freedoms), told._replace(shapes=shapes)))
    chance, best = min(found, key=lambda one: one[0], default=(1.0, None))
    return best if len(found) * chance < (1.0 - SURE) ** 2 else None


def weighed(system: System, found: Mapping[int, Directions]) -> System:
    """Return the samples weighed by the noise that was found in each direction, by part."""
    sets = []
    for number, samples in enumerate(system.sets):
        covariance = np.zeros((samples.count, 6, 6))
        for part, sigma in enumerate(samples.sigmas):
            shape = found[part].shapes[number] if part in found else np.eye(3)
            here = np.s_[:, 3 * part : 3 * part + 3, 3 * part : 3 * part + 3]
            covariance[here] = sigma**2 * shape
        seen = replace(samples.observations, covariance=covariance)
        other = type(samples)(seen, *samples.sigmas)
        other.weights = samples.weights
        sets.append(other)
    return replace(system, sets=tuple(sets))


def _of_one_sigma(samples: Samples) -> bool:
    """Tell whether it is poses or positions that have no covariance of their own."""
    seen = samples.observations
    plain = samples.whitening is None and seen.distances is None and seen.pixels is None
    return plain and not seen.socket


def _device(samples: Samples) -> tuple[str, bool]:
    seen = samples.observations
    return (seen.tool if seen.inverse else seen.base), seen.inverse


def _axes(samples: Samples) -> FloatArray:
    """Return the axes (N, 3, 3) of the device in the world, as columns."""
    seen = samples.observations
    return seen.rotations if seen.inverse else np.broadcast_to(np.eye(3), (len(seen), 3, 3))


def _sights(samples: Samples) -> FloatArray:
    """Return axes (N, 3, 3) in the world, as columns, the first along the line of sight."""
    seen = samples.observations
    places = seen.positions if not seen.inverse else -seen.positions  # from target to device
    along = places / np.maximum(np.linalg.norm(places, axis=1, keepdims=True), 1e-9)
    least = np.eye(3)[np.abs(along).argmin(axis=1)]
    across = np.cross(along, least)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    return np.stack([along, across, np.cross(along, across)], axis=2)


def _weighted(samples: Samples, rows: FloatArray) -> FloatArray:
    """Return residuals (N, 3) times the roots of the weights of their samples."""
    return rows if samples.weights is None else samples.weights[:, np.newaxis] * rows


def _products(
    chain: Chain,
    names: Sequence[str],
    sets: Sequence[Samples],
    frames: Sequence[FloatArray],
    part: int,
    groups: Sequence[Sequence[int]],
) -> tuple[FloatArray, FloatArray]:
    """Return (D, P + 1, P + 1) the products of rows and residual by direction, and their number.

    Weighted samples count for their weights.
    """
    size = len(names) + 1
    found, count = np.zeros((len(groups), size, size)), np.zeros(len(groups))
    for samples, frame in zip(sets, frames, strict=True):
        for rows, axes in _blocks(samples, chain, names, frame, part):
            turned = np.einsum('pan,nai->pin', rows, axes)
            for k, group in enumerate(groups):
                found[k] += gram(np.ascontiguousarray(turned[:, list(group)]))
        weights = (
            samples.count
            if samples.weights is None
            else float(samples.weights**2 @ np.ones(samples.count))
        )
        count += [len(group) * weights for group in groups]
    return found, count


def _blocks(
    samples: Samples, chain: Chain, names: Sequence[str], frame: FloatArray, part: int
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield rows (P + 1, 3, B) of a part and the axes (B, 3, 3) of their samples."""
    first = 0
    for parts in samples.parts(chain, names):
        last = first + parts[0].shape[2]
        yield parts[part], frame[first:last]
        first = last


def _variances(products: FloatArray, count: FloatArray, factor: FloatArray) -> Directions | None:
    """Return the variances (D,) from products and counts, None where they tell none."""
    inverse = np.linalg.inv(factor)
    inner = inverse.T @ products[:, :-1, :-1] @ inverse
    flat = inner.reshape(len(inner), -1)
    moments, taken = flat @ flat.T, np.einsum('dpp->d', inner)
    moments[np.diag_indices(len(count))] += count - 2.0 * taken
    freedom = count - taken
    if not (freedom > 1.0).all():
        return None
    variances = np.linalg.solve(moments, products[:, -1, -1])
    if not (variances > 0.0).all():
        return None
    middles = variances[:, np.newaxis, np.newaxis] * products[:, :-1, :-1]
    return Directions(variances, freedom, middles, ())


def _chance(told: Directions, freedoms: int) -> float:
    """Return how probable it is that variances of equal noise differ as much (Bartlett)."""
    total = told.freedom.sum()
    mean = float(told.freedom @ told.variances) / total
    square = total * np.log(mean) - told.freedom @ np.log(told.variances)
    more = len(told.freedom) - 1
    square /= 1.0 + ((1.0 / told.freedom).sum() - 1.0 / total) / (3.0 * more)
    return float(special.chdtrc(freedoms, max(square, 0.0)))
