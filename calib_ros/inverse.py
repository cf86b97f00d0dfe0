# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joint values that bring the target to wanted poses, for any chain.

Newton's method on the residual e = (p_wanted - p, rotation vector from R to R_wanted), with the
geometric Jacobian J: the error model's columns (`differential.py`) for theta or d of every joint,
times its sign. The step

    dq = J^T (J J^T + lambda I)^-1 e

is the shortest one that removes e (redundant arms). It is damped (Levenberg 1944, Marquardt 1963)
until it lowers |e|, as near singular configurations. Non-geometric effects are in the residual
and left out of J, which they change by a part in a thousand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.chain import Chain
from calib_ros.differential import ErrorModel, orientation_error
from calib_ros.se3 import FloatArray

LEVER = 0.3
"""Length [m] at which a turn counts as much as a shift."""
TOLERANCE = 1e-9
"""A pose is reached when it is missed by less [m, and rad times LEVER]."""
ITERATIONS = 100
DAMPING = (1e-12, 1e-6, 1e3)
"""Least damping, the first one, and that beyond which no step helps [m^2]."""


@dataclass(frozen=True, eq=False)
class Inverse:
    """Joint values for wanted poses, and what is left.

    Attributes
    ----------
    joints : (N, n)
        Joint values [rad or m], within the limits.
    position, orientation : (N,)
        Distance [m] and angle [rad] to the wanted pose.
    converged : (N,)
        Whether the pose is reached. Others are out of reach, or need another start.

    """

    joints: FloatArray
    position: FloatArray
    orientation: FloatArray
    converged: NDArray[np.bool_]


def solve(
    chain: Chain,
    poses: FloatArray,
    start: FloatArray,
    base: str = 'base',
    tool: str = 'tool',
) -> Inverse:
    """Return the joint values near a start that bring the target to wanted poses.

    Parameters
    ----------
    chain : Chain
        The arm, with its frames.
    poses : (N, 4, 4)
        Wanted T_world_target.
    start : (N, n)
        Joint values [rad or m] to start from.
    base, tool : str
        Frames at the ends of the chain.

    """
    aim = _Aim(chain, poses, base, tool)
    q = aim.within(np.array(start, dtype=float).T)
    error, jacobian = aim.linearise(q, np.arange(len(poses)))
    size = np.linalg.norm(error, axis=0)
    least, first, most = DAMPING
    damping = np.full(len(poses), first)
    for _ in range(ITERATIONS):
        (active,) = np.nonzero((size > TOLERANCE) & (damping < most))
        if not active.size:
            break
        step = _step(jacobian[:, :, active], error[:, active], damping[active])
        tried = aim.within(q[:, active] + step)
        new_error, new_jacobian = aim.linearise(tried, active)
        new_size = np.linalg.norm(new_error, axis=0)
        better = new_size < size[active]
        damping[active] *= np.where(better, 0.1, 10.0)
        damping = np.maximum(damping, least)
        moved = active[better]
        q[:, moved], error[:, moved] = tried[:, better], new_error[:, better]
        jacobian[:, :, moved], size[moved] = new_jacobian[:, :, better], new_size[better]
    return Inverse(
        q.T,
        np.linalg.norm(error[:3], axis=0),
        np.linalg.norm(error[3:], axis=0) / LEVER,
        size <= TOLERANCE,
    )


class _Aim:
    """Wanted poses and the chain that is to reach them; arrays have the sample last."""

    def __init__(self, chain: Chain, poses: FloatArray, base: str, tool: str) -> None:
        driven = ('theta' if joint.type == 'revolute' else 'd' for joint in chain.joints)
        names = [f'{joint.name}.{kind}' for joint, kind in zip(chain.joints, driven, strict=True)]
        self._model = ErrorModel(chain, names, base, tool)
        self._turns = np.array([[joint.type == 'revolute'] for joint in chain.joints])
        self._signs = np.array([joint.sign for joint in chain.joints])[:, np.newaxis, np.newaxis]
        limits = [(joint.lower, joint.upper) for joint in chain.joints]
        self._lower = np.array([[-np.inf if low is None else low] for low, _ in limits])
        self._upper = np.array([[np.inf if up is None else up] for _, up in limits])
        self._positions = np.ascontiguousarray(poses[:, :3, 3].T)
        self._rotations = np.ascontiguousarray(poses[:, :3, :3].transpose(2, 1, 0))

    def within(self, q: FloatArray) -> FloatArray:
        """Return joint values (n, B) brought into the limits, by a full turn where that helps."""
        turn = 2.0 * np.pi * self._turns
        q = np.where((q > self._upper) & (q - turn >= self._lower), q - turn, q)
        q = np.where((q < self._lower) & (q + turn <= self._upper), q + turn, q)
        return np.clip(q, self._lower, self._upper)

    def linearise(self, q: FloatArray, index: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Return the residual (6, B) and the Jacobian (6, n, B) for the poses of an index (B,)."""
        model = self._model
        axes, origin, shift, turn = model.linearise(q)
        error = np.empty((6, q.shape[1]))
        np.subtract(self._positions[:, index], origin, out=error[:3])
        error[3:] = LEVER * orientation_error(self._rotations[:, :, index], axes)
        jacobian = np.zeros((6, len(q), q.shape[1]))
        jacobian[:3] = (self._signs * shift[model.order]).transpose(1, 0, 2)
        turning = model.order < model.rotations
        turns = self._signs[turning] * turn[model.order[turning]]
        jacobian[3:, turning] = LEVER * turns.transpose(1, 0, 2)
        return error, jacobian


def _step(jacobian: FloatArray, error: FloatArray, damping: FloatArray) -> FloatArray:
    """Return the damped step (n, B) that removes the residual (6, B), the shortest one."""
    rows = jacobian.transpose(2, 0, 1)
    columns = np.swapaxes(rows, 1, 2)
    normal = rows @ columns + damping[:, np.newaxis, np.newaxis] * np.eye(6)
    weights = np.linalg.solve(normal, error.T[:, :, np.newaxis])
    return np.asarray(columns @ weights)[:, :, 0].T
