# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The best place for a task.

The optimal workspace of a task (Vacarescu et al., abstract) is the placement of its frame with the
least expected error, the mean or the worst over its poses. A grid search, whose map is the
evidence, is refined about the best placement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_ros.annotated import Count, as_annotated
from calib_ros.apply.candidates import refuse_empty, refuse_millimetres
from calib_ros.apply.task import Search
from calib_ros.errors import ConfigError, InputError
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.progress import Notify, quiet
from calib_ros.settings import Model, Objective
from calib_ros.shown import Shown, counted
from calib_ros.values import LARGEST

AROUND = np.array([each for each in np.ndindex(3, 3, 3) if each != (1, 1, 1)]) - 1
"""Steps to the neighbours on a grid."""


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
    search = Search(arm, task, aim, model, progress)
    corners = search.reach if region is None else region
    refuse_empty('region', corners)
    refuse_millimetres('region', corners)
    if cells**3 * turns > LARGEST:
        raise ConfigError(
            f'{cells} cells along each axis and {turns} turns are {cells**3 * turns:,} '
            f'placements; the limit is {LARGEST:,.0f}: give fewer'
        )
    shares = np.linspace(0.0, 1.0, cells) if cells > 1 else np.full(1, 0.5)
    axes = [low + shares * (high - low) for low, high in corners.T]
    angles = 2.0 * np.pi * np.arange(turns) / turns
    grid = np.stack(np.meshgrid(*axes, angles, indexing='ij'), axis=-1).reshape(-1, 4)
    errors, joints = search.errors(grid, refinements * len(AROUND))
    reached = ~np.isnan(errors)
    if not reached.any():
        raise InputError(
            f'the arm cannot reach the whole task in any of {counted(len(grid), "placement")}: '
            'check the unit (m), the orientation and the region, or use more cells'
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
