# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rotations and standard deviations of other systems, as quaternions and covariances.

XYZ are turns about the axes as turned before, R = Rx(r1) Ry(r2) Rz(r3); xyz about fixed ones,
which is ZYX in the other order. Standard deviations s of Euler angles make the covariance
J diag(s^2) J' of the rotation about the device's axes: the columns of J are the axes about which
the angles turn, e1, R1 e2, R1 R2 e3. For a rotation vector v it is J_l(v), for quaternions the
standard deviations are those about the device's axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.observations import Observations
from calib_ros.files import layouts
from calib_ros.files.columns import MadeColumns, check_quaternions
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import TWO_TURNS
from calib_ros.kinematics.se3 import FloatArray


def finished(made: MadeColumns, layout: layouts.Layout) -> MadeColumns:
    """Return the columns with quaternions for rotations, covariances for standard deviations."""
    path, values, words = made.path, dict(made.values), dict(made.words)
    time = values.pop('time', None)
    if time is not None:
        for line in made.lines[~(np.abs(time) <= 9e9)][:1].tolist():
            raise InputError(f'{path}, line {line}: time [s] must be a number of at most 9e9')
        words['stamp_ns'] = [str(round(each * 1e9)) for each in time.tolist()]
    rotation, axes = _rotations(values, layout, made)
    sigmas = [values.pop(name, None) for name in layouts.SIGMAS]
    for name in (*layouts.TURNS, *layouts.IN_TURN):
        values.pop(name, None)
    covariance = _covariance(sigmas, axes, path)
    if layout.inverse:
        if rotation is None or not set(layouts.POSITION) <= set(values):
            raise ConfigError('--inverse needs poses with their rotations')
        given = np.column_stack([values[name] for name in layouts.POSITION])
        poses = Observations.from_arrays(np.zeros((len(given), 1)), given, rotation)
        turned = replace(poses, covariance=covariance).inverted()
        values |= dict(zip(layouts.POSITION, turned.positions.T, strict=True))
        rotation, covariance = turned.rotations, turned.covariance
    if rotation is not None:
        values |= dict(zip(layouts.QUATERNION, se3.to_quat(rotation).T, strict=True))
    if covariance is not None:
        rows, columns = np.transpose(layouts.UPPER)
        values |= dict(zip(layouts.COVARIANCE, covariance[:, rows, columns].T, strict=True))
    return replace(made, values=values, words=words)


def _rotations(
    values: dict[str, FloatArray], layout: layouts.Layout, made: MadeColumns
) -> tuple[FloatArray | None, FloatArray | None]:
    """Return rotations (N, 3, 3), and the axes (N, 3, 3) of their sigmas in columns, or None."""
    if set(layouts.QUATERNION) & set(values):
        return _from_quaternions(values, layout, made)
    three = [each for each in (layouts.TURNS, layouts.IN_TURN) if set(each) & set(values)]
    if not three:
        for name in ('euler', 'rotation_vector', 'quaternion'):
            if getattr(layout, name):
                raise ConfigError(
                    f'{made.path}: {name.replace("_", " ")} is given, but no columns: --columns '
                    'rx=NAME,ry=NAME,rz=NAME (or qx, qy, qz, qw)'
                )
        return None, None
    names, called = three[0], ', '.join(three[0])
    missing = [name for name in names if name not in values]
    if missing or len(three) > 1:
        raise ConfigError(
            f'{made.path}: give rx, ry, rz or r1, r2, r3, all three; missing {missing}'
        )
    angles = np.column_stack([values[name] for name in names])
    _require_whole(angles, made, called)
    for row in np.flatnonzero(np.abs(angles).max(axis=1) > TWO_TURNS)[:1].tolist():
        raise InputError(
            f'{made.where(row, called)} are angles of up to '
            f'{np.abs(angles[row]).max():.6g} rad: if they are in degrees, give --angle deg '
            '(and --joint-angle rad if the joint values are in radians)'
        )
    if layout.rotation_vector:
        left = np.linalg.inv(se3.left_jacobian_inverse(angles))
        return se3.exp_rotation(angles), np.asarray(left)
    if not layout.euler:
        raise ConfigError(
            f'{made.path} has {called}: say which, --euler XYZ (or ZYX, '
            'zyx, ...) or --rotation-vector'
        )
    return _from_euler(angles, layout.euler, names)


def _from_euler(
    angles: FloatArray, letters: str, names: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Return rotations, and the axes of angles (N, 3) about the axes named by letters."""
    if names == layouts.TURNS:
        if len(set(letters.upper())) < 3:
            raise ConfigError(
                f'with --euler {letters} an axis comes twice: give r1, r2, r3 in its order'
            )
        angles = angles[:, ['XYZ'.index(letter) for letter in letters.upper()]]
    axes = np.zeros((len(angles), 3, 3))
    turned = np.tile(np.eye(3), (len(angles), 1, 1))
    for k in range(3) if letters.isupper() else (2, 1, 0):
        unit = 'XYZ'.index(letters[k].upper())
        axes[:, :, k] = turned[:, :, unit]
        turned = turned @ se3.exp_rotation(np.eye(3)[unit] * angles[:, k, np.newaxis])
    if names == layouts.TURNS:  # order rx, ry, rz
        axes = axes[:, :, [letters.upper().index(letter) for letter in 'XYZ']]
    return turned, axes


def _from_quaternions(
    values: dict[str, FloatArray], layout: layouts.Layout, made: MadeColumns
) -> tuple[FloatArray, FloatArray]:
    missing = [name for name in layouts.QUATERNION if name not in values]
    if missing:
        raise ConfigError(
            f'{made.path}: a quaternion has four columns, missing {", ".join(missing)}'
        )
    quat = np.column_stack([values[name] for name in layouts.QUATERNION])
    if layout.quaternion == 'wxyz':
        quat = quat[:, [1, 2, 3, 0]]
    _require_whole(quat, made, 'qx, qy, qz, qw')
    check_quaternions(made, quat)
    return se3.from_quat(quat), np.tile(np.eye(3), (len(quat), 1, 1))


def _require_whole(values: FloatArray, made: MadeColumns, names: str) -> None:
    for row in np.flatnonzero(np.isnan(values).any(axis=1))[:1].tolist():
        raise InputError(f'{made.where(row, names)} must be numbers, not blank')


def _covariance(
    sigmas: Sequence[FloatArray | None], axes: FloatArray | None, path: Path
) -> FloatArray | None:
    """Return covariances (N, 6, 6) of standard deviations (N,), or None."""
    place, turn = ([x for x in each if x is not None] for each in (sigmas[:3], sigmas[3:]))
    if not place and not turn:
        return None
    if len(place) < 3:
        raise ConfigError(f'{path}: standard deviations need sx, sy and sz')
    if turn and (len(turn) < 3 or axes is None):
        raise ConfigError(
            f'{path}: standard deviations of rotations need srx, sry, srz, and rotations'
        )
    found = np.zeros((len(place[0]), 6, 6))
    found[:, :3, :3] = np.square(np.column_stack(place))[:, :, np.newaxis] * np.eye(3)
    if turn and axes is not None:
        scaled = axes * np.column_stack(turn)[:, np.newaxis, :]
        found[:, 3:, 3:] = scaled @ np.swapaxes(scaled, 1, 2)
    return found
