# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors over the workspace, and where in it a task is done best.

What a calibration removes at q is the distance between the nominal arm, in frames fitted to the
calibrated one, and the calibrated arm. What remains is predicted by the covariance C of the
parameters and by the RMS error r on poses that were not fitted,

    removed(q) = |p_nominal - p|      sigma(q)^2 = tr J C J^T      remaining(q)^2 = sigma^2 + r^2

with J the rows of position of the error model. An arm that is commanded by its nominal model is
expected to miss by the root of removed^2 + remaining^2, by its calibrated model by `remaining`.

The optimal workspace of a task (Vacarescu et al., abstract) is where its frame is placed so that
this error is least, the mean or the worst over the task's poses. It is searched on a grid, which
is the map to prove it, and refined about the best. Every pose is solved for joint values
(`inverse.py`): the first one from configurations that come near it, the others from pose to pose.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib_ros import inverse, se3
from calib_ros.chain import FRAME_KINDS, Chain
from calib_ros.config import load_chain
from calib_ros.differential import ErrorModel
from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.identifiability import structurally_independent
from calib_ros.identification import Identification
from calib_ros.leastsquares import Samples, System, minimise
from calib_ros.se3 import FloatArray
from calib_ros.simulation import measure

Aim: TypeAlias = Literal['mean', 'worst']
AIMS: tuple[Aim, ...] = get_args(Aim)
Model: TypeAlias = Literal['corrected', 'nominal']
MODELS: tuple[Model, ...] = get_args(Model)
BLOCK = 4096
FRAME_POSES = 300
"""Poses to which the frames of the nominal arm are fitted."""
STARTS = 6
"""Configurations from which the first pose of a task is solved."""
KNOWN_POSES = 20_000
"""Random configurations among which they are looked for."""
REFINEMENTS = 4
"""Times that the grid is halved about the best placement."""
LEAST_SHARE = 0.005
"""Share of all poses that a region must hold to be named."""


@dataclass(frozen=True, eq=False)
class CalibratedArm:
    """An arm before and after its calibration, and how well that is known.

    Attributes
    ----------
    before, after : Chain
        The nominal chain in fitted frames, and the calibrated one.
    names, covariance : tuple of str, (P, P)
        Parameters that were fitted, and their covariance; none when it is not known.
    residual : float
        RMS position error [m] on poses that were not fitted; 0 when it is not known.

    """

    before: Chain
    after: Chain
    names: tuple[str, ...] = ()
    covariance: FloatArray | None = None
    residual: float = 0.0

    @classmethod
    def of(cls, result: Identification) -> CalibratedArm:
        """Return the arm of an identification."""
        figures = (result.validation or result.fitted).figures[1]
        return cls(
            result.before, result.chain, result.names, result.covariance, 1e-3 * figures.rms_mm
        )

    @classmethod
    def read(cls, path: Path, nominal: Chain) -> CalibratedArm:
        """Read the folder that `calib_ros identify --out` wrote, or a calibrated chain alone.

        The frames of the nominal chain are fitted to the calibrated one, over the whole range of
        the joints.

        Raises
        ------
        ConfigError
            When there is no calibrated chain, or it is not of that nominal one.
        InputError
            When the result beside it cannot be used.

        """
        after = load_chain(path / 'calibration.yaml' if path.is_dir() else path)
        if after.joint_names != nominal.joint_names:
            raise ConfigError(
                f'{path} has the joints {", ".join(after.joint_names)}, the nominal chain has '
                f'{", ".join(nominal.joint_names)}: is it the right nominal chain?'
            )
        arm = cls(_in_frames_of(nominal, after), after)
        if not path.is_dir():
            return arm
        try:
            document: dict[str, Any] = json.loads((path / 'result.json').read_text())
            names = tuple(document['covariance']['names'])
            covariance = np.array(document['covariance']['matrix'], dtype=float)
            residual = 1e-3 * float(document['validation']['after']['rms_mm'])
        except (OSError, ValueError, KeyError, TypeError) as err:
            raise InputError(
                f'{path / "result.json"} holds no covariance: identify again, or give '
                f'{path / "calibration.yaml"} alone ({type(err).__name__}: {err})'
            ) from err
        return replace(arm, names=names, covariance=covariance, residual=residual)

    def removed(self, joints: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return distance (N,) [m] and angle (N,) [rad] between before and after at (N, n)."""
        before, after = self.before.forward(joints), self.after.forward(joints)
        turn = se3.log_rotation(before[:, :3, :3] @ np.swapaxes(after[:, :3, :3], 1, 2))
        shift = before[:, :3, 3] - after[:, :3, 3]
        return np.linalg.norm(shift, axis=1), np.linalg.norm(turn, axis=1)

    def sigma(self, joints: FloatArray) -> FloatArray:
        """Return the standard deviation (N,) [m] of predicted positions; NaN if not known."""
        if self.covariance is None:
            return np.full(len(joints), np.nan)
        model = ErrorModel(self.after, self.names)
        squares = np.empty(len(joints))
        for first in range(0, len(joints), BLOCK):
            part = slice(first, first + BLOCK)
            rows = model.jacobian(joints[part])[:, :3]
            squares[part] = np.einsum('ncp,pq,ncq->n', rows, self.covariance, rows, optimize=True)
        return np.sqrt(np.maximum(squares, 0.0))

    def expected(self, joints: FloatArray, model: Model) -> FloatArray:
        """Return the error (N,) [m] expected when a model commands the arm to (N, n)."""
        if model not in MODELS:
            raise UnknownNameError('model', model, MODELS)
        if self.covariance is None and model == 'corrected':
            raise ConfigError(
                'what remains after the correction cannot be predicted from a chain alone: give '
                'the folder of the result, or ask for the nominal model'
            )
        squares = self.residual**2 + np.nan_to_num(self.sigma(joints)) ** 2
        if model == 'nominal':
            squares = squares + self.removed(joints)[0] ** 2
        return np.sqrt(squares)

    def commanded_by(self, model: Model) -> Chain:
        """Return the chain by which a model turns poses into joint values."""
        return self.after if model == 'corrected' else self.before


def _in_frames_of(nominal: Chain, after: Chain) -> Chain:
    """Return the nominal chain with frames that bring it closest to the calibrated one."""
    joints = nominal.random_joints(FRAME_POSES, np.random.default_rng(0))
    wanted = measure(after, joints, np.random.default_rng(0))
    start = replace(nominal, base=after.frame('base'), tool=after.frame('tool'))
    names = [
        f'{frame}.{kind}'
        for frame in ('base', 'tool')
        if not start.frame(frame).fixed
        for kind in FRAME_KINDS
    ]
    if not names:
        return start
    independent = structurally_independent(start, names)
    return minimise(start, independent, System((Samples(wanted, 1e-4, 1e-4 / 0.3),))).chain


@dataclass(frozen=True, eq=False)
class Survey:
    """Errors at configurations all over the workspace.

    Attributes
    ----------
    joints : (N, n)
        Joint values [rad or m].
    positions : (N, 3)
        Of the target [m] in the arm's base frame.
    removed, turned : (N,)
        What the calibration removes: distance [m] and angle [rad].
    sigma : (N,)
        Standard deviation [m] of the position by the uncertainty of the parameters; NaN if not
        known.
    remaining : (N,)
        Error [m] that is expected to remain: sigma and the residual RMS; NaN if not known.

    """

    joints: FloatArray
    positions: FloatArray
    removed: FloatArray
    turned: FloatArray
    sigma: FloatArray
    remaining: FloatArray

    @property
    def cloud(self) -> FloatArray:
        """Return (N, 5): x, y, z [m] in the arm's base frame, error removed [m], sigma [m]."""
        return np.column_stack([self.positions, self.removed, self.sigma])


def survey(arm: CalibratedArm, count: int, rng: np.random.Generator) -> Survey:
    """Survey the errors at random configurations within the joint limits."""
    joints = arm.after.random_joints(count, rng)
    removed, turned = arm.removed(joints)
    sigma = arm.sigma(joints)
    positions = in_base(arm.after, joints)[:, :3, 3]
    return Survey(joints, positions, removed, turned, sigma, np.hypot(sigma, arm.residual))


def in_base(chain: Chain, joints: FloatArray) -> FloatArray:
    """Return the target's poses (N, 4, 4) in the arm's base frame at joint values (N, n)."""
    return se3.invert(chain.frame('base').matrix) @ chain.forward(joints)


def task_of(poses: FloatArray) -> FloatArray:
    """Return poses (K, 4, 4) in a frame at their middle, whose axes stay as they are."""
    task = poses.copy()
    task[:, :3, 3] -= 0.5 * (poses[:, :3, 3].min(axis=0) + poses[:, :3, 3].max(axis=0))
    return task


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
        return cls(
            float(np.sqrt(np.mean(errors**2))),
            float(errors.mean()),
            float(np.median(errors)),
            float(np.quantile(errors, 0.95)),
            float(errors.max()),
        )


@dataclass(frozen=True)
class Region:
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


def regions(positions: FloatArray, errors: FloatArray) -> tuple[Region, ...]:
    """Return the regions of positions (N, 3) [m], that of the largest RMS error (N,) first.

    Radius and height are parted so that each third holds as many poses; azimuth in quadrants.
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
        if inside.sum() < max(1, LEAST_SHARE * len(positions)):
            continue
        middle = 0.5 * np.pi * side
        found.append(
            Region(
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

    Returns
    -------
    first_edges, second_edges : (cells + 1,)
    rms : (cells, cells)
        NaN where there is nothing; the first coordinate counts rows.

    """
    number, first_edges, second_edges = np.histogram2d(first, second, cells)
    edges = (first_edges, second_edges)
    squares = np.histogram2d(first, second, edges, weights=errors**2)[0]
    rms = np.sqrt(squares / np.where(number > 0, number, np.nan))
    return first_edges, second_edges, rms


@dataclass(frozen=True, eq=False)
class Placements:
    """Where a task's frame may be placed, and the error expected there.

    Attributes
    ----------
    positions : (M, 3)
        Of the task's frame [m] in the arm's base frame.
    turns : (M,)
        Turn [rad] of the task's frame about the vertical axis of the base.
    errors : (M,)
        Expected error [m]; NaN where the arm does not reach all poses of the task.
    joints : (M, K, n)
        Joint values [rad or m] of the task's poses, where it is reached.
    best, centre : int
        The placement of least error, and the one nearest to the centre of all that are reached.

    """

    positions: FloatArray
    turns: FloatArray
    errors: FloatArray
    joints: FloatArray
    best: int
    centre: int


def place(
    arm: CalibratedArm,
    task: FloatArray,
    aim: Aim = 'mean',
    model: Model = 'corrected',
    region: FloatArray | None = None,
    cells: int = 9,
    turns: int = 1,
) -> Placements:
    """Find the placement of a task with the least expected error.

    Parameters
    ----------
    arm : CalibratedArm
        Before and after.
    task : (K, 4, 4)
        Poses of the target in the task's frame, whose axes are those of the base at turn 0.
    aim : 'mean' or 'worst'
        Over the task's poses.
    model : 'corrected' or 'nominal'
        By which the arm is commanded.
    region : (2, 3), optional
        Lower and upper corner [m], in the base frame, for the origin of the task's frame; all
        that the arm reaches if None.
    cells : int
        Points of the grid along each axis.
    turns : int
        Turns about the vertical to try, evenly spread.

    Raises
    ------
    InputError
        When the arm reaches all poses of the task nowhere.

    """
    if aim not in AIMS:
        raise UnknownNameError('aim', aim, AIMS)
    search = _Search(arm, task, aim, model)
    corners = search.reach if region is None else region
    axes = [np.linspace(low, high, cells) for low, high in corners.T]
    angles = 2.0 * np.pi * np.arange(turns) / turns
    grid = np.stack(np.meshgrid(*axes, angles, indexing='ij'), axis=-1).reshape(-1, 4)
    errors, joints = search.errors(grid)
    reached = ~np.isnan(errors)
    if not reached.any():
        raise InputError(
            f'the arm reaches all {len(task)} poses of the task at none of {len(grid)} '
            'placements: check the unit (m), the orientation and the region, or use more cells'
        )
    middle = grid[reached, :3].mean(axis=0)
    distance = np.linalg.norm(grid[:, :3] - middle, axis=1)
    centre = int(np.where(reached, distance, np.inf).argmin())
    step = (corners[1] - corners[0]) / max(cells - 1, 1)
    for _ in range(REFINEMENTS):
        step = 0.5 * step
        best = grid[np.nanargmin(errors)]
        around = np.array([each for each in np.ndindex(3, 3, 3) if each != (1, 1, 1)]) - 1
        near = np.column_stack([best[:3] + step * around, np.full(len(around), best[3])])
        near[:, :3] = np.clip(near[:, :3], corners[0], corners[1])
        more_errors, more_joints = search.errors(near)
        grid, errors = np.concatenate([grid, near]), np.concatenate([errors, more_errors])
        joints = np.concatenate([joints, more_joints])
    best = int(np.nanargmin(errors))
    return Placements(grid[:, :3], grid[:, 3], errors, joints, best, centre)


class _Search:
    """The expected error of a task at placements (M, 4): x, y, z [m] and a turn [rad]."""

    def __init__(self, arm: CalibratedArm, task: FloatArray, aim: Aim, model: Model) -> None:
        self._arm, self._task, self._aim, self._model = arm, task, aim, model
        self._chain = arm.commanded_by(model)
        self._base = self._chain.frame('base').matrix
        self._known = self._chain.random_joints(KNOWN_POSES, np.random.default_rng(0))
        poses = in_base(self._chain, self._known)
        self._tree = cKDTree(_features(poses))
        self.reach = np.array([poses[:, :3, 3].min(axis=0), poses[:, :3, 3].max(axis=0)])

    def errors(self, placements: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the errors (M,) [m], NaN where out of reach, and the joint values (M, K, n)."""
        turns = np.zeros((len(placements), 3))
        turns[:, 2] = placements[:, 3]
        frames = se3.transform(se3.exp_rotation(turns), placements[:, :3])
        poses = frames[:, np.newaxis] @ self._task
        joints, reached = self._follow(poses)
        errors = np.full((len(placements), STARTS), np.nan)
        expected = self._arm.expected(joints[reached].reshape(-1, joints.shape[-1]), self._model)
        expected = expected.reshape(-1, len(self._task))
        over = expected.mean(axis=1) if self._aim == 'mean' else expected.max(axis=1)
        errors[reached] = over
        best = np.where(np.isnan(errors), np.inf, errors).argmin(axis=1)
        index = np.arange(len(placements))
        return errors[index, best], joints[index, best]

    def _follow(self, poses: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return joint values (M, STARTS, K, n) for poses (M, K, 4, 4), and which reach them."""
        count, length = poses.shape[:2]
        _, nearest = self._tree.query(_features(poses[:, 0]), STARTS)
        joints = np.full((count, STARTS, length, self._known.shape[1]), np.nan)
        reached = np.ones((count, STARTS), dtype=bool)
        start = self._known[nearest]
        for k in range(length):
            placement, branch = np.nonzero(reached)
            wanted = self._base @ poses[placement, k]
            found = inverse.solve(self._chain, wanted, start[reached])
            joints[placement, branch, k] = found.joints
            start[reached] = found.joints
            reached[placement, branch] = found.converged
        return joints, reached


def _features(poses: FloatArray) -> FloatArray:
    """Return (N, 12): what is near in position, and in orientation times LEVER, is near in it."""
    columns = inverse.LEVER / np.sqrt(2.0) * poses[:, :3, :3].reshape(-1, 9)
    return np.concatenate([poses[:, :3, 3], columns], axis=1)
