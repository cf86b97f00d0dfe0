# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Decoding of serialised messages of a recording straight to arrays.

Messages of one topic mostly differ only in stamps and numbers: the names, and so the offsets of
the numbers (OMG Common Data Representation), are the same. The layout is derived from the first
message, others of its length are compared with it byte by byte, and all numbers are read at once.
Messages without a layout must be decoded one by one.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.sampling.messages import JOINT_STATE, TRANSFORM, TRANSFORMS
from calib_ros.sampling.slices import Stamps
from calib_ros.values import MOST_NAMES

LITTLE_ENDIAN = b'\x00\x01'
_HEAD = len(LITTLE_ENDIAN) + 2  # encapsulation: encoding and options
_FORMS: dict[str, tuple[int, int, str, int]] = {
    JOINT_STATE: (1, 0, '<f8', 0),
    TRANSFORM: (2, 0, '<f8', 7),
    TRANSFORMS: (2, 0, '<f8', 7),
    'geometry_msgs/msg/PoseStamped': (1, 0, '<f8', 7),
    'geometry_msgs/msg/PointStamped': (1, 0, '<f8', 3),
    'geometry_msgs/msg/PoseWithCovarianceStamped': (1, 0, '<f8', 43),
    'nav_msgs/msg/Odometry': (2, 0, '<f8', 43),
    'sensor_msgs/msg/Range': (1, 13, '<f4', 1),  # after field of view, least and greatest range
}
"""By type: strings before the numbers, bytes between, kind and count of the numbers."""


@dataclass(frozen=True, eq=False)
class MessageLayout:
    """The K parts of messages of one kind: their strings, and where their numbers are.

    Places count words of the size of a number, or of four bytes of a stamp, from the head.
    """

    strings: tuple[tuple[str, ...], ...]
    stamps: Index  # (K, 2) places of seconds and nanoseconds
    kind: str
    numbers: Index  # (K, w) places
    begin: int  # offset of the first common byte
    text: NDArray[np.uint8]  # the common bytes
    mask: NDArray[np.uint8]  # 255 for common bytes
    last: slice  # the last block of these

    def among(self, rows: NDArray[np.uint8]) -> Flags:
        """Tell which messages (N, ...) have this layout."""
        part = slice(self.begin, len(self.mask))
        alone = len(self.strings) == 1  # usually even the bytes between are alike: half the cost
        if alone and (rows[:, part] == self.text[part]).all():
            return np.ones(len(rows), dtype=bool)
        equal = (rows[:, self.last] == self.text[self.last]).all(axis=1)  # usually decides
        equal[equal] = ~((rows[equal, part] ^ self.text[part]) & self.mask[part]).any(axis=1)
        return np.asarray(equal)

    def read(
        self, rows: NDArray[np.uint8]
    ) -> Iterator[tuple[tuple[str, ...], Stamps, FloatArray]]:
        """Yield the strings, stamps (N,) and numbers (N, w) of each part of messages (N, ...)."""
        length = rows.shape[1] - _HEAD
        whole = slice(_HEAD, _HEAD + length - length % int(self.kind[2:]))
        words = np.ascontiguousarray(rows[:, whole]).view('<i4')
        times = words.take(self.stamps, axis=1)  # nanoseconds are without sign
        stamps = times[..., 0].astype(np.int64) * 1_000_000_000 + times.view('<u4')[..., 1]
        numbers = words.view(self.kind).take(self.numbers, axis=1).astype(float, copy=False)
        for k, strings in enumerate(self.strings):
            yield strings, stamps[:, k], numbers[:, k]


def alike(
    kind: str, blobs: Sequence[bytes], known: dict[int, list[MessageLayout]]
) -> Iterator[tuple[Index, tuple[str, ...], Stamps, FloatArray]]:
    """Yield what messages of one type and length hold, those of each layout at once.

    Their indices (N,), the strings, stamps (N,) and numbers (N, w) of a part; those without a
    layout are left out. Layouts `known` by message length are reused, and new ones added, up to
    MOST_NAMES.
    """
    length = len(blobs[0])
    if length < _HEAD or kind not in _FORMS:
        return
    rows = np.frombuffer(b''.join(blobs), dtype=np.uint8).reshape(len(blobs), length)
    rest = np.flatnonzero((rows[:, :2] == tuple(LITTLE_ENDIAN)).all(axis=1))
    if len(known) == MOST_NAMES:
        known.clear()
    layouts = known.setdefault(length, [])
    untried, found = list(layouts), 0
    while len(rest) and found < MOST_NAMES:
        if untried:
            layout = untried.pop(0)
        else:
            try:
                layout = _layout(kind, blobs[rest[0]])
            except (struct.error, UnicodeDecodeError):
                rest = rest[1:]
                continue
            if len(layouts) == MOST_NAMES:
                layouts.clear()
            layouts.append(layout)
        left = rows if len(rest) == len(rows) else rows[rest]
        equal = layout.among(left)
        if equal.any():
            found += 1
            for part in layout.read(left if equal.all() else left[equal]):
                yield rest[equal], *part
        rest = rest[~equal]


def _layout(kind: str, blob: bytes) -> MessageLayout:
    """Return the layout of a message, or raise struct.error."""
    texts, between, numbers, count = _FORMS[kind]
    read, size = _Reader(blob), int(numbers[2:])
    parts, begins = list[tuple[str, ...]](), list[tuple[int, int]]()
    for _ in range(read.integer() if kind == TRANSFORMS else 1):
        stamp = _aligned(read.at, 4)
        read.at = stamp + 8
        strings = [read.string() for _ in range(texts)]
        if kind == JOINT_STATE:
            strings += [read.string() for _ in range(read.integer())]
            count = read.integer()
            if len(strings) != count + 1:
                raise struct.error
        begin = _aligned(read.at + between, size)
        read.at = begin + count * size
        if read.at > len(blob):
            raise struct.error
        parts.append(tuple(strings))
        begins.append((stamp, begin))
    mask = np.zeros(read.named[-1].stop, dtype=np.uint8)
    for part in read.named:
        mask[part] = 255
    text = np.frombuffer(blob, dtype=np.uint8)[: len(mask)]
    places = np.array(begins, dtype=np.intp).reshape(-1, 2) - _HEAD
    return MessageLayout(
        tuple(parts),
        places[:, :1] // 4 + np.arange(2),
        numbers,
        places[:, 1:] // size + np.arange(count),
        read.named[0].start,
        text,
        mask,
        read.named[-1],
    )


class _Reader:
    """Reader of the names in a message from offset `at`; `named` are their slices."""

    def __init__(self, blob: bytes) -> None:
        self._blob, self._order = blob, '<' if blob[:2] == LITTLE_ENDIAN else '>'
        self.at = _HEAD
        self.named: list[slice] = []

    def stamp(self) -> int:
        seconds, nanoseconds = struct.unpack_from(f'{self._order}iI', self._blob, self.at)
        self.at += 8
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def integer(self) -> int:
        begin = _aligned(self.at, 4)
        self.at = begin + 4
        self.named.append(slice(begin, self.at))
        return int(struct.unpack_from(f'{self._order}I', self._blob, begin)[0])

    def string(self) -> str:
        """Return a zero-terminated text."""
        length = self.integer()
        begin, self.at = self.at, self.at + length
        self.named[-1] = slice(begin - 4, self.at)
        return self._blob[begin : begin + max(length - 1, 0)].decode()


def read_header(blob: bytes) -> tuple[int, str]:
    """Return stamp [ns] and frame of a serialised message that begins with a header."""
    read = _Reader(blob)
    return read.stamp(), read.string()


def trajectory_size(blob: bytes, most_names: int) -> tuple[int, int]:
    """Return the number of joints and points of a serialised JointTrajectory.

    Zero points if there are more than `most_names` names or they cannot be read: such a message
    cannot be decoded either.
    """
    names = points = 0
    with suppress(struct.error, UnicodeDecodeError):
        read = _Reader(blob)
        read.at += 8
        read.string()
        names = read.integer()
        if names <= most_names:
            for _ in range(names):
                read.string()
            points = read.integer()
    return names, points


def _aligned(at: int, size: int) -> int:
    """Return the next offset aligned to a size after the encapsulation."""
    return at + (_HEAD - at) % size
