# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The launch files, evaluated by a stand-in of launch, which is not on PyPI."""

import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import rclpy
import yaml
from hypothesis import given
from hypothesis import strategies as st
from rclpy.node import Node as RosNode
from ros_cell import Cell

from calib_ros.errors import CalibrationError, ConfigError, UnknownNameError
from calib_ros.ros.arguments import (
    NODE,
    PARAMETERS,
    REMAPPED,
    launch_arguments,
    refuse_unknown,
    ros_arguments,
    rviz_config,
)
from calib_ros.sampling.sources import STANDARD

ROOT = Path(__file__).parents[2]
OTHERS = {'start_type_description_service'}
"""Parameters that every node has and no operator sets."""


class Action:
    """What a launch file returns, with the arguments that it was made with."""

    def __init__(self, *args, **kwargs):
        for name in kwargs:
            assert name in self.KEYWORDS, f'{type(self).__name__} takes no {name}'
        self.args, self.kwargs = args, kwargs


def action(name, *keywords):
    return type(name, (Action,), {'KEYWORDS': keywords})


ACTIONS = {
    'launch': {
        'LaunchContext': object,
        'LaunchDescription': list,
        'LaunchDescriptionEntity': Action,
    },
    'launch.actions': {
        'DeclareLaunchArgument': action('DeclareLaunchArgument', 'default_value', 'description'),
        'LogInfo': action('LogInfo', 'msg'),
        'OpaqueFunction': action('OpaqueFunction', 'function'),
        'RegisterEventHandler': action('RegisterEventHandler'),
        'TimerAction': action('TimerAction', 'period', 'actions'),
    },
    'launch.event_handlers': {
        'OnProcessExit': action('OnProcessExit', 'target_action', 'on_exit')
    },
    'launch_ros': {},
    'launch_ros.actions': {
        'Node': action(
            'Node',
            *('package', 'executable', 'name', 'namespace', 'parameters', 'remappings'),
            *('ros_arguments', 'arguments', 'output'),
        )
    },
    'launch_ros.parameter_descriptions': {
        'ParameterValue': action('ParameterValue', 'value_type')
    },
}


@pytest.fixture
def launched(monkeypatch):
    """Return a function that evaluates a launch file, and returns its actions."""
    for name, content in ACTIONS.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)

    def launch(name, **arguments):
        path = ROOT / name if '/' in name else ROOT / 'launch' / name
        words = [f'{key}:={value}' for key, value in arguments.items()]
        monkeypatch.setattr(sys, 'argv', ['ros2', 'launch', 'calib_ros', name, *words])
        space = {'__file__': str(path), '__name__': 'launched'}
        exec(compile(path.read_text(), path, 'exec'), space)
        *declared, start = space['generate_launch_description']()
        defaults = {each.args[0]: each.kwargs['default_value'] for each in declared}
        assert all(each.kwargs['description'] for each in declared)
        context = SimpleNamespace(launch_configurations=defaults | arguments, is_shutdown=False)
        return start.kwargs['function'](context), context

    return launch


def nodes(actions):
    return {
        each.kwargs['executable']: each.kwargs for each in actions if 'executable' in each.kwargs
    }


def parameters_of(words, name='calibration_node'):
    """Return the parameters that a real node gets by ROS arguments."""
    context = rclpy.Context()
    rclpy.init(context=context, args=[])
    node = RosNode(
        name,
        context=context,
        cli_args=['--ros-args', *words, '--'],
        automatically_declare_parameters_from_overrides=True,
        start_parameter_services=False,
    )
    try:
        found = {key: each.value for key, each in node.get_parameters_by_prefix('').items()}
        return {
            key: list(value) if isinstance(PARAMETERS.get(key, node).default, tuple) else value
            for key, value in found.items()
            if key in PARAMETERS
        }
    finally:
        node.destroy_node()
        context.try_shutdown()


def test_what_is_not_given_is_not_passed(launched):
    (node,), _ = launched('calibration.launch.py')
    assert node.kwargs['ros_arguments'] == []
    assert node.kwargs['namespace'] is None
    assert node.kwargs['package'] == 'calib_ros'
    assert node.kwargs['executable'] == node.kwargs['name'] == 'calibration_node'


def test_the_launch_file_names_what_is_there():
    assert f'{NODE} = calib_ros.ros.node:main' in (ROOT / 'setup.py').read_text()
    assert set(REMAPPED) <= {source.topic for source in STANDARD} | {'joint_states'}


def test_the_parameter_file_holds_where_no_argument_is_given(launched, tmp_path):
    path = tmp_path / 'node.yaml'
    given = {'chain': 'ur10e', 'serial': '7', 'priors': ['*.a=0.001'], 'max_gap': 0.2}
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': given}}))
    (node,), _ = launched('calibration.launch.py', params_file=str(path))
    assert parameters_of(node.kwargs['ros_arguments']) == given | {'use_sim_time': False}
    (node,), _ = launched(
        'calibration.launch.py', params_file=str(path), serial='0012', max_gap='1'
    )
    found = parameters_of(node.kwargs['ros_arguments'])
    assert found == given | {'serial': '0012', 'max_gap': 1.0, 'use_sim_time': False}


def test_arguments_reach_a_node_of_a_namespace_whose_file_names_it(launched, tmp_path):
    path = tmp_path / 'node.yaml'
    given = {'chain': 'ur10e', 'serial': '7'}
    path.write_text(yaml.safe_dump({'calibration_node': {'ros__parameters': given}}))
    (node,), _ = launched('calibration.launch.py', params_file=str(path), serial='8')
    assert parameters_of(node.kwargs['ros_arguments'])['serial'] == '8'


def test_every_type_arrives(launched):
    (node,), _ = launched(
        'calibration.launch.py',
        chain='/robots/my arm: "left".yaml',
        resume='True',
        use_sim_time='true',
        folds='7',
        settle='1',
        still='1e-05',
        marker_scale='100',
        priors='*.a=0.001',
        sources="['/tracker/left device=tracker', '/wire type=Range']",
        namespace='cell_1',
        joint_states='/ur/joint_states',
        measured_pose='tracker/pose',
    )
    words = node.kwargs['ros_arguments']
    assert node.kwargs['namespace'] == 'cell_1'
    assert [word for flag, word in zip(words[::2], words[1::2], strict=True) if flag == '-r'] == [
        'joint_states:=/ur/joint_states',
        'measured_pose:=tracker/pose',
    ]
    assert parameters_of(words) == {
        'chain': '/robots/my arm: "left".yaml',
        'resume': True,
        'use_sim_time': True,
        'folds': 7,
        'settle': 1.0,
        'still': 1e-5,
        'marker_scale': 100.0,
        'priors': ['*.a=0.001'],
        'sources': ['/tracker/left device=tracker', '/wire type=Range'],
    }


@given(st.text(st.characters(codec='utf-8', exclude_characters='\0'), min_size=1, max_size=30))
def test_text_arrives_as_it_is(text):
    _, word = ros_arguments({'serial': text})
    assert yaml.safe_load(word.partition(':=')[2]) == text


@pytest.mark.parametrize('text', ['0012', 'true', '1e3', "it's", 'a: b #c', '[x]', 'é\\', '', '~'])
def test_ros_takes_text_for_text(text):
    assert parameters_of(ros_arguments({'serial': text})).get('serial', '') == text


@pytest.mark.parametrize(
    ('name', 'text', 'expected'),
    [
        ('resume', 'maybe', 'true or false'),
        ('folds', '2.5', 'a whole number'),
        ('settle', 'long', 'a number'),
        ('priors', '[1, 2]', 'a list of texts'),
    ],
)
def test_values_of_another_type_are_refused(name, text, expected):
    with pytest.raises(ConfigError, match=f'"{name}" must be {expected}'):
        ros_arguments({name: text})


def test_a_parameter_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(CalibrationError, match='there is no file'):
        ros_arguments({'params_file': str(tmp_path / 'none.yaml')})


def test_every_parameter_of_the_node_is_an_argument():
    with Cell(chain='ur10e') as cell:
        declared = {
            name: cell.node.get_parameter(name).value
            for name in cell.node.get_parameters_by_prefix('')
            if name not in OTHERS and not name.startswith('qos_overrides.')
        }
    assert set(declared) == set(PARAMETERS)
    assert set(PARAMETERS) < set(launch_arguments())
    for name, value in declared.items():
        default = PARAMETERS[name].default
        assert type(value) is (list if isinstance(default, tuple) else type(default)), name


def test_an_argument_that_does_not_exist_is_refused(launched):
    with pytest.raises(UnknownNameError, match='did you mean "resume"'):
        launched('calibration.launch.py', chain='ur10e', resum='true')
    with pytest.raises(UnknownNameError, match='did you mean "tracker"'):
        launched('cell.launch.py', traker='driver/node')


@pytest.mark.parametrize('name', ['README.md', 'docs/node.md'])
def test_launch_commands_in_the_documents_are_valid(name):
    commands = re.findall(
        r'ros2 launch calib_ros (\S+)((?: +\S+:=\S+)*)', (ROOT / name).read_text()
    )
    assert commands
    for file, words in commands:
        own = re.findall(r"^    '(\w+)': \(", (ROOT / 'launch' / file).read_text(), re.MULTILINE)
        for argument in re.findall(r'(\S+):=', words):
            assert argument in {*launch_arguments(), *own}, f'{file} has no {argument}'


def test_arguments_of_another_launch_file_that_includes_ours_are_its_own():
    command = ['ros2', 'launch', 'my_cell', 'all.launch.py', 'gripper:=true']
    refuse_unknown(command, 'calibration.launch.py', ['chain'])


def test_a_cell_has_all_that_belongs_to_it(launched, tmp_path):
    urdf = tmp_path / 'robot.urdf'
    urdf.write_text('<robot name="arm"/>')
    actions, _ = launched(
        'cell.launch.py',
        urdf=str(urdf),
        tracker='vicon/driver',
        namespace='cell_1',
        joint_states='/ur/joint_states',
        frame_id='vicon',
    )
    found = nodes(actions)
    assert set(found) == {
        *('calibration_node', 'robot_state_publisher', 'driver', 'aggregator_node', 'rviz2')
    }
    described = found['robot_state_publisher']['parameters'][0]['robot_description']
    assert described.args == ('<robot name="arm"/>',)
    assert described.kwargs == {'value_type': str}
    assert found['robot_state_publisher']['remappings'] == [('joint_states', '/ur/joint_states')]
    assert found['driver']['package'] == 'vicon'
    assert found['driver']['remappings'] == [('pose', 'measured_pose')]
    words = found['calibration_node']['ros_arguments']
    assert parameters_of(words)['chain'] == 'robot_description'
    for name in ('robot_state_publisher', 'driver', 'calibration_node'):
        assert found[name]['namespace'] == 'cell_1'
    (aggregated,) = found['aggregator_node']['parameters']
    (analyzers,) = yaml.safe_load(Path(aggregated).read_text()).values()
    assert analyzers['ros__parameters']['calibration']['contains'] == ['calibration_node']
    flag, shown = found['rviz2']['arguments']
    manager = yaml.safe_load(Path(shown).read_text())['Visualization Manager']
    Path(shown).unlink()
    assert flag == '-d'
    assert manager['Global Options']['Fixed Frame'] == 'vicon'
    assert '/cell_1/calibration_node/residuals' in str(manager['Displays'])


def test_a_driver_needs_its_package(launched):
    with pytest.raises(ConfigError, match='must be PACKAGE/EXECUTABLE'):
        launched('cell.launch.py', chain='ur10e', tracker='driver')


def test_the_chain_of_a_parameter_file_holds_beside_a_urdf(launched, tmp_path):
    urdf, path = tmp_path / 'robot.urdf', tmp_path / 'node.yaml'
    urdf.write_text('<robot name="arm"/>')
    path.write_text('/**: {ros__parameters: {chain: ur10e}}')
    quiet = {'rviz': 'false', 'diagnostics': 'false'}
    actions, _ = launched('cell.launch.py', urdf=str(urdf), params_file=str(path), **quiet)
    words = nodes(actions)['calibration_node']['ros_arguments']
    assert parameters_of(words)['chain'] == 'ur10e'


def test_parts_of_a_cell_can_be_left_out(launched):
    actions, _ = launched('cell.launch.py', chain='ur10e', rviz='false', diagnostics='false')
    found = nodes(actions)
    assert set(found) == {'calibration_node'}
    assert parameters_of(found['calibration_node']['ros_arguments'])['chain'] == 'ur10e'


def test_a_node_that_was_killed_goes_on_with_its_samples(launched):
    quiet = {'rviz': 'false', 'diagnostics': 'false'}
    actions, context = launched('cell.launch.py', chain='ur10e', serial='0012', **quiet)
    for _ in range(2):  # it may be killed again
        handler = next(each for each in actions if type(each).__name__ == 'RegisterEventHandler')
        exited = handler.args[0].kwargs
        assert exited['target_action'] in actions
        for status in (0, 1):
            assert exited['on_exit'](SimpleNamespace(returncode=status), context) == []
        said, timer = exited['on_exit'](SimpleNamespace(returncode=-9), context)
        assert 'signal 9' in said.kwargs['msg']
        actions = timer.kwargs['actions']
        words = nodes(actions)['calibration_node']['ros_arguments']
        found = parameters_of(words)
        assert (found['resume'], found['serial'], found['chain']) == (True, '0012', 'ur10e')
    context.is_shutdown = True
    assert exited['on_exit'](SimpleNamespace(returncode=-9), context) == []


def test_the_example_feeds_the_corrected_urdf_to_all(launched, tmp_path, monkeypatch):
    urdf = tmp_path / 'robot_corrected.urdf'
    urdf.write_text('<robot name="corrected"/>')
    name = 'examples/corrected_arm.launch.py'
    (published,), _ = launched(name, urdf=str(urdf))
    assert published.kwargs['parameters'][0]['robot_description'].args == (urdf.read_text(),)

    def builder(robot, package_name):
        configured = {'robot_description': 'nominal', 'robot': robot, 'package': package_name}
        return SimpleNamespace(
            to_moveit_configs=lambda: SimpleNamespace(to_dict=lambda: configured)
        )

    module = ModuleType('moveit_configs_utils')
    module.MoveItConfigsBuilder = builder
    monkeypatch.setitem(sys.modules, 'moveit_configs_utils', module)
    actions, _ = launched(name, urdf=str(urdf), moveit_robot='ur', moveit_package='ur_moveit')
    configured, solvers, last = nodes(actions)['move_group']['parameters']
    assert (configured['robot'], configured['package']) == ('ur', 'ur_moveit')
    assert last['robot_description'].args == (urdf.read_text(),)
    (content,) = yaml.safe_load(Path(solvers).read_text()).values()
    assert 'robot_description_kinematics' in content['ros__parameters']


def test_the_example_moves_nothing_until_it_is_asked_to(launched):
    name = 'examples/compensated_controller.launch.py'
    given = {'chain': 'ur10e', 'calibration': '/data/ur10e.yaml'}
    (node,), _ = launched(name, **given)
    parameters = parameters_of(node.kwargs['ros_arguments'])
    assert parameters['calibration_filename'] == '/data/ur10e.yaml'
    assert parameters['allowed_folders'] == ['/data']
    assert dict(node.kwargs['remappings']) == {
        '~/joint_trajectory': '/planned_trajectory',
        '~/compensated_joint_trajectory': '/compensated_trajectory',
    }
    (node,), _ = launched(name, **given, execute='true')
    assert dict(node.kwargs['remappings']) == {
        '~/joint_trajectory': '/planned_trajectory',
        '~/compensated_joint_trajectory': '/joint_trajectory_controller/joint_trajectory',
    }


def test_a_real_node_passes_corrected_trajectories_by_the_remapped_topics():
    remap = (
        '~/joint_trajectory:=/planned',
        '~/compensated_joint_trajectory:=/jtc/joint_trajectory',
    )
    with Cell() as cell:
        node = cell.start(remap=remap, chain='ur10e')
        assert '/jtc/joint_trajectory' in {each.topic_name for each in node.publishers}
        assert '/planned' in {
            name for name, _ in node.get_subscriber_names_and_types_by_node(NODE, '/')
        }


@pytest.mark.parametrize('namespace', ['', '/', 'cell_1', '/line/cell_1/'])
def test_rviz_follows_the_namespace(namespace):
    text = (ROOT / 'config/calibration.rviz').read_text()
    before, after = (yaml.safe_load(each) for each in (text, rviz_config(text, namespace)))
    above = '/' + namespace.strip('/') if namespace.strip('/') else ''
    pairs = zip(
        before['Visualization Manager']['Displays'],
        after['Visualization Manager']['Displays'],
        strict=True,
    )
    for old, new in pairs:
        for key in ('Topic', 'Description Topic'):
            if key in old:
                assert new[key].pop('Value') == above + old[key].pop('Value')
        assert new == old
