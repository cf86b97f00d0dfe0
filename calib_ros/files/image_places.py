# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of the joint values or flange poses of images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib_ros.errors import InputError
from calib_ros.files.columns import check_quaternions, read_columns
from calib_ros.files.headers import joints_left_out
from calib_ros.files.vocabulary import POSE_COLUMNS, joint_columns
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.se3 import FloatArray

POSED = 'flange_pose'  # name of the virtual arm


def posed_arm() -> Chain:
    """Return a virtual arm whose joint values are a pose: x y z [m], then turns about x y z.

    It replaces an arm of which only flange poses are known.
    """
    quarter = np.pi / 2
    joints = (
        Joint('flange_z', 'prismatic', theta=quarter, alpha=quarter),
        Joint('flange_x', 'prismatic', theta=quarter, alpha=quarter),
        Joint('flange_y', 'prismatic', alpha=-quarter),
        Joint('flange_rx', alpha=quarter),
        Joint('flange_ry', theta=quarter, alpha=quarter),
        Joint('flange_rz'),
    )
    return Chain(POSED, 'standard', joints)


def joints_of_poses(positions: FloatArray, rotations: FloatArray) -> FloatArray:
    """Return the joint values (N, 6) of the virtual arm at flange poses."""
    return np.column_stack([positions[:, [2, 0, 1]], se3.to_euler(rotations, 'XYZ')])


def read_places(path: Path, joints: int) -> tuple[dict[str, FloatArray], bool, tuple[str, ...]]:
    """Read joint values (n,) of each image by name; return them, whether from poses, and warnings.

    The table has `image` and q1 ... qn, or the flange's pose x y z qx qy qz qw.
    """
    found = read_columns(path, ('image',))
    image, names = found.labels('image')
    twice = np.bincount(image)[image] > 1
    found.refuse(twice, lambda row: f'image {names[image[row]]} appears twice')
    posed = 'q1' not in found.header
    columns = POSE_COLUMNS if posed else joint_columns(joints)
    missing = [name for name in columns if name not in found.header]
    if missing:
        raise InputError(
            f'{path} has no column {", ".join(missing)}: give q1 ... q{joints}, or x y z qx qy qz '
            'qw of the flange'
        )
    values = found.block(columns)
    if posed:
        check_quaternions(found, values[:, 3:])
        values = joints_of_poses(values[:, :3], se3.from_quat(values[:, 3:]))
    left_out = joints_left_out(path, found.header, joints)
    return dict(zip(names, values, strict=True)), posed, left_out
