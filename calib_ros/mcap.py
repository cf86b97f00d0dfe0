# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Records of mcap files (mcap.dev/spec, version 0)."""

from __future__ import annotations

import importlib
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from typing import TypeVar

MAGIC = b'\x89MCAP0\r\n'
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
MESSAGE_HEAD = 22
"""Bytes before the data of a message."""
_HEAD = struct.Struct('<BQ')  # kind and size
_LOGGED = struct.Struct('<HIQ')  # channel, sequence and log time
_CHUNK = struct.Struct('<QQQI')  # first and last log time, uncompressed size and checksum

Channel = TypeVar('Channel')


def records(content: bytes, start: int = 0) -> Iterator[tuple[int, bytes]]:
    """Yield (kind, content) of the records, those in chunks included.

    Raises
    ------
    EOFError
        When the last one is cut off, after what it holds.

    """
    while start < len(content):
        kind, size = _HEAD.unpack_from(content, start)
        start += _HEAD.size
        record = content[start : start + size]
        if kind == CHUNK:
            yield from records(_unpacked(record))
        elif len(record) == size:
            yield kind, record
        if len(record) < size:
            raise EOFError(f'{size - len(record)} bytes are missing at the end')
        start += size


def logged(chunk: bytes, channels: Mapping[int, Channel]) -> Iterator[tuple[Channel, bytes]]:
    """Yield the messages on some channels of a chunk, in the order in which they were logged.

    Parameters
    ----------
    chunk : bytes
        Its record, with kind and size.
    channels : mapping
        By their numbers.

    Raises
    ------
    ValueError
        When the chunk does not have its size and checksum; when a record in it is damaged, after
        the messages before it.

    """
    chunk = chunk[_HEAD.size :]
    begin, end, size, checksum = _CHUNK.unpack_from(chunk)
    content = _unpacked(chunk)
    if len(content) != size or checksum not in (0, zlib.crc32(content)):
        raise ValueError('a chunk does not have its size and checksum')
    times, found, problem = [], [], None
    try:
        for kind, record in records(content):
            if kind == MESSAGE:
                key, _, time = _LOGGED.unpack_from(record)
                if key in channels and begin <= time <= end:
                    times.append(time)
                    found.append((channels[key], record[MESSAGE_HEAD:]))
    except (EOFError, struct.error) as err:
        problem = err
    if times != sorted(times):
        found = [found[k] for k in sorted(range(len(times)), key=times.__getitem__)]
    yield from found
    if problem is not None:
        raise ValueError('a record in a chunk is damaged') from problem


def string(record: bytes, start: int) -> str:
    """Return the text at a place of a record."""
    (size,) = struct.unpack_from('<I', record, start)
    return record[start + 4 : start + 4 + size].decode()


def _unpacked(chunk: bytes) -> bytes:
    compression = string(chunk, _CHUNK.size)
    return _decompressor(compression)(chunk[_CHUNK.size + 12 + len(compression) :])


def _decompressor(name: str) -> Callable[[bytes], bytes]:
    """Return what decompresses a chunk; the modules are those that rosbags brings."""
    if not name:
        return bytes
    known = {'lz4': ('lz4.frame',), 'zstd': ('compression.zstd', 'backports.zstd', 'zstandard')}
    for module in known.get(name, ()):
        try:
            found = importlib.import_module(module)
        except ImportError:
            continue
        if module == 'zstandard':  # its plain function wants the size in the head of the frame
            found = found.ZstdDecompressor().decompressobj()
        decompress: Callable[[bytes], bytes] = found.decompress
        return decompress
    raise OSError(f'no module to decompress {name}')
