# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Means of the measurements at stops, without spikes and what had not settled (docs/model.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_ros.estimation.levels import FEW, MOST_OUTLIERS, TELLING
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.settings import EXCEPTION

MOST_SPREAD = 2.0
"""Largest spread [noise] of measurements and joints at a stop. A convention."""
NEAR = 2.0 * MOST_SPREAD
"""Distance [noise] to the later half within which a measurement has settled."""
SPIKE = 3.0 * MOST_SPREAD
"""Distance [noise] from the median beyond which a single measurement is rejected."""


@dataclass(frozen=True, eq=False)
class Means:
    """Means of the measurements at S stops."""

    used: Flags  # (N,) measurements used
    rests: Flags  # (S,) False if measurements spread more than noise
    values: FloatArray  # (S, 3) or (S, 1) [m]
    spreads: FloatArray  # (S,) RMS of one coordinate about the mean [m]
    doubled: Flags  # (S,) True if measurements are of several places by turns


def averages(values: FloatArray, begins: Index, sigmas: FloatArray) -> Means:
    """Average positions (N, 3) or distances (N, 1) [m] of each stop, in stamp order.

    Stops begin at `begins` (S,); `sigmas` (S,) [m] are the expected ones of a coordinate.
    """
    used, limits = np.ones(len(values), dtype=bool), np.full(len(begins), np.inf)
    rests = np.ones(len(begins), dtype=bool)
    ends = np.append(begins[1:], len(values))
    for k in np.flatnonzero(ends - begins >= FEW).tolist():
        part = slice(begins[k], ends[k])
        noise = max(sigmas[k], _noise(values[part]))
        limits[k] = MOST_SPREAD * noise
        reach = noise * np.sqrt(values.shape[1])
        settled = used[part]
        settled[: _settled(values[part], reach)] = False
        middle = np.median(values[part][settled], axis=0)
        spikes = np.linalg.norm(values[part] - middle, axis=1) > SPIKE * reach
        rests[k] = (spikes & settled).sum() <= MOST_OUTLIERS * settled.sum()  # else in two places
        settled &= ~spikes
    means = mean_of_each(values, begins, used)
    squares = (values - np.repeat(means, ends - begins, axis=0)) ** 2
    spreads, wide = (
        np.sqrt(mean_of_each(squares, begins, which).mean(axis=1))
        for which in (used, np.ones_like(used))
    )
    doubled = (ends - begins >= TELLING) & (wide > MOST_SPREAD * sigmas)
    for k in np.flatnonzero(doubled).tolist():
        part = slice(begins[k], ends[k])
        plain = spreads[k] > MOST_SPREAD * sigmas[k] and _in_heaps(values[part][used[part]])
        doubled[k] = plain or _in_heaps(values[part])  # the rarer one may seem to be spikes
        spreads[k] = spreads[k] if plain or not doubled[k] else wide[k]
    return Means(used, rests & (spreads <= limits), means, spreads, doubled)


def mean_of_each(rows: FloatArray, begins: Index, used: Flags) -> FloatArray:
    """Return the means (S, ...) of the used rows (N, ...) of each stop, zero if none."""
    shape = (-1,) + (1,) * (rows.ndim - 1)
    counts = np.maximum(np.add.reduceat(used, begins, dtype=np.intp), 1)
    return np.asarray(np.add.reduceat(rows * used.reshape(shape), begins) / counts.reshape(shape))


def _noise(values: FloatArray) -> float:
    """Return the standard deviation of a coordinate, RMS over them, from successive differences.

    The second ones have less of a motion in them, the first ones fewer spikes.
    """
    first, second = (np.median(np.abs(np.diff(values, k, axis=0)), axis=0) for k in (1, 2))
    noise = np.minimum(first / np.sqrt(2.0), second / np.sqrt(6.0))
    return float(1.4826 * np.sqrt((noise**2).mean()))  # the median: spikes do not count


def _in_heaps(values: FloatArray) -> bool:
    """Tell whether values (N, w) lie in heaps by turns, ten times their size apart.

    No noise does: of two parts Gaussian noise leaves 36 % of the variance within them, a swing
    19 %, heaps 4 %; of more parts each leaves less. A target that settles comes to each once.
    """
    away = values - values.mean(axis=0)
    along = away @ np.linalg.svd(away, full_matrices=False)[2][0]
    order = np.argsort(along)
    heap = np.zeros(len(along), dtype=int)
    heap[order[1:]] = np.cumsum(np.diff(along[order]) > 0.5 * along.std())
    counts = np.bincount(heap)
    within = along @ along - (np.bincount(heap, along) ** 2 / counts).sum()
    most = 2.0 * EXCEPTION * (along @ along) / len(counts) ** 2
    turns = np.count_nonzero(np.diff(heap)) > 1
    return bool(counts.min() >= FEW and within < most and turns)


def _settled(values: FloatArray, reach: float) -> int:
    """Return the number of measurements before all stay near the later half."""
    half = len(values) // 2
    far = np.linalg.norm(values[:half] - np.median(values[half:], axis=0), axis=1) > NEAR * reach
    # vibration, not a spike: two of three in a row are far
    pairs = far & (np.append(far[1:], False) | np.append(far[2:], [False, False]))
    last = np.flatnonzero(pairs)
    return int(last[-1]) + 2 if last.size else 0
