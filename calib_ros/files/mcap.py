# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Records of mcap files (mcap.dev/spec, version 0)."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from enum import IntEnum
from mmap import mmap
from operator import itemgetter
from pathlib import Path
from typing import TypeAlias, TypeVar

from calib_ros.files.compression import Room, decompressed
from calib_ros.texts import LARGEST_TABLE

MAGIC = b'\x89MCAP0\r\n'
_HEAD = struct.Struct('<BQ')  # kind and size
_LOGGED = struct.Struct('<HIQQ')  # channel, sequence, log time, publish time
MESSAGE_HEAD = _LOGGED.size
_CHUNK = struct.Struct('<QQQI')  # first and last log time, uncompressed size and checksum
FOOTER = _HEAD.size + struct.calcsize('<QQI') + len(MAGIC)
"""Bytes of the last record, with the place of the index, and of the magic."""
Channel = TypeVar('Channel')
Content: TypeAlias = 'bytes | mmap'


class Opcode(IntEnum):
    """Opcodes of records."""

    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    CHUNK_INDEX = 0x08
    STATISTICS = 0x0B
    DATA_END = 0x0F


def is_indexed(file: Path) -> bool:
    """Tell whether a file ends with an index of its chunks, or a summary of its topics."""
    size = file.stat().st_size
    with file.open('rb') as content:
        content.seek(max(0, size - FOOTER))
        try:
            (begin,) = struct.unpack_from('<Q', content.read(FOOTER), _HEAD.size)
        except struct.error:
            return False
        kinds = set()
        while 0 < begin <= size - FOOTER:
            content.seek(begin)
            kind, length = _HEAD.unpack(content.read(_HEAD.size))
            kinds.add(kind)
            begin += _HEAD.size + length
    return Opcode.CHUNK_INDEX in kinds or {Opcode.STATISTICS, Opcode.SCHEMA} <= kinds


def records(content: Content, start: int = 0, nested: bool = False) -> Iterator[tuple[int, bytes]]:
    """Yield (kind, content) of the records, including those in chunks.

    Raises EOFError at a cut-off record, ValueError for a nested chunk, InputError for too much
    data.
    """
    room, chunk = Room(len(content)), int(Opcode.CHUNK)
    while start < len(content):
        kind, size = _HEAD.unpack_from(content, start)
        start += _HEAD.size
        record = content[start : start + size]
        if kind == chunk:
            if nested:
                raise ValueError('a chunk is within a chunk')
            unpacked = _unpacked(record)
            room.take(len(unpacked))
            yield from records(unpacked, nested=True)
        elif len(record) == size:
            yield kind, record
        if len(record) < size:
            raise EOFError(f'{size - len(record)} bytes are missing at the end')
        start += size


def logged(
    chunk: bytes, channels: Mapping[int, Channel], room: Room
) -> tuple[list[tuple[int, Channel, bytes]], Exception | None]:
    """Return the messages of a chunk on some channels (by number), in order of log time.

    Each is log time, channel and data; an error in a record ends them and is returned too. The
    chunk is a record with kind and size.
    """
    chunk = chunk[_HEAD.size :]
    begin, end, size, checksum = _CHUNK.unpack_from(chunk)
    room.take(size)
    content = _unpacked(chunk)
    if len(content) != size or checksum not in (0, zlib.crc32(content)):
        raise ValueError('a chunk does not have its size and checksum')
    found, problem, message = [], None, int(Opcode.MESSAGE)
    try:
        for kind, record in records(content, nested=True):
            if kind == message:
                key, _, time, _ = _LOGGED.unpack_from(record)
                if key in channels and begin <= time <= end:
                    found.append((time, channels[key], record[MESSAGE_HEAD:]))
    except (EOFError, ValueError, struct.error):
        problem = ValueError('a record in a chunk is damaged')
    found.sort(key=itemgetter(0))
    return found, problem


def string(record: bytes, start: int) -> str:
    """Return the text at an offset of a record."""
    (size,) = struct.unpack_from('<I', record, start)
    return record[start + 4 : start + 4 + size].decode()


def _unpacked(chunk: bytes) -> bytes:
    size = _CHUNK.unpack_from(chunk)[2]
    if size > LARGEST_TABLE:
        raise ValueError(f'a chunk has {size} bytes, more than {LARGEST_TABLE}')
    compression = string(chunk, _CHUNK.size)
    return decompressed(chunk[_CHUNK.size + 12 + len(compression) :], compression, size)
