# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Smooth distortions of measuring devices."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np

from calib_ros.estimation.identifiability import DEGENERATE
from calib_ros.estimation.samples import Samples
from calib_ros.kinematics.se3 import FloatArray

_PAIRS = ((0, 1), (0, 2), (1, 2))
_STRAINS = np.array(
    [
        *(np.diag(each) for each in ((1.0, -1.0, 0.0), (1.0, 1.0, -2.0))),
        *(np.outer(*np.eye(3)[[i, j]]) + np.outer(*np.eye(3)[[j, i]]) for i, j in _PAIRS),
    ]
)
STRAINS = _STRAINS * np.sqrt(1.2 / (_STRAINS**2).sum(axis=(1, 2), keepdims=True))
"""Symmetric matrices (5, 3, 3) without trace: the others turn or scale space. If three directions,
whichever they are, are off independently by s, the scale is off by s / 3^(1/2), and the strain, of
length 2^(1/2) s, by as much in each of these."""


def bends(sets: Sequence[Samples]) -> list[FloatArray]:
    """Return the possible device distortions of each set (K, c, N), weighted as position rows.

    Each of the K coefficients has standard deviation 1; together they have the device's sigma in
    each coordinate (RMS over samples). Each device has its own; sockets, planes, distances and
    pixels have none.
    """
    by_device: dict[str, list[int]] = {}
    for number, samples in enumerate(sets):
        seen = samples.observations
        if seen.distances is None and seen.pixels is None and not seen.socket:
            by_device.setdefault(seen.tool if seen.inverse else seen.base, []).append(number)
    found = [np.zeros((0, samples.width, samples.count)) for samples in sets]
    for own in by_device.values():
        device = [sets[number] for number in own]
        weights = [np.ones(s.count) if s.weights is None else s.weights for s in device]
        shown = [samples.observations for samples in device]
        places = [each.given for each in shown]
        waves = _polynomials(np.concatenate(places), np.concatenate(weights))
        ends = np.cumsum([samples.count for samples in device])[:-1]
        parts = dict(zip(own, np.split(waves, ends, axis=1), strict=True))
        for k, samples in enumerate(sets):
            none = np.zeros((3 * len(waves), samples.width, samples.count))
            bent = shift_rows(samples, parts[k]) if k in parts else none
            found[k] = np.concatenate([found[k], bent])
    return found


def strains(sets: Sequence[Samples]) -> list[FloatArray]:
    """Return strains of the device for each set (5, c, N), weighted as position rows.

    They are zero unless a single device measures all positions.
    """
    found, shown = [], [samples.observations for samples in sets]
    alone = len({each.tool if each.inverse else each.base for each in shown}) == 1
    if any(s.distances is not None or s.pixels is not None or s.socket for s in shown):
        alone = False
    for samples, seen in zip(sets, shown, strict=True):
        weights = np.ones(samples.count) if samples.weights is None else samples.weights
        rows = np.zeros((len(STRAINS), samples.width, samples.count))
        if alone:
            places = weights * (seen.given - seen.given.mean(axis=0)).T / device_sigma(samples)
            along = shift_rows(samples, places).reshape(3, 3, -1, samples.count)
            rows = np.einsum('kma,macn->kcn', STRAINS, along)
        found.append(rows)
    return found


def differing(coefficients: FloatArray) -> float:
    """Return by how much more a strain, a sum of STRAINS (5,) or none, stretches one direction."""
    strain = np.tensordot(coefficients, STRAINS[: len(coefficients)], 1)
    return float(np.ptp(np.linalg.eigvalsh(strain)))


def _polynomials(places: FloatArray, weights: FloatArray) -> FloatArray:
    """Return weighted polynomials (M, N), orthogonal, without mean, of total mean square 1."""
    total = max(float(weights @ weights), 1.0)
    centred = places - (weights**2 @ places) / total
    pairs = combinations_with_replacement(centred.T, 2)
    terms = [np.ones(len(places)), *centred.T, *(one * other for one, other in pairs)]
    columns = weights * np.array(terms)
    basis, factor = np.linalg.qr(columns.T)
    used = np.abs(np.diag(factor)) > DEGENERATE * np.linalg.norm(columns, axis=1)[: len(factor)]
    used[0] = False
    return np.asarray(basis.T[used] * np.sqrt(total / max(used.sum(), 1)))


def shift_rows(samples: Samples, waves: FloatArray) -> FloatArray:
    """Return rows (3 M, c, N) of weighted shifts (M, N) along each axis of the device.

    Shifts are in units of `device_sigma`.
    """
    seen = samples.observations
    axes = seen.rotations if seen.inverse else np.eye(3)[np.newaxis]
    bent = np.einsum('mn,nia->main', waves, np.broadcast_to(axes, (samples.count, 3, 3)))
    bent = bent.reshape(-1, 3, samples.count)
    if samples.whitening is None:
        return np.asarray(bent)
    shifts = device_sigma(samples) * bent
    return np.asarray(np.einsum('rsn,psn->prn', samples.whitening[:, :3], shifts))


def device_sigma(samples: Samples) -> float:
    """Return the standard deviation [m] of a coordinate (RMS over samples)."""
    if samples.whitening is None:
        return samples.sigmas[0]
    seen, covariance = samples.observations, samples.observations.covariances(samples.sigmas)
    covariance = covariance if seen.punctual is None else seen.punctual @ covariance
    return float(np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2).mean() / 3.0))
