# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of measured configurations: CSV with q1 ... qn, x y z and, if measured, qx qy qz qw.

Optional columns: `session` (one is chosen), `split` (rows marked `test` are never fitted).
Columns that are not known are left alone.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from calib_ros import se3
from calib_ros.config import QUATERNION_TOLERANCE
from calib_ros.errors import InputError, UnknownNameError
from calib_ros.observations import Observations

POSITION, QUATERNION = ('x', 'y', 'z'), ('qx', 'qy', 'qz', 'qw')


def read_table(
    path: Path, joints: int, session: str | None = None
) -> tuple[Observations, Observations]:
    """Read a CSV; return the observations to fit and those held out.

    Raises
    ------
    InputError
        For a missing column, a value that is no number, or several sessions to choose from. The
        message names the line.

    """
    try:
        with path.open(newline='', encoding='utf-8-sig') as file:
            reader = csv.DictReader(file)
            rows = [(reader.line_num, row) for row in reader]
            header = reader.fieldnames or []
    except (OSError, UnicodeDecodeError, csv.Error) as err:
        raise InputError(f'cannot read {path}: {err}') from err
    values = (*(f'q{k + 1}' for k in range(joints)), *POSITION)
    missing = [name for name in values if name not in header]
    oriented = [name for name in QUATERNION if name in header]
    if oriented:
        missing += [name for name in QUATERNION if name not in header]
    if missing:
        raise InputError(
            f'{path} has no column {", ".join(missing)}; expected {", ".join(values)} and, with '
            f'orientation, {", ".join(QUATERNION)}; found {", ".join(header)}'
        )
    if 'session' in header:
        rows = _one_session(path, rows, session)
    elif session is not None:
        raise InputError(f'{path} has no column "session" to choose "{session}" from')
    if not rows:
        raise InputError(f'{path} has no rows')
    columns = (*values, *oriented)
    numbers = np.array([_numbers(path, line, row, columns) for line, row in rows])
    rotations = None
    if oriented:
        quat = numbers[:, -4:]
        length = np.linalg.norm(quat, axis=1)
        wrong = np.flatnonzero(np.abs(length - 1.0) > QUATERNION_TOLERANCE)
        if wrong.size:
            raise InputError(
                f'{path}, line {rows[wrong[0]][0]}: quaternion qx qy qz qw has length '
                f'{length[wrong[0]]:.6g}, expected 1'
            )
        rotations = se3.from_quat(quat)
    observations = Observations.from_arrays(
        numbers[:, :joints], numbers[:, joints : joints + 3], rotations
    )
    test = np.array([row.get('split') == 'test' for _, row in rows])
    return observations.select(~test), observations.select(test)


def _one_session(
    path: Path, rows: list[tuple[int, dict[str, str]]], session: str | None
) -> list[tuple[int, dict[str, str]]]:
    """Return the rows of one session: base and tool frames differ between sessions."""
    names = list(dict.fromkeys(row['session'] for _, row in rows))
    if session is None:
        if len(names) > 1:
            raise InputError(f'{path} holds several sessions, choose one of {", ".join(names)}')
        return rows
    if session not in names:
        raise UnknownNameError(f'session in {path}', session, names)
    return [(line, row) for line, row in rows if row['session'] == session]


def _numbers(path: Path, line: int, row: dict[str, str], columns: tuple[str, ...]) -> list[float]:
    numbers = []
    for name in columns:
        try:
            number = float(row[name])
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number):
            raise InputError(f'{path}, line {line}: {name} must be a number, not {row[name]!r}')
        numbers.append(number)
    return numbers
