# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The robot's own description in, and the corrected one out."""

import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from ros_cell import LATCHED, STOPS, Cell, joint_messages, shift, topics, true_arm
from std_msgs.msg import String

from calib_ros.errors import ConfigError
from calib_ros.files.export import kinematics_yaml
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.urdf import chain_from_urdf
from calib_ros.ros import parameters as parameters_module

TABLES = {f'dh_{form}.{kind}' for form in ('standard', 'modified') for kind in ('csv', 'yaml')}
TABLES |= {'kinematics.yaml', 'dh_without_beta.csv', 'joint_offsets.csv', 'ur_kinematics.yaml'}


def urdf_of(chain):
    """Return the URDF of a chain, written from its kinematics file."""
    poses = yaml.safe_load(kinematics_yaml(chain))['kinematics']
    joints, parent = [], 'base_link'
    for name, pose in poses.items():
        kind = 'fixed' if name == 'flange' else 'revolute'
        xyz = ' '.join(repr(pose[k]) for k in 'xyz')
        rpy = ' '.join(repr(pose[k]) for k in ('roll', 'pitch', 'yaw'))
        joints.append(
            f'<link name="{name}_link"/><joint name="{name}" type="{kind}">'
            f'<parent link="{parent}"/><child link="{name}_link"/><axis xyz="0 0 1"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/>'
            '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        )
        parent = f'{name}_link'
    return f'<robot name="ur10e"><link name="base_link"/>{"".join(joints)}</robot>'


def test_the_robot_describes_itself_and_gets_a_corrected_description(tmp_path):
    text = urdf_of(load_chain('ur10e'))
    with Cell() as cell:
        cell.peer.create_publisher(String, 'robot_description', LATCHED).publish(String(data=text))
        cell.node = cell.start(chain='robot_description', data_dir=str(tmp_path))
        chain = cell.node.session.chain
        assert chain.joint_names == load_chain('ur10e').joint_names
        assert chain.joints[0].upper == 3.0
        assert chain.base is None
        refused = cell.refused('export')
        assert 'no calibration to export' in refused.message
        truth = true_arm()
        cell.play(topics(shift(truth)))
        cell.done('identify')
        answer = cell.done('export')
        (folder,) = [path for path in tmp_path.iterdir() if path.is_dir()]
        assert answer.message == f'{len(TABLES) + 1} files exported to {folder}'
        assert {path.name for path in folder.iterdir()} == TABLES | {'corrected.urdf'}
        corrected = chain_from_urdf((folder / 'corrected.urdf').read_text())
        calibrated = cell.node.session.calibration.chain
        q = truth.random_joints(100, np.random.default_rng(3))
        arm = replace(calibrated, base=chain_from_urdf(text).base, tool=chain_from_urdf(text).tool)
        np.testing.assert_allclose(corrected.forward(q), arm.forward(q), rtol=0, atol=1e-9)


def test_a_description_that_does_not_come_is_missed(tmp_path, monkeypatch):
    monkeypatch.setattr(parameters_module, 'DESCRIPTION_WAIT', 0.2)
    with Cell() as cell:
        told = cell.log()
        with pytest.raises(ConfigError, match='no robot_description arrived within'):
            cell.start(['__ns:=/cell_2'], chain='robot_description', data_dir=str(tmp_path))
        cell.peer.create_publisher(String, '/robot_description', 1)
        with pytest.raises(
            ConfigError, match='publisher of /robot_description, which must latch it'
        ):
            cell.start(chain='robot_description', data_dir=str(tmp_path))
        said = 'waiting up to 0.2 s for /cell_2/robot_description'
        cell.spin_until(lambda: said in [each.msg for each in told])


def test_the_two_arms_of_one_description_keep_their_files_apart(tmp_path, recording):
    """The second one continued with the poses of the first."""
    text = urdf_of(load_chain('ur10e')).removesuffix('</robot>').partition('>')[2]
    arms = ''.join(
        f'<joint name="{side}_mount" type="fixed"><parent link="world"/>'
        f'<child link="{side}_base_link"/></joint>'
        + re.sub('name="|link="', rf'\g<0>{side}_', text)
        for side in ('left', 'right')
    )
    path = tmp_path / 'two_arms.urdf'
    path.write_text(f'<robot name="two"><link name="world"/>{arms}</robot>')
    given = {'chain': str(path), 'data_dir': str(tmp_path / 'data'), 'resume': True}
    for side, expected in (('left', 0), ('right', 0), ('left', STOPS), ('right', 0)):
        with Cell(**given, tip_link=f'{side}_flange_link') as cell:
            assert len(cell.node.session.samples) == expected
            if side == 'left' and not expected:
                joints = joint_messages(recording, cell.node.session.joint_names)
                cell.play(topics(recording, joint_states=joints))
