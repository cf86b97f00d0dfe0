# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Files that stand for more than they hold, and numbers that no robot has."""

import itertools
import os
import sys

import numpy as np
import pytest
import yaml

from calib_ros.cli.main import main
from calib_ros.errors import LONGEST, ConfigError, InputError, UnknownNameError
from calib_ros.files.journal import read_journal
from calib_ros.files.programs import read_program
from calib_ros.files.tables import read_table
from calib_ros.files.vocabulary import COVARIANCE
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.chain_file import load_chain, parse_chain
from calib_ros.kinematics.urdf import chain_from_urdf
from calib_ros.sampling.slices import Part
from calib_ros.sampling.usable import usable
from calib_ros.texts import LARGEST_TABLE, parse_yaml

ARM = Chain('arm', 'standard', (Joint('a', alpha=1.5, d=0.3), Joint('b', a=0.4)))
HEAD = 'convention: standard\njoints:\n- {name: a, a: 0, alpha: 0, d: 0, theta: '


@pytest.mark.parametrize(
    'err',
    [
        ConfigError('x' * 10_000),
        UnknownNameError('key', 'k' * 10**6, [f'name_{k}' for k in range(20_000)]),
        InputError('short'),
    ],
)
def test_messages_are_short(err):
    assert len(str(err)) <= LONGEST


def test_a_long_message_keeps_what_is_wrong_and_what_to_do():
    text = str(ConfigError(f'key "{"k" * 9999}" is unknown: remove it'))
    assert text.startswith('key "kkk')
    assert text.endswith('is unknown: remove it')


def test_the_command_line_cuts_what_the_system_says(capsys):
    assert main(['identify', '--csv', 'x' * 5000, '--chain', 'ur10e']) == 1
    assert len(capsys.readouterr().err) <= LONGEST + len('calib_ros: \n')


BOMBS = {
    'aliases': 'a: &a [x, x, x, x, x, x, x, x, x]\n'
    + ''.join(
        f'{b}: &{b} [{", ".join([f"*{a}"] * 9)}]\n' for a, b in itertools.pairwise('abcdefgh')
    ),
    'aliases of a text': f'a: &a {"x" * 9000}\nb: &b [{", ".join(["*a"] * 900)}]\nc: [*b, *b]',
    'depth': 'name: ' + '[' * 100_000,
    'depth by aliases': ''.join(f'{k}: &k{k + 1} [*k{k}]\n' for k in range(1, 50)).replace(
        '[*k1]', '[x]'
    ),
    'itself': 'name: &a [*a]',
    'tags': 'name: !!timestamp soon',
    'empty tag': 'name: !!int ""',
    'keys': 'name: a\nname: b',
}


@pytest.mark.parametrize('bomb', BOMBS)
def test_yaml_that_stands_for_more_is_refused(tmp_path, bomb):
    with pytest.raises(ConfigError):
        parse_chain(BOMBS[bomb])
    path = tmp_path / 'p.yaml'
    path.write_text(BOMBS[bomb])
    with pytest.raises(InputError):
        read_program(path, ['a'])


def test_aliases_that_save_writing_are_read():
    text = 'convention: standard\njoints:\n- &j {name: a, a: 1, alpha: 0, d: 0, theta: 0}\n'
    text += '- {<<: *j, name: b}\n'
    assert parse_chain(text).joints[1] == Joint('b', a=1.0)


@pytest.mark.parametrize('text', ['a: &x 1\nb: [*x, 2.5, "07", 1e3, 0x10]', '- {a: [{b: c}]}\n'])
def test_other_yaml_is_read_as_ever(text):
    assert parse_yaml(text, 'text') == yaml.safe_load(text)


def test_a_limit_as_large_as_none_is_none():
    assert parse_chain(HEAD + '0, lower: -1e308, upper: 1e308}').joints[0].lower is None


def urdf(links, kind='fixed', axis='0 0 1'):
    text = ['<robot name="r">', *(f'<link name="l{k}"/>' for k in range(links))]
    for k in range(links - 1):
        moves = kind if k else 'continuous'
        text.append(
            f'<joint name="j{k}" type="{moves}"><parent link="l{k}"/><child link="l{k + 1}"/>'
            f'<axis xyz="{axis}"/></joint>'
        )
    return '\n'.join([*text, '</robot>'])


def test_the_most_links_are_read_and_more_refused(monkeypatch):
    most = 2 * sys.getrecursionlimit()
    monkeypatch.setattr('calib_ros.kinematics.urdf_reader.MOST_LINKS', most)
    assert len(chain_from_urdf(urdf(most)).joints) == 1
    with pytest.raises(ConfigError, match=f'more than {most} links'):
        chain_from_urdf(urdf(most + 1))
    with pytest.raises(ConfigError, match='more than 50'):
        chain_from_urdf(urdf(60, 'continuous'))


def test_a_long_axis_is_a_direction():
    assert chain_from_urdf(urdf(2, axis='0 1e5 1e5')).joint_names == ('j0',)


def table(tmp_path, cells, quaternion=True):
    turned = ',qx,qy,qz,qw' if quaternion else ''
    lines = [f'q1,q2,x,y,z{turned},{",".join(COVARIANCE)}']
    for k in range(3):
        turned = ',0,0,0,1' if quaternion else ''
        lines.append(f'0.{k},0.2,1,2,3{turned},' + ','.join(map(str, cells)))
    path = tmp_path / 'table.csv'
    path.write_text('\n'.join(lines))
    return path


def upper(matrix):
    return matrix[np.triu_indices(6)]


POSITION_ONLY = np.diag([4e-8, 1e-8, 1e-8, 0.0, 0.0, 0.0])


def test_a_covariance_of_zeros_is_none(tmp_path):
    assert read_table(table(tmp_path, np.zeros(21)), 2).fitted[0].covariance is None


@pytest.mark.parametrize('quaternion', [True, False])
def test_a_covariance_of_the_position_alone_weights_only_that(tmp_path, quaternion):
    read = read_table(table(tmp_path, upper(POSITION_ONLY), quaternion), 2)
    found = read.fitted[0].covariances((1e-4, 3e-4))
    np.testing.assert_allclose(found[0], np.diag([4e-8, 1e-8, 1e-8, 9e-8, 9e-8, 9e-8]))
    assert fault(POSITION_ONLY) == {}


def test_a_camera_with_a_covariance_of_the_position_alone(tmp_path):
    found = []
    for rotation in (0.0, 9e-8):
        covariance = POSITION_ONLY + np.diag([0.0] * 3 + [rotation] * 3)
        path = table(tmp_path, upper(covariance))
        read = read_table(path, 2, sigmas=(1e-4, 3e-4), eye_in_hand=True)
        found.append(read.fitted[0].covariance)
    np.testing.assert_allclose(*found, rtol=1e-12)


def fault(covariance):
    """Return why a measured pose with a covariance cannot be used."""
    row = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, *np.ravel(covariance)])
    return usable(Part(np.zeros(1), None, ('tracker',), np.array([1]), row[np.newaxis]))[1]


@pytest.mark.parametrize(
    'bad',
    [
        np.diag([1e-8, 1e-8, 0.0, 1e-8, 1e-8, 1e-8]),
        np.diag([1e-8, 1e-8, -1e-8, 1e-8, 1e-8, 1e-8]),
        np.diag([1e-8, 1e-8, 1e-8, 1e-8, 1e-8, 0.0]),
        np.full((6, 6), 1e-8),
        1e-8 * np.eye(6) + np.eye(6, k=1) + np.eye(6, k=-1),
        1e-300 * np.eye(6),
    ],
)
def test_a_covariance_that_is_none_is_refused_everywhere(tmp_path, bad):
    with pytest.raises(InputError, match=r'line 2: c11 \.\.\. c66: covariance'):
        read_table(table(tmp_path, upper(bad)), 2)
    assert any('covariance' in cause for cause in fault(bad))


def test_more_rows_than_any_table_has_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr('calib_ros.files.columns.MOST_ROWS', 100)
    path = tmp_path / 'table.csv'
    path.write_text('q1,q2,x,y,z\n' + '0,0,1,2,3,\n' * 101)
    for read in (read_table, read_journal):
        with pytest.raises(InputError, match='more than 100 rows'):
            read(path, 2)


def test_blank_cells_behind_the_columns_are_left_alone(tmp_path):
    path = tmp_path / 'table.csv'
    path.write_text('q1,q2,x,y,z,,\n0,0,1,2,3,,,,\n')
    assert len(read_table(path, 2).fitted[0]) == 1


def test_many_rows_that_were_taken_back_take_no_longer_than_others(tmp_path):
    rows = [f'{k},0,0,1,2,3,{split}' for k in range(1000) for split in ('', 'removed')]
    path = tmp_path / 'table.csv'
    path.write_text('\n'.join(['stamp_ns,q1,q2,x,y,z,split', *rows, '1,0,0,1,2,3,']))
    assert len(read_table(path, 2).fitted[0]) == 1


def test_a_pipe_with_nobody_at_its_other_end_is_refused(tmp_path):
    for name in ('table.csv', 'chain.yaml'):
        os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match='is a pipe: give a file, or /dev/stdin'):
        read_table(tmp_path / 'table.csv', 2)
    with pytest.raises(ConfigError, match='is a pipe'):
        load_chain(tmp_path / 'chain.yaml')


def test_a_file_larger_than_any_table_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / 'table.csv'
    with path.open('wb') as file:
        file.truncate(LARGEST_TABLE + 1)
    with pytest.raises(InputError, match='larger than 100 MB'):
        read_table(path, 2)
