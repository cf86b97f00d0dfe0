# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of measured configurations (CSV), described in docs/formats.md.

Joint values are in q1 ... qn; s1 ... sn, if present, hold the signs of the joints' last moves.
What was measured shows in the other columns: a pose (x y z and qx qy qz qw), a position (x y z), a
distance to a fixed point (distance), or that a ball sat in a socket (location, socket), whose
place is not known.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from calib_ros import se3
from calib_ros.config import QUATERNION_TOLERANCE
from calib_ros.errors import InputError, UnknownNameError
from calib_ros.observations import Observations
from calib_ros.se3 import FloatArray

POSITION, QUATERNION = ('x', 'y', 'z'), ('qx', 'qy', 'qz', 'qw')
Rows: TypeAlias = list[tuple[int, dict[str, str]]]


@dataclass(frozen=True, eq=False)
class Table:
    """Sets of observations to fit, each with frames of its own, and of those held out.

    `pairs` names the frames of the two sockets of each location.
    """

    fitted: tuple[Observations, ...]
    held_out: tuple[Observations, ...]
    pairs: tuple[tuple[str, str], ...] = ()


def read_table(
    path: Path,
    joints: int,
    sessions: Sequence[str] = (),
    eye_in_hand: tuple[float, float] | None = None,
) -> Table:
    """Read a CSV.

    Parameters
    ----------
    path : Path
        The file.
    joints : int
        Number of joints.
    sessions : sequence of str
        Sessions to read; each but the first gets a base and a tool frame of its own.
    eye_in_hand : (float, float), optional
        The poses are those of a fixed target in a camera on the flange, measured with these
        sigmas [m, rad].

    Raises
    ------
    InputError
        For a missing column, a value that is no number, or several sessions to choose from. The
        message names the line.

    """
    header, rows = _read(path)
    columns = _columns(path, joints, header)
    fitted: list[Observations] = []
    held_out: list[Observations] = []
    pairs = []
    for number, (session, part) in enumerate(_by_session(path, header, rows, sessions)):
        suffix = '' if number == 0 else f'_{_plain(session)}'
        for line, row in part:
            if (row.get('split') or '') not in ('', 'train', 'test'):
                raise InputError(
                    f'{path}, line {line}: split must be train or test, not {row["split"]!r}'
                )
        if 'socket' in columns:
            places = _by(part, ('location', 'socket'))
            names = {place: f'base{suffix}_{_plain("_".join(place))}' for place in places}
            locations = dict.fromkeys(location for location, _ in places)
            for location in locations:
                ends = [names[place] for place in places if place[0] == location]
                if len(ends) == 2:
                    pairs.append((ends[0], ends[1]))
            groups = [(names[place], f'tool{suffix}', each) for place, each in places.items()]
        else:
            targets = _by(part, ('target',)) if 'target' in header else {('',): part}
            ends = [f'_{_plain(name)}' if k else '' for k, (name,) in enumerate(targets)]
            groups = [
                (f'base{suffix}{end}', f'tool{suffix}', each)
                if eye_in_hand
                else (f'base{suffix}', f'tool{suffix}{end}', each)
                for end, each in zip(ends, targets.values(), strict=True)
            ]
        for base, tool, each in groups:
            observations = _observations(path, joints, each, columns)
            if f's{joints}' in header:
                signs = [f's{k + 1}' for k in range(joints)]
                approach = np.array([_numbers(path, line, row, signs) for line, row in each])
                observations = replace(observations, approach=np.sign(approach))
            if eye_in_hand:
                observations = observations.inverted(eye_in_hand)
            observations = replace(observations, base=base, tool=tool)
            test = np.array([row.get('split') == 'test' for _, row in each])
            if not test.all():
                fitted.append(observations.select(~test))
            if test.any():
                held_out.append(observations.select(test))
        if not any(len(each) for each in fitted):
            raise InputError(f'{path} has no rows to fit, only such that are marked test')
    return Table(tuple(fitted), tuple(held_out), tuple(pairs))


def read_joints(path: Path, joints: int) -> FloatArray:
    """Read joint values (N, joints) [rad or m] from the columns q1 ... qn of a CSV.

    Raises
    ------
    InputError
        For a missing column, no row, or a value that is no number.

    """
    return _table(path, [f'q{k + 1}' for k in range(joints)])[0]


def read_poses(path: Path) -> FloatArray:
    """Read poses (N, 4, 4) from the columns x y z [m] and qx qy qz qw of a CSV.

    Raises
    ------
    InputError
        For a missing column, no row, a value that is no number, or a quaternion that is none.

    """
    numbers, lines = _table(path, (*POSITION, *QUATERNION))
    return se3.transform(_rotations(path, lines, numbers[:, 3:]), numbers[:, :3])


def _table(path: Path, columns: Sequence[str]) -> tuple[FloatArray, list[int]]:
    """Return the values (N, C) of some columns, and the line of each row."""
    header, rows = _read(path)
    missing = [name for name in columns if name not in header]
    if missing:
        raise InputError(
            f'{path} has no column {", ".join(missing)}; expected {", ".join(columns)}; found '
            f'{", ".join(header) or "nothing"}'
        )
    if not rows:
        raise InputError(f'{path} has no rows')
    numbers = np.array([_numbers(path, line, row, columns) for line, row in rows])
    return numbers, [line for line, _ in rows]


def _rotations(path: Path, lines: Sequence[int], quat: FloatArray) -> FloatArray:
    """Return the rotations (N, 3, 3) of quaternions (N, 4), and refuse what is none."""
    length = np.linalg.norm(quat, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1.0) > QUATERNION_TOLERANCE)
    if wrong.size:
        raise InputError(
            f'{path}, line {lines[wrong[0]]}: quaternion qx qy qz qw has length '
            f'{length[wrong[0]]:.6g}, expected 1'
        )
    return se3.from_quat(quat)


def joints_csv(joints: FloatArray) -> str:
    """Return the CSV text of joint values (N, n), as `read_joints` reads it."""
    return csv_of([f'q{k + 1}' for k in range(joints.shape[1])], joints)


def csv_of(columns: Sequence[str], values: FloatArray) -> str:
    """Return the CSV text of values (N, C); NaN is left empty."""
    rows = (
        ','.join('' if math.isnan(value) else f'{value:.9f}' for value in row)
        for row in values.tolist()
    )
    return '\n'.join([','.join(columns), *rows]) + '\n'


def _plain(name: str) -> str:
    """Return a name as part of a frame's, which holds no dots."""
    return name.replace('.', '-')


def _read(path: Path) -> tuple[Sequence[str], Rows]:
    try:
        with path.open(newline='', encoding='utf-8-sig') as file:
            reader = csv.DictReader(file)
            rows = [(reader.line_num, row) for row in reader]
            header = reader.fieldnames or []
    except (OSError, UnicodeDecodeError, csv.Error) as err:
        raise InputError(f'cannot read {path}: {err}') from err
    return header, rows


def _columns(path: Path, joints: int, header: Sequence[str]) -> list[str]:
    """Return the columns to read: joint values, and what was measured."""
    values = [f'q{k + 1}' for k in range(joints)]
    measured = list(POSITION)
    if not set(POSITION) & set(header):
        if 'distance' in header:
            measured = ['distance']
        elif 'socket' in header:
            measured = ['location', 'socket']
    elif 'distance' in header:
        raise InputError(
            f'{path} has both x y z and distance: put them into tables of their own, or remove one'
        )
    elif set(QUATERNION) & set(header):
        measured += QUATERNION
    missing = [name for name in (*values, *measured) if name not in header]
    if missing:
        expected = ', '.join([*values, *POSITION])
        raise InputError(
            f'{path} has no column {", ".join(missing)}; expected {expected} '
            f'and, with orientation, {", ".join(QUATERNION)} as well (or '
            f'distance, or location and socket); found {", ".join(header) or "nothing"}'
        )
    return values + measured


def _by_session(
    path: Path, header: Sequence[str], rows: Rows, sessions: Sequence[str]
) -> list[tuple[str, Rows]]:
    """Return the rows of each session that is asked for."""
    if not rows:
        raise InputError(f'{path} has no rows')
    if 'session' not in header:
        if sessions:
            raise InputError(
                f'{path} has no column "session" to choose "{", ".join(sessions)}" from'
            )
        return [('', rows)]
    for line, row in rows:
        if row['session'] is None:
            raise InputError(f'{path}, line {line}: session is missing')
    known = {name: part for (name,), part in _by(rows, ('session',)).items()}
    if not sessions:
        if len(known) > 1:
            raise InputError(
                f'{path} holds several sessions, choose one of {", ".join(known)} (or several, '
                'joined by commas, to fit them together)'
            )
        return list(known.items())
    for name in sessions:
        if list(sessions).count(name) > 1:
            raise InputError(f'session "{name}" is named twice')
        if name not in known:
            raise UnknownNameError(f'session in {path}', name, known)
    return [(name, known[name]) for name in sessions]


def _by(rows: Rows, keys: Sequence[str]) -> dict[tuple[str, ...], Rows]:
    """Return the rows grouped by some columns, in the order in which the groups appear."""
    groups: dict[tuple[str, ...], Rows] = {}
    for line, row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append((line, row))
    return groups


def _observations(path: Path, joints: int, rows: Rows, columns: Sequence[str]) -> Observations:
    kind = columns[joints]
    numeric = columns[:joints] if kind == 'location' else columns
    numbers = np.array([_numbers(path, line, row, numeric) for line, row in rows])
    q = numbers[:, :joints]
    if kind == 'location':
        return Observations.from_arrays(q, np.zeros((len(rows), 3)))
    if kind == 'distance':
        at_origin = Observations.from_arrays(q, np.zeros((len(rows), 3)))
        return replace(at_origin, distances=numbers[:, joints])
    rotations = None
    if 'qx' in columns:
        rotations = _rotations(path, [line for line, _ in rows], numbers[:, -4:])
    return Observations.from_arrays(q, numbers[:, joints : joints + 3], rotations)


def _numbers(path: Path, line: int, row: dict[str, str], columns: Sequence[str]) -> list[float]:
    numbers = []
    for name in columns:
        try:
            number = float(row[name])
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number):
            found = 'the row ends before it' if row[name] is None else f'not {row[name]!r}'
            raise InputError(f'{path}, line {line}: {name} must be a number, {found}')
        numbers.append(number)
    return numbers
