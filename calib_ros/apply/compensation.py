# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The correction of a program: joint commands that reach the intended pose.

A controller assumes the nominal arm N, the real one is the calibrated arm C. A command q means the
pose N(q) of the flange in the arm's base frame; it is replaced by the nearest q' with

    C(q') = N(q)

Base and tool frames of the measurement (tracker, reflector) cancel if equal: T_base C(q') T_tool =
T_base N(q) T_tool. docs/compensation.md explains what a calibration leaves open, where the base
stands and the tool sits. Samples that cannot be corrected within the limits are refused with the
reason.
"""

from __future__ import annotations

import numpy as np

from calib_ros.annotated import as_annotated
from calib_ros.apply.compensator import Compensation, Compensator
from calib_ros.apply.refused import add_refusals, outside, too_fast, unreached
from calib_ros.errors import InputError
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.progress import Notify, quiet
from calib_ros.settings import LEVER
from calib_ros.shown import rounded

BESIDE = LEVER / 3.0
"""Distance [m] from the tool at which the effect of a turn is reported: a small tool's length."""


@as_annotated
def compensate(
    compensator: Compensator,
    joints: FloatArray,
    approach: FloatArray | None = None,
    progress: Notify = quiet,
) -> Compensation:
    """Correct joint commands (N, n) [rad or m], given in their order of execution.

    `approach` (N, n) holds the signs of the preceding velocities, for backlash; `progress`
    receives the share done.

    Raises InputError for joint values of the wrong shape, or not finite.
    """
    command = compensator.nominal.joint_values(joints).copy()
    if not len(command):
        raise InputError('there are no joint values to correct')
    if approach is not None and np.shape(approach) != command.shape:
        raise InputError(f'approach must have the shape {command.shape} of the joint values')
    follower = compensator.follower
    solution = follower.solve(command, approach, progress=progress)
    joints = np.clip(command + solution.change, follower.lower, follower.upper)  # rounding
    result = Compensation(**vars(solution), command=command, joints=joints, approach=approach)
    result = add_refusals(result, outside(compensator, result))
    result = add_refusals(result, unreached(compensator, result))
    moves, changes = (
        np.abs(np.diff(each, axis=0)) for each in (result.command, result.correction)
    )  # NaN beside refused samples
    words = 'jumps by {:.4g} while the joints move by {:.4g} at most'
    return add_refusals(result, too_fast(compensator, changes, moves, words, first=1))


def in_words(compensator: Compensator, result: Compensation) -> str:
    """Return the largest correction and the errors before and after, in a line."""
    kept = np.asarray(~np.isnan(result.joints).any(axis=1))
    text = f'{np.count_nonzero(kept)} of {len(kept)} points corrected'
    if not kept.any():
        return text
    size = np.abs(result.correction[kept]).max(axis=0)
    for kind, unit in (('revolute', 'mrad'), ('prismatic', 'mm')):
        columns = [k for k, joint in enumerate(compensator.nominal.joints) if joint.type == kind]
        if columns:
            worst = max(columns, key=lambda k: float(size[k]))
            name = compensator.nominal.joint_names[worst]
            text += f', by {rounded(1e3 * size[worst])} {unit} at most ({name})'
    turn, turned = result.orientation[kept].max(), result.orientation_before[kept].max()
    shift, shifted = result.position[kept].max(), result.position_before[kept].max()
    shifts, turns = (
        f'{rounded(1e3 * before)} -> {rounded(1e3 * after)}'
        for before, after in ((shifted, shift), (turned, turn))
    )
    text += f'; largest predicted error {shifts} mm, {turns} mrad'
    if not compensator.follower.complete and turn > turned:
        x, y, z = compensator.tool
        text += (
            '; this arm cannot keep every orientation: the position is corrected at the '
            f'point {x:g} {y:g} {z:g} m in the flange (--tool); {BESIDE:g} m away it may be '
            f'{rounded(1e3 * BESIDE * turn)} mm off, {rounded(1e3 * BESIDE * turned)} mm before'
        )
    if not compensator.follower.anywhere:
        squares = result.position[kept] ** 2 - result.reachable[kept] ** 2
        across = np.sqrt(max(float(squares.max()), 0.0))  # less than zero is rounding
        text += (
            '; this arm cannot move its target in every direction: '
            f'{rounded(1e3 * across)} mm are left that no joint can correct'
        )
    if result.damped[kept].any():
        text += f'; {np.count_nonzero(result.damped[kept])} corrected in part'
    return text


def knowledge(arm: Calibration, result: Compensation) -> tuple[str, str]:
    """Return how well a calibration knows a corrected program's poses, and a warning.

    Both texts are empty if there is nothing to say.
    """
    if arm.covariance is None:
        return '', ''
    parts = np.s_[:3], np.s_[3:]
    shift, turn = (arm.sigma(result.joints, part, result.approach) for part in parts)
    words = (
        f'standard deviation of these poses: at most {rounded(1e3 * shift.max())} mm at the '
        f'target measured and {rounded(1e3 * turn.max())} mrad'
    )
    if np.sum(turn**2) <= np.sum(result.orientation_before**2):
        return words, ''
    return words, (
        'the calibration does not know the orientation well enough to correct it; positions '
        'hold only near the measured target. Measure orientations too, or a target further '
        'from the last axis'
    )
