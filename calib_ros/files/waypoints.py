# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of poses (CSV) that hold nothing measured: candidates, tasks, plans.

Joint values are in q1 ... qn, or in columns with the joints' names [rad or m], poses in x y z [m]
and qx qy qz qw.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib_ros.errors import InputError
from calib_ros.files.columns import Columns, check_quaternions
from calib_ros.files.csv_columns import read_columns, with_rows
from calib_ros.files.layouts import POSITION, QUATERNION, joint_columns
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.inverse import limits
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.texts import csv_text

POSE = (*POSITION, *QUATERNION)


def read_joints(path: Path, chain: Chain) -> FloatArray:
    """Read joint values (N, n) [rad or m] of a chain from a CSV.

    A value over 1e-3 beyond the limits of its joint is refused.
    """
    found = read_columns(path, ())
    values = joint_values(found, chain.joint_names)
    lower, upper = limits(chain)
    beyond = (values < lower - 1e-3) | (values > upper + 1e-3)
    for k, i in np.argwhere(beyond).tolist():
        where = found.where(k, header_of(found, chain.joint_names)[i])
        raise InputError(
            f'{where} {values[k, i]:.6g} is beyond the limits of {chain.joint_names[i]}, '
            f'{lower[i]:.6g} to {upper[i]:.6g} (rad or m)'
        )
    return values


def joint_values(found: Columns, joints: Sequence[str]) -> FloatArray:
    """Return the joint values (N, n) [rad or m] of an arm with the named joints."""
    names = header_of(found, joints)
    more = f'q{len(joints) + 1}'
    if more in with_rows(found, names).header:
        raise InputError(
            f'{found.path} has a column {more}, but the arm has {len(joints)} joints only'
        )
    return found.block(names)


def header_of(found: Columns, joints: Sequence[str]) -> tuple[str, ...]:
    """Return the columns that hold the joint values: q1 ... qn, or the names of the joints."""
    ours = joint_columns(len(joints))
    named = set(joints) <= set(found.header) and not set(ours) <= set(found.header)
    return tuple(joints) if named else ours


def read_poses(path: Path) -> FloatArray:
    """Read poses (N, 4, 4) from the columns x y z [m] and qx qy qz qw of a CSV."""
    found = read_columns(path, POSE)
    numbers = found.block(POSE)
    check_quaternions(found, numbers[:, 3:])
    return se3.transform(se3.from_quat(numbers[:, 3:]), numbers[:, :3])


def joints_csv(joints: FloatArray) -> str:
    """Return the CSV text of joint values (N, n), as `read_joints` reads it."""
    return csv_of(joint_columns(joints.shape[1]), joints)


def csv_of(columns: Sequence[str], values: FloatArray) -> str:
    """Return the CSV text of values (N, C); NaN is left empty."""
    cells = (['' if x != x else f'{x:.9f}' for x in row] for row in values.tolist())
    return csv_text([columns, *cells])
