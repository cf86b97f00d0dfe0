# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Programs: tables of joint values or poses (CSV), and JointTrajectory messages (YAML).

Joint values are in q1 ... qn, or in columns with the joints' names, in rad or m or in the units
of the header, q1 [deg]; poses in x y z [m] and qx qy qz qw. Everything else in a program is
written back unchanged.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.apply.program import Program, joint_values
from calib_ros.errors import InputError
from calib_ros.files.columns import (
    Columns,
    cell_number,
    check_quaternions,
    columns_of,
    require_rows,
)
from calib_ros.files.headers import name_and_unit, places
from calib_ros.files.sheets import decimal_sign, refuse_short, text_and_separator
from calib_ros.files.vocabulary import ANGLES, LENGTHS, POSE_COLUMNS, POSITION, joint_columns
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.limits import check_limits, check_turns
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.texts import LARGEST_TEXT, csv_text, dump_yaml, parse_yaml, read_text
from calib_ros.values import parse_number, parse_numbers

TRAJECTORIES = ('.yaml', '.yml')
RATES = ('positions', 'velocities', 'accelerations')
"""Fields of a JointTrajectory point that a correction changes."""
TIME = 'time_from_start'


def read_joints(path: Path, chain: Chain) -> FloatArray:
    """Read joint values (N, n) [rad or m] from a CSV or trajectory; refuse any 1e-3 beyond limits.

    Columns of held joints may be missing.
    """
    if path.suffix.lower() in TRAJECTORIES:
        told = read_program(path, chain)
        values, _ = joint_values(chain, told.program)
        check_limits(values, chain, lambda k, _: f'{path}, {told.places[k]}: ')
        return values
    found, names, _, program = _program(_columns(path)[0], chain)
    values, _ = joint_values(chain, program)

    def remedy(i: int) -> str:
        return '' if name_and_unit(names[i])[1] else f'; in degrees the column is {names[i]} [deg]'

    check_limits(values, chain, lambda k, i: f'{found.where(k, names[i])} ', remedy)
    return values


def _columns(path: Path) -> tuple[Columns, str, str, str]:
    """Return the columns of a table, the sign between its cells, its text and encoding."""
    text, separator, coding = text_and_separator(path)
    found = require_rows(columns_of(path, text.encode(), separator=separator), ())
    if separator == ' ':
        refuse_short(found, found.header[-1])
    return found, separator, text, coding


def _program(found: Columns, chain: Chain) -> tuple[Columns, tuple[str, ...], FloatArray, Program]:
    """Return the table, the columns (n) of all joints with their units, and the program [rad, m].

    Columns of held joints may be missing.
    """
    joints = chain.joint_names
    *names, more = joint_columns(len(joints) + 1)
    header = [name_and_unit(name)[0] for name in found.header]

    def needed(names: Sequence[str]) -> list[str]:
        return [name for k, name in enumerate(names) if k not in chain.held]

    all_ways = (names, [*joints], [name.upper() for name in names])
    ways = {tuple(each): each for each in all_ways if {*needed(each)} <= {*header}}
    names = next(iter(ways.values()), names)
    if len(ways) > 1 and not {*map(str.lower, joints)} & {*POSITION}:  # of a gantry, measured
        both = ' and in '.join(f'{first} ...' for first, *_ in ways)
        raise InputError(f'{found.path} has joint values in {both}: leave out all but one')
    columns = [_column(found, name) for name in names]
    kinds = (ANGLES if joint.type == 'revolute' else LENGTHS for joint in chain.joints)
    units = _units(found, dict(zip(columns, kinds, strict=True)))
    how = '; values are in rad or m, or in the unit named there: q1 [deg]'
    how += '; Fanuc: q3 = J3 + J2' * ('J3' in header)
    require_rows(found, needed(columns), how)
    if {more, more.upper()} & {*header}:
        raise InputError(
            f'{found.path} has a column {more}, but the arm has {len(joints)} joints only'
        )
    given = [k for k, column in enumerate(columns) if column in found.header]
    named = [columns[k] for k in given]
    found = replace(found, decimal=decimal_sign(c for n in named for c in found.texts(n)))
    values = found.block(named) * units[given]
    return found, tuple(columns), units, Program(tuple(joints[k] for k in given), values)


def _units(found: Columns, columns: Mapping[str, Mapping[str, float]]) -> FloatArray:
    """Return the units (n) [rad or m] of columns, named in all of a kind or none.

    `columns` has the units that each may have.
    """
    told = {column: name_and_unit(column)[1] for column in columns}
    for column, known in columns.items():
        where = f'{found.path}: {column}'
        if told[column] not in ('', *known):
            raise InputError(f'{where} must be in {" or ".join(known)}')
        alike = [c for c in columns if columns[c] is known and c in found.header]
        named = [c for c in alike if told[c] in known]
        if named and column in {*alike} - {*named}:
            raise InputError(f'{where} has no unit, {named[-1]} has: name it in all')
    return np.array([known.get(told[column], 1.0) for column, known in columns.items()])


def read_poses(path: Path) -> FloatArray:
    """Read poses (N, 4, 4) from the columns x y z and qx qy qz qw of a CSV.

    Lengths are in m, or in the units of the header, x [mm].
    """
    table, *_ = _columns(path)
    columns = [_column(table, name) for name in POSE_COLUMNS]
    how = '; lengths are in m, or in the unit named there: x [mm]'
    found = require_rows(table, columns, how)
    found = replace(found, decimal=decimal_sign(c for n in columns for c in found.texts(n)))
    numbers = found.block(columns)
    numbers[:, :3] *= _units(found, dict.fromkeys(columns[:3], LENGTHS))
    check_quaternions(found, numbers[:, 3:])
    return se3.transform(se3.from_quat(numbers[:, 3:]), numbers[:, :3])


def _column(found: Columns, name: str) -> str:
    """Return the column of a name with its unit; the name if there is none."""
    several = [found.header[k] for k in places(found.header, name)]
    if len(several) > 1:
        raise InputError(f'{found.path} has several columns {", ".join(several)}: keep one')
    return (several or [name])[0]


def joints_csv(joints: FloatArray) -> str:
    """Return the CSV text of joint values (N, n), as `read_joints` reads it."""
    return csv_of(joint_columns(joints.shape[1]), joints)


def csv_of(columns: Sequence[str], values: FloatArray) -> str:
    """Return the CSV text of values (N, C); NaN is left empty."""
    cells = (['' if x != x else f'{x:.9f}' for x in row] for row in values.tolist())
    return csv_text([columns, *cells])


@dataclass(frozen=True, eq=False)
class ProgramFile:
    """A program, the places of its samples in the file, and how to write it in its encoding."""

    program: Program
    places: tuple[str, ...]
    text_with: Callable[[Program], str]
    coding: str = 'utf-8'


def program_of(path: Path, chain: Chain) -> ProgramFile:
    """Read a program for an arm (`read_program`); refuse joint values that may be degrees."""
    found = read_program(path, chain)
    values, _ = joint_values(chain, found.program)
    check_turns(values, chain, lambda k, _: f'{path}, {found.places[k]}: ')
    return found


def read_program(path: Path, chain: Chain) -> ProgramFile:
    """Read a program for an arm: CSV, or YAML by the file's suffix.

    CSV: joint values in q1 ... qn, or in columns with the joints' names; optional s1 ... sn are
    the signs of the joints' last moves. YAML: a trajectory_msgs/JointTrajectory as printed by
    `ros2 topic echo`.
    """
    suffix = path.suffix.lower()
    if suffix == '.csv':
        return _read_csv(path, chain)
    if suffix in TRAJECTORIES:
        return _read_yaml(read_text(path, LARGEST_TEXT, InputError), str(path))
    raise InputError(f'{path} must be a table (.csv with q1 ... qn) or a JointTrajectory (.yaml)')


def _read_csv(path: Path, chain: Chain) -> ProgramFile:
    table, separator, text, coding = _columns(path)
    found, names, units, program = _program(table, chain)
    places = tuple(f'line {n}' for n in found.lines)
    if (time := _column(found, TIME)) in found.header:
        sign = decimal_sign(found.texts(time))
        times = [cell_number(cell, sign) for cell in found.texts(time)]
        _refuse_falling(times, places, str(path))
    small = joint_columns(len(names), 's')
    signs = [each if each in found.header else each.upper() for each in small]  # beside Q1 ... Qn
    known = [k for k, sign in enumerate(signs) if sign in found.header]
    if len({*known, *chain.held}) == len(signs):
        approach = np.zeros((len(found.lines), len(signs)))
        approach[:, known] = np.sign(found.block([signs[k] for k in known]))
        program = replace(program, approach=approach)

    def text_with(corrected: Program) -> str:
        lines = csv.reader(io.StringIO(text, newline=''), delimiter=separator)
        header, *rows = (row for row in lines if any(row))
        place = {' '.join(name.split()): k for k, name in enumerate(header)}  # some have no name
        given = [k for k, name in enumerate(names) if name in found.header]
        at = [place[names[k]] for k in given]
        for row, values in zip(rows, (corrected.positions / units[given]).tolist(), strict=True):
            for k, value in zip(at, values, strict=True):
                row[k] = repr(value).replace('.', found.decimal)
        return csv_text([header, *rows], separator, '\r\n' if '\r\n' in text else '\n')

    return ProgramFile(program, places, text_with, coding)


def _refuse_falling(times: Sequence[float], places: Sequence[str], where: str) -> None:
    """Refuse samples that are not in the order of their times (N); NaN and infinity are none."""
    for (before, after), place in zip(pairwise(times), places[1:], strict=True):
        if after < before < math.inf:
            raise InputError(
                f'{where}, {place}: {TIME} falls from {before:g} to {after:g}: put the samples '
                'into the order of their times'
            )


def _read_yaml(text: str, where: str) -> ProgramFile:
    message = parse_yaml(text, where, InputError)
    names = message.get('joint_names') if isinstance(message, dict) else None
    points = message.get('points') if isinstance(message, dict) else None
    if not isinstance(names, list) or not isinstance(points, list) or not points:
        raise InputError(
            f'{where} must be a trajectory_msgs/JointTrajectory with joint_names and points'
        )
    for k, point in enumerate(points):
        if not isinstance(point, dict):
            raise InputError(
                f'{where}, point {k + 1} must be a mapping, not {point!r}; ros2 topic echo '
                '--full-length prints messages whole'
            )

    def text_with(corrected: Program) -> str:
        arrays = {
            key: array.tolist() for key in RATES if (array := getattr(corrected, key)) is not None
        }
        new = [
            point | {key: rows[k] for key, rows in arrays.items()}
            for k, point in enumerate(points)
        ]
        return dump_yaml(message | {'points': new})

    places = tuple(f'point {k + 1}' for k in range(len(points)))
    times = [
        _seconds(point.get(TIME, {}), f'{where}, {place}')
        for place, point in zip(places, points, strict=True)
    ]
    _refuse_falling(times, places, where)
    return ProgramFile(trajectory_program(names, points, where), places, text_with)


def _seconds(time: object, where: str) -> float:
    """Return the seconds of a Duration as printed, 0 by default as in a message."""
    parts = time if isinstance(time, Mapping) else {'sec': time}
    given = [parts.get(key, 0) for key in ('sec', 'nanosec')]
    sec, nanosec = (parse_number(x, f'{where}: {TIME}', InputError, 2.0**32) for x in given)
    return sec + 1e-9 * nanosec


def trajectory_program(
    names: Sequence[object], points: Sequence[Mapping[str, Any]], where: str
) -> Program:
    """Return the program of a JointTrajectory; rates at all points or none."""

    def values(key: str) -> FloatArray | None:
        given = [point.get(key) or [] for point in points]
        if not any(given):
            return None
        rows = [
            parse_numbers(row, len(names), f'{where}, point {k + 1}: {key}', InputError)
            for k, row in enumerate(given)
        ]
        return np.array(rows)

    positions, *rates = map(values, RATES)
    if positions is None:
        raise InputError(f'{where} has no positions')
    return Program(tuple(map(str, names)), positions, *rates)
