# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Checks of numbers and names from files, tables and messages."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import (
    LONGEST_NAME,
    MOST_ENTRIES,
    CalibrationError,
    ConfigError,
    InputError,
    UnknownNameError,
)

ROUNDED = 1e-3
"""Relative rounding of numbers with three digits: of the length of a quaternion, of a step of
joint values."""
SAME = 1e-9  # lengths [m] and angles [rad] that differ by less are equal; a convention
LARGEST = 1e6
"""Largest measured or set number [m or rad]; some devices send the largest float for none."""
LARGEST_RATE = LARGEST**2
"""Largest velocity and acceleration [SI], computed and stored in journals."""
LARGEST_SETTING = float(np.iinfo(np.int32).max)  # largest setting: that of 32-bit integers
MOST_NAMES = MOST_ENTRIES // 20
"""Joints of a chain, frames, targets, or sets of joint names in a cell."""


def parse_number(
    value: object,
    where: str,
    error: type[CalibrationError] = ConfigError,
    largest: float = LARGEST,
) -> float:
    """Return a finite number from YAML or a table; errors name it `where`."""
    how = ''
    try:  # YAML 1.1 reads 1e-3, without a dot, as a string
        number = float(value) if isinstance(value, int | float | str) else math.nan
    except (ValueError, OverflowError):
        number = math.nan
        how = ': write it out, such as 1.5708' if value and isinstance(value, str) else ''
    if isinstance(value, bool) or not math.isfinite(number):
        raise error(f'{where} must be a finite number, not {value!r:.100}{how}')
    if abs(number) > largest:
        raise error(f'{where} must be at most {largest:g}, not {number:g}')
    return number


def parse_like(default: Any, value: object, where: str) -> Any:
    """Return a value of the type of a default, from YAML, ROS or a command line.

    A single text is accepted for a list of texts (tuple); empty ones are dropped. The ConfigError
    for other values names it `where`.
    """
    if isinstance(default, bool):
        if isinstance(value, bool):
            return value
        wanted = 'true or false'
    elif isinstance(default, int | float):
        number = parse_number(value, where, largest=LARGEST_SETTING)
        if isinstance(default, float) or number.is_integer():
            return type(default)(number)
        wanted = 'a whole number'
    elif isinstance(default, str):
        if isinstance(value, str) and value.isprintable():
            return value
        if not isinstance(value, str):
            raise ConfigError(f'{where} must be text, not {value!r:.100}: write it in quotes')
        wanted = 'printable text'
    else:
        texts = value if isinstance(value, list | tuple) else (value,)
        if all(isinstance(each, str) and each.isprintable() for each in texts):
            return tuple(filter(None, texts))
        wanted = "a list of strings such as ['a', 'b']"
    raise ConfigError(f'{where} must be {wanted}, not {value!r:.100}')


def parse_mapping(
    value: object, keys: Sequence[str], where: str, needed: Sequence[str] = ()
) -> dict[str, Any]:
    """Return a mapping from YAML with the required keys and no unknown ones."""
    if not isinstance(value, dict):
        found = 'empty' if value is None else f'{value!r:.40}'
        raise ConfigError(
            f'{where} must be a mapping with the keys {", ".join(keys)}, not {found}'
        )
    for key in value:
        if value[key] is None and str(key).isdigit():  # {a: 0,5}; 089 is a text
            raise ConfigError(f'{where}: a number has no key: write 0.5, not 0,5')
        if key not in keys:
            raise UnknownNameError(f'{where}: key', str(key), keys)
    for key in needed:
        if value.get(key) is None:
            raise ConfigError(f'{where}: key "{key}" is missing')
    return value


def parse_name(value: object, where: str) -> str:
    """Return a name that fits into a table line, a comment or a path."""
    name = str(value)
    if not name.isprintable() or len(name) > LONGEST_NAME:
        raise ConfigError(
            f'{where} must be printable, of at most {LONGEST_NAME} characters, not {name!r:.100}'
        )
    return name


def parse_numbers(
    value: object, count: int, where: str, error: type[CalibrationError] = ConfigError
) -> NDArray[np.float64]:
    """Return finite numbers (count,) from YAML; errors name them `where`."""
    if not isinstance(value, list) or len(value) != count:
        raise error(f'{where} must be a list of {count} numbers, not {value!r:.100}')
    return np.array([parse_number(item, where, error) for item in value])


def cell_integer(text: str, where: str) -> int:
    """Return the 64-bit integer in a table cell."""
    number = int(text) if re.fullmatch(r'-?[0-9]{1,19}', text) else 2**63
    if abs(number) >= 2**63:
        raise InputError(f'{where} must be an integer of 64 bits, not {text!r}')
    return number
