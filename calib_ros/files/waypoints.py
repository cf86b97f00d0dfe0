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
from calib_ros.files.columns import check_quaternions
from calib_ros.files.csv_columns import read_columns
from calib_ros.files.layouts import POSITION, QUATERNION
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.inverse import limits
from calib_ros.kinematics.se3 import FloatArray

BEYOND = 1e-3
"""How far [rad or m] an arm may stand beyond a limit."""
POSE = (*POSITION, *QUATERNION)


def read_joints(path: Path, chain: Chain) -> FloatArray:
    """Read joint values (N, n) [rad or m] of a chain from the columns q1 ... qn of a CSV.

    Raises
    ------
    InputError
        For a missing column, one joint too many, no row, a value that is no number, and one that
        is beyond the limits of its joint.

    """
    columns = joint_columns(len(chain.joints))
    found = read_columns(path, columns)
    values, surplus = found.block(columns), f'q{len(columns) + 1}'
    if surplus in found.header:
        raise InputError(
            f'{path} has a column {surplus}, but "{chain.name}" has {len(columns)} joints only'
        )
    lower, upper = limits(chain)
    beyond = (values < lower - BEYOND) | (values > upper + BEYOND)
    for k, i in np.argwhere(beyond).tolist():
        raise InputError(
            f'{found.where(k, columns[i])} {values[k, i]:.6g} is beyond the limits of '
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
    found = read_columns(path, POSE)
    numbers = found.block(POSE)
    check_quaternions(found, numbers[:, 3:])
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
