# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The columns of a CSV: regular text is split at separators, other text read by csv."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import MOST_ENTRIES, ColumnsError, InputError
from calib_ros.files.columns import (
    Codes,
    Columns,
    MadeColumns,
    Row,
    numbered,
    of_cells,
    refuse_separator,
    with_rows,
)
from calib_ros.kinematics.se3 import Flags, FloatArray
from calib_ros.progress import Notify, quiet
from calib_ros.texts import LARGEST_TABLE, MOST_ROWS, csv_lines, decoded, read_bytes
from calib_ros.values import MOST_NAMES

IRREGULAR = (b'"', b'\r', b'\0')  # characters that need the csv module


@dataclass(frozen=True, eq=False)
class _TextColumns(Columns):
    """The columns of a regular text: cells are what is between separators."""

    _separator: str
    _data: bytes
    _ends: NDArray[np.int32]
    """Ends of the cells (N, C) in the text; each starts after the end of the one before."""

    def blank(self, name: str) -> Flags:
        begins, ends = self._places(name)
        return np.asarray(begins == ends)

    def texts(self, name: str) -> list[str]:
        begins, ends = self._places(name)
        data, places = self._data, zip(begins.tolist(), ends.tolist(), strict=True)
        return [data[begin:end].decode() for begin, end in places]

    def select(self, rows: NDArray[np.generic] | slice) -> Columns:
        index, width = np.arange(len(self.lines))[rows], len(self.header)
        begins, ends = self._ends[:-1:width][index] + 1, self._ends[width::width][index]
        places = zip(begins.tolist(), ends.tolist(), strict=True)
        data = b'\n'.join([self._data[begin:end] for begin, end in places])
        found = regular(self.path, data, self._separator, self.header)
        assert found is not None
        return replace(found, lines=self.lines[index])

    def codes(self, name: str) -> Codes:
        starts, ends = self._places(name)
        longest = int((ends - starts).max(initial=0))
        if longest == 0:
            return np.zeros(len(starts), dtype=np.intp), ['']
        if longest > MOST_NAMES:
            return numbered(self.texts(name))
        place = starts[:, np.newaxis] + np.arange(longest, dtype=np.int32)
        beyond = place >= ends[:, np.newaxis]
        place[beyond] = 0
        cells = np.frombuffer(self._data, dtype=np.uint8)[place]
        cells[beyond] = 0
        words = np.ascontiguousarray(cells).view(f'S{longest}').ravel()
        runs = np.flatnonzero(np.append(True, words[1:] != words[:-1]))
        numbers, known = numbered([word.decode() for word in words[runs].tolist()])
        return np.repeat(numbers, np.diff(np.append(runs, len(words)))), known

    def _numbers(self, names: Sequence[str]) -> FloatArray:
        columns = [self.header.index(name) for name in names]
        blank = (np.diff(self._ends) == 1).reshape(-1, len(self.header))[:, columns]
        lacking = np.asarray(blank.any(axis=0))
        some = np.flatnonzero(~(lacking & blank.all(axis=0)))
        if not len(some):
            return np.full(blank.shape, np.nan)
        rows = io.BytesIO(self._filled() if lacking[some].any() else self._data)
        if not lacking[some].any():
            rows.seek(int(self._ends[0]) + 1)
        sep, use = self._separator, [columns[k] for k in some.tolist()]
        try:  # latin1 decodes any byte in other columns
            read = np.loadtxt(rows, float, None, sep, usecols=use, ndmin=2, encoding='latin1')
        except (ValueError, OverflowError):
            return super()._numbers(names)
        finite = np.isfinite(read)
        if not finite.all():
            read[~finite & ~blank[:, some]] = np.inf
        if len(some) == len(names):
            return read
        found = np.full(blank.shape, np.nan)
        found[:, some] = read
        return found

    def _filled(self) -> bytes:
        sep = self._separator.encode()
        data = b'\n' + self._data[int(self._ends[0]) + 1 :]
        for _ in range(2):  # neighbours share a separator
            data = data.replace(sep + sep, sep + b'nan' + sep)
        return data.replace(b'\n' + sep, b'\nnan' + sep).replace(sep + b'\n', sep + b'nan\n')

    def _places(self, name: str) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        k, width = self.header.index(name), len(self.header)
        return self._ends[k:-1:width] + np.int32(1), self._ends[k + 1 :: width]


def read_columns(path: Path, needed: Sequence[str]) -> Columns:
    """Return the columns of a CSV that has rows and the needed columns."""
    return with_rows(columns_of(path, read_bytes(path, LARGEST_TABLE, InputError)), needed)


def columns_of(path: Path, data: bytes, progress: Notify = quiet, above: int = 0) -> Columns:
    """Return the columns of a CSV's content; refuse anything else, or too large.

    `above` is the number of lines of the file before it.
    """
    if (place := data.find(b'\0')) >= 0:
        line = above + 1 + data.count(b'\n', 0, place)
        raise ColumnsError(
            f'{path} is not UTF-8 text, line {line} has zero bytes: is it a workbook, or damaged? '
            'Save it as CSV in UTF-8'
        )
    if not data.isascii():
        data = decoded(data, str(path), ColumnsError).encode()
    found = regular(path, data, above=above)
    return found or _irregular(path, data.decode(), progress, above)


def regular(
    path: Path, data: bytes, separator: str = ',', header: Sequence[str] = (), above: int = 0
) -> Columns | None:
    """Return the columns of a text, None if irregular.

    Its first line is the header unless one is given; `above` lines of the file precede it.
    """
    if b'\r' in data:
        data = data.replace(b'\r\n', b'\n')
    if not data or any(each in data for each in IRREGULAR):
        return None
    if not data.endswith(b'\n'):
        data += b'\n'
    begin = 0 if header else data.index(b'\n') + 1
    names = tuple(header or map(str.strip, data[: begin - 1].decode().split(separator)))
    width = len(names)
    if len(set(names)) < width or width > MOST_ENTRIES:
        return None
    ends = None
    if begin + 1 < len(data):
        ends = _ends(data, begin, separator, width)
    if (ends is None or width == 1) and b'\n\n' in b'\n' + data:
        rows = data.split(b'\n')[:-1]
        found = regular(path, b'\n'.join(filter(None, rows)), separator, header)
        lines = above + 1 + np.flatnonzero([bool(row) for row in rows])[int(not header) :]
        return found and replace(found, lines=lines)
    if ends is None:
        return None
    lines = above + 1 + int(begin > 0) + np.arange((len(ends) - 1) // width)
    return _TextColumns(path, names, lines, separator, data, ends)


def _ends(data: bytes, begin: int, separator: str, width: int) -> NDArray[np.int32] | None:
    """Return the ends of the cells of a text, after that of what is before; None if ragged."""
    flat = np.frombuffer(data, dtype=np.uint8)
    last = flat[begin:] == ord('\n')
    found = np.flatnonzero(last | (flat[begin:] == ord(separator))) + begin
    if len(found) != width * np.count_nonzero(last):
        return None
    ends: NDArray[np.int32] = np.append(begin - 1, found).astype(np.int32)
    return ends if (flat[ends[width::width]] == ord('\n')).all() else None


def _irregular(path: Path, text: str, progress: Notify, above: int) -> MadeColumns:
    header: list[str] = []
    rows: list[Row] = []
    most = text.count('\n') + 1
    for line, row in csv_rows(path, text, strict=True):
        progress(min(line / most, 1.0))
        line += above
        if not (row and header):
            header = header or [name.strip() for name in row]
            continue
        if any(row[len(header) :]):
            refuse_separator(path, header)
            raise ColumnsError(
                f'{path}, line {line}: more values than the {len(header)} columns of its header; '
                'remove other lines above that (of measurements: calib_ros import)'
            )
        if len(rows) == MOST_ROWS:
            raise InputError(
                f'{path} has more than {MOST_ROWS} rows: leave some out, evenly over time'
            )
        rows.append((line, row[: len(header)]))
    twice = [name for name, count in Counter(header).items() if name and count > 1]
    if twice:
        raise ColumnsError(f'{path} has several columns {", ".join(twice)}: rename all but one')
    return of_cells(path, header, rows)


def csv_rows(
    path: Path, text: str, separator: str = ',', strict: bool = False
) -> Iterator[tuple[int, list[str]]]:
    """Yield the line at which each row of a text ends, and its cells."""
    reader = csv.reader(csv_lines(text, str(path)), delimiter=separator, strict=strict)
    line = 0
    try:
        for row in reader:
            if len(row) > MOST_ENTRIES:
                raise InputError(f'{path} has {len(row)} columns, more than {MOST_ENTRIES}')
            yield (line := reader.line_num), row
    except csv.Error as err:
        raise InputError(
            f'cannot read {path} from line {line + 1}: {err}: are its quotation marks paired?'
        ) from err
