# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Kinematic calibration of industrial arms: DH errors from joint states and measured poses.

What `__init__.pyi` imports is the public interface (docs/api.md); each name is imported at its
first use.
"""

import ast
import importlib

__version__ = '0.1.0'

_HOMES = {
    alias.name: home.module
    for home in ast.parse(__loader__.get_data(f'{__file__}i')).body
    if isinstance(home, ast.ImportFrom)
    for alias in home.names
}
"""Public names, and the modules that have them."""
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> object:
    """Import a public name at its first use."""
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(importlib.import_module(_HOMES[name]), name)
    if hasattr(value, '__dataclass_fields__'):
        value.__doc__ = importlib.import_module('calib_ros.documented').WithFields(value)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith('__'))})
