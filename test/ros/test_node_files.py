# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which files of its machine the node uses for somebody else, and what it tells of them."""

import os

import pytest
from ros_cell import Cell, true_arm
from std_srvs.srv import Trigger

from calib_ros.identification.records import nominal_document
from calib_ros.kinematics.chain_file import dump_chain, load_chain

SECRET = 'root:$6$salt$hash:19000:0:99999:7:::'


@pytest.fixture
def data(tmp_path):
    """Return a folder that is the node's, with a calibration; a secret is beside it."""
    data = tmp_path / 'data'
    data.mkdir()
    record = {'accepted': True, 'nominal': nominal_document(load_chain('ur10e'))}
    (data / 'good.yaml').write_text(dump_chain(true_arm(), record))
    (tmp_path / 'shadow').write_text(SECRET + '\n')
    (tmp_path / 'secret.yaml').write_text(SECRET + '\n')
    (tmp_path / 'more').mkdir()
    return data


@pytest.fixture
def cell(data, tmp_path):
    folders = [str(tmp_path / 'more')]
    with Cell(chain='ur10e', data_dir=str(data), allowed_folders=folders) as cell:
        yield cell


def called(cell, service, parameter, name):
    """Return the answer to a call after a file was named, or why that name is refused."""
    (result,) = cell.set_parameters({parameter: str(name)})
    if result.successful:
        return cell.call(service)
    return Trigger.Response(success=False, message=result.reason)


def load(cell, name):
    return called(cell, 'load', 'calibration_filename', name)


def save(cell, name):
    return called(cell, 'save', 'target_filename', name)


def everything(folder):
    return sorted(str(path) for path in folder.rglob('*'))


def test_other_files_are_neither_read_nor_told_of(cell, data, tmp_path):
    (data / 'out').symlink_to(tmp_path)
    (data / 'link.yaml').symlink_to(tmp_path / 'secret.yaml')
    names = '/etc/shadow', tmp_path / 'secret.yaml', 'out/secret.yaml', 'link.yaml'
    answers = [load(cell, name) for name in names]
    # There or not: the answer is the same.
    there, missing = (load(cell, tmp_path / name) for name in ('secret.yaml', 'missing.yaml'))
    assert there.message.replace('secret', '') == missing.message.replace('missing', '')
    for answer in (*answers, there):
        assert not answer.success
        assert 'outside the folders' in answer.message or 'must end in' in answer.message
    assert not any(part in answer.message for answer in answers for part in ('$6$', '19000'))


def test_no_content_of_a_file_is_in_an_answer(cell, data):
    secret = SECRET.encode()
    for content in (
        *(secret, b'- [' + secret, b'\xff\xfe' + secret, b'name: {%s: 1}' % secret),
        *(b'{%s: 1, %s: 1}' % (secret[:9], secret[:9]), b'name: arm\njoints: "%s"' % secret),
        b'!!python/object:%s' % secret,
    ):
        (data / 'wrong.yaml').write_bytes(content)
        answer = load(cell, 'wrong.yaml')
        assert not answer.success
        assert answer.message == (
            f'{data}/wrong.yaml is not a calibration: `calib_ros chain {data}/wrong.yaml` says '
            'what is wrong with it'
        )


def test_a_pipe_does_not_stop_the_node(cell, data):
    os.mkfifo(data / 'pipe.yaml')
    assert 'there is no file' in load(cell, 'pipe.yaml').message
    assert 'there is no file' in load(cell, 'missing.yaml').message


def test_files_are_written_into_the_folders_only(cell, data, tmp_path):
    assert load(cell, 'good.yaml').success
    (data / 'out').symlink_to(tmp_path)
    (data / 'link.yaml').symlink_to(tmp_path / 'new.yaml')
    before = everything(tmp_path)
    for name in (tmp_path / 'x.yaml', 'out/x.yaml', 'link.yaml', 'x.csv', '.bashrc'):
        answer = save(cell, name)
        assert not answer.success, name
        assert 'choose target_filename in' in answer.message or 'must end' in answer.message
    assert everything(tmp_path) == before
    text = (data / 'good.yaml').read_text()
    for name in ('new.yaml', 'sub/new.yaml', tmp_path / 'more' / 'sub' / 'new.yaml'):
        answer = save(cell, name)
        assert answer.success, answer.message
        assert (data / name).read_text() == text
        assert load(cell, name).success
    assert 'exists already' in save(cell, 'new.yaml').message


def test_a_file_with_a_name_of_its_own_is_loaded_by_this_name(cell):
    """~/load and autoload took an older one, the newest by the time in its name."""
    assert load(cell, 'good.yaml').success
    saved = save(cell, 'new.yaml')
    assert saved.message.endswith('; to load it set calibration_filename to it')
    (result,) = cell.set_parameters({'calibration_filename': 'newer.yaml'})
    assert result.successful
    assert 'calibration_filename' not in save(cell, 'newer.yaml').message
    assert 'calibration_filename' not in save(cell, '').message


def test_a_name_that_was_good_is_looked_at_again(cell, data, tmp_path):
    """A link may be put in its place after it was set."""
    assert load(cell, 'good.yaml').success
    (data / 'good.yaml').rename(tmp_path / 'moved.yaml')
    (data / 'good.yaml').symlink_to(tmp_path / 'moved.yaml')
    answer = cell.refused('load')
    assert 'outside the folders of the node' in answer.message


def test_robots_of_a_kind_in_namespaces_keep_their_files_apart(data):
    name = 'ur10e+left_20260101T000000000000Z.yaml'
    (data / 'good.yaml').rename(data / name)
    with Cell() as cell:
        for namespace in ('left', 'right'):
            cell.start(namespace=f'/{namespace}', chain='ur10e', data_dir=str(data))
        assert name in cell.call('load', node='/left/calibration_node').message
        answer = cell.call('load', node='/right/calibration_node')
        assert 'there is no saved calibration' in answer.message


def test_the_list_of_folders_is_the_operators(cell):
    (result,) = cell.set_parameters({'allowed_folders': ['/']})
    assert not result.successful
    assert not load(cell, '/etc/passwd.yaml').success


def test_files_are_found_at_home_though_no_shell_expands_a_parameter(tmp_path, monkeypatch):
    monkeypatch.setenv('HOME', str(tmp_path))
    (tmp_path / 'arm.yaml').write_text(dump_chain(true_arm()))
    (tmp_path / 'poses.csv').write_text('q1,q2,q3,q4,q5,q6\n0,0,0,0,0,0\n')
    with Cell(chain='~/arm.yaml', data_dir='~/data', candidates='~/poses.csv') as cell:
        assert cell.node.session.chain.name == 'ur10e'
        assert cell.node._archive.folder == tmp_path / 'data'


def test_a_folder_is_told_from_the_root(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with Cell(chain='ur10e', data_dir='data') as cell:
        assert cell.node._archive.folder == tmp_path / 'data'
