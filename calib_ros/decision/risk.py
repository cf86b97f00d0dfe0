# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Where a calibration may be used: where it improves the arm, also away from its poses.

By the posterior of the arm (`evidence.py`) its true offsets from nominal are x ~ N(m, C); those of
the calibration are x^. At poses with the Jacobian A, base and tool frames projected out, it makes
the arm worse if

    |A (x^ - x)|^2 > |A x|^2    <=>    (A x^)^T (A x) < |A x^|^2 / 2

Waves of its axes are among x, and x^ has none. The probability of that is the *risk*;
docs/model.md (Region) describes the poses it is computed for.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from scipy import special

from calib_ros.decision.region import Region
from calib_ros.estimation.gain import inverse_root
from calib_ros.estimation.joint_errors import axis_parameters, turns_and_tilts, wobble_columns
from calib_ros.estimation.levels import ALIKE, KNOWN
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.estimation.posterior import MixtureTerm, Posterior
from calib_ros.estimation.samples import gram
from calib_ros.kinematics.effects import PLAY
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter, parameters_of
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray

RISK = 0.02
"""Largest probability that the arm gets worse over the poses of a shell (benchmarks/harm.py)."""
SHELL = SOME_POSES // 20  # random configurations per shell


def region_of(
    posterior: Posterior,
    sets: Sequence[Observations],
    freedom: float,
    largest: float,
    incomplete: bool = False,
) -> Region | None:
    """Return where a calibration may be used; None if not even at the measured poses.

    `freedom` are the degrees of freedom of the noise estimate; away from the measured poses the
    expected error is `largest` [m] at most. If the model is `incomplete`, it is not clearly larger
    there than the correction at the measured poses either (benchmarks/real_robots.py).
    """
    ends = sets[0].base, sets[0].tool
    measured = np.concatenate([each.spread(SOME_POSES // 2).joints for each in sets])
    drawn = posterior.chain.random_joints(SOME_POSES, np.random.default_rng(0))
    judge = _Judge(posterior, *ends, freedom)
    joints = np.concatenate([drawn, measured])
    rows = judge.rows(joints)
    sizes = np.sqrt(np.maximum(judge.expected(rows), 0.0))  # of the expected errors
    sizes *= 1.0 + HALF_THE_DIGITS  # as rounded, also in the record
    far, limit = sizes[:SOME_POSES], float(sizes[SOME_POSES:].max())
    order = np.argsort(far)
    own, inside = judge.products(rows[..., SOME_POSES:]), far[order] <= limit
    inner = own + judge.products(rows[..., order[inside]])
    mixture = judge.of_the_arm(posterior.mixture)
    if not max(judge.risk(own, own, mixture), judge.risk(inner, inner, mixture)) < RISK:
        return None
    if incomplete:
        largest = min(largest, ALIKE * judge.correction(own) / np.sqrt(len(measured)))
    first, last = (int(np.sum(far <= most)) for most in (limit, max(limit, largest)))
    for begin in range(first, last, SHELL):
        end = min(begin + SHELL, last)
        added = shell = judge.products(rows[..., order[begin:end]])
        if end - begin < SHELL:  # a few poses tell little: with the next within
            shell = judge.products(rows[..., order[max(end - SHELL, 0) : end]])
        if not judge.risk(shell, inner + added, mixture) < RISK:
            break
        inner, limit = inner + added, float(far[order[end - 1]])
    by_scale = 0.0
    if posterior.rival is not None:
        odds, mean, covariance = posterior.rival
        out = float(special.expit(odds))
        mixture = judge.of_the_arm([(1.0, mean, covariance)])
        by_scale = out * max(judge.risk(own, own, mixture), judge.risk(inner, inner, mixture))
    share = float(np.mean(far <= limit))
    if share == 1.0 and not any(joint.guessed for joint in posterior.chain.joints):
        limit = np.inf
    arm = posterior.chain, posterior.names, posterior.square, posterior.device
    return Region(*arm, limit, share, *ends, by_scale)


_Mixture: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""Weights (S,), means (S, A) and covariances (S, A, A) of the arm's A offsets."""


class _Judge:
    """Probability that a calibration makes the arm worse at some poses."""

    def __init__(self, posterior: Posterior, base: str, tool: str, freedom: float) -> None:
        chain, names = posterior.chain, posterior.names
        arm = [k for k, name in enumerate(names) if not chain.owns_frame(name)]
        frames = [*parameters_of(base), *parameters_of(tool)[:3]]
        self._placed, self._freedom = len(frames), freedom
        every = list(dict.fromkeys([*names, *frames, *axis_parameters(chain)]))
        self._model, self._waves = ErrorModel(chain, every, base, tool), posterior.unmodelled.waves
        waves = range(len(posterior.mixture[0][1]) - len(names))
        self._arm = [*arm, *(len(names) + k for k in waves)]
        self._own = [*map(every.index, frames), *arm, *(len(every) + k for k in waves)]
        self._offsets = np.append(posterior.offsets[arm], np.zeros(len(waves)))
        self._square, driven = posterior.square, {j.name: j.driven for j in chain.joints}
        self._play = [k for k, name in enumerate(names) if Parameter(name).kind in PLAY]
        self._sided = [every.index(driven[Parameter(names[k]).owner]) for k in self._play]

    def rows(self, joints: FloatArray) -> FloatArray:
        """Return the columns (K, 3, N) of the posterior's names, of others, and of waves."""
        rows = self._model.jacobian(joints)[:, :3].transpose(2, 1, 0)
        _, tilts = turns_and_tilts(self._model.chain, self._model.names, rows)
        return np.concatenate([rows, self._waves * wobble_columns(tilts, joints)])

    def expected(self, rows: FloatArray) -> FloatArray:
        """Return the expected squares (N,) of position errors by `rows`, play from either side."""
        own, play = rows[: len(self._square)], np.diag(self._square)[self._play]
        along = np.tensordot(self._square, own, 1)
        squares = np.einsum('pcn,pcn->n', along, own)
        return np.asarray(squares + play @ (rows[self._sided] ** 2).sum(axis=1))

    def products(self, rows: FloatArray) -> FloatArray:
        """Return products (K, K) of the columns of frames, then of the arm, from all rows."""
        return gram(rows[self._own])

    def of_the_arm(self, mixture: Sequence[MixtureTerm]) -> _Mixture:
        """Return plausible offsets and waves, as in `Posterior.mixture`, for the arm only."""
        weights, means, covariances = zip(*mixture, strict=True)
        arm = np.ix_(self._arm, self._arm)
        own = np.array([each[arm] for each in covariances])
        return np.array(weights), np.array(means)[:, self._arm], own

    def correction(self, which: FloatArray) -> float:
        """Return the root of the sum of squares [m] of the correction at some poses."""
        return float(np.sqrt(np.maximum(self._slope(which, which) @ self._offsets, 0.0)))

    def risk(self, which: FloatArray, around: FloatArray, mixture: _Mixture) -> float:
        """Return the risk at some poses, in frames fitted to poses around; by their products."""
        slope = self._slope(which, around)
        gain = float(slope @ self._offsets)
        weights, means, covariances = mixture
        margins = means @ slope - 0.5 * gain
        along = covariances.reshape(means.size, len(slope)) @ slope
        spreads = np.sqrt(np.maximum(along.reshape(means.shape) @ slope, 0.0))
        with np.errstate(divide='ignore', invalid='ignore'):
            risks = special.stdtr(min(self._freedom, KNOWN), -margins / spreads)
        return float(weights @ np.where(spreads > 0.0, risks, margins <= 0.0))

    def _slope(self, which: FloatArray, around: FloatArray) -> FloatArray:
        """Return the products (A,) of the correction at some poses with the arm's columns."""
        frames, arm = np.s_[: self._placed], np.s_[self._placed :]
        root = inverse_root(around[frames, frames], np.diag(around)[frames])
        placed = -root @ (root.T @ (around[frames, arm] @ self._offsets))
        pushed = which @ np.append(placed, self._offsets)
        return np.asarray(pushed[arm] - around[arm, frames] @ (root @ (root.T @ pushed[frames])))
