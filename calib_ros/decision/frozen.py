# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements or joint values that repeat while the rest moves: their source stood still."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_ros.decision.residuals import residuals
from calib_ros.decision.trials import fault_limit, sample_errors
from calib_ros.decision.undoing import Suspect
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.levels import LEAST_ASIDE, NEARER
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.start import flange
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.se3 import ROUNDING, Flags, FloatArray, norms
from calib_ros.settings import EXCEPTION
from calib_ros.shown import rows_in_words


def repeating(
    chain: Chain, seen: Observations, far: Flags, largest: float, of_messages: bool
) -> tuple[Suspect, list[int]] | None:
    """Return rows that repeat the measurement, or the joint values, of a row before them.

    They are `far` (N,) from the chain, and the others moved by more than `largest` [m] since then;
    so do most that repeat, or some of the poses measured again and again have gross errors.
    """
    if seen.socket:
        return None
    poses = np.column_stack([seen.given, seen.rotations.reshape(-1, 9)])
    for what, values, others in (
        ('the measurement is', poses, flange(chain, seen)[:, :3, 3]),
        ('the joint values are', seen.joints, seen.given),
    ):
        again = np.append(False, (np.diff(values, axis=0) == 0.0).all(axis=1))
        fresh = np.maximum.accumulate(np.where(again, 0, np.arange(len(seen))))
        moved = norms(others - others[fresh]) > largest
        rows = np.flatnonzero(again & moved & far).tolist()
        if len(rows) >= max(LEAST_ASIDE, 0.5 * np.count_nonzero(again)):
            stale = Suspect(
                f'{what} repeated in {rows_in_words(rows, seen.stamps_ns, of_messages)} while the '
                'rest moved',
                'leave these rows out, and see why its source stood still',
                rank=0,
                published='see why its publisher repeats old values',
            )
            return stale, rows
    return None


def frozen_sources(fitted: Fitted) -> tuple[tuple[str, ...], list[Observations]]:
    """Return what repeats in gross errors while the rest moved: a measurement, or joint values.

    The sets follow, with what explains these errors: what else moved shows in them.
    """
    problem, told, sets = fitted.problem, list[str](), list(fitted.problem.sets)
    for number, (each, good) in enumerate(zip(sets, fitted.robust.inliers, strict=True)):
        of_poses = not each.socket and each.distances is None and each.pixels is None
        if not of_poses or np.count_nonzero(~good) < LEAST_ASIDE:
            continue
        largest, live = fault_limit(problem), problem.of_messages
        if stale := repeating(fitted.chain, each, ~good, largest, live):
            found, rows = stale
            told.append(f'{found.what}: {found.published if live else found.remedy}')
            true = np.arange(len(each))
            for row in rows:
                true[row] = true[row - 1]
            sets[number] = replace(each.select(true), stamps_ns=each.stamps_ns)
        elif not each.inverse:
            text, joints = _frozen_joints(fitted.chain, each, good, live)
            if text:
                told += text
                sets[number] = replace(each, joints=joints)
    return tuple(told), sets


def _frozen_joints(
    chain: Chain, seen: Observations, good: Flags, of_messages: bool
) -> tuple[list[str], FloatArray]:
    """Return which joint values repeat in gross errors that a motion of this joint explains.

    A joint that rests moves in no pose, and one whose zero is off is off by one angle. The joint
    values (N, n) that explain the errors follow.
    """
    again = np.abs(np.diff(seen.joints, axis=0, prepend=np.nan)) <= ROUNDING
    odd, joints, told = ~good & ~again.all(axis=1), seen.joints.copy(), list[str]()
    for k, joint in enumerate(chain.joints):
        rows, found = np.flatnonzero(again[:, k] & odd), list[int]()
        if len(rows) < LEAST_ASIDE:
            continue
        offsets, before, after = _moved_alone(chain, seen.select(rows), k)
        runs = np.cumsum(~again[:, k])[rows]
        for run in np.unique(runs):
            mine = runs == run
            wide = np.ptp(offsets[mine]) > NEARER * np.abs(offsets[mine]).max()
            better = np.linalg.norm(after[mine]) < EXCEPTION * np.linalg.norm(before[mine])
            if mine.sum() >= LEAST_ASIDE and wide and better:
                found += range(rows[mine][0], rows[mine][-1] + 1)
                joints[rows[mine], k] += offsets[mine]
        if found:
            told.append(
                f'{joint.name} moved in {rows_in_words(found, seen.stamps_ns, of_messages)}, but '
                "its values repeat there: look for the cause in the robot's driver or the table, "
                'and measure these poses again'
            )
    return told, joints


def _moved_alone(
    chain: Chain, seen: Observations, k: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return by how much values of joint k (N,) are off, and errors [m] before and after that.

    By orientations, if these are measured; else about its axis, or along it.
    """
    joint, left = chain.joints[k], residuals(chain, seen)
    model = ErrorModel(chain, [joint.driven], seen.base, seen.tool)
    along, axis = np.split(model.jacobian(seen.joints, seen.approach)[:, :, 0], 2, axis=1)
    arm = np.cross(along, axis)
    offsets = np.arctan2(
        np.einsum('nc,nc->n', along, left.position),
        (arm**2).sum(axis=1) + np.einsum('nc,nc->n', arm, left.position),
    )
    turned = np.einsum('nc,nc->n', axis, left.orientation)
    offsets = np.where(seen.oriented, turned, offsets)
    if joint.type == 'prismatic':
        offsets = np.einsum('nc,nc->n', along, left.position)
    joints, offsets = seen.joints.copy(), joint.sign * offsets
    joints[:, k] += offsets
    both = seen, seen.changed(joints=joints)
    before, after = (sample_errors(chain, each, flange(chain, each)) for each in both)
    return offsets, before, after
