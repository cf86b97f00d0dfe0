# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Where several sets of observations were: their frames, configurations, stations and sides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from calib_ros.estimation.configurations import SCATTER, STILL, configurations, stops
from calib_ros.estimation.levels import NEARER, TELLING
from calib_ros.estimation.observations import Observations
from calib_ros.kinematics.se3 import FloatArray, Index

S = TypeVar('S', bound=np.generic)


def frames_of_sets(sets: Sequence[Observations], base: bool, tool: bool) -> tuple[str, ...]:
    """Return the frames of all devices of sets, if wanted, and of all targets."""
    ends = ('base',) * base + ('tool',) * tool
    return tuple(dict.fromkeys(getattr(each, end) for end in ends for each in sets))


def numbered(sets: Sequence[Observations]) -> tuple[Index, ...]:
    """Return the configuration numbers (N,) of each set, counted over all sets."""
    if len(sets) == 1:
        return (sets[0].configurations,)
    numbers = configurations(np.concatenate([each.joints for each in sets]))
    return by_set(numbers, sets)


def as_measured(sets: Sequence[Observations]) -> Index:
    """Return the configuration numbers (N,) of all pairs in the order of measurement."""
    numbers, (_, order) = np.concatenate(numbered(sets)), _in_order(sets)
    _, first, own = np.unique(numbers[order], return_index=True, return_inverse=True)
    numbers[order] = np.argsort(np.argsort(first))[own]
    return numbers


def sided(sets: Sequence[Observations]) -> tuple[Observations, ...]:
    """Return sets with signs of the last moves, as if straight from stop to stop if unknown.

    Joints come to their largest values from below: play so depends on them even in random order.
    """
    joints, order = _in_order(sets)
    signs = np.empty_like(joints)
    signs[order] = approaches(joints[order], STILL)
    return tuple(
        each if each.approach is not None and each.approach.any() else each.changed(approach=own)
        for each, own in zip(sets, by_set(signs, sets), strict=True)
    )


def approaches(joints: FloatArray, least: float = 0.0) -> FloatArray:
    """Return the sign (N, n) of the last move beyond `least` [rad or m], 0 before the first."""
    moves = np.diff(joints, axis=0, prepend=joints[:1])
    last = np.where(np.abs(moves) > least, np.arange(len(moves))[:, np.newaxis], 0)
    return np.sign(np.take_along_axis(moves, np.maximum.accumulate(last), axis=0))


def stations(sets: Sequence[Observations]) -> tuple[Index, ...]:
    """Return at which of few stations each pair (N,) of each set is, counted over all sets.

    Half of the joints or more, which seldom move from stop to stop, stand still at a station.
    Without stations, or at many, these are the configurations.
    """
    joints, order = _in_order(sets)
    begins = np.flatnonzero(np.diff(stops(joints[order]), prepend=-1))
    moves = np.abs(np.diff(joints[order[begins]], axis=0)) > STILL
    times, moving = moves.sum(axis=0), np.count_nonzero(moves.any(axis=0))
    seldom = joints[:, (times > 0) & (times < NEARER * len(moves))]
    numbers = np.full(len(joints), TELLING)  # not yet at any
    for k in range(TELLING if moving <= 2 * seldom.shape[1] < 2 * moving else 0):
        first = seldom[(numbers == TELLING).argmax()]
        near = np.abs(seldom - first).max(axis=1) <= SCATTER
        numbers[near] = np.minimum(numbers[near], k)
    if TELLING in numbers or not numbers.any():
        return numbered(sets)
    return by_set(numbers, sets)


def _in_order(sets: Sequence[Observations]) -> tuple[FloatArray, Index]:
    """Return all joint values (N, n), and their order by stamps (N,).

    The arm is at one place at a time: if stamps say otherwise, sets come one after another.
    """
    joints = np.concatenate([each.joints for each in sets])
    stamps = np.concatenate([each.stamps_ns for each in sets])
    order = np.argsort(stamps, kind='stable')
    elsewhere = np.abs(np.diff(joints[order], axis=0)).max(axis=1) > STILL
    if (elsewhere & (np.diff(stamps[order]) == 0)).any():
        order = np.lexsort((stamps, np.repeat(np.arange(len(sets)), [*map(len, sets)])))
    return joints, order


def by_set(values: NDArray[S], sets: Sequence[Observations]) -> tuple[NDArray[S], ...]:
    """Return the values (N,) of all pairs, set by set."""
    return tuple(np.split(values, np.cumsum([len(each) for each in sets])[:-1]))
