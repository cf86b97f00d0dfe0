# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How a measuring device may distort space: smooth errors as large as its sigma.

Axes that are not square, a lens, and misplaced mirrors or markers distort what is measured. Such
errors repeat: no number of poses averages them out, held-out poses share them, and arms distort
space in a similar way. A device that is accurate to its sigma may have all of it in this form.
These errors are modelled as second-order polynomials in the measured position, for each
coordinate, and *considered* in the decision where a calibration may be used (`evidence.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np

from calib_ros.identification.identifiability import DEGENERATE
from calib_ros.identification.observations import Observations
from calib_ros.identification.samples import Samples
from calib_ros.kinematics.se3 import FloatArray


def bends(sets: Sequence[Samples]) -> list[FloatArray]:
    """Return for each set (K, c, N) what its device may do, weighted as the rows of positions.

    Each of the K coefficients has the standard deviation 1, and together they have the sigma of
    the device in each coordinate (RMS over the samples). Devices have their own; what is measured
    in sockets, on planes, as distances or pixels has none.
    """
    by_device: dict[str, list[int]] = {}
    for number, samples in enumerate(sets):
        seen = samples.observations
        if seen.distances is None and seen.pixels is None and not seen.socket:
            by_device.setdefault(seen.tool if seen.inverse else seen.base, []).append(number)
    found = [[np.zeros((0, samples.width, samples.count))] for samples in sets]
    for own in by_device.values():
        weights = [_weights(sets[number]) for number in own]
        places = [_place(sets[number].observations) for number in own]
        waves = _polynomials(np.concatenate(places), np.concatenate(weights))
        ends = np.cumsum([len(each) for each in places])[:-1]
        parts = dict(zip(own, np.split(waves, ends, axis=1), strict=True))
        for number, samples in enumerate(sets):
            shape = (3 * len(waves), samples.width, samples.count)
            known = number in parts
            found[number].append(_rows(samples, parts[number]) if known else np.zeros(shape))
    return [np.concatenate(each) for each in found]


def _weights(samples: Samples) -> FloatArray:
    return np.ones(samples.count) if samples.weights is None else samples.weights


def _place(seen: Observations) -> FloatArray:
    """Return where the device saw the targets (N, 3) [m], in its own axes."""
    if not seen.inverse:
        return seen.positions
    return np.asarray(-np.einsum('nji,nj->ni', seen.rotations, seen.positions))


def _polynomials(places: FloatArray, weights: FloatArray) -> FloatArray:
    """Return (M, N) weighted polynomials of mean square 1 together, orthogonal, of no mean."""
    total = max(float(weights @ weights), 1.0)
    centred = places - (weights**2 @ places) / total
    centred /= max(float(np.sqrt((weights**2 @ centred**2).sum() / total)), DEGENERATE)
    pairs = combinations_with_replacement(centred.T, 2)
    terms = [np.ones(len(places)), *centred.T, *(one * other for one, other in pairs)]
    columns = weights * np.array(terms)
    basis, factor = np.linalg.qr(columns.T)
    told = np.abs(np.diag(factor)) > DEGENERATE * np.linalg.norm(columns, axis=1)[: len(factor)]
    told[0] = False
    return np.asarray(basis.T[told] * np.sqrt(total / max(told.sum(), 1)))


def _rows(samples: Samples, waves: FloatArray) -> FloatArray:
    """Return (3 M, c, N) rows of weighted polynomials (M, N) along each axis of the device."""
    seen = samples.observations
    axes = seen.rotations if seen.inverse else np.eye(3)[np.newaxis]
    bent = np.einsum('mn,nia->main', waves, np.broadcast_to(axes, (samples.count, 3, 3)))
    bent = bent.reshape(-1, 3, samples.count)
    if samples.whitening is None:
        return np.asarray(bent)
    covariance = seen.covariances(samples.sigmas)[:, :3, :3]
    sigma = float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean() / 3.0))
    return np.asarray(np.einsum('rsn,psn->prn', samples.whitening[:, :3], sigma * bent))
