# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Grouping of joint values into stops and configurations."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from calib_ros.estimation.levels import ALIKE, CLEARLY, TELLING
from calib_ros.kinematics.se3 import Flags, FloatArray, Index, cos_sin
from calib_ros.settings import Settings

STILL = 2.0 * Settings.still
"""Joint values [rad or m] that differ by less are one configuration: both may deviate from it."""
SCATTER = 0.02
"""Largest scatter [rad or m] of visits to one configuration (benchmarks/harm.py)."""


def count_distinct(numbers: Index) -> int:
    """Return the number of different configurations in (N,)."""
    return int(np.count_nonzero(np.bincount(numbers)))


def renumber(numbers: Index) -> Index:
    """Return configuration numbers (N,) in the same order, but without gaps."""
    return np.asarray((np.cumsum(np.bincount(numbers) > 0) - 1)[numbers])


def group_means(rows: FloatArray, numbers: Index) -> FloatArray:
    """Return the means (M, ...) of rows (N, ...) over groups of successive numbers (N,)."""
    begins = np.flatnonzero(np.diff(numbers, prepend=-1))
    counts = np.diff(begins, append=len(numbers)).reshape(-1, *[1] * (rows.ndim - 1))
    return np.asarray(np.add.reduceat(rows, begins) / counts)


def stops(joints: FloatArray) -> Index:
    """Return the stop number (N,) of consecutive joint values (N, n)."""
    moved = np.zeros(len(joints), dtype=np.intp)
    moved[1:] = ~_still(np.diff(joints, axis=0))
    return np.cumsum(moved)


def _still(change: FloatArray) -> Flags:
    """Return which changes (N, n) of joint values are within STILL (N,), modulo a turn."""
    left = np.abs(change - 2.0 * np.pi * np.rint(change / (2.0 * np.pi)))
    return np.asarray(left.max(axis=1) <= STILL)


def configurations(joints: FloatArray, number: Index | None = None) -> Index:
    """Return the configuration number (N,) of joint values (N, n), with the stops (N,) if known.

    Values within STILL of each other are one configuration, whenever they were taken: a program in
    a loop revisits it instead of measuring another. So are values that are close together compared
    with their distance to all others. Angles count modulo a full turn.
    """
    if len(joints) == 0:
        return np.zeros(0, dtype=np.intp)
    number = stops(joints) if number is None else number
    standing = joints[np.flatnonzero(np.diff(number, prepend=-1))]  # one row a stop
    place = np.concatenate(cos_sin(standing), axis=1)  # modulo a turn
    close = _pairs(place, SCATTER)
    # STILL < SCATTER, so `close` holds all these pairs
    near = close[_still(standing[close[:, 0]] - standing[close[:, 1]])]
    links = _graph(np.ones(len(near)), near[:, 0], near[:, 1], len(standing))
    _, label = connected_components(links, directed=False)
    _, first = np.unique(label, return_index=True)
    if np.isin(close, first).all(axis=1).any():
        label = _repeats(place[first])[label]
    return np.asarray(label[number], dtype=np.intp)


def _repeats(place: FloatArray) -> Index:
    """Return the configuration number (N,) of places (N, 2 n), where scattered visits are one.

    If the distances between nearest places have a gap of a factor of CLEARLY, those below it are
    visits, provided that each configuration is as small as they are.
    """
    count = len(place)
    apart = np.arange(count)
    if count < TELLING:
        return apart
    ranks = range(2, 2 + min(TELLING, count - 1))
    far, near = cKDTree(place).query(place, k=ranks, distance_upper_bound=CLEARLY * SCATTER)
    first, which = np.nonzero(np.isfinite(far))
    graph = _graph(far[first, which], first, near[first, which], count)
    tree = minimum_spanning_tree(graph).tocoo()
    lengths = np.append(np.sort(tree.data), CLEARLY * SCATTER)
    gaps = np.flatnonzero((lengths[1:] >= CLEARLY * lengths[:-1]) & (lengths[:-1] <= SCATTER))
    for reach in lengths[gaps[::-1]]:
        close = tree.data <= reach
        links = _graph(tree.data[close], tree.row[close], tree.col[close], count)
        number, label = connected_components(links, directed=False)
        middle = np.stack([np.bincount(label, row) for row in place.T]) / np.bincount(label)
        extent = np.linalg.norm(place - middle.T[label], axis=1).max()
        if number >= TELLING and extent <= ALIKE * reach:
            return np.asarray(label, dtype=np.intp)
    return apart


def _graph(
    lengths: FloatArray, first: NDArray[np.integer], second: NDArray[np.integer], count: int
) -> coo_array:
    """Return edges (K,) between nodes, with the 32-bit indices that scipy 1.11 needs."""
    ends = (first.astype(np.int32), second.astype(np.int32))
    return coo_array((lengths, ends), shape=(count, count))


def _pairs(place: FloatArray, reach: float) -> Index:
    """Return the pairs (K, 2) of rows of (N, D) within reach of each other.

    Searched in a projection to three directions, which keeps all pairs: trees of more dimensions
    are slow.
    """
    along = place @ _directions(place.shape[1])
    tree = cKDTree(along, balanced_tree=False, compact_nodes=False)
    pairs = tree.query_pairs(reach, output_type='ndarray')
    close = np.linalg.norm(place[pairs[:, 0]] - place[pairs[:, 1]], axis=1) <= reach
    return np.asarray(pairs[close])


@lru_cache
def _directions(size: int) -> FloatArray:  # (D, 3 at most), orthonormal
    return np.linalg.qr(np.random.default_rng(0).normal(size=(size, min(size, 3))))[0]
