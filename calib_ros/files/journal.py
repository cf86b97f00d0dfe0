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
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from itertools import zip_longest
from pathlib import Path

import numpy as np

from calib_ros.errors import InputError, unreadable
from calib_ros.files.columns import Columns, columns_of, joined_columns, lines_in_words
from calib_ros.files.measurements import measurements, view_of
from calib_ros.files.vocabulary import COVARIANCE, POSE_COLUMNS, UPPER, joint_columns
from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.progress import Notify, quiet
from calib_ros.sampling.sample import Sample, View
from calib_ros.shown import some
from calib_ros.texts import LARGEST_TABLE, LARGEST_TEXT, csv_text, read_bytes, to_cell

ITS_JOINTS = '# joints: '  # what the settings beside a journal begin with


def locked(path: Path, create: int = os.O_CREAT) -> int:
    """Return an open file that no other process can lock until it is closed.

    Raises InputError if another process has locked it, OSError if it cannot be opened.
    """
    file = os.open(path, os.O_RDWR | os.O_APPEND | create, 0o644)
    try:  # held until the file is closed or the process ends
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(file)
        raise InputError(
            f'another process writes {path}: stop it, or give each robot its own serial or '
            'data_dir'
        ) from None
    except OSError:  # a file system without locks
        pass
    return file


class Journal:
    """An open journal, which only grows and which no other process can open."""

    def __init__(self, path: Path, joints: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path, self._size = path, 0
        self._file = locked(path)
        with ExitStack() as stack:
            stack.callback(self.close)
            self._begin(columns(joints))
            self._size = os.fstat(self._file).st_size
            stack.pop_all()

    def add(self, sample: Sample, removed: bool = False) -> None:
        """Append a sample, or its removal."""
        self._write(_of_sample(sample, removed))

    @property
    def gone(self) -> bool:
        """Tell whether the file was deleted, moved, replaced, cut or written by others."""
        try:
            there = os.stat(self.path)
        except FileNotFoundError:
            return True
        same = os.path.samestat(there, os.fstat(self._file))
        return not same or there.st_size != self._size

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

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
            self._write(_line(header))
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

    def _write(self, data: bytes) -> None:
        begin = os.fstat(self._file).st_size
        written = os.write(self._file, data)
        if written < len(data):  # the disk is full: no half row may stay
            os.ftruncate(self._file, begin)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._size += written


def whole_journal(rows: Sequence[tuple[Sample, bool]], joints: int) -> bytes:
    """Return the content of a journal with samples, and their removals (true)."""
    return b''.join([_line(columns(joints)), *(_of_sample(*row) for row in rows)])


def _of_sample(sample: Sample, removed: bool) -> bytes:
    return _line(cells(sample, 'removed' if removed else None))


def _line(row: Sequence[str]) -> bytes:
    text = csv_text([row], end='\r\n')  # which makes csv quote names with any line end
    return text.removesuffix('\r\n').encode() + b'\n'


def settings_beside(path: Path) -> Path:
    """Return the path of the settings of a journal, which begin with its joints."""
    return path.with_suffix('.settings.yaml')


def joints_line(joints: Sequence[str]) -> str:
    """Return the line that names the joints q1, q2, ... of a journal."""
    return f'{ITS_JOINTS}{json.dumps(joints)}\n'


def refuse_other_joints_than(joints: Sequence[str], path: Path) -> None:
    """Refuse a journal of other joints, or in another order, if its settings name them."""
    beside = settings_beside(path)
    if not beside.is_file():
        return
    with beside.open(encoding='utf-8', errors='replace') as file:
        line = file.readline(LARGEST_TEXT)
    if not line.startswith(ITS_JOINTS):
        return
    try:
        theirs = [str(name) for name in json.loads(line.removeprefix(ITS_JOINTS))]
    except (ValueError, TypeError) as err:
        raise InputError(f'{beside} must begin with {joints_line(joints).strip()}') from err
    pairs = enumerate(zip_longest(theirs, joints, fillvalue='none'), 1)
    other = [f'q{k} is {its}, in the chain {ours}' for k, (its, ours) in pairs if its != ours]
    if other:
        raise InputError(
            f'{path} is of other joints: {"; ".join(some(other))}: give the chain it was measured '
            'with; if joints were only renamed, write the new names into the first line of '
            f'{beside.name}'
        )


def read_journal(path: Path, joints: int) -> tuple[tuple[Sample, ...], tuple[str, ...]]:
    """Return the samples of a journal, possibly none, and warnings; leave out damaged rows."""
    damaged: list[int] = []
    found, warnings = of_journal(path, joints, damaged=damaged) or (
        columns_of(path, read_bytes(path, LARGEST_TABLE, InputError)),
        (),
    )
    if damaged:
        words = f'{path}: {lines_in_words(damaged)} cannot be read: left out, but kept in the file'
        warnings = (*warnings, words)
    return tuple(measurements(found, joints).kept().samples()), warnings


def of_journal(
    path: Path, joints: int, progress: Notify = quiet, damaged: list[int] | None = None
) -> tuple[Columns, tuple[str, ...]] | None:
    """Return the columns of a journal, and warnings; None for other files.

    It may have any length, since its samples were in memory: it is read in parts. The lines of
    damaged rows go into a list; without one they are refused.
    """
    header = ','.join(columns(joints)).encode() + b'\n'
    parts = [columns_of(path, header)]
    lines, rest = 1, b''
    try:
        with path.open('rb') as file:
            if (begin := file.read(len(header))) != header:
                return (parts[0], ()) if begin and header.startswith(begin) else None
            size = path.stat().st_size
            while data := file.read(LARGEST_TEXT):
                whole, end, rest = (rest + data).rpartition(b'\n')
                if file.tell() == size and is_whole(rest, len(columns(joints))):
                    whole, end, rest = whole + end + rest, b'\n', b''
                if end:
                    ended = [each + b'\n' for each in whole.split(b'\n')]
                    parts += _rows(path, joints, ended, lines - 1, damaged)
                    lines += len(ended)
                if len(rest) > LARGEST_TEXT:
                    raise InputError(f'{path}, line {lines + 1} is incomplete: is it a journal?')
                progress(min(file.tell() / size, 1.0))
    except OSError as err:
        raise InputError(unreadable(path, err)) from err
    cut_off = f'{path}: line {lines + 1} was cut off and is ignored'
    return joined_columns(parts), (cut_off,) if rest else ()


def _rows(
    path: Path, joints: int, lines: Sequence[bytes], above: int, damaged: list[int] | None
) -> Iterator[Columns]:
    """Yield the rows in lines of a journal, in halves if one is damaged, until it is alone."""
    header = ','.join(columns(joints)).encode() + b'\n'
    try:
        found = columns_of(path, header + b''.join(lines), above=above)
        if damaged is not None:
            made = measurements(found, joints)
            if found.blank('split').any():
                raise InputError(f'{path} has incomplete rows')
            for text in filter(None, made.view[1]):
                view_of(text, '')
    except InputError:
        if damaged is None:
            raise
        half = len(lines) // 2
        if not half:
            damaged.append(above + 2)
            return
        yield from _rows(path, joints, lines[:half], above, damaged)
        yield from _rows(path, joints, lines[half:], above + half, damaged)
    else:
        yield found


def is_whole(row: bytes, width: int) -> bool:
    """Tell whether a row lacks only its line end; the numbers of a view may lack more."""
    if not row.endswith(b',') or b'\0' in row:
        return False
    return len(next(csv.reader([row.decode(errors='replace')]))) == width


def columns(joints: int) -> list[str]:
    """Return the columns of a table for every kind of sample."""
    names = ['stamp_ns', *joint_columns(joints, 'qsva'), *POSE_COLUMNS, 'distance', *COVARIANCE]
    names += ['device', 'target', 'frame_id', 'eye_in_hand', 'delay', 'count', 'spread']
    return [*names, 'session', 'split', 'location', 'socket', 'view']


def cells(sample: Sample, split: str | None = None) -> list[str]:
    """Return the exact cells of a sample in the order of `columns`."""

    def numbers(values: FloatArray | None, count: int) -> list[str]:
        return [''] * count if values is None else [repr(float(value)) for value in values]

    joints = len(sample.joints)
    row = [str(sample.stamp_ns)]
    for values in (sample.joints, sample.approach, sample.velocity, sample.acceleration):
        row += numbers(values, joints)
    row += numbers(sample.position, 3)
    row += numbers(None if sample.rotation is None else se3.to_quat(sample.rotation), 4)
    row.append('' if sample.distance is None else repr(sample.distance))
    covariance = sample.covariance
    row += numbers(None if covariance is None else covariance[tuple(np.transpose(UPPER))], 21)
    place = sample.device.rpartition('_')[::2] if sample.socket else ('', '')
    device = '' if sample.socket else sample.device
    row += [to_cell(name) for name in (device, sample.target, sample.frame_id)]
    row.append('1' if sample.eye_in_hand else '')
    row += [repr(sample.delay), str(sample.count), repr(sample.spread)]
    row.append(to_cell(sample.session))
    row.append(split or ('test' if sample.validation else 'train'))
    view = '' if sample.view is None else _view_cell(sample.view)
    return [*row, *map(to_cell, place), view]


def _view_cell(view: View) -> str:
    rows = np.column_stack([view.points, view.pixels]).tolist()
    lens = [*view.lens.values.values(), int(view.lens.fixed)]
    return ';'.join(' '.join(map(repr, row)) for row in (lens, *rows))


def table_text(samples: Sequence[Sample], joints: int) -> str:
    """Return samples as a table with the columns that are used."""
    names = columns(joints)
    rows = [cells(sample) for sample in samples]
    used = [k for k, column in enumerate(zip(*rows, strict=True)) if any(column)]
    return csv_text([row[k] for k in used] for row in (names, *rows))
