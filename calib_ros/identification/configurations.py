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

from calib_ros.identification.levels import ALIKE, CLEARLY, TELLING
from calib_ros.kinematics.se3 import FloatArray, cos_sin
from calib_ros.settings import Settings

STILL = 2.0 * Settings.still
"""Joint values [rad or m] that differ by less are one configuration: both may leave it."""
SCATTER = 0.02
"""Distance [rad or m] up to which visits of one configuration may scatter (benchmarks/harm.py)."""


def distinct(numbers: NDArray[np.intp]) -> int:
    """Return how many different numbers (N,) of configurations there are."""
    return int(np.count_nonzero(np.bincount(numbers)))


def stops(joints: FloatArray) -> NDArray[np.intp]:
    """Return (N,) the number of the stop at which joint values (N, n) in sequence were taken."""
    moved = np.zeros(len(joints), dtype=np.intp)
    moved[1:] = ~_still(np.diff(joints, axis=0))
    return np.cumsum(moved)


def _still(change: FloatArray) -> NDArray[np.bool_]:
    """Return (N,) which changes (N, n) of joint values are none; angles modulo a turn."""
    change = np.abs(change) % (2.0 * np.pi)
    return np.asarray(np.minimum(change, 2.0 * np.pi - change).max(axis=1) <= STILL)


def configurations(joints: FloatArray) -> NDArray[np.intp]:
    """Return (N,) the number of the configuration that joint values (N, n) belong to.

    Values within STILL of each other are one configuration, whenever they were taken: a program
    that runs in a loop visits it again, it does not measure another one. So are those that lie
    as close together beside their distance from all others. Angles count modulo a full turn.
    """
    if len(joints) == 0:
        return np.zeros(0, dtype=np.intp)
    number = stops(joints)
    standing = joints[np.flatnonzero(np.diff(number, prepend=-1))]  # one row a stop
    place = np.concatenate(cos_sin(standing), axis=1)  # which knows no turns
    close = _pairs(place, SCATTER)
    # what stands still is nearer than visits may scatter
    near = close[_still(standing[close[:, 0]] - standing[close[:, 1]])]
    links = _graph(np.ones(len(near)), near[:, 0], near[:, 1], len(standing))
    _, label = connected_components(links, directed=False)
    _, first = np.unique(label, return_index=True)
    if np.isin(close, first).all(axis=1).any():
        label = _repeats(place[first])[label]
    return np.asarray(label[number], dtype=np.intp)


def _repeats(place: FloatArray) -> NDArray[np.intp]:
    """Return (N,) which places (N, 2 n) are visits of one configuration that scatter.

    Where the distances of nearest values leave a gap, from so much to CLEARLY times as much, those
    below it are visits, as long as each configuration is as small as they are.
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
    """Return edges (K,) between nodes, whose numbers scipy 1.11 wants in 32 bits."""
    ends = (first.astype(np.int32), second.astype(np.int32))
    return coo_array((lengths, ends), shape=(count, count))


def _pairs(place: FloatArray, reach: float) -> NDArray[np.intp]:
    """Return (K, 2) the rows of (N, D) that are no further apart than a reach.

    In a projection on three directions they are as near; trees of more dimensions are slow.
    """
    along = place @ _directions(place.shape[1])
    tree = cKDTree(along, balanced_tree=False, compact_nodes=False)
    pairs = tree.query_pairs(reach, output_type='ndarray')
    close = np.linalg.norm(place[pairs[:, 0]] - place[pairs[:, 1]], axis=1) <= reach
    return np.asarray(pairs[close])


@lru_cache
def _directions(size: int) -> FloatArray:
    """Return (D, 3 at most) orthonormal directions, seeded."""
    return np.linalg.qr(np.random.default_rng(0).normal(size=(size, min(size, 3))))[0]
