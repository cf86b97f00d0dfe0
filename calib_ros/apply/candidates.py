# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses at which the target can be measured, and their visiting order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_ros.apply.design import Design
from calib_ros.errors import ConfigError, InputError
from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import Flags, FloatArray, Index


def refuse_empty(what: str, corners: FloatArray) -> None:
    """Refuse corners (2, 3) whose lower one does not come first."""
    if not (corners[0] <= corners[1]).all():
        given = ' to '.join(map(str, corners.tolist()))
        raise ConfigError(f'the {what} from {given} is empty: give the lower corner first')


def refuse_millimetres(what: str, given: FloatArray) -> None:
    """Refuse coordinates (N,) or corners (2, 3) [m] that no cell has."""
    if (np.abs(given) > 100.0).any():
        raise ConfigError(f'the {what} must be in metres (300 mm is 0.3), not {given.tolist()}')


@dataclass(frozen=True, eq=False)
class Visibility:
    """Where the measuring device sees the target.

    `box` (2, 3) [m] holds opposite corners of the measurable region, `tracker` (3,) [m] the
    position of the device, both in the `world` or else in the arm's base frame. The `axis` in the
    target's frame must point to the device within a `cone` [rad].
    """

    box: FloatArray | None = None
    tracker: FloatArray | None = None
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    cone: float = np.pi / 4.0
    world: bool = False

    def __post_init__(self) -> None:
        if self.box is not None:
            refuse_empty('box', self.box)
        for name, given in (('box', self.box), ('tracker', self.tracker)):
            if given is not None and not self.world:
                refuse_millimetres(name, np.extract(np.isfinite(given), given))
        if self.tracker is not None and not np.isfinite(self.tracker).all():
            raise ConfigError(f'the tracker must be at a place in metres, not at {self.tracker}')
        if not np.linalg.norm(self.axis) > 0.0:
            raise ConfigError('the axis of the target must not be 0 0 0')
        if not 0.0 < self.cone <= np.pi:
            raise ConfigError(
                f'the cone must be between 0 and 180 degrees, not {np.degrees(self.cone):g}'
            )

    def sees(self, design: Design, joints: FloatArray) -> Flags:
        """Tell (N,) whether the target can be measured at joint values (N, n)."""
        base = design.chain.all_frames[design.base]
        poses = design.targets(joints)
        if not self.world:
            poses = se3.invert(design.chain.frame(design.base).matrix) @ poses
        elif base is None:
            raise ConfigError(
                'the measurable region is given in the world, but the chain file does not say '
                'where the base is: give it in the base frame, or "base" in the chain file'
            )
        position = poses[:, :3, 3]
        seen = np.ones(len(joints), dtype=bool)
        if self.box is not None:
            seen &= ((self.box[0] <= position) & (position <= self.box[1])).all(axis=1)
        if self.tracker is not None:
            sight = self.tracker - position
            axis = poses[:, :3, :3] @ (np.array(self.axis) / np.linalg.norm(self.axis))
            along = np.einsum('ni,ni->n', sight, axis)
            seen &= along >= np.cos(self.cone) * np.linalg.norm(sight, axis=1)
        return seen


def draw_candidates(
    design: Design, count: int, rng: np.random.Generator, visibility: Visibility | None = None
) -> FloatArray:
    """Draw joint values (count, n) within the limits at which the target can be measured.

    The region counts as out of reach after a thousand tries for each.
    """
    found = np.zeros((0, len(design.chain.joints)))
    drawn = 0
    while len(found) < count:
        if drawn > 1000 * count:
            raise InputError(
                f'the target can be measured at {len(found)} of {drawn} random poses only; '
                f'{count} candidates are needed: widen what the device sees (--box, --cone), turn '
                'the target (--axis), or give a file of poses (--candidates)'
            )
        joints = design.chain.random_joints(10 * count, rng)
        drawn += len(joints)
        seen = joints if visibility is None else joints[visibility.sees(design, joints)]
        found = np.concatenate([found, seen])
    return found[:count]


def visit_order(joints: FloatArray, velocities: FloatArray) -> Index:
    """Return a fast order (N,) to visit configurations (N, n).

    The slowest joint, at `velocities` (n,) [rad/s or m/s], determines the time of a move. Nearest
    neighbour from the outermost configuration, improved by reversing parts of the path (2-opt;
    Croes 1958).
    """
    travel = travel_times(joints, velocities)
    count = len(joints)
    order = [int(travel.sum(axis=1).argmax())]
    free = np.ones(count, dtype=bool)
    for _ in range(count - 1):
        free[order[-1]] = False
        order.append(int(np.where(free, travel[order[-1]], np.inf).argmin()))
    path = np.array(order)
    while True:
        # reversing i ... j joins i - 1 to j and i to j + 1; ends of the path join nothing
        padded = np.zeros((count + 2, count + 2))
        padded[1:-1, 1:-1] = travel[np.ix_(path, path)]
        legs = np.diagonal(padded, 1)
        change = padded[:-2, 1:-1] + padded[1:-1, 2:] - legs[:-1, None] - legs[None, 1:]
        change = np.triu(change, 1)
        i, j = np.unravel_index(change.argmin(), change.shape)
        if change[i, j] > -1e-9:
            return path
        path[i : j + 1] = path[i : j + 1][::-1]


def travel_times(joints: FloatArray, velocities: FloatArray) -> FloatArray:
    """Return the times (N, N) [s] of the moves between configurations (N, n)."""
    return np.asarray(np.abs((joints[:, None] - joints[None]) / velocities).max(axis=2))
