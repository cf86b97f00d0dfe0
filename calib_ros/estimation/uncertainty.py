# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The covariance of the parameters and its degrees of freedom."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.linalg import lapack

from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray
from calib_ros.shown import Shown


def covariance(factor: FloatArray, middle: FloatArray | None = None) -> FloatArray:
    """Return the covariance (P, P) of the parameters from R, for weights in units of sigma.

    For Gaussian noise of those sigmas (R^T R)^-1 is the Cramer-Rao bound. Otherwise it is (R^T
    R)^-1 M (R^T R)^-1, where `middle` M (P, P) is the normal matrix with every equation weighted
    by its true variance (in units of the assumed one).
    """
    scale = 1.0 / np.linalg.norm(factor, axis=0)
    inverse, failed = lapack.dtrtri(factor * scale)
    inverse *= scale[:, np.newaxis]
    turned = inverse if middle is None else inverse.T @ middle @ inverse
    if failed or not np.isfinite(turned).all():
        raise np.linalg.LinAlgError('singular factor')
    if middle is None:
        return np.asarray(inverse @ inverse.T)
    root, order, rank, _ = lapack.dpstrf(turned, lower=1)  # pivoted
    root = np.tril(root)
    root[:, rank:] = 0.0  # no rounding below zero
    if np.isclose((root**2).sum(), np.trace(turned), rtol=HALF_THE_DIGITS, atol=0.0):
        root = inverse[:, order - 1] @ root
    else:  # not positive: of thinned pairs of neighbours, or a difference
        sizes, axes = np.linalg.eigh(turned)
        root = inverse @ (axes * np.sqrt(np.maximum(sizes, 0.0)))
    return np.asarray(root @ root.T)


@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty(Shown):
    """Covariance of the fitted parameters, by source of error.

    `parts` (K, P, P) belong to position, orientation and priors, or to all of these, to parameters
    held at nominal, and to what no parameter explains; `freedom` (K,) are the degrees of freedom
    of each, infinite if the noise is known. `shared` (F, F) is what errors shared by neighbours
    add to the covariance by independent noise of one size, of F parameters if there are any, and
    `together` the number of positions that tell as much as one, if the device drifts.
    """

    parts: FloatArray
    freedom: FloatArray
    shared: FloatArray = field(default_factory=partial(np.zeros, (0, 0)))
    together: float = 1.0

    @property
    def covariance(self) -> FloatArray:
        """Return the covariance (P, P) by all sources."""
        return np.asarray(self.parts.sum(axis=0))

    def with_part(self, part: FloatArray) -> Uncertainty:
        """Return the uncertainty with a further source (P, P) of known size."""
        parts = np.concatenate([self.parts, part[np.newaxis]])
        return replace(self, parts=parts, freedom=np.append(self.freedom, np.inf))

    @property
    def overall(self) -> float:
        """Return the degrees of freedom of all parameters together."""
        variances = np.einsum('kpp,pp->k', self.parts, np.diag(1.0 / np.diag(self.covariance)))
        return float(self.freedom_of(variances))

    def freedom_of(self, variances: FloatArray) -> FloatArray:
        """Return the degrees of freedom (...) of sums of variances (K, ...) from the sources.

        After Satterthwaite (1946).
        """
        shares = variances / np.maximum(variances.sum(axis=0), 1e-300)
        with np.errstate(divide='ignore'):
            return np.asarray(1.0 / np.tensordot(1.0 / self.freedom, shares**2, axes=1))
