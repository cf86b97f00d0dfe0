# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Numbers as files, tables and messages give them: which are taken, and what is said of others."""

from __future__ import annotations

import math

import numpy as np

from calib_ros.errors import CalibrationError, ConfigError, InputError
from calib_ros.se3 import FloatArray

QUATERNION_TOLERANCE = 1e-3
"""A quaternion whose length differs from 1 by more is refused as not being one."""


def parse_number(value: object, where: str, error: type[CalibrationError] = ConfigError) -> float:
    """Return a finite number from YAML or a table; `where` names it in the error."""
    try:  # YAML 1.1 reads 1e-3, without a dot, as a string
        number = float(value) if isinstance(value, int | float | str) else math.nan
    except (ValueError, OverflowError):
        number = math.nan
    if isinstance(value, bool) or not math.isfinite(number):
        raise error(f'{where} must be a finite number, not {value!r}')
    return number


def parse_numbers(
    value: object, count: int, where: str, error: type[CalibrationError] = ConfigError
) -> FloatArray:
    """Return so many finite numbers (count,) from YAML; `where` names them in the error."""
    if not isinstance(value, list) or len(value) != count:
        raise error(f'{where} must be a list of {count} numbers, not {value!r}')
    return np.array([parse_number(item, where, error) for item in value])


def cell_number(text: str | None, where: str) -> float:
    """Return the number in a cell of a table; None where the row ends before it."""
    try:
        number = float(text or 'blank')
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        found = 'the row ends before it' if text is None else f'not {text!r}'
        raise InputError(f'{where} must be a number, {found}')
    return number
