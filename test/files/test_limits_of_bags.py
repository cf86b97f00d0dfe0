# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags that stand for more than they hold, and such of which much is lost."""

import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from recorded import ARM

from calib_ros.errors import InputError
from calib_ros.estimation.observations import Observations
from calib_ros.files.bags import Replayed, replay
from calib_ros.files.recording import Recording, write_bag
from calib_ros.files.stored import recorded
from calib_ros.sampling.account import Cause
from calib_ros.sampling.buffers import TOO_LATE
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.slices import JOINTS, POSES
from calib_ros.sampling.usable import NO_STAMP


@pytest.fixture(params=['sqlite3', 'mcap'])
def bag(tmp_path, request, rng):
    poses = Observations.from_arrays(rng.normal(size=(20, 3)), rng.normal(size=(20, 3)))
    made = Recording.of_dwells(ARM.joint_names, poses, np.zeros(20, bool))
    write_bag(tmp_path / 'bag', made, request.param)
    return tmp_path / 'bag'


@pytest.mark.parametrize(
    'content',
    [
        b'\xff\xfe\x00',
        b'rosbag2_bagfile_information:\n  message_count: many\n',
        b'rosbag2_bagfile_information:\n  message_count: ' + b'9' * 5000 + b'\n',
        b'[' * 100_000,
        b'a: &a [x, x]\nb: &b [' + b'*a, ' * 10**5 + b']\nc: [*b, *b, *b]\n',
    ],
)
def test_with_any_metadata_the_messages_are_read(bag, content):
    (bag / 'metadata.yaml').write_bytes(content)
    assert recorded(bag) is None
    taken = CalibrationSession(ARM)
    replayed = replay(bag, taken)
    assert len(taken.samples) == 20
    assert replayed.read == 120


def changed(file, *statements):
    with closing(sqlite3.connect(file, isolation_level=None)) as connection:
        for statement in statements:
            connection.execute(statement)
    return file


SCHEMA = (
    'CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, '
    'offered_qos_profiles TEXT)',
    'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, '
    'data BLOB)',
)
ENDLESS = 'WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) SELECT'


@pytest.mark.parametrize(
    'statements',
    [
        (
            SCHEMA[0],
            f'CREATE VIEW messages AS {ENDLESS} id, 1 AS topic_id, 0 AS timestamp, '
            'zeroblob(1000000) AS data FROM n',
        ),
        (f"CREATE VIEW topics AS {ENDLESS} id, 'a' AS name, 'b' AS type FROM n", SCHEMA[1]),
        (SCHEMA[0], SCHEMA[1].replace('data BLOB', 'data AS (zeroblob(1000000000))')),
        (SCHEMA[0], SCHEMA[1].replace(' PRIMARY KEY', '')),
    ],
)
def test_a_database_that_computes_what_it_holds_is_refused(tmp_path, statements):
    path = changed(tmp_path / 'bag.db3', *statements)
    with pytest.raises(InputError, match='is not what a recorder makes'):
        replay(path, CalibrationSession(ARM))


@pytest.mark.parametrize('bag', ['sqlite3'], indirect=True)
def test_messages_without_data_are_lost_and_no_more(bag):
    (file,) = bag.glob('*.db3')
    changed(
        file,
        'PRAGMA writable_schema=ON',
        "UPDATE sqlite_master SET sql=replace(sql, 'BLOB NOT NULL', 'BLOB') WHERE name='messages'",
    )
    changed(file, 'UPDATE messages SET data=NULL WHERE id=7')
    replayed = replay(bag, CalibrationSession(ARM))
    assert (replayed.recorded, replayed.read) == (120, 119)
    assert 'cannot be decoded' in replayed.warnings[0]


@pytest.mark.parametrize('bag', ['sqlite3'], indirect=True)
@pytest.mark.parametrize('known', [True, False])
@pytest.mark.parametrize('column', ['name', 'type'])
def test_topics_whose_names_are_no_text_are_not_read(bag, column, known):
    (file,) = bag.glob('*.db3')
    changed(file, f"UPDATE topics SET {column}=x'05' WHERE type LIKE '%Point%'")
    if known:  # the metadata name them
        replayed = replay(bag, CalibrationSession(ARM))
        assert (replayed.recorded, replayed.read) == (120, 100)
        return
    (bag / 'metadata.yaml').unlink()
    with pytest.raises(InputError, match='has no pose topic'):
        replay(bag, CalibrationSession(ARM))


@pytest.mark.parametrize(
    ('recorded_', 'read', 'largest', 'refused'),
    [
        (100, 100, 0.1, ''),
        (100, 91, 0.1, ''),
        (100, 80, 0.1, '20 % of the messages could not be read'),
        (100, 80, 0.25, ''),
        (None, 80, 0.1, 'not known'),
        (None, 80, 1.0, ''),
    ],
)
def test_a_bag_of_which_much_is_lost_is_not_accepted(recorded_, read, largest, refused):
    account = CalibrationSession(ARM).account()
    found = Replayed(recorded_, read).refusals(account, largest)
    assert bool(found) == bool(refused)
    assert all(refused in reason and '--largest-loss' in reason for reason in found)


@pytest.mark.parametrize(
    ('cause', 'refused'),
    [
        (Cause(POSES, NO_STAMP), True),
        (Cause(POSES, TOO_LATE), True),
        (Cause(JOINTS, NO_STAMP), False),
        (Cause(POSES, str(NO_STAMP)), False),  # the words alone do not decide
    ],
)
def test_messages_dropped_for_their_stamps_count_as_lost(cause, refused):
    account = replace(CalibrationSession(ARM).account(), poses=100, dropped={cause: 50})
    assert bool(Replayed(100, 100).refusals(account, 0.1)) == refused
