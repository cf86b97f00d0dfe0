# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import fcntl
import os
import resource
import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from calib_ros.errors import InputError
from calib_ros.files.archive import Archive
from calib_ros.files.journal import joints_line
from calib_ros.files.tables import read_table
from calib_ros.sampling.sample import Sample


def sample(number, **more):
    return Sample(number, np.full(2, 0.1 * number), position=np.arange(3.0) + number, **more)


def open_archive(folder, robot='arm', joints=('a', 'b')):
    return Archive(folder, robot, joints, lambda: 'settings: none\n')


def written(folder, *numbers, robot='arm'):
    """Write a journal with samples of these numbers, and close it."""
    archive = open_archive(folder, robot)
    for number in numbers:
        archive.add(sample(number))
    archive.close()


def stamps(folder, robot='arm'):
    """Return the stamps that a resumed session has, while another may still write."""
    with TemporaryDirectory() as copy:
        shutil.copytree(folder, copy, dirs_exist_ok=True)
        archive = open_archive(Path(copy), robot)
        samples, _ = archive.resume()
        archive.close()
    return [each.stamp_ns for each in samples]


@contextmanager
def open_folder(path):
    handle = os.open(path, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    yield
    os.close(handle)


@contextmanager
def full_disk(limit):
    """Let no file grow beyond a limit [bytes]."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


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


def test_nothing_to_resume(tmp_path):
    archive = open_archive(tmp_path / 'none')
    samples, (warning,) = archive.resume()
    assert (samples, 'nothing to resume' in warning) == ((), True)
    archive.folder.rmdir()  # as a full disk, no end of the node
    assert archive.begin() == ''


def test_a_session_without_poses_that_was_killed_is_resumed_and_not_the_one_before(tmp_path):
    """The poses of yesterday became those of a node that respawned before its first one."""
    written(tmp_path, 1)
    again = open_archive(tmp_path)
    assert again.begin().endswith('Z.csv, start with resume:=true')
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
    again.begin()
    again.add(sample(2))
    assert stamps(tmp_path) == [2]


def test_a_second_node_is_told_of_the_one_that_runs_and_not_to_delete_its_journal(tmp_path):
    """Before the first pose it was "to continue yesterday's instead, delete" that of the first."""
    written(tmp_path, 1)
    first, second, said = open_archive(tmp_path), open_archive(tmp_path), 'another process writes'
    first.begin()
    with pytest.raises(InputError, match=f'{said} {first.path}: stop it, or give each robot'):
        second.resume()
    first.add(sample(2))
    assert second.begin().startswith(f'{said} {first.path}: ')  # not "start with resume"
    first.close()
    assert 'to continue' in open_archive(tmp_path).begin()


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


def test_a_full_disk_loses_nothing(tmp_path):
    archive = open_archive(tmp_path)
    samples = [sample(k) for k in range(1, 8)]
    files = len(os.listdir('/proc/self/fd'))
    with full_disk(100):  # not even the header fits
        archive.add(samples[0])
        assert 'the disk is full' in archive.error
        archive.write()
        assert len(list(tmp_path.glob('*.csv'))) == 1
        assert stamps(tmp_path) == []
    assert len(os.listdir('/proc/self/fd')) == files
    archive.write()
    assert archive.error == ''
    archive.add(samples[1])
    with full_disk(archive.journal.stat().st_size + 20):
        for each in samples[2:]:
            archive.add(each)
        assert archive.error
        assert stamps(tmp_path) == [1, 2]
        assert archive.trouble.startswith('poses are in memory only: the disk is full: make room')
        archive.remove(samples[1])
        archive.remove(samples[3])
    assert archive.close() == archive.trouble == archive.error == ''
    assert stamps(tmp_path) == [1, 3, 5, 6, 7]


@pytest.mark.parametrize('rows', [[1, 2], [2], [1]])
def test_what_the_folder_does_not_take_is_kept_elsewhere_at_the_end(tmp_path, monkeypatch, rows):
    """With all rows written, ~/clear and the end closed the only copy there was."""
    folder, elsewhere = tmp_path / 'data', tmp_path / 'tmp'
    elsewhere.mkdir()
    archive = open_archive(folder)
    if 1 in rows:
        archive.add(sample(1))
    shutil.rmtree(folder)
    folder.write_text('in the way')
    if 2 in rows:
        archive.add(sample(2))
    with pytest.raises(InputError, match='in memory only and would be lost'):
        archive.start_new()
    assert archive.trouble
    monkeypatch.setattr(tempfile, 'tempdir', str(elsewhere))
    words = archive.close()
    (journal,) = elsewhere.glob('*/*.csv')
    assert f'poses are in {journal}, not in {folder}: ' in words
    assert stamps(journal.parent) == rows
    archive = open_archive(tmp_path)
    with full_disk(0):
        archive.add(sample(3))
        assert archive.close().startswith('poses are lost: ')
    archive = open_archive(tmp_path)
    archive.add(sample(4))
    journal = archive.journal
    with full_disk(journal.stat().st_size):
        archive.add(sample(5))
        assert archive.close().startswith(f'poses other than those in {journal} are lost: ')


def test_what_waits_for_room_is_not_lost_by_a_clear(tmp_path):
    archive = open_archive(tmp_path)
    archive.add(sample(1))
    with full_disk(archive.journal.stat().st_size):
        archive.add(sample(2))
        with pytest.raises(InputError, match='in memory only and would be lost'):
            archive.start_new()
    archive.add(sample(3))
    assert stamps(tmp_path) == [1, 2, 3]
    assert archive.start_new() is not None
    assert stamps(tmp_path) == []


def test_no_calibration_is_overwritten(tmp_path):
    archive = open_archive(tmp_path)
    path = archive.save('first', 'settings: a\n', tmp_path / 'sub' / 'arm.yaml')
    with pytest.raises(InputError, match='exists already'):
        archive.save('second', 'settings: b\n', path)
    with full_disk(2), pytest.raises(OSError, match='File too large'):
        archive.save('3', 'settings: c\n')  # of the two files the smaller one fits
    assert path.read_text() == 'first'
    assert path.with_suffix('.settings.yaml').read_text() == 'settings: a\n'
    assert not list(tmp_path.glob('*Z.yaml'))


def test_an_export_is_whole_or_absent(tmp_path):
    archive = open_archive(tmp_path / 'data')
    files = {'a.csv': 'short', 'b.csv': 'too long for the disk'}
    with full_disk(10), pytest.raises(OSError, match='File too large'):
        archive.export(files)
    assert list((tmp_path / 'data').iterdir()) == []
    folder = archive.export(files)
    assert list((tmp_path / 'data').iterdir()) == [folder]
    assert {path.name: path.read_text() for path in folder.iterdir()} == files


@pytest.mark.parametrize('folder', ['/proc/nope', '/dev/null/nope', '/dev/null'])
def test_a_folder_in_which_nothing_can_be_written_is_refused(folder):
    with pytest.raises(InputError, match='set data_dir') as caught:
        open_archive(Path(folder))
    assert folder in str(caught.value)
    assert '\n' not in str(caught.value)


def test_poses_of_two_nodes_that_would_write_one_journal_are_kept(tmp_path, monkeypatch):
    """After the clock was set back both chose the name behind the newest: poses were lost."""
    folder, elsewhere = tmp_path / 'data', tmp_path / 'tmp'
    elsewhere.mkdir()
    open_archive(folder)
    (folder / 'arm_20990101T000000000000Z.csv').touch()
    first, second = open_archive(folder), open_archive(folder)
    for archive in (first, second):
        archive.add(sample(1))
        archive.add(sample(2))
    assert not first.error
    assert second.error.startswith(f'another process writes {first.journal}: stop it')
    with pytest.raises(InputError, match='in memory only and would be lost'):
        second.start_new()
    monkeypatch.setattr(tempfile, 'tempdir', str(elsewhere))
    words = second.close()
    (journal,) = elsewhere.glob('*/*.csv')
    assert f'poses are in {journal}, not in {folder}: another process' in words
    assert stamps(journal.parent) == stamps(folder) == [1, 2]


def test_a_note_that_cannot_be_written_is_none(tmp_path):
    """It left ~/identify without an answer, and the next call refused as still running."""
    archive = open_archive(tmp_path)
    archive.add(sample(1))
    archive.journal.with_suffix('.identified.txt').mkdir()
    assert archive.note('text', archive.path) is None


@pytest.mark.parametrize('how', ['deleted', 'folder deleted', 'replaced', 'cut', 'emptied'])
def test_a_journal_that_is_not_there_any_more_goes_on_in_another_file(tmp_path, how):
    folder = tmp_path / 'data'
    archive = open_archive(folder)
    archive.add(sample(1))
    archive.add(sample(2))
    first = archive.journal
    if how == 'folder deleted':
        shutil.rmtree(folder)
        folder.write_text('in the way')
        archive.write()
        assert 'in memory only' in archive.trouble
        folder.unlink()
    elif how == 'replaced':
        (folder / 'edited').write_text('by an editor')
        (folder / 'edited').replace(first)
    elif how in ('cut', 'emptied'):  # by an editor that saves in place
        os.truncate(first, first.stat().st_size - 20 if how == 'cut' else 0)
    else:
        first.unlink()
    archive.add(sample(3))
    assert not archive.error
    assert stamps(folder) == [1, 2, 3]
    assert archive.start_new().exists()
    archive.close()
    if how == 'replaced':
        assert first.read_text() == 'by an editor'


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
