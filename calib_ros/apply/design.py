# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The information of poses about the parameters, before they are measured.

A pose adds A^T A to the information M about the parameters, with A (m, P) its rows of the weighted
Jacobian: 6 by full pose, 3 by position. With C = M^-1 the predicted RMS position error over task
poses is the root of the mean of tr J C J^T, with J their position rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg

from calib_ros.annotated import as_annotated
from calib_ros.decision.result import Identification
from calib_ros.errors import InputError
from calib_ros.estimation.identifiability import independent, structurally_independent
from calib_ros.estimation.problem import Problem
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray
from calib_ros.sampling.estimate import Estimate
from calib_ros.settings import LEVER
from calib_ros.shown import Shown

ASSUMED_TOOL = 3 * (LEVER / 3.0,)
"""Assumed place of an unknown target [m] in the flange frame: on its axis, where an identity frame
puts it, it hides the last joint. So does a point seen from there at the origin of the base."""


@dataclass(frozen=True, eq=False, repr=False)
class Design(Shown):
    """What to identify, how it will be measured, and what is already known."""

    chain: Chain
    """The point of linearisation. The base frame has no influence, the tool has."""
    names: tuple[str, ...]  # P parameters to identify, without gauge freedoms
    sigma_position: float
    sigma_orientation: float | None
    """Of a measured pose [m, rad]; None if only positions are measured."""
    known: FloatArray  # (R, P) rows of existing information, in sigma: priors, poses taken
    base: str = 'base'
    tool: str = 'tool'  # frames of the chain for further poses
    seen: bool = False  # of a fixed point only its position from the flange is measured

    @classmethod
    @as_annotated
    def of(cls, problem: Problem, result: Identification | Estimate | None = None) -> Design:
        """Return the design of a problem, with nothing known but the priors.

        With an identification, or an estimate during sampling, its information is known too, and
        further poses have its noise. Measured values do not count otherwise: `simulation.measure`
        can make the observations of a problem before anything is measured. Distances are refused.
        """
        seen = problem.observations
        if seen.distances is not None or problem.separations:
            raise InputError('planning needs measured poses or positions, not distances')
        if len(problem.chain.held) == len(problem.chain.joints):
            raise InputError('no joint can move: the limits of each are equal')
        model = problem.model
        priors = problem.prior_sigmas
        structural = structurally_independent(model, problem.free, problem.sets)
        names: tuple[str, ...] = tuple(n for n in problem.free if n in structural or n in priors)
        scales = (1.0, 1.0)
        if result is None:
            place = Frame(se3.transform(np.eye(3), np.array(ASSUMED_TOOL)))
            for name in (seen.tool, *(seen.base,) * seen.seen):
                if model.all_frames[name] is None:
                    model = model.with_frame(name, place)
            known = np.diag([1.0 / priors.get(name, np.inf) for name in names])
        else:
            model = result.chain
            names = (*result.names, *(name for name in names if name not in result.names))
            known = np.zeros((len(result.names), len(names)))
            known[:, : len(result.names)] = _root_of_inverse(result.covariance)
            noise = result.noise
            if isinstance(noise, float):
                scales = (noise, noise)
            elif not noise.consistent:
                scales = (noise.position, noise.orientation or noise.position)
        return cls(
            chain=model,
            names=names,
            sigma_position=problem.sigma_position * scales[0],
            sigma_orientation=problem.sigma_orientation * scales[1] if seen.turned else None,
            known=known,
            base=seen.base,
            tool=seen.tool,
            seen=seen.seen,
        )

    def jacobian(self, joints: FloatArray, seen: bool = False) -> FloatArray:
        """Return the Jacobian (N, 6, P) [m, rad] of poses at (N, n), or as they are `seen`."""
        model = ErrorModel(self.chain, self.names, self.base, self.tool)
        return model.jacobian(joints, seen=seen)

    def rows(self, joints: FloatArray) -> FloatArray:
        """Return the rows (N, 6 or 3, P) of information, in sigma, of poses at (N, n)."""
        jacobian = self.jacobian(joints, self.seen)
        jacobian[:, :3] /= self.sigma_position
        if self.sigma_orientation is None:
            return jacobian[:, :3]
        jacobian[:, 3:] /= self.sigma_orientation
        return jacobian

    def after(self, joints: FloatArray) -> Design:
        """Return the design after measuring poses at (N, n)."""
        rows = self.rows(joints).reshape(-1, len(self.names))
        return replace(self, known=triangular(np.concatenate([self.known, rows])))

    def determined_by(self, joints: FloatArray) -> Design:
        """Return the design without parameters that all poses at (N, n) do not determine."""
        names = independent(self.after(joints).known, self.names)
        known = self.known[:, [self.names.index(name) for name in names]]
        return replace(self, names=names, known=known)

    def targets(self, joints: FloatArray) -> FloatArray:
        """Return the target's poses (N, 4, 4) in the world at (N, n)."""
        return self.chain.forward(joints, base=self.base, tool=self.tool)


class Candidates:
    """Rows (N, m, P) of candidates, scaled to unit average.

    With `factor` (P, P), rows @ factor are in sigma per metre or radian.
    """

    def __init__(self, design: Design, joints: FloatArray) -> None:
        self.joints = joints
        self.design = design.determined_by(joints)
        rows = self.design.rows(joints)
        self.factor = self.design.after(joints).known / np.sqrt(len(rows))
        self._inverse = linalg.solve_triangular(self.factor, np.eye(len(self.factor)))
        self.rows = times(rows, self._inverse)
        self.known = information_of(self.design.known @ self._inverse)

    @cached_property
    def _products(self) -> FloatArray:
        each = np.swapaxes(self.rows, 1, 2) @ self.rows
        return np.asarray(each[(slice(None), *np.triu_indices(len(self.factor)))])

    def traces(self, matrix: FloatArray) -> FloatArray:
        """Return tr A K A^T (N,) of all rows A with a symmetric matrix K (P, P)."""
        twice = 2.0 * matrix - np.diag(np.diag(matrix))
        return np.asarray(self._products @ twice[np.triu_indices(len(matrix))])

    def of_task(self, task: FloatArray) -> FloatArray:
        """Return V (P, P) [m^2]: tr V C is the mean squared position error at (T, n)."""
        rows = self.design.jacobian(task)[:, :3]
        return information_of(times(rows, self._inverse)) / len(task)


def accuracy(design: Design, joints: FloatArray, task: FloatArray) -> FloatArray:
    """Return the predicted RMS position error (N,) [m] with the first 1, 2, ... N poses.

    At task poses (T, n), from the uncertainty of the parameters alone; infinite until all are
    determined. `joints` (N, n) are the poses, in measuring order.
    """
    space = Candidates(design, joints)
    if space.design.names != design.names:
        return np.full(len(joints), np.inf)
    each = np.swapaxes(space.rows, 1, 2) @ space.rows
    values, vectors = np.linalg.eigh(space.known + np.cumsum(each, axis=0))
    along = np.einsum('npk,pq,nqk->nk', vectors, space.of_task(task), vectors, optimize=True)
    squares = (along / np.maximum(values, HALF_THE_DIGITS)).sum(axis=1)
    return np.where(values[:, 0] < HALF_THE_DIGITS, np.inf, np.sqrt(squares))


def predicted(design: Design, task: FloatArray) -> float:
    """Return the predicted RMS position error [m] at task poses (T, n)."""
    known = triangular(design.known)
    if independent(known, design.names) != design.names:
        return float('inf')
    rows = design.jacobian(task)[:, :3].reshape(-1, len(design.names))
    length = np.linalg.norm(linalg.solve_triangular(known, rows.T, trans='T'))
    return float(length / np.sqrt(len(task)))


def times(rows: FloatArray, matrix: FloatArray) -> FloatArray:
    """Return the product of (N, m, P) and (P, P) as one BLAS operation."""
    flat = np.ascontiguousarray(rows).reshape(-1, rows.shape[2]) @ matrix
    return flat.reshape(*rows.shape[:2], -1)


def information_of(rows: FloatArray) -> FloatArray:
    """Return the information (P, P) of rows (..., P)."""
    flat = rows.reshape(-1, rows.shape[-1])
    return flat.T @ flat


def triangular(rows: FloatArray) -> FloatArray:
    """Return R (P, P), upper triangular, with the information of rows (R, P)."""
    size = rows.shape[1]
    padded = np.concatenate([rows, np.zeros((max(0, size - len(rows)), size))])
    return np.asarray(linalg.qr(padded, mode='r')[0])[:size]


def _root_of_inverse(covariance: FloatArray) -> FloatArray:
    """Return rows (P, P) whose information is the inverse of a covariance."""
    std = np.sqrt(np.diag(covariance))
    values, vectors = linalg.eigh(covariance / np.outer(std, std))
    least = len(std) * np.finfo(float).eps * values[-1]  # rounding may give zero and less
    return np.asarray((vectors / np.sqrt(np.maximum(values, least))).T / std)
