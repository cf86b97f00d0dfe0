# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import warnings

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from calib_ros.kinematics import se3

SEEDS = st.integers(0, 2**32 - 1)


def test_the_angle_between_rotations_is_that_of_their_difference():
    rng = np.random.default_rng(0)
    vectors = np.array([[0.0, 0.0, 0.0], [1e-4, 0.0, 0.0], [0.3, -0.4, 0.5], [0.0, np.pi, 0.0]])
    first = se3.exp_rotation(rng.normal(size=(4, 3)))
    found = se3.angles_between(first, first @ se3.exp_rotation(vectors))
    np.testing.assert_allclose(found, np.linalg.norm(vectors, axis=1), atol=3e-8)
    many = se3.exp_rotation(rng.normal(size=(1000, 3)))  # a cosine may be rounded to more than 1
    assert se3.angles_between(many, many).max() < 1e-7


@pytest.mark.parametrize('angle', [0.0, 1e-9, 1e-4, 0.3, 2.0, 3.1])
@given(SEEDS)
def test_a_turn_is_the_exponential(angle, seed):
    axis = np.random.default_rng(seed).normal(size=3)
    vector = angle * axis / np.linalg.norm(axis)
    expected = expm(se3.skew(vector))
    np.testing.assert_allclose(se3.turned(*vector), expected, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(se3.exp_rotation(vector), expected, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize('angle', [0.0, 1e-7, 1e-3, 0.3, 2.0, 3.0])
@given(SEEDS)
def test_the_left_jacobian_is_the_central_difference(angle, seed):
    axis = np.random.default_rng(seed).normal(size=3)
    vector = angle * axis / np.linalg.norm(axis)
    step, end = 1e-5, se3.exp_rotation(vector)
    less, more = (
        se3.log_rotation(se3.exp_rotation(sign * step * np.eye(3)) @ end) for sign in (-1, 1)
    )
    expected = (more - less).T / (2.0 * step)
    found = se3.left_jacobian_inverse(vector)
    np.testing.assert_allclose(found, expected, atol=1e-7)
    among_others = se3.left_jacobian_inverse(np.array([[1.0, -2.0, 0.5], vector]))[1]
    np.testing.assert_allclose(among_others, found, rtol=0.0, atol=1e-15)
    if angle < 0.01:  # its series, of which the next term is the fourth power over 720
        cross = se3.skew(vector)
        series = np.eye(3) - cross / 2.0 + cross @ cross / 12.0
        np.testing.assert_allclose(found, series, rtol=0.0, atol=1e-13)


@given(SEEDS)
def test_of_a_matrix_the_nearest_rotation_is_no_reflection(seed):
    matrix = np.random.default_rng(seed).normal(size=(2, 3, 3))
    found = se3.nearest_rotation(matrix)
    np.testing.assert_allclose(np.linalg.det(found), 1.0)
    near = se3.exp_rotation(1e-3 * np.vstack([np.eye(3), -np.eye(3)]))
    for rotation, wanted in zip(found, matrix, strict=True):
        distance = np.linalg.norm(near @ rotation - wanted, axis=(1, 2))
        assert (distance >= np.linalg.norm(rotation - wanted)).all()


@given(SEEDS)
def test_quaternions_come_back_with_a_positive_w(seed):
    quat = np.random.default_rng(seed).normal(size=(3, 4))
    unit = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    found = se3.to_quat(se3.from_quat(quat))
    np.testing.assert_allclose(found, unit * np.sign(unit[:, 3:]), atol=1e-12)


def test_angles_about_axes_in_an_order():
    angles = np.random.default_rng(0).uniform(-1.5, 1.5, (2, 4, 3))
    turns = Rotation.from_euler('ZYX', angles.reshape(-1, 3)).as_matrix().reshape(2, 4, 3, 3)
    np.testing.assert_allclose(se3.to_euler(turns, 'ZYX'), angles)
    locked = Rotation.from_euler('ZYX', [0.3, np.pi / 2, 0.4]).as_matrix()
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        found = se3.to_euler(locked, 'ZYX')
    np.testing.assert_allclose(Rotation.from_euler('ZYX', found).as_matrix(), locked, atol=1e-9)
