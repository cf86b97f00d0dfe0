# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A table by columns, read from CSV; errors name the line, and what its header lacks."""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain, product, zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import MOST_ENTRIES, ColumnsError, InputError
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.progress import Notify, quiet
from calib_ros.shown import some
from calib_ros.texts import LARGEST_TABLE, MOST_ROWS, as_text, csv_lines, from_cell, read_bytes
from calib_ros.values import LARGEST, ROUNDED, cell_integer, parse_number

DECIMAL_COMMA = re.compile(r'\s*[+\u2212-]?[0-9]+,[0-9]+([eE][+-]?[0-9]+)?\s*')
THOUSANDS = re.compile(r"[+\u2212-]?[1-9][0-9]{0,2}([\s.,'\u2019][0-9]{3})+([.,][0-9]*)?")
MISSING = frozenset(('', 'nan', '-nan', 'na', 'n/a', '#n/a', '#nv', 'null', 'none', '-', '--'))
"""Cells without a value, in small letters."""
Cells = tuple[int, list[str]]  # line number and cells
BETWEEN = '\0'
MAYBE_MISSING = (f'{BETWEEN} ', *(f'{BETWEEN}{each}{BETWEEN}' for each in MISSING))
Codes = tuple[Index, list[str]]
"""The code (N,) of each row's text, and the texts in order of appearance."""


@dataclass(frozen=True, eq=False)
class Columns:
    """The columns of the file at `path`; `lines` (N,) are those of the rows.

    They are `words` as read, one text with BETWEEN its cells, which takes a fifth of the memory of
    a list, or `values` (N,) that were computed, with NaN for empty cells.
    """

    path: Path
    lines: Index
    words: Mapping[str, str]
    values: Mapping[str, FloatArray] = field(default_factory=dict)
    theirs: tuple[str, ...] = ()  # names in the file, if others
    decimal: str = '.'  # sign in the numbers of `words`

    @property
    def header(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return (*self.words, *self.values)

    def where(self, row: int, name: str) -> str:
        """Return the place of a cell for messages."""
        return f'{self.path}, line {self.lines[row]}: {name}'

    def _no_number(self, row: int, name: str, text: str = '') -> InputError:
        bare, remedy = text.strip(), 'correct that row or leave it out'
        if THOUSANDS.fullmatch(bare):
            remedy = 'write it without the marks between thousands'
            remedy += ', or its decimal point as a comma' * (self.decimal == ',')
        if DECIMAL_COMMA.fullmatch(bare):
            told = f'; if these are thousands, {remedy}' * bool(THOUSANDS.fullmatch(bare))
            remedy = f'write a point, or give --decimal comma{told}'
        of_units = row == 0 and bare.lower() not in MISSING and not re.search('[0-9]', bare)
        if of_units:  # perhaps, as other tables have below their header
            remedy += '; units belong into the header: q1 [deg]'
        return (ColumnsError if of_units else InputError)(
            f'{self.where(row, name)} must be a finite number, not {text!r}: {remedy}'
        )

    def numbers(self, names: Sequence[str], called: Sequence[str] = ()) -> FloatArray:
        """Return numbers (N, len(names)), NaN for empty cells; errors name them as `called`."""
        found = np.zeros((len(self.lines), len(names)))
        for k, name in enumerate(names):
            given = self.values.get(name)
            found[:, k] = _numbers(self.words[name], self.decimal) if given is None else given
        for row, k in np.argwhere(np.isinf(found))[:1].tolist():
            raise self._no_number(row, (called or names)[k], self.texts(names[k])[row])
        return found

    def block(
        self, names: Sequence[str], largest: float = LARGEST, needed: Flags | bool = True
    ) -> FloatArray:
        """Return numbers (N, len(names)); a row has all of them or, if not `needed`, none."""
        found = self.numbers(names)
        highest = max(found.max(initial=0.0), -found.min(initial=0.0))
        if np.isnan(highest):
            blank = np.isnan(found)
            lacking = blank.any(axis=1) & (needed | ~blank.all(axis=1))
            for row in np.flatnonzero(lacking)[:1].tolist():
                name = names[int(blank[row].argmax())]
                raise self._no_number(row, name, self.texts(name)[row])
            highest = np.nanmax(np.abs(found), initial=0.0)
        if highest > largest:
            row, k = np.argwhere(np.abs(found) > largest)[0].tolist()
            parse_number(float(found[row, k]), self.where(row, names[k]), InputError, largest)
        return found

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

    def labels(self, name: str) -> Codes:
        """Return the code (N,) of each row's name, and the names; empty without the column."""
        if name not in self.header:
            return np.zeros(len(self.lines), dtype=np.intp), ['']
        numbers, found = codes_of(self.texts(name))
        place, names = codes_of([from_cell(each) for each in found])
        return place[numbers], names

    def blank(self, name: str) -> Flags:
        """Return (N,) which cells of a column are empty."""
        if name in self.values:
            return np.isnan(self.values[name])
        cells = f'{BETWEEN}{self.words[name].lower()}{BETWEEN}'
        if not any(each in cells for each in MAYBE_MISSING):
            return np.zeros(len(self.lines), dtype=bool)
        return np.array([text.strip().lower() in MISSING for text in self.texts(name)], dtype=bool)

    def texts(self, name: str) -> list[str]:
        """Return the cells of a column."""
        if name in self.words:
            return self.words[name].split(BETWEEN) if len(self.lines) else []
        return ['' if value != value else repr(value) for value in self.values[name].tolist()]

    def select(self, rows: NDArray[np.generic] | slice) -> Columns:
        """Return some rows, by a mask (N,), indices (K,) or a slice."""
        index = np.arange(len(self.lines))[rows].tolist()
        words = {}
        for name in self.words:
            words[name] = BETWEEN.join(map(self.texts(name).__getitem__, index))
        values = {name: value[rows] for name, value in self.values.items()}
        return replace(self, lines=self.lines[rows], values=values, words=words)


def of_rows(path: Path, blocks: Iterable[Sequence[Cells]], header: Sequence[str] = ()) -> Columns:
    """Return columns of blocks of rows that may end early; further ones are `#1`, `#2` ..."""
    lines: list[int] = []
    columns: list[list[str]] = []  # of each block
    for block in filter(None, blocks):
        numbers, rows = zip(*block, strict=True)
        lines += numbers
        columns.append([*map(BETWEEN.join, zip_longest(*rows, fillvalue=''))])
    width = max([len(header), *map(len, columns)])
    names = [*header, *(f'#{k + 1}' for k in range(len(header), width))]
    words = {}
    for k, name in enumerate(names):
        words[name] = BETWEEN.join(
            part[k] if k < len(part) else BETWEEN * part[0].count(BETWEEN) for part in columns
        )
    return Columns(path, np.array(lines, dtype=np.intp), words)


def _refuse_zeros(path: Path, data: bytes, above: int) -> None:
    if (place := data.find(b'\0')) >= 0:
        line = above + 1 + data.count(b'\n', 0, place)
        raise ColumnsError(
            f'{path} is not UTF-8 text, line {line} has zero bytes: is it a workbook, or damaged? '
            'Save it as CSV in UTF-8'
        )


def joined_columns(parts: Sequence[Columns]) -> Columns:
    """Return the rows of successive parts of one file."""
    some = [each for each in parts if len(each.lines)]
    words = {name: BETWEEN.join([each.words[name] for each in some]) for name in parts[0].words}
    return replace(parts[0], lines=np.concatenate([each.lines for each in parts]), words=words)


def read_columns(path: Path, needed: Sequence[str]) -> Columns:
    """Return the columns of a CSV that has rows and the needed columns."""
    return with_rows(columns_of(path, read_bytes(path, LARGEST_TABLE, InputError)), needed)


def columns_of(
    path: Path, data: bytes, progress: Notify = quiet, above: int = 0, separator: str = ','
) -> Columns:
    """Return the columns of a CSV's content; refuse anything else, or too large.

    `above` is the number of lines of the file before it.
    """
    _refuse_zeros(path, data, above)
    as_text(data, str(path), ColumnsError)  # all of it, before any row
    blocks = csv_blocks(path, data, separator, strict=True, above=above)
    first: list[Cells] = next(blocks, [(above, [])])
    header = [name.strip() for name in first[0][1]]
    twice = [name for name, count in Counter(header).items() if name and count > 1]
    if twice:
        raise ColumnsError(f'{path} has several columns {", ".join(twice)}: rename all but one')
    end = above + data.count(b'\n') + 1
    return of_rows(path, _below(path, header, chain([first[1:]], blocks), end, progress), header)


def _below(
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
                    'header; remove other lines above that (of measurements: calib_ros import)'
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

    `above` lines precede the content, which is in UTF-8.
    """
    _refuse_zeros(path, data, above)
    reader = csv.reader(csv_lines(data, str(path)), delimiter=separator, strict=strict)
    line, block = 0, list[Cells]()
    try:
        for row in reader:
            line = reader.line_num
            if any(row):
                block.append((above + line, row))
            if len(block) * len(row) >= MOST_ENTRIES:  # cells that fit the caches
                if len(row) > MOST_ENTRIES:
                    raise InputError(f'{path} has {len(row)} columns, more than {MOST_ENTRIES}')
                yield block
                block = []
    except csv.Error as err:
        raise InputError(
            f'cannot read {path} from line {above + line + 1}: {err}: are its quotation marks '
            'paired?'
        ) from err
    if block:
        yield block


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


def cell_number(text: str) -> float:
    """Return the number in a cell (1.5D-3 as Fortran writes), NaN if blank, else infinity."""
    low = text.strip().lower().replace('\u2212', '-')  # the minus of typesetting
    with suppress(ValueError):
        return math.nan if low in MISSING else float(low.replace('d', 'e'))
    return math.inf


def codes_of(texts: Sequence[str]) -> Codes:
    """Return the code of each text, and the different texts."""
    known = {text: number for number, text in enumerate(dict.fromkeys(texts))}
    numbers = np.fromiter(map(known.__getitem__, texts), dtype=np.intp, count=len(texts))
    return numbers, list(known)


def joints_left_out(columns: Columns, joints: int) -> tuple[str, ...]:
    """Return a warning about joint values that the arm does not have."""
    name = f'q{joints + 1}'
    if name not in columns.header:
        return ()
    return (f'{columns.path}: the column {name} is left out: the arm has {joints} joints',)


def check_quaternions(columns: Columns, quat: FloatArray) -> None:
    """Refuse quaternions (N, 4) that are not of length 1, except NaN."""
    lengths = np.sqrt(np.einsum('ni,ni->n', quat, quat))
    for row in np.flatnonzero(np.abs(lengths - 1.0) > ROUNDED)[:1].tolist():
        raise InputError(
            f'{columns.where(row, "quaternion")} qx qy qz qw has length {lengths[row]:.6g}, '
            'expected 1: normalise it, and check the order of the columns'
        )


def lines_in_words(lines: Sequence[int]) -> str:
    """Return the numbers of the first lines as text."""
    return f'line{"s" if len(lines) > 1 else ""} {", ".join(some(list(map(str, lines))))}'


def with_rows(found: Columns, needed: Sequence[str], how: str = '') -> Columns:
    """Return columns; refuse those without rows or needed columns."""
    missing = [name for name in needed if name not in found.header]
    if missing:
        refuse_separator(found.path, found.header)
        raise InputError(
            f'{found.path} has no column {", ".join(missing)}; expected {", ".join(needed)}; '
            f'found {", ".join(found.header) or "nothing"}: name them in the first line{how}'
        )
    if not len(found.lines):
        raise InputError(f'{found.path} has no rows')
    return found


def refuse_separator(path: Path, header: Sequence[str]) -> None:
    """Raise with advice if cells are not separated by commas."""
    for name, mark in (('semicolon', ';'), ('tab', '\t')):
        if any(mark in cell for cell in header):
            raise ColumnsError(
                f'the cells of {path} are separated by {name}s: save it with commas between cells '
                'and points in numbers (measurements: calib_ros import)'
            )


def named_by_option(header: Sequence[str], missing: Sequence[str], joints: int) -> str:
    """Return --columns for the missing columns, with similar names of the header or NAME."""
    if several := [name for name in missing if header.count(name) > 1]:
        return f'Several columns are called {", ".join(several)}: rename all but one'
    if _only_numbers(header):
        numbers = ','.join(f'{name}=#{k}' for k, name in enumerate(missing, 1))
        return f'Its first line holds numbers, not names: --columns "{numbers}", in its order'
    found = {
        name: next((each for each in header if re.match(rf'{name}\b', each, re.I)), 'NAME')
        for name in missing
    }
    of_joints = [f'q{k}' for k in range(1, joints + 1)]
    whole = found.keys() >= {*of_joints}
    lacking = found.keys() & {*of_joints}
    fewer = bool(lacking) and 'q1' in header and 'q0' not in header
    like = like_joints(header, joints) if lacking and not fewer else {}
    more = '; joint values in another file: --joints FILE' if whole and not like else ''
    if whole or like:
        others = {name: found[name] for name in found if name not in of_joints}
        found = {**(like or {'q*': 'NAME*'}), **others}
    given = (f'{name}={as_typed(each)}' for name, each in found.items())
    named = ' '.join(found.values())
    units = ('length', 'mm'), ('length', 'cm'), ('angle', 'deg'), ('angle', '°')
    for option, unit in reversed(units):
        if re.search(rf'(?<!\w){unit}(?!\w)', named):
            more = f' --{option} {unit.replace("°", "deg")}{more}'
    options = f'Columns of other names: --columns "{",".join(given)}"{more}'
    return f'Is it another arm (--chain)? {options}' if fewer else options


def as_typed(name: str) -> str:
    """Return the name of a column as --columns takes it."""
    return name if re.fullmatch(r'[#\w.*]+', name) else f'{{{name}}}'


def _only_numbers(header: Sequence[str]) -> bool:
    return bool(header) and all(re.fullmatch(r'-?[\d.]+(e[+-]?\d+)?', name) for name in header)


def like_joints(header: Sequence[str], joints: int) -> dict[str, str]:
    """Return the names in a header that count the joints, with a star for the number from 1."""
    if _only_numbers(header):
        return {'q*': '#*'}
    for name, first in product(header, (1, 0)):
        for one in re.finditer(str(first), name):
            before, after = name[: one.start()], name[one.end() :]
            like = [f'{before}{k}{after}' for k in range(first, joints + first)]
            if set(like) <= set(header):
                count = {f'q{k}': each for k, each in enumerate(like, 1)}
                return {'q*': f'{before}*{after}'} if first else count
    return {}
