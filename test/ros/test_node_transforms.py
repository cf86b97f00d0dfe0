# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A real node that hears /tf; tf2_msgs comes with ROS, and is built for these tests without."""

import itertools
import os
import sys

import numpy as np
import pytest

if 'CI' not in os.environ:
    pytest.importorskip('tf2_msgs.msg', reason='make test builds it')

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from ros_cell import LATCHED, Cell, direct, header, joint_messages
from tf2_msgs.msg import TFMessage

from calib_ros.errors import ConfigError
from calib_ros.kinematics import se3
from calib_ros.ros import inputs as inputs_module
from calib_ros.ros.inputs import TopicState

SOURCE = '/tf parent=tracker child=tool'
TRACKER = se3.transform(se3.exp_rotation(np.array([0.3, -0.2, 1.0])), np.array([2.0, 1.0, 0.5]))


def link(parent, child, stamp, matrix):
    x, y, z = matrix[:3, 3].tolist()
    turn = dict(zip(('x', 'y', 'z', 'w'), se3.to_quat(matrix[:3, :3]).tolist(), strict=True))
    return TransformStamped(
        header=header(stamp, parent),
        child_frame_id=child,
        transform=Transform(translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(**turn)),
    )


def still():
    """Return where the tracker is, and what else stands still."""
    return TFMessage(
        transforms=[link('hall', 'tracker', 0, TRACKER), link('hall', 'base_link', 0, np.eye(4))]
    )


def moving(recording):
    """Return the measured poses among the frames of the robot."""
    poses = TRACKER @ se3.transform(recording.poses.rotations, recording.poses.positions)
    names = ['base_link', *(f'link_{k}' for k in range(1, 29))]
    frames = [se3.transform(se3.exp_rotation(np.full(3, 0.1 * k)), np.ones(3)) for k in range(29)]
    found = []
    for stamp, pose in zip(recording.poses.stamps_ns.tolist(), poses, strict=True):
        robot = [
            link(*pair, stamp, matrix)
            for pair, matrix in zip(itertools.pairwise(names), frames, strict=False)
        ]
        found.append(TFMessage(transforms=[*robot, link('hall', 'tool', stamp, pose), *robot]))
    return found


def test_a_link_is_measured_as_a_pose_would_be(tmp_path, recording):
    with Cell(chain='ur10e', sources=[SOURCE], data_dir=str(tmp_path)) as cell:
        latched = cell.peer.create_publisher(TFMessage, '/tf_static', LATCHED)
        latched.publish(still())
        cell.play({'/tf': moving(recording), 'joint_states': joint_messages(recording)})
        live = cell.node.session
        found, expected = (each.problem().observations for each in (live, direct(recording)))
        assert live.account().dropped == {}
    np.testing.assert_array_equal(found.stamps_ns, expected.stamps_ns)
    np.testing.assert_allclose(found.positions, expected.positions, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.rotations, expected.rotations, rtol=0, atol=1e-12)


def test_the_diagnostics_tell_which_frames_are_there(tmp_path, recording):
    source = '/tf parent=hall child=tol'
    with Cell(chain='ur10e', sources=[source], data_dir=str(tmp_path)) as cell:
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        publisher = cell.publisher(TFMessage, '/tf')
        for message in moving(recording)[:5]:
            publisher.publish(message)
        cell.spin_until(lambda: any('nothing links' in m.status[0].message for m in heard))
        words = heard[-1].status[0].message
        assert 'nothing links frame "tol" to "hall" on /tf' in words
        assert 'parent=hall child=tool"' in words


def test_without_the_messages_it_is_said_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', None)
    monkeypatch.setenv('ROS_DISTRO', 'jazzy')
    with (
        pytest.raises(ConfigError, match='tf2_msgs cannot be imported, install ros-jazzy'),
        Cell(chain='ur10e', sources=[SOURCE], data_dir=str(tmp_path)),
    ):
        pass


@pytest.mark.parametrize(('latched', 'every'), [(False, 0.1), (True, 0.1), (False, 2.0)])
def test_frames_that_stand_still_and_single_shots_may_be_silent(monkeypatch, latched, every):
    monkeypatch.setattr(inputs_module, 'SILENCE', 5.0)
    hearing = TopicState(latched=latched)
    for now in (-100.0, -100.0 + 5.0 * every):
        hearing.count += 1
        hearing.look(now, 0.5)
    assert hearing.rate == 2.0
    assert hearing.silent is (every < 1.0 and not latched)
