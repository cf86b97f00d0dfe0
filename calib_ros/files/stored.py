# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The messages stored in a recording.

An intact one is read by its index. A damaged one, cut off or never closed by its recorder, has
none, so its files are read from their beginning up to the damage. So are those that the library,
which trusts them, must not open.
"""

from __future__ import annotations

import mmap
import re
import shlex
import sqlite3
import struct
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib_ros.errors import MOST_ENTRIES, ConfigError
from calib_ros.files import compression, mcap
from calib_ros.files.unpacked import recorded_files
from calib_ros.sampling.messages import PICTURES
from calib_ros.sampling.streams import Stream
from calib_ros.shown import some
from calib_ros.texts import LARGEST_TABLE, parse_yaml, read_text

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

STORAGE = ('chunks', 'connections', 'path')
TIMES = ('message_start_time', 'message_end_time')
CHUNK = (*TIMES, 'channel_count', 'chunk_start_offset', 'chunk_length', 'uncompressed_size')
"""Attributes that rosbags does not promise: without them, its own reading is used."""
LARGEST_MESSAGE = 64 * MOST_ENTRIES
"""Bytes of a message: a joint state with a name and three numbers per joint."""
LARGEST_IMAGE = 2 * LARGEST_TABLE  # bytes of an image, as a message or a file
NOT_CLOSED = 'the recording was not closed'
GROWING = {
    'topics': 'SELECT id FROM topics NOT INDEXED',
    'messages': 'SELECT id FROM messages NOT INDEXED',
    'message_definitions': 'SELECT id FROM message_definitions NOT INDEXED',
    'timestamp_idx': 'SELECT timestamp, id FROM messages INDEXED BY timestamp_idx ORDER BY 1, 2',
}
"""Queries whose rows must increase; in a malicious file they repeat for ever."""
_PLAIN = re.compile(r'CREATE (TABLE|INDEX) (?!.*\b(AS|GENERATED)\b)', re.IGNORECASE | re.DOTALL)
_NUMBERED = re.compile(r'[^(]*\(\s*id INTEGER PRIMARY KEY', re.IGNORECASE)


def recorded(path: Path) -> int | None:
    """Return the number of messages stated by the recorder, or None."""
    try:
        text = read_text(path / 'metadata.yaml')
    except ConfigError:
        return None
    found = re.search(r'^  message_count: ([0-9]{1,15})\s*$', text, re.MULTILINE)
    return None if found is None else int(found.group(1))


def topic_types(topics: Iterable[tuple[object, object]]) -> dict[str, str]:
    """Return the types of topics; a database may hold something other than text."""
    return {name: kind for name, kind in topics if isinstance(name, str) and isinstance(kind, str)}


def check_bag(path: Path) -> None:
    """Refuse a bag folder or file that the library must not open."""
    metadata = path / 'metadata.yaml'
    if metadata.exists():
        parse_yaml(read_text(metadata), str(metadata))
    elif not recorded_files(path):
        convert = f'rosbags-convert --src {shlex.quote(str(path))} --dst FOLDER'
        older = f'; a bag of ROS 1 is converted by {convert}' if path.suffix == '.bag' else ''
        files = sorted(each.name for each in path.iterdir()) if path.is_dir() else []
        only = f', only {", ".join(some(files, 3))}' if files else ''
        raise ValueError(f'no .mcap or .db3 file is in it{only}{older}')
    for file in recorded_files(path):
        if file.suffix == '.db3':
            with closing(_open(file)) as connection:
                _check_layout(connection)
                names = connection.execute('SELECT name FROM sqlite_master').fetchall()
                for name in {name for (name,) in names} & set(GROWING):
                    deque(_growing(connection.execute(GROWING[name]), name), maxlen=0)
        elif not mcap.is_indexed(file):
            raise ValueError('it has no index, and no messages could be found without')


@dataclass
class Salvage:
    """Topics with types, number of messages, problem, and whether files are `whole`."""

    files: tuple[Path, ...]
    topics: dict[str, str] = field(default_factory=dict)
    count: int = 0
    problem: str = ''
    whole: bool = True

    def messages(self) -> Iterator[tuple[str, bytes]]:
        """Yield the serialised messages as (topic, data), up to the damage in each file."""
        for file in self.files:
            yield from (_of_sqlite3 if file.suffix == '.db3' else _of_mcap)(file, self)

    def note(self, problem: str) -> None:
        """Note why a file could not be read to its end."""
        self.problem, self.whole = problem, False

    def on(self, streams: Mapping[str, Stream]) -> Iterator[tuple[Stream, bytes]]:
        """Yield the messages of some streams."""
        found = ((streams[topic], data) for topic, data in self.messages() if topic in streams)
        return _unpacked(found)


def salvage(path: Path) -> Salvage | None:
    """Return what can be read of a bag folder or file, or None."""
    found = Salvage(recorded_files(path))
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        found.problem = NOT_CLOSED
        ends = (re.search('_([0-9]{1,9})$', file.stem) for file in found.files)
        numbers = [int(each[1]) for each in ends if each]
        if numbers and len(numbers) <= max(numbers) - min(numbers):
            found.note('a file of it is missing')
    found.count = sum(1 for _ in found.messages())
    return found if found.count else None


def _open(file: Path) -> sqlite3.Connection:
    return sqlite3.connect(f'{file.resolve().as_uri()}?mode=ro&immutable=1', uri=True)


def _check_layout(connection: sqlite3.Connection) -> None:
    """Refuse a database with computed content: views, virtual tables and columns."""
    for name, statement in connection.execute('SELECT name, sql FROM sqlite_master'):
        if statement is None:  # implicit index of a table
            continue
        plain = isinstance(statement, str) and _PLAIN.match(statement)
        if not plain or (name in ('topics', 'messages') and not _NUMBERED.match(statement)):
            raise ValueError(f'"{name}" is not what a recorder makes')


def _growing(rows: Iterable[tuple[Any, ...]], name: str) -> Iterator[tuple[Any, ...]]:
    before: tuple[Any, ...] | None = None
    for row in rows:
        if before is not None and row[:2] <= before:
            raise ValueError(f'rows of "{name}" come again')
        before = row[:2]
        yield row


def _of_sqlite3(file: Path, found: Salvage) -> Iterator[tuple[str, bytes]]:
    with closing(_open(file)) as connection:
        cut = ''
        try:
            connection.execute('PRAGMA writable_schema=ON')
            (pages,) = connection.execute('PRAGMA page_count').fetchone()
            (size,) = connection.execute('PRAGMA page_size').fetchone()
            cut = 'the file is cut off' * (pages * size > file.stat().st_size)
            _check_layout(connection)
            rows = connection.execute('SELECT id, name, type FROM topics')
            topics = {key: (name, kind) for key, name, kind in _growing(rows, 'topics')}
            found.topics |= topic_types(topics.values())
            rows = connection.execute('SELECT id, topic_id, data FROM messages ORDER BY id')
            for _, key, data in _growing(rows, 'messages'):
                yield topics[key][0], data
        except Exception as err:  # cells may hold anything
            found.note(str(err) or type(err).__name__)
        if cut:  # whatever the error is
            found.note(cut)


def _of_mcap(file: Path, found: Salvage) -> Iterator[tuple[str, bytes]]:
    schemas: dict[int, str] = {}
    channels: dict[int, str] = {}
    try:
        with (
            file.open('rb') as opened,
            closing(mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ)) as content,
        ):
            if content[: len(mcap.MAGIC)] != mcap.MAGIC:
                raise ValueError('no mcap file')
            for kind, record in mcap.records(content, len(mcap.MAGIC)):
                if kind == mcap.Opcode.SCHEMA:
                    (key,) = struct.unpack_from('<H', record)
                    schemas[key] = mcap.string(record, 2)
                elif kind == mcap.Opcode.CHANNEL:
                    key, schema = struct.unpack_from('<HH', record)
                    channels[key] = mcap.string(record, 4)
                    found.topics[channels[key]] = schemas[schema]
                elif kind == mcap.Opcode.MESSAGE:
                    (key,) = struct.unpack_from('<H', record)
                    yield channels[key], record[mcap.MESSAGE_HEAD :]
                elif kind == mcap.Opcode.DATA_END:
                    return
        found.problem = NOT_CLOSED
    except Exception as err:  # decompressors have their own errors
        found.note(f'cut off or damaged: {err}')


def read(reader: Reader, streams: Mapping[str, Stream]) -> Iterator[tuple[Stream, bytes]]:
    """Return the messages of an open bag on some topics, in order of log time.

    mcap files are read chunk by chunk, merged where chunks overlap in time, and in file order
    without chunks; all others by the library.
    """
    storage = getattr(reader, 'storage', None)
    storages = getattr(storage, 'storages', [storage])
    if all(map(_is_known, storages)):
        found = (each for storage in storages for each in _stored(storage, streams))
    else:
        messages = reader.messages(_wanted(reader, streams))
        found = ((streams[connection.topic], data) for connection, _, data in messages)
    return _unpacked(found)


def _unpacked(messages: Iterator[tuple[Stream, bytes]]) -> Iterator[tuple[Stream, bytes]]:
    """Unpack messages that were compressed one by one, as their first bytes tell.

    Metadata, which would tell, may be missing. Damaged or too large ones, and what is no message,
    are empty, so that they cannot be decoded: the next one may be readable.
    """
    for stream, data in messages:
        most = LARGEST_IMAGE if stream.type in PICTURES else LARGEST_MESSAGE
        if isinstance(data, bytes) and data.startswith(compression.ZSTD):
            try:
                data = compression.decompressed(data, 'zstd', most)
            except OSError:  # no decompression module
                raise
            except Exception:  # decompressors have their own errors
                data = b''
        yield stream, data if isinstance(data, bytes) and len(data) <= most else b''


def _wanted(storage: Any, streams: Mapping[str, Stream]) -> list[Any]:
    connections = (each for each in storage.connections if each.topic in streams)
    return [each for each in connections if each.msgtype == streams[each.topic].type]


def _is_known(storage: Any) -> bool:
    if hasattr(storage, 'dbconn'):
        return True
    if not all(hasattr(storage, name) for name in STORAGE):
        return False
    return all(hasattr(each, name) for each in storage.chunks for name in CHUNK)


def _stored(storage: Any, streams: Mapping[str, Stream]) -> Iterator[tuple[Stream, bytes]]:
    """Yield the messages of a file; an error in a chunk is raised at the end."""
    wanted = _wanted(storage, streams)
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
        room = compression.Room(storage.path.stat().st_size)
        problem: Exception | None = None
        for overlapping in _chunk_groups(storage.chunks, channels):
            found: list[tuple[int, Stream, bytes]] = []
            for chunk in overlapping:
                file.seek(chunk.chunk_start_offset)
                try:
                    data = file.read(chunk.chunk_length)
                    messages, wrong = mcap.logged(data, channels, room)
                except Exception as err:  # see `replay`
                    messages, wrong = [], err
                found += messages
                problem = wrong or problem
            if len(overlapping) > 1:
                found.sort(key=itemgetter(0))
            yield from ((stream, data) for _, stream, data in found)
    if problem is not None:
        raise problem


def _chunk_groups(chunks: Sequence[Any], channels: Mapping[int, Stream]) -> Iterator[list[Any]]:
    """Yield chunks with messages on some channels, overlapping ones together if they fit."""
    together: list[Any] = []
    end = size = 0
    for chunk in sorted(chunks, key=attrgetter('message_start_time', 'chunk_start_offset')):
        counts = chunk.channel_count  # empty without a message index
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
