# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Names in a serialised message, read one by one (OMG Common Data Representation)."""

from __future__ import annotations

import struct
from contextlib import suppress

BYTE_ORDERS = {b'\x00\x01': '<', b'\x00\x00': '>'}
"""Order of bytes by the encoding of a message."""
HEAD_SIZE = struct.calcsize('2s2s')  # encoding and options


class CdrReader:
    """Reader of the names in a message from offset `at`; `texts` are their slices."""

    def __init__(self, blob: bytes) -> None:
        self._blob, self._order = blob, BYTE_ORDERS.get(blob[:2], '>')
        self.at = HEAD_SIZE
        self.texts: list[slice] = []
        self.lengths: list[int] = []  # and counts: their offsets

    def stamp(self) -> int:
        """Return a stamp [ns]."""
        seconds, nanoseconds = struct.unpack_from(f'{self._order}iI', self._blob, self.at)
        self.at += 8
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def integer(self) -> int:
        """Return a length or a count."""
        begin = aligned(self.at, 4)
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
    read = CdrReader(blob)
    return read.stamp(), read.string()


def trajectory_size(blob: bytes, most_names: int) -> tuple[int, int]:
    """Return the number of joints and points of a serialised JointTrajectory.

    Zero points if there are more than `most_names` names or they cannot be read: such a message
    cannot be decoded either.
    """
    names = points = 0
    with suppress(struct.error, UnicodeDecodeError):
        read = CdrReader(blob)
        read.at += 8
        read.string()
        names = read.integer()
        if names <= most_names:
            for _ in range(names):
                read.string()
            points = read.integer()
    return names, points


def aligned(at: int, size: int) -> int:
    """Return the next offset aligned to a size [bytes] after the head."""
    return at + (HEAD_SIZE - at) % size
