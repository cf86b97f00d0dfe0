# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors over the workspace."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
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
    remaining, sigma = arm.remaining(joints)
    return Survey(joints, positions, removed, sigma, remaining)


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
