# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Arrays from values of any kind."""

from __future__ import annotations

from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import InputError


def array_of(values: object, kind: Any, name: str, finite: bool = False) -> NDArray[Any]:
    """Return values as an array (...,) of numbers, integers or flags, masked ones as NaN."""
    allowed, what = {
        'f': ('iufO', 'real numbers'),
        'i': ('iu', 'integers'),
        'b': ('b', 'True and False'),
    }[np.dtype(kind).kind]
    try:
        array = values if isinstance(values, np.ma.MaskedArray) else np.asarray(values)
    except ValueError as err:  # rows of different lengths
        raise InputError(f'{name} must be {what} in an array: {err}') from err
    each = map(type, array.flat) if array.dtype == object else ()
    if (array.dtype.kind not in allowed and array.size) or not all(
        issubclass(of, Real) and not issubclass(of, bool) for of in each
    ):
        given = f'{array.dtype}' if array.ndim else type(values).__name__
        raise InputError(f'{name} must be {what} in an array, not {given}')
    if np.ma.is_masked(array):
        array = np.ma.filled(array.astype(np.float64), np.nan)
    array = np.asarray(array, dtype=kind)
    if finite and (wrong := ~np.isfinite(array)).any():
        place = np.argwhere(wrong)[0].tolist()
        raise InputError(
            f'{name} must not hold NaN or infinite values, as at {place} (counted from 0)'
        )
    return array
