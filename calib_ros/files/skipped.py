# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rows of a table that hold no measurement: blank ones, statistics, and lost targets."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from itertools import count, product, takewhile
from typing import TypeAlias

import numpy as np

from calib_ros.errors import LONGEST, InputError
from calib_ros.files.columns import BETWEEN, Columns, lines_in_words
from calib_ros.files.vocabulary import MEASURED_COLUMNS, POSITION
from calib_ros.kinematics.se3 import Flags, FloatArray
from calib_ros.values import ROUNDED

STATISTIC = re.compile(
    r'((mean|average)( value)?|avg|median|mittelwert|moyenne|max|maximum|min|minimum|range'
    r'|spannweite|sum|total|summe|count|anzahl|rms|st(andar)?d?[. ]*(dev(iation)?|err(or)?)|std|sd'
    r'|([1-6] ?)?sigma|var(iance)?|varianz|[ée]cart[- ]type|standardabweichung)[ :.]*',
    re.I,
)
"""Names of rows below a table."""
Statistic: TypeAlias = Callable[[FloatArray], FloatArray]  # (C,) of columns (N, C)
MOMENTS: tuple[Statistic, ...] = (
    lambda columns: columns.mean(axis=0),
    lambda columns: columns.sum(axis=0),
    lambda columns: columns.std(axis=0),
    lambda columns: columns.std(axis=0, ddof=1),
)
"""Statistics that are the values of a pose by chance only."""
STATISTICS: tuple[Statistic, ...] = (
    *MOMENTS,
    lambda columns: columns.min(axis=0),
    lambda columns: columns.max(axis=0),
    lambda columns: np.ptp(columns, axis=0),
    lambda columns: np.median(columns, axis=0),
    lambda columns: np.full(columns.shape[1], len(columns)),
)
"""Statistics that a table may have, a row each."""
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
    kept = made.select(~empty) if notes else made
    if (computed := _computed(kept)).any():
        left = lines_in_words(kept.lines[computed].tolist())
        notes.append(f'{made.path}: mean, sum or the like of all others in {left}: skipped')
        kept = kept.select(~computed)
    return kept, tuple(notes)


def _computed(made: Columns) -> Flags:
    """Return (N,) which few rows, first or last, are a mean, sum or the like of all others."""
    measured = [name for name in (*POSITION, 'distance') if name in made.cells]
    names = [*measured, *filter(re.compile('q[0-9]+').fullmatch, made.cells)]
    every, none = np.arange(len(made.lines)), np.zeros(len(made.lines), dtype=bool)
    first = made.numbers(measured[:1])  # of most tables enough
    # the most first: a deviation below a mean is also one of all rows with the mean
    for few, last in product(range(len(STATISTICS), 0, -1), (True, False)):
        rows = every >= len(every) - few if last else every < few
        if 2 * few < len(every) and _summarise(first, rows):
            found = made.numbers(names)
            varying = np.ptp(found[~rows], axis=0) > 0.0
            if np.count_nonzero(varying) > len(POSITION) and _summarise(found[:, varying], rows):
                return rows
    return none


def _summarise(columns: FloatArray, rows: Flags) -> bool:
    """Tell whether rows (N,) of columns (N, C) are statistics of the others, one a moment."""
    given, others = columns[rows], columns[~rows]
    rounded = 0.1 * ROUNDED * others.std(axis=0)  # as means are written

    def those_of(kinds: Sequence[Statistic]) -> Flags:
        values = np.array([kind(others) for kind in kinds])
        near = np.abs(given[:, None] - values) <= rounded
        return np.asarray(near.all(axis=2).any(axis=1))

    return bool(those_of(MOMENTS).any() and those_of(STATISTICS).all())


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
