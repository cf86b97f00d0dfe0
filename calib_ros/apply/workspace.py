# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors over the workspace: what a calibration removes, and what remains (`Calibration`)."""

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
    """Errors at `joints` (N, n) [rad or m] all over the workspace.

    `positions` (N, 3) [m] are those of the target in the arm's base frame. The calibration removes
    `removed` (N,) [m] and `turned` (N,) [rad]; `sigma` (N,) [m] is the standard deviation of the
    position by the uncertainty of the parameters, and `remaining` (N,) [m] what is expected to
    remain by it and the residuals, both NaN if not known.
    """

    joints: FloatArray
    positions: FloatArray
    removed: FloatArray
    turned: FloatArray
    sigma: FloatArray
    remaining: FloatArray

    @property
    def parts(self) -> dict[str, FloatArray]:
        """Return the errors (N,) [m] by their names: only what is removed, if no more is known."""
        found = {'removed by the calibration': self.removed}
        if not np.isnan(self.remaining).any():
            found |= {'uncertainty of that': self.sigma, 'expected to remain': self.remaining}
        return found

    @property
    def cloud(self) -> FloatArray:
        """Return (N, 5): x, y, z [m] in the arm's base frame, error removed [m], sigma [m]."""
        return np.column_stack([self.positions, self.removed, self.sigma])


def survey(arm: Calibration, count: int, rng: np.random.Generator) -> Survey:
    """Survey the errors at random configurations within the joint limits."""
    joints = arm.chain.random_joints(count, rng)
    removed, turned = arm.removed(joints)
    positions, sigma = in_base(arm.chain, joints)[:, :3, 3], arm.sigma(joints)
    return Survey(joints, positions, removed, turned, sigma, np.hypot(sigma, arm.residual or 0.0))


def in_base(chain: Chain, joints: FloatArray) -> FloatArray:
    """Return the target's poses (N, 4, 4) in the arm's base frame at joint values (N, n)."""
    return se3.invert(chain.frame('base').matrix) @ chain.forward(joints)


@dataclass(frozen=True)
class Spread:
    """RMS, mean, percentiles and maximum of an error [m]."""

    rms: float
    mean: float
    median: float
    percentile_95: float
    max: float

    @classmethod
    def of(cls, errors: FloatArray) -> Spread:
        """Return the figures of errors (N,)."""
        median, high = np.quantile(errors, [0.5, 0.95])
        found = (np.sqrt(np.mean(errors**2)), errors.mean(), median, high, errors.max())
        return cls(*map(float, found))


@dataclass(frozen=True)
class Sector:
    """A part of the workspace in cylinder coordinates of the arm's base, and its RMS error [m].

    `radius`, `height` [m] and `azimuth` [rad] are the limits, the latter from the x axis.
    """

    words: str
    radius: tuple[float, float]
    height: tuple[float, float]
    azimuth: tuple[float, float]
    poses: int
    rms: float


SIDES = ('ahead (+x)', 'left (+y)', 'behind (-x)', 'right (-y)')
RADII = ('close in', 'half way out', 'far out')
HEIGHTS = ('low', 'at middle height', 'high')


def regions(positions: FloatArray, errors: FloatArray, least: float = 0.005) -> tuple[Sector, ...]:
    """Return the regions of positions (N, 3) [m], that of the largest RMS error (N,) first.

    Radius and height are parted so that each third holds as many poses; azimuth in quadrants.
    Regions with less than the `least` share of all poses are left out.
    """
    radius, height = np.hypot(positions[:, 0], positions[:, 1]), positions[:, 2]
    azimuth = np.arctan2(positions[:, 1], positions[:, 0])
    edges = [np.quantile(each, [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0]) for each in (radius, height)]
    rings, levels = (
        np.clip(np.searchsorted(edge, each, 'right') - 1, 0, 2)
        for edge, each in zip(edges, (radius, height), strict=True)
    )
    sides = np.round(azimuth / (0.5 * np.pi)).astype(int) % 4
    found = []
    for ring, level, side in np.ndindex(3, 3, 4):
        inside = (rings == ring) & (levels == level) & (sides == side)
        if inside.sum() < max(1, least * len(positions)):
            continue
        middle = 0.5 * np.pi * side
        found.append(
            Sector(
                f'{RADII[ring]}, {HEIGHTS[level]}, {SIDES[side]}',
                (float(edges[0][ring]), float(edges[0][ring + 1])),
                (float(edges[1][level]), float(edges[1][level + 1])),
                (middle - 0.25 * np.pi, middle + 0.25 * np.pi),
                int(inside.sum()),
                float(np.sqrt(np.mean(errors[inside] ** 2))),
            )
        )
    return tuple(sorted(found, key=lambda region: -region.rms))


def rms_map(
    first: FloatArray, second: FloatArray, errors: FloatArray, cells: int = 30
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the RMS of errors (N,) over cells of two coordinates (N,).

    Edges (cells + 1,) of both, and RMS (cells, cells), NaN where there is nothing; the first
    coordinate counts rows.
    """
    number, first_edges, second_edges = np.histogram2d(first, second, cells)
    edges = (first_edges, second_edges)
    squares = np.histogram2d(first, second, edges, weights=errors**2)[0]
    rms = np.sqrt(squares / np.where(number > 0, number, np.nan))
    return first_edges, second_edges, rms
