# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joint values at which one arm reaches the poses of another (docs/compensation.md).

A `Follower` minimises, with x the change of the joints in units of the largest allowed one and
e, J the error and its derivative as in `inverse.py`,

    |e|^2 + x^T D x         step = (J^T J + D)^-1 (J^T e - D x)

D is negligible, so that x is the smallest change that reaches the pose, or the best compromise.
Samples that need more than is allowed, as near a singularity, are damped. With
J = sum_k s_k u_k v_k^T at the command, a direction whose share e_k = u_k^T e of the error needs
x_k = e_k / s_k > 1 gets x_k = s_k / e_k by D = sum_k (e_k^2 - s_k^2) v_k v_k^T: continuous where
damping begins, zero at the singularity (variable damping after Nakamura and Hanafusa 1986), and
exact in all other directions.

The errors of an arm let it move a little in directions in which it cannot by design, as out of the
plane of parallel joints. Steps of thousandths would take joint moves of radians, so |e|^2 counts
only directions in which the leader moves: of the position if it does not move in all three, and of
the orientation too if the arm has redundant joints.

Arrays inside are laid out (component, sample), as in `jacobian.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.inverse import Aim
from calib_ros.kinematics.jacobian import orientation_error
from calib_ros.kinematics.limits import limits
from calib_ros.kinematics.newton import Minimum, NormalBatch, minimise_batch
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, ROUNDING, Flags, FloatArray, Index, transform
from calib_ros.kinematics.walk import BLOCK
from calib_ros.progress import Notify, quiet
from calib_ros.settings import LEVER, LEVER_IN_PART
from calib_ros.shown import Shown
from calib_ros.values import SAME

BY_DESIGN = 0.01
"""Share of the largest motion that counts as designed: supplied arms have at least 0.05 in every
direction, errors of arms add thousandths."""


@dataclass(frozen=True, eq=False, repr=False)
class Solution(Shown):
    """Changes (N, n) to add to commands [rad or m], and the errors with and without them.

    Errors (N,) of `position` [m] and `orientation` [rad] remain, those `before` are without the
    change; `reachable` (N,) [m] is the remaining position error in directions the arm can move.
    Joints `limited` (N, n) are held at a limit; samples `damped` (N,) are changed in part, because
    the full change would exceed the largest.
    """

    change: FloatArray
    position: FloatArray
    orientation: FloatArray
    reachable: FloatArray
    position_before: FloatArray
    orientation_before: FloatArray
    converged: Flags
    limited: Flags
    damped: Flags


def mobility(chain: Chain) -> tuple[int, int, int]:
    """Return the number of freedoms of pose, position and orientation that an arm controls."""
    q = chain.random_joints(10, np.random.default_rng(0)).T
    jacobian = _columns(chain, q).transpose(2, 1, 0)
    for part in (jacobian[:, :3], jacobian[:, 3:]):
        part /= max(float(np.linalg.norm(part, 2, (1, 2)).max()), SAME)
    parts = (jacobian, jacobian[:, :3], jacobian[:, 3:])
    pose, place, turn = (int(np.linalg.matrix_rank(each, BY_DESIGN).max()) for each in parts)
    return pose, place, turn


def _columns(chain: Chain, q: FloatArray, approach: FloatArray | None = None) -> FloatArray:
    """Return the derivative of the pose by the joints (n, 6, B) at joint values (n, B)."""
    axes, origin = chain.trace(q, approach)
    return Aim(chain).linearise(q, approach, origin, axes, LEVER)[1]


class Follower:
    """Joint changes with which the `follower` arm reaches the poses of the `leader`.

    Of the `tool` point [m] in the flange frame; base and tool frames of the arms are ignored.
    `unit` (n,) [rad or m] is the largest change of each joint, `weight` the metres per radian.
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
        freedoms, *self._ranks = mobility(self._leader)
        self.complete, self.anywhere = freedoms == 6, self._ranks[0] == 3
        self._weight = weight or (LEVER if self.complete else LEVER_IN_PART)
        self._first_weight = LEVER if self.complete else self._weight
        # redundant joints make J^T J singular: D must exceed its rounding
        redundant = len(unit) - len(leader.held) > freedoms
        ridge = ROUNDING if redundant else HALF_THE_DIGITS**2
        self._ridge = ridge * np.eye(len(unit))[:, :, np.newaxis]
        if not redundant:
            self._ranks[1] = 3  # no redundant joint: any orientation counts

    def solve(
        self,
        joints: FloatArray,
        approach: FloatArray | None = None,
        bounded: bool = True,
        progress: Notify = quiet,
    ) -> Solution:
        """Return the changes for commands (N, n), within the joint limits if `bounded`."""
        parts = []
        for start in range(0, len(joints), BLOCK):
            rows = slice(start, start + BLOCK)
            signs = None if approach is None else np.ascontiguousarray(approach[rows].T)
            parts.append(self._solve_block(np.ascontiguousarray(joints[rows].T), signs, bounded))
            progress(min(1.0, rows.stop / len(joints)))
        names = [each.name for each in fields(Solution)]
        joined = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
        return Solution(*joined)

    def _solve_block(self, q: FloatArray, approach: FloatArray | None, bounded: bool) -> Solution:
        """Solve for commands (n, B); hold joints beyond a limit there and solve the rest again."""
        axes, origin = self._leader.trace(q, approach)
        never = np.zeros(q.shape, dtype=bool)
        never[list(self._leader.held)] = True
        ways = self._ways(q, approach)
        task = _Task(q, approach, axes, origin, ways, never, np.zeros_like(q))
        before = self._errors(task, task.start)
        x, errors, converged, damped = self._attempt(task)
        lower, upper = (((end - q.T).T / self._unit) for end in (self.lower, self.upper))
        while bounded:
            beyond = ~task.held & ((x < lower) | (x > upper))
            rest = np.flatnonzero(beyond.any(axis=0))
            if not rest.size:
                break
            held = task.held | beyond
            task = task._replace(held=held, start=np.where(held, np.clip(x, lower, upper), 0.0))
            again = self._attempt(task.select(rest))
            x[:, rest], errors[rest], converged[rest], damped[rest] = again
        limited = (task.held & ~never).T
        found = (*errors.T, *before.T[:2], converged, limited, damped)
        return Solution((self._unit * x).T, *found)

    def _attempt(self, task: _Task) -> tuple[FloatArray, FloatArray, Flags, Flags]:
        """Return x (n, B), errors (B, 3), convergence and damping (B,).

        If the first attempt fails, the weight of the orientation decides the compromise.
        """
        x, _, converged = self._minimise(task, self._ridge, self._first_weight)
        errors = self._errors(task, x)
        damped = np.zeros_like(converged)
        rest = np.flatnonzero(
            ~converged | (self.complete & (errors > HALF_THE_DIGITS).any(axis=1))
        )
        if rest.size:
            part = task.select(rest)
            stiffness, damped[rest] = self._stiffness(part)
            x[:, rest], _, converged[rest] = self._minimise(
                part, stiffness, self._weight, settle=True
            )
            errors[rest] = self._errors(part, x[:, rest])
        return x, errors, converged, damped

    def _minimise(
        self, task: _Task, stiffness: FloatArray, weight: float, settle: bool = False
    ) -> Minimum:
        """Minimise |e|^2 + x^T D x; without `settle`, samples with |x| > 1 are given up."""
        stiffness = np.broadcast_to(stiffness, (*stiffness.shape[:2], len(task.q[0])))

        def linearise(x: FloatArray, which: Index) -> NormalBatch:
            some, soft = task.select(which), stiffness[..., which]
            error, columns = self._linearise(some, x, weight)
            pull = np.einsum('ijb,jb->ib', soft, x)
            slope = np.where(some.held, 0.0, np.einsum('ikb,kb->ib', columns, error) - pull)
            cost = np.einsum('kb,kb->b', error, error) + np.einsum('ib,ib->b', x, pull)
            return NormalBatch(np.einsum('ikb,jkb->ijb', columns, columns) + soft, slope, cost)

        fall, longest = (ROUNDING, np.inf) if settle else (0.0, 1.0)
        return minimise_batch(linearise, task.start, fall=fall, longest=longest)

    def _linearise(
        self, task: _Task, x: FloatArray, weight: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the weighted error (6, B), and its derivative by x (n, 6, B)."""
        q = task.q + self._unit * x
        error, columns = self._aim.linearise(q, task.approach, task.origin, task.axes, weight)
        columns *= self._unit[:, np.newaxis] * ~task.held[:, np.newaxis]
        if task.ways is not None:
            error = np.einsum('jkb,kb->jb', task.ways, error)
            columns = np.einsum('jkb,ikb->ijb', task.ways, columns)
        return error, columns

    def _ways(self, q: FloatArray, approach: FloatArray | None) -> FloatArray | None:
        """Return projections (6, 6, B) of errors onto the motion of the leader; None for all."""
        if self._ranks == [3, 3]:
            return None
        columns = _columns(self._leader, q, approach)
        found = np.zeros((6, 6, len(q[0])))
        for rank, part in zip(self._ranks, (slice(0, 3), slice(3, 6)), strict=True):
            moved = np.linalg.svd(columns[:, part].transpose(2, 1, 0))[0][:, :, :rank]
            found[part, part] = np.einsum('bik,bjk->ijb', moved, moved)
        return found

    def _stiffness(self, task: _Task) -> tuple[FloatArray, Flags]:
        """Return D (n, n, B) against too large changes, and which samples (B,) it damps."""
        error, columns = self._linearise(task, task.start, self._weight)
        left, values, right = np.linalg.svd(columns.transpose(2, 1, 0), full_matrices=False)
        share = np.einsum('bik,ib->bk', left, error)
        added = np.maximum(share**2 - values**2, 0.0)
        stiffness = np.einsum('bki,bk,bkj->ijb', right, added, right)
        return stiffness + self._ridge, (added > 0.0).any(axis=1)

    def _errors(self, task: _Task, x: FloatArray) -> FloatArray:
        """Return position [m], orientation [rad] and reachable position errors (B, 3)."""
        axes, origin = self._follower.trace(task.q + self._unit * x, task.approach)
        away = near = task.origin - origin
        if task.ways is not None:
            near = np.einsum('jkb,kb->jb', task.ways[:3, :3], away)
        errors = np.stack([away, orientation_error(task.axes, axes), near])
        return np.asarray(np.sqrt(np.einsum('kib,kib->bk', errors, errors)))


class _Task(NamedTuple):
    """Samples to solve: commands (n, B), wanted axes (3, 3, B) and origins (3, B).

    `ways` (6, 6, B) project errors on those that count; None keeps all. Joints `held` (n, B) keep
    the x of `start` (n, B).
    """

    q: FloatArray
    approach: FloatArray | None
    axes: FloatArray
    origin: FloatArray
    ways: FloatArray | None
    held: Flags
    start: FloatArray

    def select(self, index: Index) -> _Task:
        return _Task._make(None if each is None else each[..., index] for each in self)
