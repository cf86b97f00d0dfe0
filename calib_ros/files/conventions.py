# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses of other systems in our convention: quaternions, covariances, stamps in nanoseconds.

XYZ are turns about the axes as turned before, R = Rx(r1) Ry(r2) Rz(r3); xyz about fixed ones,
which is ZYX in the other order. Standard deviations s of Euler angles make the covariance
J diag(s^2) J' of the rotation about the device's axes: the columns of J are the axes about which
the angles turn, e1, R1 e2, R1 R2 e3. For a rotation vector v it is J_l(v), for quaternions and
matrices the standard deviations are those about the device's axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros.errors import ConfigError
from calib_ros.estimation.observations import Observations
from calib_ros.files.columns import BETWEEN, Columns, check_quaternions
from calib_ros.files.layouts import Layout
from calib_ros.files.vocabulary import (
    COVARIANCE,
    IN_TURN,
    MATRIX,
    POSITION,
    QUATERNION,
    SIGMAS,
    TURNS,
    UPPER,
)
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import TWO_TURNS
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.values import ROUNDED

THEIRS = (*TURNS, *IN_TURN, *MATRIX, *SIGMAS, 'time')


def to_our_columns(made: Columns, layout: Layout) -> Columns:
    """Return the columns with quaternions for rotations, covariances for standard deviations."""
    cells = {name: given for name, given in made.cells.items() if name not in THEIRS}
    if 'time' in made.cells:
        time = made.numbers(['time'])[:, 0]
        made.refuse(
            ~(np.abs(time) <= 9e9),
            'time [s] must be a number of at most 9e9: if it is in ms, give --columns '
            'time=NAME/1000',
        )
        cells['stamp_ns'] = BETWEEN.join(str(round(each * 1e9)) for each in time.tolist())
    rotation, axes = _rotations(made, layout)
    covariance = _covariance(made, axes)
    if layout.inverse:
        if rotation is None or not {*POSITION} <= {*cells}:
            raise ConfigError('--inverse needs poses with their rotations')
        given = np.zeros((len(made.lines), 1)), made.numbers(POSITION), rotation
        turned = replace(Observations.from_arrays(*given), covariance=covariance).inverted()
        cells |= zip(POSITION, turned.positions.T, strict=True)
        rotation, covariance = turned.rotations, turned.covariance
    if rotation is not None:
        cells |= zip(QUATERNION, se3.to_quat(rotation).T, strict=True)
    if covariance is not None:
        rows, columns = np.transpose(UPPER)
        cells |= zip(COVARIANCE, covariance[:, rows, columns].T, strict=True)
    return replace(made, cells=cells)


def _rotations(made: Columns, layout: Layout) -> tuple[FloatArray | None, FloatArray | None]:
    """Return rotations (N, 3, 3), and the axes (..., 3, 3) of their sigmas in columns, or None."""
    if {*QUATERNION} & {*made.cells}:
        quat = _whole(made, QUATERNION, 'a quaternion has four columns')
        quat = quat[:, [1, 2, 3, 0]] if layout.quaternion == 'wxyz' else quat
        check_quaternions(made, quat)
        return se3.from_quat(quat), np.eye(3)
    if {*MATRIX} & {*made.cells} and not (layout.euler or layout.rotation_vector):
        given = _whole(made, MATRIX, 'a rotation matrix has nine columns').reshape(-1, 3, 3)
        rotations = se3.nearest_rotation(given)
        made.refuse(
            np.abs(given - rotations).max(axis=(1, 2)) > ROUNDED,
            'r11 ... r33 are no rotation: check the order of the columns, and that the axes are '
            'right-handed',
        )
        return rotations, np.eye(3)
    three = [names for names in (TURNS, IN_TURN) if {*names} & {*made.cells}]
    if not three:
        for name in ('euler', 'rotation_vector', 'quaternion'):
            if getattr(layout, name):
                raise ConfigError(
                    f'{made.path}: {name.replace("_", " ")} is given, but no columns: --columns '
                    'rx=NAME,ry=NAME,rz=NAME (r1, r2, r3: in their order; or qx, qy, qz, qw)'
                )
        return None, None
    if len(three) > 1:
        raise ConfigError(f'{made.path}: give rx, ry, rz or r1, r2, r3, not both')
    return _of_angles(made, layout, three[0])


def _of_angles(
    made: Columns, layout: Layout, names: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    called = ', '.join(names)
    angles = _whole(made, names, 'Euler angles and rotation vectors have three columns')
    largest = np.abs(angles).max(axis=1)
    made.refuse(
        largest > TWO_TURNS,
        lambda row: (
            f'{called} are angles of up to {largest[row]:.6g} rad: if they are in degrees, give '
            '--angle deg (and --joint-angle rad if the joint values are in radians)'
        ),
    )
    if layout.rotation_vector:
        left = np.linalg.inv(se3.left_jacobian_inverse(angles))
        return se3.exp_rotation(angles), np.asarray(left)
    if not layout.euler:
        raise ConfigError(
            f'{made.path} has {called}: say which, --euler XYZ (ZYX, zyx ...) or --rotation-vector'
        )
    order = ['XYZ'.index(letter) for letter in layout.euler.upper()]
    if names == TURNS:
        if len({*order}) < 3:
            raise ConfigError(
                f'with --euler {layout.euler} an axis comes twice: give r1, r2, r3 in its order'
            )
        angles = angles[:, order]
    axes = np.zeros((len(angles), 3, 3))
    turned = np.tile(np.eye(3), (len(angles), 1, 1))
    for k in range(3) if layout.euler.isupper() else (2, 1, 0):
        axes[:, :, k] = turned[:, :, order[k]]
        turned = turned @ se3.exp_rotation(np.eye(3)[order[k]] * angles[:, k, np.newaxis])
    return turned, axes[:, :, np.argsort(order)] if names == TURNS else axes  # of rx, ry, rz


def _whole(made: Columns, names: Sequence[str], what: str) -> FloatArray:
    """Return the numbers (N, len(names)) of columns that belong together."""
    if missing := [name for name in names if name not in made.cells]:
        raise ConfigError(f'{made.path}: {what}, missing {", ".join(missing)}')
    found = made.numbers(names)
    made.refuse(np.isnan(found).any(axis=1), f'{", ".join(names)} must be numbers, not blank')
    return found


def _covariance(made: Columns, axes: FloatArray | None) -> FloatArray | None:
    """Return covariances (N, 6, 6) of standard deviations, or None."""
    place, turn = ([n for n in some if n in made.cells] for some in (SIGMAS[:3], SIGMAS[3:]))
    if not place and not turn:
        return None
    if len(place) < 3:
        raise ConfigError(f'{made.path}: standard deviations need sx, sy and sz')
    if turn and (len(turn) < 3 or axes is None):
        raise ConfigError(
            f'{made.path}: standard deviations of rotations need srx, sry, srz, and rotations'
        )
    found = np.zeros((len(made.lines), 6, 6))
    found[:, :3, :3] = np.square(_sizes(made, place))[:, :, np.newaxis] * np.eye(3)
    if turn and axes is not None:
        scaled = axes * _sizes(made, turn)[:, np.newaxis, :]
        found[:, 3:, 3:] = scaled @ np.swapaxes(scaled, 1, 2)
    return found


def _sizes(made: Columns, names: Sequence[str]) -> FloatArray:
    """Return standard deviations (N, len(names)); blank ones are not stated: 0."""
    found = np.nan_to_num(made.numbers(names))
    wrong = found.any(axis=1) & ~(found > 0.0).all(axis=1)
    told = f'standard deviations {", ".join(names)}'
    made.refuse(wrong, f'{told} must be positive, or all blank; name other columns otherwise')
    return found
