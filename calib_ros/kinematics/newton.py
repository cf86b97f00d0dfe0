# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Thousands of small least-squares problems at once, each with its own damping.

Gauss-Newton steps; one that does not lower the cost is rejected and tried again with more damping
(Levenberg 1944, Marquardt 1963). Arrays are laid out (component, problem), as in `jacobian.py`.
`leastsquares.minimise` solves one problem of many rows, whose cost may rise in curved valleys.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from calib_ros.kinematics.se3 import HALF_THE_DIGITS, ROUNDING, ROUNDS, Flags, FloatArray, Index


class NormalBatch(NamedTuple):
    """Normal matrices (n, n, B), downward slopes (n, B) and costs (B,) of problems."""

    matrix: FloatArray
    slope: FloatArray
    cost: FloatArray


class Minimum(NamedTuple):
    """Minima (..., B), costs (B,), and which are settled (B,)."""

    x: FloatArray
    cost: FloatArray
    settled: Flags


def minimise_batch(
    linearise: Callable[[FloatArray, Index], NormalBatch],
    start: FloatArray,
    move: Callable[[FloatArray, FloatArray], FloatArray] = np.add,
    fall: float = 0.0,
    longest: float = np.inf,
    enough: float | None = None,
    rounds: int = ROUNDS,
) -> Minimum:
    """Return the minima from starts (..., B).

    `linearise` gives the normal equations at points (..., K) of the problems with numbers (K,),
    `move` the points after steps (n, K). A problem settles when its step vanishes, or its cost
    changes by a smaller share than `fall`. With `enough`, it settles at that cost instead, and
    damping is by the identity, for shortest steps, from the first one on. It is given up when no
    damping lowers its cost, x is longer than `longest`, or after `rounds` rounds.
    """
    x, active = start, np.arange(start.shape[-1])
    found, settled = start.copy(), np.zeros(active.size, dtype=bool)
    first, least = (1e-6, 1e-12) if enough else (0.0, 1e-3)
    slack = 0.0 if enough else ROUNDING  # the cost determines only half the digits of x
    damping, over = np.full(active.size, first), settled.copy()
    now = linearise(x, active)
    cost = now.cost.copy()
    diagonal = np.diag_indices(len(now.slope))
    for _ in range(rounds):
        matrix = now.matrix.copy()
        matrix[diagonal] += damping * (1.0 if enough else matrix[diagonal])
        step = solve_positive(matrix, now.slope)
        tried = move(x, step)
        small = ~over & (np.abs(step).max(axis=0) <= HALF_THE_DIGITS) & (enough is None)
        far = np.zeros_like(over)
        if longest < np.inf:
            far = ~over & (np.linalg.norm(tried, axis=0) > longest)
        found[..., active] = np.where(small | far, tried, x)
        settled[active[small & ~far]] = True
        going = np.flatnonzero(~(over | small | far))
        active, damping = active[going], damping[going]
        x, tried = x[..., going], tried[..., going]
        if not going.size:
            break
        now = NormalBatch._make(part[..., going] for part in now)
        new = linearise(tried, active)
        taken = new.cost < now.cost * (1.0 + slack)
        still = np.abs(new.cost - now.cost) < fall * now.cost
        x = np.where(taken, tried, x)
        now = NormalBatch._make(np.where(taken, *pair) for pair in zip(new, now, strict=True))
        still |= now.cost <= (enough or 0.0)
        settled[active[still]] = True
        damping = np.where(taken, 0.1 * damping, np.maximum(10.0 * damping, least))
        over = still | (damping > 1e3)
        cost[active] = now.cost
    found[..., active] = x
    return Minimum(found, cost, settled)


def solve_positive(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve positive definite systems (n, n, B) for right hand sides (n, B), by elimination.

    One that is singular by rounding has no finite solution; LAPACK would refuse all of them.
    """
    rows, x = matrix.copy(), right.copy()
    for k in range(len(x) - 1):
        factor = rows[k + 1 :, k] / rows[k, k]
        rows[k + 1 :, k + 1 :] -= factor[:, np.newaxis] * rows[k, np.newaxis, k + 1 :]
        x[k + 1 :] -= factor * x[k]
    for k in reversed(range(len(x))):
        x[k] -= np.einsum('jb,jb->b', rows[k, k + 1 :], x[k + 1 :])
        x[k] /= rows[k, k]
    return x
