# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which of two triples of angles was meant. `test_mistakes.py` has the mistakes themselves."""

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros.decision.rotation_conventions import _angles, _beyond, _vectors, misread


def test_angles_are_beyond_the_usual_range_by_the_one_that_is_furthest():
    angles = np.array([[3.0, -1.5, -3.0], [3.2, 0.0, -3.3], [3.2, -2.0, 0.0]])
    np.testing.assert_allclose(_beyond(angles, 'ZXY'), [0.0, 3.3 - np.pi, 2.0 - 0.5 * np.pi])
    vectors = np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 4.0]])
    np.testing.assert_allclose(_beyond(vectors, ''), [0.0, 5.0 - np.pi])


def test_both_triples_and_both_vectors_are_the_same_rotation():
    turns = Rotation.random(20, random_state=1)
    for read in ('XYZ', 'ZXY'):
        for angles in _angles(turns.as_matrix(), read):
            columns = ['XYZ'.index(axis) for axis in read]
            again = Rotation.from_euler(read, angles[:, columns])
            np.testing.assert_allclose(again.as_matrix(), turns.as_matrix(), atol=1e-9)
    short, long = (np.linalg.norm(each, axis=1) for each in _vectors(turns.as_matrix()))
    np.testing.assert_allclose(short + long, 2.0 * np.pi)
    for vectors in _vectors(turns.as_matrix()):
        again = Rotation.from_rotvec(vectors)
        np.testing.assert_allclose(again.as_matrix(), turns.as_matrix(), atol=1e-9)


def test_euler_angles_read_as_vectors_may_be_of_more_than_half_a_turn(rng):
    angles = rng.uniform(-np.pi, np.pi, (200, 3)) * [1.0, 0.5, 1.0]
    meant = Rotation.from_euler('XYZ', angles).as_matrix()
    read = Rotation.from_rotvec(angles).as_matrix()
    far = np.linalg.norm(angles, axis=1) > np.pi
    found = (turn for what, _, turn in misread() if 'are Euler angles XYZ' in what)
    for turn, wanted in zip(found, (~far, far), strict=True):
        np.testing.assert_allclose(turn(read)[wanted], meant[wanted], atol=1e-9)
