# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rotations that were read by another convention than they were written in.

A rotation matrix gives back the angles that it was made of if the order of the axes is known: each
order is tried. From the angles follows the rotation that was meant. Two triples of angles make the
same rotation; where one of them is never written as what was meant, it was the other. XYZ stands
for R = Rx Ry Rz, turns about rotated axes; zyx about fixed ones is the same.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from itertools import permutations
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import FloatArray

Turn: TypeAlias = Callable[[FloatArray], FloatArray]
Triples: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
ORDERS = tuple(map(''.join, permutations('XYZ')))
VECTOR = ''
"""Of no order: three numbers that are a rotation vector."""


def misread() -> Iterator[tuple[str, str, Turn]]:
    """Yield mistakes, what to do, and the rotations (N, 3, 3) that were meant by those read."""
    for read in ORDERS:
        for meant in ORDERS:
            if meant != read:
                yield (
                    f'the Euler angles are {_order(meant)}, not {_order(read)}',
                    f'--euler {meant}, or convert them so',
                    _meant(_angles(read), meant, meant),
                )
                now = ', '.join(f'r{axis.lower()}' for axis in read)
                yield (
                    f'the Euler angles are {_order(meant)} in the order of their columns, '
                    f'not {_order(read)}',
                    f'--euler {meant} with r1, r2, r3 (now {now}), or convert them so',
                    _meant(_angles(read), meant, read),
                )
        yield (
            f'the angles are rotation vectors, not Euler angles {_order(read)}',
            '--rotation-vector, or convert them so',
            _meant(_angles(read), VECTOR, 'XYZ'),
        )
        for vectors in (_vectors, _longer):
            yield (
                f'the angles are Euler angles {_order(read)}, not rotation vectors',
                f'--euler {read}, or convert them so',
                _meant(vectors, read, read),
            )
        yield (
            'the Euler angles are in radians, not degrees',
            '--angle rad, with --joint-angle for the joints',
            _meant(_angles(read), read, read, np.degrees(1.0)),
        )
    yield (
        'the rotation vectors are in radians, not degrees',
        '--angle rad, with --joint-angle for the joints',
        _meant(_vectors, VECTOR, 'XYZ', np.degrees(1.0)),
    )


def _order(letters: str) -> str:
    return f'{letters} ({letters[::-1].lower()} about fixed axes)'


def _meant(triples: Triples, order: str, axes: str, size: float = 1.0) -> Turn:
    """Return what makes other rotations of the same numbers.

    Those about `axes`, as they were read, become turns in this order, or a rotation vector.
    """
    columns = ['XYZ'.index(axis) for axis in axes]

    def turned(rotations: FloatArray) -> FloatArray:
        one, other = (size * each[:, columns] for each in triples(rotations))
        better = _beyond(other, order) < _beyond(one, order)
        angles = np.where(better[:, np.newaxis], other, one)
        if order == VECTOR:
            return se3.exp_rotation(angles)
        return np.asarray(Rotation.from_euler(order, angles).as_matrix())

    return turned


def _beyond(angles: FloatArray, order: str) -> FloatArray:
    """Return by how much angles (N, 3) exceed [rad] what is written: (N,)."""
    if order == VECTOR:
        sizes = np.linalg.norm(angles, axis=1) - np.pi
    else:
        sizes = (np.abs(angles) - np.pi * np.array([1.0, 0.5, 1.0])).max(axis=1)
    return np.asarray(np.maximum(sizes, 0.0))


def _angles(order: str) -> Triples:
    """Return what finds the angles (N, 3) about x, y and z [rad] in this order."""
    middle = 'XYZ'.index(order[1])

    def taken(rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # where two axes are parallel any split will do
            angles = Rotation.from_matrix(rotations).as_euler(order)
        one = np.asarray(angles[:, [order.index(axis) for axis in 'XYZ']])
        other = one - np.pi * np.where(one > 0.0, 1.0, -1.0)
        other[:, middle] = np.pi * np.where(one[:, middle] > 0.0, 1.0, -1.0) - one[:, middle]
        return one, other

    return taken


def _vectors(rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rotation vectors (N, 3) [rad], the shorter ones and the longer ones."""
    one = se3.log_rotation(rotations)
    length = np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-300)
    return one, one * (1.0 - 2.0 * np.pi / length)


def _longer(rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return them the other way round: Euler angles may well be longer than half a turn."""
    return _vectors(rotations)[::-1]
