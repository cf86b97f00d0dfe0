# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Test poses to verify an arm, in the largest cube that it reaches (ISO 9283:1998, 6.10.2)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_ros.apply.candidates import Visibility, draw_candidates
from calib_ros.apply.design import Design
from calib_ros.errors import InputError
from calib_ros.kinematics import inverse, se3
from calib_ros.kinematics.se3 import FloatArray

CORNERS = 0.5 * np.array(
    [[x, y, z * x] for z in (1, -1) for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
)
TILTED = range(len(CORNERS) // 2)
"""Corners of the plane x = z of the cube, in order around it."""


class IsoPoses(NamedTuple):
    """Joint values (5, n) [rad or m] of the test poses P1 to P5, and the edge [m] of the cube.

    All have one orientation if `oriented`.
    """

    joints: FloatArray
    edge: float
    oriented: bool


class _Cubes(NamedTuple):
    """Cubes about reachable centres (M, 4, 4), with the joint values (M, n) and (M, 8, n)."""

    centres: FloatArray
    middle: FloatArray
    corners: FloatArray

    def select(self, index: NDArray[np.generic]) -> _Cubes:
        return _Cubes(*(each[index] for each in self))


def iso_9283_poses(
    design: Design, rng: np.random.Generator, visibility: Visibility | None = None
) -> IsoPoses:
    """Return five poses to verify an arm in the largest cube found (ISO 9283:1998, 6.10.2).

    The arm reaches the cube and the device sees it, beside the z axis of the base; its edges are
    parallel to the base frame. All poses have one orientation: P1 is at the centre, P2 to P5 on a
    diagonal plane, each a tenth of the diagonal away from a corner. Cubes grow about 500 reachable
    centres while inverse kinematics tracks their corners. If the arm can keep its orientation in
    none, as with fewer than six joints, orientations vary.
    """
    middle = draw_candidates(design, 500, rng, visibility)
    corners = np.repeat(middle[:, np.newaxis], 8, axis=1)
    points = _Cubes(design.targets(middle), middle, corners)
    for part in (slice(6), slice(3)):
        edge = 0.02  # of the smallest cubes [m]
        cubes = _with_edge(design, visibility, points, edge, part)
        for factor in 1.3**0.5 ** np.arange(5):  # increasingly fine
            while len(
                (grown := _with_edge(design, visibility, cubes, edge * factor, part)).centres
            ):
                cubes, edge = grown, edge * factor
        if len(cubes.centres):
            break
    else:
        raise InputError(
            'the arm cannot reach all corners of any cube: choose test poses yourself; any new '
            'ones will do'
        )
    inside = 0.8  # of the edge: a tenth of the diagonal from the corners
    away = cubes.corners - cubes.middle[:, np.newaxis]
    start = (cubes.middle[:, np.newaxis] + inside * away)[:, TILTED]
    wanted = _poses(design, cubes.centres, inside * edge)[:, TILTED]
    size, frames = (*start.shape[:2], -1), (design.base, design.tool)
    flat = wanted.reshape(-1, 4, 4), start.reshape(-1, start.shape[-1])
    found = inverse.solve(design.chain, *flat, *frames, part)
    lost = ~found.converged.reshape(size[:2]).all(axis=1)
    if lost.all():
        raise InputError(
            'the arm does not reach the inside of the cube that it reaches: try --seed'
        )
    best = np.where(lost, np.inf, np.abs(away).max(axis=(1, 2))).argmin()
    joints = np.concatenate([cubes.middle[[best]], found.joints.reshape(size)[best]])
    return IsoPoses(joints, edge, part == slice(6))


def _with_edge(
    design: Design, visibility: Visibility | None, cubes: _Cubes, edge: float, part: slice
) -> _Cubes:
    """Return the cubes that can have this edge [m]."""
    count, _, joints = cubes.corners.shape
    wanted = _poses(design, cubes.centres, edge).reshape(-1, 4, 4)
    start = cubes.corners.reshape(-1, joints)
    found = inverse.solve(design.chain, wanted, start, design.base, design.tool, part)
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
