# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics.

`solve` takes Newton steps on the error e = (p_wanted - p, rotation vector from R to R_wanted),
with J = -de/dq from the error model's columns for theta or d of every joint:

    dq = (J^T J + tiny I)^-1 J^T e

is the shortest step that removes e. Arrays inside are laid out (component, sample), as in
`jacobian.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel, orientation_error
from calib_ros.kinematics.limits import limits
from calib_ros.kinematics.newton import NormalBatch, minimise_batch
from calib_ros.kinematics.se3 import ROUNDING, ROUNDS, Flags, FloatArray, Index
from calib_ros.settings import LEVER
from calib_ros.values import SAME


@dataclass(frozen=True, eq=False)
class Inverse:
    """Joint values (N, n) [rad or m] for wanted poses, within the limits, and their errors.

    `position` (N,) [m] and `orientation` (N,) [rad] are the distances to the wanted poses. Those
    not `converged` (N,) are out of reach, or need another start.
    """

    joints: FloatArray
    position: FloatArray
    orientation: FloatArray
    converged: Flags


def solve(
    chain: Chain,
    poses: FloatArray,
    start: FloatArray,
    base: str = 'base',
    tool: str = 'tool',
    part: slice = slice(6),
    iterations: int = ROUNDS,
    lever: float = LEVER,
    enough: float = SAME,
) -> Inverse:
    """Return the joint values near a start (N, n) that bring the target to poses (N, 4, 4).

    `part` are the components to reach, of position and rotation in world axes, six in all; a
    radian counts as `lever` [m], if not both can be reached. Errors of `enough` [m] count as none.
    """
    aim = Aim(chain, base, tool)
    positions = np.ascontiguousarray(poses[:, :3, 3].T)
    axes = np.ascontiguousarray(poses[:, :3, :3].transpose(2, 1, 0))

    def linearise(q: FloatArray, which: Index) -> NormalBatch:
        turns = lever if part.stop > 3 else 0.0
        error, columns = aim.linearise(q, None, positions[:, which], axes[..., which], turns)
        error, columns = error[part], columns[:, part]
        normal = np.einsum('ikb,jkb->ijb', columns, columns)
        normal[np.diag_indices(len(q))] += ROUNDING
        slope = np.einsum('ikb,kb->ib', columns, error)
        return NormalBatch(normal, slope, np.einsum('kb,kb->b', error, error))

    lower, upper = (end[:, np.newaxis] for end in limits(chain))
    turn = np.array([[2.0 * np.pi * (joint.type == 'revolute')] for joint in chain.joints])

    def within(q: FloatArray, step: FloatArray | float) -> FloatArray:
        """Move joint values (n, B) into the limits, by a full turn if possible."""
        q = q + step
        q = np.where((q > upper) & (q - turn >= lower), q - turn, q)
        q = np.where((q < lower) & (q + turn <= upper), q + turn, q)
        return np.clip(q, lower, upper)

    begin = within(np.array(start, dtype=float).T, 0.0)
    q = minimise_batch(linearise, begin, within, enough=enough**2, rounds=iterations).x
    error, _ = aim.linearise(q, None, positions, axes, lever)
    apart, turned = (np.linalg.norm(part, axis=0) for part in (error[:3], error[3:] / lever))
    return Inverse(q.T, apart, turned, np.linalg.norm(error[part], axis=0) <= enough)


class Aim:
    """Errors of an arm's target from wanted poses, and their derivatives by the joints."""

    def __init__(self, chain: Chain, base: str = 'base', tool: str = 'tool') -> None:
        self._chain = chain
        self._model = ErrorModel(chain, [joint.driven for joint in chain.joints], base, tool)
        self._signs = np.array([float(joint.sign) for joint in chain.joints])[:, None, None]

    def linearise(
        self,
        q: FloatArray,
        approach: FloatArray | None,
        positions: FloatArray,
        axes: FloatArray,
        lever: float,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the error (6, B), and the derivative of the pose by the joints (n, 6, B).

        At joint values (n, B), approached with signs (n, B), for wanted positions (3, B) [m] and
        axes (3, 3, B), whose first index counts them; a radian counts as `lever` [m].
        """
        found, origin, *moved = self._model.linearise(q, approach)
        columns = self._model.twists(*moved)
        columns *= self._signs
        columns[:, 3:] *= lever
        if self._chain.effects or self._chain.held:
            columns = np.einsum('jib,jkb->ikb', self._effects_slope(q), columns)
        turned = lever * orientation_error(axes, found) if lever else np.zeros_like(origin)
        return np.concatenate([positions - origin, turned]), columns

    def _effects_slope(self, q: FloatArray) -> FloatArray:
        """Return the derivative (n, n, B) of effective by reported joint values."""
        count, step = len(q), 1e-6  # accurate to 1e-9 of the effects
        moved = np.repeat(q[:, np.newaxis], count + 1, axis=1)  # the last unchanged
        moved[np.arange(count), np.arange(count)] += step
        found = self._chain.effective(moved.reshape(count, -1)).reshape(moved.shape)
        return np.asarray((found[:, :-1] - found[:, -1:]) / step)
