# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joint values that bring the target to wanted poses, or one arm to the poses of another.

`solve` takes Newton's steps on the error e = (p_wanted - p, rotation vector from R to R_wanted),
with J = -de/dq by the error model's columns for theta or d of every joint:

    dq = (J^T J + tiny I)^-1 J^T e

is the shortest step that removes e. A `Follower` minimises, with x the change of the joints in
units of the largest that is allowed,

    |e|^2 + x^T D x         step = (J^T J + D)^-1 (J^T e - D x)

D is next to nothing, so that x is the smallest change that reaches the pose, or the best
compromise of an arm that cannot. Samples that would need more than is allowed, as near a
singularity, are damped. With J = sum_k s_k u_k v_k^T at the command, a direction whose share
e_k = u_k^T e of the error would need x_k = e_k / s_k > 1 gets x_k = s_k / e_k, which is what
D = sum_k (e_k^2 - s_k^2) v_k v_k^T does: continuous where damping begins, zero at the singularity
(variable damping after Nakamura and Hanafusa 1986), and exact in all other directions.

Arrays inside are laid out (component, sample), as in `jacobian.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.jacobian import ErrorModel, orientation_error
from calib_ros.kinematics.newton import Minimum, Normal, minimise
from calib_ros.kinematics.se3 import (
    HALF_THE_DIGITS,
    ROUNDING,
    ROUNDS,
    Flags,
    FloatArray,
    Index,
    transform,
)
from calib_ros.kinematics.walk import BLOCK
from calib_ros.progress import Told, nobody
from calib_ros.settings import LEVER as LEVER
from calib_ros.shown import Shown
from calib_ros.values import SAME


@dataclass(frozen=True, eq=False)
class Inverse:
    """Joint values (N, n) [rad or m] for wanted poses, within the limits, and what is left.

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
    part : slice
        What counts of the position and the rotation in world axes, six in all.
    iterations : int
        Steps at most.
    lever : float
        Metres that a radian counts, where not both can be reached.

    """
    aim = Aim(chain, base, tool)
    positions = np.ascontiguousarray(poses[:, :3, 3].T)
    axes = np.ascontiguousarray(poses[:, :3, :3].transpose(2, 1, 0))

    def linearise(q: FloatArray, which: Index) -> Normal:
        error, columns = aim.linearise(q, None, positions[:, which], axes[..., which], lever)
        error, columns = error[part], columns[:, part]
        normal = np.einsum('ikb,jkb->ijb', columns, columns)
        normal[np.diag_indices(len(q))] += ROUNDING
        slope = np.einsum('ikb,kb->ib', columns, error)
        return Normal(normal, slope, np.einsum('kb,kb->b', error, error))

    def within(q: FloatArray, step: FloatArray | float) -> FloatArray:
        return _within(chain, q + step)

    begin = within(np.array(start, dtype=float).T, 0.0)
    q = minimise(linearise, begin, within, enough=SAME**2, rounds=iterations).x
    error, _ = aim.linearise(q, None, positions, axes, lever)
    apart, turned = (np.linalg.norm(part, axis=0) for part in (error[:3], error[3:] / lever))
    return Inverse(q.T, apart, turned, np.linalg.norm(error[part], axis=0) <= SAME)


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
        count, step = len(q), 1e-6  # right to 1e-9 of what effects add
        moved = np.repeat(q[:, np.newaxis], count + 1, axis=1)  # the last as it is
        moved[np.arange(count), np.arange(count)] += step
        came = None if approach is None else np.tile(approach, count + 1)
        found = self._chain.effective(moved.reshape(count, -1), came).reshape(moved.shape)
        return np.asarray((found[:, :-1] - found[:, -1:]) / step)


def limits(chain: Chain) -> tuple[FloatArray, FloatArray]:
    """Return the lower and the upper limits (n,) of the joints [rad or m], infinite if none."""
    ends = [(joint.lower, joint.upper) for joint in chain.joints]
    return (
        np.array([-np.inf if lower is None else lower for lower, _ in ends]),
        np.array([np.inf if upper is None else upper for _, upper in ends]),
    )


@dataclass(frozen=True, eq=False, repr=False)
class Solution(Shown):
    """Changes (N, n) to be added to commands [rad or m], and the errors with and without them.

    Errors (N,) of `position` [m] and `orientation` [rad] remain, those `before` are without a
    change. `iterations` are those of the slowest sample. Joints `limited` (N, n) are held at a
    limit; samples `damped` (N,) are changed in part, as the full change would exceed the largest.
    """

    change: FloatArray
    position: FloatArray
    orientation: FloatArray
    position_before: FloatArray
    orientation_before: FloatArray
    iterations: int
    converged: Flags
    limited: Flags
    damped: Flags


def mobility(chain: Chain) -> int:
    """Return how many freedoms of its flange an arm controls, 6 at most."""
    model = ErrorModel(chain, [joint.driven for joint in chain.joints])
    jacobian = model.jacobian(chain.random_joints(10, np.random.default_rng(0)))
    return int(np.linalg.matrix_rank(jacobian, 1e-6).max())


class Follower:
    """Joint changes with which the `follower` arm reaches the poses of the `leader`.

    `lower` and `upper` (n,) are the limits of the leader's joints. An arm is `complete` when it
    can reach every position and orientation nearby.

    Parameters
    ----------
    leader, follower : Chain
        Arms with the same joints. Their base and tool frames are left aside.
    tool : three floats
        The point [m] in the flange frame whose position counts.
    unit : (n,)
        Largest change of each joint [rad or m].
    weight : float, optional
        Metres that a radian counts.

    """

    def __init__(
        self,
        leader: Chain,
        follower: Chain,
        tool: Sequence[float],
        unit: FloatArray,
        weight: float | None,
    ) -> None:
        point = Frame(transform(np.eye(3), np.array(tool, dtype=np.float64)))
        self._leader, self._follower = (
            replace(chain, base=Frame(), tool=point) for chain in (leader, follower)
        )
        self._aim = Aim(self._follower)
        self._unit = unit[:, np.newaxis]
        self.lower, self.upper = limits(leader)
        freedoms = mobility(leader)
        self.complete = freedoms == 6
        self._weight = weight or (LEVER if self.complete else 1e-3)  # as `Limits` promises
        self._first_weight = LEVER if self.complete else self._weight
        # where more joints than freedoms make J^T J singular, D stands above its rounding
        ridge = ROUNDING if len(unit) > freedoms else HALF_THE_DIGITS**2
        self._ridge = ridge * np.eye(len(unit))[:, :, np.newaxis]

    def solve(
        self,
        joints: FloatArray,
        approach: FloatArray | None = None,
        bounded: bool = True,
        told: Told = nobody,
    ) -> Solution:
        """Return the changes for commands (N, n), within the limits of the joints if bounded.

        `told` is called with the share that is done.
        """
        parts = []
        for start in range(0, len(joints), BLOCK):
            rows = slice(start, start + BLOCK)
            came = None if approach is None else np.ascontiguousarray(approach[rows].T)
            parts.append(self._solve_block(np.ascontiguousarray(joints[rows].T), came, bounded))
            told(min(1.0, rows.stop / len(joints)))
        names = [each.name for each in fields(Solution)]
        found = {name: [getattr(part, name) for part in parts] for name in names}
        iterations = max(found.pop('iterations'))
        joined = {name: np.concatenate(arrays) for name, arrays in found.items()}
        return Solution(iterations=iterations, **joined)

    def _solve_block(self, q: FloatArray, approach: FloatArray | None, bounded: bool) -> Solution:
        """Solve for commands (n, B).

        A joint that would go beyond a limit is held there, and the others do without it.
        """
        axes, origin = self._leader.trace(self._leader.effective(q, approach))
        nothing = np.zeros_like(q)
        task = _Task(q, approach, axes, origin, nothing.astype(bool), nothing)
        before = self._errors(task, task.start)
        x, errors, converged, damped, iterations = self._attempt(task)
        lower, upper = (((end - q.T).T / self._unit) for end in (self.lower, self.upper))
        while bounded:
            beyond = ~task.held & ((x < lower) | (x > upper))
            rest = np.flatnonzero(beyond.any(axis=0))
            if not rest.size:
                break
            held = task.held | beyond
            task = task._replace(held=held, start=np.where(held, np.clip(x, lower, upper), 0.0))
            x[:, rest], errors[rest], converged[rest], damped[rest], more = self._attempt(
                task.select(rest)
            )
            iterations += more
        return Solution(
            (self._unit * x).T,
            *(errors[:, 0], errors[:, 1], before[:, 0], before[:, 1]),
            *(iterations, converged, task.held.T, damped),
        )

    def _attempt(self, task: _Task) -> tuple[FloatArray, FloatArray, Flags, Flags, int]:
        """Return x (n, B), errors (B, 2), what converged and is damped (B,), and the iterations.

        Where the first attempt fails the weight of the orientation makes the compromise.
        """
        x, _, converged, iterations = self._minimise(task, self._ridge, self._first_weight)
        errors = self._errors(task, x)
        damped = np.zeros_like(converged)
        rest = np.flatnonzero(
            ~converged | (self.complete & (errors > HALF_THE_DIGITS).any(axis=1))
        )
        if rest.size:
            part = task.select(rest)
            stiffness, damped[rest] = self._stiffness(part)
            x[:, rest], _, converged[rest], more = self._minimise(
                part, stiffness, self._weight, settle=True
            )
            errors[rest] = self._errors(part, x[:, rest])
            iterations += more
        return x, errors, converged, damped, iterations

    def _minimise(
        self, task: _Task, stiffness: FloatArray, weight: float, settle: bool = False
    ) -> Minimum:
        """Minimise |e|^2 + x^T D x, the cost.

        Samples settle for a cost that does not fall any more if told so; else they are given up
        when x is longer than 1.
        """
        stiffness = np.broadcast_to(stiffness, (*stiffness.shape[:2], len(task.q[0])))

        def linearise(x: FloatArray, which: Index) -> Normal:
            some, soft = task.select(which), stiffness[..., which]
            error, columns = self._linearise(some, x, weight)
            pull = np.einsum('ijb,jb->ib', soft, x)
            slope = np.where(some.held, 0.0, np.einsum('ikb,kb->ib', columns, error) - pull)
            cost = np.einsum('kb,kb->b', error, error) + np.einsum('ib,ib->b', x, pull)
            return Normal(np.einsum('ikb,jkb->ijb', columns, columns) + soft, slope, cost)

        fall, longest = (ROUNDING, np.inf) if settle else (0.0, 1.0)
        return minimise(linearise, task.start, fall=fall, longest=longest, rounds=ROUNDS)

    def _linearise(
        self, task: _Task, x: FloatArray, weight: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the weighted error (6, B), and what x changes of the pose (n, 6, B)."""
        q = task.q + self._unit * x
        error, columns = self._aim.linearise(q, task.approach, task.origin, task.axes, weight)
        columns *= self._unit[:, np.newaxis] * ~task.held[:, np.newaxis]
        return error, columns

    def _stiffness(self, task: _Task) -> tuple[FloatArray, Flags]:
        """Return D (n, n, B) against too large changes, and which samples (B,) it damps."""
        error, columns = self._linearise(task, task.start, self._weight)
        left, values, right = np.linalg.svd(columns.transpose(2, 1, 0), full_matrices=False)
        share = np.einsum('bik,ib->bk', left, error)
        added = np.maximum(share**2 - values**2, 0.0)
        stiffness = np.einsum('bki,bk,bkj->ijb', right, added, right)
        return stiffness + self._ridge, (added > 0.0).any(axis=1)

    def _errors(self, task: _Task, x: FloatArray) -> FloatArray:
        """Return the lengths (B, 2) of position [m] and orientation error [rad]."""
        q = task.q + self._unit * x
        axes, origin = self._follower.trace(self._follower.effective(q, task.approach))
        errors = np.stack([task.origin - origin, orientation_error(task.axes, axes)])
        return np.asarray(np.sqrt(np.einsum('kib,kib->bk', errors, errors)))


class _Task(NamedTuple):
    """Samples to solve: commands (n, B), wanted axes (3, 3, B) and origins (3, B).

    Joints that are `held` (n, B) keep the x that they have at the `start` (n, B).
    """

    q: FloatArray
    approach: FloatArray | None
    axes: FloatArray
    origin: FloatArray
    held: Flags
    start: FloatArray

    def select(self, index: Index) -> _Task:
        """Return some of the samples."""
        return _Task._make(None if each is None else each[..., index] for each in self)
