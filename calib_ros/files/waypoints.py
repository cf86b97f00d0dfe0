# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of poses (CSV) that hold nothing measured: candidates, tasks, plans.

Joint values are in q1 ... qn [rad or m], poses in x y z [m] and qx qy qz qw.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib_ros.errors import InputError
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.inverse import limits
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.texts import LARGEST_TABLE, read_rows, read_text
from calib_ros.values import QUATERNION_TOLERANCE, cell_number

BEYOND = 1e-3
"""How far [rad or m] an arm may stand beyond a limit."""
POSE = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')


def read_joints(path: Path, chain: Chain) -> FloatArray:
    """Read joint values (N, n) [rad or m] of a chain from the columns q1 ... qn of a CSV.

    Raises
    ------
    InputError
        For a missing column, one joint too many, no row, a value that is no number, and one that
        is beyond the limits of its joint.

    """
    columns = joint_columns(len(chain.joints))
    values, lines, header = _read(path, columns)
    surplus = f'q{len(columns) + 1}'
    if surplus in header:
        raise InputError(
            f'{path} has a column {surplus}, but "{chain.name}" has {len(columns)} joints only'
        )
    lower, upper = limits(chain)
    beyond = (values < lower - BEYOND) | (values > upper + BEYOND)
    for k, i in np.argwhere(beyond).tolist():
        raise InputError(
            f'{path}, line {lines[k]}: {columns[i]} {values[k, i]:.6g} is beyond the limits of '
            f'{chain.joint_names[i]}, {lower[i]:.6g} to {upper[i]:.6g} (rad or m)'
        )
    return values


def read_poses(path: Path) -> FloatArray:
    """Read poses (N, 4, 4) from the columns x y z [m] and qx qy qz qw of a CSV.

    Raises
    ------
    InputError
        For a missing column, no row, a value that is no number, or a quaternion that is none.

    """
    numbers, lines, _ = _read(path, POSE)
    length = np.linalg.norm(numbers[:, 3:], axis=1)
    for k in np.flatnonzero(np.abs(length - 1.0) > QUATERNION_TOLERANCE).tolist():
        raise InputError(
            f'{path}, line {lines[k]}: quaternion qx qy qz qw has length {length[k]:.6g}, '
            'expected 1'
        )
    return se3.transform(se3.from_quat(numbers[:, 3:]), numbers[:, :3])


def joint_columns(joints: int) -> list[str]:
    """Return the names of the columns of joint values."""
    return [f'q{k + 1}' for k in range(joints)]


def joints_csv(joints: FloatArray) -> str:
    """Return the CSV text of joint values (N, n), as `read_joints` reads it."""
    return csv_of(joint_columns(joints.shape[1]), joints)


def csv_of(columns: Sequence[str], values: FloatArray) -> str:
    """Return the CSV text of values (N, C); NaN is left empty."""
    rows = (
        ','.join('' if math.isnan(value) else f'{value:.9f}' for value in row)
        for row in values.tolist()
    )
    return '\n'.join([','.join(columns), *rows]) + '\n'


def _read(path: Path, columns: Sequence[str]) -> tuple[FloatArray, list[int], Sequence[str]]:
    """Return the values (N, C) of some columns, the line of each row, and the header."""
    header, rows = read_rows(read_text(path, LARGEST_TABLE, InputError), path)
    missing = [name for name in columns if name not in header]
    if missing:
        raise InputError(
            f'{path} has no column {", ".join(missing)}; expected {", ".join(columns)}; found '
            f'{", ".join(header) or "nothing"}'
        )
    if not rows:
        raise InputError(f'{path} has no rows')
    numbers = [
        [cell_number(row[name], f'{path}, line {line}: {name}') for name in columns]
        for line, row in rows
    ]
    return np.array(numbers), [line for line, _ in rows], header
