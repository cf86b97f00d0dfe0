# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of samples (CSV): measurements or a journal (docs/formats.md).

Joint values are in q1 ... qn. The filled cells of a row determine what was measured: a pose (x y z
and qx qy qz qw), a position (x y z), a distance to a fixed point (distance), a ball in a socket
(location, socket) or a touched plane (plane). The pose of a board may include its corners (view):
the lens, fx fy cx cy k1 k2 p1 p2 k3 and whether it is fixed (1 or 0), then x y z u v of each
corner, joined by semicolons.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.errors import ColumnsError, InputError, UnknownNameError, unreadable
from calib_ros.estimation.observations import Observations
from calib_ros.files.columns import (
    Codes,
    Columns,
    columns_of,
    joined_columns,
    lines_in_words,
)
from calib_ros.files.foreign import Foreign, measured
from calib_ros.files.headers import joints_left_out, not_read
from calib_ros.files.measurements import (
    DISTANCE,
    PLANE,
    POSE,
    SOCKET,
    Measurements,
    distinct_rows,
    measurements,
)
from calib_ros.files.vocabulary import (
    COVARIANCE,
    MATRIX,
    POSITION,
    QUATERNION,
    TURNS,
    UPPER,
    WORDS,
    joint_columns,
)
from calib_ros.kinematics import se3
from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.parameter import LENS_KINDS
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.progress import Notify, quiet
from calib_ros.sampling.dataset import Dataset, dataset_of
from calib_ros.sampling.sample import Sample, View
from calib_ros.settings import Settings
from calib_ros.texts import LARGEST_TABLE, LARGEST_TEXT, csv_text, read_bytes, to_cell
from calib_ros.values import parse_number

USUAL_SIGMAS = Settings().sigmas


def read_table(
    path: Path | str,
    joints: int,
    sessions: Sequence[str] = (),
    sigmas: tuple[float, float] = USUAL_SIGMAS,
    eye_in_hand: bool = False,
    foreign: Foreign | None = None,
    progress: Notify = quiet,
) -> Dataset:
    """Read a CSV table, or one in any other layout.

    Of several `sessions`, each after the first gets its own base and tool frames. `sigmas` are the
    standard deviations [m, rad] of poses seen by a camera on the flange; with `eye_in_hand` all
    poses are of a fixed target in such a camera. `foreign` tells how to read a table from another
    system; `progress` receives the share read.

    Raises InputError for a missing column, a value that is not a number, an ambiguous session, or
    measurements of one device in different frames. The message names the line.
    """
    path, read = Path(path), None
    if foreign is not None:
        read = foreign.convert(path)
    elif path.is_file():  # a pipe can be read once only
        read = _of_journal(path, joints, progress)
    if read is None:
        found = columns_of(path, read_bytes(path, LARGEST_TABLE, InputError), progress)
        lower = Counter(map(str.lower, found.cells))
        meant = {name: name.lower() for name in found.cells if lower[name.lower()] == 1}
        meant = {name: ours for name, ours in meant.items() if ours in WORDS and ours != name}
        notes = [f'{path}: the column {name} is read as {ours}' for name, ours in meant.items()]
        named = {meant.get(name, name): given for name, given in found.cells.items()}
        found = replace(found, cells=named)
        kept, skipped = measured(found)
        if skipped:  # of whole rows: others were cut off
            found.block([name for name in joint_columns(joints) if name in found.header])
        if {*MATRIX} <= {*found.header}:
            raise ColumnsError(f'{path} has rotation matrices: calib_ros import makes quaternions')
        read = kept, (*notes, *skipped, *_unread(found, joints))
    found, warnings = read
    rows, by_line = _chosen(found, joints, sessions), 'stamp_ns' not in found.header
    return _table(rows, sigmas, eye_in_hand, warnings, by_line)


def _unread(found: Columns, joints: int) -> Iterator[str]:
    yield from joints_left_out(found.path, found.header, joints)
    known = {*columns(joints), *TURNS, 'plane', f'q{joints + 1}'}
    if {*TURNS} <= {*found.header} and QUATERNION[0] not in found.header:
        turns = ', '.join(TURNS)
        yield f'{found.path}: {turns} are left out: give --euler or --rotation-vector to use them'
    yield from not_read(found.path, [name for name in found.header if name not in known])


def _chosen(found: Columns, joints: int, sessions: Sequence[str]) -> Measurements:
    if not len(found.lines):
        measurements(found, joints)  # names missing columns first
        raise InputError(f'{found.path} has no rows')
    if 'session' not in found.header and sessions:
        names = ', '.join(sessions)
        raise InputError(f'{found.path} has no column "session" to choose "{names}" from')
    rows = _rows_of(found.path, found.labels('session'), sessions)
    every = np.array_equal(rows, np.arange(len(found.lines)))
    return measurements(found if every else found.select(rows), joints)


def _table(
    made: Measurements,
    sigmas: tuple[float, float] = USUAL_SIGMAS,
    eye_in_hand: bool = False,
    warnings: tuple[str, ...] = (),
    by_line: bool = False,
) -> Dataset:
    made = made.kept()
    made.check_frames()
    if made.test.all():
        raise InputError(f'{made.path} has no rows to fit, only rows marked test')
    if eye_in_hand:
        made = replace(made, eye_in_hand=np.ones(len(made.lines), dtype=bool))
    if made.view[1] != ['']:
        found = dataset_of([*_samples(made)], sigmas)
    else:  # arrays, with one example of each kind
        _, number = distinct_rows(made.codes)
        examples = [*_samples(made.select(np.unique(number, return_index=True)[1]))]

        def observed(members: Sequence[int]) -> Observations:
            rows = np.isin(number, members)
            return (made if rows.all() else made.select(rows)).observations()

        found = dataset_of(examples, sigmas, observed=observed)
    place, names = made.frame_id
    world_frame = next((names[k] for k in place.tolist() if names[k]), '')
    return replace(found, world_frame=world_frame, warnings=warnings, by_line=by_line)


def check_table(made: Columns) -> None:
    """Refuse columns that no table may have: any sessions, with as many joints as there are."""
    joints = sum(re.fullmatch('q[0-9]+', name) is not None for name in made.header)
    if not joints:
        raise InputError(
            f'{made.path} has no joint values: name their columns (--columns q1=...), give the '
            'chain with those joint names (--chain), or their separate table (--joints)'
        )
    sessions = made.texts('session') if 'session' in made.cells else ()
    _table(_chosen(made, joints, tuple(dict.fromkeys(sessions))))


def read_journal(path: Path, joints: int) -> tuple[tuple[Sample, ...], tuple[str, ...]]:
    """Return the samples of a journal, possibly none, and warnings; leave out damaged rows."""
    damaged: list[int] = []
    found, warnings = _of_journal(path, joints, damaged=damaged) or (
        columns_of(path, read_bytes(path, LARGEST_TABLE, InputError)),
        (),
    )
    if damaged:
        words = f'{path}: {lines_in_words(damaged)} cannot be read: left out, but kept in the file'
        warnings = (*warnings, words)
    return tuple(_samples(measurements(found, joints).kept())), warnings


def _of_journal(
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
                    some = [each + b'\n' for each in whole.split(b'\n')]
                    parts += _rows(path, joints, some, lines - 1, damaged)
                    lines += len(some)
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
                _view_of(text, '')
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


def _samples(made: Measurements) -> Iterator[Sample]:
    for k, kind in enumerate(made.kind.tolist()):
        texts: dict[str, Any] = {
            name: getattr(made, name)[1][getattr(made, name)[0][k]]
            for name in ('session', 'device', 'target', 'frame_id')
        }
        optional: dict[str, Any] = {
            name: None if values is None or np.isnan(values[k]).any() else values[k]
            for name in ('approach', 'velocity', 'acceleration', 'covariance')
            for values in (getattr(made, name),)
        }
        view = made.view[1][made.view[0][k]]
        where = f'{made.path}, line {made.lines[k]}: view'
        yield Sample(
            int(made.stamps_ns[k]),
            made.joints[k],
            position=made.position[k] if kind == POSE else None,
            rotation=made.rotation[k] if made.oriented[k] else None,
            distance=float(made.distance[k]) if kind in (DISTANCE, PLANE) else None,
            socket=kind == SOCKET,
            plane=kind == PLANE,
            view=_view_of(view, where) if view else None,
            eye_in_hand=bool(made.eye_in_hand[k]),
            validation=bool(made.test[k]),
            delay=float(made.delay[k]),
            count=int(made.count[k]),
            spread=float(made.spread[k]),
            **texts,
            **optional,
        )


def columns(joints: int) -> list[str]:
    """Return the columns of a table for every kind of sample."""
    names = ['stamp_ns', *(name for letter in 'qsva' for name in joint_columns(joints, letter))]
    names += [*POSITION, *QUATERNION, 'distance', *COVARIANCE, 'device', 'target', 'frame_id']
    names += ['eye_in_hand', 'delay', 'count', 'spread', 'session', 'split']
    return [*names, 'location', 'socket', 'view']


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


def _view_of(text: str, where: str) -> View:
    first, *rows = [
        [parse_number(cell, where, InputError) for cell in part.split(' ')]
        for part in text.split(';')
    ]
    if len(first) != len(LENS_KINDS) + 1 or not rows or any(len(row) != 5 for row in rows):
        raise InputError(f'{where} must be a lens of 10 numbers, then x y z u v of each corner')
    corners = np.array(rows)
    values = dict(zip(LENS_KINDS, first, strict=False))
    return View(corners[:, :3], corners[:, 3:], Lens(**values, fixed=bool(first[-1])))


def table_text(samples: Sequence[Sample], joints: int) -> str:
    """Return samples as a table with the columns that are used."""
    names = columns(joints)
    rows = [cells(sample) for sample in samples]
    used = [k for k, column in enumerate(zip(*rows, strict=True)) if any(column)]
    return csv_text([row[k] for k in used] for row in (names, *rows))


def _rows_of(path: Path, labels: Codes, sessions: Sequence[str]) -> Index:
    numbers, known = labels
    if not sessions and len(known) > 1:
        raise InputError(
            f'{path} holds several sessions, choose one of {", ".join(known)} (or several, '
            'joined by commas, to fit them together)'
        )
    for k, name in enumerate(sessions):
        if name in sessions[:k]:
            raise InputError(f'session "{name}" is named twice')
        if name not in known:
            raise UnknownNameError(f'session in {path}', name, known)
    wanted = [known.index(name) for name in sessions or known]
    return np.concatenate([np.flatnonzero(numbers == place) for place in wanted])
