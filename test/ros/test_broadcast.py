# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The frames found on /tf_static; tf2_msgs comes with ROS, and without is built for the tests."""

import os
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

if 'CI' not in os.environ:
    pytest.importorskip('tf2_msgs.msg', reason='make test builds it')

from ros_cell import Cell, true_arm
from tf2_msgs.msg import TFMessage
from urdfs import UR10E, by_kinpy

from calib_ros.apply.simulation import Cell as SimulatedCell, faulty
from calib_ros.errors import ConfigError
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import dump_chain
from calib_ros.kinematics.corrected_urdf import corrected_urdf
from calib_ros.kinematics.urdf import chain_from_urdf
from calib_ros.ros.broadcast import Broadcast

NAMES = {'base_frame': 'base_link', 'flange_frame': 'tool0', 'target_frame': 'ball'}


def transforms(message):
    """Return matrices by (parent, child)."""
    found = {}
    for each in message.transforms:
        shift, turn = each.transform.translation, each.transform.rotation
        rotation = se3.from_quat(np.array([turn.x, turn.y, turn.z, turn.w]))
        matrix = se3.transform(rotation, np.array([shift.x, shift.y, shift.z]))
        found[each.header.frame_id, each.child_frame_id] = matrix
    return found


def test_nothing_is_published_and_tf2_msgs_not_needed_without_names(monkeypatch):
    for name in ('tf2_msgs', 'tf2_msgs.msg'):
        monkeypatch.setitem(sys.modules, name, None)
    with Cell(chain='ur10e') as cell:
        assert '/tf_static' not in {each.topic_name for each in cell.node.publishers}
        with pytest.raises(ConfigError, match='apt install ros-jazzy-tf2-msgs'):
            cell.start(namespace='other', chain='ur10e', base_frame='base')


def test_a_calibration_that_is_loaded_is_broadcast(tmp_path):
    truth = true_arm()
    path = tmp_path / 'calibration.yaml'
    path.write_text(dump_chain(truth, {'world_frame': 'leica'}))
    given = NAMES | {'data_dir': str(tmp_path), 'calibration_filename': path.name}
    with Cell() as cell:
        heard = cell.listen(TFMessage, '/tf_static')
        cell.start(chain='ur10e', **given)
        cell.spin_until(lambda: heard)
        cell.done('load')
        cell.spin_until(lambda: len(heard) == 2)
    found = transforms(heard[0])
    assert set(found) == {('leica', 'base_link'), ('tool0', 'ball')}
    for key, frame in (('leica', 'base_link'), 'base'), (('tool0', 'ball'), 'tool'):
        np.testing.assert_allclose(found[key], truth.frame(frame).matrix, rtol=0, atol=1e-12)


def broadcast(chain, world='leica', in_hand=False, urdf='', outdated=(), **names):
    given = SimpleNamespace(links={}, **(NAMES | names))
    owners = {'base': ('', in_hand, False, '')}
    more = {'world_frame': world, 'owners': owners, 'record': {'outdated': outdated}}
    with Cell() as cell:
        heard = cell.listen(TFMessage, '/tf_static')
        Broadcast(cell.peer, given, urdf).publish(Calibration(chain, chain, **more))
        cell.spin_until(lambda: heard)
    return transforms(heard[0])


def test_with_a_urdf_the_chain_of_frames_leads_to_the_target(rng):
    """World to base_link, along the corrected URDF to tool0, and on to the target."""
    nominal = replace(chain_from_urdf(UR10E), base=None, tool=None)
    chain = faulty(nominal, SimulatedCell(), rng)
    found = broadcast(chain, urdf=UR10E)
    q = chain.random_joints(10, rng)
    text = corrected_urdf(UR10E, chain)
    arm = by_kinpy(text, chain.joint_names, q, 'base_link', 'tool0')
    reached = found['leica', 'base_link'] @ arm @ found['tool0', 'ball']
    np.testing.assert_allclose(reached, chain.forward(q), rtol=0, atol=1e-9)


def test_a_camera_on_the_flange_sees_a_target_that_stands():
    chain = replace(true_arm(), tool=Frame(np.eye(4)))
    found = broadcast(chain, world='camera', in_hand=True)
    assert set(found) == {('ball', 'base_link'), ('tool0', 'camera')}


def test_frames_without_a_name_of_their_own_are_left_out():
    """A frame that is its own parent, or has two, would be an error in every listener."""
    chain = true_arm()
    assert set(broadcast(chain, world='tool0')) == {('tool0', 'ball')}
    assert set(broadcast(chain, 'base_link', in_hand=True)) == {('ball', 'base_link')}
    assert set(broadcast(chain, 'ball')) == set()
    assert set(broadcast(chain, world='base_link')) == {('tool0', 'ball')}
    assert set(broadcast(chain, 'tool0', in_hand=True)) == {('ball', 'base_link')}
    assert set(broadcast(chain, base_frame='')) == {('tool0', 'ball')}
    assert set(broadcast(chain, flange_frame='')) == {('leica', 'base_link')}
    assert set(broadcast(chain, world='')) == {('tool0', 'ball')}
    assert set(broadcast(chain, outdated=('base', 'base_wire'))) == {('tool0', 'ball')}
    assert len(broadcast(chain, outdated=('base, tool',))) == 2  # one frame of that name
    with pytest.raises(ConfigError, match='must be different, not tool0, tool0, ball'):
        broadcast(chain, base_frame='tool0')
