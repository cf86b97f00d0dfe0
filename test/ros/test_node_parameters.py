# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A real node in real rclpy: its parameters, at the start and later."""

from dataclasses import fields
from pathlib import Path

import pytest
import yaml
from launching import parameters_of
from rcl_interfaces import msg, srv
from rclpy.exceptions import ParameterException
from rclpy.parameter import Parameter
from ros_cell import Cell, topics

from calib_ros.errors import CalibrationError, ConfigError
from calib_ros.kinematics.chain_file import calibration_record, load_chain
from calib_ros.ros import node as node_module
from calib_ros.ros.arguments import launch_arguments
from calib_ros.ros.command_line import refuse_ignored_files, typed
from calib_ros.ros.parameter_list import PARAMETERS
from calib_ros.settings import STARTUP, Settings

FREE = ('target_filename', 'calibration_filename', 'socket', 'largest_loss', 'marker_scale')
SHIPPED = Path(__file__).parents[2] / 'config' / 'calibration_node.yaml'


def declared(node):
    return {name: parameter.value for name, parameter in node.get_parameters_by_prefix('').items()}


def test_every_parameter_is_in_the_file_with_its_default_and_an_argument_of_launch(idle):
    with open(SHIPPED) as file:
        (content,) = yaml.safe_load(file).values()
    shipped = content['ros__parameters']
    of_every_node = ('qos_overrides.', 'start_type_description_service')
    own = {k: v for k, v in declared(idle.node).items() if not k.startswith(of_every_node)}
    assert set(own) == set(PARAMETERS) < set(launch_arguments())
    for name, value in own.items():
        default = PARAMETERS[name].default
        assert type(value) is (list if isinstance(default, tuple) else type(default)), name
    del own['use_sim_time']
    assert list(shipped) == list(own)
    of_this_test = {'chain': '', 'data_dir': ''}
    assert shipped == own | of_this_test


@pytest.mark.parametrize(
    ('name', 'value', 'said'),
    [
        ('model', 'nonsense', 'unknown model "nonsense"'),
        ('model', 'auto+ratio', 'model auto stands alone'),
        ('fixed', ['joint_7.a'], 'unknown parameter "joint_7.a"'),
        ('priors', ['*.a=much'], 'must be a finite number'),
        ('sigma_position', -1.0, 'sigma_position'),
        ('sigma_position', 1, "expected 'Type.DOUBLE'"),
        ('frame_id', 'a\nb', "frame_id must be printable text, not 'a\\nb'"),
        ('still', 5.0, 'Max: 0.1'),  # degrees
        ('largest_loss', 20.0, 'Max: 1'),  # per cent
        ('wanted_accuracy', 0.1, 'Max: 0.05'),  # mm
        ('marker_scale', float('nan'), 'marker_scale'),  # the markers would be nowhere
        ('longest_stop', 0.1, 'must be shorter than longest_stop (0.1 s)'),
        ('mode', 'continuous', 'read-only'),
        ('joint_names', ['a'], 'read-only'),
        ('serial', 'A8', 'read-only'),
    ],
)
def test_a_setting_that_cannot_be_is_refused_and_changes_nothing(idle, name, value, said):
    before, settings = declared(idle.node), idle.node.session.settings
    (result,) = idle.set_parameters({name: value})
    assert not result.successful
    assert said in result.reason
    assert declared(idle.node) == before
    assert idle.node.session.settings == settings


@pytest.mark.parametrize(
    ('kind', 'name'),
    [
        (srv.SetParameters, 'set_parameters'),
        (srv.SetParametersAtomically, 'set_parameters_atomically'),
    ],
)
def test_a_parameter_of_a_type_that_there_is_not_does_not_end_the_node(idle, kind, name):
    """An exception of rclpy in the parameter service ended the spinning."""
    told = idle.log()
    broken = msg.Parameter(name='folds', value=msg.ParameterValue(type=200))
    client = idle.peer.create_client(kind, f'calibration_node/{name}')
    idle.spin_until(client.service_is_ready)
    answer = client.call_async(kind.Request(parameters=[broken]))
    idle.spin_until(answer.done)
    assert answer.result() == kind.Response()
    said = f"calibration_node/{name}: the call cannot be answered: ValueError('200 is not"
    idle.spin_until(lambda: any(said in each.msg for each in told))
    assert all(each.successful for each in idle.set_parameters({'folds': Settings.folds}))


def test_settings_change_at_run_time(cell, recording):
    cell.play(topics(recording))
    cell.done('identify')
    before = cell.node.session.calibration.chain
    changes = {
        'model': 'ratio',
        'sigma_position': 2e-4,
        'wanted_accuracy': 1e-5,
        'fixed': ['elbow_joint.a'],
        'marker_scale': 10.0,
        'still': 1e-3,
    }
    results = cell.set_parameters(changes)
    assert all(result.successful for result in results), results
    wanted = {name: changes[name] for name in changes.keys() - {'marker_scale', 'fixed'}}
    assert cell.node.session.settings == Settings(**wanted, fixed=('elbow_joint.a',))
    told = cell.node.session.told  # another thread learns
    cell.spin_until(lambda: 'more for 0.01 mm' in '; '.join(told()))
    cell.done('identify')
    after = cell.node.session.calibration.chain
    assert after.table[2, 0] == load_chain('ur10e').table[2, 0] != before.table[2, 0]
    assert len(after.effects) == 6


def test_all_of_an_atomic_change_or_nothing(idle):
    settings = idle.node.session.settings
    changes = [Parameter('sigma_position', value=5e-4), Parameter('model', value='nonsense')]
    assert not idle.node.set_parameters_atomically(changes).successful
    assert idle.node.session.settings == settings
    assert idle.node.get_parameter('sigma_position').value == settings.sigma_position


@pytest.mark.parametrize(
    ('parameters', 'said'),
    [
        ({'chain': ''}, 'parameter "chain" is not set'),
        ({'chain': 'ur10f'}, 'another arm needs a URDF or a chain file'),
        ({'target_frame': ''}, 'parameter "target_frame" must not be empty'),
        ({'folds': 5.5}, 'parameter "folds" must be a whole number, not 5.5'),
        ({'mode': 'dwel'}, 'did you mean "dwell"'),
        ({'fixed': ['joint_2.a']}, 'unknown parameter "joint_2.a"'),
        ({'sources': ['/pose', '/pose type=Range']}, 'named twice'),
        ({'sources': ['/b{x}']}, '"/b{x}" is no topic name: failed to resolve name'),
        ({'sources': ['/b', 'b']}, '"b" is /b, from which another input is taken: give each one'),
        ({'joint_topics': ['a', 'a']}, '"a" is /a, from which another input is taken'),
        (  # the poses that were fitted also judged
            {'remap': ('measured_pose:=/a', 'validation_pose:=/a')},
            '"validation_pose" is /a, from which another input is taken',
        ),
        ({'max_gapp': 1.0}, 'did you mean "max_gap"'),
        ({'delay': 'none'}, 'parameter "delay" must be a finite number'),
        ({'serial': 12}, 'must be text, not 12: write it in quotes'),
        ({'model': True}, 'parameter "model" must be text, not True'),
        ({'marker_scale': 'large'}, '"marker_scale" must be a finite number, not \'large'),
        ({'resume': 1}, 'parameter "resume" must be true or false, not 1'),
        ({'folds': True}, 'parameter "folds" must be a finite number, not True'),
        ({'joint_names': [1, 2]}, 'parameter "joint_names" must be a list of strings such as ['),
        ({'shortest_stop': 6.0}, 'shortest_stop (6 s) must be shorter than longest_stop (5 s)'),
        ({'tip_link': 'tool0'}, 'apply only to a URDF'),
        ({'history': 'history'}, 'set serial as well'),
        ({'socket': 'A'}, 'socket must be LOCATION/SOCKET (A/1)'),
        ({'data_dir': '~nobody-here/x'}, 'no such home folder'),
        ({'candidates': '~nobody-here/x'}, 'no such home folder'),
        ({'target_filename': '/x.yaml'}, 'choose target_filename in data_dir, or start'),
        ({'calibration_filename': '/x.yaml'}, 'choose calibration_filename in data_dir, or start'),
        ({'settle': 100.0}, 'settle (100 s) must be shorter than longest_stop (5 s)'),
        ({'lateness': 1e9}, 'lateness out of range Min: 0.0, Max: 600'),
        ({'delay': 50.0}, 'delay out of range Min: -10.0, Max: 10'),  # ms
        ({'max_gap': 100.0}, 'max_gap out of range Min: 1e-06, Max: 60'),
        ({'target_frame': 'a\x07'}, 'parameter "target_frame" must be printable text'),
        ({'data_dir': '\0'}, 'parameter "data_dir" must be printable text'),
        ({'sources': ['/p target=\x07']}, 'parameter "sources" must be a list of'),
    ],
)
def test_a_wrong_parameter_is_refused_at_the_start(empty, tmp_path, parameters, said):
    with pytest.raises((CalibrationError, ParameterException)) as caught:
        empty.start(**{'chain': 'ur10e', 'data_dir': str(tmp_path)} | parameters)
    assert said in str(caught.value)


def test_numbers_are_those_of_their_parameters_and_a_text_is_a_list_of_one(tmp_path):
    given = {'marker_scale': 100, 'settle': 1, 'folds': 6.0, 'fixed': '*.a'}
    with Cell(chain='ur10e', data_dir=str(tmp_path), **given) as cell:
        assert cell.node.get_parameter('marker_scale').value == 100.0
        assert cell.node.session.settings == Settings(settle=1.0, folds=6, fixed=('*.a',))
        assert cell.node.get_parameter('fixed').value == ['*.a']


@pytest.mark.parametrize(
    ('words', 'said'),
    [
        (['--params-file', '/nowhere.yaml'], '/nowhere.yaml'),
        (['-p', 'chain'], "parse parameter override rule: '-p chain'"),
        (['-r', '__ns:=bad-name'], '__ns:=bad-name'),
        (['--foo'], "unknown ROS arguments: ['--foo']"),
        (['--', '--serial', '7'], 'unrecognized arguments: --serial 7'),  # which ROS ignores
    ],
)
def test_words_that_cannot_be_read_are_told(capsys, words, said):
    with pytest.raises(SystemExit) as caught:
        node_module.main(['--ros-args', '-p', 'chain:=ur10e', *words])
    assert caught.value.code == 2
    assert said in capsys.readouterr().err


def test_help_names_every_parameter_and_starts_nothing(capsys):
    with pytest.raises(SystemExit) as caught:
        node_module.main(['--help'])
    assert caught.value.code == 0
    out = capsys.readouterr().out
    for name in PARAMETERS:
        can_change = name in (*FREE, 'use_sim_time', *(each.name for each in fields(Settings)))
        mark = ' *' if can_change and name not in STARTUP else ''
        assert f'\n  {name}{mark}\n' in out
    assert '--ros-args -p chain:=ur10e' in out
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.parametrize(
    ('word', 'meant'),
    [('0012', '0012'), ('"0012"', '0012'), ("'1e5'", '1e5'), ('yes', 'yes'), ('A 7', 'A 7')],
)
def test_a_serial_number_is_text(word, meant):
    words = typed(['node', '--ros-args', '-p', f'serial:={word}', '-p', 'folds:=4'])
    assert words[-1] == 'folds:=4'
    assert yaml.safe_load(words[3].partition(':=')[2]) == meant


@pytest.mark.parametrize(
    ('keys', 'applies'),
    [
        (['calibration_node'], False),
        (['/cell_1/calibration'], False),
        (['/cell_2/*', '/cell_2/calibration_node'], False),
        (['/cell_2/calibration_node', '/cell_1/calibration_node'], True),
        (['/**'], True),
        (['/**/calibration_node'], True),
        (['/cell_1/*'], True),
        (['/*/calibration_node'], True),
        (['/**/cell_1/**'], True),
        (['/*'], False),  # of nodes without a namespace
        (['*', '/*/*/calibration_node'], False),
    ],
)
def test_a_parameter_file_of_other_nodes_is_refused(tmp_path, keys, applies):
    """ROS ignores it: the node would run with its defaults. One of comments only is none."""
    path = tmp_path / 'parameters.yaml'
    path.write_text('# chain: ur10e')
    refuse_ignored_files(['node', '--ros-args', '--params-file', str(path)], '/calibration_node')
    path.write_text(yaml.safe_dump({key: {'ros__parameters': {'chain': 'ur10e'}} for key in keys}))
    words = ['--params-file', str(path), '-r', '__ns:=/cell_1']
    assert ('chain' in parameters_of(words)) == applies
    node, command = '/cell_1/calibration_node', ['node', '--ros-args', *words]
    if applies:
        refuse_ignored_files(command, node)
        return
    with pytest.raises(ConfigError, match=rf'no parameters of {node}, but of /.*: use the key /'):
        refuse_ignored_files(command, node)


@pytest.mark.parametrize(
    ('node', 'given', 'said'),
    [
        ('/cell_2/calibration_node', 'mode: triggered', 'but of /cell_2/calibration_node: use'),
        # ROS gives it no type, and rclpy no name
        ('/**', 'sources: []', "an empty list []: write [''] or leave it out"),
    ],
)
def test_a_parameter_file_without_effect_ends_it(tmp_path, capsys, ended_by, node, given, said):
    path = tmp_path / 'parameters.yaml'
    path.write_text(f'{node}: {{ros__parameters: {{{given}}}}}')
    assert ended_by('chain:=ur10e', f'data_dir:={tmp_path}', file=path) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


@pytest.mark.parametrize(
    ('own', 'also', 'name', 'ends'),
    [
        ('/**', 'tracker', 'robot_ip', False),
        ('/**/calibration_node', '/**', 'diagnostic_updater.period', False),
        ('/**', 'tracker', 'sigma_postion', True),  # misspelt
        ('/**', '/**', 'robot_ip', True),  # a file for this node alone
        ('calibration_node', '/**', 'qos_overrides./joint_state.subscription.depth', True),
    ],
)
def test_a_parameter_of_all_nodes_is_refused_if_it_may_be_ours(
    tmp_path, capfd, ended_by, own, also, name, ends
):
    """One file for all nodes of a cell with what they share kept this one from starting."""
    path, sections = tmp_path / 'cell.yaml', {also: {'port': 1}, '/**': {}}
    sections[own] = {'chain': 'ur10e', 'data_dir': str(tmp_path)}
    sections['/**'][name] = 4
    sections = {key: {'ros__parameters': given} for key, given in sections.items()}
    path.write_text(yaml.safe_dump(sections))
    assert ended_by(file=path, **({} if ends else {'spun': lambda *_: None})) == ends
    said = f'unknown parameter "{name}"' if ends else f'does not have: {name}: they are ignored'
    assert said in capfd.readouterr().err


def test_the_parameter_file_applies_under_a_namespace(tmp_path, ended_by):
    path, found = tmp_path / 'parameters.yaml', []

    def spun(node, *_):
        serial = node.get_parameter('serial').value  # text, although ROS makes it 12
        found.append((node.get_fully_qualified_name(), node.session.chain.name, serial))

    path.write_text(SHIPPED.read_text().replace("chain: ''", 'chain: meca500'))
    given, names = ('serial:=0012', f'data_dir:={tmp_path}'), ('__ns:=/cell_2', '__node:=arm')
    assert ended_by(*given, file=path, spun=spun, names=names) == 0
    assert found == [('/cell_2/arm', 'meca500', '0012')]


def test_the_settings_of_the_identification_are_saved_with_it(tmp_path, recording, monkeypatch):
    """Whatever has been changed since, and though its report cannot be made."""
    given = {'chain': 'ur10e', 'serial': '7', 'base_frame': 'base_link'}
    with Cell(**given, data_dir=str(tmp_path)) as cell:
        cell.play(topics(recording))
        given |= {'folds': 4, 'largest_loss': 0.3, 'socket': 'A/1'}
        cell.set_parameters({name: given[name] for name in ('folds', 'largest_loss', 'socket')})
        cell.done('identify')
        cell.set_parameters({'folds': 7, 'largest_loss': 0.2})
        monkeypatch.setattr('calib_ros.report.page.render', None)
        told = cell.log()
        saved = cell.done('save')
        (path,) = tmp_path.glob('*Z.yaml')
        assert saved.message == f'saved to {path}'
        cell.spin_until(lambda: any(f'the report of {path} is not' in m.msg for m in told))
        of_all = yaml.safe_load(path.with_suffix('.settings.yaml').read_text())['/**']
        assert calibration_record(path.read_text())['robot_serial'] == '7'
        assert given.items() <= of_all['ros__parameters'].items()
