# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a fit leaves: gross errors, or behaviour of the arm that its model lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from calib_ros.decision.drift import chance
from calib_ros.decision.steps import EXPLAINED
from calib_ros.estimation.configurations import STILL, stops
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.leastsquares import stacked
from calib_ros.estimation.levels import CERTAIN, FEW, SURE
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.robust import OUTLIER, SUSPICIOUS, Robust
from calib_ros.estimation.samples import residual_arrays
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import Flags, FloatArray
from calib_ros.settings import EXCEPTION

LEAST_STOPS = SOME_POSES // 4
"""Stops needed to compare outliers with joint values: along a path half as many double the false
alarms, from 0.7 to 1.5 %."""
ADVICE = (
    'device errors do not depend on joint values, so the arm has an effect that the model lacks. '
    'Look for effects (model auto), or fit these poses too (loss none)'
)


@dataclass(frozen=True)
class Outlier:
    """A sample with a gross error: its place, and its size in units of the usual error."""

    set: int
    sample: int
    stamp_ns: int
    size: float


def outliers_of(fitted: Fitted) -> tuple[Outlier, ...]:
    """Return the samples that a robust fit excludes."""
    if fitted.problem.loss == 'none':
        return ()
    sets = zip(fitted.problem.sets, fitted.robust.distances, strict=True)
    return tuple(
        Outlier(number, k, int(each.stamps_ns[k]), float(distances[k]))
        for number, (each, distances) in enumerate(sets)
        for k in np.flatnonzero(distances > OUTLIER).tolist()
    )


def arms_own(fitted: Fitted) -> str | None:
    """Return why outliers look like the arm's own behaviour, or None."""
    problem, robust = fitted.problem, fitted.robust
    if not robust.outliers.any() or any(each.socket for each in problem.sets):
        return None
    joints, kept = np.concatenate([each.joints for each in problem.sets]), ~robust.outliers
    whole = np.ptp(joints, axis=0)
    left = np.ptp(joints[kept], axis=0) if kept.any() else 0.0 * whole
    for name, part, all_of_it in zip(problem.chain.joint_names, left, whole, strict=True):
        if all_of_it > 10.0 * STILL and part < EXCEPTION * all_of_it:
            return f'{name} moves only in poses set aside as gross errors: {ADVICE}'
    shared, by_chance = _shared(problem, robust)
    if shared > 1 and by_chance < 1.0 - CERTAIN:
        return f'at {shared} stops all targets were set aside as gross errors: {ADVICE}'
    order = np.argsort(np.concatenate([each.stamps_ns for each in problem.sets]), kind='stable')
    joint, by_chance = _with_a_joint(problem, joints[order], robust.outliers[order])
    if by_chance < 1.0 - SURE:
        return f'the poses set aside as gross errors depend on {joint}: {ADVICE}'
    return None


def _shared(problem: Problem, robust: Robust) -> tuple[int, float]:
    """Return at how many configurations all of several targets are off, and its probability.

    To one device, an arm's own errors move all targets alike; exchanged ones are off in opposite
    directions.
    """
    count = 1 + max(int(each.max()) for each in problem.configurations)
    targets = dict.fromkeys(each.tool for each in problem.sets)
    seen, off = np.zeros((2, len(targets), count))
    away = np.zeros((len(targets), count, 3))
    one = len({each.base for each in problem.sets}) == 1
    sets = zip(problem.sets, problem.configurations, robust.distances, strict=True)
    for each, numbers, far in sets:
        row = list(targets).index(each.tool)
        seen[row] += np.bincount(numbers, minlength=count)
        off[row] += np.bincount(numbers, far > OUTLIER, count)
        if one and each.distances is None and each.pixels is None:
            errors, _ = residual_arrays(robust.fit.chain, each)
            np.add.at(away[row], numbers[far > OUTLIER], errors[far > OUTLIER])
    alike = (away.sum(axis=0) ** 2).sum(axis=1) >= (away**2).sum(axis=(0, 2))
    present, wrong = seen > 0, (off > 0.5 * seen) & alike
    several = present.sum(axis=0) > 1
    both = several & (wrong == present).all(axis=0)
    rates = wrong.sum(axis=1) / np.maximum(present.sum(axis=1), 1)
    expected = np.prod(np.where(present, rates[:, np.newaxis], 1.0), axis=0)[several].sum()
    found = int(both.sum())
    return found, float(special.gammainc(found, expected)) if found else 1.0


def _with_a_joint(problem: Problem, joints: FloatArray, outliers: Flags) -> tuple[str, float]:
    """Return the joint whose values (N, n) best explain outliers (N,), and the chance of that."""
    number = stops(joints)
    begins = np.flatnonzero(np.diff(number, prepend=-1))
    off = np.bincount(number, outliers) > 0.5 * np.bincount(number)
    names = problem.chain.joint_names
    if len(begins) < LEAST_STOPS or not FEW <= off.sum() <= len(off) - FEW:
        return '', 1.0
    turning = np.array([joint.type == 'revolute' for joint in problem.chain.joints])
    angle = joints[begins]
    waves = np.stack([np.where(turning, np.cos(angle), angle), np.sin(angle) * turning])
    waves -= waves.mean(axis=1, keepdims=True)
    spread = waves.std(axis=1, keepdims=True)
    waves = np.where(spread > STILL, waves / np.maximum(spread, STILL), 0.0)
    spectrum = np.conj(np.fft.rfft(waves, axis=1)) * np.fft.rfft(off)[:, np.newaxis]
    shifted = (np.fft.irfft(spectrum, len(off), axis=1) ** 2).sum(axis=0).T  # joint, shift
    most = int(np.argmax(shifted[:, 0]))
    variance = off.sum() * (1.0 - off.mean())  # of each wave for random outliers
    anywhere = len(names) * float(np.exp(-0.5 * shifted[most, 0] / variance))
    return names[most], max(anywhere, chance(shifted.max(axis=0)))


def lacking(fitted: Fitted) -> float:
    """Return the share of the residuals that couplings of the wrist explain, if most of it."""
    problem, chain = fitted.problem, fitted.chain
    known = [name for name, _ in chain.effects]
    added = tuple(n for n in effects.members(problem.chain, 'coupling') if n not in known)
    if not added or fitted.noise.position < SUSPICIOUS:  # nothing is left to explain
        return 0.0
    share = explained(problem, chain.with_effects([*known, *added]), fitted.names, added)
    return share if share >= EXPLAINED else 0.0


def explained(
    problem: Problem, chain: Chain, fitted: Sequence[str], added: Sequence[str]
) -> float:
    """Return the share of the residual squares that added parameters explain, linearly."""
    few = [each.spread() for each in problem.sets]
    rows = stacked(problem.system(few).rows_of(chain, (*fitted, *added)))
    count = len(fitted)
    if len(rows) - count - len(added) < len(rows) // 3:
        return 0.0
    scale = np.linalg.norm(rows, axis=0)
    scale[scale == 0.0] = 1.0
    factor = np.asarray(np.linalg.qr(rows / scale, mode='r'))
    rest = factor[count:, count:]  # beyond the fitted parameters
    left = rest[:, -1] - rest[:, :-1] @ np.linalg.lstsq(rest[:, :-1], rest[:, -1], rcond=1e-6)[0]
    total = float(rest[:, -1] @ rest[:, -1])
    return 1.0 - float(left @ left) / total if total > 0.0 else 0.0
