# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Workbooks (.xlsx): the rows of their sheets as text."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

from calib_ros.errors import LONGEST, MOST_ENTRIES, InputError
from calib_ros.files.columns import Cells
from calib_ros.texts import LARGEST_TABLE

LARGEST_SHEET = 3 * LARGEST_TABLE  # bytes of an unpacked workbook
WITH_FORMULA = re.compile(rb'<(\w+:)?f[ />]')
WITH_HIDDEN = re.compile(rb'<(\w+:)?row [^>]*\bhidden="(1|true)"')
READ_HIDDEN = 'hidden and filtered rows are read too: delete those that do not count'


def sheets_of(path: Path, name: str) -> Iterator[tuple[str, list[str], list[Cells]]]:
    """Yield the title of sheets that have rows, notes and the rows.

    They are the one named, or the visible ones.
    """
    try:
        import openpyxl
    except ImportError as err:
        raise InputError(
            f'{path} needs openpyxl: pip install "calib_ros[xlsx]", or save it as CSV'
        ) from err
    try:
        with zipfile.ZipFile(path) as packed:
            if sum(each.file_size for each in packed.infolist()) > LARGEST_SHEET:
                raise InputError(
                    f'{path} is larger than {LARGEST_SHEET // 10**6} MB when unpacked'
                )
            formulas, hidden = _has(packed, WITH_FORMULA), _has(packed, WITH_HIDDEN)
            never = formulas and any(
                b'fullCalcOnLoad="1"' in packed.read(part)
                for part in packed.namelist()
                if re.match(r'xl/workbook\d*\.xml', part)
            )
        again = openpyxl.load_workbook(path, read_only=True) if formulas else None
        with (
            closing(openpyxl.load_workbook(path, read_only=True, data_only=True)) as book,
            nullcontext() if again is None else closing(again),
        ):
            titles = {each.title: each for each in book.worksheets}  # without charts
            if name and name not in titles:
                raise InputError(f'{path} has no sheet "{name}"; it has {", ".join(titles)}')
            visible = [each for each in book.worksheets if each.sheet_state == 'visible']
            for sheet in [titles[name]] if name else visible:
                sheet.reset_dimensions()  # stated ones may be too small
                values = sheet.iter_rows(values_only=True)
                if again is not None:
                    values = _computed(sheet, again[sheet.title], never)
                if rows := _rows(path, values):
                    told = f'sheet "{sheet.title}" of {len(visible)} is read (--sheet)'
                    notes = [told] * (len(visible) > 1 and not name) + [READ_HIDDEN] * hidden
                    yield sheet.title, notes, rows
    except InputError:
        raise
    except zipfile.BadZipFile as err:
        raise InputError(f'{path} is no workbook, or damaged: save it as .xlsx or CSV') from err
    except Exception as err:  # a broken workbook fails in many ways
        raise InputError(f'cannot read {path}: {" ".join(str(err).split())}') from err


def _has(packed: zipfile.ZipFile, element: re.Pattern[bytes]) -> bool:
    """Tell whether any sheet has an element."""
    for name in packed.namelist():
        if '/worksheets/' in name.lower():
            with packed.open(name) as file:
                end = b''
                while block := file.read(1 << 20):
                    if element.search(end + block):
                        return True
                    end = block[-LONGEST:]
    return False


def _computed(sheet: Any, source: Any, never: bool) -> Iterator[list[object]]:
    """Yield the values of rows, text for formulas of `source` without one."""
    source.reset_dimensions()
    for row, written in zip(sheet.iter_rows(), source.iter_rows(), strict=True):
        yield [
            f'{formula.value}, not computed: save the workbook in a spreadsheet program'
            if formula.data_type == 'f'
            and ((cell.value is None and cell.data_type == 'n') or (never and cell.value == 0))
            else cell.value
            for cell, formula in zip(row, written, strict=True)
        ]


def _rows(path: Path, values: Iterable[Sequence[object]]) -> list[Cells]:
    """Return the rows of a sheet that are not empty, with their numbers."""
    rows: list[Cells] = []
    for number, row in enumerate(values, start=1):
        if len(row) > MOST_ENTRIES:
            raise InputError(f'{path} has {len(row)} columns, more than {MOST_ENTRIES}')
        cells = [_cell(value) for value in row]
        if any(cells):
            rows.append((number, cells))
    return rows


def _cell(value: object) -> str:
    if value is None:
        return ''
    text = str(int(value) if isinstance(value, bool) else value)
    return ' '.join(text.split())
