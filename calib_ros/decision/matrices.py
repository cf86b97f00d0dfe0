# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Matrices of a record as rows of text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from calib_ros.errors import ConfigError
from calib_ros.kinematics.se3 import ROUNDING, FloatArray


def packed(square: FloatArray) -> list[str]:
    """Return the rows of the lower Cholesky factor of a positive matrix (P, P) as text."""
    scale = np.sqrt(np.maximum(np.diag(square), 1e-300))
    scaled = square / np.outer(scale, scale) + ROUNDING * np.eye(len(scale))
    root = scale[:, np.newaxis] * np.linalg.cholesky(scaled)
    return rows_of([row[: k + 1] for k, row in enumerate(root)])


def rows_of(matrix: Iterable[FloatArray]) -> list[str]:
    """Return the rows of a matrix (P, K) as text, for `parse_rows`."""
    return [' '.join(f'{x:.9e}' for x in row) for row in matrix]


def parse_rows(rows: Sequence[str], count: int, triangular: bool = False) -> FloatArray:
    """Return the matrix (P, K) of rows of numbers, up to the diagonal if `triangular`.

    Raises ValueError if the number or length of the rows is wrong, or a value is not finite.
    """
    numbers = [np.array(row.split(), dtype=np.float64) for row in rows]
    first = [len(row) for row in numbers[:1]]
    widths = [*range(1, count + 1)] if triangular else first * count
    if [*map(len, numbers)] != widths or not all(np.isfinite(row).all() for row in numbers):
        raise ValueError(f'{len(rows)} rows of finite numbers for {count} names')
    matrix = np.zeros((count, max(widths, default=0)))
    for row, given in zip(matrix, numbers, strict=True):
        row[: len(given)] = given
    return matrix


def unpacked_matrix(rows: Sequence[str], size: int) -> FloatArray:
    """Return the matrix (P, P) from the rows of `packed`."""
    root = parse_rows(rows, size, triangular=True)
    return np.asarray(root @ root.T)


def damage_error(key: str, where: str, err: Exception | None = None) -> ConfigError:
    """Return the error for a damaged part of a record."""
    kind = '' if err is None else f' ({type(err).__name__})'
    return ConfigError(f'{where}: calibration.{key} is damaged{kind}: identify again')
