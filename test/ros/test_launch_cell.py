# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The launch files of a whole cell and of the examples."""

import sys
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import yaml
from launching import ROOT, nodes, parameters_of

from calib_ros.errors import ConfigError
from calib_ros.ros.arguments import rviz_config

QUIET = {'rviz': 'false', 'diagnostics': 'false'}


def test_a_cell_has_all_that_belongs_to_it(launched, tmp_path, monkeypatch):
    ends = []
    monkeypatch.setattr('atexit.register', lambda *f, **k: ends.append(partial(*f, **k)))
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
    assert {each['namespace'] for each in found.values()} == {'cell_1'}  # another cell has others
    (aggregated,) = found['aggregator_node']['parameters']
    (analyzers,) = yaml.safe_load(Path(aggregated).read_text()).values()
    assert analyzers['ros__parameters']['calibration']['contains'] == ['calibration_node']
    flag, shown = found['rviz2']['arguments']
    manager = yaml.safe_load(Path(shown).read_text())['Visualization Manager']
    assert flag == '-d'
    for end in ends:
        end()
    assert not Path(shown).exists()
    assert manager['Global Options']['Fixed Frame'] == 'vicon'
    assert '/cell_1/calibration_node/residuals' in str(manager['Displays'])


def test_a_driver_needs_its_package(launched):
    with pytest.raises(ConfigError, match='must be PACKAGE/EXECUTABLE'):
        launched('cell.launch.py', chain='ur10e', tracker='driver')


def test_a_driver_that_no_source_hears_is_refused(launched):
    given = {'chain': 'ur10e', 'tracker': 'vicon/driver', **QUIET}
    with pytest.raises(ConfigError, match='measured_pose would not be heard'):
        launched('cell.launch.py', sources='/wire type=Range', **given)
    actions, _ = launched('cell.launch.py', sources='measured_pose device=vicon', **given)
    assert set(nodes(actions)) == {'calibration_node', 'driver'}
    given['namespace'] = 'cell'
    launched('cell.launch.py', sources='/cell/measured_pose device=vicon', **given)
    with pytest.raises(ConfigError, match='measured_pose would not be heard'):
        launched('cell.launch.py', sources='/measured_pose device=vicon', **given)


def test_the_chain_of_a_parameter_file_holds_beside_a_urdf(launched, tmp_path):
    urdf, path = tmp_path / 'robot.urdf', tmp_path / 'node.yaml'
    urdf.write_text('<robot name="arm"/>')
    path.write_text('/**: {ros__parameters: {chain: ur10e}}')
    actions, _ = launched('cell.launch.py', urdf=str(urdf), params_file=str(path), **QUIET)
    words = nodes(actions)['calibration_node']['ros_arguments']
    assert parameters_of(words)['chain'] == 'ur10e'


def test_a_node_that_was_killed_goes_on_with_its_samples(launched):
    actions, context = launched('cell.launch.py', chain='ur10e', serial='0012', **QUIET)
    assert set(nodes(actions)) == {'calibration_node'}
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


def test_a_delay_that_is_none_is_refused_at_the_start(launched):
    """The launch failed when the node was killed, rather than start it again."""
    said = 'launch argument "respawn_delay" must be a finite number, not \'2 s\''
    with pytest.raises(ConfigError, match=said):
        launched('cell.launch.py', chain='ur10e', respawn_delay='2 s', **QUIET)


@pytest.mark.parametrize('name', ['cell.launch.py', 'examples/corrected_arm.launch.py'])
def test_a_urdf_that_is_not_there_is_named_with_a_similar_one(launched, tmp_path, name):
    (tmp_path / 'robot.urdf').write_text('<robot name="arm"/>')
    path = tmp_path / 'robto.urdf'
    with pytest.raises(ConfigError, match=f'URDF {path}: .*: did you mean "robot.urdf"'):
        launched(name, urdf=str(path))


def test_the_example_feeds_the_corrected_urdf_to_all(launched, tmp_path, monkeypatch):
    urdf = tmp_path / 'robot_corrected.urdf'
    urdf.write_text('<robot name="corrected"/>')
    name = 'examples/corrected_arm.launch.py'
    (published,), _ = launched(name, urdf=str(urdf))
    assert published.kwargs['parameters'][0]['robot_description'].args == (urdf.read_text(),)

    def builder(robot, package_name):
        own = {'robot_description': 'nominal', 'robot': robot, 'package': package_name}
        return SimpleNamespace(to_moveit_configs=lambda: SimpleNamespace(to_dict=lambda: own))

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
