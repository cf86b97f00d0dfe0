# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import logging
import os
import resource
import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest
from archives import open_archive, sample, stamps, written

from calib_ros.errors import InputError


@contextmanager
def full_disk(limit):
    """Let no file grow beyond a limit [bytes]."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_second_node_is_told_of_the_one_that_runs_and_not_to_delete_its_journal(
    tmp_path, caplog
):
    """Before the first pose it was "to continue yesterday's instead, delete" that of the first."""
    written(tmp_path, 1)
    first, second, said = open_archive(tmp_path), open_archive(tmp_path), 'another process writes'
    first.begin(logging.getLogger())
    with pytest.raises(InputError, match=f'{said} {first.path}: stop it, or give each robot'):
        second.resume()
    first.add(sample(2))
    caplog.set_level(logging.INFO)
    second.begin(logging.getLogger())
    first.close()
    open_archive(tmp_path).begin(logging.getLogger())
    other, old = caplog.records
    assert other.message.startswith(f'{said} {first.path}: ')  # not "start with resume"
    assert old.message.endswith(f'to continue {first.path}, start with resume:=true')
    assert (other.levelname, old.levelname) == ('WARNING', 'INFO')


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
