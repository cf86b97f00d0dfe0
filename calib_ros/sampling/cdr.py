# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Serialised messages of a recording straight to arrays.

Messages of one topic mostly differ in their stamps and numbers only: the names in them, and so
the places of the numbers (OMG Common Data Representation), are the same. The layout is read off
the first message of a batch, the others are held against it byte by byte, and all numbers are
taken and checked at once. A batch whose layouts differ is no error: `None` says that each message
must be decoded by itself.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.sampling.messages import JOINT_STATE, Readings, frame_name
from calib_ros.sampling.rows import Stamps
from calib_ros.values import MOST_NAMES

LITTLE_ENDIAN = b'\x00\x01'
MOST_LAYOUTS = 2 * MOST_NAMES
"""Layouts of messages of one length that are remembered, and such lengths."""
_HEAD, _STAMP = 4, 8  # bytes of the encapsulation and of the stamp

# Of each type: strings before the numbers, bytes between, kind and count of the numbers.
_LAYOUTS: dict[str, tuple[int, int, str, int]] = {
    'geometry_msgs/msg/PoseStamped': (1, 0, '<f8', 7),
    'geometry_msgs/msg/PointStamped': (1, 0, '<f8', 3),
    'geometry_msgs/msg/TransformStamped': (2, 0, '<f8', 7),
    'geometry_msgs/msg/PoseWithCovarianceStamped': (1, 0, '<f8', 43),
    'nav_msgs/msg/Odometry': (2, 0, '<f8', 43),
    'sensor_msgs/msg/Range': (1, 1, '<f4', 4),
}


def decode(kind: str, blobs: Sequence[bytes]) -> Readings | None:
    """Return serialised messages of one topic and type as arrays; None where layouts differ."""
    first = blobs[0]
    length = len(first)
    if first[:2] != LITTLE_ENDIAN or set(map(len, blobs)) != {length}:
        return None
    try:
        strings, begin, dtype, count = _layout(kind, first)
    except (struct.error, UnicodeDecodeError):
        return None
    size = np.dtype(dtype).itemsize
    if begin + count * size > length or (kind == JOINT_STATE and len(strings) != count + 1):
        return None
    rows = np.frombuffer(b''.join(blobs), dtype=np.uint8).reshape(len(blobs), length)
    names = rows[:, _HEAD + _STAMP : begin]
    if (rows[:, :2] != rows[0, :2]).any() or (names != names[0]).any():
        return None
    numbers = _numbers(rows, begin, dtype, count)
    if kind.endswith('/Range'):  # after field of view, least and greatest range
        numbers = numbers[:, 3:]
    return Readings(_stamps(_numbers(rows, _HEAD, '<u4', 2)), strings, numbers.astype(np.float64))


@dataclass(frozen=True, eq=False)
class Layout:
    """Where in a TFMessage things are: of its transforms the links, stamps and numbers.

    `names` are the places of all that makes it this layout, the `last` ones in one piece, and
    `text` is what stands there.
    """

    links: tuple[tuple[str, str], ...]
    stamps: tuple[int, ...]
    numbers: tuple[int, ...]
    names: NDArray[np.intp]
    last: tuple[int, int]
    text: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Alike:
    """TFMessages of one layout: which of a batch they are, and their bytes (N, ...)."""

    layout: Layout
    which: NDArray[np.intp]
    ends: tuple[bytes, bytes]
    rows: NDArray[np.uint8]

    def of(self, k: int) -> Readings:
        """Return stamps (N,) and numbers (N, 7) of one transform of each."""
        numbers = _numbers(self.rows, self.layout.numbers[k], '<f8', 7).astype(np.float64)
        stamps = _stamps(_numbers(self.rows, self.layout.stamps[k], '<u4', 2))
        return Readings(stamps, self.layout.links[k], numbers)

    def span(self, k: int) -> tuple[int, int]:
        """Return the first and the last stamp of one transform of each."""
        (s, ns), (t, nt) = (struct.unpack_from('<iI', x, self.layout.stamps[k]) for x in self.ends)
        return s * 1_000_000_000 + ns, t * 1_000_000_000 + nt


def transforms(blobs: Sequence[bytes], known: dict[int, list[Layout]]) -> list[Alike]:
    """Return what is in TFMessages of one length; those that cannot be read are in none.

    Layouts that are `known` by the length of messages need not be found again, and are added.
    """
    length = len(blobs[0])
    if length < _HEAD:
        return []
    rows = np.frombuffer(b''.join(blobs), dtype=np.uint8).reshape(len(blobs), length)
    rest = np.flatnonzero((rows[:, :2] == tuple(LITTLE_ENDIAN)).all(axis=1))
    if len(known) == MOST_LAYOUTS:
        known.clear()
    layouts = known.setdefault(length, [])
    found: list[Alike] = []
    for layout in layouts:
        rest = _part(blobs, rows, rest, layout, found)
    while len(rest):
        try:
            layout = _transform_layout(blobs[rest[0]])
        except (struct.error, UnicodeDecodeError):
            rest = rest[1:]
            continue
        if len(layouts) == MOST_LAYOUTS:
            layouts.clear()
        layouts.append(layout)
        rest = _part(blobs, rows, rest, layout, found)
    return found


def _part(
    blobs: Sequence[bytes],
    rows: NDArray[np.uint8],
    rest: NDArray[np.intp],
    layout: Layout,
    found: list[Alike],
) -> NDArray[np.intp]:
    """Add those of some messages that have a layout to what is found; return the others."""
    begin, end = layout.last
    equal = (rows[rest, begin:end] == layout.text[len(layout.text) - (end - begin) :]).all(axis=1)
    likely = np.flatnonzero(equal)  # mostly the last name tells; places are slow to gather
    equal[likely] = (rows[np.ix_(rest[likely], layout.names)] == layout.text).all(axis=1)
    which: NDArray[np.intp] = rest[equal]
    others: NDArray[np.intp] = rest[~equal]
    if len(which):
        found.append(Alike(layout, which, (blobs[which[0]], blobs[which[-1]]), rows[which]))
    return others


def _transform_layout(blob: bytes) -> Layout:
    count, at = _integer(blob, _HEAD)
    links, stamps, numbers, names = [], [], [], [np.arange(_HEAD, at)]
    for _ in range(count):
        stamps.append(_aligned(at, 4))
        begin = stamps[-1] + _STAMP
        parent, middle = _string(blob, begin)
        child, end = _string(blob, _aligned(middle, 4))
        numbers.append(_aligned(end, 8))
        at = numbers[-1] + 56
        if at > len(blob):
            raise struct.error
        names += [np.arange(begin, middle), np.arange(_aligned(middle, 4), end)]
        links.append((frame_name(parent), frame_name(child)))
    places = np.concatenate(names)
    text = np.frombuffer(blob, dtype=np.uint8)[places]
    last = int(names[-1][0]), int(names[-1][-1]) + 1
    return Layout(tuple(links), tuple(stamps), tuple(numbers), places, last, text)


def _stamps(times: NDArray[np.generic]) -> Stamps:
    """Return stamps (N,) [ns] of signed seconds and nanoseconds (N, 2)."""
    seconds, nanoseconds = times[:, 0].view(np.int32), times[:, 1]
    return seconds.astype(np.int64) * 1_000_000_000 + nanoseconds.astype(np.int64)


def _layout(kind: str, blob: bytes) -> tuple[tuple[str, ...], int, str, int]:
    """Return strings, the place of the numbers, their kind and count."""
    at = _HEAD + _STAMP
    if kind == JOINT_STATE:
        frame_id, at = _string(blob, at)
        names, at = _integer(blob, at)
        strings = [frame_id]
        for _ in range(names):
            name, at = _string(blob, at)
            strings.append(name)
        count, at = _integer(blob, at)
        return tuple(strings), _aligned(at, 8), '<f8', count
    texts, between, dtype, count = _LAYOUTS[kind]
    strings = []
    for _ in range(texts):
        text, at = _string(blob, at)
        strings.append(text)
    return tuple(strings), _aligned(at + between, np.dtype(dtype).itemsize), dtype, count


def head(blob: bytes) -> tuple[int, str]:
    """Return stamp [ns] and frame of a serialised message that begins with a header."""
    order = '<' if blob[:2] == LITTLE_ENDIAN else '>'
    seconds, nanoseconds = struct.unpack_from(f'{order}iI', blob, _HEAD)
    return seconds * 1_000_000_000 + nanoseconds, _string(blob, _HEAD + _STAMP, order)[0]


def trajectory_size(blob: bytes, most_names: int) -> tuple[int, int]:
    """Return how many joints and points a serialised JointTrajectory has.

    Zero points where names are too many to be passed over on the way to these, or cannot be read:
    such a message cannot be decoded either.
    """
    order = '<' if blob[:2] == LITTLE_ENDIAN else '>'
    names = 0
    try:
        at = _string(blob, _HEAD + _STAMP, order)[1]
        names, at = _integer(blob, at, order)
        for _ in range(min(names, most_names)):
            at = _string(blob, at, order)[1]
        points = _integer(blob, at, order)[0] if names <= most_names else 0
    except (struct.error, UnicodeDecodeError):
        return names, 0
    return names, points


def _aligned(at: int, size: int) -> int:
    """Return the next place that is a multiple of a size after the encapsulation."""
    return at + (_HEAD - at) % size


def _integer(blob: bytes, at: int, order: str = '<') -> tuple[int, int]:
    at = _aligned(at, 4)
    return int(struct.unpack_from(f'{order}I', blob, at)[0]), at + 4


def _string(blob: bytes, at: int, order: str = '<') -> tuple[str, int]:
    length, at = _integer(blob, at, order)
    return blob[at : at + max(length - 1, 0)].decode(), at + length


def _numbers(rows: NDArray[np.uint8], begin: int, dtype: str, count: int) -> NDArray[np.generic]:
    size = np.dtype(dtype).itemsize * count
    return np.ascontiguousarray(rows[:, begin : begin + size]).view(dtype)
