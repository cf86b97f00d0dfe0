# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Delays in motion that are not one constant: an arm imitates them along its path.

The delay of each device is fitted. Joints that are not read at one moment have delays of their
own, and clocks that drift apart or jump one that changes, here by cosines over the session. Such a
delay d moves a joint by -d times its speed: play with the speed for the sign of the approach.
Where speeds are not known, joints measured in motion seem to be off at random.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from calib_ros.decision.result import Identification
from calib_ros.decision.rounding import rounded_joints
from calib_ros.decision.steps import EXPLAINED
from calib_ros.estimation.gain import gain_share
from calib_ros.estimation.levels import ALIKE, NEARER, TELLING
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.sizes import TYPICAL
from calib_ros.estimation.system import stacked
from calib_ros.kinematics import effects
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray, norms
from calib_ros.settings import Settings

_Modes: TypeAlias = Callable[[Observations], FloatArray]
"""Return how K delays make up those of N samples and L joints (K, N, L)."""


def uneven(problem: Problem, result: Identification) -> tuple[str, Problem] | None:
    """Return what explains most of the residuals, and the problem without it; None if nothing.

    Where true play explains more, it is that.
    """
    lags = [Parameter(name) for name in effects.members(result.chain, 'backlash')]
    if set(lags) & set(result.names):
        return None
    stamps = np.concatenate([each.stamps_ns for each in problem.sets])
    first, whole = stamps.min(), max(np.ptp(stamps), 1)

    def by_joint(each: Observations) -> FloatArray:
        return np.eye(len(lags))[:, np.newaxis].repeat(len(each), axis=1)

    def in_time(each: Observations) -> FloatArray:
        order = np.arange(1, 1 + TELLING)
        waves = np.cos(np.pi * np.outer(order, (each.stamps_ns - first) / whole))
        return waves[..., np.newaxis].repeat(len(lags), axis=2)

    by_play, _, _ = _explained(problem, result, lags, by_joint, np.sign)
    found = [(_explained(problem, result, lags, m, np.positive), m) for m in (by_joint, in_time)]
    (share, sizes, strong), modes = max(found, key=lambda each: each[0][0])
    if share < EXPLAINED or share < by_play:
        return None
    text = 'a delay that changes explains'
    remedy = 'clocks drift apart or jump: stamp with one clock'
    if modes is by_joint:
        text = 'joints late by different times explain'
        remedy = f'above all {lags[int(np.argmax(strong))].owner}: read all joints at one moment'
    text += f' {100.0 * share:.0f} % of the residuals, {remedy}, or stop at each pose (mode dwell)'
    own = [list(problem.chain.joint_names).index(name.owner) for name in lags]
    sets = []
    for each in problem.sets:
        joints = each.joints.copy()
        if each.velocity is not None:
            joints[:, own] += each.velocity[:, own] * np.einsum('k,knl->nl', sizes, modes(each))
        sets.append(replace(each, joints=joints))
    return text, problem.with_sets(sets)


def other_delay(problem: Problem, result: Identification) -> str:
    """Return that a fitted delay is too far from the one at which the joint values were taken."""
    for each in problem.sets:
        found = result.chain.frame(each.base).delay
        if each.velocity is None or each.delay is None or found is None:
            continue
        read = float(np.median(each.delay))
        if abs(found - read) > 0.5 * Settings.max_gap:
            return (
                f'joint values were read for measurements {read:.3f} s late, but these are about '
                f'{found:.3f} s late: set delay to {found:.3f}, and sample anew'
            )
    return ''


def unsteady(problem: Problem, result: Identification) -> tuple[str, bool]:
    """Return that joints seem to be off at random by more than arms are, and whether it is a lag.

    It is if some other reason refuses the result as well, or if that is more than any arm's play
    and the correction lowers the error by less than a third. Rounded values are off like that.
    """
    lacking, typical = result.posterior.unmodelled, TYPICAL['angle']
    steps = rounded_joints(problem).values()
    rounding = np.sqrt(sum(step**2 for step in steps) / 12.0 / len(problem.chain.joints))
    if not (lacking.random and lacking.turns > max(typical, ALIKE * rounding)):
        return '', False
    if result.refusals and lacking.turns > problem.largest_angle:  # something else is wrong
        return '', False
    before, after = result.comparison.figures
    slight = before.rms_mm < ALIKE * after.rms_mm and lacking.turns > typical / NEARER
    unit = ' or '.join(sorted({f'm{joint.driven.unit}' for joint in problem.chain.joints}))
    text = (
        f'joints seem off by {1e3 * lacking.turns:.2g} {unit} at random, from pose to pose: the '
        'arm moved while it was measured, joint values and poses are not of one moment, values '
        'lack digits, joints have play, or devices or targets lack names. Stop at each pose, '
        'and compare the clocks'
    )
    return text, bool(result.refusals) or slight


def _explained(
    problem: Problem,
    result: Identification,
    lags: list[Parameter],
    modes: _Modes,
    rate: Callable[[FloatArray], FloatArray],
) -> tuple[float, FloatArray, FloatArray]:
    """Return the share of the residual squares by K delays, their sizes and effects (K,)."""
    few, count = [each.spread() for each in problem.sets], len(result.names)
    few = [replace(s, approach=None if s.velocity is None else rate(s.velocity)) for s in few]
    rows = problem.system(few).rows_of(result.chain.with_effects(lags), [*result.names, *lags])
    for k, each in enumerate(few):
        added = np.einsum('knl,lcn->kcn', modes(each), rows[k][count:-1])
        rows[k] = np.concatenate([rows[k][:count], added, rows[k][-1:]])
    matrix = stacked(rows)
    delays = np.asarray(np.linalg.lstsq(matrix[:, :-1], matrix[:, -1])[0][count:])
    return gain_share(matrix, count), delays, np.abs(delays) * norms(matrix[:, count:-1].T)
