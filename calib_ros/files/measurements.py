# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The rows of a measurement table as arrays, and their rules."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.covariances import covariance_faults
from calib_ros.errors import ColumnsError, ConfigError, InputError
from calib_ros.files.columns import Codes, Columns, check_quaternions, codes_of, lines_in_words
from calib_ros.files.headers import listed, named_by_option, refuse_separator
from calib_ros.files.vocabulary import (
    COVARIANCE,
    KINDS,
    POSITION,
    QUATERNION,
    UPPER,
    joint_columns,
)
from calib_ros.kinematics import se3
from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.parameter import LENS_KINDS
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.sampling.messages import frame_name
from calib_ros.sampling.sample import Sample, View, socket_place
from calib_ros.values import LARGEST, LARGEST_RATE, parse_number

SPLITS = {name: name for name in ('', 'train', 'test', 'removed')}
FLAGS = {'': False, '0': False, 'false': False, '1': True, 'true': True}
POSE, DISTANCE, SOCKET, PLANE = range(4)  # of KINDS


@dataclass(frozen=True, eq=False)
class Measurements:
    """N rows of measurements, NaN where missing; columns as in `Sample`.

    `lines` (N,) are those of the file at `path`. `kind` (N,) is POSE, DISTANCE, SOCKET or PLANE
    (with distance 0). Poses without a measured rotation, by `oriented` (N,), have the identity.
    Columns without values may be None.
    """

    path: Path
    lines: Index
    stamps_ns: NDArray[np.int64]
    joints: FloatArray
    approach: FloatArray | None
    velocity: FloatArray | None
    acceleration: FloatArray | None
    kind: Index
    position: FloatArray
    rotation: FloatArray
    oriented: Flags
    distance: FloatArray
    covariance: FloatArray | None
    session: Codes
    device: Codes
    target: Codes
    frame_id: Codes
    view: Codes
    eye_in_hand: Flags
    test: Flags
    removed: Flags
    delay: FloatArray
    count: NDArray[np.int64]
    spread: FloatArray

    def select(self, rows: NDArray[np.generic]) -> Measurements:
        """Return some rows, by a mask (N,) or indices (K,)."""
        found: dict[str, object] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                found[item.name] = value[rows]
            elif isinstance(value, tuple):
                found[item.name] = (value[0][rows], value[1])
        return replace(self, **found)  # type: ignore[arg-type]

    def samples(self) -> Iterator[Sample]:
        """Yield the rows as samples."""
        for k, kind in enumerate(self.kind.tolist()):
            texts: dict[str, Any] = {
                name: words[codes[k]]
                for name in ('session', 'device', 'target', 'frame_id', 'view')
                for codes, words in (getattr(self, name),)
            }
            optional: dict[str, Any] = {
                name: None if values is None or np.isnan(values[k]).any() else values[k]
                for name in ('approach', 'velocity', 'acceleration', 'covariance')
                for values in (getattr(self, name),)
            }
            view, where = texts.pop('view'), f'{self.path}, line {self.lines[k]}: view'
            yield Sample(
                int(self.stamps_ns[k]),
                self.joints[k],
                position=self.position[k] if kind == POSE else None,
                rotation=self.rotation[k] if self.oriented[k] else None,
                distance=float(self.distance[k]) if kind in (DISTANCE, PLANE) else None,
                socket=kind == SOCKET,
                plane=kind == PLANE,
                view=view_of(view, where) if view else None,
                eye_in_hand=bool(self.eye_in_hand[k]),
                validation=bool(self.test[k]),
                delay=float(self.delay[k]),
                count=int(self.count[k]),
                spread=float(self.spread[k]),
                **texts,
                **optional,
            )

    @cached_property
    def codes(self) -> Index:
        """Return the codes (N, 6) of frames and sets; session, device, target first."""
        words = (self.session[0], self.device[0], self.target[0])
        return np.column_stack([*words, self.eye_in_hand, self.kind, self.test])

    def kept(self) -> Measurements:
        """Return the rows that were not removed; refuse duplicates."""
        found = self
        if self.removed.any():
            open_rows: dict[tuple[int, ...], list[int]] = {}
            keys = np.column_stack([self.stamps_ns, self.frame_id[0], self.codes[:, :-1]]).tolist()
            for row, (key, removed) in enumerate(zip(keys, self.removed.tolist(), strict=True)):
                same = open_rows.setdefault(tuple(key), [])
                if not removed:
                    same.append(row)
                elif same:
                    same.pop()
            rows = sorted(row for same in open_rows.values() for row in same)
            found = self.select(np.array(rows, dtype=np.intp))
        stamps = found.stamps_ns
        _, number = distinct_rows(np.column_stack([found.codes, found.frame_id[0]]))
        order = np.lexsort((number, stamps))
        again = (np.diff(stamps[order]) == 0) & (np.diff(number[order]) == 0)
        for row in np.sort(order[1:][again])[:1].tolist():
            raise InputError(
                f'{self.path}, line {found.lines[row]}: stamp_ns {stamps[row]} already exists'
            )
        return found

    def check_frames(self) -> None:
        """Refuse too many frames, and several of a device; rows without one may have any."""
        kinds, number = distinct_rows(self.codes[:, :3])
        most = 100
        for line in self.lines[number == most][:1].tolist():
            raise InputError(
                f'{self.path}, line {line}: more than {most} sessions, devices and targets; each '
                'has a frame to be fitted'
            )
        kinds, number = distinct_rows(np.column_stack([self.codes[:, :2], self.frame_id[0]]))
        frames: dict[tuple[int, ...], list[str]] = {}
        for k, (*device, frame) in enumerate(kinds.tolist()):
            if name := self.frame_id[1][frame]:
                lines = lines_in_words(self.lines[number == k].tolist())
                frames.setdefault(tuple(device), []).append(f'{name} ({lines})')
        for names in frames.values():
            if len(names) > 1:
                raise InputError(
                    f'{self.path}: poses came in different frames: {", ".join(names)}; only one '
                    'is allowed: leave out the rows of the others, or give each frame its own '
                    'device'
                )


def measurements(columns: Columns, joints: int) -> Measurements:
    """Return the measurements in a table; refuse invalid rows."""
    header = columns.header
    _check_header(columns, joints)
    filled = np.array([~columns.blank(name) for name in KINDS])
    for row in np.flatnonzero(filled.sum(axis=0, dtype=np.uint8) > 1)[:1].tolist():
        kinds = np.array(KINDS)[filled[:, row]].tolist()
        raise InputError(
            f'{columns.path}, line {columns.lines[row]} has both {" and ".join(kinds)}: give each '
            f'its own row, or rename the column {kinds[-1]} if it is no measurement of its own'
        )
    kind = filled.argmax(axis=0)
    placed = kind == POSE
    count = len(columns.lines)
    angles = columns.joint_values(joint_columns(joints))
    position = _block(columns, POSITION, placed)
    oriented, rotation = _turned(columns, _block(columns, QUATERNION, False), placed)
    signs = _block(columns, joint_columns(joints, 's'), False, LARGEST_RATE)
    split = _choices(columns, 'split', SPLITS, 'train or test')
    ones = np.ones(count, dtype=np.int64)
    return Measurements(
        columns.path,
        columns.lines,
        _stamps(columns),
        angles,
        None if signs is None else np.sign(signs),
        _block(columns, joint_columns(joints, 'v'), False, LARGEST_RATE),
        _block(columns, joint_columns(joints, 'a'), False, LARGEST_RATE),
        kind,
        np.zeros((count, 3)) if position is None else position,
        rotation,
        oriented,
        np.where(kind == PLANE, 0.0, _one(columns, 'distance', needed=kind == DISTANCE)),
        _covariance(columns, _block(columns, COVARIANCE, False, LARGEST**2), placed, oriented),
        columns.labels('session'),
        _devices(columns, kind),
        columns.labels('target'),
        columns.labels('frame_id', frame_name),
        columns.labels('view'),
        _choices(columns, 'eye_in_hand', FLAGS, '0 or 1').astype(bool),
        split == 'test',
        split == 'removed',
        _one(columns, 'delay'),
        columns.integers('count', ones) if 'count' in header else ones,
        _one(columns, 'spread', math.inf),
    )


def _block(
    columns: Columns, names: tuple[str, ...], needed: Flags | bool, largest: float = LARGEST
) -> FloatArray | None:
    """Return the numbers (N, len(names)) of a block, None if all are blank."""
    if names[0] not in columns.header:
        return None
    found = columns.block(names, largest, needed)
    return None if len(found) and np.isnan(found[:, 0]).all() else found


def _one(
    columns: Columns, name: str, largest: float = LARGEST, needed: Flags | bool = False
) -> FloatArray:
    """Return the numbers (N,) of a column, 0 if blank."""
    found = _block(columns, (name,), needed, largest)
    return np.zeros(len(columns.lines)) if found is None else np.nan_to_num(found[:, 0])


def _check_header(columns: Columns, joints: int) -> None:
    header = set(columns.header)
    needed = [*joint_columns(joints)]
    if not set(KINDS[1:]) & header:
        needed += POSITION
    blocks = (joint_columns(joints, letter) for letter in 'sva')
    for block in (*blocks, POSITION, QUATERNION, COVARIANCE, ('location', 'socket')):
        needed += block if set(block) & header else ()
    missing = [name for name in dict.fromkeys(needed) if name not in header]
    if missing:
        refuse_separator(columns.path, columns.header)
        found = columns.theirs or columns.header
        expected = ', '.join([*needed[:joints], *POSITION])
        lacks = ', '.join(missing)
        expected = '' if lacks == expected else f'; expected {expected}'
        raise ColumnsError(
            f'{columns.path} has no column {lacks}{expected} '
            '(or distance, plane, or location and socket); found '
            f'{listed(found)}. {named_by_option(found, missing, joints)}'
        )


def _choices(
    columns: Columns, name: str, known: Mapping[str, object], what: str
) -> NDArray[np.generic]:
    """Return the meaning of the cells (N,) of a column with known values."""
    numbers, found = columns.labels(name)
    for k, word in enumerate(found):
        if word not in known:
            columns.refuse(numbers == k, f'{name} must be {what}, not {word!r}')
    return np.array([known[word] for word in found])[numbers]


def _stamps(columns: Columns) -> NDArray[np.int64]:
    lines = columns.lines.astype(np.int64) * 1_000_000_000
    if columns.blank('stamp_ns').all():
        return lines
    try:
        return columns.integers('stamp_ns', lines)
    except InputError as err:
        told = 'if it is in seconds, give --columns time=stamp_ns'
        if any('e' in cell.lower() for cell in columns.texts('stamp_ns')):
            told = 'a spreadsheet program has rounded the stamps: remove or rename that column'
        raise InputError(f'{err}; {told}') from err


def _devices(columns: Columns, kind: Index) -> Codes:
    labels = [columns.labels(name) for name in ('device', 'plane', 'location', 'socket')]
    kinds, number = distinct_rows(np.column_stack([kind, *(codes for codes, _ in labels)]))
    names = []
    for k, (what, *codes) in enumerate(kinds.tolist()):
        pairs = zip(labels, codes, strict=True)
        name, plane, place, socket = (texts[code] for (_, texts), code in pairs)
        if what == PLANE:
            name = plane
        elif what == SOCKET:
            try:
                name = socket_place(f'{place}/{socket}')
            except ConfigError as err:
                columns.refuse(number == k, str(err))
        elif what == DISTANCE and 'x' in columns.header:  # not the tracker's origin
            name = name or 'distance'
        names.append(name)
    found, different = codes_of(names)
    return found[number], different


def _turned(columns: Columns, quat: FloatArray | None, placed: Flags) -> tuple[Flags, FloatArray]:
    """Return which poses (N,) are oriented, and the rotations (N, 3, 3)."""
    if quat is None:
        return np.zeros(len(placed), bool), np.broadcast_to(np.eye(3), (len(placed), 3, 3))
    check_quaternions(columns, quat)
    oriented = placed & ~np.isnan(quat[:, 0])
    if not oriented.all():
        quat = np.where(oriented[:, np.newaxis], quat, [0.0, 0.0, 0.0, 1.0])
    return oriented, se3.from_quat(quat)


def _covariance(
    columns: Columns, upper: FloatArray | None, placed: Flags, oriented: Flags
) -> FloatArray | None:
    """Return the covariances (N, 6, 6), NaN where missing, None if all are."""
    if upper is None:
        return None
    given = placed & ~np.isnan(upper[:, 0])
    full = np.full((len(upper), 6, 6), np.nan)
    rows, across = np.transpose(UPPER)
    full[:, rows, across] = full[:, across, rows] = upper
    known = np.where(oriented[given, np.newaxis], 1.0, np.repeat([1.0, 0.0], 3))
    faults = covariance_faults(full[given] * known[:, :, np.newaxis] * known[:, np.newaxis, :])
    told = np.full(len(given), '', faults.dtype)
    told[given] = faults
    columns.refuse(told != '', lambda row: f'c11 ... c66: {told[row]}')
    full[~given | ~full.any(axis=(1, 2))] = np.nan
    return None if np.isnan(full).all() else full


def distinct_rows(codes: Index) -> tuple[Index, Index]:
    """Return the different rows of (N, C) in order of appearance, and their indices (N,)."""
    if not codes.any():
        return codes[:1], np.zeros(len(codes), dtype=np.intp)
    sizes = [int(size) + 1 for size in codes.max(axis=0)]
    if math.prod(sizes) < 2**62:
        joined = np.ravel_multi_index(tuple(codes.T), sizes)
        _, first, number = np.unique(joined, return_index=True, return_inverse=True)
    else:
        _, first, number = np.unique(codes, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), dtype=np.intp)
    rank[order] = np.arange(len(order))
    return codes[first[order]], rank[number.reshape(-1)]


def view_of(text: str, where: str) -> View:
    """Return the corners of a board in a cell; errors name it `where`."""
    first, *rows = [
        [parse_number(cell, where, InputError) for cell in part.split(' ')]
        for part in text.split(';')
    ]
    if len(first) != len(LENS_KINDS) + 1 or not rows or any(len(row) != 5 for row in rows):
        raise InputError(f'{where} must be a lens of 10 numbers, then x y z u v of each corner')
    corners = np.array(rows)
    values = dict(zip(LENS_KINDS, first, strict=False))
    try:
        lens = Lens(**values, fixed=bool(first[-1]))
    except ConfigError as err:
        raise InputError(f'{where}: {err}') from err
    return View(corners[:, :3], corners[:, 3:], lens)
