# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Decimal numbers of a text, many at once: eight characters at a time in a word of 64 bits.

The digits without the point are an integer m, and 10^k is exact up to k = 22. The nearest double
of m / 10^k is their quotient where m is below 2^53 (Clinger, How to read floating point numbers
accurately, 1990). Else it is the quotient and what remains, over 10^k, where that is not too near
to the middle of two doubles to tell (Dekker, A floating-point technique for extending the
available precision, 1971). The digits of a word add up in three steps, by pairs (Lemire, Number
parsing at a gigabyte per second, 2021).
"""

from __future__ import annotations

from functools import reduce

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics.se3 import FloatArray

Words = NDArray[np.uint64]
LONGEST = 24
"""Characters before the end of a cell that are looked at, without its sign: three words."""


def _each(byte: int) -> np.uint64:
    """Return a word of eight times a byte."""
    return np.uint64(int.from_bytes(bytes([byte] * 8), 'little'))


KEPT = {
    size: np.array([bytes(size - k) + b'\xff' * k for k in range(size + 1)], f'V{size}')
    for size in (16, LONGEST)
}
"""Masks of the last characters, by their number."""
SCALES = np.array([1.0] * 128 + [10.0**k for k in range(LONGEST - 1, -1, -1)])
"""What the digits are divided by: 128 and the place of the point among the characters; else 0."""
SIGNED = np.concatenate([SCALES, -SCALES])


def decimals(
    data: bytes, begins: NDArray[np.intp], ends: NDArray[np.intp]
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the numbers (N,) in cells of a text, and which of them (N,) were read.

    A cell must not end before the 24th character. Those with exponents, more digits, spaces and
    whatever is no number are left.
    """
    first = np.frombuffer(data, dtype=np.uint8)[begins]
    minus = first == ord('-')
    size = ends - begins - (minus | (first == ord('+')))
    width = LONGEST if size.max(initial=0) > 16 else 16
    words = np.ndarray(len(data) - width + 1, f'V{width}', data, 0, (1,))[ends - width].view('<u8')
    words ^= _each(ord('0'))
    words &= KEPT[width][np.minimum(size, width)].view('<u8')
    point = _first(words, ord('.') ^ ord('0')).reshape(-1, width // 8)
    has = point != 0
    points = reduce(np.add, has.view(np.uint8).T)
    digits = _without(words.reshape(point.shape), point, has)
    wrong = reduce(np.bitwise_or, ((digits + _each(0x76)) | digits).T) & _each(0x80)  # above 9
    for step, (factor, mask) in enumerate(
        ((10, 0x00FF00FF00FF00FF), (100, 0x0000FFFF0000FFFF), (10_000, 0xFFFFFFFF))
    ):
        carried = digits >> np.uint64(8 << step)
        digits *= np.uint64(factor)
        digits += carried
        digits &= np.uint64(mask)
    whole = reduce(lambda high, low: high * np.uint64(10**8) + low, digits.T)
    place = reduce(np.bitwise_or, point.T).astype(np.float64).view(np.int64) >> 55  # its exponent
    word = (has * np.arange(LONGEST - width, LONGEST, 8, dtype=np.uint8)).T
    place += reduce(np.maximum, word) + np.uint8(len(SCALES)) * minus
    read = (wrong == 0) & (points <= 1) & (size > points) & (size < LONGEST)
    if width == LONGEST:
        read &= digits[:, 0] < 100  # the integer has 18 digits at most
    found = whole.view(np.int64) / SIGNED[place]
    large = np.flatnonzero(read & (whole > 2**53))
    found[large], sure = _nearest(whole[large].view(np.int64), SIGNED[place[large]])
    read[large] &= sure
    return found, read


def _first(words: Words, byte: int) -> Words:
    """Return the highest bit of the first byte in each word that is `byte`; 0 where none is."""
    other = words ^ _each(byte)
    found = (other - _each(1)) & ~other & _each(0x80)
    return np.asarray(found & np.negative(found))


def _without(words: Words, point: Words, has: NDArray[np.bool_]) -> Words:
    """Return words (N, W) in which the characters before the point have moved one further."""
    moved = has.copy()
    for k in range(words.shape[1] - 1, 0, -1):
        moved[:, k - 1] |= moved[:, k]
    before = words & ((point >> np.uint64(7)) - moved)
    after = words & ~((point << np.uint64(1)) - moved)
    found = (before << np.uint64(8)) | after
    found[:, 1:] |= (words[:, :-1] >> np.uint64(56)) * moved[:, 1:]
    return np.asarray(found)


def _nearest(whole: NDArray[np.int64], scale: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the doubles (N,) nearest to integers over powers of ten, and which are sure."""
    most = whole.astype(np.float64)
    first = most / scale
    rest = (most - first * scale) - _rounding(first, scale) + (whole - most.astype(np.int64))
    second = rest / scale
    found = first + second
    margin = second * 2.0**-50  # of two roundings of it
    return found, (found == first + (second - margin)) & (found == first + (second + margin))


def _rounding(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return what a b is beyond its double, exactly."""
    halves = []
    for each in (a, b):
        large = each * (2.0**27 + 1.0)
        high = large - (large - each)
        halves.append((high, each - high))
    (a_high, a_low), (b_high, b_low) = halves
    return ((a_high * b_high - a * b) + a_high * b_low + a_low * b_high) + a_low * b_low
