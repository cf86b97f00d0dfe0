# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joint values between samples, and the direction in which each joint arrived."""

from __future__ import annotations

import numpy as np

from calib_ros.estimation.configurations import STILL
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.sampling.buffers import Rows
from calib_ros.sampling.slices import Stamps


def interpolated(
    rows: Rows, stamps: Stamps, first: Index, last: Index, revolute: Flags, straight: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return values, velocities and accelerations (N, n) of the cubic through four samples.

    Two before and two after the stamp. At the ends of the recording and beside equal
    stamps, or always if `straight`, values are interpolated linearly.
    """
    known, values = rows.stamps, rows.values
    nothing = np.zeros((len(stamps), values.shape[1]))
    origin = values[first]
    span = (known[last] - known[first]) * 1e-9
    share = (stamps - known[first]) * 1e-9 / np.maximum(span, 1e-9)
    step = unwrapped(values[last] - origin, revolute)
    joints = origin + share[:, np.newaxis] * step
    velocity = step / np.maximum(span, 1e-9)[:, np.newaxis]
    if straight:
        return joints, velocity, nothing
    before, behind = first - 1, np.maximum(last, first + 1) + 1
    inner = (before >= 0) & (behind < rows.count)
    near = np.stack([first - 1, first, np.maximum(last, first + 1), behind])[:, inner]
    times = (known[near] - stamps[inner]) * 1e-9  # (4, N)
    # no cubic over a pause in the samples
    even = np.diff(times, axis=0).max(axis=0) < 3.0 * np.diff(times, axis=0).min(axis=0)
    inner[inner] = even
    near, times = near[:, even], times[:, even]
    heights = unwrapped(values[near] - origin[inner], revolute)  # (4, N, n)
    powers = times.T[..., np.newaxis] ** np.arange(4)
    at, slope, bend, _ = np.linalg.solve(powers, heights.swapaxes(0, 1)).swapaxes(0, 1)
    joints[inner] = origin[inner] + at
    velocity[inner] = slope
    acceleration = nothing.copy()
    acceleration[inner] = 2.0 * bend
    return joints, velocity, acceleration


def unwrapped(steps: FloatArray, revolute: Flags) -> FloatArray:
    """Return differences (M, n) of joint values without full turns of revolute joints."""
    turn = np.round(steps / (2.0 * np.pi)) * (2.0 * np.pi)
    return np.asarray(steps - np.where(revolute, turn, 0.0))


def continuous(values: FloatArray, revolute: Flags) -> FloatArray:
    """Return successive joint values (M, n) without jumps of a turn."""
    return np.where(revolute, np.unwrap(values, axis=0), values)


def last_moves(
    values: FloatArray, first: Index, now: FloatArray, earlier: FloatArray, revolute: Flags
) -> FloatArray:
    """Return the signs (N, n) of the last move of each joint before its present value.

    Relative to the last of the samples (M, n) up to index `first` (N,) that differs; without one,
    `earlier` (n,) holds earlier signs.
    """
    path = continuous(values, revolute)
    now = path[first] + unwrapped(now - path[first], revolute)
    last = _last_outside(path, first, now - STILL, now + STILL)
    signs = np.sign(now - np.take_along_axis(path, last, axis=0))
    return np.asarray(np.where(last >= 0, signs, earlier))


def _last_outside(values: FloatArray, last: Index, low: FloatArray, high: FloatArray) -> Index:
    """Return the index (N, n) of the last value (M, n) up to `last` (N,) outside, or -1.

    By the extremes of blocks of 1, 2, 4, ... values, up to the one that holds it and down again.
    """
    lows, highs = [values], [values]
    while len(lows[-1]) > 1:
        even = len(lows[-1]) // 2 * 2
        lows.append(np.minimum(lows[-1][:even:2], lows[-1][1:even:2]))
        highs.append(np.maximum(highs[-1][:even:2], highs[-1][1:even:2]))
    shape, low, high = low.shape, low.ravel(), high.ravel()
    column = np.tile(np.arange(shape[1]), shape[0])
    end = np.repeat(last + 1, shape[1])  # not yet searched before this
    found, sizes = np.full(len(end), -1), np.zeros(len(end), dtype=np.intp)

    def outside(level: int, block: Index, rows: Index) -> Flags:
        where = (block, column[rows])
        return np.asarray((lows[level][where] < low[rows]) | (highs[level][where] > high[rows]))

    for level in range(len(lows)):
        rows = np.flatnonzero((found < 0) & (end >> level & 1 == 1))
        block = (end[rows] >> level) - 1
        hit = outside(level, block, rows)
        found[rows[hit]], sizes[rows[hit]] = block[hit], level
        end[rows[~hit]] -= 1 << level
    for level in reversed(range(len(lows) - 1)):
        rows = np.flatnonzero(sizes > level)
        block = 2 * found[rows] + 1
        found[rows] = np.where(outside(level, block, rows), block, block - 1)
    return found.reshape(shape)
