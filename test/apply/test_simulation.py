# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from calib_ros.apply.camera import Camera, _facing, before_camera, photograph
from calib_ros.apply.simulation import Cell, drive
from calib_ros.errors import InputError
from calib_ros.kinematics.chain_file import load_chain


def test_an_arm_is_driven_smoothly_from_stop_to_stop(rng):
    """By the polynomial of least jerk, whose greatest speed is 15 / 8 of the mean one."""
    stops, cell, start = load_chain('ur10e').random_joints(4, rng), Cell(), 10**18
    stamps, joints, pose_stamps = drive(stops, cell, start)
    assert (np.diff(stamps) == 1e9 / cell.joint_rate).all()
    at = np.searchsorted(stamps, pose_stamps)
    np.testing.assert_array_equal(joints[at], np.repeat(stops, cell.poses_per_dwell, axis=0))
    speeds = np.diff(joints, axis=0) / (1e-9 * np.diff(stamps)[:, np.newaxis])
    fastest = np.abs(np.diff(stops, axis=0)).max() / cell.move * 15.0 / 8.0
    assert np.abs(speeds).max() == pytest.approx(fastest, rel=0.01)


def test_boards_stand_in_the_view_of_a_camera_as_far_away_as_said(rng):
    points = np.array([[x, y, 0.0] for x in (0.0, 0.3) for y in (0.0, 0.4)])
    camera = Camera()
    far = (_facing(camera, points, 500, rng)[:, :3] @ [*points.mean(axis=0), 1.0])[:, 2]
    assert far / camera.depth == pytest.approx(np.clip(far / camera.depth, 0.7, 1.3))
    assert np.ptp(far) == pytest.approx(0.6 * camera.depth, rel=0.03)
    chain = before_camera(load_chain('ur10e'), camera, points, True, rng)
    pixels = photograph(chain, camera, points, True, 10, rng).pixels
    assert ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all()
    across = np.linalg.norm(
        pixels.reshape(10, 4, 2)[:, 0] - pixels.reshape(10, 4, 2)[:, 3], axis=1
    )
    assert 0.35 < across.mean() / np.hypot(camera.width, camera.height) < 0.65  # about half of it


def test_a_camera_out_of_reach_is_refused(rng):
    points, camera = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]), Camera()
    chain = before_camera(load_chain('ur5e'), camera, points, False, rng)
    far = chain.frame('base')
    chain = chain.with_frame('base', replace(far, matrix=far.matrix + 9.0 * np.eye(4, k=3)))
    with pytest.raises(InputError, match='of 40 places before the camera the arm reaches 0, exp'):
        photograph(chain, camera, points, False, 20, rng, tries=40)


def test_a_simulated_lens_bends_the_corners_of_its_pictures_a_little():
    """By 1 to 5 % of their distance from the centre, as lenses of machine vision do."""
    camera = Camera()
    corners = np.array([[x, y] for x in (0.0, camera.width) for y in (0.0, camera.height)])
    seen = np.linalg.norm(corners - [camera.lens.cx, camera.lens.cy], axis=1)
    straight = camera.lens.rays(corners) * [camera.lens.fx, camera.lens.fy]
    bent = seen / np.linalg.norm(straight, axis=1) - 1.0
    assert (bent > -0.05).all()
    assert (bent < -0.01).all()
