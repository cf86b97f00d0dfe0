# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages by slices of time: what came on all streams between two moments, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib_ros.identification.levels import CONFIDENT
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.rows import Stamps
from calib_ros.settings import Settings

JOINTS, POSES = 'joints', 'measurements'
NO_ACCIDENT = round(1.0 / (1.0 - CONFIDENT))
"""So many messages that differ from the others are no accident: one in so many may be."""
SILENCE = 5.0 * Settings.lateness
"""A joint or topic that was heard before and is silent for so long [s] is told."""


class StreamKey(NamedTuple):
    """What one stream of measurements is of: device, target, and whether it only judges.

    What is measured in another frame is another stream.
    """

    device: str
    target: str
    validation: bool
    distance: bool
    eye_in_hand: bool
    frame_id: str = ''
    images: bool = False

    @property
    def is_place(self) -> bool:
        """Tell whether it says where the target is in the frame of its device."""
        return not (self.distance or self.eye_in_hand or self.images)


Columns: TypeAlias = tuple[int, ...]
"""The numbers in the chain of the joints that a message names."""


class Piece(NamedTuple):
    """Messages of one stream: places (N,) in the order of arrival, stamps (N,), numbers (N, w)."""

    key: Columns | StreamKey
    places: NDArray[np.intp]
    stamps: Stamps
    numbers: FloatArray

    @property
    def kind(self) -> str:
        """Return what is said: where joints are, or what was measured."""
        return POSES if isinstance(self.key, StreamKey) else JOINTS

    def cut(self, begin: int, end: int) -> Piece:
        """Return what has its place from `begin` on and before `end`."""
        part = slice(*np.searchsorted(self.places, (begin, end)).tolist())
        return Piece(self.key, self.places[part], self.stamps[part], self.numbers[part])


@dataclass(frozen=True, eq=False)
class Slice:
    """Messages in the order in which they came, in pieces by stream, the first to come first.

    Places count from the first message of a batch, `begin` is that of the first one here.
    `joints` (N,) are the messages that are joint states, `times` (N,) all stamps on the clock of
    the joints [ns].
    """

    pieces: tuple[Piece, ...]
    begin: int
    joints: NDArray[np.bool_]
    times: Stamps

    @classmethod
    def of(cls, pieces: Sequence[Piece], delay_ns: int = 0) -> Slice:
        """Put pieces in order; measurements are stamped late by `delay_ns`."""
        places = np.concatenate([each.places for each in pieces])
        order = np.argsort(places, kind='stable')
        ranks = np.empty_like(order)
        ranks[order] = np.arange(len(order))
        joints = np.repeat(
            [each.kind == JOINTS for each in pieces], [len(each.places) for each in pieces]
        )
        times = np.concatenate(
            [each.stamps - (0 if each.kind == JOINTS else delay_ns) for each in pieces]
        )
        ends = np.cumsum([len(each.places) for each in pieces])[:-1]
        ranked = [
            each._replace(places=part)
            for each, part in zip(pieces, np.split(ranks, ends), strict=True)
        ]
        return cls(_by_arrival(ranked), 0, joints[order], times[order])

    def __len__(self) -> int:
        """Return how many messages there are."""
        return len(self.times)

    def between(self, begin: int, end: int) -> Slice:
        """Return the messages from the one of a number on and before that of another."""
        pieces = [each.cut(self.begin + begin, self.begin + end) for each in self.pieces]
        part = slice(begin, end)
        return Slice(_by_arrival(pieces), self.begin + begin, self.joints[part], self.times[part])

    def where(self, kind: str) -> NDArray[np.intp]:
        """Return the numbers of the messages of a kind."""
        return np.flatnonzero(self.joints if kind == JOINTS else ~self.joints)


def _by_arrival(pieces: Sequence[Piece]) -> tuple[Piece, ...]:
    present = [each for each in pieces if len(each.places)]
    return tuple(sorted(present, key=lambda each: int(each.places[0])))


def merged(pieces: Sequence[Piece], width: int) -> tuple[Stamps, FloatArray]:
    """Return stamps (N,) and numbers (N, width) in the order in which they came, NaN for none."""
    stamps = np.concatenate([each.stamps for each in pieces])
    numbers = np.full((len(stamps), width), np.nan)
    begin = 0
    for each in pieces:
        part = each.numbers[:, :width]
        numbers[begin : begin + len(part), : part.shape[1]] = part
        begin += len(part)
    if len(pieces) == 1:
        return stamps, numbers
    order = np.argsort(np.concatenate([each.places for each in pieces]))
    return stamps[order], numbers[order]
