# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages as rows of numbers, by streams and in slices of time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib_ros.estimation.levels import CONFIDENT
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.sampling.sources import Source
from calib_ros.settings import Settings

Stamps: TypeAlias = NDArray[np.int64]
Series: TypeAlias = tuple[Stamps, FloatArray]
"""Stamps (N,), with rows (N, w) or values (N,)."""


JOINTS, POSES = 'joints', 'measurements'
NO_ACCIDENT = round(1.0 / (1.0 - CONFIDENT))
"""Number of differing messages that cannot be chance."""
SILENCE = 5.0 * Settings.lateness
"""Silence [s] after which an active joint or topic is reported."""


class Part(NamedTuple):
    """Messages of one source with the same names, their places (N,) in a batch and stamps (N,).

    The source is None for joint states and transforms. `strings` are frame and child frame (if
    any) of a measurement, or the frame and the joint names. `numbers` (N, w) are joint values [rad
    or m], of a faulty publisher more or fewer than names; or a distance [m] (w = 1), a position
    [m] (3), a pose with its quaternion x y z w (7), or a pose and a covariance row by row (43); of
    an image its number (1).
    """

    places: Index
    source: Source | None
    strings: tuple[str, ...]
    stamps: Stamps
    numbers: FloatArray

    @property
    def child(self) -> str:
        """Return the child frame of a measurement, or empty text."""
        return self.strings[1] if len(self.strings) > 1 else ''

    def rows(self, which: Flags | slice) -> Part:
        """Return some messages, by a mask (N,) or a slice."""
        places, source, strings, stamps, numbers = self
        return Part(places[which], source, strings, stamps[which], numbers[which])


class StreamKey(NamedTuple):
    """One stream of measurements: device, target, purpose, kind and frame."""

    device: str
    target: str
    validation: bool
    distance: bool
    eye_in_hand: bool
    frame_id: str = ''
    images: bool = False

    @property
    def is_place(self) -> bool:
        """Tell whether it measures the target in the frame of its device."""
        return not (self.distance or self.eye_in_hand or self.images)


JointIndices: TypeAlias = tuple[int, ...]  # indices of the chain's joints that a message names


class Piece(NamedTuple):
    """Messages of one stream: places (N,) in order of arrival, stamps (N,), numbers (N, w)."""

    key: JointIndices | StreamKey
    places: Index
    stamps: Stamps
    numbers: FloatArray

    @property
    def kind(self) -> str:
        """Return JOINTS or POSES."""
        return POSES if isinstance(self.key, StreamKey) else JOINTS

    def cut(self, begin: int, end: int) -> Piece:
        """Return the messages with places from `begin` to before `end`."""
        part = slice(*np.searchsorted(self.places, (begin, end)).tolist())
        return Piece(self.key, self.places[part], self.stamps[part], self.numbers[part])


@dataclass(frozen=True, eq=False)
class Slice:
    """Messages in order of arrival; places count from the first one of a batch."""

    pieces: tuple[Piece, ...]  # by stream
    begin: int  # the place of the first message here
    joints: Flags  # (N,) which are joint states
    times: Stamps  # (N,) stamps on the joints' clock [ns]

    @classmethod
    def of(cls, pieces: Sequence[Piece], delay_ns: int = 0) -> Slice:
        """Order pieces by arrival; measurements are stamped late by `delay_ns`."""
        lengths = [len(each.places) for each in pieces]
        order = np.argsort(np.concatenate([each.places for each in pieces]), kind='stable')
        joints = np.repeat([each.kind == JOINTS for each in pieces], lengths)
        times = np.concatenate([each.stamps for each in pieces]) - np.where(joints, 0, delay_ns)
        ranks = np.split(np.argsort(order), np.cumsum(lengths)[:-1])
        ranked = [each._replace(places=own) for each, own in zip(pieces, ranks, strict=True)]
        return cls(tuple(ranked), 0, joints[order], times[order])

    def __len__(self) -> int:
        return len(self.times)

    def between(self, begin: int, end: int) -> Slice:
        """Return the messages from index `begin` to before `end`."""
        cut = (each.cut(self.begin + begin, self.begin + end) for each in self.pieces)
        pieces, part = tuple(each for each in cut if len(each.places)), slice(begin, end)
        return Slice(pieces, self.begin + begin, self.joints[part], self.times[part])

    def where(self, kind: str) -> Index:
        """Return the indices (K,) of the messages of a kind."""
        return np.flatnonzero(self.joints if kind == JOINTS else ~self.joints)
