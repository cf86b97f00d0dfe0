# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rotations and rigid transforms, batched.

Quaternions are ordered (x, y, z, w) as in ROS. A rotation vector is the axis times the angle in
radians. Transforms are homogeneous 4 x 4 matrices.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

FloatArray: TypeAlias = NDArray[np.float64]
Flags: TypeAlias = NDArray[np.bool_]
Index: TypeAlias = NDArray[np.intp]
ROUNDS = 100
"""Iterations of a fixed-point search, which normally needs far fewer. A convention."""
HALF_THE_DIGITS = float(np.sqrt(np.finfo(float).eps))
"""Share whose square is rounding: such a Newton step is the last, and a column with less left
depends on those before it."""
ROUNDING = HALF_THE_DIGITS**1.5
"""Share of the whole above rounding: 12 of 16 digits."""


def transform(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Compose (..., 3, 3) rotations and (..., 3) translations [m] to (..., 4, 4) transforms."""
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    matrix = np.zeros((*shape, 4, 4))
    matrix[..., :3, :3] = rotation
    matrix[..., :3, 3] = translation
    matrix[..., 3, 3] = 1.0
    return matrix


def invert(matrix: FloatArray) -> FloatArray:
    """Invert (..., 4, 4) rigid transforms."""
    rotation = np.swapaxes(matrix[..., :3, :3], -1, -2)
    return transform(rotation, -np.einsum('...ij,...j->...i', rotation, matrix[..., :3, 3]))


def from_quat(quat_xyzw: FloatArray) -> FloatArray:
    """Turn (..., 4) quaternions, normalised here, into (..., 3, 3) rotation matrices."""
    return _each(quat_xyzw, (4,), lambda flat: Rotation.from_quat(flat).as_matrix(), (3, 3))


def to_quat(rotation: FloatArray) -> FloatArray:
    """Turn (..., 3, 3) rotation matrices into (..., 4) quaternions with w >= 0."""
    quat = _each(rotation, (3, 3), lambda flat: Rotation.from_matrix(flat).as_quat(), (4,))
    return np.where(quat[..., 3:] < 0.0, -quat, quat)


def exp_rotation(vector: FloatArray) -> FloatArray:
    """Turn (..., 3) rotation vectors [rad] into (..., 3, 3) rotation matrices."""
    return _each(vector, (3,), lambda flat: Rotation.from_rotvec(flat).as_matrix(), (3, 3))


def turned(x: float, y: float, z: float) -> FloatArray:
    """Return the rotation matrix (3, 3) of one rotation vector [rad] (Rodrigues)."""
    angle = math.hypot(x, y, z)
    # sin(a) / a and (1 - cos(a)) / a^2, without loss of digits
    half = math.sin(0.5 * angle) / (0.5 * angle) if angle > 0.0 else 1.0
    first, second = math.sin(angle) / angle if angle > 0.0 else 1.0, 0.5 * half * half
    xy, xz, yz = second * x * y, second * x * z, second * y * z
    x, y, z, xx, yy, zz = first * x, first * y, first * z, x * x, y * y, z * z
    return np.array(
        [
            [1.0 - second * (yy + zz), xy - z, xz + y],
            [xy + z, 1.0 - second * (xx + zz), yz - x],
            [xz - y, yz + x, 1.0 - second * (xx + yy)],
        ]
    )


def cos_sin(angles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return cosines and sines of angles (...) [rad], from the tangents of half angles."""
    tangent = np.tan(0.5 * angles)
    square = tangent * tangent
    scale = 1.0 / (1.0 + square)
    return (1.0 - square) * scale, (tangent + tangent) * scale


def log_rotation(rotation: FloatArray) -> FloatArray:
    """Turn (..., 3, 3) rotation matrices into (..., 3) rotation vectors [rad]."""
    return _each(rotation, (3, 3), lambda flat: Rotation.from_matrix(flat).as_rotvec(), (3,))


def to_euler(rotation: FloatArray, order: str) -> FloatArray:
    """Turn (..., 3, 3) rotation matrices into (..., 3) angles [rad] in an order of scipy."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')  # any split will do in gimbal lock
        return _each(
            rotation, (3, 3), lambda flat: Rotation.from_matrix(flat).as_euler(order), (3,)
        )


def angles_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the angles (...,) [rad] between rotations (..., 3, 3), to 1e-8."""
    cosines = (np.einsum('...ij,...ij->...', first, second) - 1.0) / 2.0
    return np.asarray(np.arccos(np.clip(cosines, -1.0, 1.0)))


def skew(vector: FloatArray) -> FloatArray:
    """Return the matrices (..., 3, 3) of the cross product with (..., 3) vectors."""
    return np.asarray(np.cross(np.eye(3), vector[..., np.newaxis, :]))


def cross(first: FloatArray, second: FloatArray, out: FloatArray | None = None) -> FloatArray:
    """Return the cross product of (..., 3, B) arrays, in `out` if given."""
    found = np.empty(np.broadcast_shapes(first.shape, second.shape)) if out is None else out
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        np.multiply(first[..., i, :], second[..., j, :], out=found[..., k, :])
        found[..., k, :] -= first[..., j, :] * second[..., i, :]
    return found


def norms(vectors: FloatArray) -> FloatArray:
    """Return the lengths (N,) of vectors (N, c), in a third of the time of `np.linalg.norm`."""
    return np.asarray(np.sqrt(np.einsum('nc,nc->n', vectors, vectors)))


def left_jacobian_inverse(vector: FloatArray) -> FloatArray:
    """Return J_l(v)^-1 (..., 3, 3) of rotation vectors (..., 3) (Chirikjian 2012).

    For small w, log(exp(w) exp(v)) = v + J_l(v)^-1 w.
    """
    half = 0.5 * np.maximum(np.linalg.norm(vector, axis=-1), 1e-6)[..., np.newaxis, np.newaxis]
    factor = (1.0 - half / np.tan(half)) / (2.0 * half) ** 2
    cross = skew(vector)
    return np.asarray(np.eye(3) - 0.5 * cross + factor * cross @ cross)


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """Return the rotations (..., 3, 3) nearest to matrices (Schönemann 1966, Umeyama 1991)."""
    u, _, vt = np.linalg.svd(matrix)
    u[..., -1] *= np.linalg.det(u @ vt)[..., np.newaxis]
    return np.asarray(u @ vt)


def _each(
    array: FloatArray,
    shape: tuple[int, ...],
    turned: Callable[[FloatArray], FloatArray],
    into: tuple[int, ...],
) -> FloatArray:
    """Return (..., *into) of (..., *shape): old scipy refuses empty and read-only arrays."""
    flat = np.array(array, dtype=np.float64).reshape(-1, *shape)
    found = np.asarray(turned(flat)) if len(flat) else np.zeros(0)
    return found.reshape(*array.shape[: array.ndim - len(shape)], *into)
