# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of samples (CSV), described in docs/formats.md: measured elsewhere, or a journal.

Joint values are in q1 ... qn. What was measured shows in the cells of the row that are filled: a
pose (x y z and qx qy qz qw), a position (x y z), a distance to a fixed point (distance), that a
ball sat in a socket (location, socket) or that a plane was touched (plane), whose places are not
known. A pose may be that of a board whose corners are in the row (view). Rows of all kinds may
stand in one table.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.errors import InputError, UnknownNameError
from calib_ros.escapes import from_cell, to_cell
from calib_ros.files.bulk import (
    COVARIANCE,
    FLAGS,
    MOST_FRAMES,
    POSITION,
    QUATERNION,
    UPPER,
    observations_of,
)
from calib_ros.files.columns import MadeColumns, regular
from calib_ros.files.foreign import Foreign, refuse_separator
from calib_ros.files.views import view_cell, view_of
from calib_ros.identification.observations import Observations
from calib_ros.identification.problem import Problem
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.problems import with_lenses
from calib_ros.sampling.sample import SOCKETS, Frames, Sample, collect, lenses
from calib_ros.shown import Shown
from calib_ros.texts import LARGEST_TABLE, Row, decoded, read_bytes, read_rows
from calib_ros.values import (
    LARGEST,
    LARGEST_RATE,
    LARGEST_SIGMA,
    QUATERNION_TOLERANCE,
    cell_integer,
    cell_number,
    covariance_fault,
)

SPLITS = ('', 'train', 'test', 'removed')
MOST_LINES = 5
"""Lines that an error names."""
SOCKET = ('location', 'socket')
LATER = (SOCKET, ('view',))
"""Columns that journals of earlier versions do not have."""


@dataclass(frozen=True, eq=False, repr=False)
class Table(Shown):
    """The sets to fit and held out, each with frames of its own.

    `pairs` names the frames of the two sockets of each location, `world_frame` is the first frame
    of measurements that the table names, if any. `by_line` tells that the table has no stamps: a
    sample's is its line, in seconds. `lenses` are those at the frames of cameras.
    """

    fitted: tuple[Observations, ...]
    held_out: tuple[Observations, ...]
    pairs: tuple[tuple[str, str], ...] = ()
    warnings: tuple[str, ...] = ()
    world_frame: str = ''
    by_line: bool = False
    lenses: Mapping[str, Lens] = field(default_factory=dict)

    def problem(self, chain: Chain, sockets: float = SOCKETS, **more: Any) -> Problem:
        """Return what is to be fitted of a chain; `sockets` [m] of a location are apart."""
        return Problem(
            with_lenses(chain, self.lenses),
            self.fitted[0],
            self.held_out,
            more=self.fitted[1:],
            separations=tuple((*pair, sockets) for pair in self.pairs),
            world_frame=self.world_frame,
            **more,
        )


def read_table(
    path: Path,
    joints: int,
    sessions: Sequence[str] = (),
    sigmas: tuple[float, float] = (1e-4, 1e-4 / 0.3),
    eye_in_hand: bool = False,
    foreign: Foreign | None = None,
) -> Table:
    """Read a CSV, or a table in any other layout.

    Parameters
    ----------
    path : Path
        The file.
    joints : int
        Number of joints.
    sessions : sequence of str
        Sessions to read; each but the first gets a base and a tool frame of its own.
    sigmas : (float, float)
        Standard deviations [m, rad] of poses seen by a camera on the flange.
    eye_in_hand : bool
        All poses are those of a fixed target in a camera on the flange.
    foreign : Foreign, optional
        How to read a table that others have written.

    Raises
    ------
    InputError
        For a missing column, a value that is no number, several sessions to choose from, or
        measurements of one device in different frames. The message names the line.

    """
    if foreign is not None:
        made, warnings = foreign.convert(path)
        return table_of(made, path, joints, sessions, sigmas, eye_in_hand, warnings)
    text, warnings = _read(path, columns(joints))
    columns_of = regular(text)
    if columns_of is not None:
        found = observations_of(columns_of, joints, sessions, sigmas, eye_in_hand)
        if found is not None:
            fitted, held_out, world_frame = found
            by_line = 'stamp_ns' not in columns_of.header
            return Table(fitted, held_out, (), warnings, world_frame, by_line)
    header, rows = read_rows(text, path)
    return _by_rows(path, joints, header, rows, sessions, sigmas, eye_in_hand, warnings)


def table_of(
    made: MadeColumns,
    path: Path,
    joints: int | None = None,
    sessions: Sequence[str] | None = None,
    sigmas: tuple[float, float] = (1e-4, 1e-4 / 0.3),
    eye_in_hand: bool = False,
    warnings: tuple[str, ...] = (),
) -> Table:
    """Return the table of columns that were converted; the arguments are those of `read_table`.

    By default all sessions, and as many joints as there are columns for them.
    """
    if joints is None:
        joints = sum(re.fullmatch('q[0-9]+', name) is not None for name in made.header)
    if sessions is None:
        sessions = tuple(dict.fromkeys(made.words.get('session', ())))
    found = observations_of(made, joints, sessions, sigmas, eye_in_hand)
    if found is not None:
        fitted, held_out, world_frame = found
        by_line = 'stamp_ns' not in made.header
        return Table(fitted, held_out, (), warnings, world_frame, by_line)
    header, rows = made.header, made.rows()
    return _by_rows(path, joints, header, rows, sessions, sigmas, eye_in_hand, warnings)


def _by_rows(
    path: Path,
    joints: int,
    header: Sequence[str],
    rows: list[tuple[int, Row]],
    sessions: Sequence[str],
    sigmas: tuple[float, float],
    eye_in_hand: bool,
    warnings: tuple[str, ...],
) -> Table:
    """Return the table read row by row, which names what is wrong."""
    reader = _Reader(path, joints, header)
    samples = reader.samples(_of_sessions(path, header, rows, sessions))
    reader.refuse_different_frames(samples)
    taken = [replace(s, eye_in_hand=True) if eye_in_hand else s for s in samples]
    if not any(not sample.validation for sample in taken):
        raise InputError(f'{path} has no rows to fit, only such that are marked test')
    frames = Frames()
    fitted, held_out = collect(taken, sigmas, frames)
    by_line = 'stamp_ns' not in header
    world_frame = next((sample.frame_id for sample in taken if sample.frame_id), '')
    cameras = lenses(taken, frames)
    return Table(fitted, held_out, reader.pairs(taken), warnings, world_frame, by_line, cameras)


def read_journal(path: Path, joints: int) -> tuple[tuple[Sample, ...], tuple[str, ...]]:
    """Return the samples of a journal, of which there may be none, and warnings."""
    text, warnings = _read(path, columns(joints))
    header, rows = read_rows(text, path)
    return _Reader(path, joints, header).samples(rows), warnings


def columns(joints: int) -> list[str]:
    """Return the columns of a table that can hold every kind of sample."""
    numbers = range(1, joints + 1)
    names = ['stamp_ns']
    names += [f'{letter}{k}' for letter in 'qsva' for k in numbers]
    names += [*POSITION, *QUATERNION, 'distance', *COVARIANCE]
    return [
        *names,
        'device',
        'target',
        'frame_id',
        'eye_in_hand',
        'delay',
        'count',
        'spread',
        'session',
        'split',
        *(name for names in LATER for name in names),
    ]


def cells(sample: Sample, split: str | None = None) -> list[str]:
    """Return the cells of a sample in the order of `columns`; numbers are exact."""

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
    row += [repr(sample.delay), str(sample.count), repr(sample.spread), sample.session]
    row.append(split or ('test' if sample.validation else 'train'))
    view = '' if sample.view is None else view_cell(sample.view)
    return [*row, *map(to_cell, place), view]


def table_text(samples: Sequence[Sample], joints: int) -> str:
    """Return samples as a table, with the columns that any of them fills."""
    names = columns(joints)
    rows = [cells(sample) for sample in samples]
    used = [k for k, column in enumerate(zip(*rows, strict=True)) if any(column)]
    lines = [','.join(row[k] for k in used) for row in (names, *rows)]
    return '\n'.join(lines) + '\n'


class _Reader:
    """Turns rows into samples."""

    def __init__(self, path: Path, joints: int, header: Sequence[str]) -> None:
        self._path = path
        self._header = set(header)
        self._joints = joints
        self._quaternion = bool(set(QUATERNION) & self._header)
        self._places: dict[tuple[str, str, str], Sample] = {}
        self._lines: dict[Sample, int] = {}
        needed = [f'q{k + 1}' for k in range(joints)]
        if not {'distance', 'socket', 'plane'} & self._header or set(POSITION) & self._header:
            needed += POSITION
        if self._quaternion:
            needed += QUATERNION
        if 'socket' in self._header:
            needed.append('location')
        missing = [name for name in needed if name not in self._header]
        if missing:
            refuse_separator(path, header)
            expected = ', '.join([*needed[:joints], *POSITION])
            raise InputError(
                f'{path} has no column {", ".join(missing)}; expected {expected} '
                f'and, with orientation, {", ".join(QUATERNION)} as well (or '
                'distance, plane, or location and socket); found '
                f'{", ".join(header) or "nothing"}. '
                'Columns of other names: --columns q1=NAME,x=NAME,...'
            )

    def samples(self, rows: Sequence[tuple[int, Row]]) -> tuple[Sample, ...]:
        """Return the samples of rows with their lines, without those that were taken back."""
        found: dict[tuple[object, ...], Sample] = {}
        frames: set[tuple[str, str, str]] = set()
        for line, row in rows:
            sample = self.sample(line, row)
            frames.add((sample.session, sample.device, sample.target))
            if len(frames) > MOST_FRAMES:
                raise InputError(
                    f'{self._path}, line {line}: more than {MOST_FRAMES} sessions, devices and '
                    'targets; each has a frame to be fitted'
                )
            what = (
                *(sample.stamp_ns, sample.session, sample.device, sample.target),
                *(sample.eye_in_hand, sample.distance is None),
            )
            if row.get('split') == 'removed':  # the last one, to fit or held out
                same = [key for key in ((*what, False), (*what, True)) if key in found]
                if same:
                    del found[max(same, key=lambda key: self._lines[found[key]])]
                continue
            key = (*what, sample.validation)
            if key in found:
                raise InputError(
                    f'{self._path}, line {line}: stamp_ns {sample.stamp_ns} is there already'
                )
            found[key] = sample
            self._lines[sample] = line
        return tuple(found.values())

    def refuse_different_frames(self, samples: Sequence[Sample]) -> None:
        """Refuse what one device measured in different frames, as a session does.

        A row that names no frame may be of any.
        """
        lines: dict[tuple[str, str], dict[str, list[int]]] = {}
        for sample in samples:
            if sample.frame_id:
                frames = lines.setdefault((sample.session, sample.device), {})
                frames.setdefault(sample.frame_id, []).append(self._lines[sample])
        for frames in lines.values():
            if len(frames) > 1:
                found = ', '.join(f'{name} ({_in_words(where)})' for name, where in frames.items())
                raise InputError(
                    f'{self._path}: poses came in different frames: {found}; one is needed: '
                    'leave out the rows of the others, or give each a device of its own'
                )

    def sample(self, line: int, row: Row) -> Sample:
        """Return the sample of a row."""
        joints = self._optional(line, row, 'q')
        if joints is None:
            raise InputError(f'{self._path}, line {line}: q1 must be a number, not blank')
        split = row.get('split') or ''
        if split not in SPLITS:
            raise InputError(
                f'{self._path}, line {line}: split must be train or test, not {split!r}'
            )
        stamp_ns = line * 1_000_000_000
        if row.get('stamp_ns'):
            stamp_ns = self._integer(line, row, 'stamp_ns')
        plain = Sample(
            stamp_ns,
            joints,
            velocity=self._optional(line, row, 'v'),
            acceleration=self._optional(line, row, 'a'),
            session=row.get('session') or '',
            device=from_cell(row.get('device') or ''),
            target=from_cell(row.get('target') or ''),
            frame_id=from_cell(row.get('frame_id') or ''),
            eye_in_hand=self._flag(line, row, 'eye_in_hand'),
            validation=split == 'test',
            delay=self._number(line, row, 'delay') if row.get('delay') else 0.0,
            count=self._integer(line, row, 'count') if row.get('count') else 1,
            spread=self._number(line, row, 'spread', math.inf) if row.get('spread') else 0.0,
        )
        signs = self._optional(line, row, 's')
        if signs is not None:
            plain = replace(plain, approach=np.sign(signs))
        return self._measured(line, row, plain)

    def _measured(self, line: int, row: Row, plain: Sample) -> Sample:
        """Return the sample with what was measured."""
        kinds = [name for name in ('x', 'distance', 'socket', 'plane') if row.get(name)]
        if len(kinds) > 1:
            raise InputError(
                f'{self._path}, line {line} has both {" and ".join(kinds)}: give each kind of '
                'measurement a row of its own'
            )
        if kinds == ['distance']:
            device = plain.device
            if not device and 'x' in self._header:  # the origin of a tracker is another one
                device = 'distance'
            return replace(plain, distance=self._number(line, row, 'distance'), device=device)
        if kinds == ['plane']:
            return replace(plain, plane=True, distance=0.0, device=from_cell(str(row['plane'])))
        if kinds == ['socket']:
            place = f'{row["location"]}_{row["socket"]}'
            sample = replace(plain, socket=True, device=place)
            key = (plain.session, str(row['location']), str(row['socket']))
            self._places.setdefault(key, sample)
            return sample
        position = self._numbers(line, row, POSITION)
        quat = None
        if self._quaternion and any(row.get(name) for name in QUATERNION):
            quat = self._numbers(line, row, QUATERNION)
            length = float(np.linalg.norm(quat))
            if abs(length - 1.0) > QUATERNION_TOLERANCE:
                raise InputError(
                    f'{self._path}, line {line}: quaternion qx qy qz qw has length '
                    f'{length:.6g}, expected 1'
                )
        covariance = None
        if row.get(COVARIANCE[0]):
            covariance = np.zeros((6, 6))
            variances = self._numbers(line, row, COVARIANCE, LARGEST_SIGMA**2)
            covariance[tuple(np.transpose(UPPER))] = variances
            covariance += np.triu(covariance, 1).T
            mask = np.repeat([1.0, 0.0 if quat is None else 1.0], 3)  # what was measured
            fault = covariance_fault(covariance * np.outer(mask, mask))
            if fault:
                raise InputError(f'{self._path}, line {line}: c11 ... c66: {fault}')
            covariance = covariance if covariance.any() else None
        rotation = None if quat is None else se3.from_quat(quat)
        text = row.get('view')
        return replace(
            plain,
            position=position,
            rotation=rotation,
            covariance=covariance,
            view=view_of(text, f'{self._path}, line {line}: view') if text else None,
        )

    def pairs(self, samples: Sequence[Sample]) -> tuple[tuple[str, str], ...]:
        """Return the names of the base frames of the two sockets of each location."""
        frames = Frames()
        names = {frames.of(sample)[0]: sample for sample in samples}
        by_device = {(s.session, s.device): name for name, s in names.items()}
        ends: dict[tuple[str, str], list[str]] = {}
        for (session, location, _), sample in self._places.items():
            name = by_device.get((session, sample.device))
            if name is not None:
                ends.setdefault((session, location), []).append(name)
        return tuple((pair[0], pair[1]) for pair in ends.values() if len(pair) == 2)

    def _optional(self, line: int, row: Row, letter: str) -> FloatArray | None:
        """Return the values of all joints, None where their columns are missing or blank."""
        names = [f'{letter}{k + 1}' for k in range(self._joints)]
        if not any(row.get(name) for name in names):
            return None
        return self._numbers(line, row, names, LARGEST if letter == 'q' else LARGEST_RATE)

    def _numbers(
        self, line: int, row: Row, names: Sequence[str], largest: float = LARGEST
    ) -> FloatArray:
        return np.array([self._number(line, row, name, largest) for name in names])

    def _number(self, line: int, row: Row, name: str, largest: float = LARGEST) -> float:
        return cell_number(row.get(name), f'{self._path}, line {line}: {name}', largest)

    def _flag(self, line: int, row: Row, name: str) -> bool:
        text = row.get(name) or ''
        if text not in FLAGS:
            raise InputError(f'{self._path}, line {line}: {name} must be 0 or 1, not {text!r}')
        return FLAGS[text]

    def _integer(self, line: int, row: Row, name: str) -> int:
        return cell_integer(row.get(name) or '', f'{self._path}, line {line}: {name}')


def _in_words(lines: Sequence[int]) -> str:
    shown = ', '.join(map(str, lines[:MOST_LINES]))
    more = f' and {len(lines) - MOST_LINES} more' if len(lines) > MOST_LINES else ''
    return f'line{"s" if len(lines) > 1 else ""} {shown}{more}'


def _read(path: Path, journal: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """Return the text of a table, and warnings; `journal` is the header of one."""
    data = whole = read_bytes(path, LARGEST_TABLE, InputError)
    if data.startswith(','.join(journal).encode()):
        whole = data[: data.rfind(b'\n') + 1]
    text = decoded(whole, str(path), InputError)
    if len(whole) < len(data):
        line = whole.count(b'\n') + 1
        return text, (f'{path}: line {line} was cut off and is left out',)
    return text, ()


def _of_sessions(
    path: Path, header: Sequence[str], rows: list[tuple[int, Row]], sessions: Sequence[str]
) -> list[tuple[int, Row]]:
    """Return the rows of the sessions that are asked for, session by session."""
    if not rows:
        raise InputError(f'{path} has no rows')
    if 'session' not in header:
        if sessions:
            raise InputError(
                f'{path} has no column "session" to choose "{", ".join(sessions)}" from'
            )
        return rows
    known: dict[str, list[tuple[int, Row]]] = {}
    for line, row in rows:
        if row['session'] is None:
            raise InputError(f'{path}, line {line}: session is missing')
        known.setdefault(row['session'], []).append((line, row))
    if not sessions:
        if len(known) > 1:
            raise InputError(
                f'{path} holds several sessions, choose one of {", ".join(known)} (or several, '
                'joined by commas, to fit them together)'
            )
        return rows
    for name in sessions:
        if list(sessions).count(name) > 1:
            raise InputError(f'session "{name}" is named twice')
        if name not in known:
            raise UnknownNameError(f'session in {path}', name, known)
    return [each for name in sessions for each in known[name]]
