# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What of a table is read: the columns that are ours, the rows of the wanted sessions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros.errors import InputError, UnknownNameError
from calib_ros.files.columns import Columns
from calib_ros.files.measurements import Measurements, measurements
from calib_ros.files.vocabulary import POSITION


def without_others(found: Columns) -> tuple[Columns, tuple[str, ...]]:
    """Return columns without those that only seem to be ours, and notes.

    Trackers write the distance of each point beside its coordinates, and SpatialAnalyzer calls the
    name of a point its target.
    """
    count, told = len(found.lines), dict[str, str]()
    for name in ('target', 'device'):
        if len(found.labels(name)[1]) == count > len(POSITION):
            told[name] = 'has another name in each row: it is left out, as a name of poses'
    for name in ('distance', 'plane') if 'x' in found.cells else ():
        filled = ~found.blank(name)
        if filled.any() and not (filled & found.blank('x')).any():
            told[name] = 'is left out: x, y, z are in all of its rows'
    if not told:
        return found, ()
    cells = {name: given for name, given in found.cells.items() if name not in told}
    notes = (f'{found.path}: the column {name} {why}' for name, why in told.items())
    return replace(found, cells=cells), tuple(notes)


def select_rows(found: Columns, joints: int, sessions: Sequence[str]) -> Measurements:
    """Return the measurements of the wanted sessions, of all if none is named."""
    if not len(found.lines):
        measurements(found, joints)  # names missing columns first
        raise InputError(f'{found.path} has no rows')
    if 'session' not in found.cells and sessions:
        names = ', '.join(sessions)
        raise InputError(f'{found.path} has no column "session" to choose "{names}" from')
    numbers, known = found.labels('session')
    if not sessions and len(known) > 1:
        named = ', '.join(filter(None, known))
        blank = '; rows without one are left out: name it in each (merged cells: in the first)'
        raise InputError(
            f'{found.path} holds several sessions, choose one of {named} (or several, joined by '
            f'commas, to fit them together){blank * ("" in known)}'
        )
    for k, name in enumerate(sessions):
        if name in sessions[:k]:
            raise InputError(f'session "{name}" is named twice')
        if name not in known:
            raise UnknownNameError(f'{found.path}: session', name, known)
    wanted = [known.index(name) for name in sessions or known]
    rows = np.concatenate([np.flatnonzero(numbers == place) for place in wanted])
    every = np.array_equal(rows, np.arange(len(found.lines)))
    return measurements(found if every else found.select(rows), joints)
