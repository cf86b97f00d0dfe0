# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages come as the library gives them, and in its order."""

import struct
from types import SimpleNamespace

import pytest
from recorded import STREAMS, record_in_chunks, session_of
from rosbags.rosbag2 import Reader

from calib_ros.files.mcap import MAGIC, Opcode, records
from calib_ros.files.stored import CHUNK, STORAGE, read
from calib_ros.settings import STORAGES

COMPRESSIONS = [
    *((storage, mode) for storage in sorted(STORAGES) for mode in ('none', 'message', 'file')),
    ('mcap', 'storage'),
]
LOG_TIMES = {
    'in order': lambda k, rng: k,
    'of a coarse clock': lambda k, rng: k // 40,
    'not in order within a chunk': lambda k, rng: k - (k - 1) % 5 + rng.integers(5),
    'not in order among chunks': lambda k, rng: rng.integers(300),
}


@pytest.mark.parametrize(
    ('storage', 'mode', 'log_times'),
    [
        *((*each, 'in order') for each in COMPRESSIONS),
        *(('mcap', mode, times) for mode in ('none', 'storage') for times in [*LOG_TIMES][1:]),
    ],
)
def test_messages_are_those_of_the_library_in_its_order(tmp_path, storage, mode, log_times):
    path = record_in_chunks(tmp_path / 'bag', storage, mode, LOG_TIMES[log_times])
    with Reader(path) as reader:
        connections = [each for each in reader.connections if each.topic in STREAMS]
        library = list(reader.messages(connections))
        found = list(read(reader, STREAMS))
    times = {bytes(data): time for _, time, data in library}
    assert len(times) == 280
    # Of messages of one time, which comes first differs between versions of the library.
    assert [times[data] for _, data in found] == [time for _, time, _ in library]
    streams = {bytes(data): STREAMS[each.topic] for each, _, data in library}
    assert {data: stream for stream, data in found} == streams


@pytest.mark.parametrize('summary', [True, False])
@pytest.mark.parametrize('log_times', LOG_TIMES)
def test_messages_without_chunks_come_as_they_stand_in_the_file(tmp_path, log_times, summary):
    """As of rosbag2 with the preset fastwrite; its log times need not be in order."""
    path = record_in_chunks(tmp_path / 'bag', 'mcap', log_time=LOG_TIMES[log_times])
    (file,) = path.glob('*.mcap')
    stream = records(file.read_bytes()[: -len(MAGIC)], len(MAGIC))
    found = [(kind, struct.pack('<BQ', kind, len(each)) + each) for kind, each in stream]
    end = 1 + [kind for kind, _ in found].index(Opcode.DATA_END)
    flat = MAGIC + b''.join(each for _, each in found[:end])
    kept = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS) if summary else ()
    behind = b''.join(each for kind, each in found[end:] if kind in kept)
    footer = struct.pack('<BQQQI', 2, 20, len(flat) if summary else 0, 0, 0)
    file.write_bytes(flat + behind + footer + MAGIC)
    (path / 'metadata.yaml').unlink()  # nobody tells how many there were, and none is missing
    session, warnings = session_of(file)
    account = session.account()
    assert (account.joint_states, account.poses) == (180, 100)
    assert not warnings


def test_chunks_without_an_index_of_their_messages_are_read(tmp_path):
    path = record_in_chunks(tmp_path / 'bag', 'mcap')
    with Reader(path) as reader:
        expected = list(read(reader, STREAMS))
        for chunk in reader.storage.storages[0].chunks:
            chunk.channel_count.clear()
        assert list(read(reader, STREAMS)) == expected
    assert len(expected) == 280


@pytest.mark.parametrize('missing', ['storage', *STORAGE, *CHUNK])
def test_a_library_with_other_attributes_is_asked_itself(missing):
    chunk = SimpleNamespace(**dict.fromkeys(CHUNK, 1))
    storage = SimpleNamespace(**dict.fromkeys(STORAGE), storages=None)
    storage.chunks, storage.storages = [chunk], [storage]
    pose = SimpleNamespace(topic='/pose', msgtype=STREAMS['/pose'].type)
    reader = SimpleNamespace(
        storage=storage,
        compression_mode=None,
        connections=[pose],
        messages=lambda connections: [(connections[0], 1, b'data')],
    )
    for each in (reader, storage, chunk):
        if hasattr(each, missing) and not (each is reader and missing == 'connections'):
            delattr(each, missing)
    assert list(read(reader, STREAMS)) == [(STREAMS['/pose'], b'data')]


def test_the_files_of_a_split_bag_are_read_one_after_the_other(tmp_path):
    path, other = (record_in_chunks(tmp_path / name, 'mcap') for name in ('bag', 'other'))
    (other / 'other.mcap').rename(path / 'a.mcap')
    metadata = (path / 'metadata.yaml').read_text()
    (path / 'metadata.yaml').write_text(
        metadata.replace('  - bag.mcap', '  - bag.mcap\n  - a.mcap')
    )
    with Reader(path) as reader:
        connections = [each for each in reader.connections if each.topic in STREAMS]
        expected = [(STREAMS[c.topic], bytes(data)) for c, _, data in reader.messages(connections)]
        assert list(read(reader, STREAMS)) == expected
    assert len(expected) == 560
