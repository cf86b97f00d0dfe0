# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimation of the delay of a device's stamps from the motion itself.

The speed of the target by joints and chain and the speed by the measurements are the same signal.
Angular speed depends on no frame; linear speed is that of the flange, close enough to the target's
for a start. The velocity of the target, in the axes of the device, is a sum of those of the flange
and of the axes there: the delay leaves the least rest of this linear fit, of the lags at which
each half of the motion tells the other, or, if none do, of those that speeds do not tell apart.
The best lag is refined by a parabola; in motion the identification then fits the rest as a
parameter (`base.delay`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from calib_ros.estimation.identifiability import DEGENERATE
from calib_ros.estimation.levels import ALIKE, MOST_OUTLIERS, TELLING
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.sampling.slices import Stamps
from calib_ros.settings import EXCEPTION, Settings

SMOOTHING = 0.5 * Settings.max_gap
"""Time over which speeds are computed [s]; short compared with moves, long with the noise."""
STEP = SMOOTHING / 10.0  # sampling time of the speeds [s]
LEAST_MOTION = 3.0 * Settings.lateness
"""Motion needed [s], so that most of it is compared at every delay."""
ALIKE_ENOUGH = float(np.sqrt(1.0 - MOST_OUTLIERS))
"""Least correlation: the share of unexplained variance is that of outliers."""
RISE = EXCEPTION * (1.0 - ALIKE_ENOUGH)
"""Least rise of a correlation peak above a valley: a tenth of what it may lack."""
MOST_TIME = 100.0 * LEAST_MOTION
"""Longest motion evaluated [s], the latest: it must not grow with gaps in the stamps."""

Rates: TypeAlias = tuple[FloatArray, FloatArray]


@dataclass(frozen=True)
class Delay:
    """Delay of measurement stamps after joint stamps, and its certainty."""

    seconds: float
    correlation: float
    rivals: tuple[float, ...] = ()  # [s] explain repetitive motion nearly as well
    within: float = 0.0
    """Longest time [s] to a delay that, as all in between, explains the motion nearly as well."""


def find_delay(
    chain: Chain,
    joint_stamps: Stamps,
    joints: FloatArray,
    stamps: Stamps,
    positions: FloatArray,
    rotations: FloatArray | None,
    max_gap: float = Settings.lateness,
) -> Delay | None:
    """Return the delay of measurements (N) to joint samples (M), None if unclear or too long.

    Stamps are in order, joints (M, n), positions (N, 3), rotations (N, 3, 3). Between joint
    samples further apart than `max_gap` [s] their motion is unknown.
    """
    if len(joint_stamps) < TELLING or len(stamps) < TELLING:
        return None
    start = joint_stamps[0]
    joint_times, times = (joint_stamps - start) * 1e-9, (stamps - start) * 1e-9
    farthest = Settings.lateness + Settings.max_gap  # beyond it, stamps show a moved clock
    begin = max(joint_times[0], times[0] - farthest)
    end = min(joint_times[-1], times[-1] + farthest)
    begin = max(begin, end - MOST_TIME)
    grid = np.arange(begin, end, STEP)
    coarse = np.interp(grid, joint_times, np.arange(len(joint_times)))
    known_motion = np.diff(joint_times, append=np.inf)[coarse.astype(int)] <= max_gap
    nearest = np.unique(np.round(coarse).astype(int))
    if len(nearest) < TELLING:  # a gap
        return None
    poses = chain.forward(joints[nearest])
    turns = None if rotations is None else poses[:, :3, :3]
    flange = _rates(joint_times[nearest], poses[:, :3].reshape(-1, 12))
    middle, rates = _rates(joint_times[nearest], poses[:, :3, 3], turns)
    by_joints = np.interp(grid, middle, se3.norms(rates))
    moving = known_motion & (by_joints > EXCEPTION * np.percentile(by_joints, 95))
    if moving.sum() * STEP < LEAST_MOTION:
        return None
    middle, rates = _rates(times, positions, rotations)
    possible = se3.norms(rates) <= ALIKE * se3.norms(flange[1]).max()  # others were lost
    if possible.mean() > 1.0 - MOST_OUTLIERS:  # else they are of other units
        middle, rates = middle[possible], rates[possible]
    most = round(farthest / STEP)
    lags = STEP * np.arange(-most, most + 1)
    wide = begin + STEP * np.arange(-most, len(grid) + most)
    known = int(np.sum(wide < middle[0])), int(np.sum(wide <= middle[-1]))
    score = _correlations(by_joints, np.interp(wide, middle, se3.norms(rates)), known)
    if rotations is None:
        places = np.flatnonzero(known_motion)
        score = _fitted(score, places, _resampled(grid, *flange), _resampled(wide, middle, rates))
    best = int(np.argmax(score))
    if score[best] < ALIKE_ENOUGH or best in (0, len(lags) - 1):
        return None
    alike = _alike(score)
    left, middle, right = np.pad(score, 1)[best : best + 3]
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    others = peaks(score, RISE)
    rivals = lags[others[(others != best) & alike[others]]].tolist()
    reach = max(int(np.argmin(np.append(a, False))) for a in (alike[best::-1], alike[best:]))
    seconds = float(lags[best] + shift * STEP)
    return Delay(seconds, float(score[best]), tuple(rivals), STEP * reach)


def _alike(score: FloatArray) -> Flags:
    """Return which correlations (N,) leave nearly as little as the best."""
    apart = np.sqrt(1.0 - np.clip(score, 0.0, 1.0) ** 2)
    return np.asarray(apart <= ALIKE * apart.min())


def _fitted(
    score: FloatArray, places: Index, flange: FloatArray, target: FloatArray
) -> FloatArray:
    """Return the correlations (L,) of a target's velocities and those fitted to them by lag.

    By the rates (N, 12) of position and axes of the flange, known at some places; those of the
    target (N + L - 1, 3) are NaN where unknown. Lags where neither halves of the motion tell each
    other nor speeds are alike, of the `score` (L,), count for nothing.
    """

    def by_lag(lags: Index, parts: int) -> FloatArray:
        found = np.full_like(score, -1.0)
        ends = flange[places], target[places + lags[0]], target[places + lags[-1]]
        inner = places[~np.isnan(sum(each[:, 0] for each in ends))]
        if len(inner) * STEP < LEAST_MOTION:
            return found
        inner = inner[:: int(len(inner) * STEP / LEAST_MOTION)]
        basis = np.linalg.svd(flange[inner], full_matrices=False)[0]
        moved = target[inner[:, np.newaxis] + lags].reshape(len(inner), -1)
        rest, unit = np.zeros(moved.shape[1]), np.eye(basis.shape[1])
        pieces = np.array_split(np.arange(len(inner)), parts)
        for judged, given in zip(pieces, pieces[::-1], strict=True):
            matrix = basis[given].T @ basis[given] + DEGENERATE * unit
            weights = np.linalg.solve(matrix, basis[given].T @ moved[given])
            rest += ((moved[judged] - basis[judged] @ weights) ** 2).sum(axis=0)
        whole = np.maximum((moved**2).sum(axis=0).reshape(-1, 3).sum(axis=1), 1e-300)
        found[lags] = np.sqrt(np.maximum(1.0 - rest.reshape(-1, 3).sum(axis=1) / whole, 0.0))
        return found

    halves = by_lag(np.arange(len(score)), 2)
    alike = _alike(halves)
    if halves.max() ** 2 < 1.0 - EXCEPTION or alike[0] or alike[-1]:
        if score.max() < ALIKE_ENOUGH or score.argmax() in (0, len(score) - 1):
            return score
        alike = _alike(score)
    found = by_lag(np.flatnonzero(alike), 1)
    return found if found.max() > 0.0 else score


def peaks(score: FloatArray, rise: float) -> Index:
    """Return peaks of correlations (N,) that rise this much above the valleys to higher ones.

    As scipy.signal.find_peaks, which takes 0.4 s and 35 MB to load.
    """
    padded = np.pad(score, 1, constant_values=-1.0)
    found = []
    tops = (padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:])
    for k in (np.flatnonzero(tops) + 1).tolist():
        higher = np.flatnonzero(padded > padded[k])
        begin = int(max(higher[higher < k], default=0))
        end = int(min(higher[higher > k], default=len(score) + 1))
        valley = max(padded[begin:k].min(), padded[k + 1 : end + 1].min())
        if padded[k] - valley >= rise:
            found.append(k - 1)
    return np.array(found, dtype=np.intp)


def _resampled(grid: FloatArray, times: FloatArray, values: FloatArray) -> FloatArray:
    """Return values (M, c) at other times (N,), NaN outside."""
    return np.array([np.interp(grid, times, each, np.nan, np.nan) for each in values.T]).T


def _rates(times: FloatArray, values: FloatArray, rotations: FloatArray | None = None) -> Rates:
    """Return times and the rates (M, c) of values (N, c) over SMOOTHING, or angular velocities."""
    first, last = _steps(times)
    moved = values[last] - values[first]
    if rotations is not None:
        moved = se3.log_rotation(np.swapaxes(rotations[first], 1, 2) @ rotations[last])
    return 0.5 * (times[first] + times[last]), moved / (times[last] - times[first])[:, np.newaxis]


def _steps(times: FloatArray) -> tuple[Index, Index]:
    """Return first and last of pairs of times (N,) about SMOOTHING apart."""
    behind = np.searchsorted(times, times + SMOOTHING)
    behind = np.minimum(np.maximum(behind, np.arange(len(times)) + 1), len(times) - 1)
    first = np.flatnonzero(times[behind] > times)
    return first, behind[first]


def _correlations(first: FloatArray, second: FloatArray, known: tuple[int, int]) -> FloatArray:
    """Return the correlations of a signal (N,) with the windows (N,) of a longer one.

    The latter is known between two indices; -1 if the overlap is too short.
    """
    lags = np.arange(len(second) - len(first) + 1)
    begin, end = (np.clip(each - lags, 0, len(first)) for each in known)
    count = np.maximum(end - begin, 1)
    one, other = first - first.mean(), np.zeros(len(second))
    part = slice(*known)
    other[part] = second[part] - second[part].mean()

    def total(values: FloatArray, shift: Index | int = 0) -> FloatArray:
        running = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray(running[end + shift] - running[begin + shift])

    means = total(one) / count, total(other, lags) / count
    squares = total(one**2) - count * means[0] ** 2
    squares *= total(other**2, lags) - count * means[1] ** 2
    products = np.correlate(other, one, 'valid') - count * means[0] * means[1]
    least = np.finfo(float).eps * (one @ one) * (other @ other)
    good = (count * STEP >= LEAST_MOTION) & (squares > least)
    return np.where(good, products / np.sqrt(np.where(good, squares, 1.0)), -1.0)
