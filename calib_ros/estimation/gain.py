# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What columns explain of a residual beside others, by their products."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_ros.kinematics.se3 import ROUNDING, FloatArray, Index


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
    return _explained(_beside(products, count), np.diag(products)[count:-1])


def gain_share(rows: FloatArray, count: int) -> float:
    """Return the share of the squares beside the first `count` columns that added ones explain.

    The residual is the last column of the rows (R, P). Few rows tell none.
    """
    (share,) = gain_shares(rows, count, [np.arange(rows.shape[1] - count - 1)])
    return share


def gain_shares(rows: FloatArray, count: int, groups: Sequence[Index]) -> list[float]:
    """Return the shares that groups of the added columns of rows (R, P) explain, each alone."""
    products, shares = rows.T @ rows, []
    left, sizes = _beside(products, count), np.diag(products)[count:]
    for group in groups:
        chosen = np.append(group, -1)
        gain, _, whole = _explained(left[np.ix_(chosen, chosen)], sizes[group])
        few = len(rows) - count - len(group) < len(rows) // 3
        shares.append(0.0 if few or whole <= 0.0 else gain / whole)
    return shares


def _beside(products: FloatArray, count: int) -> FloatArray:
    """Return the products of all but the first `count` columns, without what these explain."""
    known, rest = np.s_[:count], np.s_[count:]
    cross = products[rest, known] @ inverse_root(products[known, known], np.diag(products)[known])
    return np.asarray(products[rest, rest] - cross @ cross.T)


def _explained(left: FloatArray, sizes: FloatArray) -> tuple[float, int, float]:
    root = inverse_root(left[:-1, :-1], sizes)
    along = root.T @ left[:-1, -1]
    return float(along @ along), int(root.any(axis=0).sum()), float(left[-1, -1])
