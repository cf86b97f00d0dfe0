# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Where boards are before a camera, by their corners in an image, and how well that is known."""

import numpy as np
import pytest

from calib_ros.errors import InputError
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.resection import board_poses, uncertainty
from calib_ros.kinematics import se3
from calib_ros.kinematics.lens import Lens

LENS = Lens(900.0, 950.0, 320.0, 240.0, -0.1, 0.05, 0.001, -0.002)
BOARD = np.array([[0.03 * column, 0.04 * row, 0.0] for row in range(3) for column in range(4)])
POSES = se3.transform(
    se3.exp_rotation(np.array([[0.2, -0.3, 0.4], [-0.5, 0.1, 0.2]])),
    np.array([[0.05, -0.05, 0.5], [-0.1, 0.05, 0.6]]),
)


def pixels_of(pose, corners=BOARD):
    return LENS.project(pose[:3, :3] @ corners.T + pose[:3, 3:])[0].T


def images(*corners):
    """Return images of the first so many corners of a board, one at each pose."""
    index = np.repeat(np.arange(len(corners)), corners)
    pixels = [pixels_of(pose, BOARD[:n]) for pose, n in zip(POSES, corners, strict=False)]
    points = np.concatenate([BOARD[:n] for n in corners])
    return Observations.from_pixels(
        np.zeros((len(index), 2)), np.concatenate(pixels), points, index
    )


def test_boards_are_where_their_corners_say():
    found = board_poses(images(12, 7), LENS)
    np.testing.assert_allclose(found.positions, POSES[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(found.rotations, POSES[:, :3, :3], atol=1e-8)
    assert found.oriented.all()
    assert found.pixels is None


def test_images_of_a_line_of_corners_are_left_out():
    found = board_poses(images(12, 4), LENS)
    np.testing.assert_allclose(found.positions, POSES[:1, :3, 3], atol=1e-9)
    with pytest.raises(InputError, match='no image shows 4 board points that are not in line'):
        board_poses(images(4, 3), LENS)


def test_corners_that_fit_no_board_are_refused():
    seen = images(12, 12)
    mixed = np.random.default_rng(0).permutation(24)
    with pytest.raises(InputError, match='the corners do not fit the board in 2 of 2 images'):
        board_poses(seen.changed(pixels=seen.pixels[mixed]), LENS)


def test_the_uncertainty_of_a_board_is_that_of_its_pose_by_noise_of_a_pixel():
    found = uncertainty(images(12, 7), POSES, LENS)
    for pose, corners, covariance in zip(POSES, (12, 7), found, strict=True):
        step, columns = 1e-6, []
        for twist in step * np.eye(6):
            ends = []
            for sign in (1.0, -1.0):
                moved = pose.copy()
                moved[:3, :3] = se3.exp_rotation(sign * twist[3:]) @ pose[:3, :3]
                moved[:3, 3] += sign * twist[:3]
                ends.append(pixels_of(moved, BOARD[:corners]))
            columns.append((ends[0] - ends[1]).ravel() / (2.0 * step))
        rows = np.array(columns)
        np.testing.assert_allclose(covariance @ (rows @ rows.T), np.eye(6), atol=1e-4)
