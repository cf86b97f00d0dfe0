# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Chunks of mcap files, made here byte by byte as the specification says."""

import importlib
import struct
import sys
import tracemalloc
import zlib
from io import BytesIO
from types import SimpleNamespace

import lz4.frame
import pytest
from hypothesis import given, strategies as st

from calib_ros.errors import InputError
from calib_ros.files.compression import Room, module_of
from calib_ros.files.mcap import Opcode, logged, records
from calib_ros.texts import LARGEST_TABLE

try:
    from rosbags.rosbag2.reader import zstd
except ImportError:  # what older ones bring
    import zstandard as zstd

COMPRESSORS = {'': bytes, 'lz4': lz4.frame.compress, 'zstd': zstd.compress}
OF_DAMAGE = {'': (), 'lz4': (RuntimeError, OSError), 'zstd': (zstd.ZstdError, OSError)}
"""Errors of what unpacks, and of one whose name is damaged."""
TIMES = st.integers(0, 20)


def record(kind, content):
    return struct.pack('<BQ', kind, len(content)) + content


def message(channel, time, data):
    return record(Opcode.MESSAGE, struct.pack('<HIQQ', channel, 0, time, time) + data)


def chunk(content, compression='', checked=True, begin=0, end=2**63):
    """Return the record of a chunk."""
    name, body = compression.encode(), COMPRESSORS[compression](content)
    head = struct.pack('<QQQI', begin, end, len(content), zlib.crc32(content) if checked else 0)
    sizes = struct.pack('<I', len(name)) + name + struct.pack('<Q', len(body))
    return record(Opcode.CHUNK, head + sizes + body)


def messages_of(chunk, channels):
    return logged(chunk, channels, Room(1 << 50))


MESSAGES = [(1, 5, b'one'), (2, 6, b'other'), (1, 7, b''), (3, 7, b'three')]
CONTENT = b''.join(message(*each) for each in MESSAGES)


@given(
    st.sampled_from(sorted(COMPRESSORS)),
    st.booleans(),
    st.lists(st.tuples(st.integers(1, 3), TIMES, st.binary(max_size=9)), max_size=12),
    st.tuples(TIMES, TIMES),
)
def test_messages_come_in_the_order_of_their_log_times(compression, checked, given_, limits):
    begin, end = sorted(limits)
    content = record(Opcode.CHANNEL, b'any') + b''.join(message(*each) for each in given_)
    given_chunk = chunk(content, compression, checked, begin, end)
    found, problem = messages_of(given_chunk, {1: 'a', 3: 'c'})
    assert problem is None
    wanted = [each for each in given_ if each[0] != 2 and begin <= each[1] <= end]
    wanted.sort(key=lambda each: each[1])
    names = {1: 'a', 3: 'c'}
    assert found == [(time, names[channel], data) for channel, time, data in wanted]


@pytest.mark.parametrize('compression', sorted(COMPRESSORS))
def test_a_chunk_with_a_wrong_byte_is_refused(compression):
    good = chunk(CONTENT, compression)
    whole = messages_of(good, {1: 1, 2: 2, 3: 3})
    assert len(whole[0]) == 4
    for place in range(25, len(good)):  # from the size on
        bad = bytearray(good)
        bad[place] ^= 0x55
        try:
            found = messages_of(bytes(bad), {1: 1, 2: 2, 3: 3})
        except (ValueError, InputError, *OF_DAMAGE[compression]):
            continue
        # Bytes that no reader needs, such as the checksum that a compressor adds.
        assert found == whole, place


def test_a_chunk_that_is_cut_off_is_refused():
    good = chunk(CONTENT, checked=False)
    for length in range(len(good)):
        with pytest.raises((ValueError, struct.error)):
            messages_of(good[:length], {1: 1})


@pytest.mark.parametrize('lost', [2, 34])  # within its data, and its head
def test_the_messages_before_a_damaged_one_are_used(lost):
    found, problem = messages_of(chunk(CONTENT[:-lost]), {1: 'a', 3: 'c'})
    assert found == [(5, 'a', b'one'), (7, 'a', b'')]
    assert 'a record in a chunk is damaged' in str(problem)


def test_an_unknown_compression_is_named():
    named = chunk(CONTENT, 'zstd').replace(b'zstd', b'brot')
    with pytest.raises(OSError, match='decompress brot'):
        messages_of(named, {1: 1})


@pytest.fixture
def unknown():
    """Nobody has looked for what unpacks before, nor will know what was found."""
    module_of.cache_clear()
    yield
    module_of.cache_clear()


@pytest.mark.usefixtures('unknown')
def test_what_unpacks_is_looked_for_once(monkeypatch):
    """A module that is not there takes 0.15 ms to be missed: ten times as long as a message."""
    sought, find = [], importlib.import_module
    monkeypatch.setattr(importlib, 'import_module', lambda name: sought.append(name) or find(name))
    for _ in range(3):
        messages_of(chunk(CONTENT, 'zstd'), {3: 'c'})
    assert sought
    assert len(set(sought)) == len(sought)


@pytest.mark.usefixtures('unknown')
def test_the_zstd_of_older_rosbags_will_do(monkeypatch):
    class Decompressor:
        def stream_reader(self, data):
            return BytesIO(zstd.decompress(data))

    for module in ('compression.zstd', 'backports.zstd'):
        monkeypatch.setitem(sys.modules, module, None)
    named = SimpleNamespace(ZstdDecompressor=Decompressor, ZstdCompressionDict=None)
    monkeypatch.setitem(sys.modules, 'zstandard', named)
    assert messages_of(chunk(CONTENT, 'zstd'), {3: 'c'}) == ([(7, 'c', b'three')], None)


@pytest.mark.parametrize('compression', ['lz4', 'zstd'])
@pytest.mark.parametrize('said', [100, 1 << 40])
def test_a_chunk_that_unpacks_to_more_than_it_says_or_may_is_refused(compression, said):
    bomb = bytearray(chunk(bytes(LARGEST_TABLE + 1000), compression))
    bomb[25:33] = struct.pack('<Q', said)
    assert len(bomb) < 1_000_000
    tracemalloc.start()
    with pytest.raises(ValueError, match='more than'):
        messages_of(bytes(bomb), {1: 1})
    with pytest.raises(ValueError, match='more than'):
        list(records(bytes(bomb)))
    assert tracemalloc.get_traced_memory()[1] < 2.5 * LARGEST_TABLE
    tracemalloc.stop()


def test_chunks_within_chunks_are_refused():
    nested = chunk(chunk(CONTENT))
    with pytest.raises(ValueError, match='a chunk is within a chunk'):
        list(records(nested))
    found, problem = messages_of(nested, {1: 1})
    assert found == []
    assert problem is not None


def test_many_chunks_are_not_more_than_any_recording_holds():
    bomb = chunk(record(0x0A, bytes(LARGEST_TABLE // 2)), 'zstd') * 3
    with pytest.raises(InputError, match='times its size'):
        list(records(bomb))


def test_records_of_chunks_come_among_the_others():
    content = CONTENT + chunk(CONTENT, 'lz4') + message(1, 8, b'last')
    found = [record[22:] for kind, record in records(content) if kind == Opcode.MESSAGE]
    assert found == [*(each[2] for each in MESSAGES * 2), b'last']
