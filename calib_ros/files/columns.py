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
IRREGULAR = ('"', '\r', '\0')
"""What cells are not cut at separators alone with."""
WIDEST, FEW = 40, 100
"""Characters of a text, and how many different ones, that are told apart all at once."""


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
    _separator: str
    _bytes: NDArray[np.uint8]
    _ends: NDArray[np.int32]
    """Where each cell ends (N, C) in the bytes; it begins one after the end of the one before."""

    def blank(self, name: str) -> NDArray[np.bool_]:
        """Return (N,) which cells of a column are empty."""
        return self._empty[:, self.header.index(name)]

    def numbers(self, names: Sequence[str]) -> FloatArray | None:
        """Return the numbers (N, len(names)), NaN for empty cells; None where one is no number.

        Many columns at once take hardly longer than one.
        """
        columns = [self.header.index(name) for name in names]
        blank = self._empty[:, columns]
        some = np.flatnonzero(~blank.all(axis=0))
        if not len(some):
            return np.full(blank.shape, np.nan)
        rows = self._filled if blank[:, some].any() else self._rows
        use = [columns[k] for k in some.tolist()]
        try:
            read = np.loadtxt(rows, delimiter=self._separator, usecols=use, ndmin=2, comments=None)
        except (ValueError, OverflowError):
            return None
        found = read
        if len(some) < len(names):
            found = np.full(blank.shape, np.nan)
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
        return [row.split(self._separator, k + 1)[k] for row in self._rows]

    def codes(self, name: str) -> tuple[NDArray[np.intp], list[str]]:
        """Return the number (N,) of each row's text, and the texts in order of appearance."""
        starts, ends = self._spans(name)
        width = int((ends - starts).max(initial=0))
        if width == 0:
            return np.zeros(len(starts), dtype=np.intp), ['']
        if width > WIDEST:
            return _numbered(self.texts(name))
        place = starts[:, np.newaxis] + np.arange(width, dtype=np.int32)
        beyond = place >= ends[:, np.newaxis]
        place[beyond] = 0
        cells = self._bytes[place]
        cells[beyond] = 0
        words = np.ascontiguousarray(cells).view(f'S{width}').ravel()
        numbers = np.full(len(words), -1, dtype=np.intp)
        known: list[str] = []
        first = 0
        while len(known) < FEW:
            word = words[first]
            numbers[words == word] = len(known)
            known.append(bytes(word).decode())
            rest = numbers[first:] < 0
            if not rest.any():
                return numbers, known
            first += int(np.argmax(rest))
        return _numbered(self.texts(name))

    def _spans(self, name: str) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return where the cells of a column begin and end (N,)."""
        k, width = self.header.index(name), len(self.header)
        flat = self._ends
        return flat[k:-1:width] + np.int32(1), flat[k + 1 :: width]

    @cached_property
    def _empty(self) -> NDArray[np.bool_]:
        """Return which cells (N, C) are empty."""
        return np.asarray(np.diff(self._ends) == 1).reshape(-1, len(self.header))

    @cached_property
    def _filled(self) -> list[str]:
        """Return the rows with NaN in empty cells."""
        sep = self._separator
        text = '\n' + '\n'.join(self._rows) + '\n'
        for _ in range(2):  # neighbours share a separator
            text = text.replace(sep + sep, f'{sep}nan{sep}')
        text = text.replace(f'\n{sep}', f'\nnan{sep}').replace(f'{sep}\n', f'{sep}nan\n')
        return text[1:-1].split('\n')


def regular(
    text: str, separator: str = ',', header: Sequence[str] = (), above: int = 0
) -> TextColumns | None:
    """Return the columns of a text, None where it is not regular.

    Its first line is the header unless one is given; `above` are lines of the file before it.
    """
    if '\r' in text:
        text = text.replace('\r\n', '\n')
    if not text or any(each in text for each in IRREGULAR):
        return None
    rows = text.split('\n')
    if not rows[-1]:
        rows.pop()
    lines = np.arange(above + 1, above + 1 + len(rows))
    whole = '' not in rows
    if not whole:
        lines = lines[[bool(row) for row in rows]]
        rows = [row for row in rows if row]
    if not header:
        if not rows:
            return None
        header, lines = rows[0].split(separator), lines[1:]
        rows, whole = rows[1:], False
    width = len(header)
    if not rows or len(set(header)) < width or width > MOST_COLUMNS:
        return None
    body = text if whole and text.endswith('\n') else '\n'.join(rows) + '\n'
    flat = np.frombuffer(f'\n{body}'.encode(), dtype=np.uint8)
    ends = np.flatnonzero((flat == ord(separator)) | (flat == NEWLINE)).astype(np.int32)
    if len(ends) != width * len(rows) + 1 or not (flat[ends[::width]] == NEWLINE).all():
        return None
    return TextColumns(tuple(header), lines, rows, separator, flat, ends)


def _numbered(texts: Sequence[str]) -> tuple[NDArray[np.intp], list[str]]:
    """Return the number (N,) of each text, and the different ones in order of appearance."""
    known: dict[str, int] = {}
    numbers = [known.setdefault(text, len(known)) for text in texts]
    return np.array(numbers, dtype=np.intp), list(known)


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

    def codes(self, name: str) -> tuple[NDArray[np.intp], list[str]]:
        """Return the number (N,) of each row's text, and the texts in order of appearance."""
        return _numbered(self.texts(name))

    def rows(self) -> list[tuple[int, Row]]:
        """Return the rows with their lines."""
        columns = [self.texts(name) for name in self.header]
        cells = zip(*columns, strict=True)
        return [
            (line, dict(zip(self.header, row, strict=True)))
            for line, row in zip(self.lines.tolist(), cells, strict=True)
        ]
