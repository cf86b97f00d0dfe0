# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Intervals of time: in which joints stood, or were silent, and what several have in common."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_ros.estimation.levels import FEW
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.slices import Stamps

LOOKS_BACK = FEW  # samples in the window that the present one is compared with


def standing_intervals(
    stamps: Stamps, values: FloatArray, still: float, window_ns: int, max_gap_ns: int
) -> Stamps:
    """Return the intervals (K, 2) in which the joints of one publisher stood."""
    index = np.arange(len(stamps))
    gap = np.concatenate([[True], np.diff(stamps) > max_gap_ns])
    begin = index[gap][np.cumsum(gap) - 1]  # start of the run without gaps
    quiet = np.ones(len(stamps), dtype=bool)
    joints = values.T.copy()  # numpy is slow over a short axis
    back = begin
    for lag in range(1, LOOKS_BACK + 1):
        back = np.searchsorted(stamps, stamps - window_ns * lag // LOOKS_BACK)
        back = np.maximum(np.minimum(back, index - 1), begin)
        quiet &= np.abs(joints - np.take(joints, back, axis=1)).max(axis=0) <= still
    starts = np.flatnonzero(quiet & ~np.concatenate([[False], quiet[:-1]]) | (quiet & gap))
    ends = np.flatnonzero(quiet & ~(np.concatenate([quiet[1:], [False]])))
    ends = np.union1d(ends, np.flatnonzero(quiet & np.concatenate([gap[1:], [False]])))
    found = np.stack([stamps[back[starts]], stamps[ends]], axis=1)
    found[1:, 0] = np.maximum(found[1:, 0], found[:-1, 1])  # a twitch separates two stands
    return np.asarray(found[found[:, 0] < found[:, 1]], dtype=np.int64)


def silences(stamps: Stamps, max_gap_ns: int) -> Stamps:
    """Return the intervals (K, 2) without messages of a publisher, and a sample on either side."""
    limits = np.iinfo(np.int64)
    gaps = np.flatnonzero(np.diff(stamps) > max_gap_ns)
    begins = np.concatenate([[limits.min], stamps[gaps] - 1, stamps[-1:] - 1])
    ends = np.concatenate([stamps[:1] + 1, stamps[gaps + 1] + 1, [limits.max]])
    return np.stack([begins, ends], axis=1)


def union(several: Sequence[Stamps]) -> Stamps:
    """Return the union (K, 2) of sorted lists of intervals."""
    found = np.concatenate(several)
    found = found[np.argsort(found[:, 0], kind='stable')]
    ends = np.maximum.accumulate(found[:, 1])
    apart = found[1:, 0] >= ends[:-1]
    firsts = np.concatenate([np.ones(len(found[:1]), dtype=bool), apart])
    lasts = np.concatenate([apart, np.ones(len(found[:1]), dtype=bool)])
    return np.stack([found[firsts, 0], ends[lasts]], axis=1)


def intersection(first: Stamps, second: Stamps) -> Stamps:
    """Return the intersection (K, 2) of two sorted lists of intervals."""
    starts = np.maximum(first[:, np.newaxis, 0], second[np.newaxis, :, 0])
    ends = np.minimum(first[:, np.newaxis, 1], second[np.newaxis, :, 1])
    chosen = starts < ends
    return np.stack([starts[chosen], ends[chosen]], axis=1)
