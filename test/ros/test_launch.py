# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The launch file of the node, and the arguments that reach it."""

import re

import pytest
import yaml
from launching import ROOT, parameters_of

from calib_ros.errors import CalibrationError, ConfigError, UnknownNameError
from calib_ros.ros.arguments import NODE, REMAPPED, launch_arguments, refuse_unknown, ros_arguments
from calib_ros.sampling.sources import STANDARD


def test_what_is_not_given_is_not_passed(launched):
    (node,), _ = launched('calibration.launch.py')
    assert node.kwargs['ros_arguments'] == []
    assert node.kwargs['namespace'] is None
    assert node.kwargs['package'] == 'calib_ros'
    assert node.kwargs['executable'] == node.kwargs['name'] == 'calibration_node'


def test_the_launch_file_names_what_is_there():
    assert f'{NODE} = calib_ros.start:node' in (ROOT / 'setup.py').read_text()
    assert set(REMAPPED) <= {source.topic for source in STANDARD} | {'joint_states'}


@pytest.mark.parametrize('named', ['/**', 'calibration_node'])
def test_the_parameter_file_holds_where_no_argument_is_given(launched, tmp_path, named):
    path = tmp_path / 'node.yaml'
    given = {'chain': 'ur10e', 'serial': '7', 'priors': ['*.a=0.001'], 'max_gap': 0.2}
    path.write_text(yaml.safe_dump({named: {'ros__parameters': given}}))
    (node,), _ = launched('calibration.launch.py', params_file=str(path))
    assert parameters_of(node.kwargs['ros_arguments']) == given | {'use_sim_time': False}
    (node,), _ = launched(
        'calibration.launch.py', params_file=str(path), serial='0012', max_gap='1'
    )
    found = parameters_of(node.kwargs['ros_arguments'])
    assert found == given | {'serial': '0012', 'max_gap': 1.0, 'use_sim_time': False}


TYPED = {
    'chain': ('/robots/my arm: "left".yaml', '/robots/my arm: "left".yaml'),
    'resume': ('True', True),
    'use_sim_time': ('true', True),
    'folds': ('7', 7),
    'settle': ('1', 1.0),
    'still': ('1e-05', 1e-5),
    'marker_scale': ('100', 100.0),
    'priors': ('*.a=0.001', ['*.a=0.001']),
    'sources': ("['/left device=a', '/w type=Range']", ['/left device=a', '/w type=Range']),
}


def test_every_type_arrives(launched):
    topics = {'joint_states': '/ur/joint_states', 'measured_pose': '/left'}
    given = {name: text for name, (text, _) in TYPED.items()}
    (node,), _ = launched('calibration.launch.py', **given, **topics, namespace='cell_1')
    words = node.kwargs['ros_arguments']
    assert node.kwargs['namespace'] == 'cell_1'
    assert [word for flag, word in zip(words[::2], words[1::2], strict=True) if flag == '-r'] == [
        f'{ours}:={theirs}' for ours, theirs in topics.items()
    ]
    assert parameters_of(words) == {name: value for name, (_, value) in TYPED.items()}


@pytest.mark.parametrize('text', ['0012', 'true', '1e3', "it's", 'a: b #c', '[x]', 'é\\', '', '~'])
def test_ros_takes_text_for_text(text):
    assert parameters_of(ros_arguments({'serial': text})).get('serial', '') == text


@pytest.mark.parametrize(
    ('name', 'text', 'expected'),
    [
        ('resume', 'maybe', 'true or false'),
        ('folds', '2.5', 'a whole number'),
        ('settle', 'long', 'a finite number'),
        ('priors', '[1, 2]', 'a list of strings'),
    ],
)
def test_values_of_another_type_are_refused(name, text, expected):
    with pytest.raises(ConfigError, match=f'"{name}" must be {expected}'):
        ros_arguments({name: text})


def test_a_parameter_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(CalibrationError, match='there is no file'):
        ros_arguments({'params_file': str(tmp_path / 'none.yaml')})


def test_an_argument_that_does_not_exist_is_refused(launched):
    with pytest.raises(UnknownNameError, match='did you mean "resume"'):
        launched('calibration.launch.py', chain='ur10e', resum='true')
    with pytest.raises(UnknownNameError, match='did you mean "tracker"'):
        launched('cell.launch.py', traker='driver/node')


@pytest.mark.parametrize('name', ['README.md', 'docs/node.md'])
def test_launch_commands_in_the_documents_are_valid(name):
    text = (ROOT / name).read_text()
    commands = re.findall(r'ros2 launch calib_ros (\S+)((?: +\S+:=\S+)*)', text)
    assert commands
    for file, words in commands:
        own = re.findall(r"^    '(\w+)': \(", (ROOT / 'launch' / file).read_text(), re.MULTILINE)
        for argument in re.findall(r'(\S+):=', words):
            assert argument in {*launch_arguments(), *own}, f'{file} has no {argument}'


def test_arguments_of_another_launch_file_that_includes_ours_are_its_own():
    command = ['ros2', 'launch', 'my_cell', 'all.launch.py', 'gripper:=true']
    refuse_unknown(command, 'calibration.launch.py', ['chain'])


@pytest.mark.parametrize('sources', ['/wire type=Range', "['/wire type=Range', '/b device=b']"])
def test_a_topic_that_other_sources_replace_is_refused(launched, sources):
    """It was remapped, and nothing heard it."""
    given = {'chain': 'ur10e', 'measured_pose': '/tracker/pose'}
    with pytest.raises(ConfigError, match='measured_pose:=/tracker/pose would not be heard'):
        launched('calibration.launch.py', sources=sources, **given)
    for name in ('/tracker/pose device=tracker', 'measured_pose device=tracker'):
        (node,), _ = launched('calibration.launch.py', sources=f"['/wire', '{name}']", **given)
        assert 'measured_pose:=/tracker/pose' in node.kwargs['ros_arguments']
