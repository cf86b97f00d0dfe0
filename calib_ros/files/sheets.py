# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of other systems as text columns: files and workbooks with any head.

Guesses (encoding, separator, decimal sign, header line) are reported.
"""

from __future__ import annotations

import codecs
import math
import re
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

from calib_ros.errors import MOST_ENTRIES, InputError
from calib_ros.files.columns import (
    DECIMAL_COMMA,
    THOUSANDS,
    Cells,
    Columns,
    cell_number,
    csv_blocks,
    lines_in_words,
    of_rows,
)
from calib_ros.files.layouts import ANGLES, LENGTHS, SEPARATORS, Layout
from calib_ros.shown import some
from calib_ros.texts import LARGEST_TABLE, read_bytes

HEAD_LINES = MOST_ENTRIES // 10
"""Lines searched for the header and the first row of numbers."""
LARGEST_SHEET = 3 * LARGEST_TABLE  # bytes of an unpacked workbook
SHEETS = ('.xlsx', '.xlsm')
LONG = {'degree': 'deg', 'radian': 'rad', 'meter': 'm', 'centimeter': 'cm', 'millimeter': 'mm'}
LONG |= {'micrometer': 'um'}
UNIT_SIGNS = {word + s: unit for word, unit in LONG.items() for s in ('', 's')}
UNIT_SIGNS |= {'°': 'deg', 'µm': 'um', 'μm': 'um', 'inch': 'in', 'inches': 'in'}
UNIT_SIGNS |= {unit: unit for unit in (*LENGTHS, *ANGLES)}
"""Units by their signs and words in small letters."""
_ANY = '|'.join(UNIT_SIGNS)
UNIT = re.compile(rf'(.*\S) *(?:[\[(] *({_ANY}) *[\])]|/ *({_ANY}))', re.I)
"""A name with its unit: X [mm], X (mm), X / mm."""


def name_and_unit(cell: str) -> tuple[str, str]:
    """Return the name of a column, and its unit if the header says it."""
    match = UNIT.fullmatch(cell)
    return (match[1], UNIT_SIGNS[(match[2] or match[3]).lower()]) if match else (cell, '')


def places(header: Sequence[str], name: str) -> list[int]:
    """Return the indices of the columns of a name, with or without its unit."""
    return [k for k, cell in enumerate(header) if name in (cell, name_and_unit(cell)[0])]


def only(found: Sequence[int], name: str) -> int:
    """Return the index of a column; refuse several."""
    if len(found) > 1:
        where = ', '.join(some([f'#{k + 1}' for k in found]))
        raise InputError(
            f'column "{name}" comes {len(found)} times: name it by its number ({where})'
        )
    return found[0]


@dataclass(frozen=True, eq=False)
class Sheet:
    """The rows of a table in columns `#1`, `#2` ..., their names, and the cells `above`."""

    header: tuple[str, ...]
    above: tuple[tuple[str, ...], ...]
    columns: Columns
    notes: tuple[str, ...]

    def number(self, name: str) -> str | None:
        """Return `#k` of a column by its name, None if unknown."""
        if name.startswith('#'):
            return name if 0 < int(name[1:]) <= len(self.header) else None
        found = places(self.header, name)
        return f'#{only(found, name) + 1}' if found else None


@dataclass(frozen=True)
class _Content:
    rows: list[Cells]  # of a text only the first
    notes: list[str]
    text: str = ''
    separator: str = ''
    title: str = ''  # of a sheet


def read_sheet(path: Path, layout: Layout, names: Sequence[str], known: Sequence[str]) -> Sheet:
    """Read a table with a known layout; of a workbook the sheet named, or the first that fits.

    The header is the first line with all column `names`; if these are only numbers, the first with
    some of the `known` names.
    """
    if path.suffix.lower() not in SHEETS:
        return _sheet(path, _of_text(path, layout), layout, names, known)
    faults: list[str] = []
    found: list[Sheet] = []
    for content in _of_workbook(path, layout.sheet):
        try:
            sheet = _sheet(path, content, layout, names, known)
        except InputError as err:
            faults.append(f'sheet "{content.title}": {err}')
            continue
        lower = [cell.lower() for cell in sheet.header]
        if names or sum(bool(places(lower, name.lower())) for name in known) > 1:
            return sheet
        found.append(sheet)
    if not found:
        raise InputError('; '.join(some(faults)) or f'{path} has no rows in visible sheets')
    return found[0]


def _of_text(path: Path, layout: Layout) -> _Content:
    notes: list[str] = []
    text, coding = _text(path)
    if coding:
        notes.append(f'the text is read as {coding}')
    if '\r' in text:
        text = text.replace('\r\n', '\n').replace('\r', '\n')
    if layout.comment:
        text = re.sub(rf'(?m)^[ \t]*{re.escape(layout.comment)}.*$', '', text)
    text = re.sub(r'(?m)^[#%]+[ \t]+(?=[A-Za-z])', '', text)  # a header, as numpy writes it
    separator = layout.cut or _separator(path, text, notes)
    text = _narrow(text, separator)
    rows = _cells(path, text[: _after(text, HEAD_LINES)], separator)
    return _Content(rows, notes, text, separator)


def _sheet(
    path: Path, content: _Content, layout: Layout, names: Sequence[str], known: Sequence[str]
) -> Sheet:
    rows, notes = content.rows, content.notes
    at, header = _header(path, rows, names, known)
    used = [k for name in names if not name.startswith('#') for k in places(header, name)]
    used += [int(n[1:]) - 1 for n in names if n.startswith('#')]
    low = {name.lower() for name in known}
    used += [k for k, cell in enumerate(header) if name_and_unit(cell)[0].lower() in low]
    cells = (row[k] for _, row in rows[at + 1 :] for k in used if k < len(row))
    decimal = layout.decimal or decimal_sign(cells, content.separator)
    if decimal == ',' and not layout.decimal:
        notes.append('numbers have decimal commas (--decimal)')
    first = _first(path, rows, at, used, decimal, notes)
    if at < 0 and first:  # columns by their numbers
        header = tuple(f'#{k + 1}' for k in range(len(rows[first][1])))
    header = _with_units(header, [cells for _, cells in rows[at + 1 : first]])
    above = tuple(tuple(cells) for _, cells in rows[: max(at, 0)])
    start = rows[first][0]
    body: Iterable[Sequence[Cells]] = [rows[first:]]
    if content.text:
        body = _below(path, content.text, start, content.separator)
    columns = of_rows(path, body, [f'#{k + 1}' for k in range(len(header))])
    columns = replace(columns, decimal=decimal)
    header = (*header, *[''] * (len(columns.header) - len(header)))
    return Sheet(header, above, columns, tuple(notes))


def text_and_separator(path: Path) -> tuple[str, str]:
    """Return the text of a table, and the sign between its cells."""
    text, _ = _text(path)
    separator = _separator(path, text, [])
    narrow = _narrow(text, separator)
    if separator in narrow.lstrip().partition('\n')[0]:
        return narrow, separator
    return text, ','  # the header lacks it: it is in the words below


def _narrow(text: str, separator: str) -> str:
    """Return a text with single blanks between cells that blanks separate."""
    if separator != ' ':
        return text
    return re.sub(r'[ \t]+', ' ', re.sub(r'(?m)^[ \t]+|[ \t]+$', '', text))


def decimal_sign(cells: Iterable[str], separator: str) -> str:
    """Return the decimal sign in cells of numbers."""
    commas = any(DECIMAL_COMMA.fullmatch(c) and not THOUSANDS.fullmatch(c) for c in cells)
    return ',' if commas and separator != ',' else '.'


def _with_units(header: tuple[str, ...], below: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Return the names of columns with their units in the lines below."""
    for cells in below:
        units = [UNIT_SIGNS.get(c.strip('[]() ').lower()) or name_and_unit(c)[1] for c in cells]
        pairs = zip_longest(header, units[: len(header)])
        header = tuple(
            f'{name} [{unit}]' if unit and name and not name_and_unit(name)[1] else name
            for name, unit in pairs
        )
    return header


def _below(path: Path, text: str, start: int, separator: str) -> Iterator[list[Cells]]:
    """Yield the rows of a text from a line on."""
    body = text[_after(text, start - 1) :]
    for block in csv_blocks(path, body.encode(), separator, above=start - 1):
        rows = [(line, [*map(str.strip, cells)]) for line, cells in block]
        yield [(line, cells) for line, cells in rows if any(cells)]


def _after(text: str, lines: int) -> int:
    at = 0
    for _ in range(lines):
        at = text.find('\n', at) + 1
        if not at:
            return len(text)
    return at


def _text(path: Path) -> tuple[str, str]:
    data = read_bytes(path, LARGEST_TABLE, InputError)
    if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        try:
            return data.decode('utf-16'), ''
        except UnicodeDecodeError as err:
            raise InputError(f'cannot read {path}: {err}') from err
    if b'\0' in data:
        raise InputError(
            f'cannot read {path}: it is not text, and not a workbook by its name (.xlsx)'
        )
    with suppress(UnicodeDecodeError):
        return data.decode('utf-8-sig'), ''
    return data.decode('cp1252', errors='replace'), 'Windows-1252, because it is not UTF-8'


def _of_workbook(path: Path, name: str) -> Iterator[_Content]:
    """Yield the sheets with rows: the one named, or the visible ones."""
    try:
        import openpyxl
    except ImportError as err:
        raise InputError(
            f'{path} needs openpyxl: pip install "calib_ros[xlsx]", or save it as CSV'
        ) from err
    try:
        with zipfile.ZipFile(path) as packed:
            size = sum(each.file_size for each in packed.infolist())
        if size > LARGEST_SHEET:
            raise InputError(f'{path} is larger than {LARGEST_SHEET // 10**6} MB when unpacked')
        with closing(openpyxl.load_workbook(path, read_only=True, data_only=True)) as book:
            titles = {each.title: each for each in book.worksheets}  # without charts
            if name and name not in titles:
                raise InputError(f'{path} has no sheet "{name}"; it has {", ".join(titles)}')
            visible = [each for each in book.worksheets if each.sheet_state == 'visible']
            for sheet in [titles[name]] if name else visible:
                notes = []
                if len(visible) > 1 and not name:
                    notes = [f'sheet "{sheet.title}" of {len(visible)} is read (--sheet)']
                if rows := _rows(path, sheet):
                    yield _Content(rows, notes, title=sheet.title)
    except InputError:
        raise
    except zipfile.BadZipFile as err:
        raise InputError(f'{path} is no workbook, or damaged: save it as .xlsx or CSV') from err
    except Exception as err:  # a broken workbook fails in many ways
        raise InputError(f'cannot read {path}: {" ".join(str(err).split())}') from err


def _rows(path: Path, sheet: Any) -> list[Cells]:
    """Return the rows of a sheet that are not empty, with their numbers."""
    sheet.reset_dimensions()  # stated ones may be too small
    rows: list[Cells] = []
    for number, row in enumerate(sheet.iter_rows(values_only=True), start=1):
        if len(row) > MOST_ENTRIES:
            raise InputError(f'{path} has {len(row)} columns, more than {MOST_ENTRIES}')
        cells = [_cell(value) for value in row]
        if any(cells):
            rows.append((number, cells))
    return rows


def _cell(value: object) -> str:
    if value is None:
        return ''
    if isinstance(value, bool):
        return str(int(value))
    text = repr(value) if isinstance(value, float) else str(value)
    return ' '.join(text.split())


def _separator(path: Path, text: str, notes: list[str]) -> str:
    head = re.sub('"[^"\n]*"', '0', text[: _after(text, HEAD_LINES)])  # cells in quotes
    lines = [line for line in head.split('\n') if line.strip()][-30:]  # mostly below the header
    if not lines:
        raise InputError(f'{path} has no rows')
    best, most, cells = 'comma', 0, 1
    for name in ('tab', 'semicolon', 'comma', 'space'):
        mark = SEPARATORS[name]
        rows = [line.split() if mark == ' ' else line.split(mark) for line in lines]
        counts = [len(row) for row in rows]
        usual = max(set(counts), key=counts.count)
        agreed = counts.count(usual) if usual > 1 else 0
        finer = agreed == len(lines) and usual > cells  # as if tabs are mixed with blanks
        below = [cell for row in rows[len(rows) // 2 :] for cell in row]  # the header
        if agreed > 1.2 * most or (finer and all(_is_number(cell, '.') for cell in below)):
            best, most, cells = name, agreed, usual
    if best != 'comma':
        notes.append(f'cells are separated by {best}s (--separator)')
    return SEPARATORS[best]


def _cells(path: Path, text: str, separator: str) -> list[Cells]:
    """Return the cells of all non-empty lines, with line numbers."""
    found: list[Cells] = [
        (line, [' '.join(cell.split()) for cell in row])
        for block in csv_blocks(path, text.encode(), separator)
        for line, row in block
        if any(cell.strip() for cell in row)
    ]
    if not found:
        raise InputError(f'{path} has no rows')
    return found


def _header(
    path: Path, rows: Sequence[Cells], names: Sequence[str], known: Sequence[str]
) -> tuple[int, tuple[str, ...]]:
    """Return the row index of the header, and its names; -1 if there is none."""
    wanted = {name for name in names if not name.startswith('#')}
    low = {name.lower() for name in known}
    words = [sum(not _is_number(c, ',') for c in cells if c) for _, cells in rows[:HEAD_LINES]]
    likely = words.index(max(words))  # title and data have fewer
    best: tuple[int, set[str]] = (likely, wanted)
    numbers = [int(name[1:]) - 1 for name in names if name.startswith('#')]
    for k, (_, cells) in enumerate(rows[:HEAD_LINES]):
        bare = {name_and_unit(cell)[0] for cell in cells}
        missing = wanted - bare - set(cells)
        if wanted and not missing:
            return k, tuple(cells)
        if not wanted and len(low & {name.lower() for name in bare}) > 1:
            found = [cells[i] for i in numbers if i < len(cells)]
            of_data = any(_is_number(cell, ',') for cell in found)
            return (-1, ()) if of_data else (k, tuple(cells))
        if len(missing) < len(best[1]):
            best = (k, missing)
    if not wanted:
        return (-1, ()) if names else (likely, tuple(rows[likely][1]))
    has = ', '.join(f'"{cell}"' for cell in rows[best[0]][1] if cell)
    raise InputError(
        f'{path} has no column {", ".join(sorted(best[1]))}; line {rows[best[0]][0]} has {has}: '
        'name its columns (--columns OURS=NAME or OURS=#NUMBER)'
    )


def _first(
    path: Path, rows: Sequence[Cells], at: int, used: Sequence[int], decimal: str, notes: list[str]
) -> int:
    limit = HEAD_LINES if at < 0 else at + 4  # three lines of units at most
    for k in range(at + 1, min(len(rows), limit + 1)):
        cells = [rows[k][1][i] for i in used if i < len(rows[k][1])]
        if not used or any(_is_number(cell, decimal) for cell in cells):
            if k > at + 1:
                left = lines_in_words([line for line, _ in rows[at + 1 : k]])
                notes.append(f'there are no numbers in {left}: only units are read')
            return k
    none = [f'{path} has no rows of numbers in the columns named']
    for line, cells in rows[at + 1 : at + 2]:
        none += [
            f'line {line} has "{cells[i]}": numbers without units are expected there; other '
            'columns are named by --columns OURS=NAME or OURS=#NUMBER'
            for i in used[:1]
            if i < len(cells)
        ]
    raise InputError('; '.join([*none, *notes]))


def _is_number(cell: str, decimal: str) -> bool:
    return math.isfinite(cell_number(cell.replace(',', '.') if decimal == ',' else cell))
