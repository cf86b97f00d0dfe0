# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of an open bag, in the order in which they were logged."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any

from calib_ros.errors import MOST_ENTRIES
from calib_ros.files.mcap import Room, logged, unpacked, unpacked_size
from calib_ros.files.salvage import Salvage
from calib_ros.sampling.intake import Stream
from calib_ros.sampling.messages import PICTURES
from calib_ros.texts import LARGEST_TABLE

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

STORAGE = ('chunks', 'connections', 'path')
TIMES = ('message_start_time', 'message_end_time')
CHUNK = (*TIMES, 'channel_count', 'chunk_start_offset', 'chunk_length', 'uncompressed_size')
"""What the library does not promise: without them, it is asked for the messages itself."""
LARGEST_MESSAGE = 64 * MOST_ENTRIES
"""Bytes of a message: those of a joint in a joint state, its name and three numbers, for each."""
LARGEST_IMAGE = 2 * LARGEST_TABLE
"""Bytes of an image, as a message or a file."""


def largest(stream: Stream) -> int:
    """Return how many bytes a message of a stream may have."""
    return LARGEST_IMAGE if stream.type in PICTURES else LARGEST_MESSAGE


def read(reader: Reader, streams: Mapping[str, Stream]) -> Iterator[tuple[Stream, bytes]]:
    """Return the messages of an open bag on some topics, in the order in which they were logged.

    Those of mcap files come chunk by chunk, merged where chunks overlap in time, and as they
    stand in the file where it has none. All others come as the library reads them.
    """
    storage = getattr(reader, 'storage', None)
    storages = getattr(storage, 'storages', [storage])
    if not all(map(_is_known, storages)):
        connections = [c for c in reader.connections if c.topic in streams]
        return (
            (streams[c.topic], data)
            for c, _, data in reader.messages(connections)
            if c.msgtype == streams[c.topic].type
        )
    found = itertools.chain.from_iterable(_stored(each, streams) for each in storages)
    if reader.compression_mode == 'message':
        return ((stream, _unpacked(data, largest(stream))) for stream, data in found)
    return found


def _unpacked(data: bytes, most: int) -> bytes:
    """Return a message, without any bytes where it cannot be unpacked: the next one may be."""
    try:
        return unpacked(data, 'zstd', most)
    except OSError:  # nothing to unpack with
        raise
    except Exception:  # decompressors have errors of their own
        return b''


def _is_known(storage: Any) -> bool:
    """Return whether it is a database, or an mcap file with what is needed of its index."""
    if hasattr(storage, 'dbconn'):
        return True
    if not all(hasattr(storage, name) for name in STORAGE):
        return False
    return all(hasattr(each, name) for each in storage.chunks for name in CHUNK)


def _stored(storage: Any, streams: Mapping[str, Stream]) -> Iterator[tuple[Stream, bytes]]:
    """Yield the messages of a file; what is wrong with a chunk is raised at the end."""
    wanted = [
        each
        for each in storage.connections
        if each.topic in streams and each.msgtype == streams[each.topic].type
    ]
    channels = {each.id: streams[each.topic] for each in wanted}
    if hasattr(storage, 'dbconn'):
        if wanted:
            yield from ((channels[c.id], data) for c, _, data in storage.messages(wanted))
        return
    if not storage.chunks:
        whole = Salvage((storage.path,))
        yield from whole.on({each.topic: streams[each.topic] for each in wanted})
        if whole.problem:
            raise ValueError(whole.problem)
        return
    with storage.path.open('rb') as file:
        room = Room(storage.path.stat().st_size)
        problem: Exception | None = None
        for overlapping in _together(storage.chunks, channels):
            found: list[tuple[int, Stream, bytes]] = []
            for chunk in overlapping:
                file.seek(chunk.chunk_start_offset)
                try:
                    data = file.read(chunk.chunk_length)
                    room.take(unpacked_size(data))
                    messages, wrong = logged(data, channels)
                except Exception as err:  # see `replay`
                    messages, wrong = [], err
                found += messages
                problem = wrong or problem
            if len(overlapping) > 1:
                found.sort(key=itemgetter(0))
            yield from ((stream, data) for _, stream, data in found)
    if problem is not None:
        raise problem


def _together(chunks: Sequence[Any], channels: Mapping[int, Stream]) -> Iterator[list[Any]]:
    """Yield chunks that hold messages on some channels, those that overlap in time together.

    As far as they fit into memory; messages may come in any order.
    """
    together: list[Any] = []
    end = size = 0
    for chunk in sorted(chunks, key=attrgetter('message_start_time', 'chunk_start_offset')):
        counts = chunk.channel_count  # empty where the recorder wrote no index of messages
        if counts and not any(counts.get(key) for key in channels):
            continue
        size += chunk.uncompressed_size
        if together and (chunk.message_start_time >= end or size > LARGEST_TABLE):
            yield sorted(together, key=attrgetter('chunk_start_offset'))
            together, end, size = [], 0, chunk.uncompressed_size
        together.append(chunk)
        end = max(end, chunk.message_end_time)
    if together:
        yield sorted(together, key=attrgetter('chunk_start_offset'))
