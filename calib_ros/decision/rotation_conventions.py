# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rotations read in another convention than they were written in.

A rotation matrix gives back the angles it was made of, in each order of axes in which they may
have been read; these give the intended rotation. Two triples of angles make the same rotation; if
the intended convention never writes one of them, it was the other. XYZ stands for R = Rx Ry Rz,
turns about rotated axes; zyx about fixed ones is the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import permutations
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import FloatArray

Turn: TypeAlias = Callable[[FloatArray], FloatArray]
ORDERS = tuple(map(''.join, permutations('XYZ')))
BACKWARDS = (
    'the Euler angles are in the opposite order',
    'for r1, r2, r3 reverse the letters of --euler and change their case (xyz for ZYX); for rx, '
    'ry, rz swap the first and the last turn',
)
VECTOR = ''  # "Order" of a rotation vector


def misread() -> Iterator[tuple[str, str, Turn]]:
    """Yield mistakes, remedies, and functions from rotations (N, 3, 3) as read to those meant."""
    in_radians, so = '--angle rad, with --joint-angle for the joints', ', or convert them so'
    for read in ORDERS:
        now = ','.join(f'r{k}=r{axis.lower()}' for k, axis in enumerate(read, 1))
        angles = f'Euler angles {_order(read)}'
        for meant in ORDERS:
            if meant == read:
                yield *BACKWARDS, _reinterpret(read, read, read[::-1])
                continue
            what, turn = f'the Euler angles are {_order(meant)}', _reinterpret(read, meant, meant)
            yield f'{what}, not {_order(read)}', f'--euler {meant}{so}', turn
            what += f' in the order of their columns, not {_order(read)}'
            remedy = f'--euler {meant} --columns {now} (if so named){so}'
            yield what, remedy, _reinterpret(read, meant, read)
        turn = _reinterpret(read, VECTOR, 'XYZ')
        yield f'the angles are rotation vectors, not {angles}', f'--rotation-vector{so}', turn
        for longer in (False, True):
            turn = _reinterpret(VECTOR, read, read, longer=longer)
            yield f'the angles are {angles}, not rotation vectors', f'--euler {read}{so}', turn
        what = 'the Euler angles are in radians, not degrees'
        yield what, in_radians, _reinterpret(read, read, read, np.degrees(1.0))
    what = 'the rotation vectors are in radians, not degrees'
    yield what, in_radians, _reinterpret(VECTOR, VECTOR, 'XYZ', np.degrees(1.0))


def _order(letters: str) -> str:
    return f'{letters} ({letters[::-1].lower()} about fixed axes)'


def _reinterpret(
    read: str, meant: str, axes: str, size: float = 1.0, longer: bool = False
) -> Turn:
    """Return a function from the rotations read to those meant.

    Angles about `axes`, as read, become turns in the intended order or a rotation vector. With
    `longer`, the longer rotation vectors come first: Euler angles may exceed half a turn.
    """
    columns = ['XYZ'.index(axis) for axis in axes]

    def turned(rotations: FloatArray) -> FloatArray:
        triples = _angles(rotations, read) if read else _vectors(rotations)
        one, other = (size * each[:, columns] for each in triples[:: -1 if longer else 1])
        better = _beyond(other, meant) < _beyond(one, meant)
        angles = np.where(better[:, np.newaxis], other, one)
        if meant == VECTOR:
            return se3.exp_rotation(angles)
        return np.asarray(Rotation.from_euler(meant, angles).as_matrix())

    return turned


def _beyond(angles: FloatArray, order: str) -> FloatArray:
    """Return by how much [rad] angles (N, 3) exceed the usual range: (N,)."""
    if order == VECTOR:
        sizes = np.linalg.norm(angles, axis=1) - np.pi
    else:
        sizes = (np.abs(angles) - np.pi * np.array([1.0, 0.5, 1.0])).max(axis=1)
    return np.asarray(np.maximum(sizes, 0.0))


def _angles(rotations: FloatArray, order: str) -> tuple[FloatArray, FloatArray]:
    """Return both triples of angles (N, 3) about x, y and z [rad] in an order."""
    one = se3.to_euler(rotations, order)
    half = np.copysign(np.pi, one)
    other = np.where([True, False, True], one - half, half - one)
    columns = [order.index(axis) for axis in 'XYZ']
    return one[:, columns], other[:, columns]


def _vectors(rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the shorter and the longer rotation vectors (N, 3) [rad]."""
    one = se3.log_rotation(rotations)
    length = np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-300)
    return one, one * (1.0 - 2.0 * np.pi / length)
