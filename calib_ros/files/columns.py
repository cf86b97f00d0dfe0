# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A table by columns: numbers of all rows at once.

What is made here is exactly what reading row by row makes, or nothing: where a table is not as
regular as most are (quotes, rows that end early, a cell that is no number), None is returned, and
whoever asked reads row by row and names the fault.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics.se3 import FloatArray
from calib_ros.texts import MOST_COLUMNS, Row

Lines = NDArray[np.intp]
NEWLINE = 10
IRREGULAR = (b'"', b'\r', b'\0')
"""What cells are not cut at separators alone with."""


@dataclass(frozen=True, eq=False)
class TextColumns:
    """The columns of a regular text.

    Attributes
    ----------
    header : tuple of str
    lines : (N,)
        Line of each row in the file.

    """

    header: tuple[str, ...]
    lines: Lines
    _rows: Sequence[str]
    _lengths: NDArray[np.int32]
    _separator: str

    def blank(self, name: str) -> NDArray[np.bool_]:
        """Return (N,) which cells of a column are empty."""
        return np.asarray(self._lengths[:, self.header.index(name)] == 0)

    def numbers(self, names: Sequence[str]) -> FloatArray | None:
        """Return the numbers (N, len(names)), NaN for empty cells; None where one is no number."""
        blank = np.column_stack([self.blank(name) for name in names])
        found = np.full(blank.shape, np.nan)
        some = np.flatnonzero(~blank.all(axis=0))
        if not len(some):
            return found
        rows = self._rows
        if blank[:, some].any():
            rows = self._filled
        use = [self.header.index(names[k]) for k in some.tolist()]
        try:
            read = np.loadtxt(rows, delimiter=self._separator, usecols=use, ndmin=2, comments=None)
        except (ValueError, OverflowError):
            return None
        found[:, some] = read
        return found if (np.isfinite(found) | blank).all() else None

    def integers(self, name: str) -> NDArray[np.int64] | None:
        """Return the integers (N,) of a column as written; None where one is not."""
        texts = self.texts(name)
        try:
            found = np.array([int(text) for text in texts], dtype=np.int64)
        except (ValueError, OverflowError):
            return None
        return found if list(map(str, found.tolist())) == texts else None

    def texts(self, name: str) -> list[str]:
        """Return the cells of a column."""
        k = self.header.index(name)
        if not self._lengths[:, k].any():
            return [''] * len(self._rows)
        return [row.split(self._separator, k + 1)[k] for row in self._rows]

    @cached_property
    def _filled(self) -> list[str]:
        """Return the rows with NaN in empty cells."""
        sep = self._separator
        text = '\n' + '\n'.join(self._rows) + '\n'
        for _ in range(2):  # neighbours share a separator
            text = text.replace(sep + sep, f'{sep}nan{sep}')
        text = text.replace(f'\n{sep}', f'\nnan{sep}').replace(f'{sep}\n', f'{sep}nan\n')
        return text[1:-1].split('\n')


def regular(text: str, separator: str = ',') -> TextColumns | None:
    """Return the columns of a text, None where it is not regular."""
    data = text.replace('\r\n', '\n').encode()
    if not data or any(each in data for each in IRREGULAR):
        return None
    lines = data.decode().split('\n')
    last = len(lines) - (not lines[-1])
    numbers = np.arange(1, last + 1)
    kept = lines[:last]
    if '' in kept:
        full = np.array([bool(line) for line in kept])
        numbers, kept = numbers[full], [line for line in kept if line]
    if len(kept) < 2:
        return None
    header = tuple(kept[0].split(separator))
    width = len(header)
    if len(set(header)) < width or width > MOST_COLUMNS:
        return None
    flat = np.frombuffer('\n'.join(['', *kept[1:], '']).encode(), dtype=np.uint8)
    ends = np.flatnonzero((flat == ord(separator)) | (flat == NEWLINE)).astype(np.int32)
    if len(ends) != width * (len(kept) - 1) + 1 or not (flat[ends[::width]] == NEWLINE).all():
        return None
    lengths = (np.diff(ends) - 1).reshape(-1, width)
    return TextColumns(header, numbers[1:], kept[1:], lengths, separator)


@dataclass(frozen=True, eq=False)
class MadeColumns:
    """Columns that were computed: numbers (N,), NaN where there is none, and texts."""

    lines: Lines
    values: Mapping[str, FloatArray]
    words: Mapping[str, Sequence[str]]

    @property
    def header(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return (*self.words, *self.values)

    def blank(self, name: str) -> NDArray[np.bool_]:
        """Return (N,) where a column holds nothing."""
        if name in self.words:
            return np.array([not word for word in self.words[name]])
        return np.isnan(self.values[name])

    def numbers(self, names: Sequence[str]) -> FloatArray | None:
        """Return the numbers (N, len(names)), NaN where there is none."""
        return np.column_stack([self.values[name] for name in names])

    def integers(self, name: str) -> NDArray[np.int64] | None:
        """Return the integers (N,) of a column."""
        return np.array([int(word) for word in self.words[name]], dtype=np.int64)

    def texts(self, name: str) -> list[str]:
        """Return the cells of a column."""
        if name in self.words:
            return list(self.words[name])
        return ['' if value != value else repr(value) for value in self.values[name].tolist()]

    def rows(self) -> list[tuple[int, Row]]:
        """Return the rows with their lines."""
        columns = [self.texts(name) for name in self.header]
        cells = zip(*columns, strict=True)
        return [
            (line, dict(zip(self.header, row, strict=True)))
            for line, row in zip(self.lines.tolist(), cells, strict=True)
        ]
