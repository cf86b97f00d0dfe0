# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observations from the columns of a table of measurements, all rows at once.

This does for half a million rows what `tables.py` does row by row, and nothing else: whatever is
unusual, let alone wrong, makes it return None.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.escapes import from_cell
from calib_ros.files.columns import MadeColumns, TextColumns
from calib_ros.identification.observations import Observations
from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.sample import Frames, Sample
from calib_ros.values import (
    DEPENDENT,
    LARGEST,
    LARGEST_RATE,
    LARGEST_SIGMA,
    QUATERNION_TOLERANCE,
    SMALLEST_SIGMA,
)

POSITION, QUATERNION = ('x', 'y', 'z'), ('qx', 'qy', 'qz', 'qw')
UPPER = tuple((i, j) for i in range(6) for j in range(i, 6))
COVARIANCE = tuple(f'c{i + 1}{j + 1}' for i, j in UPPER)
FLAGS = {'': False, '0': False, 'false': False, '1': True, 'true': True}
ROW_BY_ROW = ('socket', 'location', 'plane', 'view')
MOST_FRAMES = 100
"""Sessions, devices and targets of a table."""
Sets = tuple[Observations, ...]


class _UnusualError(Exception):
    """The table is to be read row by row."""


def observations_of(
    columns: TextColumns | MadeColumns,
    joints: int,
    sessions: Sequence[str],
    sigmas: tuple[float, float],
    eye_in_hand: bool,
) -> tuple[Sets, Sets, str] | None:
    """Return the sets to fit and held out, and the first frame of measurements; None if unusual.

    The arguments are those of `read_table`.
    """
    try:
        return _Bulk(columns, joints, sessions, eye_in_hand).sets(sigmas)
    except _UnusualError:
        return None


def _require(condition: object) -> None:
    if not condition:
        raise _UnusualError


class _Bulk:
    """The columns that matter, in the order of the sessions asked for."""

    def __init__(
        self,
        columns: TextColumns | MadeColumns,
        joints: int,
        sessions: Sequence[str],
        eye_in_hand: bool,
    ) -> None:
        self._columns = columns
        self._header = set(columns.header)
        for name in self._header & set(ROW_BY_ROW):  # empty in a journal of poses
            _require(bool(columns.blank(name).all()))
        self._count = len(columns.lines)
        self._order, self._all = np.arange(self._count), True
        self._numbers = self._read(joints)
        self._session = self._codes('session')
        self._order = self._of_sessions(sessions)
        self._all = len(self._order) == self._count and len(sessions) < 2
        self._session = (self._session[0][self._order], self._session[1])
        angles = self._block('q', joints)
        _require(angles is not None and not np.isnan(angles).any())
        assert angles is not None
        self._joints = angles
        self._approach = self._block('s', joints)
        self._velocity = self._block('v', joints, LARGEST_RATE)
        self._acceleration = self._block('a', joints, LARGEST_RATE)
        self._position = self._values(POSITION)
        self._distance = self._values(('distance',))
        self._eye = self._flags(eye_in_hand)
        self._test = self._split()
        self._delay = self._values(('delay',))
        for name in ('count', 'spread'):  # of no use here, but not to be nonsense either
            if name in self._header:
                self._values((name,))
        if 'count' in self._header and not self._columns.blank('count').any():
            _require(self._columns.integers('count') is not None)

    def sets(self, sigmas: tuple[float, float]) -> tuple[Sets, Sets, str]:
        """Return the sets to fit and held out, and the first frame of measurements."""
        count = len(self._order)
        far = np.zeros(count, bool) if self._distance is None else ~np.isnan(self._distance[:, 0])
        position = self._position
        placed = np.zeros(count, bool) if position is None else ~np.isnan(position[:, 0])
        _require((far != placed).all())  # one kind in each row
        _require(position is None or not np.isnan(position[placed]).any())
        quat = self._values(QUATERNION) if self._header & set(QUATERNION) else None
        oriented = np.zeros(count, bool)
        if quat is None:
            quat = np.zeros((count, 4))
        else:
            oriented = placed & ~np.isnan(quat[:, 0])
            lengths = np.sqrt(np.einsum('ni,ni->n', quat, quat))
            _require((np.abs(lengths - 1.0) <= QUATERNION_TOLERANCE)[oriented].all())
        quat[~oriented] = (0.0, 0.0, 0.0, 1.0)
        rotations = se3.from_quat(quat)
        covariance = self._covariance(placed, oriented)
        device, target = self._codes('device'), self._codes('target')
        frame_id = self._codes('frame_id')
        self._one_frame_each(device, frame_id)
        codes = np.column_stack(
            [self._session[0], device[0], target[0], self._eye, far, self._test]
        ).astype(np.int64)
        stamps = self._stamps(codes)
        names = Frames()
        groups: dict[tuple[str, str, bool, bool, bool, bool], list[int]] = {}
        kinds, number = _distinct(codes)
        frames = {tuple(kind[:3]) for kind in kinds.tolist()}
        _require(len(frames) <= MOST_FRAMES)
        for k, (session, by, what, eye, distance, test) in enumerate(kinds.tolist()):
            word = from_cell(device[1][by])
            if distance and not word and 'x' in self._header:
                word = 'distance'
            base, tool = names.of(
                Sample(
                    0,
                    np.zeros(0),
                    session=self._session[1][session],
                    device=word,
                    target=from_cell(target[1][what]),
                    eye_in_hand=bool(eye),
                )
            )
            key = (base, tool, bool(distance), False, bool(eye), bool(test))
            groups.setdefault(key, []).append(k)
        fitted: list[Observations] = []
        held_out: list[Observations] = []
        for (base, tool, distance, _, eye, test), members in groups.items():
            where = np.flatnonzero(np.isin(number, members))
            which = slice(None) if len(where) == count else where
            some = covariance is not None and not np.isnan(covariance[which, 0, 0]).all()
            found = Observations(
                stamps[which],
                self._joints[which],
                np.zeros((len(where), 3)) if position is None or distance else position[which],
                rotations[which],
                oriented[which],
                covariance[which] if covariance is not None and some else None,
                self._optional(self._approach, which, sign=True),
                self._distance[which, 0] if self._distance is not None and distance else None,
                self._optional(self._velocity, which),
                self._optional(self._acceleration, which),
                np.zeros(len(where))
                if self._delay is None
                else np.nan_to_num(self._delay[which, 0]),
                base=base,
                tool=tool,
            )
            if eye:
                found = found.inverted(sigmas)
            (held_out if test else fitted).append(found)
        _require(fitted)
        named = np.flatnonzero([bool(word) for word in frame_id[1]])
        first = np.flatnonzero(np.isin(frame_id[0], named))[:1]
        world = from_cell(frame_id[1][frame_id[0][first[0]]]) if len(first) else ''
        return tuple(fitted), tuple(held_out), world

    def _read(self, joints: int) -> dict[str, FloatArray]:
        """Return all columns of numbers (N,)."""
        names = [f'{letter}{k + 1}' for letter in 'qsva' for k in range(joints)]
        names += [*POSITION, *QUATERNION, 'distance', *COVARIANCE, 'delay', 'count', 'spread']
        names = [name for name in names if name in self._header]
        _require(names)
        found = self._columns.numbers(names)
        _require(found is not None)
        assert found is not None
        return dict(zip(names, found.T, strict=True))

    def _codes(self, name: str) -> tuple[NDArray[np.intp], list[str]]:
        """Return the number (N,) of each row's text, and the texts in order of appearance."""
        if name not in self._header:
            return np.zeros(len(self._order), dtype=np.intp), ['']
        numbers, words = self._columns.codes(name)
        return numbers if self._all else numbers[self._order], words

    def _of_sessions(self, sessions: Sequence[str]) -> NDArray[np.intp]:
        """Return the rows of the sessions asked for, session by session."""
        numbers, names = self._session
        _require(len(set(sessions)) == len(sessions))
        if 'session' not in self._header:
            _require(not sessions)
            return self._order
        if not sessions:
            _require(len(names) == 1)
            return self._order
        _require(set(sessions) <= set(names))
        return np.concatenate([np.flatnonzero(numbers == names.index(n)) for n in sessions])

    def _values(self, names: Sequence[str], largest: float = LARGEST) -> FloatArray | None:
        """Return the numbers (N, len(names)), None where there is none, or no such column.

        A row has all of them or none.
        """
        if not set(names) & self._header:
            return None
        _require(set(names) <= self._header)
        found = np.column_stack([self._numbers[name] for name in names])
        if not self._all:
            found = found[self._order]
        nothing = np.isnan(found)
        _require((nothing.all(axis=1) == nothing.any(axis=1)).all())
        if nothing.all():
            return None
        with np.errstate(invalid='ignore'):
            _require(not (np.abs(found) > largest).any())
        return found

    def _block(self, letter: str, joints: int, largest: float = LARGEST) -> FloatArray | None:
        names = [f'{letter}{k + 1}' for k in range(joints)]
        return self._values(names, LARGEST_RATE if letter == 's' else largest)

    def _flags(self, all_of_them: bool) -> NDArray[np.bool_]:
        numbers, words = self._codes('eye_in_hand')
        _require(all(word in FLAGS for word in words))
        return np.array([FLAGS[word] or all_of_them for word in words])[numbers]

    def _split(self) -> NDArray[np.bool_]:
        numbers, words = self._codes('split')
        _require(all(word in ('', 'train', 'test') for word in words))
        return np.array([word == 'test' for word in words])[numbers]

    def _stamps(self, codes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the stamps (N,), each once for its kind of row."""
        if 'stamp_ns' not in self._header or self._columns.blank('stamp_ns').all():
            return np.asarray(self._columns.lines)[self._order].astype(np.int64) * 1_000_000_000
        found = self._columns.integers('stamp_ns')
        _require(found is not None)
        assert found is not None
        found = found[self._order]
        _, number = _distinct(codes)
        ranked = np.lexsort((number, found))
        same = (np.diff(found[ranked]) == 0) & (np.diff(number[ranked]) == 0)
        _require(not same.any())
        return found

    def _one_frame_each(
        self,
        device: tuple[NDArray[np.intp], list[str]],
        frame_id: tuple[NDArray[np.intp], list[str]],
    ) -> None:
        """Require that what a device measured in a session is in one frame."""
        if frame_id[1] == ['']:
            return
        kinds, _ = _distinct(np.column_stack([self._session[0], device[0], frame_id[0]]))
        named = [each for each in kinds.tolist() if frame_id[1][each[2]]]
        _require(len({tuple(each[:2]) for each in named}) == len(named))

    def _covariance(
        self, placed: NDArray[np.bool_], oriented: NDArray[np.bool_]
    ) -> FloatArray | None:
        """Return the covariances (N, 6, 6), NaN where none was given; None where none was."""
        if COVARIANCE[0] not in self._header or self._columns.blank(COVARIANCE[0]).all():
            return None
        upper = self._values(COVARIANCE, LARGEST_SIGMA**2)
        assert upper is not None
        full = np.zeros((len(upper), 6, 6))
        rows, columns = np.transpose(UPPER)
        full[:, rows, columns] = upper
        full[:, columns, rows] = upper
        given = placed & ~np.isnan(upper[:, 0])
        known = np.where(oriented[:, np.newaxis], 1.0, np.repeat([1.0, 0.0], 3))
        seen = full * known[:, :, np.newaxis] * known[:, np.newaxis, :]
        empty = given & ~full.any(axis=(1, 2))
        judged = given & seen.any(axis=(1, 2))
        for turned in (True, False):
            which = judged & (seen[:, 3:].any(axis=(1, 2)) == turned)
            self._require_definite(seen[which] if turned else seen[which, :3, :3])
        full[~given | empty] = np.nan
        return None if np.isnan(full).all() else full

    @staticmethod
    def _require_definite(covariance: FloatArray) -> None:
        variances = np.diagonal(covariance, axis1=1, axis2=2)
        _require((variances > 0.0).all())
        sigmas = np.sqrt(variances)
        _require((sigmas >= SMALLEST_SIGMA).all() and (sigmas <= LARGEST_SIGMA).all())
        normed = covariance / sigmas[:, :, np.newaxis] / sigmas[:, np.newaxis, :]
        mixed = np.abs(normed - np.eye(normed.shape[1])).max(axis=(1, 2), initial=0.0) > 1e-12
        if mixed.any():
            _require((np.linalg.eigvalsh(normed[mixed])[:, 0] > DEPENDENT).all())

    @staticmethod
    def _optional(
        values: FloatArray | None, which: NDArray[np.intp] | slice, sign: bool = False
    ) -> FloatArray | None:
        """Return the values of some rows, zeros where there is none; None where all are none."""
        if values is None or np.isnan(values[which]).all():
            return None
        found = np.nan_to_num(values[which])
        return np.sign(found) if sign else found


def _distinct(codes: NDArray[np.integer]) -> tuple[NDArray[np.integer], NDArray[np.intp]]:
    """Return the different rows of (N, C) in order of appearance, and which (N,) each row is."""
    sizes = codes.max(axis=0, initial=0) + 1
    if np.prod(sizes.astype(np.float64)) > 2**62:
        raise _UnusualError
    joined = np.ravel_multi_index(tuple(codes.T), tuple(sizes.tolist()))
    if not joined.any():
        return codes[:1], np.zeros(len(codes), dtype=np.intp)
    _, first, number = np.unique(joined, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), dtype=np.intp)
    rank[order] = np.arange(len(order))
    return codes[first[order]], rank[number.reshape(-1)]
