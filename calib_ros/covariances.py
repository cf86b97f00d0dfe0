# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Covariances of measured poses: what is wrong with them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.values import LARGEST, SAME


def covariance_faults(covariances: NDArray[np.float64]) -> NDArray[np.str_]:
    """Return the fault of each covariance (N, 6, 6) of measured poses; empty if valid.

    All zeros mean that none was measured. Zeros for the rotation mean that it was not measured, or
    that its covariance is unknown (trackers of positions).
    """
    found = np.full(len(covariances), '', dtype='U60')

    def refuse(wrong: Any, fault: str) -> None:
        found[wrong & (found == '')] = f'covariance {fault}'

    refuse(~np.isfinite(covariances).all(axis=(1, 2)), 'with NaN or infinite values')
    full = np.where((found == '')[:, np.newaxis, np.newaxis], covariances, np.eye(6))
    other = np.swapaxes(full, 1, 2)
    alike = np.abs(full - other) <= 1e-15 + 1e-6 * np.abs(other)
    refuse(~alike.all(axis=(1, 2)), 'not symmetric')
    still = ~full[:, 3:].any(axis=(1, 2))
    full[still, 3:, 3:] = np.eye(3)
    full[still & ~full[:, :3].any(axis=(1, 2))] = np.eye(6)
    variances = np.diagonal(full, axis1=1, axis2=2)
    refuse((variances <= 0.0).any(axis=1), 'not positive definite')
    full[found != ''] = np.eye(6)
    sigmas = np.sqrt(np.diagonal(full, axis1=1, axis2=2))
    believed = (sigmas >= SAME) & (sigmas <= LARGEST)
    refuse(~believed.all(axis=1), f'with a sigma not within {SAME:g} and {LARGEST:g}')
    normed = full / sigmas[:, :, np.newaxis] / sigmas[:, np.newaxis, :]
    mixed = np.flatnonzero((normed * (1.0 - np.eye(6))).any(axis=(1, 2)))
    definite = np.ones(len(found), dtype=bool)
    definite[mixed] = np.linalg.eigvalsh(normed[mixed])[:, 0] > 1e-12  # rounding
    refuse(~definite, 'not positive definite')
    return found
