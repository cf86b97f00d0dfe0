# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Checks of the arguments of public functions, and of fields, by their annotations.

Numbers may be annotated with a test, and with the words for what passes it.
"""

from __future__ import annotations

import inspect
import math
import re
import typing
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial, wraps
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, get_args, get_origin

from calib_ros.errors import CalibrationError, ConfigError, UnknownNameError

Positive: TypeAlias = Annotated[float, lambda x: 0.0 < x < math.inf, 'a positive number']
InMetres: TypeAlias = Annotated[float, lambda x: 0.0 < x <= 0.1, 'between 0 and 0.1 metres']
NotNegative: TypeAlias = Annotated[float, lambda x: 0.0 <= x < math.inf, 'a number of at least 0']
Limit: TypeAlias = Annotated[float, lambda x: x > 0.0, 'a positive number']  # inf: none
Share: TypeAlias = Annotated[float, lambda x: 0.0 < x < 1.0, 'between 0 and 1, as 0.95']
Confidence: TypeAlias = Annotated[float, lambda x: 0.5 < x < 1.0, 'between 0.5 and 1']
Fraction: TypeAlias = Annotated[float, lambda x: 0.0 <= x < 1.0, 'at least 0 and below 1']
Count: TypeAlias = Annotated[int, lambda x: x >= 1, 'at least 1']
Several: TypeAlias = Annotated[int, lambda x: x >= 2, 'at least 2']
_F = TypeVar('_F', bound=Callable[..., Any])
_FLAGS = ('bool', 'bool_')  # of Python, and of both generations of numpy
_ARRAYS = ('ndarray', 'NDArray')  # before numpy 2.5, and since, of another form
_QUOTED = (str, Real, NoneType, tuple, list)
_TESTS: dict[Any, Callable[[Any], bool]] = {
    bool: lambda x: type(x).__name__ in _FLAGS,
    float: lambda x: isinstance(x, Real) and type(x).__name__ not in _FLAGS and x == x,
    Any: lambda x: True,
    int: lambda x: isinstance(x, Integral) and type(x).__name__ not in _FLAGS,
}
_hints: Callable[[Any], dict[str, Any]] = cache(
    partial(typing.get_type_hints, include_extras=True)
)


def as_annotated(function: _F) -> _F:
    """Make a function refuse arguments that are not as annotated, and return read-only arrays.

    Sequences arrive as tuples, arrays as `array_of` returns them, without NaN.
    """
    taken = inspect.signature(function)

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        try:
            given, hints = taken.bind(*args, **named), _hints(function)
        except TypeError:
            return function(*args, **named)  # whose error names it
        for name, value in given.arguments.items():
            given.arguments[name] = _fitting(value, hints.get(name, Any), name, True)
        return _read_only(function(*given.args, **given.kwargs))

    return typing.cast(_F, call)


def check_fields(made: Any) -> None:
    """Refuse fields of a dataclass that are not as annotated; arrays may have NaN."""
    hints = _hints(type(made))
    for name in made.__dataclass_fields__:
        value = getattr(made, name)
        if (found := _fitting(value, hints[name], name, False)) is not value:
            object.__setattr__(made, name, found)


def _fitting(value: Any, hint: Any, name: str, finite: bool) -> Any:
    """Return a value as annotated; the ConfigError or InputError for another one has its name."""
    kind, parts = get_origin(hint) or hint, get_args(hint)
    if kind is Annotated:
        return _passing(_fitting(value, parts[0], name, finite), name, *parts[1:])
    if kind in (typing.Union, UnionType):
        if len(parts) == 2 and value is not None and parts[1] is NoneType:
            return _fitting(value, parts[0], name, finite)
        for each in parts:
            with suppress(CalibrationError):
                return _fitting(value, each, name, finite)
    elif kind is Literal and isinstance(value, str):
        if value in parts:
            return value
        raise UnknownNameError(name, value, parts)
    elif getattr(kind, '__name__', '') in _ARRAYS:
        from calib_ros.arrays import array_of

        return array_of(value, (get_args(parts[-1]) or parts)[0], name, finite)
    elif kind is Mapping and isinstance(value, Mapping):
        return {
            _fitting(key, parts[0], f'a key of {name}', finite): _fitting(
                each, parts[1], f'{name}[{key!r}]', finite
            )
            for key, each in value.items()
        }
    elif kind in (tuple, Sequence) and _is_list(value):
        items, several = tuple(value), kind is Sequence or parts[-1] is Ellipsis
        hints = parts[:1] * len(items) if several else parts
        if len(hints) == len(items):
            pairs = enumerate(zip(items, hints, strict=True))
            return tuple(_fitting(x, of, f'{name}[{k}]', finite) for k, (x, of) in pairs)
    elif kind is not Sequence and _TESTS.get(kind, lambda x: isinstance(x, kind))(value):
        return value
    wanted = re.sub(r'(\w+\.)+(?=\w)', '', inspect.formatannotation(hint))
    made = ' (Calibration.of(result))' if wanted == 'Calibration' else ''
    shown = f'{value!r:.60}' if isinstance(value, _QUOTED) else type(value).__name__
    raise ConfigError(f'{name} must be of type {wanted}{made}, not {shown}')


def _read_only(made: Any) -> Any:
    """Return an array, or a result that holds some, so that nobody changes it by mistake.

    These are views: an array that was given stays as it was. So do inputs, which check themselves.
    """
    if type(made).__name__ == 'ndarray':
        made = made.view()
        made.flags.writeable = False
    elif type(made) is tuple:
        return tuple(map(_read_only, made))
    elif not hasattr(made, '__post_init__'):
        for name in getattr(made, '__dataclass_fields__', ()):
            if (found := _read_only(value := getattr(made, name))) is not value:
                object.__setattr__(made, name, found)
    return made


def _passing(value: Any, name: str, test: Callable[[Any], bool], words: str) -> Any:
    if test(value):
        return value
    raise ConfigError(f'{name} must be {words}, not {value}')


def _is_list(value: object) -> bool:
    text = isinstance(value, str | bytes | Mapping)
    return isinstance(value, Collection) and not text and getattr(value, 'ndim', 1) > 0
