# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Short representations of values."""

from __future__ import annotations

import html
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from datetime import datetime, timezone
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ConfigError
from calib_ros.texts import capitalised

NAMED = 5  # items named in a sentence; a convention
LISTED = 4 * NAMED  # items listed in a table or longer text


def some(words: Sequence[str], most: int = NAMED) -> list[str]:
    """Return the first words, and the number of the others."""
    more = len(words) - most
    return [*words[:most], f'and {more} more'] if more > 0 else list(words)


def rounded(value: float, sign: str = '') -> str:
    """Return mm or mrad with three decimals, more if two digits need them, fewer from 100."""
    if math.isfinite(value) and abs(value) >= 999.95:
        return f'{value:{sign}{"," if abs(value) >= 1e4 else ""}.0f}'  # 1,210 may be read as 1.210
    told = math.isfinite(value) and abs(value) >= 1e-6  # less is what computing leaves
    digits = 1 - math.floor(math.log10(abs(value))) if told else 0
    return f'{value:{sign}.{1 if abs(value) >= 100.0 else max(3, digits)}f}'


def two_digits(value: float) -> str:
    """Return mm, mrad or ms with two digits, of large ones without a power of ten: 8.4, 150."""
    return f'{float(f"{value:.2g}"):g}'


def sentence(text: str) -> str:
    """Return a text with its capital letter and full stop, unless it has an end of its own."""
    return f'{capitalised(text)}{"" if text.endswith((".", "?")) else "."}'


def counted(count: int, what: str) -> str:
    """Return a number of things: 1 pose, 2 poses."""
    return f'{count} {what}{"s" * (count != 1)}'


def of_them(count: int, what: str) -> str:
    """Return how many of several are outliers or effects."""
    return f'1 of them an {what}' if count == 1 else f'{count} of them {what}s'


def rows_in_words(
    rows: Sequence[int], stamps_ns: NDArray[np.int64], of_messages: bool = False
) -> str:
    """Return some of N measurements (N,), from 0: line 2, poses 3 to 5, 8, or their times."""
    lines = are_lines(stamps_ns, of_messages)
    numbers = np.take(stamps_ns // 10**9, rows) if lines else np.add(rows, 1)
    names = [moment(stamps_ns[k]) for k in rows] if of_messages else [*map(str, numbers)]
    runs = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(numbers) != 1) + 1)
    words = [' to '.join(dict.fromkeys((names[run[0]], names[run[-1]]))) for run in runs]
    what = f'{"line" if lines else "pose"}{"s" * (len(rows) > 1)}{" of" * of_messages}'
    return f'{what} {", ".join(some(words))}'


def are_lines(stamps_ns: NDArray[np.int64], of_messages: bool = False) -> bool:
    """Tell whether stamps (N,) are lines of a table, in whole seconds, not such by chance."""
    lines, fractions = np.divmod(stamps_ns, 10**9)
    return not (of_messages or fractions.any() or lines.min() <= 0 or lines.max() >= 10**6)


def is_time(stamp_ns: int) -> bool:
    """Tell whether a stamp is a time (from 1973), not since a start or from lines."""
    return stamp_ns >= 10**17


def interval_mm(lower: float, upper: float) -> str:
    """Return an interval [mm] with as many decimals at both ends, if the upper one has any."""
    if np.isinf(upper):
        return f'at least {rounded(lower)}'
    end = rounded(upper)
    decimals = len(end.partition('.')[2])
    return f'{f"{lower:.{decimals}f}" if decimals else rounded(lower)} to {end}'


def moment(stamp_ns: int | np.int64) -> str:
    """Return a stamp as a time, or as seconds, to a millisecond."""
    seconds, rest = divmod(int(stamp_ns) // 10**6, 1000)
    if not is_time(int(stamp_ns)):
        return f'{seconds}.{rest:03d} s'
    time = datetime.fromtimestamp(seconds, timezone.utc)
    return f'{time:%Y-%m-%d %H:%M:%S}.{rest:03d} UTC'


class Shown:
    """A dataclass whose fields are shown in brief: arrays by shape, long values by their size."""

    def __repr__(self) -> str:
        """Return the fields in brief, on as few lines as they need."""
        text = ', '.join(f'{name}={value}' for name, value in _briefly(self))
        return textwrap.fill(f'{type(self).__name__}({text})', 99, subsequent_indent='    ')

    def _repr_html_(self) -> str:
        """Return the fields in brief as a table, for notebooks."""
        return as_html(type(self).__name__, (), (('field', 'value'), *_briefly(self)))


def as_html(caption: str, text: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return paragraphs and a table, whose first row is the header, for notebooks."""
    lines = [f'<p><strong>{html.escape(caption)}</strong></p>']
    lines += [*(f'<p>{html.escape(each)}</p>' for each in text), '<table>']
    for k, row in enumerate(rows):
        tag = 'td' if k else 'th'
        cells = ''.join(f'<{tag}>{html.escape(cell)}</{tag}>' for cell in row)
        lines.append(f'<tr>{cells}</tr>')
    return '\n'.join([*lines, '</table>'])


def as_frame(columns: Mapping[str, Any]) -> Any:
    """Return columns as a pandas.DataFrame, if pandas is installed."""
    try:
        import pandas
    except ImportError as err:
        raise ConfigError('a data frame needs pandas: pip install pandas') from err
    return pandas.DataFrame(columns)


def _briefly(value: Any) -> list[tuple[str, str]]:
    return [(each.name, _brief(getattr(value, each.name))) for each in fields(value)]


def _brief(value: object) -> str:
    """Return a value as short text, a longer one by its kind and size."""
    if isinstance(value, np.ndarray):
        return f'{value.dtype}{list(value.shape)}'
    if isinstance(value, Shown):
        name = getattr(value, 'name', '')
        return f'<{type(value).__name__}{" " + name if isinstance(name, str) and name else ""}>'
    if isinstance(value, float):
        return f'{value:.6g}'
    if isinstance(value, tuple | list | Mapping):
        plain = not any(isinstance(each, np.ndarray | Shown) for each in value)
        text, kind = repr(value) if plain else '', type(value).__name__
        if 0 < len(text) <= 60:
            return text
        return f'<{kind}>' if hasattr(value, '_fields') else f'<{len(value)} in a {kind}>'
    text = repr(value)
    return f'<{type(value).__name__}>' if len(text) > 60 and is_dataclass(value) else clipped(text)


def clipped(text: str) -> str:
    """Return a text, or the beginning of a long one."""
    return text if len(text) <= 60 else text[:57] + '...'
