# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Board points in images: the camera stands and the board is on the arm, or the reverse."""

import numpy as np
import pytest

from calib_ros.kinematics import se3
from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.projection import view

LENS = Lens(900.0, 950.0, 320.0, 240.0, -0.1, 0.05, 0.001, -0.002)
OWNER = np.array([0, 0, 1, 1, 1])
TURNS = se3.exp_rotation(np.array([[0.2, -0.3, 0.4], [-0.5, 0.1, 0.2]]))
PLACES = np.array([[0.1, -0.05, 1.0], [-0.2, 0.1, 1.5]])
POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (3, 5))
BEFORE = np.array([0.0, 0.0, 1.2])
"""Where points are in the world if the camera is on the arm."""


def seen(on_flange, turns=TURNS, places=PLACES):
    points = POINTS
    if on_flange:  # before each camera
        places = 0.1 * places
        points = POINTS + np.einsum('kij,j->ik', TURNS[OWNER], BEFORE)
    return view(LENS, turns.transpose(2, 1, 0), places.T, OWNER, points, on_flange)


def test_points_of_a_board_on_the_arm_are_seen_where_the_lens_projects_them():
    inside = np.einsum('kij,jk->ik', TURNS[OWNER], POINTS) + PLACES[OWNER].T
    np.testing.assert_allclose(seen(False).points, inside)
    np.testing.assert_allclose(seen(False).pixels, LENS.project(inside)[0])


def test_points_of_a_board_that_stands_are_seen_by_a_camera_on_the_arm():
    world = POINTS + np.einsum('kij,j->ik', TURNS[OWNER], BEFORE)
    inside = np.einsum('kji,jk->ik', TURNS[OWNER], world - 0.1 * PLACES[OWNER].T)
    np.testing.assert_allclose(seen(True).points, inside)
    np.testing.assert_allclose(seen(True).pixels, LENS.project(inside)[0])


@pytest.mark.parametrize('on_flange', [False, True])
def test_derivatives_by_shifts_and_turns_along_the_axes_of_the_camera(on_flange):
    found, step = np.empty((6, 2, 5)), 1e-6
    seen(on_flange).by_twist(found)

    def moved(twist):
        shift, turn = twist[:3], se3.exp_rotation(twist[3:])
        if on_flange:
            return seen(True, TURNS @ turn, PLACES + 10.0 * TURNS @ shift).pixels
        return seen(False, turn @ TURNS, PLACES + shift).pixels

    for k, twist in enumerate(step * np.eye(6)):
        change = (moved(twist) - moved(-twist)) / (2.0 * step)
        np.testing.assert_allclose(found[k], change, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize('on_flange', [False, True])
def test_the_shortest_shift_that_removes_a_residual(on_flange):
    there, residual = seen(on_flange), np.random.default_rng(1).normal(size=(2, 5))
    shift = there.at_the_board(residual).T
    if on_flange:
        shift = np.einsum('kji,jk->ik', TURNS[OWNER], shift)
    np.testing.assert_allclose(np.einsum('ikn,kn->in', there.by_shift, shift), residual)
    ray = np.cross(there.by_shift[0], there.by_shift[1], axis=0)
    np.testing.assert_allclose((ray * shift).sum(axis=0) / np.linalg.norm(ray), 0.0, atol=1e-9)
