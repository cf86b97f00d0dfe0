# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors over the workspace, and the best place for a task.

The optimal workspace of a task (Vacarescu et al., abstract) is the placement of its frame with the
least expected error, the mean or the worst over its poses. A grid search, whose map is the
evidence, is refined about the best placement. The first pose is solved from nearby configurations
and the others from pose to pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from calib_ros.annotated import Count, as_annotated
from calib_ros.apply.candidates import refuse_empty
from calib_ros.errors import InputError
from calib_ros.estimation.configurations import STILL
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics import inverse, se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.follower import mobility
from calib_ros.kinematics.se3 import Flags, FloatArray
from calib_ros.progress import Notify, quiet
from calib_ros.settings import EXACT, LEVER, LEVER_IN_PART, TURN_IN_PART, Model, Objective
from calib_ros.shown import Shown


@dataclass(frozen=True, eq=False, repr=False)
class Survey(Shown):
    """Errors at `joints` (N, n) [rad or m] over the workspace.

    `positions` (N, 3) [m] are those of the target in the arm's base frame. The calibration removes
    `removed` (N,) [m]; `sigma` (N,) [m] is the standard deviation of the position by the
    parameters, `remaining` (N,) [m] the expected remaining error, both NaN if unknown.
    """

    joints: FloatArray
    positions: FloatArray
    removed: FloatArray
    sigma: FloatArray
    remaining: FloatArray

    @property
    def parts(self) -> dict[str, FloatArray]:
        """Return the errors (N,) [m] by name: only the removed ones, if no others are known."""
        found = {'removed by the calibration': self.removed}
        if not np.isnan(self.remaining).any():
            found |= {'its uncertainty': self.sigma, 'expected to remain': self.remaining}
        return found

    @property
    def cloud(self) -> FloatArray:
        """Return (N, 5): x, y, z [m] in the arm's base frame, error removed [m], sigma [m]."""
        return np.column_stack([self.positions, self.removed, self.sigma])


def survey(arm: Calibration, count: int, rng: np.random.Generator) -> Survey:
    """Survey the errors at random configurations within the joint limits."""
    joints = arm.chain.random_joints(count, rng)
    positions, (removed, _) = in_base(arm.chain, joints)[:, :3, 3], arm.removed(joints)
    return Survey(joints, positions, removed, arm.sigma(joints), arm.remaining(joints))


def in_base(chain: Chain, joints: FloatArray) -> FloatArray:
    """Return the target's poses (N, 4, 4) in the arm's base frame at joint values (N, n)."""
    return se3.invert(chain.frame('base').matrix) @ chain.forward(joints)


def spread(errors: FloatArray) -> dict[str, float]:
    """Return figures of errors (N,) by name."""
    rms, (median, high) = np.sqrt(np.mean(errors**2)), np.quantile(errors, [0.5, 0.95])
    found = map(float, (rms, errors.mean(), median, high, errors.max()))
    return dict(zip(('RMS', 'mean', 'median', '95 % below', 'max'), found, strict=True))


@dataclass(frozen=True)
class Sector:
    """A part of the workspace in cylinder coordinates of the arm's base, and its RMS error [m].

    `radius` and `height` [m] are its limits.
    """

    words: str
    radius: tuple[float, float]
    height: tuple[float, float]
    poses: int
    rms: float


SIDES = ('ahead (+x)', 'left (+y)', 'behind (-x)', 'right (-y)')
RADII = ('close in', 'halfway out', 'far out')
HEIGHTS = ('low', 'at middle height', 'high')


def regions(positions: FloatArray, errors: FloatArray) -> tuple[Sector, ...]:
    """Return the regions of positions (N, 3) [m], that of the largest RMS error (N,) first.

    Thirds of the poses by radius and height, and quadrants. Regions with less than 0.5 % of the
    poses are omitted.
    """
    radius, height = np.hypot(positions[:, 0], positions[:, 1]), positions[:, 2]
    azimuth = np.arctan2(positions[:, 1], positions[:, 0])
    edges = [np.quantile(each, [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0]) for each in (radius, height)]
    rings, levels = np.digitize(radius, edges[0][1:3]), np.digitize(height, edges[1][1:3])
    sides = np.round(azimuth / (0.5 * np.pi)).astype(int) % 4
    found = []
    for ring, level, side in np.ndindex(3, 3, 4):
        inside = (rings == ring) & (levels == level) & (sides == side)
        if inside.sum() < max(1, 0.005 * len(positions)):
            continue
        found.append(
            Sector(
                f'{RADII[ring]}, {HEIGHTS[level]}, {SIDES[side]}',
                (float(edges[0][ring]), float(edges[0][ring + 1])),
                (float(edges[1][level]), float(edges[1][level + 1])),
                int(inside.sum()),
                float(np.sqrt(np.mean(errors[inside] ** 2))),
            )
        )
    return tuple(sorted(found, key=lambda region: -region.rms))


def rms_map(
    first: FloatArray, second: FloatArray, errors: FloatArray, cells: int = 30
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the RMS of errors (N,) over cells of two coordinates (N,).

    Edges (cells + 1,) of both, and RMS (cells, cells), NaN if empty; the first coordinate counts
    rows.
    """
    number, first_edges, second_edges = np.histogram2d(first, second, cells)
    edges = (first_edges, second_edges)
    squares = np.histogram2d(first, second, edges, weights=errors**2)[0]
    return first_edges, second_edges, np.sqrt(squares / np.where(number > 0, number, np.nan))


AROUND = np.array([each for each in np.ndindex(3, 3, 3) if each != (1, 1, 1)]) - 1
"""Steps to the neighbours on a grid."""


def task_of(poses: FloatArray) -> FloatArray:
    """Return poses (K, 4, 4) in a frame at their middle, with unchanged axes."""
    task = poses.copy()
    task[:, :3, 3] -= 0.5 * (poses[:, :3, 3].min(axis=0) + poses[:, :3, 3].max(axis=0))
    return task


@dataclass(frozen=True, eq=False, repr=False)
class Placements(Shown):
    """Placements of a task's frame, and their expected `errors` (M,) [m].

    `positions` (M, 3) [m] are in the arm's base frame, `turns` (M,) [rad] about its vertical axis;
    `joints` (M, K, n) [rad or m] are those of the task's poses. Errors are NaN if not all poses
    are reached. `best` is the placement of least error, `centre` the one nearest to the centre of
    the reached ones.
    """

    positions: FloatArray
    turns: FloatArray
    errors: FloatArray
    joints: FloatArray
    best: int
    centre: int


@as_annotated
def place(
    arm: Calibration,
    task: FloatArray,
    aim: Objective = 'mean',
    model: Model = 'corrected',
    region: FloatArray | None = None,
    cells: Count = 9,
    turns: Count = 1,
    refinements: int = 4,
    progress: Notify = quiet,
) -> Placements:
    """Find the placement of a task with the smallest expected error, mean or worst of its poses.

    Poses (K, 4, 4) of the target are in the task's frame, whose axes are those of the base at turn
    0; `region` (2, 3) are corners [m, base] for its origin, None for all that the arm, commanded
    by a `model`, reaches. The grid has `cells` along each axis and `turns` about the vertical, and
    is halved `refinements` times about the best placement. An arm with fewer than six freedoms
    reaches a pose at its position, with the orientation to 0.02 rad.
    """
    search = _Search(arm, task, aim, model, progress)
    corners = search.reach if region is None else region
    refuse_empty('region', corners)
    axes = [np.linspace(low, high, cells) for low, high in corners.T]
    angles = 2.0 * np.pi * np.arange(turns) / turns
    grid = np.stack(np.meshgrid(*axes, angles, indexing='ij'), axis=-1).reshape(-1, 4)
    errors, joints = search.errors(grid, refinements * len(AROUND))
    reached = ~np.isnan(errors)
    if not reached.any():
        raise InputError(
            f'the arm cannot reach all {len(task)} poses of the task in any of {len(grid)} '
            'placements: check the unit (m), the orientation and the region, or use more cells'
        )
    away = np.linalg.norm(grid[:, :3] - grid[reached, :3].mean(axis=0), axis=1)
    centre = int(np.where(reached, away, np.inf).argmin())
    step = (corners[1] - corners[0]) / max(cells - 1, 1)
    for left in reversed(range(refinements)):
        step /= 2.0
        best = grid[np.nanargmin(errors)]
        near = np.tile(best, (len(AROUND), 1))
        near[:, :3] = np.clip(best[:3] + step * AROUND, corners[0], corners[1])
        more = search.errors(near, left * len(AROUND))
        both = zip((grid, errors, joints), (near, *more), strict=True)
        grid, errors, joints = map(np.concatenate, both)
    return Placements(grid[:, :3], grid[:, 3], errors, joints, int(np.nanargmin(errors)), centre)


class _Search:
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
        best = np.where(np.isnan(errors), np.inf, errors).argmin(axis=1)
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
