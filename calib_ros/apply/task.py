# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The expected error of a task at its placements.

The first pose is solved from nearby configurations and the others from pose to pose.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from calib_ros.apply.workspace import in_base
from calib_ros.estimation.configurations import STILL
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics import inverse, se3
from calib_ros.kinematics.follower import mobility
from calib_ros.kinematics.se3 import Flags, FloatArray
from calib_ros.progress import Notify
from calib_ros.settings import EXACT, LEVER, LEVER_IN_PART, TURN_IN_PART, Model, Objective


def task_of(poses: FloatArray) -> FloatArray:
    """Return poses (K, 4, 4) in a frame at their middle, with unchanged axes."""
    task = poses.copy()
    task[:, :3, 3] -= 0.5 * (poses[:, :3, 3].min(axis=0) + poses[:, :3, 3].max(axis=0))
    return task


class Search:
    """The expected error of a task at placements (M, 4): x, y, z [m] and a turn [rad].

    The arm reaches only points within the corners (2, 3) of its `reach` [m]. The first pose of the
    task is solved from the nearest 24 of random joint values, since an arm reaches it in several
    postures with other errors.
    """

    def __init__(
        self, arm: Calibration, task: FloatArray, aim: Objective, model: Model, progress: Notify
    ) -> None:
        self._arm, self._task, self._aim, self._model = arm, task, aim, model
        self._starts, self._progress, self._solved = 24, progress, 0
        self._chain = arm.commanded_by(model)
        self._complete = mobility(self._chain)[0] == 6
        self._base = self._chain.frame('base').matrix
        self._known = self._chain.random_joints(20_000, np.random.default_rng(0))
        poses = in_base(self._chain, self._known)
        self._tree = cKDTree(_features(poses))
        self.reach = np.array([poses[:, :3, 3].min(axis=0), poses[:, :3, 3].max(axis=0)])

    def errors(self, placements: FloatArray, later: int) -> tuple[FloatArray, FloatArray]:
        """Return the errors (M,) [m], NaN if out of reach, and the joint values (M, K, n).

        `later` placements follow.
        """
        turns = placements[:, 3:] * [0.0, 0.0, 1.0]
        frames = se3.transform(se3.exp_rotation(turns), placements[:, :3])
        poses = frames[:, np.newaxis] @ self._task
        joints, reached = self._follow(poses, later)
        errors = np.full((len(placements), self._starts), np.nan)
        expected = self._arm.expected(joints[reached].reshape(-1, joints.shape[-1]), self._model)
        expected = expected.reshape(-1, len(self._task))
        errors[reached] = expected.mean(axis=1) if self._aim == 'mean' else expected.max(axis=1)
        turning = [joint.type == 'revolute' for joint in self._chain.joints]
        turned = (np.abs(np.diff(joints[..., turning], axis=2)) > np.pi).any(axis=(2, 3))
        best = np.lexsort((errors, turned, np.isnan(errors)))[:, 0]
        index = np.arange(len(placements))
        return errors[index, best], joints[index, best]

    def _follow(self, poses: FloatArray, later: int) -> tuple[FloatArray, Flags]:
        """Return joint values (M, S, K, n) for poses (M, K, 4, 4), and which reach them."""
        count, length = poses.shape[:2]
        _, nearest = self._tree.query(_features(poses[:, 0]), self._starts)
        joints = np.full((count, self._starts, length, self._known.shape[1]), np.nan)
        reached = np.ones((count, self._starts), dtype=bool)
        start = self._known[nearest]
        for k in range(length):
            placement, branch = np.nonzero(reached)
            wanted = self._base @ poses[placement, k]
            lever = LEVER if self._complete else LEVER_IN_PART
            found = inverse.solve(self._chain, wanted, start[reached], lever=lever)
            joints[placement, branch, k] = found.joints
            start[reached] = found.joints
            near = found.converged
            if not self._complete:  # tolerated as by `compensate`
                near = (found.position <= EXACT) & (found.orientation <= TURN_IN_PART)
            reached[placement, branch] = near
            if not k:
                reached &= ~self._known_before(joints[:, :, 0], reached)
            self._solved += len(wanted)
            left = np.count_nonzero(reached) * (length - k - 1) + later * self._starts * length
            self._progress(self._solved / max(self._solved + left, 1))
        return joints, reached

    def _known_before(self, joints: FloatArray, reached: Flags) -> Flags:
        """Tell (M, S) whether an earlier start led to the same joint values (M, S, n)."""
        found = np.zeros_like(reached)
        for k in range(1, self._starts):
            apart = np.abs(joints[:, :k] - joints[:, k, np.newaxis]).max(axis=2)
            found[:, k] = (reached[:, :k] & (apart < STILL)).any(axis=1)
        return found


def _features(poses: FloatArray) -> FloatArray:
    """Return (N, 12) features: position, and orientation times LEVER."""
    columns = LEVER / np.sqrt(2.0) * poses[:, :3, :3].reshape(-1, 9)
    return np.concatenate([poses[:, :3, 3], columns], axis=1)
