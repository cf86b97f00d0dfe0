# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Is it the device that drifts? By the restricted likelihood (Patterson and Thompson 1971).

Errors that fade in succession are the device's if that is more probable than independent errors,
or than errors that fade in joint space as those of an arm do, or not at all: beyond one standard
deviation, with equal odds before, and any length and size as likely as another, in logarithms.

Residuals r of a part with orthonormal columns Q (`quadratic_forms.py`) and errors of covariance
v (I + g K), where all other parts have the variance u that independent errors of this one would
have, have the log likelihood

    -(n log v + log |I + g K| + log |A| + r^T W r - b^T A^-1 b) / 2      W = (I + g K)^-1 / v
    A = Q^T W Q + (I - Q^T Q) / u      b = Q^T W r - Q^T r / u
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy import special
from scipy.linalg import lapack

from calib_ros.estimation.fading import DECAYS
from calib_ros.estimation.levels import SEVERAL, UNUSUAL
from calib_ros.estimation.quadratic_forms import PartRows
from calib_ros.estimation.samples import gram
from calib_ros.estimation.stops import Stops
from calib_ros.kinematics.se3 import ROUNDING, FloatArray
from calib_ros.values import SAME

DRIFT_KERNELS = [('successive', length) for length in (*DECAYS['successive'], 300.0)]
"""Kinds and lengths of drift. The longest is a random walk to most sessions."""
ARM_KERNELS = [('near', length) for length in (SAME, *DECAYS['near'], 300.0)]
"""Those of errors of the arm; also if only the samples of one stop share them, or all poses: of
distances no frame takes a constant error."""


def device_drift(part: PartRows, units: Stops) -> FloatArray | None:
    """Return the expected sizes (1 + K,) of independent errors and DRIFT_KERNELS, or None.

    None unless the device drifts. Averages over all sizes and lengths: a session tells little of
    a drift that lasts longer.
    """
    highest = -np.inf

    @cache
    def one(kind: str, length: float) -> tuple[FloatArray, FloatArray]:
        return likelihoods(part, units.kernel(kind, length), highest)

    def likely(kernels: Sequence[tuple[str, float]]) -> tuple[FloatArray, FloatArray]:
        pairs = [one(*each) for each in kernels]
        return np.array([each for each, _ in pairs]), np.array([sizes for _, sizes in pairs])

    least = float(special.logit(1.0 - UNUSUAL))
    drift, arm = ((kind, lengths[len(lengths) // 2]) for kind, lengths in DECAYS.items())
    highest = one(*drift)[0].max()
    if not (highest > least and highest > one(*arm)[0].max()):  # few sessions need a closer look
        return None
    (found, sizes), (near, _) = likely(DRIFT_KERNELS), likely(ARM_KERNELS)
    odds, other = (special.logsumexp(each) - np.log(each.size) for each in (found, near))
    if not odds - np.logaddexp(0.0, other) > least:
        return None
    white, fading = np.einsum('kr,ksr->sk', special.softmax(found), sizes)
    return np.append(white.sum(), fading)


def together(units: Stops, lengths: Sequence[int], sizes: FloatArray) -> float:
    """Return how many stops tell as much of the noise as one, with sizes (1 + K,) of a drift.

    Of sets of so many stops; `units` may be some of them. After Satterthwaite (1946).
    """
    apart = np.arange(max(lengths))
    pairs = np.maximum(np.subtract.outer(lengths, apart), 0).sum(axis=0)
    fading = sizes[1:] @ np.exp([-apart / length for _, length in DRIFT_KERNELS])
    shares = fading / (sizes[0] / units.count.mean() + fading[0])
    return float(1.0 + 2.0 * pairs[1:] @ shares[1:] ** 2 / pairs[0])


def likelihoods(
    part: PartRows, kernel: FloatArray, rival: float = -np.inf
) -> tuple[FloatArray, FloatArray]:
    """Return log likelihoods (R,) against independent errors alone, and sizes (2, R).

    The sizes of the independent part and of the kernel K (n, n), for ratios g, each with the most
    likely v. From the middle up, then down, until falling likelihoods are nothing (-inf) beside
    the largest, or that of a `rival`.
    """
    basis, residual, known, shares = part
    rows = np.concatenate([basis, residual[:, :, np.newaxis]], axis=2)
    ratios, width, alike = np.geomspace(0.02, 50.0, 12), rows.shape[2], []
    for seen in np.unique(known, axis=1).T:
        which = (known == seen[:, np.newaxis]).all(axis=0)
        values, axes = np.linalg.eigh(kernel * np.outer(seen, seen))
        turned = axes.T @ rows[:, which].reshape(len(rows), -1)
        alike.append((which.sum(), np.maximum(values, 0.0), turned))
    count, others = known.sum(), np.eye(width - 1) - shares
    moved, free = np.einsum('ncp,nc->p', basis, residual), count - np.trace(shares)
    alone = (residual**2).sum() / free
    sizes = alone / (1.0 + ratios * np.diag(kernel).mean())
    likely, middle = np.full(len(ratios), -np.inf), len(ratios) // 2
    for k in (*range(middle, len(ratios)), *reversed(range(middle))):
        best, last = likely.max(), likely[k - 1 if k > middle else k + 1]
        if last < min(best, max(best, rival) + np.log(ROUNDING)):
            continue
        product, twice = np.zeros((width, width)), count * np.log(alone) + free
        for number, values, turned in alike:
            weights = 1.0 / (1.0 + ratios[k] * values)
            twice += number * np.log(weights).sum()
            product += gram((np.sqrt(weights)[:, np.newaxis] * turned).reshape(-1, width).T)
        own, along, squares = product[:-1, :-1].copy(), product[:-1, -1], product[-1, -1]
        for left in reversed(range(1 + SEVERAL)):
            ratio = alone / sizes[k]
            matrix = own * ratio + others  # symmetric: as Fortran has it, without a copy
            factor = lapack.dpotrf(matrix.T, lower=1, overwrite_a=1)[0]
            vector = along * ratio - moved
            shift = lapack.dpotrs(factor, vector, lower=1)[0]
            if not left:
                break
            inverse = lapack.dpotri(factor, lower=1, overwrite_c=1)[0]  # its lower triangle
            taken = 2.0 * np.vdot(inverse.T, own) - np.diag(inverse) @ np.diag(own)
            squared = squares - 2.0 * shift @ along + shift @ own @ shift
            sizes[k] = squared / max(count - ratio * taken, 1.0)
        twice -= count * np.log(sizes[k]) + 2.0 * np.log(np.diag(factor)).sum()
        likely[k] = 0.5 * (twice + shift @ vector / alone - squares / sizes[k])
    return likely, np.array([sizes, ratios * sizes])
