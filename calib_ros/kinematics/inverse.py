# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joint values that bring the target to wanted poses, for any chain.

Newton's method on the error e = (p_wanted - p, rotation vector from R to R_wanted), with
J = -de/dq by the error model's columns (`jacobian.py`) for theta or d of every joint. The step

    dq = (J^T J + lambda I)^-1 J^T e

is the shortest one that removes e (redundant arms). It is damped (Levenberg 1944, Marquardt 1963)
until it lowers |e|, as near singular configurations.

Arrays are laid out (component, sample), as in `jacobian.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel, orientation_error
from calib_ros.kinematics.se3 import ROUNDS, FloatArray
from calib_ros.values import SAME

LEVER = 0.3
"""Length [m] at which a turn counts as much as a shift."""
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
    part: slice = slice(6),
    iterations: int = ROUNDS,
) -> Inverse:
    """Return the joint values near a start that bring the target to wanted poses.

    Thousands of small problems at once, each with its own damping.

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
    part : slice
        What counts of the position and the rotation in world axes, six in all.
    iterations : int
        Steps at most.

    """
    aim = Aim(chain, base, tool)
    positions = np.ascontiguousarray(poses[:, :3, 3].T)
    axes = np.ascontiguousarray(poses[:, :3, :3].transpose(2, 1, 0))

    def missed(q: FloatArray, which: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
        error, columns = aim.linearise(q, None, positions[:, which], axes[..., which], LEVER)
        return error[part], columns[:, part], np.linalg.norm(error[part], axis=0)

    q = _within(chain, np.array(start, dtype=float).T)
    error, columns, size = missed(q, slice(None))
    least, first, most = DAMPING
    damping = np.full(len(poses), first)
    diagonal = np.diag_indices(len(q))
    for _ in range(iterations):
        (active,) = np.nonzero((size > SAME) & (damping < most))
        if not active.size:
            break
        own = columns[:, :, active]
        normal = np.einsum('ikb,jkb->ijb', own, own)
        normal[diagonal] += damping[active]
        slope = np.einsum('ikb,kb->ib', own, error[:, active])
        tried = _within(chain, q[:, active] + solve_positive(normal, slope))
        new_error, new_columns, new_size = missed(tried, active)
        better = new_size < size[active]
        damping[active] = np.maximum(damping[active] * np.where(better, 0.1, 10.0), least)
        moved = active[better]
        q[:, moved], error[:, moved] = tried[:, better], new_error[:, better]
        columns[:, :, moved], size[moved] = new_columns[:, :, better], new_size[better]
    apart, turned = (np.linalg.norm(part, axis=0) for part in (error[:3], error[3:] / LEVER))
    return Inverse(q.T, apart, turned, size <= SAME)


def _within(chain: Chain, q: FloatArray) -> FloatArray:
    """Bring joint values (n, B) into the limits, by a full turn where that helps."""
    lower, upper = (end[:, np.newaxis] for end in limits(chain))
    turns = np.array([[2.0 * np.pi * (joint.type == 'revolute')] for joint in chain.joints])
    q = np.where((q > upper) & (q - turns >= lower), q - turns, q)
    q = np.where((q < lower) & (q + turns <= upper), q + turns, q)
    return np.clip(q, lower, upper)


class Aim:
    """How far the target of an arm is from wanted poses, and what the joints change of it."""

    def __init__(self, chain: Chain, base: str = 'base', tool: str = 'tool') -> None:
        self._chain = chain
        self._model = ErrorModel(chain, [joint.driven for joint in chain.joints], base, tool)
        self._signs = np.array([float(joint.sign) for joint in chain.joints])[:, None, None]
        kinds = [joint.type for joint in chain.joints]
        self._turning = np.flatnonzero([kind == 'revolute' for kind in kinds])

    def linearise(
        self,
        q: FloatArray,
        approach: FloatArray | None,
        positions: FloatArray,
        axes: FloatArray,
        lever: float,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the error (6, B), and what the joints change of the pose (n, 6, B).

        Parameters
        ----------
        q : (n, B)
            Joint values [rad or m].
        approach : (n, B), optional
            Signs of the velocities before, for backlash.
        positions, axes : (3, B), (3, 3, B)
            Wanted positions [m], and wanted axes; the first index counts them.
        lever : float
            Metres that a radian counts.

        """
        model, turning = self._model, self._turning
        found, origin, shift, turn = model.linearise(q, approach)
        columns = np.zeros((len(q), 6, q.shape[1]))
        columns[:, :3] = self._signs * shift[model.order]
        columns[turning, 3:] = lever * self._signs[turning] * turn[model.order[turning]]
        if self._chain.effects:
            columns = np.einsum('jib,jkb->ikb', self._effects_slope(q, approach), columns)
        turned = lever * orientation_error(axes, found)
        return np.concatenate([positions - origin, turned]), columns

    def _effects_slope(self, q: FloatArray, approach: FloatArray | None) -> FloatArray:
        """Return the derivative (n, n, B) of the effective joint values by those reported."""
        here = self._chain.effective(q, approach)
        slope, step = np.empty((len(q), *q.shape)), 1e-6  # right to 1e-9 of what effects add
        for k in range(len(q)):
            moved = q.copy()
            moved[k] += step
            slope[:, k] = (self._chain.effective(moved, approach) - here) / step
        return slope


def limits(chain: Chain) -> tuple[FloatArray, FloatArray]:
    """Return the lower and the upper limits (n,) of the joints [rad or m], infinite if none."""
    ends = [(joint.lower, joint.upper) for joint in chain.joints]
    return (
        np.array([-np.inf if lower is None else lower for lower, _ in ends]),
        np.array([np.inf if upper is None else upper for _, upper in ends]),
    )


def solve_positive(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve positive definite systems (n, n, B) for right hand sides (n, B), by elimination."""
    rows, x = matrix.copy(), right.copy()
    for k in range(len(x) - 1):
        factor = rows[k + 1 :, k] / rows[k, k]
        rows[k + 1 :, k + 1 :] -= factor[:, np.newaxis] * rows[k, np.newaxis, k + 1 :]
        x[k + 1 :] -= factor * x[k]
    for k in reversed(range(len(x))):
        x[k] -= np.einsum('jb,jb->b', rows[k, k + 1 :], x[k + 1 :])
        x[k] /= rows[k, k]
    return x
