# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Decoding of serialised messages of a recording straight to arrays.

Messages of one topic mostly differ only in stamps and numbers: the names, or at least their
lengths, and so the offsets of the numbers (OMG Common Data Representation), are the same. The
layout is derived from the first message, others of its length are compared with it byte by byte,
and all numbers are read at once, and then divided by names.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.sampling.messages import FORMS, JOINT_STATE, TRANSFORMS
from calib_ros.sampling.slices import Stamps
from calib_ros.values import MOST_NAMES

BYTE_ORDERS = {b'\x00\x01': '<', b'\x00\x00': '>'}
"""Order of bytes by the encoding of a message."""
_HEAD = struct.calcsize('2s2s')  # encoding and options


Strings: TypeAlias = 'tuple[tuple[str, ...], ...]'
"""Those of each part of a message."""
Groups: TypeAlias = 'list[tuple[Index | slice, Strings]]'
"""Indices of messages with the same strings, and these."""


@dataclass(frozen=True, eq=False)
class MessageLayout:
    """The K parts of messages of one kind: where their strings and their numbers are.

    Places count words of the size of a number, or of four bytes of a stamp, from the head; those
    of strings, and of their bytes and lengths, count bytes.
    """

    strings: Strings  # of the first message
    places: tuple[tuple[slice, ...], ...]  # of these, with the zero at the end
    stamps: Index  # (K, 2) places of seconds and nanoseconds
    kind: str  # of the numbers, with the order of bytes
    numbers: Index  # (K, w) places
    lengths: Index  # (L,) places
    named: Index  # (M,) places
    text: NDArray[np.uint8]  # the first message
    common: slice  # what the strings and lengths span

    def read(
        self, rows: NDArray[np.uint8]
    ) -> tuple[Flags, list[tuple[Index | slice, tuple[str, ...], Stamps, FloatArray]]]:
        """Return which messages (N, ...) have this layout, and what they hold.

        Indices (G,) among these, the strings, stamps (G,) and numbers (G, w) of a part.
        """
        same = np.ones(len(rows), dtype=bool)
        groups: Groups = [(slice(None), self.strings)]  # usually
        if len(self.strings) > 1 or (rows[:, self.common] != self.text[self.common]).any():
            same = (rows.take(self.lengths, axis=1) == self.text[self.lengths]).all(axis=1)
            rows = rows if same.all() else rows[same]
            groups = self._by_names(rows)
        length, size = rows.shape[1] - _HEAD, int(self.kind[2:])
        words = np.ascontiguousarray(rows[:, _HEAD : _HEAD + length - length % size])
        order, words = self.kind[0], words.view(f'{self.kind[0]}i4')
        times = words.take(self.stamps, axis=1)  # nanoseconds are without sign
        stamps = times[..., 0].astype(np.int64) * 1_000_000_000 + times.view(f'{order}u4')[..., 1]
        numbers = words.view(self.kind).take(self.numbers, axis=1).astype(float, copy=False)
        return same, [
            (which, names, stamps[which, k], numbers[which, k])
            for which, strings in groups
            for k, names in enumerate(strings)
        ]

    def _by_names(self, rows: NDArray[np.uint8]) -> Groups:
        """Return the messages (N, ...) with the same strings, and these; not damaged ones."""
        texts = rows.take(self.named, axis=1)
        if (texts == self.text[self.named]).all():
            return [(slice(None), self.strings)]
        whole = texts.view(f'V{texts.shape[1]}').ravel()
        _, group, counts = np.unique(whole, return_inverse=True, return_counts=True)
        members = np.split(np.argsort(group, kind='stable'), np.cumsum(counts)[:-1])
        found: Groups = []
        for which in sorted(members, key=lambda each: int(each[0])):
            row = rows[which[0]].tobytes()
            with suppress(UnicodeDecodeError):
                strings = tuple(
                    tuple(row[at][:-1].decode() for at in each) for each in self.places
                )
                found.append((which, strings))
        return found


Layouts: TypeAlias = dict[tuple[int, bytes], list[MessageLayout]]
"""Layouts by the length and the encoding of messages."""


def alike(
    kind: str, blobs: Sequence[bytes], known: Layouts
) -> Iterator[tuple[Index, tuple[str, ...], Stamps, FloatArray]]:
    """Yield what messages of one type, encoding and length hold, those of each layout at once.

    Their indices (N,), the strings, stamps (N,) and numbers (N, w) of a part; damaged ones are
    left out. Layouts that are `known` are reused, and new ones added, up to MOST_NAMES.
    """
    length, encoding = len(blobs[0]), blobs[0][:2]
    rows = np.frombuffer(b''.join(blobs), dtype=np.uint8).reshape(len(blobs), length)
    rest = np.arange(len(rows))
    if len(known) == MOST_NAMES:
        known.clear()
    layouts = known.setdefault((length, encoding), [])
    untried, tried = list(layouts), 0
    while len(rest):
        if untried:
            layout = untried.pop(0)
        else:
            try:
                layout = message_layout(kind, blobs[rest[0]])
            except (struct.error, UnicodeDecodeError):
                rest = rest[1:]
                continue
            if len(layouts) == MOST_NAMES:
                layouts.clear()
            layouts.append(layout)
        some = rest if tried < MOST_NAMES else rest[:1]  # of so many layouts, each by itself
        tried += 1
        same, found = layout.read(rows if len(some) == len(rows) else rows[some])
        own = some[same]
        for which, strings, stamps, numbers in found if len(own) else ():
            yield own[which], strings, stamps, numbers
        rest = np.concatenate([some[~same], rest[len(some) :]])


def message_layout(kind: str, blob: bytes) -> MessageLayout:
    """Return the layout of a message; raise what is wrong with a damaged one."""
    if blob[:2] not in BYTE_ORDERS:
        raise struct.error('it is not in CDR')
    texts, between, numbers, count = FORMS[kind]
    read, size = _Reader(blob), int(numbers[1:])
    parts, at, begins = list[tuple[str, ...]](), list[tuple[slice, ...]](), list[tuple[int, int]]()
    for _ in range(read.count() if kind == TRANSFORMS else 1):
        stamp = _aligned(read.at, 4)
        read.at = stamp + 8
        strings = [read.string() for _ in range(texts)]
        if kind == JOINT_STATE:
            strings += [read.string() for _ in range(read.count())]
            count = read.integer()
        begin = _aligned(read.at + between, size)
        read.at = begin + count * size
        if read.at > len(blob):
            raise struct.error('it is cut off')
        parts.append(tuple(strings))
        at.append(tuple(read.texts[-len(strings) :]))
        begins.append((stamp, begin))
    mask = np.zeros(len(blob), dtype=bool)
    for each in read.texts:
        mask[each] = True
    lengths = np.add.outer(read.lengths, np.arange(4)).ravel()
    places = np.array(begins, dtype=np.intp).reshape(-1, 2) - _HEAD
    return MessageLayout(
        tuple(parts),
        tuple(at),
        places[:, :1] // 4 + np.arange(2),
        BYTE_ORDERS[blob[:2]] + numbers,
        places[:, 1:] // size + np.arange(count),
        lengths,
        np.flatnonzero(mask),
        np.frombuffer(blob, dtype=np.uint8),
        slice(lengths[0], max(lengths[-1] + 1, read.texts[-1].stop if read.texts else 0)),
    )


class _Reader:
    """Reader of the names in a message from offset `at`; `texts` are their slices."""

    def __init__(self, blob: bytes) -> None:
        self._blob, self._order = blob, BYTE_ORDERS.get(blob[:2], '>')
        self.at = _HEAD
        self.texts: list[slice] = []
        self.lengths: list[int] = []  # and counts: their offsets

    def stamp(self) -> int:
        seconds, nanoseconds = struct.unpack_from(f'{self._order}iI', self._blob, self.at)
        self.at += 8
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def integer(self) -> int:
        begin = _aligned(self.at, 4)
        self.at = begin + 4
        if self.at > len(self._blob):
            raise struct.error('it is cut off')
        self.lengths.append(begin)
        return int(struct.unpack_from(f'{self._order}I', self._blob, begin)[0])

    def count(self) -> int:
        """Return the number of texts or transforms that follow."""
        count = self.integer()
        if self.at + 4 * count > len(self._blob):  # the least that they take
            raise struct.error('it is cut off')
        return count

    def string(self) -> str:
        """Return a zero-terminated text."""
        length = self.integer()
        begin, self.at = self.at, self.at + length
        self.texts.append(slice(begin, self.at))
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
