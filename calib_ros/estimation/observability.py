# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How well the poses determine the parameters: observability indices, correlations and trades."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_ros.estimation.identifiability import DEGENERATE
from calib_ros.kinematics.se3 import ROUNDING, FloatArray


def trades(matrix: FloatArray, names: Sequence[str], kept: Sequence[str]) -> dict[str, list[str]]:
    """Return the fitted parameters that each left-out one trades against.

    Moving both by the right amounts leaves every measured pose unchanged. `matrix` (P, P) is the
    normal matrix of all.
    """
    sizes = np.sqrt(np.diag(matrix))
    seen = sizes > ROUNDING * sizes.max(initial=0.0)
    fitted, left_out = (np.flatnonzero(seen & (np.isin(names, kept) == x)) for x in (True, False))
    scaled = matrix[fitted] / sizes[fitted, np.newaxis]
    basis, columns = (scaled[:, part] / sizes[part] for part in (fitted, left_out))
    shares = np.abs(np.linalg.lstsq(basis, columns, rcond=None)[0])
    strong = (shares > DEGENERATE * shares.max(axis=0, initial=0.0)).T
    partners: dict[str, list[str]] = {name: [] for name in names if name not in set(kept)}
    for k, marks in zip(left_out.tolist(), strong, strict=True):
        partners[names[k]] = [names[j] for j in fitted[marks].tolist()]
    return partners


def observability(factor: FloatArray, poses: int) -> dict[str, float]:
    """Return the indices o1 to o5 from R (P, P) of the weighted Jacobian of a number of poses.

    From the singular values, in sigma of the measurement per metre or radian. O1 Borm and Menq
    1991, O2 Driels and Pathre 1990, O3 and O4 Nahvi et al. 1994 and 1996, O5 Sun and Hollerbach
    2008.
    """
    singular = np.asarray(np.linalg.svd(factor, compute_uv=False), dtype=float)
    mean = float(np.exp(np.log(np.maximum(singular, 1e-300)).mean()))
    others = {name: float(each) for name, each in indices_of(singular).items()}
    return {'o1': float(mean / np.sqrt(poses)), **others}


def indices_of(singular: FloatArray) -> dict[str, FloatArray]:
    """Return the indices o2 to o5 (...) of singular values (..., P)."""
    smallest, largest = singular.min(axis=-1), singular.max(axis=-1)
    return {
        'o2': smallest / largest,
        'o3': smallest,
        'o4': smallest**2 / largest,
        'o5': 1.0 / np.sum(1.0 / np.maximum(singular, 1e-300), axis=-1),
    }


def correlated(
    matrix: FloatArray, names: Sequence[str], threshold: float
) -> tuple[tuple[str, str, float], ...]:
    """Return pairs correlated beyond a threshold by their covariance (P, P), strongest first."""
    std = np.sqrt(np.diag(matrix))
    correlation = matrix / np.outer(std, std)
    strong = np.argwhere(np.triu(np.abs(correlation) > threshold, 1)).tolist()
    pairs = [(names[i], names[j], float(correlation[i, j])) for i, j in strong]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair[2])))
