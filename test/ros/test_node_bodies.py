# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A real node that hears a motion capture system; its messages are built for these tests."""

import os

import numpy as np
import pytest

if 'CI' not in os.environ:
    pytest.importorskip('mocap4r2_msgs.msg', reason='make test builds it')

from mocap4r2_msgs.msg import Marker, RigidBodies, RigidBody
from ros_cell import Cell, direct, joint_messages, pose_messages

SOURCE = '/rigid_bodies type=RigidBodies parent=tracker child=4'


def bodies(recording):
    """Return the measured poses, each beside a body that stands still and one that is lost."""
    found = []
    for message in pose_messages(recording.poses):
        tool = RigidBody(rigid_body_name='4', markers=[Marker()] * 4, pose=message.pose)
        still, lost = RigidBody(rigid_body_name='1'), RigidBody(rigid_body_name='2')
        lost.pose.orientation.w = 0.0
        found.append(RigidBodies(header=message.header, rigidbodies=[still, lost, tool]))
    return found


def test_a_body_is_measured_as_a_pose_would_be(tmp_path, recording):
    with Cell(chain='ur10e', sources=[SOURCE], data_dir=str(tmp_path)) as cell:
        cell.play({'/rigid_bodies': bodies(recording), 'joint_states': joint_messages(recording)})
        live, expected = cell.node.session, direct(recording)
        assert live.account() == expected.account()
        assert {each.target for each in live.samples} == {'4'}
        for name in ('stamps_ns', 'joints', 'positions', 'rotations'):
            np.testing.assert_array_equal(
                getattr(live.problem().observations, name),
                getattr(expected.problem().observations, name),
            )
