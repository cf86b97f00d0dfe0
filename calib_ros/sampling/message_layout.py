# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Layouts of serialised messages: where their strings and numbers are."""

from __future__ import annotations

import struct
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.sampling.cdr import BYTE_ORDERS, HEAD_SIZE, CdrReader, aligned
from calib_ros.sampling.messages import FORMS, JOINT_STATE, TRANSFORMS
from calib_ros.sampling.slices import Stamps

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
        length, size = rows.shape[1] - HEAD_SIZE, int(self.kind[2:])
        words = np.ascontiguousarray(rows[:, HEAD_SIZE : HEAD_SIZE + length - length % size])
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


def message_layout(kind: str, blob: bytes) -> MessageLayout:
    """Return the layout of a message; raise what is wrong with a damaged one."""
    if blob[:2] not in BYTE_ORDERS:
        raise struct.error('it is not in CDR')
    texts, between, numbers, count = FORMS[kind]
    read, size = CdrReader(blob), int(numbers[1:])
    parts, at, begins = list[tuple[str, ...]](), list[tuple[slice, ...]](), list[tuple[int, int]]()
    for _ in range(read.count() if kind == TRANSFORMS else 1):
        stamp = aligned(read.at, 4)
        read.at = stamp + 8
        strings = [read.string() for _ in range(texts)]
        if kind == JOINT_STATE:
            strings += [read.string() for _ in range(read.count())]
            count = read.integer()
        begin = aligned(read.at + between, size)
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
    places = np.array(begins, dtype=np.intp).reshape(-1, 2) - HEAD_SIZE
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
