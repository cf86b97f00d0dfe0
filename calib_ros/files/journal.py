# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A journal: a table that receives every sample at once, and that `identify` reads.

A row is written by one call, so a killed process leaves whole rows; rows cut off or damaged by a
crash of the machine are left out on resuming. A removed sample gets a second row marked `removed`;
nothing is ever deleted.
"""

from __future__ import annotations

import codecs
import csv
import errno
import fcntl
import io
import os
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from calib_ros.errors import InputError
from calib_ros.files.tables import cells, columns, is_whole
from calib_ros.sampling.sample import Sample


class Journal:
    """An open journal, which only grows and which no other process can open."""

    def __init__(self, path: Path, joints: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
        with ExitStack() as stack:
            stack.callback(self.close)
            self._lock()
            self._begin(columns(joints))
            stack.pop_all()

    def add(self, sample: Sample, removed: bool = False) -> None:
        """Append a sample, or its removal."""
        self._write(cells(sample, 'removed' if removed else None))

    @property
    def gone(self) -> bool:
        """Tell whether the file was deleted, moved or replaced."""
        try:
            return not os.path.samestat(os.stat(self.path), os.fstat(self._file))
        except FileNotFoundError:
            return True

    @property
    def content(self) -> bytes:
        """Return what was written, wherever the file is now."""
        return os.pread(self._file, os.fstat(self._file).st_size, 0)

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def _lock(self) -> None:
        try:  # held until the file is closed or the process ends
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f'another process writes {self.path}: give each robot its own serial or data_dir'
            ) from None
        except OSError:  # a file system without locks
            pass

    def _begin(self, header: Sequence[str]) -> None:
        """Write the header of a new file; remove a row cut off by a crash."""
        expected = ','.join(header).encode() + b'\n'
        found = os.pread(self._file, len(expected), 0)
        plain = found.removeprefix(codecs.BOM_UTF8).replace(b'\r', b'')
        if plain != found and expected.startswith(plain):
            raise InputError(
                f'{self.path} was saved by another program (a byte order mark, or lines that end '
                'in CR LF), so no rows can be added: save it without these, or move it. '
                'calib_ros identify can read it'
            )
        if not expected.startswith(found):
            raise InputError(
                f"{self.path} lacks this robot's columns: move it, or choose another data_dir"
            )
        if found != expected:
            os.ftruncate(self._file, 0)
            self._write(header)
            return
        end, size = -1, os.fstat(self._file).st_size
        while end < 0:  # the header ends a line
            begin = max(size - 2**16, 0)
            tail = os.pread(self._file, size - begin, begin)
            end, size = tail.rfind(b'\n'), begin
        if is_whole(tail[end + 1 :], len(header)):
            os.write(self._file, b'\n')
        else:
            os.ftruncate(self._file, begin + end + 1)

    def _write(self, row: Sequence[str]) -> None:
        text = io.StringIO()
        csv.writer(text).writerow(row)  # its line end makes it quote names with any
        data = text.getvalue().removesuffix('\r\n').encode() + b'\n'
        begin = os.fstat(self._file).st_size
        written = os.write(self._file, data)
        if written < len(data):  # the disk is full: no half row may stay
            os.ftruncate(self._file, begin)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
