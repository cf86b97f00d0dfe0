# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What can still be read of a damaged recording: cut off, or never closed by its recorder.

An intact recording is read by its index. A damaged one has none, so its files are read from
their beginning up to the damage.
"""

from __future__ import annotations

import re
import sqlite3
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from calib_ros import mcap

Stream = TypeVar('Stream')


def recorded(path: Path) -> int | None:
    """Return how many messages the recorder says it has written; None when it does not."""
    try:
        text = (path / 'metadata.yaml').read_text(encoding='utf-8')
    except OSError:
        return None
    found = re.search(r'^  message_count: (\d+)', text, re.MULTILINE)
    return None if found is None else int(found.group(1))


@dataclass
class Salvage:
    """Topics with their types, serialised messages as (topic, data), and what was wrong."""

    problem: str = 'the recording was not closed'
    topics: dict[str, str] = field(default_factory=dict)
    messages: list[tuple[str, bytes]] = field(default_factory=list)

    def on(self, streams: Mapping[str, Stream]) -> Iterator[tuple[Stream, bytes]]:
        """Yield the messages on some topics, as what these carry."""
        return ((streams[topic], data) for topic, data in self.messages if topic in streams)


def salvage(path: Path) -> Salvage | None:
    """Return what can be read of a bag folder or file; None when nothing can."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    found = Salvage()
    for file in files:
        if file.suffix == '.mcap':
            _read_mcap(file, found)
        elif file.suffix == '.db3':
            _read_sqlite3(file, found)
    return found if found.messages else None


def _read_sqlite3(file: Path, found: Salvage) -> None:
    connection = sqlite3.connect(f'{file.resolve().as_uri()}?mode=ro&immutable=1', uri=True)
    try:
        connection.execute('PRAGMA writable_schema=ON')
        topics = {
            key: (name, kind)
            for key, name, kind in connection.execute('SELECT id, name, type FROM topics')
        }
        found.topics |= dict(topics.values())
        for key, data in connection.execute('SELECT topic_id, data FROM messages ORDER BY id'):
            found.messages.append((topics[key][0], data))
        (pages,) = connection.execute('PRAGMA page_count').fetchone()
        (size,) = connection.execute('PRAGMA page_size').fetchone()
        if pages * size > file.stat().st_size:
            found.problem = 'the file is cut off'
    except (sqlite3.Error, KeyError) as err:
        found.problem = str(err)
    finally:
        connection.close()


def _read_mcap(file: Path, found: Salvage) -> None:
    content = file.read_bytes()
    if not content.startswith(mcap.MAGIC):
        return
    schemas: dict[int, str] = {}
    channels: dict[int, str] = {}
    try:
        for kind, record in mcap.records(content, len(mcap.MAGIC)):
            if kind == mcap.SCHEMA:
                (key,) = struct.unpack_from('<H', record)
                schemas[key] = mcap.string(record, 2)
            elif kind == mcap.CHANNEL:
                key, schema = struct.unpack_from('<HH', record)
                channels[key] = mcap.string(record, 4)
                found.topics[channels[key]] = schemas[schema]
            elif kind == mcap.MESSAGE:
                (key,) = struct.unpack_from('<H', record)
                found.messages.append((channels[key], record[mcap.MESSAGE_HEAD :]))
            elif kind == mcap.DATA_END:
                break
    except Exception as err:  # decompressors have errors of their own
        found.problem = f'cut off or damaged: {err}'
