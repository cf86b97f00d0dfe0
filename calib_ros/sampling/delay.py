# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How late a measuring device stamps, from the motion itself.

The speed of the target by the joints and the chain, and the speed by the measurements, are the
same signal twice. Angular speed depends on no frame; linear speed is that of the flange, near
enough to that of the target for a start. The lag of the greatest correlation is refined by a
parabola; the identification then fits the rest as a parameter (`base.delay`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.identification.levels import ALIKE, MOST_OUTLIERS, TELLING
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.rows import Stamps
from calib_ros.settings import EXCEPTION, Settings

SMOOTHING = 0.5 * Settings.max_gap
"""Time over which speeds are taken [s]; short against a move, long against the noise."""
STEP = SMOOTHING / 10.0
"""Time between two values of the speeds [s]."""
LEAST_MOTION = 3.0 * Settings.lateness
"""Time in motion that is needed [s]: so that most of it is compared at every delay."""
ALIKE_ENOUGH = float(np.sqrt(1.0 - MOST_OUTLIERS))
"""Least correlation: no more of the speeds' variance may be something else than of samples."""
RISE = 0.02
"""Least rise of the correlation beyond a valley for another peak."""
MOST_TIME = 100.0 * LEAST_MOTION
"""Time [s] that is looked at, the latest: it must not grow with a gap in the stamps."""


@dataclass(frozen=True)
class Delay:
    """How much later than the joints' the stamps of measurements are, and how sure it is.

    Where the motion repeats itself, `rivals` [s] explain it nearly as well.
    """

    seconds: float
    correlation: float
    rivals: tuple[float, ...] = ()


def find_delay(
    chain: Chain,
    joint_stamps: Stamps,
    joints: FloatArray,
    stamps: Stamps,
    positions: FloatArray,
    rotations: FloatArray | None,
    max_gap: float = Settings.lateness,
) -> Delay | None:
    """Return the delay of measurements (N) against joint samples (M); None where none shows.

    It is looked for up to the lateness that measurements may have.

    Stamps are in order, joints (M, n), positions (N, 3), rotations (N, 3, 3). Between joint
    samples further apart than `max_gap` [s] nothing is known of their motion.
    """
    if len(joint_stamps) < TELLING or len(stamps) < TELLING:
        return None
    start = joint_stamps[0]
    joint_times, times = (joint_stamps - start) * 1e-9, (stamps - start) * 1e-9
    begin = max(joint_times[0], times[0] - Settings.lateness)
    end = min(joint_times[-1], times[-1] + Settings.lateness)
    if end - begin < LEAST_MOTION:
        return None
    begin = max(begin, end - MOST_TIME)
    grid = np.arange(begin, end, STEP)
    coarse = np.interp(grid, joint_times, np.arange(len(joint_times)))
    heard = np.diff(joint_times, append=np.inf)[coarse.astype(int)] <= max_gap
    if heard.sum() * STEP < LEAST_MOTION:
        return None
    nearest = np.unique(np.round(coarse).astype(int))
    if len(nearest) < TELLING:  # a gap
        return None
    poses = chain.forward(joints[nearest])
    first = _speed(joint_times[nearest], poses[:, :3, 3], poses[:, :3, :3], rotations is not None)
    by_joints = np.interp(grid, *first)
    moving = heard & (by_joints > EXCEPTION * np.percentile(by_joints, 95))
    if moving.sum() * STEP < LEAST_MOTION:
        return None
    second = _speed(times, positions, rotations, rotations is not None)
    most = round(Settings.lateness / STEP)
    lags = STEP * np.arange(-most, most + 1)
    wide = begin + STEP * np.arange(-most, len(grid) + most)
    known = int(np.sum(wide < second[0][0])), int(np.sum(wide <= second[0][-1]))
    score = _correlations(by_joints, np.interp(wide, *second), known)
    best = int(np.argmax(score))
    if score[best] < ALIKE_ENOUGH or best in (0, len(lags) - 1):
        return None
    left, middle, right = score[best - 1 : best + 2]
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return Delay(
        float(lags[best] + shift * STEP),
        float(score[best]),
        tuple(lags[_rivals(score, best)].tolist()),
    )


def _rivals(score: FloatArray, best: int) -> NDArray[np.intp]:
    """Return at which other peaks of the correlation as much of the speeds is left."""
    found = peaks(score, RISE)
    others = found[found != best]
    left, least = (np.sqrt(1.0 - np.maximum(score[k], 0.0) ** 2) for k in (others, best))
    return np.asarray(others[left < ALIKE * least])


def peaks(score: FloatArray, rise: float) -> NDArray[np.intp]:
    """Return where correlations (N,) rise by so much above the valleys towards higher ones."""
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


def _speed(
    times: FloatArray, positions: FloatArray, rotations: FloatArray | None, angular: bool
) -> tuple[FloatArray, FloatArray]:
    """Return times and speeds, over SMOOTHING or from one measurement to the next."""
    behind = np.searchsorted(times, times + SMOOTHING)
    behind = np.minimum(np.maximum(behind, np.arange(len(times)) + 1), len(times) - 1)
    first = np.flatnonzero(times[behind] > times)
    last = behind[first]
    span = times[last] - times[first]
    if angular and rotations is not None:
        turn = np.swapaxes(rotations[first], 1, 2) @ rotations[last]
        way = np.linalg.norm(se3.log_rotation(turn), axis=1)
    else:
        way = np.linalg.norm(positions[last] - positions[first], axis=1)
    return 0.5 * (times[first] + times[last]), way / span


def _correlations(first: FloatArray, second: FloatArray, known: tuple[int, int]) -> FloatArray:
    """Return the correlations of a signal (N,) with the parts (N,) of a longer one.

    Of the latter only what lies between two numbers is known; -1 stands where that is too little.
    """
    lags = np.arange(len(second) - len(first) + 1)
    begin, end = (np.clip(each - lags, 0, len(first)) for each in known)
    count = np.maximum(end - begin, 1)
    one, other = first - first.mean(), np.zeros(len(second))
    part = slice(*known)
    other[part] = second[part] - second[part].mean()

    def total(values: FloatArray, shift: NDArray[np.intp] | int = 0) -> FloatArray:
        running = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray(running[end + shift] - running[begin + shift])

    means = total(one) / count, total(other, lags) / count
    squares = (total(one**2) - count * means[0] ** 2) * (
        total(other**2, lags) - count * means[1] ** 2
    )
    products = np.correlate(other, one, 'valid') - count * means[0] * means[1]
    least = np.finfo(float).eps * (one @ one) * (other @ other)
    good = (count * STEP >= LEAST_MOTION) & (squares > least)
    return np.where(good, products / np.sqrt(np.where(good, squares, 1.0)), -1.0)
