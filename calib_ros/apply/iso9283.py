# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Five poses at which to verify an arm, after ISO 9283:1998, 6.10.2.

They lie in the largest cube found in the workspace beside the z axis of the base (where the arm
stands), with edges parallel to the base frame and one orientation for all: P1 at the centre, P2 to
P5 on a diagonal plane, each a tenth of the diagonal away from a corner.

Cubes grow about many reachable poses at once. Inverse kinematics tracks their eight corners
(`inverse.py`); a cube is dropped when a corner is lost.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_ros.apply.candidates import Visibility, draw_candidates
from calib_ros.apply.design import Design
from calib_ros.errors import InputError
from calib_ros.kinematics import inverse, se3
from calib_ros.kinematics.se3 import FloatArray

CORNERS = 0.5 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
PLANE = [7, 5, 0, 2]
"""Corners of the plane x = z of the cube, round about."""


@dataclass(frozen=True, eq=False)
class TestPoses:
    """Joint values (5, n) [rad or m] of the test poses P1 to P5, and the edge [m] of the cube."""

    __test__ = False  # no test class, whatever its name

    joints: FloatArray
    edge: float


class _Cubes(NamedTuple):
    """Cubes about reachable centres (M, 4, 4), with the joint values (M, n) and (M, 8, n)."""

    centres: FloatArray
    middle: FloatArray
    corners: FloatArray

    def select(self, index: NDArray[np.generic]) -> _Cubes:
        """Return some of the cubes."""
        return _Cubes(*(each[index] for each in self))


def iso_9283_poses(
    design: Design,
    rng: np.random.Generator,
    visibility: Visibility | None = None,
    centres: int = 500,
    edge: float = 0.02,
) -> TestPoses:
    """Return the test poses in the largest cube that the arm reaches, and the device sees.

    Cubes grow about so many reachable centres, from this `edge` [m] on. An arm that cannot keep
    its orientation in any of them, as with fewer than six joints, is refused.
    """
    middle = draw_candidates(design, centres, rng, visibility)
    start = np.repeat(middle[:, np.newaxis], 8, axis=1)
    cubes = _at(design, visibility, _Cubes(design.targets(middle), middle, start), edge)
    for factor in 1.3**0.5 ** np.arange(5):  # finer and finer
        while len((grown := _at(design, visibility, cubes, edge * factor)).centres):
            cubes, edge = grown, edge * factor
    if not len(cubes.centres):
        raise InputError(
            'the arm keeps one orientation in no cube of its workspace: choose test poses '
            'yourself; new ones anywhere will do'
        )
    travel = np.abs(cubes.corners - cubes.middle[:, np.newaxis]).max(axis=(1, 2))
    best = cubes.select(travel.argmin()[np.newaxis])
    wanted = _poses(design, best.centres, 0.8 * edge)[0, PLANE]
    found = inverse.solve(design.chain, wanted, best.corners[0, PLANE], design.base, design.tool)
    if not found.converged.all():
        raise InputError(
            'the arm does not reach the inside of the cube that it reaches: try --seed'
        )
    return TestPoses(np.concatenate([best.middle, found.joints]), edge)


def _at(design: Design, visibility: Visibility | None, cubes: _Cubes, edge: float) -> _Cubes:
    """Return those cubes that may have this edge [m]."""
    count, _, joints = cubes.corners.shape
    wanted = _poses(design, cubes.centres, edge).reshape(-1, 4, 4)
    start = cubes.corners.reshape(-1, joints)
    found = inverse.solve(design.chain, wanted, start, design.base, design.tool)
    reached = found.converged
    if visibility is not None:
        reached &= visibility.sees(design, found.joints)
    whole = reached.reshape(count, 8).all(axis=1)
    middle = se3.invert(design.chain.frame(design.base).matrix) @ cubes.centres
    whole &= np.abs(middle[:, :2, 3]).max(axis=1) > 0.5 * edge
    return cubes._replace(corners=found.joints.reshape(count, 8, joints)).select(whole)


def _poses(design: Design, centres: FloatArray, edge: float) -> FloatArray:
    """Return the poses (M, 8, 4, 4) at the corners of cubes about centres (M, 4, 4)."""
    turn = design.chain.frame(design.base).matrix[:3, :3]
    poses = np.repeat(centres[:, np.newaxis], 8, axis=1)
    poses[:, :, :3, 3] += edge * CORNERS @ turn.T
    return poses
