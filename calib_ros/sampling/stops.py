# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The mean of what was measured while the arm stood.

An arm vibrates after its joints have stopped. So the mean begins where the measurements have come
as close to the later ones as their noise allows, and a stop whose measurements still spread more
than that is refused: something moved that no joint reports. The noise is the sigma given or the
one that successive differences show (von Neumann 1941), whichever is larger: a slow motion is in
the spread, but hardly in the differences.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.identification.levels import MOST_OUTLIERS
from calib_ros.kinematics.se3 import FloatArray

MOST_SPREAD = 2.0
"""Largest spread [noise] of measurements and joints at a stop: a motion is in the spread alone."""
NEAR = 2.0 * MOST_SPREAD
"""Distance [noise] to the later half within which a measurement is taken to have settled."""
SPIKE = 3.0 * MOST_SPREAD
"""A single measurement further from the median [noise] is left out of the mean."""
LEAST_COUNT = 4
"""With fewer measurements nothing can be said about their spread."""


@dataclass(frozen=True, eq=False)
class Means:
    """The means of what was measured at S stops: `values` (S, 3) or (S, 1) [m].

    `used` (N,) are the measurements in them, `spreads` (S,) the RMS of one coordinate about them
    [m]; where `rests` (S,) is False measurements spread more than their noise.
    """

    used: NDArray[np.bool_]
    rests: NDArray[np.bool_]
    values: FloatArray
    spreads: FloatArray


def averages(values: FloatArray, begins: NDArray[np.intp], sigmas: FloatArray) -> Means:
    """Average positions (N, 3) or distances (N, 1) [m] stop by stop, in the order of their stamps.

    The stops begin at `begins` (S,); `sigmas` (S,) [m] are those of one coordinate expected.
    """
    used, limits = np.ones(len(values), dtype=bool), np.full(len(begins), np.inf)
    rests = np.ones(len(begins), dtype=bool)
    ends = np.append(begins[1:], len(values))
    for k in np.flatnonzero(ends - begins >= LEAST_COUNT).tolist():
        part = slice(begins[k], ends[k])
        noise = max(sigmas[k], _noise(values[part]))
        limits[k] = MOST_SPREAD * noise
        reach = noise * np.sqrt(values.shape[1])
        settled = used[part]
        settled[: _settled(values[part], reach)] = False
        middle = np.median(values[part][settled], axis=0)
        spikes = _distance(values[part], middle) > SPIKE * reach
        rests[k] = (spikes & settled).sum() <= MOST_OUTLIERS * settled.sum()  # else two places
        settled &= ~spikes
    means = mean_of_each(values, begins, used)
    squares = (values - np.repeat(means, ends - begins, axis=0)) ** 2
    spreads = np.sqrt(mean_of_each(squares, begins, used).mean(axis=1))
    return Means(used, rests & (spreads <= limits), means, spreads)


def mean_of_each(
    rows: FloatArray, begins: NDArray[np.intp], used: NDArray[np.bool_]
) -> FloatArray:
    """Return the means (S, ...) of the rows (N, ...) in use of each stop, zero where none is."""
    shape = (-1,) + (1,) * (rows.ndim - 1)
    counts = np.maximum(np.add.reduceat(used, begins, dtype=np.intp), 1)
    return np.asarray(np.add.reduceat(rows * used.reshape(shape), begins) / counts.reshape(shape))


def _noise(values: FloatArray) -> float:
    """Return the standard deviation of one coordinate from successive differences."""
    steps = np.abs(np.diff(values, axis=0))
    return float(1.4826 * np.median(steps) / np.sqrt(2.0))  # the median: spikes do not count


def _settled(values: FloatArray, reach: float) -> int:
    """Return how many measurements come before all of them stay near the later half."""
    half = len(values) // 2
    far = _distance(values[:half], np.median(values[half:], axis=0)) > NEAR * reach
    # A spike among settled ones is no vibration: two of three in a row must be far.
    pairs = far & (np.append(far[1:], False) | np.append(far[2:], [False, False]))
    last = np.flatnonzero(pairs)
    return int(last[-1]) + 2 if last.size else 0


def _distance(values: FloatArray, point: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(values - point, axis=1))
