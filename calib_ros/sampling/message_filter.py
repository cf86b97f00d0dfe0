# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Admission of messages by their names: joints, frames, targets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from calib_ros.estimation.configurations import STILL
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.sampling.account import Cause, Lost
from calib_ros.sampling.hints import Hint
from calib_ros.sampling.slices import (
    JOINTS,
    NO_ACCIDENT,
    POSES,
    SILENCE,
    JointIndices,
    Part,
    Piece,
    StreamKey,
)
from calib_ros.settings import EXCEPTION
from calib_ros.values import LARGEST, MOST_NAMES, ROUNDED, covariance_faults

OTHERS = 'none of the joints in the message'
NO_VALUES = 'no positions in the message'
UNEVEN = 'names and positions differ in number'
NO_STAMP = Lost('zero stamp (fill header.stamp where it is published)')
NOT_UNIT = 'quaternion not of length 1 (normalise it where it is published)'
NOWHERE = -1  # column of a joint that needs no name


class JointNames:
    """Finds the joints of a chain in messages that may name others, or only some of them.

    `names` are the chain's joints as messages name them. `held` ones need not be named; they have
    this value.
    """

    def __init__(self, names: Sequence[str], held: Mapping[int, float] | None = None) -> None:
        self._names, self.held = names, held or {}
        self._heard: dict[str, tuple[float, float]] = {}  # lowest and highest value of others
        self.blank: set[int] = set()  # joints of the chain that came without a position

    def layout(self, key: Sequence[str]) -> tuple[JointIndices, Index, str]:
        """Return the joints of the chain in messages, the columns (K,) of them, and any fault.

        Of held joints that are not named the column is NOWHERE.
        """
        known = {k: key.index(name) for k, name in enumerate(self._names) if name in key}
        fault = '' if known.keys() - self.held.keys() else OTHERS
        if any(key.count(self._names[k]) > 1 for k in known):
            fault = 'a joint is named twice'
        known = dict(sorted((dict.fromkeys(self.held, NOWHERE) | known).items()))
        return tuple(known), np.array([*known.values()], dtype=np.intp), fault

    def hear(self, names: Sequence[str], numbers: FloatArray) -> None:
        """Note the k names of joint states, and values (N, k) of others than the chain's.

        Beyond MOST_NAMES others are not noted.
        """
        others = []
        for k, name in enumerate(names):
            own = name in self._names
            if own or name in self._heard or len(self._heard) < MOST_NAMES:
                self._heard.setdefault(name, (np.inf, -np.inf))
                others += [] if own else [k]
        if not others or numbers.shape[1] != len(names):
            return
        values = numbers[:, others]
        lowest, highest = np.fmin.reduce(values).tolist(), np.fmax.reduce(values).tolist()
        for k, least, most in zip(others, lowest, highest, strict=True):
            low, high = self._heard[names[k]]
            self._heard[names[k]] = min(low, least), max(high, most)

    @property
    def never(self) -> tuple[str, ...]:
        """Return the joints that must be named and never were."""
        needed = {name for k, name in enumerate(self._names) if k not in self.held}
        return tuple(sorted(needed - self._heard.keys()))

    @property
    def foreign(self) -> tuple[str, ...]:
        """Return the names received if some of the chain's joints are never named."""
        return tuple(sorted(name or '""' for name in self._heard)) if self.never else ()

    @property
    def extra_joints(self) -> list[str]:
        """Return the names of joints that move but are not in the chain."""
        moved = {name for name, (low, high) in self._heard.items() if high - low > STILL}
        return sorted(moved.difference(self._names))

    def silent_ones(self, silent: Sequence[int]) -> list[Hint]:
        """Return a hint that no more joint states of these joints arrive, if any."""
        words = f'no more joint states of {", ".join(self._names[k] for k in silent)}'
        ask = 'does their driver run, and publish them at rest too?'
        return [Hint(f'nothing can be sampled: {words}', f'{words}: {ask}')] if silent else []

    def why_missing(self, missing: Sequence[int]) -> str:
        """Return why joints are missing: no positions or other names arrive; empty if neither."""
        if blank := ', '.join(self._names[k] for k in missing if k in self.blank):
            return f'waiting for joint states with positions: none came of {blank}'
        if not (missing and self.foreign):
            return ''
        return (
            f'waiting for joint states, set joint_names? Those received name '
            f'{", ".join(self.foreign)}, not {", ".join(self._names[k] for k in missing)}'
        )


class FrameNames:
    """Frames in which each device has measured; each should have one: the `wanted` one if any."""

    def __init__(self, wanted: str = '') -> None:
        self.wanted = wanted
        self._known: dict[str, Counter[str]] = {}
        self._told: set[str] = set()  # frames that are not wanted, up to MOST_NAMES
        self.usual: dict[str, str] = {}
        """The usual frames of devices with more than a few measurements."""

    def required(self, device: str) -> str:
        """Return the frame wanted of a device; none if only others have measured in it."""
        there = [name for name, frames in self._known.items() if self.wanted in frames]
        return '' if there and device not in there else self.wanted

    def decides(self, device: str, frame_id: str) -> bool:
        """Tell whether measurements are the first ones of a device in the wanted frame."""
        return frame_id == self.wanted != '' and frame_id not in self._known.get(device, ())

    def fault(self, device: str, frame_id: str, count: int) -> str:
        """Note the frame of some measurements; return why it cannot be used, or empty text.

        Only the required frame can, or else the usual one.
        """
        wanted = self.required(device)
        if wanted and frame_id != wanted:
            if len(self._told) < MOST_NAMES:
                self._told.add(frame_id)
            told = frame_id if frame_id in self._told else '...'
            return f'in frame "{told}", not in frame_id "{wanted}"'
        if not frame_id.isprintable():  # it is written to tables
            return 'in a frame whose name cannot be printed'
        if not self.note(device, frame_id, count):
            return f'in one of more than {MOST_NAMES} frames'
        usual = self.usual.get(device, frame_id)
        if frame_id == (wanted or usual):
            return ''
        return f'in frame "{frame_id}", not in "{usual}" like the others'

    def note(self, device: str, frame_id: str, count: int) -> bool:
        """Note the frame of measurements; return False beyond MOST_NAMES frames."""
        known = self._known.setdefault(device, Counter())
        if frame_id not in known and len(known) == MOST_NAMES:
            return False
        known[frame_id] += count
        if known[frame_id] >= NO_ACCIDENT:
            self.usual.setdefault(device, frame_id)
        return True

    def main(self, device: str) -> str | None:
        """Return the required or usual frame of a device, or the most frequent one so far."""
        known = self._known.get(device)
        most = max(known, key=known.__getitem__) if known else None
        return self.required(device) or self.usual.get(device, most)

    @property
    def different(self) -> tuple[str, ...]:
        """Return the frames of one device if more than a few measurements are not in its own.

        That is the required one, as soon as any are in it.
        """
        for device, known in self._known.items():
            required, own = self.required(device), self.main(device)
            many = known.total() - known[own or ''] > EXCEPTION * known.total()
            if required not in known if required else many:
                return tuple(sorted(known))
        return ()


def usable(found: Part, joints: bool = False) -> tuple[Flags, Counter[str]]:
    """Return which messages (N,) can be used, of joints or measurements, and why others not."""
    numbers, causes = found.numbers, Counter[str]()
    good = np.ones(len(numbers), dtype=bool)

    def refuse(wrong: np.bool_ | Flags, cause: str) -> None:
        count = int((good & wrong).sum())
        if count:
            causes[cause] += count
            good[wrong] = False

    refuse(found.stamps == 0, NO_STAMP)
    refuse(found.stamps < 0, Lost('negative stamp (is the clock set?)'))
    if joints:
        size = np.abs(numbers).max(axis=1)
        refuse(~np.isfinite(size), 'NaN or infinite joint value')
        refuse(size > LARGEST, 'joint value beyond 1e6')
        return good, causes
    if found.source and found.source.board:
        return good, causes
    width = numbers.shape[1]
    if width == 1:
        far = numbers[:, 0]
        refuse(~((far > 0.0) & (far < np.inf)), 'distance not a positive number')
        refuse(far > LARGEST, 'distance beyond 1000 km')
    else:
        at = numbers[:, :3]
        refuse(~np.isfinite(at).all(axis=1), 'NaN or infinite position')
        refuse((np.abs(at) > LARGEST).any(axis=1), 'position beyond 1000 km')
    if width >= 7:
        with np.errstate(over='ignore'):  # refused anyway
            length = np.sqrt((numbers[:, 3:7] ** 2).sum(axis=1))
        refuse(~(np.abs(length - 1.0) <= ROUNDED), NOT_UNIT)
    if width > 7:
        rows = numbers[:, 7:]
        fresh = np.append(True, (rows[1:] != rows[:-1]).any(axis=1))  # most devices repeat one
        faults = covariance_faults(rows[fresh].reshape(-1, 6, 6))[np.cumsum(fresh) - 1]
        for fault in dict.fromkeys(faults.tolist()):
            if fault:
                refuse(faults == fault, f'{fault} (leave it zero if it is not known)')
    if not found.child.isprintable():  # it is written to tables
        refuse(good.copy(), 'child frame whose name cannot be printed')
    return good, causes


class MessageFilter:
    """Admission of usable messages; others are counted by cause."""

    def __init__(self, names: JointNames, frames: FrameNames, joint_count: int) -> None:
        self._names, self._frames, self._joint_count = names, frames, joint_count
        self.received: Counter[str] = Counter()
        self.dropped: Counter[Cause] = Counter()
        self.unused: Counter[Cause] = Counter()
        self.refused: dict[str, str] = {}  # why the last messages of a kind cannot be used
        self.latest: tuple[int, Sequence[float]] | None = None

    def pieces(self, parts: Sequence[Part], recording: bool) -> list[Piece]:
        """Return the messages to keep."""
        joints = [each for each in parts if each.source is None]
        measured = [self._usable(each) for each in parts if each.source is not None]
        measured = [each for each in measured if len(each.places)]
        return [*self._joints(joints, recording), *self._measured(measured, recording)]

    def miss(self, kind: str, count: int, cause: str) -> None:
        """Count received messages that cannot be used."""
        self.received[kind] += count
        self.dropped[Cause(kind, cause)] += count
        self.refused[kind] = cause

    def _usable(self, part: Part) -> Part:
        good, causes = usable(part, joints=part.source is None)
        for cause, count in causes.items():
            self.miss(POSES if part.source else JOINTS, count, cause)
        return part if good.all() else part.rows(good)

    def _joints(self, parts: Sequence[Part], recording: bool) -> Iterator[Piece]:
        latest, good = -1, False
        for part in parts:
            places, _, (_, *names), stamps, numbers = part
            self._names.hear(names, numbers)
            columns, index, fault = self._names.layout(names)
            if numbers.shape[1] != len(names) and not (fault and names):
                fault = UNEVEN if numbers.size else NO_VALUES
            if fault == NO_VALUES:
                self._names.blank.update(columns)
                if self.latest and stamps[-1] - self.latest[0] > 1e9 * SILENCE:
                    self.refused[JOINTS] = fault  # the arm's, since its own have ended
            if fault in (OTHERS, NO_VALUES):  # such as a gripper's, or efforts, published apart
                self.received[JOINTS] += len(stamps)
                self.unused[Cause(JOINTS, fault)] += len(stamps)
                continue
            if fault:
                self.miss(JOINTS, len(stamps), fault)
                continue
            values = numbers[:, index]
            for place in np.flatnonzero(index == NOWHERE):
                values[:, place] = self._names.held[columns[place]]
            places, *_, stamps, values = self._usable(part._replace(numbers=values))
            if not len(stamps):
                continue
            good = True
            self.received[JOINTS] += len(stamps)
            if len(columns) == self._joint_count and places[-1] > latest:
                latest = int(places[-1])
                self.latest = (int(stamps[-1]), values[-1].tolist())
            if recording:
                yield Piece(columns, places, stamps, values)
            else:
                self.unused[Cause(JOINTS, 'not recording')] += len(stamps)
        if good:  # others among them are only counted
            self.refused.pop(JOINTS, None)

    def _measured(self, parts: Sequence[Part], recording: bool) -> Iterator[Piece]:
        for part in self._by_frame(parts):
            places, source, (frame_id, *_), stamps, numbers = part
            assert source is not None
            count = len(places)
            self.received[POSES] += count
            self.refused.pop(POSES, None)
            if not recording:
                self.unused[Cause(POSES, 'not recording')] += count
            elif fault := self._frames.fault(source.device, frame_id, count):
                self.dropped[Cause(POSES, fault)] += count
                self.refused[POSES] = fault
            else:
                width = numbers.shape[1]
                if width > 7:  # a covariance of zeros means none
                    none = ~numbers[:, 7:].any(axis=1)
                    numbers[none, 7:] = np.nan
                target, board = source.target or part.child, bool(source.board)
                kind = source.validation, width == 1 and not board, source.eye_in_hand
                key = StreamKey(source.device, target, *kind, frame_id, board)
                yield Piece(key, places, stamps, numbers)

    def _by_frame(self, parts: Sequence[Part]) -> list[Part]:
        """Return measurements one by one until the one of several frames is decided."""
        frames: dict[str, set[str]] = {}
        deciding = False
        for each in parts:
            assert each.source is not None
            device, frame_id = each.source.device, each.strings[0]
            deciding = deciding or self._frames.decides(device, frame_id)
            if device not in self._frames.usual:
                frames.setdefault(device, set()).add(frame_id)
        if deciding or any(len(some) > 1 for some in frames.values()):
            parts = [part.rows(slice(k, k + 1)) for part in parts for k in range(len(part.places))]
        return sorted(parts, key=lambda part: int(part.places[0]))
