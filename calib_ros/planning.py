# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which poses to measure, and how accurate the arm will be by them, before any is measured.

A pose adds A^T A to the information M about the parameters, with A (m, P) its rows of the weighted
Jacobian: 6 by full pose, 3 by position. Neither needs a measured value. With C = M^-1

    d       ln det(M + A^T A) - ln det M = ln det(I + A C A^T)          (O1, Borm and Menq 1991)
    task    tr V C - tr V (M + A^T A)^-1 = tr (I + A C A^T)^-1 A C V C A^T
            with V the mean of J^T J over the poses of a task: tr V C is the mean squared error
    o2-o5   observability indices (`identifiability.observability`), from eigenvalues

so that a pose is judged by a matrix of m x m. Poses are chosen one by one, the best first, and
then exchanged one by one while that helps (Fedorov 1972, Mitchell 1974). The indices o2 to o5
say nothing while M is singular: there the choice by `d` is where exchanges start.

Columns are taken in coordinates in which the candidates weigh one on average. `d` and `task` do
not depend on coordinates, and rounding then treats all parameters alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from calib_ros import se3
from calib_ros.chain import Chain, Frame
from calib_ros.differential import ErrorModel
from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.identifiability import independent, structurally_independent
from calib_ros.identification import Identification
from calib_ros.observations import STILL
from calib_ros.problem import Problem
from calib_ros.se3 import FloatArray

Criterion: TypeAlias = Literal['d', 'o2', 'o3', 'o4', 'o5', 'task']
CRITERIA: tuple[Criterion, ...] = get_args(Criterion)
Score: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]
"""Returns the worth (N,) of candidates from information (P, P) and their rows (N, m, P)."""

ASSUMED_TOOL = (0.1, 0.1, 0.1)
"""Where the target is taken to be [m] in the flange's frame when nothing is known about it."""
RIDGE = 1e-9
"""Information about everything, in that of an average candidate, that keeps M invertible."""
UNDETERMINED = 1e-7
"""A direction of the parameters with less, in the same unit, is not determined."""
SWEEPS = 20
"""Most rounds of exchanges."""
GAIN = 1e-9
"""Least relative gain of an exchange."""
MOST_DRAWS = 1000
"""Draws per candidate after which a measurable region is said to be out of reach."""
RANDOM_DRAWS = 25
"""Random choices that a plan is compared with."""


@dataclass(frozen=True, eq=False)
class Design:
    """What is to be identified, how it will be measured, and what is known about it already.

    Parameters
    ----------
    chain : Chain
        The point of linearisation. The base frame has no influence, the tool has.
    names : tuple of str
        P parameters to identify, without gauge freedoms.
    sigma_position, sigma_orientation : float, float or None
        Of a measured pose [m, rad]; None when only positions are measured.
    known : (R, P)
        Rows of information that is there already, in sigma: priors, poses taken.
    base, tool : str
        Frames of the chain that hold for the poses to come.

    """

    chain: Chain
    names: tuple[str, ...]
    sigma_position: float
    sigma_orientation: float | None
    known: FloatArray
    base: str = 'base'
    tool: str = 'tool'

    @classmethod
    def of(cls, problem: Problem, result: Identification | None = None) -> Design:
        """Return the design of a problem: nothing but the priors is known yet.

        With the result of an identification that is known as well, and poses to come have the
        noise that it found. Measured values do not count otherwise: `simulation.measure` can make
        the observations of a problem before anything is measured.

        Raises
        ------
        InputError
            When neither poses nor positions are measured.

        """
        kind = problem.kinds[0]
        if kind.distance or problem.separations:
            raise InputError('planning is for measured poses or positions, not for distances')
        model = problem.model
        priors = problem.prior_sigmas
        structural = structurally_independent(model, problem.free, problem.kinds)
        names = tuple(n for n in problem.free if n in structural or n in priors)
        scales = (1.0, 1.0)
        if result is None:
            model = _with_assumed_tool(model, kind.tool)
            known = np.diag([1.0 / priors.get(name, np.inf) for name in names])
        else:
            model = result.chain
            names = (*result.names, *(name for name in names if name not in result.names))
            known = np.zeros((result.rank, len(names)))
            known[:, : result.rank] = _root_of_inverse(result.covariance)
            noise = result.noise
            if not noise.consistent:
                scales = (noise.position, noise.orientation or noise.position)
        return cls(
            chain=model,
            names=names,
            sigma_position=problem.sigma_position * scales[0],
            sigma_orientation=problem.sigma_orientation * scales[1] if kind.oriented else None,
            known=known,
            base=kind.base,
            tool=kind.tool,
        )

    def rows(self, joints: FloatArray) -> FloatArray:
        """Return the rows (N, 6 or 3, P) of information, in sigma, of poses at (N, n)."""
        jacobian = ErrorModel(self.chain, self.names, self.base, self.tool).jacobian(joints)
        jacobian[:, :3] /= self.sigma_position
        if self.sigma_orientation is None:
            return jacobian[:, :3]
        jacobian[:, 3:] /= self.sigma_orientation
        return jacobian

    def after(self, joints: FloatArray) -> Design:
        """Return the design when poses at (N, n) have been measured."""
        rows = self.rows(joints).reshape(-1, len(self.names))
        return replace(self, known=_triangular(np.concatenate([self.known, rows])))

    def determined_by(self, joints: FloatArray) -> Design:
        """Return the design without parameters that not even all poses at (N, n) determine."""
        names = independent(self.after(joints).known, self.names)
        known = self.known[:, [self.names.index(name) for name in names]]
        return replace(self, names=names, known=known)

    def targets(self, joints: FloatArray) -> FloatArray:
        """Return the target's poses (N, 4, 4) in the world at (N, n)."""
        return self.chain.forward(joints, base=self.base, tool=self.tool)


def choose(
    design: Design,
    candidates: FloatArray,
    count: int,
    criterion: Criterion = 'd',
    task: FloatArray | None = None,
    apart: float = STILL,
) -> NDArray[np.intp]:
    """Choose the poses to measure.

    Parameters
    ----------
    design : Design
        What is to be identified and what is known about it.
    candidates : (N, n)
        Joint values [rad or m] that the arm may be moved to.
    count : int
        How many of them.
    criterion : Criterion
        What is to be large, by its name.
    task : (T, n), optional
        Joint values at which the arm is to be accurate, for the criterion `task`.
    apart : float
        Least distance of two poses: of the joint that moves most [rad or m].

    Returns
    -------
    (count,)
        Indices of the chosen, the best first: with the first of them alone most is determined.

    Raises
    ------
    InputError
        With fewer candidates than poses, at that distance from each other.

    """
    if count < 1:
        raise ConfigError(f'at least one pose must be chosen, not {count}')
    space = _Candidates(design, candidates)
    score = _score(space, criterion, task)
    first = score if criterion == 'task' else _by_determinant
    pick = _Pick(space, apart)
    for _ in range(count):
        pick.add(pick.best(first))
    for _ in range(SWEEPS):
        if not pick.exchange(score):
            break
    again = _Pick(space, apart)
    for _ in range(count):
        again.add(again.best(first, pick.chosen))
    return np.array(again.chosen)


class _Candidates:
    """Rows (N, m, P) of candidates in coordinates in which they weigh one on average.

    `factor` (P, P) leads back: rows @ factor are in sigma per metre or radian.
    """

    def __init__(self, design: Design, joints: FloatArray) -> None:
        self.joints = joints
        self.design = design.determined_by(joints)
        rows = self.design.rows(joints)
        self.factor = self.design.after(joints).known / np.sqrt(len(rows))
        self._inverse = linalg.solve_triangular(self.factor, np.eye(len(self.factor)))
        self.rows = _times(rows, self._inverse)
        self.known = _information(self.design.known @ self._inverse)

    def of_task(self, task: FloatArray) -> FloatArray:
        """Return V (P, P) [m^2]: tr V C is the mean squared position error at (T, n)."""
        design = self.design
        jacobian = ErrorModel(design.chain, design.names, design.base, design.tool).jacobian(task)
        return _information(_times(jacobian[:, :3], self._inverse)) / len(task)


class _Pick:
    """The candidates chosen so far, and the information that they bring."""

    def __init__(self, space: _Candidates, apart: float) -> None:
        self._joints, self._rows = space.joints, space.rows
        self._start = space.known + RIDGE * np.eye(len(space.known))
        self._apart = apart
        self._near: list[NDArray[np.bool_]] = []
        self._blocked = np.zeros(len(space.rows), dtype=np.intp)
        self.information = self._start
        self.chosen: list[int] = []

    def best(self, score: Score, among: list[int] | None = None) -> int:
        """Return the best candidate that is free to be chosen."""
        worth = np.where(self._blocked > 0, -np.inf, score(self.information, self._rows))
        index = np.arange(len(worth)) if among is None else np.array(among)
        best = int(index[worth[index].argmax()])
        if self._blocked[best]:
            raise InputError(
                f'only {len(self.chosen)} of {len(worth)} candidates are {self._apart:g} apart '
                'from each other: give more candidates, or plan fewer poses'
            )
        return best

    def add(self, index: int, place: int | None = None) -> None:
        """Choose a candidate."""
        near = np.abs(self._joints - self._joints[index]).max(axis=1) <= self._apart
        place = len(self.chosen) if place is None else place
        self.chosen.insert(place, index)
        self._near.insert(place, near)
        self._blocked += near
        self.information = self.information + _information(self._rows[index])

    def exchange(self, score: Score) -> bool:
        """Exchange every chosen candidate for the best one; return whether any was changed."""
        self.information = self._start + _information(self._rows[self.chosen])  # no rounding left
        changed = False
        for place in range(len(self.chosen)):
            old = self.chosen.pop(place)
            self._blocked -= self._near.pop(place)
            self.information = self.information - _information(self._rows[old])
            worth = np.where(self._blocked > 0, -np.inf, score(self.information, self._rows))
            new = int(worth.argmax())
            if worth[new] - worth[old] > GAIN * abs(worth[old]):
                changed = True
            else:
                new = old
            self.add(new, place)
        return changed


def _score(space: _Candidates, criterion: Criterion, task: FloatArray | None) -> Score:
    """Return the score of a criterion."""
    if criterion not in CRITERIA:
        raise UnknownNameError('criterion', criterion, CRITERIA)
    if criterion == 'd':
        return _by_determinant
    if criterion == 'task':
        if task is None:
            raise ConfigError('the criterion "task" needs the poses of a task')
        wanted = space.of_task(task)
        return lambda information, rows: _by_task(information, rows, wanted)
    return lambda information, rows: _by_index(information, rows, criterion, space.factor)


def _by_determinant(information: FloatArray, rows: FloatArray) -> FloatArray:
    """Return ln det(I + A C A^T)."""
    seen = _times(rows, _root(information))
    return np.asarray(np.linalg.slogdet(_with_unit(seen))[1])


def _by_task(information: FloatArray, rows: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return tr (I + A C A^T)^-1 A C V C A^T."""
    root = _root(information)
    seen = _times(rows, root)
    spread = _times(seen, root.T @ wanted @ root) @ np.swapaxes(seen, 1, 2)
    return np.asarray(np.trace(np.linalg.solve(_with_unit(seen), spread), axis1=1, axis2=2))


def _by_index(
    information: FloatArray, rows: FloatArray, criterion: Criterion, factor: FloatArray
) -> FloatArray:
    """Return an observability index of M + A^T A, in sigma per metre or radian."""
    back = _times(rows, factor)
    total = factor.T @ information @ factor + np.swapaxes(back, 1, 2) @ back
    singular = np.sqrt(np.maximum(np.linalg.eigvalsh(total), 1e-300))
    smallest, largest = singular[:, 0], singular[:, -1]
    if criterion == 'o2':
        return np.asarray(smallest / largest)
    if criterion == 'o3':
        return np.asarray(smallest)
    if criterion == 'o4':
        return np.asarray(smallest**2 / largest)
    return np.asarray(1.0 / np.sum(1.0 / singular, axis=1))


def _root(information: FloatArray) -> FloatArray:
    """Return L (P, P) with L L^T = M^-1."""
    lower = linalg.cholesky(information, lower=True)
    return np.asarray(linalg.solve_triangular(lower, np.eye(len(lower)), lower=True).T)


def _with_unit(seen: FloatArray) -> FloatArray:
    """Return I + Y Y^T (N, m, m) of (N, m, P)."""
    return np.asarray(np.eye(seen.shape[1]) + seen @ np.swapaxes(seen, 1, 2))


def _times(rows: FloatArray, matrix: FloatArray) -> FloatArray:
    """Return the product of (N, m, P) and (P, P), which BLAS does in one piece."""
    flat = np.ascontiguousarray(rows).reshape(-1, rows.shape[2]) @ matrix
    return flat.reshape(*rows.shape[:2], -1)


def _information(rows: FloatArray) -> FloatArray:
    """Return the information (P, P) of rows (..., P)."""
    flat = rows.reshape(-1, rows.shape[-1])
    return flat.T @ flat


def _triangular(rows: FloatArray) -> FloatArray:
    """Return R (P, P), upper triangular, with the information of rows (R, P)."""
    size = rows.shape[1]
    padded = np.concatenate([rows, np.zeros((max(0, size - len(rows)), size))])
    return np.asarray(linalg.qr(padded, mode='r')[0])[:size]


def _root_of_inverse(covariance: FloatArray) -> FloatArray:
    """Return rows (P, P) with the information whose inverse is a covariance."""
    std = np.sqrt(np.diag(covariance))
    lower = linalg.cholesky(covariance / np.outer(std, std), lower=True)
    return np.asarray(linalg.solve_triangular(lower, np.diag(1.0 / std), lower=True))


def _with_assumed_tool(chain: Chain, tool: str) -> Chain:
    """Return the chain with its target off the flange's axis, if nothing is known about it.

    On the axis, where a frame of no size would put it, its position hides the last joint.
    """
    if {'tool': chain.tool, **dict(chain.frames)}[tool] is not None:
        return chain
    return chain.with_frame(tool, Frame(se3.transform(np.eye(3), np.array(ASSUMED_TOOL))))


def accuracy(design: Design, joints: FloatArray, task: FloatArray) -> FloatArray:
    """Return the predicted RMS position error (N,) [m] with the first 1, 2, ... N poses.

    At task poses (T, n), from the uncertainty of the parameters alone; infinite while they are
    not all determined. `joints` (N, n) are the poses, in the order in which they are measured.
    """
    space = _Candidates(design, joints)
    if space.design.names != design.names:
        return np.full(len(joints), np.inf)
    each = np.swapaxes(space.rows, 1, 2) @ space.rows
    values, vectors = np.linalg.eigh(space.known + np.cumsum(each, axis=0))
    along = np.einsum('npk,pq,nqk->nk', vectors, space.of_task(task), vectors, optimize=True)
    squares = (along / np.maximum(values, UNDETERMINED)).sum(axis=1)
    return np.where(values[:, 0] < UNDETERMINED, np.inf, np.sqrt(squares))


def efficiency(
    design: Design, candidates: FloatArray, chosen: NDArray[np.intp], task: FloatArray | None
) -> float:
    """Return a lower bound of how good a choice is against the best of as many candidates.

    For the criterion `d`, or `task` with the poses of one, as a share of poses: with 0.9 even the
    best choice would need 90 % of them. Both criteria are convex, and the tangent at the choice
    (Kiefer and Wolfowitz 1960) bounds what the candidates with the steepest slopes would bring.
    """
    space = _Candidates(design, candidates)
    root = _root(space.known + _information(space.rows[chosen]) + RIDGE * np.eye(len(space.known)))
    slope = root @ root.T
    if task is not None:
        slope = slope @ space.of_task(task) @ slope
    each = np.einsum('nmp,nmp->n', _times(space.rows, slope), space.rows)
    start = float(np.sum(slope * space.known))
    steepest = np.sort(each)[-len(chosen) :]
    return float((start + each[chosen].sum()) / (start + steepest.sum()))


@dataclass(frozen=True, eq=False)
class Suggestion:
    """The next pose to measure, and what it brings.

    Attributes
    ----------
    joints : (n,)
        Joint values [rad or m].
    now, then : float
        Predicted RMS position error [m] at the task poses, without and with it; infinite while
        parameters are not determined.
    enough : bool
        Whether the wanted error is reached already.

    """

    joints: FloatArray
    now: float
    then: float
    enough: bool


def next_pose(
    design: Design,
    candidates: FloatArray,
    task: FloatArray,
    wanted: float,
    criterion: Criterion = 'd',
) -> Suggestion:
    """Return the next best pose of candidates (N, n), after those that the design knows.

    `task` (T, n) are poses at which the RMS error of position is to be `wanted` [m].
    """
    index = choose(design, candidates, 1, criterion, task)
    now, then = predicted(design, task), predicted(design.after(candidates[index]), task)
    return Suggestion(candidates[index[0]], now, then, now <= wanted)


def predicted(design: Design, task: FloatArray) -> float:
    """Return the RMS position error [m] at task poses (T, n) predicted by what is known."""
    known = _triangular(design.known)
    if independent(known, design.names) != design.names:
        return float('inf')
    model = ErrorModel(design.chain, design.names, design.base, design.tool)
    rows = model.jacobian(task)[:, :3].reshape(-1, len(design.names))
    return float(
        np.linalg.norm(linalg.solve_triangular(known, rows.T, trans='T')) / len(task) ** 0.5
    )


@dataclass(frozen=True, eq=False)
class Visibility:
    """Where the measuring device sees the target.

    Parameters
    ----------
    box : (2, 3), optional
        Lower and upper corner [m] of the measurable region.
    tracker : (3,), optional
        Where the device stands [m].
    axis : (3,)
        Direction in the target's frame that must point to the device.
    cone : float
        Largest angle [rad] between that axis and the direction to the device.
    world : bool
        Whether box and tracker are given in the world; else they are in the arm's base frame.

    """

    box: FloatArray | None = None
    tracker: FloatArray | None = None
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    cone: float = np.pi / 4.0
    world: bool = False

    def __post_init__(self) -> None:
        """Refuse an empty box and an axis without direction."""
        if self.box is not None and not (self.box[0] < self.box[1]).all():
            raise ConfigError(
                f'the box from {self.box[0].tolist()} to {self.box[1].tolist()} is empty: give '
                'the lower corner first'
            )
        if not np.linalg.norm(self.axis) > 0.0:
            raise ConfigError('the axis of the target must not be 0 0 0')

    def sees(self, design: Design, joints: FloatArray) -> NDArray[np.bool_]:
        """Return (N,) whether the target can be measured at joint values (N, n)."""
        base = {'base': design.chain.base, **dict(design.chain.frames)}[design.base]
        poses = design.targets(joints)
        if not self.world:
            poses = se3.invert(design.chain.frame(design.base).matrix) @ poses
        elif base is None:
            raise ConfigError(
                'the measurable region is given in the world, but the chain file does not say '
                'where the base is: give it in the base frame, or "base" in the chain file'
            )
        position = poses[:, :3, 3]
        seen = np.ones(len(joints), dtype=bool)
        if self.box is not None:
            seen &= ((self.box[0] <= position) & (position <= self.box[1])).all(axis=1)
        if self.tracker is not None:
            sight = self.tracker - position
            axis = poses[:, :3, :3] @ (np.array(self.axis) / np.linalg.norm(self.axis))
            along = np.einsum('ni,ni->n', sight, axis)
            seen &= along >= np.cos(self.cone) * np.linalg.norm(sight, axis=1)
        return seen


def draw_candidates(
    design: Design, count: int, rng: np.random.Generator, visibility: Visibility | None = None
) -> FloatArray:
    """Draw joint values (count, n) within the limits at which the target can be measured.

    Raises
    ------
    InputError
        When hardly any can.

    """
    found = np.zeros((0, len(design.chain.joints)))
    drawn = 0
    while len(found) < count:
        if drawn > MOST_DRAWS * count:
            raise InputError(
                f'the target can be measured at {len(found)} of {drawn} random poses only, '
                f'{count} candidates are wanted: widen box and cone, or give a file of candidates'
            )
        joints = design.chain.random_joints(10 * count, rng)
        drawn += len(joints)
        seen = joints if visibility is None else joints[visibility.sees(design, joints)]
        found = np.concatenate([found, seen])
    return found[:count]


def visit_order(joints: FloatArray, velocities: FloatArray) -> NDArray[np.intp]:
    """Return an order (N,) of visiting configurations (N, n) that takes little time.

    The time of a move is that of the joint which takes longest, at `velocities` (n,) [rad/s or
    m/s]. Nearest neighbour from the configuration that lies farthest out, then parts of the way
    are turned round while that shortens it (2-opt; Croes 1958).
    """
    travel = travel_times(joints, velocities)
    count = len(joints)
    order = [int(travel.sum(axis=1).argmax())]
    free = np.ones(count, dtype=bool)
    for _ in range(count - 1):
        free[order[-1]] = False
        order.append(int(np.where(free, travel[order[-1]], np.inf).argmin()))
    path = np.array(order)
    while True:
        # turning i ... j round joins i - 1 to j and i to j + 1; an end of the way joins nothing
        there = np.zeros((count + 2, count + 2))
        there[1:-1, 1:-1] = travel[np.ix_(path, path)]
        legs = np.diagonal(there, 1)
        change = there[:-2, 1:-1] + there[1:-1, 2:] - legs[:-1, None] - legs[None, 1:]
        change = np.triu(change, 1)
        i, j = np.unravel_index(change.argmin(), change.shape)
        if change[i, j] > -1e-9:
            return path
        path[i : j + 1] = path[i : j + 1][::-1]


def travel_times(joints: FloatArray, velocities: FloatArray) -> FloatArray:
    """Return the times (N, N) [s] of the moves between configurations (N, n)."""
    return np.asarray(np.abs((joints[:, None] - joints[None]) / velocities).max(axis=2))


@dataclass(frozen=True, eq=False)
class Plan:
    """Poses to measure, and what they promise.

    Attributes
    ----------
    joints : (K, n)
        Joint values [rad or m], the most telling first.
    visit : (K,)
        Their order of visit.
    travel : float
        Time of the moves [s].
    accuracy : (K,)
        Predicted RMS position error [m] with the first 1, 2, ... K of them.
    at_random : (K,)
        The same with candidates taken at random (median of draws).
    efficiency : float or None
        Lower bound against the best choice of as many candidates; None for o2 to o5, and
        with too few poses to determine all parameters.
    lacking : tuple of str
        Parameters that no choice of these candidates would determine; they are left out.

    """

    joints: FloatArray
    visit: NDArray[np.intp]
    travel: float
    accuracy: FloatArray
    at_random: FloatArray
    efficiency: float | None
    lacking: tuple[str, ...]


def plan(
    design: Design,
    candidates: FloatArray,
    task: FloatArray,
    count: int,
    criterion: Criterion = 'd',
    apart: float = STILL,
    velocities: FloatArray | None = None,
) -> Plan:
    """Plan a number of measurements; `choose` and `visit_order` say what the arguments mean."""
    excited = design.determined_by(candidates)
    chosen = choose(excited, candidates, count, criterion, task, apart)
    joints = candidates[chosen]
    speeds = np.ones(joints.shape[1]) if velocities is None else velocities
    visit = visit_order(joints, speeds)
    rng = np.random.default_rng(0)
    draws = [
        accuracy(excited, candidates[rng.permutation(len(candidates))[:count]], task)
        for _ in range(RANDOM_DRAWS)
    ]
    predictions = accuracy(excited, joints, task)
    bound = None
    if criterion in ('d', 'task') and np.isfinite(predictions[-1]):
        bound = efficiency(excited, candidates, chosen, task if criterion == 'task' else None)
    moves = travel_times(joints[visit], speeds)
    return Plan(
        joints,
        visit,
        float(np.diagonal(moves, 1).sum()),
        predictions,
        np.median(draws, axis=0),
        bound,
        tuple(name for name in design.names if name not in excited.names),
    )


def poses_needed(
    design: Design,
    candidates: FloatArray,
    task: FloatArray,
    wanted: float,
    criterion: Criterion = 'd',
    apart: float = STILL,
) -> int:
    """Return how many poses bring the RMS position error at task poses (T, n) to `wanted` [m].

    Raises
    ------
    InputError
        When not even all candidates do.

    """
    excited = design.determined_by(candidates)
    best = predicted(excited.after(candidates), task)
    if best > wanted:
        raise InputError(
            f'all {len(candidates)} candidates together predict {1e3 * best:.4f} mm, '
            f'{1e3 * wanted:g} mm are wanted: give more candidates or a better measurement'
        )
    count = 25
    while True:
        count = min(count, len(candidates))
        chosen = choose(excited, candidates, count, criterion, task, apart)
        reached = np.flatnonzero(accuracy(excited, candidates[chosen], task) <= wanted)
        if reached.size:
            break
        count *= 2
    count = int(reached[0]) + 1
    while count > 1:  # the first of many are not quite the best of few
        fewer = choose(excited, candidates, count - 1, criterion, task, apart)
        if accuracy(excited, candidates[fewer], task)[-1] > wanted:
            break
        count -= 1
    return count
