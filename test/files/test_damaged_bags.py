# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import re
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from recorded import (
    ARM,
    MS,
    STREAMS,
    assert_equal,
    damage,
    observations_of,
    pose_stamped,
    record,
    record_in_chunks,
    recording,
    session_of,
    standing,
    storages,
    text_message,
)
from rosbags.rosbag2 import Reader

from calib_ros.errors import InputError
from calib_ros.files.bags import replay
from calib_ros.files.recording import write_bag
from calib_ros.sampling.session import CalibrationSession
from calib_ros.settings import STORAGES


@pytest.fixture(scope='module')
def long_bags(tmp_path_factory):
    """A bag of each storage, and the observations in it."""
    folder = tmp_path_factory.mktemp('long')
    for storage in STORAGES:
        write_bag(folder / storage, recording(80), storage)
    return folder, observations_of(folder / STORAGES[0])


@storages
@pytest.mark.parametrize(
    ('metadata', 'alone', 'share'), [(True, False, 0.45), (False, False, 0.55), (True, True, 0.8)]
)
def test_of_a_truncated_bag_the_rest_is_used(tmp_path, long_bags, storage, metadata, alone, share):
    folder, whole = long_bags
    path = shutil.copytree(folder / storage, tmp_path / 'bag')
    file = damage(path, share, metadata)
    session, warnings = session_of(file if alone else path)
    part = session.problem().observations
    (warning,) = warnings
    assert str(path) in warning
    assert 'is damaged (the file is cut off' in warning or 'is damaged (cut off' in warning
    assert 'lost' in warning
    account = session.account()
    assert str(account.joint_states + account.poses) in warning
    assert 0.2 * share * len(whole) < len(part) < len(whole)
    # What is read is what was recorded.
    index = np.searchsorted(whole.stamps_ns, part.stamps_ns)
    np.testing.assert_array_equal(whole.stamps_ns[index], part.stamps_ns)
    np.testing.assert_array_equal(whole.positions[index], part.positions)
    np.testing.assert_array_equal(whole.joints[index], part.joints)


@storages
def test_of_a_split_bag_a_missing_file_is_told(tmp_path, long_bags, storage):
    path = shutil.copytree(long_bags[0] / storage, tmp_path / 'bag')
    (file,) = (each for each in path.iterdir() if each.suffix != '.yaml')
    text = (path / 'metadata.yaml').read_text()
    text = text.replace(f'  - {file.name}\n', f'  - {file.name}\n  - bag_1{file.suffix}\n')
    text = re.sub(r'(?m)^  message_count: [0-9]+', '  message_count: 1000000', text)
    (path / 'metadata.yaml').write_text(text)
    _, (warning,) = session_of(path)
    assert 'damaged (is a file of it missing?): ' in warning


@storages
def test_the_files_of_a_split_bag_that_was_not_closed_are_in_order(tmp_path, storage):
    """Which also tell of those between."""
    for k in (0, 9, 10):
        made = recording(20)
        stamps, later = made.poses.stamps_ns, k * 10**11
        made = replace(
            made, joint_stamps_ns=made.joint_stamps_ns + later, poses=made.poses.at(stamps + later)
        )
        write_bag(tmp_path / 'part', made, storage)
        (file,) = (each for each in (tmp_path / 'part').iterdir() if each.suffix != '.yaml')
        (tmp_path / 'bag').mkdir(exist_ok=True)
        file.rename(tmp_path / 'bag' / f'bag_{k}{file.suffix}')
        shutil.rmtree(tmp_path / 'part')
    session = CalibrationSession(ARM)
    found = replay(tmp_path / 'bag', session)
    assert session.account().notes == {}
    assert found.recorded is None  # so the result is refused
    assert 'damaged (a file of it is missing): ' in found.warnings[0]


@storages
def test_a_bag_that_was_never_closed_is_read(tmp_path, storage):
    write_bag(tmp_path / 'bag', recording(), storage)
    whole = observations_of(tmp_path / 'bag')
    damage(tmp_path / 'bag', metadata=False)
    path = (tmp_path / 'bag').rename(tmp_path / 'cell #1 50%20?')
    session, warnings = session_of(path)
    assert_equal(session.problem().observations, whole)
    assert len(warnings) == 1


@pytest.mark.parametrize('alone', [True, False])
def test_the_log_beside_a_database_is_read_and_left_as_it_is(tmp_path, long_bags, alone):
    """Of a recorder that was killed, what came last is in its write-ahead log only."""
    folder, whole = long_bags
    (file,) = shutil.copytree(folder / 'sqlite3', tmp_path / 'at work').glob('*.db3')
    path = tmp_path / 'bag'
    path.mkdir()
    with closing(sqlite3.connect(file, isolation_level=None)) as recorder:
        recorder.execute('PRAGMA journal_mode=WAL')
        recorder.execute('CREATE TEMP TABLE last AS SELECT * FROM messages WHERE id > 100')
        recorder.execute('DELETE FROM messages WHERE id > 100')
        recorder.execute('PRAGMA wal_checkpoint(TRUNCATE)')
        recorder.execute('INSERT INTO messages SELECT * FROM last')
        for each in (file, file.with_name(f'{file.name}-wal')):
            shutil.copy(each, path)
            (path / each.name).chmod(0o444)
    before = {each: each.read_bytes() for each in path.iterdir()}
    path.chmod(0o555)
    session, warnings = session_of(path / file.name if alone else path)
    path.chmod(0o755)
    assert_equal(session.problem().observations, whole)
    unknown = [each for each in warnings if 'how many are lost is not known' in each]
    assert len(warnings) == len(unknown) == (not alone)  # without metadata it was not closed
    assert {each: each.read_bytes() for each in path.iterdir()} == before
    log = path / f'{file.name}-wal'
    log.chmod(0o644)
    log.write_bytes(b'\0' + log.read_bytes()[1:])
    with pytest.raises(InputError, match='wal is damaged, so the last messages cannot be read'):
        session_of(path / file.name if alone else path)


@storages
def test_the_count_of_a_damaged_bag_is_of_the_messages_used(tmp_path, storage):
    events = [*standing([pose_stamped(105 * MS)]), *[('/chatter', text_message())] * 7]
    path = record(tmp_path / 'bag', events, storage)
    damage(path, metadata=False)
    assert ' 101 messages' in session_of(path)[1][0]


@pytest.mark.parametrize('share', [0.3, 0.9])
def test_of_a_truncated_compressed_bag_the_whole_chunks_are_used(tmp_path, share):
    path = record_in_chunks(tmp_path / 'bag', 'mcap', 'storage')
    session, warnings = session_of(damage(path, share))
    assert 30 * share < session.account().poses < 100
    assert len(warnings) == 1


@storages
def test_a_hole_in_a_file_is_reported(tmp_path, long_bags, storage):
    path = shutil.copytree(long_bags[0] / storage, tmp_path / 'bag')
    file = damage(path)
    content = bytearray(file.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 9000] = b'\xff' * 9000
    file.write_bytes(bytes(content))
    session, warnings = session_of(path)
    account = session.account()
    assert 0 < account.samples < 80
    assert len(warnings) == 1
    assert 'lost' in warnings[0]


@pytest.mark.parametrize('damaged', [0, 5])
def test_a_damaged_chunk_costs_its_messages_only(tmp_path, damaged):
    path = record_in_chunks(tmp_path / 'bag', 'mcap')
    with Reader(path) as reader:
        chunks = list(reader.storage.storages[0].chunks)
        wanted = [each.id for each in reader.connections if each.topic in STREAMS]
    assert len(chunks) > 6
    lost = sum(chunks[damaged].channel_count.get(key, 0) for key in wanted)
    file = damage(path)
    content = bytearray(file.read_bytes())
    place = chunks[damaged].chunk_start_offset + 33
    content[place : place + 4] = b'\1\2\3\4'  # not its checksum
    file.write_bytes(bytes(content))
    session, (warning,) = session_of(path)
    account = session.account()
    assert 10 < lost < 100
    assert account.joint_states + account.poses == 280 - lost
    assert f'{lost} of 280 messages are lost' in warning


GARBAGE = (b'', b'garbage ' * 500, b'\x89MCAP0\r\n' + b'\x05' * 500)
GARBAGE += (b'SQLite format 3\0' + b'\x01' * 500,)


METADATA = (b'', b'\xff\xfe', b'- 1', b'rosbag2_bagfile: {')


@pytest.mark.parametrize(
    ('file', 'content'),
    [
        *((name, c) for name in ('bag.mcap', 'bag.db3', 'bag.bag', 'bag') for c in GARBAGE),
        ('folder/notes.txt', b'no bag'),
        *(('folder/metadata.yaml', content) for content in METADATA),
    ],
)
def test_what_is_no_bag_is_refused(tmp_path, file, content):
    path = tmp_path / file.partition('/')[0]
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_bytes(content)
    with pytest.raises(InputError, match='not a readable rosbag2 recording') as caught:
        session_of(path)
    assert str(path) in str(caught.value)
    assert 'copy it again from the computer' in str(caught.value)
    convert = f'rosbags-convert --src {path} --dst FOLDER'
    assert (convert in str(caught.value)) == (path.suffix == '.bag')


def test_one_packed_message_that_is_damaged_costs_no_other(tmp_path):
    path = record_in_chunks(tmp_path / 'bag', 'sqlite3', 'message')
    (file,) = path.glob('*.db3')
    with closing(sqlite3.connect(file, isolation_level=None)) as connection:
        connection.execute("UPDATE messages SET data = x'0011223344' WHERE id = 7")
    session, (warning,) = session_of(path)
    account = session.account()
    assert account.joint_states + account.poses == 279
    assert '1 of 280 messages are lost' in warning


@storages
@pytest.mark.parametrize('alone', [True, False])
def test_packed_messages_need_no_metadata(tmp_path, storage, alone):
    """Only metadata tell of compression; a killed recorder leaves none."""
    path = record_in_chunks(tmp_path / 'bag', storage, 'message')
    file = damage(path, metadata=alone)
    account = session_of(file if alone else path)[0].account()
    assert account.joint_states + account.poses == 280
