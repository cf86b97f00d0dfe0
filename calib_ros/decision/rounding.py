# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rounded joint values: does the arm explain the gain, or the rounding?

docs/model.md (Judgement) gives the reasons. An F test decides whether the arm explains more of the
nominal residuals y, frames projected out, than chance would if rounding explained them all,

    y ~ N(0, k (I + C C^T))        C: a column for each value of each joint, scaled to its error
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.gain import gain_of
from calib_ros.estimation.levels import CLEARLY, SURE, chance_of
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.system import row_samples, stacked
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import TWO_TURNS
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.values import ROUNDED, SAME

RESOLUTIONS = (
    *(1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4),
    *np.deg2rad([0.2, 0.1, 0.05, 0.02, 0.01]).tolist(),
)
"""Steps [rad or m] that values are rounded to; finer ones do no harm, wider ones are intended."""


def rounded_joints(problem: Problem) -> dict[str, float]:
    """Return the joints whose values are multiples of a step [rad or m], with the step.

    None if some are hardly rad or m: the steps are of another unit.
    """
    joints = np.concatenate([each.joints for each in problem.sets])
    if np.abs(joints).max() > TWO_TURNS:
        return {}
    pairs = zip(problem.chain.joint_names, joints.T, strict=True)
    steps = {name: resolution_of(q) for name, q in pairs}
    return {name: step for name, step in steps.items() if step > 0.0}


def resolution_in_words(step: float, unit: str) -> str:
    """Return a step of rounded values [rad or m] in the unit in which they were written."""
    degrees = round(float(np.rad2deg(step)), 3)
    written = unit == 'rad' and abs(np.deg2rad(degrees) / step - 1.0) < SAME
    return f'{degrees:g}°' if written else f'{1e3 * step:.3g} m{unit}'


def rounding_errors(problem: Problem, coarse: Mapping[str, float]) -> dict[str, float]:
    """Return the error [rad or m] of each joint's zero by rounding, by parameter.

    The RMS of the mean over all values, uniform within a step; a value shared by most poses hardly
    averages out.
    """
    joints = np.concatenate([each.joints for each in problem.sets])
    found: dict[str, float] = {}
    for joint, values in zip(problem.chain.joints, joints.T, strict=True):
        if joint.name in coarse:
            shares = np.unique(values, return_counts=True)[1] / len(values)
            size = coarse[joint.name] / np.sqrt(12.0) * np.sqrt(np.sum(shares**2))
            found[joint.driven] = float(size)
    return found


def error_by_rounding(problem: Problem) -> float:
    """Return the RMS position error [m] of the flange that rounded joint values cause."""
    joints, chain = np.concatenate([each.joints for each in problem.sets]), problem.chain
    coarse, squares = rounded_joints(problem), 0.0
    for number in np.flatnonzero([name in coarse for name in chain.joint_names]):
        step = coarse[chain.joint_names[number]] * (np.arange(joints.shape[1]) == number)
        moved = (chain.forward(joints + step) - chain.forward(joints))[:, :3, 3]
        squares += float(np.mean(np.sum(moved**2, axis=-1))) / 12.0
    return float(np.sqrt(squares))


def resolution_of(values: FloatArray) -> float:
    """Return the step [rad or m] of which values (N,) are multiples; 0 for none."""
    few = values[:3, np.newaxis] / RESOLUTIONS
    likely = np.compress(np.abs(few - np.round(few)).max(axis=0) < ROUNDED, RESOLUTIONS).tolist()
    for step in sorted(likely, reverse=True):
        if _are_multiples(values, step):
            wider = _are_multiples(values, CLEARLY * step)
            return 0.0 if wider or len(np.unique(values)) < 3 else step
    return 0.0


def _are_multiples(values: FloatArray, step: float) -> bool:
    return bool(np.abs(values / step - np.round(values / step)).max() < ROUNDED)


def may_be_rounding(fitted: Fitted, before: Chain, steps: Mapping[str, float]) -> bool:
    """Tell whether rounding of joint values explains the nominal residuals as well.

    `before` is the nominal chain with fitted frames, `steps` belong to rounded joints.
    """
    problem, names = fitted.problem, fitted.names
    sets = fitted.good_sets()
    joints = np.concatenate([each.joints for each in sets])
    levels = {}
    for number, joint in enumerate(problem.chain.joints):
        value, level = np.unique(joints[:, number], return_inverse=True)
        if joint.name in steps and 2 * len(value) <= len(joints):
            levels[joint.driven] = level
    arm = [name for name in names if not before.owns_frame(name)]
    if not (levels and arm):
        return False
    frames = [name for name in names if before.owns_frame(name)]
    chain = before.with_effects([name for name in arm if name in dict(problem.model.effects)])
    wanted = list(dict.fromkeys([*frames, *arm, *levels]))
    parts = problem.system(sets).rows_of(chain, wanted)
    owner, rows = row_samples(parts), stacked(parts)
    columns = [rows[:, : len(frames)]]
    for name, level in levels.items():
        size = steps[Parameter(name).owner] / np.sqrt(12.0)
        column = size * rows[:, [wanted.index(name)]]
        columns.append(column * (level[owner, np.newaxis] == np.unique(level)))
    beside = np.column_stack(columns)
    every = np.column_stack([beside, rows[:, len(frames) : len(frames) + len(arm)], rows[:, -1]])
    prior, count = np.zeros(every.shape[1]), beside.shape[1]
    prior[len(frames) : count] = 1.0
    gain, rank, left = gain_of(every.T @ every + np.diag(prior), count)
    freedom = max(len(rows) - len(frames) - rank, 1)
    noise = max(left - gain, 1e-300) / freedom
    return chance_of(gain / noise, rank, freedom) > 1.0 - SURE
