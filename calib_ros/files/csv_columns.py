# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The columns of a CSV: of a regular text, whose cells are cut at separators, or by csv."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import MOST_ENTRIES, InputError
from calib_ros.files.columns import Codes, Columns, MadeColumns, numbered
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.texts import LARGEST_TABLE, MOST_ROWS, csv_lines, read_text

IRREGULAR = ('"', '\r', '\0')
"""What cells are not cut at separators alone with."""
BLOCK = 2**18
"""Bytes that are looked at together: they stay in the cache."""
WIDEST, FEW = 40, 100
"""Characters of a text, and how many different ones, that are told apart all at once."""


@dataclass(frozen=True, eq=False)
class TextColumns(Columns):
    """The columns of a regular text: cells are what is between separators."""

    _rows: Sequence[str]
    _separator: str
    _bytes: NDArray[np.uint8]
    _ends: NDArray[np.int32]
    """Where each cell ends (N, C) in the bytes; it begins one after the end of the one before."""

    def blank(self, name: str) -> NDArray[np.bool_]:
        """Return (N,) which cells of a column are empty."""
        return self._empty[:, self.header.index(name)]

    def texts(self, name: str) -> list[str]:
        """Return the cells of a column."""
        k = self.header.index(name)
        return [row.split(self._separator, k + 1)[k] for row in self._rows]

    def select(self, rows: NDArray[np.generic] | slice) -> TextColumns:
        """Return some of the rows, by a mask, by indices or by a slice."""
        index = np.arange(len(self.lines))[rows]
        text = '\n'.join([self._rows[k] for k in index.tolist()])
        found = regular(self.path, text, self._separator, self.header)
        assert found is not None
        return replace(found, lines=self.lines[index])

    def codes(self, name: str) -> Codes:
        """Return the number of each row's text, and the texts."""
        k, width = self.header.index(name), len(self.header)
        starts, ends = self._ends[k:-1:width] + np.int32(1), self._ends[k + 1 :: width]
        longest = int((ends - starts).max(initial=0))
        if longest == 0:
            return np.zeros(len(starts), dtype=np.intp), ['']
        if longest > WIDEST:
            return numbered(self.texts(name))
        place = starts[:, np.newaxis] + np.arange(longest, dtype=np.int32)
        beyond = place >= ends[:, np.newaxis]
        place[beyond] = 0
        cells = self._bytes[place]
        cells[beyond] = 0
        words = np.ascontiguousarray(cells).view(f'S{longest}').ravel()
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
        return numbered(self.texts(name))

    def _numbers(self, names: Sequence[str]) -> FloatArray | None:
        columns = [self.header.index(name) for name in names]
        blank = self._empty[:, columns]
        lacking = np.asarray(blank.any(axis=0))
        some = np.flatnonzero(~(lacking & blank.all(axis=0)))
        if not len(some):
            return np.full(blank.shape, np.nan)
        rows = self._filled if lacking[some].any() else self._rows
        use = [columns[k] for k in some.tolist()]
        try:
            read = np.loadtxt(rows, delimiter=self._separator, usecols=use, ndmin=2, comments=None)
        except (ValueError, OverflowError):
            return None
        finite = np.isfinite(read)
        if not (finite.all() or (finite | blank[:, some]).all()):
            return None
        if len(some) == len(names):
            return read
        found = np.full(blank.shape, np.nan)
        found[:, some] = read
        return found

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


def read_columns(path: Path, needed: Sequence[str]) -> Columns:
    """Return the columns of a CSV with rows, some of which it needs to have."""
    return with_rows(columns_of(path, read_text(path, LARGEST_TABLE, InputError)), needed)


def with_rows(found: Columns, needed: Sequence[str]) -> Columns:
    """Return columns; refuse those without rows, and without any of those that are needed."""
    missing = [name for name in needed if name not in found.header]
    if missing:
        raise InputError(
            f'{found.path} has no column {", ".join(missing)}; expected {", ".join(needed)}; '
            f'found {", ".join(found.header) or "nothing"}'
        )
    if not len(found.lines):
        raise InputError(f'{found.path} has no rows')
    return found


def columns_of(path: Path, text: str) -> Columns:
    """Return the columns of the text of a CSV.

    Raises
    ------
    InputError
        When it is no table, has more columns or rows than any, or cells that no column or
        several columns could be meant with.

    """
    return regular(path, text) or _irregular(path, text)


def regular(
    path: Path, text: str, separator: str = ',', header: Sequence[str] = (), above: int = 0
) -> TextColumns | None:
    """Return the columns of a text, None where it is not regular.

    Its first line is the header unless one is given; `above` are lines of the file before it.
    """
    if '\r' in text:
        text = text.replace('\r\n', '\n')
    if not text or any(each in text for each in IRREGULAR):
        return None
    if not text.endswith('\n'):
        text += '\n'
    rows = text.split('\n')[:-1]
    lines = above + 1 + np.arange(len(rows))
    if '' in rows:
        lines = lines[[bool(row) for row in rows]]
        rows = [row for row in rows if row]
        text = '\n'.join([*rows, ''])
    flat = np.frombuffer(text.encode(), dtype=np.uint8)
    if not header:
        if not rows:
            return None
        flat = flat[len(rows[0].encode()) + 1 :]
        header, rows, lines = rows[0].split(separator), rows[1:], lines[1:]
    width = len(header)
    if not len(lines) or len(set(header)) < width or width > MOST_ENTRIES:
        return None
    ends = _ends(flat, separator, width * len(lines))
    if ends is None:
        return None
    if not (flat[ends[width::width]] == ord('\n')).all():
        return None
    return TextColumns(path, tuple(header), lines, rows, separator, flat, ends)


def _ends(flat: NDArray[np.uint8], separator: str, count: int) -> NDArray[np.int32] | None:
    """Return where the cells of a text end, behind a -1; None where they are not `count`."""
    ends = np.empty(count + 1, dtype=np.int32)
    ends[0], known = -1, 1
    for begin in range(0, len(flat), BLOCK):
        part = flat[begin : begin + BLOCK]
        found = np.flatnonzero((part == ord(separator)) | (part == ord('\n')))
        if known + len(found) > len(ends):
            return None
        ends[known : known + len(found)] = found + begin
        known += len(found)
    return ends if known == len(ends) else None


def _irregular(path: Path, text: str) -> MadeColumns:
    """Return the columns of a text with quotes, or with rows that end early."""
    reader = csv.reader(csv_lines(text, str(path)), strict=True)
    header: list[str] = []
    rows: list[list[str]] = []
    lines: list[int] = []
    try:
        for row in reader:
            if not (row and header):
                header = header or row
                if len(header) > MOST_ENTRIES:
                    raise InputError(f'{path} has {len(header)} columns, more than {MOST_ENTRIES}')
                continue
            if any(row[len(header) :]):
                raise InputError(
                    f'{path}, line {reader.line_num}: more values than the {len(header)} columns'
                )
            if len(rows) == MOST_ROWS:
                raise InputError(
                    f'{path} has more than {MOST_ROWS} rows: leave some out, evenly over time'
                )
            rows.append([*row[: len(header)], *[''] * (len(header) - len(row))])
            lines.append(reader.line_num)
    except csv.Error as err:
        raise InputError(f'cannot read {path}: {err}') from err
    twice = [name for name, count in Counter(header).items() if name and count > 1]
    if twice:
        raise InputError(f'{path} has several columns {", ".join(twice)}: rename all but one')
    cells = zip(*rows, strict=True) if rows else [()] * len(header)
    words = dict(zip(header, cells, strict=True))
    return MadeColumns(path, np.array(lines, dtype=np.intp), {}, words)
