# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Admission of messages by their names: joints, frames, targets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from calib_ros.sampling.account import Cause
from calib_ros.sampling.frame_names import FrameNames
from calib_ros.sampling.joint_names import NOWHERE, OTHERS, JointNames
from calib_ros.sampling.slices import JOINTS, POSES, SILENCE, Part, Piece, StreamKey
from calib_ros.sampling.usable import usable

NO_VALUES = 'no positions in the message'
UNEVEN = 'names and positions differ in number'


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
            own = '', *(names[k] for k in index)
            part = part._replace(strings=own, numbers=values)
            places, *_, stamps, values = self._usable(part)
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
