# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rows of a table that hold no measurement: blank ones, remarks, nominal values, lost targets."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from calib_ros.errors import InputError
from calib_ros.files.columns import Cells, Columns, cell_number, lines_in_words
from calib_ros.files.names import MEASURED_WORDS, NOMINAL_TITLES, TITLE_WORDS, words_of
from calib_ros.files.summary_rows import rows_of_statistics
from calib_ros.files.vocabulary import MEASURED_COLUMNS, NOT_VALID, POSITION, VALID
from calib_ros.kinematics.se3 import Flags

COMMENTS = ('#', '%', '//')


def without_words(
    blocks: Iterable[list[Cells]], head: Sequence[list[str]], left: list[Cells]
) -> Iterator[list[Cells]]:
    """Yield the rows but comments, remarks and the `head` again, which go into a list."""
    for block in blocks:
        words = [
            (line, cells)
            for line, cells in block
            if (
                len(cells) - cells.count('') <= 2 or cells[0].startswith(COMMENTS) or cells in head
            )
            and not any(math.isfinite(cell_number(cell, ',')) for cell in cells)
        ]
        left += words
        yield [row for row in block if row not in words] if words else block


def refuse_nominal(columns: Columns, remarks: Iterable[Cells]) -> None:
    """Refuse rows below a title that calls them nominal, if other rows are below another one.

    A title is a remark of such words and those of places; remarks above the header come first.
    """
    titles = [(0, False, '')]
    for line, cells in remarks:
        words = words_of(text := ' '.join(filter(None, cells)))
        told = NOMINAL_TITLES | MEASURED_WORDS
        if {*words} & told and {*words} <= told | TITLE_WORDS:
            titles.append((line, bool({*words} & NOMINAL_TITLES), text))
    ends = np.searchsorted(columns.lines, [line for line, *_ in titles])
    counts = np.diff(ends, append=len(columns.lines))
    held = [title for title, count in zip(titles, counts.tolist(), strict=True) if count]
    for line, nominal, text in held:
        if nominal and not all(each for _, each, _ in held):
            raise InputError(
                f'{columns.path}, line {line}: the rows below "{text}" may be nominal, the others '
                'not: leave out the rows that were not measured, or that line'
            )


def drop_unmeasured(made: Columns) -> tuple[Columns, tuple[str, ...]]:
    """Return the rows in which something was measured, and notes about the others."""
    notes: list[str] = []
    measuring = [name for name in MEASURED_COLUMNS if name in made.cells]
    for rows_of, what in (
        (lambda left: np.logical_and.reduce([*map(left.blank, measuring)]), 'nothing measured'),
        (_not_valid, 'the column valid says no'),
        (_lost, 'no target (x = y = z)'),
        (rows_of_statistics, 'mean, sum or the like of all others'),
    ):
        if measuring and (rows := rows_of(made)).any():
            left = f'{made.path}: {what} in {lines_in_words(made.lines[rows].tolist())}'
            if rows.all():
                other = 'rename it if it means something else'
                need = other if rows_of is _not_valid else 'rows need x, y, z or distance'
                raise InputError(f'{left}: {need}')
            notes.append(f'{left}: skipped')
            made = made.select(~rows)
    words = [each not in VALID and np.isinf(cell_number(each)) for each in _valid(made)]
    if any(words):
        told = f'{made.path}: the column valid says {_valid(made)[words.index(True)]!r} in '
        lines = lines_in_words(made.lines[words].tolist())
        notes.append(f'{told}{lines}, or another word: read all the same; 0 leaves out a row')
    if 'valid' in made.cells:  # otherwise the numbers are known
        cells = {name: given for name, given in made.cells.items() if name != 'valid'}
        made = replace(made, cells=cells)
    return made, tuple(notes)


def _valid(made: Columns) -> list[str]:
    return [each.lower() for each in made.texts('valid')] if 'valid' in made.cells else []


def _not_valid(made: Columns) -> Flags:
    left = [each in NOT_VALID or cell_number(each, ',') == 0.0 for each in _valid(made)]
    return np.array(left or np.zeros(len(made.lines)), dtype=bool)


def _lost(made: Columns) -> Flags:
    """Return (N,) which rows have 0, -9999 or the like for all of x, y, z."""
    if not {*POSITION} <= {*made.cells}:
        return np.zeros(len(made.lines), dtype=bool)
    x, y, z = made.numbers(POSITION).T
    same = np.asarray((x == y) & (y == z))
    for row in np.flatnonzero(same).tolist():
        digits = f'{abs(x[row]):.9g}'.replace('.', '')
        same[row] = re.fullmatch('0|9{4,}', digits) is not None
    return same
