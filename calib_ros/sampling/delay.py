# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimation of the delay of a device's stamps from the motion itself.

The speed of the target by joints and chain and the speed by the measurements are the same signal.
Angular speed depends on no frame; linear speed is that of the flange, close enough to the target's
for a start. Then the velocity of the target, in the axes of the device, is a sum of those of the
flange and of the axes there: of the lags that speeds do not tell apart, that with the least rest
of this linear fit. The best lag is refined by a parabola; in motion the identification then fits
the rest as a parameter (`base.delay`).
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
    by_joints = np.interp(grid, *_speed(joint_times[nearest], poses[:, :3, 3], turns))
    moving = known_motion & (by_joints > EXCEPTION * np.percentile(by_joints, 95))
    if moving.sum() * STEP < LEAST_MOTION:
        return None
    second = _speed(times, positions, rotations)
    most = round(farthest / STEP)
    lags = STEP * np.arange(-most, most + 1)
    wide = begin + STEP * np.arange(-most, len(grid) + most)
    known = int(np.sum(wide < second[0][0])), int(np.sum(wide <= second[0][-1]))
    score = _correlations(by_joints, np.interp(wide, *second), known)
    best = int(np.argmax(score))
    if score[best] < ALIKE_ENOUGH or best in (0, len(lags) - 1):
        return None
    if rotations is None:
        flange = _rates(joint_times[nearest], poses[:, :3].reshape(-1, 12))
        score = _fitted(score, grid[known_motion], flange, _rates(times, positions))
        best = int(np.argmax(score))
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


def _fitted(score: FloatArray, grid: FloatArray, flange: Rates, target: Rates) -> FloatArray:
    """Return the correlations (L,) of a target's velocities and those fitted to them by lag.

    By the rates (N, 12) of position and axes of the flange at known times (T,). Lags whose speeds
    are less alike, of the `score` (L,), count for nothing.
    """
    times, seen = target
    found = np.flatnonzero(_alike(score))
    lags = STEP * (found - len(score) // 2)
    inner = grid[(grid + lags[0] >= times[0]) & (grid + lags[-1] <= times[-1])]
    if len(inner) * STEP < LEAST_MOTION:
        return score
    inner = inner[:: int(len(inner) * STEP / LEAST_MOTION)]
    columns = np.array([np.interp(inner, flange[0], each) for each in flange[1].T]).T
    basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    basis = basis[:, sizes > DEGENERATE * sizes[0]]
    at = inner[:, np.newaxis] + lags
    moved = np.array([np.interp(at, times, each) for each in seen.T])
    whole = (moved**2).sum(axis=(0, 1))
    kept = (np.einsum('nk,cnl->kcl', basis, moved, optimize=True) ** 2).sum(axis=(0, 1))
    fitted = np.full_like(score, -1.0)
    fitted[found] = np.sqrt(kept / np.maximum(whole, 1e-300))
    return fitted


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


def _speed(times: FloatArray, positions: FloatArray, rotations: FloatArray | None) -> Rates:
    """Return times and speeds over SMOOTHING, angular if rotations (N, 3, 3) are given."""
    if rotations is None:
        middle, rates = _rates(times, positions)
        return middle, np.linalg.norm(rates, axis=1)
    first, last = _steps(times)
    turn = np.swapaxes(rotations[first], 1, 2) @ rotations[last]
    way = np.linalg.norm(se3.log_rotation(turn), axis=1)
    return 0.5 * (times[first] + times[last]), way / (times[last] - times[first])


def _rates(times: FloatArray, values: FloatArray) -> Rates:
    """Return times and the rates (M, c) of values (N, c) over SMOOTHING."""
    first, last = _steps(times)
    rates = (values[last] - values[first]) / (times[last] - times[first])[:, np.newaxis]
    return 0.5 * (times[first] + times[last]), rates


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
