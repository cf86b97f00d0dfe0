# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import fcntl
import logging
import os
from contextlib import contextmanager

import pytest
from archives import open_archive, sample, stamps, written

from calib_ros.errors import InputError
from calib_ros.files.journal import joints_line
from calib_ros.files.tables import read_table


@contextmanager
def open_folder(path):
    handle = os.open(path, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    yield
    os.close(handle)


def test_robots_with_similar_and_with_long_names_have_files_of_their_own(tmp_path):
    names = ('12_3', '12/3', '12//3', '12 3', '12%2F3', '12%203', 'ö', 'é' * 150, 'é' * 150 + '1')
    kinds = 'arm', 'arm_on_linear_axis', 'arm_A7', 'arm+A7', 'an/arm', 'arm_A7/1'
    robots = [*kinds, *(f'arm/{name}' for name in ('A7', 'A7_1', *names))]
    for k, robot in enumerate(robots):
        archive = open_archive(tmp_path, robot)
        archive.add(sample(k))
        archive.close()
        assert not archive.error
        archive.save(f'calibration: {k}', 'settings: none')
        assert archive.note('identified', archive.path) is not None
    for k, robot in enumerate(robots):
        assert stamps(tmp_path, robot) == [k]
        newest = open_archive(tmp_path, robot).newest_calibration()
        assert newest.read_text() == f'calibration: {k}'
    files = {path.name.rpartition('_')[0] for path in tmp_path.glob('*Z.csv')}
    assert {'arm+12_3', 'arm+12%2F3', 'arm+ö'} < files


def test_a_folder_named_like_a_journal_is_none_and_a_lost_one_is_told_when_it_is_read(tmp_path):
    """A link to a journal that had been moved away kept a node without resume from starting."""
    archive = open_archive(tmp_path)
    archive.add(sample(1))
    archive.save('calibration: 1', 'settings: 1')
    archive.close()
    for ending in ('.csv', '.yaml'):
        (tmp_path / f'arm_99901231T235959999999Z{ending}').mkdir()
    archive = open_archive(tmp_path)
    assert [each.stamp_ns for each in archive.resume()[0]] == [1]
    assert archive.newest_calibration().read_text() == 'calibration: 1'
    archive.close()
    lost = tmp_path / 'arm_99901231T235959999998Z.csv'
    lost.symlink_to(tmp_path / 'on a disk that is not there')
    archive = open_archive(tmp_path)
    assert archive.newest_journal() == lost
    with pytest.raises(InputError, match=f'{lost}.* It is left untouched'):
        archive.resume()


def test_the_newest_journal_is_resumed_when_the_clock_was_set_back(tmp_path):
    """As that of a computer without a battery: what is written later sorts later all the same."""
    archive = open_archive(tmp_path)
    archive.add(sample(1))
    archive.save('of the first night', 'settings: 1')
    archive.close()
    for path in tmp_path.glob('*Z.*'):
        path.rename(tmp_path / f'arm_99901231T235959999999Z.{path.name.partition("Z.")[2]}')
    archive = open_archive(tmp_path)
    archive.add(sample(2))
    archive.save('of the second night', 'settings: 2')
    archive.start_new()
    archive.add(sample(3))
    archive.close()
    assert stamps(tmp_path) == [3]
    assert open_archive(tmp_path).newest_calibration().read_text() == 'of the second night'


def test_the_newest_journal_is_resumed_without_what_was_taken_back(tmp_path):
    written(tmp_path, 1)
    second = open_archive(tmp_path)
    samples = [sample(2), sample(3), sample(3, validation=True), sample(4)]
    for each in samples:
        second.add(each)
    second.remove(samples[2])
    second.remove(samples[3])
    with pytest.raises(InputError, match='another process writes'):
        open_archive(tmp_path).resume()
    second.close()
    third = open_archive(tmp_path)
    found, warnings = third.resume()
    assert [(each.stamp_ns, each.validation) for each in found] == [(2, False), (3, False)]
    assert warnings == ()
    third.add(sample(5))
    assert stamps(tmp_path) == [2, 3, 5]
    assert len(list(tmp_path.glob('*.csv'))) == len(list(tmp_path.glob('*.settings.yaml'))) == 2


@pytest.mark.parametrize('damage', [b'no number', b'1,2', b'"', b'\0' * 40, b'\xff'])
def test_a_damaged_row_is_left_out_and_stays(tmp_path, damage):
    written(tmp_path, *range(1, 9))
    (journal,) = tmp_path.glob('*.csv')
    lines = journal.read_bytes().splitlines(keepends=True)
    lines[3] = damage + b'\n' if damage == b'1,2' else damage + lines[3]
    lines[6] = lines[6][:-20] + b'\n'
    journal.write_bytes(b''.join(lines)[:-1])  # by an editor, perhaps
    archive = open_archive(tmp_path)
    samples, (warning,) = archive.resume()
    assert [each.stamp_ns for each in samples] == [1, 2, 4, 5, 7, 8]
    assert 'lines 4, 7 cannot be read: left out' in warning
    archive.add(sample(9))
    assert stamps(tmp_path) == [1, 2, 4, 5, 7, 8, 9]
    assert journal.read_bytes().startswith(b''.join(lines))
    with pytest.raises(InputError):
        read_table(journal, 2)


def test_nothing_to_resume(tmp_path, caplog):
    archive = open_archive(tmp_path / 'none')
    samples, (warning,) = archive.resume()
    assert (samples, 'nothing to resume' in warning) == ((), True)
    archive.folder.rmdir()  # as a full disk, no end of the node
    archive.begin(logging.getLogger())
    assert not caplog.records


def test_a_session_without_poses_that_was_killed_is_resumed_and_not_the_one_before(tmp_path):
    """The poses of yesterday became those of a node that respawned before its first one."""
    written(tmp_path, 1)
    again = open_archive(tmp_path)
    again.begin(logging.getLogger())
    (journal, mark) = sorted(tmp_path.glob('*.csv'))
    for how in ('killed', 'ended'):
        again._unmark()  # as the end of its process does
        again = open_archive(tmp_path)
        samples, (warning,) = again.resume()
        assert (samples, again.start_new()) == ((), None)
        assert warning.endswith(f'to continue {journal} instead, delete {mark}')
        if how == 'ended':
            again.close()
    assert stamps(tmp_path) == [1]  # nothing was killed
    again.begin(logging.getLogger())
    again.add(sample(2))
    assert stamps(tmp_path) == [2]


def test_a_journal_from_which_all_was_taken_back_is_resumed(tmp_path):
    archive, only = open_archive(tmp_path), sample(1)
    archive.add(only)
    archive.remove(only)
    assert stamps(tmp_path) == []


def test_the_journal_of_a_robot_with_other_joints_is_refused(tmp_path):
    """In another order too: values would be those of other joints; without names it is resumed."""
    written(tmp_path, 1)
    said = r'Z.csv is of other joints: q1 is a, in the chain b; q2 is b, in the chain a: give'
    with pytest.raises(InputError, match=said):
        open_archive(tmp_path, joints=('b', 'a')).resume()
    assert stamps(tmp_path) == [1]
    (beside,) = tmp_path.glob('*.settings.yaml')
    beside.write_text(beside.read_text().replace('["a", "b"]', '["c",  "b"]'))  # as it says
    open_archive(tmp_path, joints=('c', 'b')).resume()
    beside.write_text('# joints: [c, b]')
    with pytest.raises(InputError, match=r'yaml must begin with # joints: \["a", "b"\]$'):
        stamps(tmp_path)
    many = tuple(f'a_joint_with_a_long_name_{k}' for k in range(7))
    beside.write_text(joints_line(many))
    with pytest.raises(InputError, match=f'first line of {beside.name}$'):  # never cut off
        stamps(tmp_path)
    beside.write_text('settings: none\n')
    assert stamps(tmp_path) == [1]
    with pytest.raises(InputError, match='q3'):
        open_archive(tmp_path, joints=('a', 'b', 'c')).resume()


def test_what_killed_nodes_leave_is_removed_by_the_next(tmp_path):
    """Names with the time are never written again, so it piled up."""
    made = {'save': 'a1.0.partial', 'export': 'dh.csv', 'folder': 'x.old', 'other': 'a1.0.partial'}
    works = {name: tmp_path / f'.arm_2026_{name}.partial' for name in made}
    for name, inside in made.items():
        works[name].mkdir()
        (works[name] / inside).write_text('half')
    with open_folder(works['other']):  # another node writes
        open_archive(tmp_path)
    assert [name for name, work in works.items() if work.exists()] == ['folder', 'other']


def test_a_journal_with_poses_is_not_removed_by_one_that_added_none(tmp_path):
    archive, other = open_archive(tmp_path), open_archive(tmp_path, joints=('b', 'a'))
    other.path = archive.path  # as two nodes at once choose it
    archive.add(sample(1))
    archive.close()
    for _ in range(2):
        other.close()
        assert stamps(tmp_path) == [1]
        with pytest.raises(InputError):
            other.resume()
