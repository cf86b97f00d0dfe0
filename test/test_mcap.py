# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Chunks of mcap files, made here byte by byte as the specification says."""

import struct
import sys
import zlib
from types import SimpleNamespace

import lz4.frame
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib_ros.mcap import CHANNEL, CHUNK, MESSAGE, logged, records

try:
    from rosbags.rosbag2.reader import zstd
except ImportError:  # what older ones bring
    import zstandard as zstd

COMPRESSORS = {'': bytes, 'lz4': lz4.frame.compress, 'zstd': zstd.compress}
TIMES = st.integers(0, 20)


def record(kind, content):
    return struct.pack('<BQ', kind, len(content)) + content


def message(channel, time, data):
    return record(MESSAGE, struct.pack('<HIQQ', channel, 0, time, time) + data)


def chunk(content, compression='', checked=True, begin=0, end=2**63):
    """Return the record of a chunk."""
    name, body = compression.encode(), COMPRESSORS[compression](content)
    head = struct.pack('<QQQI', begin, end, len(content), zlib.crc32(content) if checked else 0)
    sizes = struct.pack('<I', len(name)) + name + struct.pack('<Q', len(body))
    return record(CHUNK, head + sizes + body)


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
    content = record(CHANNEL, b'any') + b''.join(message(*each) for each in given_)
    found = list(logged(chunk(content, compression, checked, begin, end), {1: 'a', 3: 'c'}))
    wanted = [each for each in given_ if each[0] != 2 and begin <= each[1] <= end]
    wanted.sort(key=lambda each: each[1])
    assert found == [({1: 'a', 3: 'c'}[channel], data) for channel, _, data in wanted]


@pytest.mark.parametrize('compression', sorted(COMPRESSORS))
def test_a_chunk_with_a_wrong_byte_is_refused(compression):
    good = chunk(CONTENT, compression)
    whole = list(logged(good, {1: 1, 2: 2, 3: 3}))
    assert len(whole) == 4
    for place in range(25, len(good)):  # from the size on
        bad = bytearray(good)
        bad[place] ^= 0x55
        try:
            found = list(logged(bytes(bad), {1: 1, 2: 2, 3: 3}))
        except Exception:
            continue
        # Bytes that no reader needs, such as the checksum that a compressor adds.
        assert found == whole, place


def test_a_chunk_that_is_cut_off_is_refused():
    good = chunk(CONTENT, checked=False)
    for length in range(len(good)):
        with pytest.raises((ValueError, struct.error)):
            list(logged(good[:length], {1: 1}))


def test_the_messages_before_a_damaged_one_are_used():
    found = logged(chunk(CONTENT[:-2]), {1: 'a', 3: 'c'})
    assert [next(found), next(found)] == [('a', b'one'), ('a', b'')]
    with pytest.raises(ValueError, match='a record in a chunk is damaged'):
        next(found)


def test_an_unknown_compression_is_named():
    named = chunk(CONTENT, 'zstd').replace(b'zstd', b'brot')
    with pytest.raises(OSError, match='decompress brot'):
        next(logged(named, {1: 1}))


def test_the_zstd_of_older_rosbags_will_do(monkeypatch):
    class Decompressor:
        def decompressobj(self):
            return SimpleNamespace(decompress=zstd.decompress)

    for module in ('compression.zstd', 'backports.zstd'):
        monkeypatch.setitem(sys.modules, module, None)
    named = SimpleNamespace(ZstdDecompressor=Decompressor)
    monkeypatch.setitem(sys.modules, 'zstandard', named)
    assert list(logged(chunk(CONTENT, 'zstd'), {3: 'c'})) == [('c', b'three')]


def test_records_of_chunks_come_among_the_others():
    content = CONTENT + chunk(CONTENT, 'lz4') + message(1, 8, b'last')
    found = [record[22:] for kind, record in records(content) if kind == MESSAGE]
    assert found == [*(each[2] for each in MESSAGES * 2), b'last']
