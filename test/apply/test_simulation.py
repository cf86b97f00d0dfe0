# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from calib_ros.apply.simulation import Cell, drive
from calib_ros.kinematics.chain_file import load_chain


def test_an_arm_is_driven_smoothly_from_stop_to_stop(rng):
    """By the polynomial of least jerk, whose greatest speed is 15 / 8 of the mean one."""
    stops, cell, start = load_chain('ur10e').random_joints(4, rng), Cell(), 10**18
    stamps, joints, pose_stamps = drive(stops, cell, start)
    at = np.searchsorted(stamps, pose_stamps)
    np.testing.assert_array_equal(joints[at], np.repeat(stops, cell.poses_per_dwell, axis=0))
    speeds = np.diff(joints, axis=0) / (1e-9 * np.diff(stamps)[:, np.newaxis])
    fastest = np.abs(np.diff(stops, axis=0)).max() / cell.move * 15.0 / 8.0
    assert np.abs(speeds).max() == pytest.approx(fastest, rel=0.01)
