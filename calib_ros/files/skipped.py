# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rows of a table that hold no measurement: blank ones, statistics, and lost targets."""

from __future__ import annotations

import re
from itertools import count, takewhile

import numpy as np

from calib_ros.errors import LONGEST, InputError
from calib_ros.files.columns import BETWEEN, Columns, lines_in_words
from calib_ros.files.vocabulary import MEASURED_COLUMNS, POSITION
from calib_ros.kinematics.se3 import Flags

STATISTIC = re.compile(
    r'(mean|average|avg|median|mittelwert|moyenne|max|maximum|min|minimum|range|spannweite|sum|total'
    r'|summe|rms|st(andar)?d[. ]*dev(iation)?|std|sd|sigma|[ée]cart[- ]type|standardabweichung)'
    r'[ :.]*',
    re.I,
)
"""Names of rows below a table."""
NO_TARGET = re.compile(r'\0\s*-?(?:0|9{4,})[.,]?0*\s*(?:\0|$)')
"""A coordinate as devices write it without a target: 0 or -9999, all three alike."""


def measured(made: Columns) -> tuple[Columns, tuple[str, ...]]:
    """Return the rows in which something was measured, and notes about the others."""
    blank = [made.blank(name) for name in MEASURED_COLUMNS if name in made.cells]
    if not blank:
        return made, ()
    notes, empty = [], np.logical_and.reduce(blank)
    for rows, what in ((empty, 'nothing measured'), (_lost(made), 'no target (x = y = z)')):
        if not rows.any():
            continue
        left = lines_in_words(made.lines[rows].tolist())
        if rows.all():
            raise InputError(f'{made.path}: {what} in {left}: rows need x, y, z or distance')
        notes.append(f'{made.path}: {what} in {left}: skipped')
        empty = empty | rows
    return (made.select(~empty) if notes else made), tuple(notes)


def _lost(made: Columns) -> Flags:
    """Return (N,) which rows have 0, -9999 or the like for all of x, y, z."""
    given = [made.cells.get(name) for name in POSITION]
    if any(
        x is None or (isinstance(x, str) and not NO_TARGET.search(f'{BETWEEN}{x}')) for x in given
    ):
        return np.zeros(len(made.lines), dtype=bool)
    x, y, z = made.numbers(POSITION).T
    same = np.asarray((x == y) & (y == z))
    for row in np.flatnonzero(same).tolist():
        digits = f'{abs(x[row]):.9g}'.replace('.', '')
        same[row] = re.fullmatch('0|9{4,}', digits) is not None
    return same


def without_statistics(columns: Columns) -> tuple[Columns, tuple[str, ...]]:
    """Return the rows that are not called mean, max and the like at the end, and a note."""
    named = set[int]()  # rows from the end
    for given in columns.cells.values():
        last = str(given)[-10 * LONGEST :].lower().split(BETWEEN)  # as read: text of many rows
        for row, cell in enumerate(reversed(last), start=1):
            if STATISTIC.fullmatch(cell.strip()) and last.count(cell) == 1:
                named.add(row)
    kept = np.ones(len(columns.lines), dtype=bool)
    for row in takewhile(named.__contains__, count(1)):
        kept[-row] = False
    if kept.all():
        return columns, ()
    left = lines_in_words(columns.lines[~kept].tolist())
    return columns.select(kept), (f'{columns.path}: statistics in {left}: skipped',)
