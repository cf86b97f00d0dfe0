# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rows of a table that are statistics of the others, by their names or by their values."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from itertools import groupby, product
from typing import Any

import numpy as np

from calib_ros.errors import LONGEST, MOST_ENTRIES
from calib_ros.files.columns import BETWEEN, Columns, lines_in_words
from calib_ros.files.vocabulary import POSITION
from calib_ros.kinematics.se3 import Flags, FloatArray
from calib_ros.values import ROUNDED

_MEAN = (
    r'((?!(?:than|the|above|below)\b)[^\W_]+[ _-]){0,3}'  # Group 1, but no remark
    r'(mean|average|avg|(gesamt)?mittel(wert)?|durchschnitt|ø|moy(enne)?'
    r'|m[eé]dia|valore? medio|promedio|平均[値值]?)( value| error| of [\w ]+)?'
)
_OTHERS = (
    r'median|max|maximum|m[aá](ss|x)imo|min|minimum|m[ií]nimo|range|spannweite|sum|(sub)?total'
    r'|summe|gesamt|varianza?|dev\. ?st|teilergebnis|count|anzahl|rmse?( error)?'
    r'|([1-6][ -]?)?(sigma|\u03c3)|streuung|stabw'
    r'|(d[eé]viation|desviaci[oó]n|deviazione) (standard|est[aá]ndar)'
    r'|(\w+[ _-])?(st(andar)?d?[. -]*(dev(iation)?|err(or)?|abw(eichung)?)|std|sd)'
    r'|var(iance)?|[ée]cart[- ]type|standardabweichung|標準偏差|标准差|tolerance|toleranz'
)
MEAN, STATISTIC = (
    re.compile(rf'(?:\A|{BETWEEN})\s*(?:{names})( ?[\[(]\S+[\])])?[ :.]*(?={BETWEEN}|\Z)', re.I)
    for names in (_MEAN, f'{_MEAN}|{_OTHERS}')
)
"""Names of rows that hold no pose, and of those that may hold one."""
LEVEL = re.compile(
    rf'{BETWEEN}(low|high|slow|fast|alt[ao]|baj[ao]|bass[ao]|baix[ao]|lent[ao]|r[áa]pid[ao])'
    rf'(?={BETWEEN}|\Z)'
)
"""What stands beside `media` if it is a speed or load of poses."""
MOMENTS = (np.mean, np.sum, np.std, partial(np.std, ddof=1))
"""Statistics that are the values of a pose by chance only."""
STATISTICS = (*MOMENTS, np.min, np.max, np.ptp, np.median, np.size)
"""Statistics that a table may have, a row each."""


def rows_of_statistics(made: Columns) -> Flags:
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

    def those_of(kinds: Sequence[Callable[..., Any]]) -> Flags:
        near = [(np.abs(given - of(others, axis=0)) <= rounded).all(axis=1) for of in kinds]
        return np.asarray(np.any(near, axis=0))

    return bool(those_of(MOMENTS).any() and those_of(STATISTICS).all())


def without_statistics(columns: Columns) -> tuple[Columns, tuple[str, ...]]:
    """Return the rows that are not called mean and the like, and a note.

    Others, such as max, hold poses, except beside a mean or at the end; so do means if they are
    more than the rows of other names.
    """
    kept = np.ones(len(columns.lines), dtype=bool)
    for text in map(str, columns.cells.values()):  # as read: text of many rows
        part = text[: 100 * MOST_ENTRIES] + BETWEEN + text[-10 * LONGEST :]
        told = re.search('[^\0-@]', part) and STATISTIC.search(part)  # soon known of numbers
        if not told or LEVEL.search(f'{BETWEEN}{text}'.lower()):
            continue
        cells = text.lower().split(BETWEEN)
        times, named = Counter(cells), [STATISTIC.match(cell) is not None for cell in cells]
        means = {k for k, cell in enumerate(cells) if MEAN.match(cell)}
        few = len(means) <= max(1, named.count(False))
        for called, run in groupby(range(len(cells)), named.__getitem__):
            rows = [*run]
            last = rows[-1] == len(cells) - 1 and all(times[cells[k]] == 1 for k in rows)
            if called and (last or means & {*rows}):
                kept[[k for k in rows if few or k not in means]] = False
    if kept.all():
        return columns, ()
    left = lines_in_words(columns.lines[~kept].tolist())
    return columns.select(kept), (f'statistics in {left}: skipped',)
