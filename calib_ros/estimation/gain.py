# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What columns explain of a residual beside others, by their products."""

from __future__ import annotations

import numpy as np

from calib_ros.kinematics.se3 import ROUNDING, FloatArray


def inverse_root(matrix: FloatArray, size: FloatArray) -> FloatArray:
    """Return T (..., P, P) with T T^T the pseudo-inverse of (..., P, P).

    Columns are scaled to squared lengths `size` (..., P); directions lost to rounding are zero.
    """
    scale = 1.0 / np.sqrt(np.maximum(size, 1e-300))
    sizes, vectors = np.linalg.eigh(matrix * (scale[..., np.newaxis] * scale[..., np.newaxis, :]))
    good = sizes > ROUNDING
    lengths = good / np.sqrt(np.where(good, sizes, 1.0))
    return np.asarray(scale[..., np.newaxis] * vectors * lengths[..., np.newaxis, :])


def about_nominal(products: FloatArray, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return normal matrix (..., P) and vector (...) of offsets from nominal, now `offsets` (P,).

    By products (..., P + 1) of columns with all and the residual.
    """
    matrix = products[..., :-1]
    return matrix, matrix @ offsets + products[..., -1]


def gain_of(products: FloatArray, count: int) -> tuple[float, int, float]:
    """Return the squares that added columns explain of the residual, and in how many directions.

    By the products (P, P) of the first `count` columns, the added ones and the residual. The
    squares left beside the first columns alone follow.
    """
    sizes, known, rest = np.diag(products), np.s_[:count], np.s_[count:]
    root = inverse_root(products[known, known], sizes[known])
    cross = products[rest, known] @ root
    left = products[rest, rest] - cross @ cross.T
    root = inverse_root(left[:-1, :-1], sizes[count:-1])
    along = root.T @ left[:-1, -1]
    return float(along @ along), int(root.any(axis=0).sum()), float(left[-1, -1])


def gain_share(rows: FloatArray, count: int) -> float:
    """Return the share of the squares beside the first `count` columns that added ones explain.

    The residual is the last column of the rows (R, P). Few rows tell none.
    """
    if len(rows) - rows.shape[1] + 1 < len(rows) // 3:
        return 0.0
    gain, _, left = gain_of(rows.T @ rows, count)
    return gain / left if left > 0.0 else 0.0
