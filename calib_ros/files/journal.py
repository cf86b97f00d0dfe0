# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The journal: every sample at once on disk, in a table that can be identified by itself.

A row is written by one call, so that a process that is killed leaves whole rows; a row that a
crash of the machine cut off is left out when the journal is read again. A sample that is taken
back gets a second row, marked `removed`; nothing is ever deleted.
"""

from __future__ import annotations

import codecs
import csv
import fcntl
import io
import os
from collections.abc import Sequence
from pathlib import Path

from calib_ros.errors import InputError
from calib_ros.files.tables import cells, columns
from calib_ros.sampling.sample import Sample


class Journal:
    """An open journal, which only grows and which no other process can open meanwhile.

    The file is made if there is none, else rows are added.
    """

    def __init__(self, path: Path, joints: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            self._lock()
            self._begin(columns(joints))
        except BaseException:
            self.close()
            raise

    def add(self, sample: Sample, removed: bool = False) -> None:
        """Write a sample, or that it was taken back; what is there stays whole."""
        self._write(cells(sample, 'removed' if removed else None))

    @property
    def gone(self) -> bool:
        """Tell whether the file was deleted, moved or replaced, so that nobody finds its rows."""
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
        """Keep others out until the file is closed or the process has ended."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f'{self.path} is being written by another process: give each robot a serial or '
                'a data_dir of its own'
            ) from None
        except OSError:  # a file system without locks: a journal without one is better than none
            return

    def _begin(self, header: Sequence[str]) -> None:
        """Write the header into a new file; leave out what a crash cut off."""
        expected = ','.join(header).encode() + b'\n'
        found = os.pread(self._file, len(expected), 0)
        plain = found.removeprefix(codecs.BOM_UTF8).replace(b'\r', b'')
        if plain != found and expected.startswith(plain):
            raise InputError(
                f'{self.path} was saved by another program (a byte order mark, or lines that end '
                'in CR LF), so no rows can be added: save it without these, or move it. calib_ros '
                'identify reads it as it is'
            )
        if not expected.startswith(found):
            raise InputError(
                f"{self.path} does not have this robot's columns: move it, or choose another "
                'data_dir'
            )
        if found != expected:
            os.ftruncate(self._file, 0)
            self._write(header)
            return
        end, size = -1, os.fstat(self._file).st_size
        while end < 0:  # the header ends a line
            begin = max(size - 2**16, 0)
            end, size = os.pread(self._file, size - begin, begin).rfind(b'\n'), begin
        os.ftruncate(self._file, begin + end + 1)

    def _write(self, row: Sequence[str]) -> None:
        text = io.StringIO()
        csv.writer(text).writerow(row)  # by its own end of lines it quotes names with any
        data = text.getvalue().removesuffix('\r\n').encode() + b'\n'
        begin = os.fstat(self._file).st_size
        written = os.write(self._file, data)
        if written < len(data):  # the disk is full: no half row may stay
            os.ftruncate(self._file, begin)
            raise OSError(f'{self.path}: the disk is full, the pose was not written')
