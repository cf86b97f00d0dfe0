# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The cells of a table by columns, and the numbers, integers and names in them.

A strict CSV has its header in the first line, commas between cells and text in UTF-8.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, islice, zip_longest
from operator import length_hint
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import MOST_ENTRIES, ColumnsError, InputError
from calib_ros.files.headers import refuse_separator
from calib_ros.files.vocabulary import DECIMAL_COMMA, IN_ORDER, MISSING, THOUSANDS, UNIT_SIGNS
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.progress import Notify, quiet
from calib_ros.shown import some
from calib_ros.texts import (
    LARGEST_TABLE,
    MOST_ROWS,
    as_text,
    csv_lines,
    csv_text,
    from_cell,
    read_bytes,
)
from calib_ros.values import LARGEST, ROUNDED, cell_integer, parse_number

Cells = tuple[int, list[str]]  # line number and cells
BETWEEN = '\0'
Codes = tuple[Index, list[str]]
"""The code (N,) of each row's text, and the texts in order of appearance."""


@dataclass(frozen=True, eq=False)
class Columns:
    """The columns of the file at `path` by name; `lines` (N,) are those of the rows.

    A column is one text with BETWEEN its cells, which takes a fifth of the memory of a list, or
    computed numbers (N,) with NaN for empty cells.
    """

    path: Path
    lines: Index
    cells: Mapping[str, str | FloatArray]
    theirs: tuple[str, ...] = ()  # names in the file, if others
    decimal: str = '.'  # sign in the numbers of texts

    @property
    def header(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(self.cells)

    def where(self, row: int, name: str) -> str:
        """Return the place of a cell for messages."""
        return f'{self.path}, line {self.lines[row]}: {name}'

    def refuse(self, wrong: Flags | np.bool_, told: str | Callable[[int], str]) -> None:
        """Refuse the first of the rows (N,) that are wrong."""
        for row in np.flatnonzero(wrong)[:1].tolist():
            raise InputError(self.where(row, told if isinstance(told, str) else told(row)))

    def _no_number(self, row: int, name: str, called: str) -> InputError:
        text, remedy = self.texts(name)[row], 'correct that row or leave it out'
        bare = text.strip()
        if THOUSANDS.fullmatch(bare):
            remedy = 'write it without the marks between thousands'
            remedy += ', or its decimal point as a comma' * (self.decimal == ',')
        if commas := DECIMAL_COMMA.fullmatch(bare) is not None:
            told = f'; if these are thousands, {remedy}' * bool(THOUSANDS.fullmatch(bare))
            remedy = f'write a point or (measurements) give --decimal comma{told}'
        if bare.split(' [')[0] == called.split(' [')[0]:  # the header again, but not the same
            remedy = 'other columns or units begin there: split the file above that line'
        cut = re.fullmatch(r'[^a-z]*[0-9.] ?(\D+)', bare, re.I)
        if cut and cut[1].lower() in UNIT_SIGNS:
            remedy = f'write its unit into the header, {called.split(" [")[0]} [{cut[1]}]'
        words = bare.lower() not in MISSING and not re.search('[0-9]', bare)
        words |= re.match(r'#|%|//|[^\W\d_]{2}', bare) is not None  # Run 2, # page 2
        if words and row == 0:  # perhaps, as other tables have below their header
            told = '' if bare.strip('[]()').lower() in UNIT_SIGNS else f'{remedy}; '
            remedy = f'{told}units belong into the header: q1 [deg]'
        found = repr(text) if text else 'empty or NaN'
        return (ColumnsError if words or (commas and not row) else InputError)(
            f'{self.where(row, called)} must be a finite number, not {found}: {remedy}'
        )

    def numbers(self, names: Sequence[str], called: Sequence[str] = ()) -> FloatArray:
        """Return numbers (N, len(names)), NaN for empty cells; errors name them as `called`."""
        found = np.zeros((len(self.lines), len(names)))
        for k, name in enumerate(names):
            found[:, k] = self._read(name)
        for row, k in np.argwhere(np.isinf(found))[:1].tolist():
            raise self._no_number(row, names[k], (called or names)[k])
        return found

    def block(
        self, names: Sequence[str], largest: float = LARGEST, needed: Flags | bool = True
    ) -> FloatArray:
        """Return numbers (N, len(names)); a row has all of them or, if not `needed`, none."""
        found = self.numbers(names)
        blank = np.isnan(found)
        lacking = blank.any(axis=1) & (needed | ~blank.all(axis=1))
        for row in np.flatnonzero(lacking)[:1].tolist():
            name = names[int(blank[row].argmax())]
            raise self._no_number(row, name, name)
        for row, k in np.argwhere(np.abs(found) > largest)[:1].tolist():
            parse_number(float(found[row, k]), self.where(row, names[k]), InputError, largest)
        return found

    def joint_values(self, names: Sequence[str]) -> FloatArray:
        """Return the numbers (N, len(names)) of joints beside measurements."""
        told = 'must not be empty: each row needs joint values beside what was measured; '
        told += 'keep one row of a recording for each stop, or give a bag'
        self.refuse(self.blank(names[0]), f'{names[0]} {told}')
        return self.block(names)

    def integers(self, name: str, blank: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """Return the integers (N,) of a column; `blank` (N,) replaces empty cells."""
        texts = self.texts(name)
        if re.fullmatch('(-?[0-9]{1,19},)*', ','.join([*texts, ''])):
            with suppress(ValueError, OverflowError):  # found cell by cell below
                return np.array(list(map(int, texts)), dtype=np.int64)
        numbers = [
            int(blank[row])
            if blank is not None and text.strip().lower() in MISSING
            else cell_integer(text, self.where(row, name))
            for row, text in enumerate(texts)
        ]
        return np.array(numbers, dtype=np.int64)

    def labels(self, name: str, meaning: Callable[[str], str] = str) -> Codes:
        """Return the code (N,) of each row's name, and the names; empty without the column."""
        if name not in self.cells:
            return np.zeros(len(self.lines), dtype=np.intp), ['']
        numbers, found = codes_of(self.texts(name))
        place, names = codes_of([meaning(from_cell(each)) for each in found])
        return place[numbers], names

    def blank(self, name: str) -> Flags:
        """Return (N,) which cells of a column are empty; all without the column."""
        count = len(self.lines)
        return np.isnan(self._read(name)) if name in self.cells else np.ones(count, dtype=bool)

    def _read(self, name: str) -> FloatArray:
        """Return numbers (N,), NaN for empty cells, infinity for others without one."""
        given = self._known.get(name, self.cells[name])
        if isinstance(given, str):
            given = self._known[name] = _numbers(given, self.decimal)[: len(self.lines)]
        return given

    @cached_property
    def _known(self) -> dict[str, FloatArray]:
        """Numbers read so far: those of a measurement tell which rows have one."""
        return {}

    def texts(self, name: str) -> list[str]:
        """Return the cells of a column."""
        given = self.cells[name]
        if isinstance(given, str):
            return given.split(BETWEEN) if len(self.lines) else []
        return ['' if value != value else repr(value) for value in given.tolist()]

    def select(self, rows: NDArray[np.generic] | slice) -> Columns:
        """Return some rows, by a mask (N,), indices (K,) or a slice."""
        index = np.arange(len(self.lines))[rows].tolist()
        cells = {
            name: BETWEEN.join(map(self.texts(name).__getitem__, index))
            if isinstance(given, str)
            else given[rows]
            for name, given in self.cells.items()
        }
        return replace(self, lines=self.lines[rows], cells=cells)


def from_rows(
    path: Path, blocks: Iterable[Sequence[Cells]], header: Sequence[str] = ()
) -> Columns:
    """Return columns of blocks of rows that may end early; further ones are `#1`, `#2` ..."""
    lines: list[int] = []
    parts: list[list[str]] = []  # the columns of each block
    for block in filter(None, blocks):
        numbers, rows = zip(*block, strict=True)
        lines += numbers
        parts.append([*map(BETWEEN.join, zip_longest(*rows, fillvalue=''))])
    width = max([len(header), *map(len, parts)])
    cells = {}
    for k, name in enumerate([*header, *(f'#{k + 1}' for k in range(len(header), width))]):
        cells[name] = BETWEEN.join(
            part[k] if k < len(part) else BETWEEN * part[0].count(BETWEEN) for part in parts
        )
    return Columns(path, np.array(lines, dtype=np.intp), cells)


def joined_columns(parts: Sequence[Columns]) -> Columns:
    """Return the rows of successive parts, as read, of one file."""
    some = [each for each in parts if len(each.lines)]
    cells = {
        name: BETWEEN.join([str(each.cells[name]) for each in some]) for name in parts[0].cells
    }
    return replace(parts[0], lines=np.concatenate([each.lines for each in parts]), cells=cells)


def read_columns(path: Path, needed: Sequence[str]) -> Columns:
    """Return the columns of a CSV that has rows and the needed columns."""
    return require_rows(columns_of(path, read_bytes(path, LARGEST_TABLE, InputError)), needed)


def require_rows(found: Columns, needed: Sequence[str], how: str = '') -> Columns:
    """Return columns; refuse those without rows or needed columns."""
    missing = [name for name in needed if name not in found.cells]
    if missing:
        refuse_separator(found.path, found.header)
        raise InputError(
            f'{found.path} has no column {", ".join(missing)}; expected {", ".join(needed)}; '
            f'found {", ".join(found.header) or "nothing"}: name them in the first line{how}'
        )
    if not len(found.lines):
        raise InputError(f'{found.path} has no rows')
    return found


def columns_of(
    path: Path, data: bytes, progress: Notify = quiet, above: int = 0, separator: str = ','
) -> Columns:
    """Return the columns of a CSV's content; refuse anything else, or too large.

    `above` is the number of lines of the file before it.
    """
    blocks = csv_blocks(path, data, separator, strict=True, above=above)
    first: list[Cells] = next(blocks, [(above, [])])
    header = [' '.join(name.split()) for name in first[0][1]]
    twice = [name for name, count in Counter(header).items() if name and count > 1]
    if twice:
        raise ColumnsError(f'{path} has several columns {", ".join(twice)}: rename all but one')
    end = above + data.count(b'\n') + 1
    return from_rows(
        path, _rows_below(path, header, chain([first[1:]], blocks), end, progress), header
    )


def _rows_below(
    path: Path, header: Sequence[str], blocks: Iterable[list[Cells]], end: int, progress: Notify
) -> Iterator[list[Cells]]:
    """Yield the rows below a header, up to a last line; refuse more values than names."""
    width, count = len(header), 0
    for block in blocks:
        for line, cells in [row for row in block if len(row[1]) > width]:
            if any(cells[width:]):
                refuse_separator(path, header)
                raise ColumnsError(
                    f'{path}, line {line}: more values than the {width} columns of its '
                    'header; remove other lines above that (measurements: calib_ros import)'
                )
            del cells[width:]
        count += len(block)
        if count > MOST_ROWS:
            raise InputError(
                f'{path} has more than {MOST_ROWS} rows: leave some out, evenly over time'
            )
        yield block
        progress(min(block[-1][0] / end, 1.0) if block else 0.0)


def csv_blocks(
    path: Path, data: bytes, separator: str = ',', strict: bool = False, above: int = 0
) -> Iterator[list[Cells]]:
    """Yield rows that are not empty: the line at which each ends, and its cells.

    `above` lines precede the content, which is in UTF-8, all of it.
    """
    if (place := data.find(b'\0')) >= 0:
        line = above + 1 + data.count(b'\n', 0, place)
        raise ColumnsError(
            f'{path} is not UTF-8 text, line {line} has zero bytes: is it a workbook, or damaged? '
            'Save it as CSV in UTF-8'
        )
    as_text(data, str(path), ColumnsError)
    end = iter(['\n'])  # no row, unless a quotation mark is open
    reader = csv.reader(chain(csv_lines(data, str(path)), end), delimiter=separator, strict=strict)
    before = line = width = 0
    try:
        while length_hint(end):
            some = islice(reader, MOST_ENTRIES // width + 1 if width else 1)  # fits the caches
            rows = [(line, row) for row in some if (line := reader.line_num)]
            if line - before > len(rows) and (at := _quoted(rows, before, width, separator)) >= 0:
                line = at
                raise csv.Error('whole rows are within quotation marks')
            if rows and rows[-1][1] and not length_hint(end):
                line = rows[-2][0] if len(rows) > 1 else before
                raise csv.Error('unexpected end of data')
            if (most := max((len(row) for _, row in rows), default=0)) > MOST_ENTRIES:
                told = f'{path} has {most} columns, more than {MOST_ENTRIES}'
                raise InputError(f'{told}: leave out those that are not needed')
            width, before = next((len(row) for _, row in reversed(rows) if row), width), line
            if block := [(above + last, row) for last, row in rows if any(row)]:
                yield block
    except csv.Error as err:
        raise (InputError if width > 1 else ColumnsError)(  # other separators may suit the header
            f'cannot read {path} from line {above + line + 1}: {err}: are its quotation marks '
            'paired?'
        ) from err


def _quoted(rows: Iterable[Cells], before: int, width: int, separator: str) -> int:
    """Return the line before a row that holds whole rows within quotation marks, or -1.

    `before` is the line at which the row before them ends, `width` how many cells it has.
    """
    for line, row in rows:
        within = re.split('\r\n?|\n', separator.join(row)) if line - before > 1 < width else ()
        if {part.count(separator) for part in within} == {width - 1}:  # a note has others
            return before
        before, width = line, len(row) or width
    return -1


def _numbers(text: str, decimal: str = '.') -> FloatArray:
    """Return the numbers (N,) in joined cells, NaN if blank, infinity if there is none.

    They are read in parts that fit the caches: numpy takes four bytes for a character. Points
    between thousands are no decimals: 1.554 beside decimal commas is no number.
    """
    if decimal == ',' and '.' in text:
        cells = text.split(BETWEEN)
        thousands = ('.' in c and THOUSANDS.fullmatch(c.strip()) for c in cells)
        text = BETWEEN.join([f'{c}?' if t else c for c, t in zip(cells, thousands, strict=True)])
    if decimal == ',':
        text = text.replace(',', '.')
    if not text.strip(BETWEEN):
        return np.full(text.count(BETWEEN) + 1, np.nan)
    found, begin = [], 0
    while begin <= len(text):
        end = text.find(BETWEEN, begin + 100 * MOST_ENTRIES)
        part = text[begin : end if end >= 0 else None]
        begin += len(part) + 1
        try:  # a line of numbers, behind one because no line may be empty
            found.append(np.loadtxt([f'0{BETWEEN}{part}'], delimiter=BETWEEN, comments=None)[1:])
        except ValueError:
            found.append(np.array([*map(cell_number, part.split(BETWEEN))]))
    return np.concatenate(found)


def cell_number(text: str, decimal: str = '.') -> float:
    """Return the number in a cell (1.5D-3 as Fortran writes), NaN if blank, else infinity."""
    low = text.strip().lower().replace('\u2212', '-')  # the minus of typesetting
    low = low.replace(decimal, '.').replace('_', '?')  # 1_0 is 10 to Python only
    with suppress(ValueError):
        return math.nan if low in MISSING else float(low.replace('d', 'e'))
    return math.inf


def codes_of(texts: Sequence[str]) -> Codes:
    """Return the code of each text, and the different texts."""
    known = {text: number for number, text in enumerate(dict.fromkeys(texts))}
    numbers = np.fromiter(map(known.__getitem__, texts), dtype=np.intp, count=len(texts))
    return numbers, list(known)


def check_quaternions(columns: Columns, quat: FloatArray) -> None:
    """Refuse quaternions (N, 4) that are not of length 1, except NaN."""
    lengths = np.sqrt(np.einsum('ni,ni->n', quat, quat))
    columns.refuse(
        np.abs(lengths - 1.0) > ROUNDED,
        lambda row: (
            f'quaternion qx qy qz qw has length {lengths[row]:.6g}, expected 1: normalise it, and '
            'check the order of the columns'
        ),
    )


def lines_in_words(lines: Sequence[int]) -> str:
    """Return the numbers of the first lines as text."""
    return f'line{"s" if len(lines) > 1 else ""} {", ".join(some(list(map(str, lines))))}'


def as_csv(columns: Columns) -> str:
    """Return the text of a table; numbers are exact."""
    names = [name for name in IN_ORDER if name in columns.cells]
    names += [name for name in columns.cells if name not in names]
    return csv_text([names, *zip(*map(columns.texts, names), strict=True)])
