# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Where in the workspace a task is done best.

The optimal workspace of a task (Vacarescu et al., abstract) is the placement of its frame with the
least expected error (`workspace.py`), the mean or the worst over the task's poses. A grid search,
whose map is the evidence, is refined about the best placement. Inverse kinematics (`inverse.py`)
solves the first pose from nearby configurations and the others from pose to pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib_ros.apply.workspace import in_base
from calib_ros.errors import InputError, UnknownNameError
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics import inverse, se3
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.progress import Told, nobody
from calib_ros.settings import AIMS, Aim, Model
from calib_ros.shown import Shown

STEPS = np.array([each for each in np.ndindex(3, 3, 3) if each != (1, 1, 1)]) - 1
"""To the neighbours on a grid."""


def task_of(poses: FloatArray) -> FloatArray:
    """Return poses (K, 4, 4) in a frame at their middle, with unchanged axes."""
    task = poses.copy()
    task[:, :3, 3] -= 0.5 * (poses[:, :3, 3].min(axis=0) + poses[:, :3, 3].max(axis=0))
    return task


@dataclass(frozen=True, eq=False, repr=False)
class Placements(Shown):
    """Where a task's frame may be placed, and the `errors` (M,) [m] expected there.

    `positions` (M, 3) [m] are in the arm's base frame, `turns` (M,) [rad] about its vertical axis;
    `joints` (M, K, n) [rad or m] are those of the task's poses. Errors are NaN where not all poses
    are reached. `best` is the placement of least error, `centre` the one nearest to the centre of
    all that are reached.
    """

    positions: FloatArray
    turns: FloatArray
    errors: FloatArray
    joints: FloatArray
    best: int
    centre: int


def place(
    arm: Calibration,
    task: FloatArray,
    aim: Aim = 'mean',
    model: Model = 'corrected',
    region: FloatArray | None = None,
    cells: int = 9,
    turns: int = 1,
    refinements: int = 4,
    starts: int = 6,
    drawn: int = 20_000,
    told: Told = nobody,
) -> Placements:
    """Find the placement of a task with the least expected error, mean or worst of its poses.

    Poses (K, 4, 4) of the target are in the task's frame, whose axes are those of the base at
    turn 0; `region` (2, 3) are corners [m, base] for its origin, None for all that the arm, which
    is commanded by a `model`, reaches. The grid has so many `cells` along each axis and `turns`
    about the vertical, and is halved so many times about the best placement. The first pose is
    solved from so many `starts` out of random joint values `drawn`.
    """
    search = _Search(arm, task, aim, model, starts, drawn, told)
    corners = search.reach if region is None else region
    if not (corners[0] <= corners[1]).all():
        raise InputError(
            f'the region from {corners[0].tolist()} to {corners[1].tolist()} is empty: give the '
            'lower corner first'
        )
    axes = [np.linspace(low, high, cells) for low, high in corners.T]
    angles = 2.0 * np.pi * np.arange(turns) / turns
    grid = np.stack(np.meshgrid(*axes, angles, indexing='ij'), axis=-1).reshape(-1, 4)
    errors, joints = search.errors(grid, refinements * len(STEPS))
    reached = ~np.isnan(errors)
    if not reached.any():
        raise InputError(
            f'the arm reaches all {len(task)} poses of the task at none of {len(grid)} '
            'placements: check the unit (m), the orientation and the region, or use more cells'
        )
    away = np.linalg.norm(grid[:, :3] - grid[reached, :3].mean(axis=0), axis=1)
    centre = int(np.where(reached, away, np.inf).argmin())
    step = (corners[1] - corners[0]) / max(cells - 1, 1)
    for left in reversed(range(refinements)):
        step /= 2.0
        best = grid[np.nanargmin(errors)]
        near = np.tile(best, (len(STEPS), 1))
        near[:, :3] = np.clip(best[:3] + step * STEPS, corners[0], corners[1])
        more = search.errors(near, left * len(STEPS))
        both = zip((grid, errors, joints), (near, *more), strict=True)
        grid, errors, joints = map(np.concatenate, both)
    return Placements(grid[:, :3], grid[:, 3], errors, joints, int(np.nanargmin(errors)), centre)


class _Search:
    """The expected error of a task at placements (M, 4): x, y, z [m] and a turn [rad].

    All that the arm reaches is within the corners (2, 3) of its `reach` [m].
    """

    def __init__(
        self,
        arm: Calibration,
        task: FloatArray,
        aim: Aim,
        model: Model,
        starts: int,
        drawn: int,
        told: Told,
    ) -> None:
        if aim not in AIMS:
            raise UnknownNameError('aim', aim, AIMS)
        self._arm, self._task, self._aim, self._model = arm, task, aim, model
        self._starts, self._told, self._solved = starts, told, 0
        self._chain = arm.commanded_by(model)
        self._base = self._chain.frame('base').matrix
        self._known = self._chain.random_joints(drawn, np.random.default_rng(0))
        poses = in_base(self._chain, self._known)
        self._tree = cKDTree(_features(poses))
        self.reach = np.array([poses[:, :3, 3].min(axis=0), poses[:, :3, 3].max(axis=0)])

    def errors(self, placements: FloatArray, later: int) -> tuple[FloatArray, FloatArray]:
        """Return the errors (M,) [m], NaN where out of reach, and the joint values (M, K, n).

        So many placements are tried `later`.
        """
        turns = placements[:, 3:] * [0.0, 0.0, 1.0]
        frames = se3.transform(se3.exp_rotation(turns), placements[:, :3])
        poses = frames[:, np.newaxis] @ self._task
        joints, reached = self._follow(poses, later)
        errors = np.full((len(placements), self._starts), np.nan)
        expected = self._arm.expected(joints[reached].reshape(-1, joints.shape[-1]), self._model)
        expected = expected.reshape(-1, len(self._task))
        errors[reached] = (np.mean if self._aim == 'mean' else np.max)(expected, axis=1)
        best = np.where(np.isnan(errors), np.inf, errors).argmin(axis=1)
        index = np.arange(len(placements))
        return errors[index, best], joints[index, best]

    def _follow(self, poses: FloatArray, later: int) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return joint values (M, S, K, n) for poses (M, K, 4, 4), and which reach them."""
        count, length = poses.shape[:2]
        _, nearest = self._tree.query(_features(poses[:, 0]), self._starts)
        joints = np.full((count, self._starts, length, self._known.shape[1]), np.nan)
        reached = np.ones((count, self._starts), dtype=bool)
        start = self._known[nearest]
        for k in range(length):
            placement, branch = np.nonzero(reached)
            wanted = self._base @ poses[placement, k]
            found = inverse.solve(self._chain, wanted, start[reached])
            joints[placement, branch, k] = found.joints
            start[reached] = found.joints
            reached[placement, branch] = found.converged
            self._solved += len(wanted)
            left = np.count_nonzero(reached) * (length - k - 1) + later * self._starts * length
            self._told(self._solved / max(self._solved + left, 1))
        return joints, reached


def _features(poses: FloatArray) -> FloatArray:
    """Return (N, 12): what is near in position, and in orientation times LEVER, is near in it."""
    columns = inverse.LEVER / np.sqrt(2.0) * poses[:, :3, :3].reshape(-1, 9)
    return np.concatenate([poses[:, :3, 3], columns], axis=1)


def in_words(placements: Placements, aim: str, model: str) -> str:
    """Return where to place a task, against the centre of all places."""
    reached = placements.errors[~np.isnan(placements.errors)]
    best, centre = (
        f'{1e3 * placements.errors[k]:.4f} mm at '
        f'{" ".join(f"{x:.3f}" for x in placements.positions[k])} m in the base '
        f'frame, turned by {np.degrees(placements.turns[k]):.0f} degrees'
        for k in (placements.best, placements.centre)
    )
    return (
        f'expected {aim} error of the task, {model} model; the arm reaches it at '
        f'{len(reached)} of {len(placements.errors)} placements\n'
        f'best:   {best}\ncentre: {centre}\nworst:  {1e3 * reached.max():.4f} mm\n'
    )
