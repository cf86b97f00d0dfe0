# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors over the workspace: what a calibration removes, and what remains.

What it removes at q is the distance between the nominal arm, in frames fitted to the calibrated
one, and the calibrated arm. What remains is predicted by the covariance C of the parameters and by
the RMS error r on poses that were not fitted,

    removed(q) = |p_nominal - p|      sigma(q)^2 = tr J C J^T      remaining(q)^2 = sigma^2 + r^2

with J the rows of position of the error model. An arm that is commanded by its nominal model is
expected to miss by the root of removed^2 + remaining^2, by its calibrated model by `remaining`.
"""

from __future__ import annotations

import json
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from calib_ros.apply.simulation import measure
from calib_ros.errors import CalibrationError, ConfigError, InputError, UnknownNameError
from calib_ros.identification.identifiability import structurally_independent
from calib_ros.identification.identification import Identification
from calib_ros.identification.leastsquares import Samples, System, minimise
from calib_ros.identification.region import Region, region_of_record
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import load_calibration
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import parameters_of
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import Shown
from calib_ros.texts import read_text

Model: TypeAlias = Literal['corrected', 'nominal']
MODELS: tuple[Model, ...] = get_args(Model)
BLOCK = 4096
FRAME_POSES = 300
"""Poses to which the frames of the nominal arm are fitted."""
LEAST_SHARE = 0.005
"""Share of all poses that a region must hold to be named."""


@dataclass(frozen=True, eq=False, repr=False)
class CalibratedArm(Shown):
    """An arm before and after its calibration, and how well that is known.

    Attributes
    ----------
    before, after : Chain
        The nominal chain in fitted frames, and the calibrated one.
    names, covariance : tuple of str, (P, P)
        Parameters that were fitted, and their covariance; none when it is not known.
    residual : float
        RMS position error [m] on poses that were not fitted; 0 when it is not known.
    region : Region, optional
        Where the calibration may be used; None when it is not known.

    """

    before: Chain
    after: Chain
    names: tuple[str, ...] = ()
    covariance: FloatArray | None = None
    residual: float = 0.0
    region: Region | None = None

    @classmethod
    def of(cls, result: Identification) -> CalibratedArm:
        """Return the arm of an identification."""
        figures = (result.validation or result.fitted).figures[1]
        return cls(
            result.before,
            result.chain,
            result.names,
            result.covariance,
            1e-3 * figures.rms_mm,
            result.region,
        )

    @classmethod
    def read(cls, path: Path, nominal: Chain) -> CalibratedArm:
        """Read the folder that `calib_ros identify --out` wrote, or a calibrated chain alone.

        The frames of the nominal chain are fitted to the calibrated one, over the whole range of
        the joints.

        Raises
        ------
        ConfigError
            When there is no calibration, or not one of that nominal chain.
        InputError
            When the result beside it cannot be used.

        """
        after, record = load_calibration(path, nominal)
        region = region_of_record(record, after, str(path))
        arm = cls(_in_frames_of(nominal, after), after, region=region)
        if not path.is_dir():
            return arm
        try:
            document: dict[str, Any] = json.loads(read_text(path / 'result.json'))
            names = tuple(map(str, document['covariance']['names']))
            covariance = np.array(document['covariance']['matrix'], dtype=float)
            residual = 1e-3 * float(document['validation']['after']['rms_mm'])
            if covariance.shape != (len(names),) * 2 or not np.isfinite(covariance).all():
                raise ValueError(f'its matrix is not one of finite numbers for {len(names)} names')
            if not 0.0 <= residual < np.inf:
                raise ValueError('its RMS error is none')
        except (CalibrationError, ValueError, LookupError, TypeError, ArithmeticError) as err:
            raise InputError(
                f'{path / "result.json"} holds no covariance: identify again, or give '
                f'{path / "calibration.yaml"} alone ({type(err).__name__}: {err})'
            ) from err
        except RecursionError as err:
            raise InputError(f'{path / "result.json"} is nested too deep') from err
        return replace(arm, names=names, covariance=covariance, residual=residual)

    def removed(self, joints: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return distance (N,) [m] and angle (N,) [rad] between before and after at (N, n)."""
        before, after = self.before.forward(joints), self.after.forward(joints)
        turn = se3.log_rotation(before[:, :3, :3] @ np.swapaxes(after[:, :3, :3], 1, 2))
        shift = before[:, :3, 3] - after[:, :3, 3]
        return np.linalg.norm(shift, axis=1), np.linalg.norm(turn, axis=1)

    def sigma(self, joints: FloatArray) -> FloatArray:
        """Return the standard deviation (N,) [m] of predicted positions; NaN if not known.

        With the region it is the expected error, effects that are not modelled included.
        """
        if self.region is not None:
            return self.region.sigma(joints)
        return self._sigma(joints, slice(0, 3))

    def sigma_turned(self, joints: FloatArray) -> FloatArray:
        """Return the standard deviation (N,) [rad] of orientations; NaN if not known."""
        return self._sigma(joints, slice(3, 6))

    def knowledge(self, joints: FloatArray, turned: FloatArray) -> tuple[str, str]:
        """Return how well a program at (N, n) is known, and a warning where that is not enough.

        `turned` (N,) [rad] are the errors of orientation to correct. Both are empty where the
        covariance is not known, or nothing is to be warned about.
        """
        if self.covariance is None:
            return '', ''
        shift, turn = self.sigma(joints), self.sigma_turned(joints)
        words = (
            f'sigma of the calibration at these poses: {1e3 * shift.max(initial=0.0):.3f} mm '
            f'where the target was, {1e3 * turn.max(initial=0.0):.3f} mrad at most'
        )
        if np.sum(turn**2) <= np.sum(turned**2):
            return words, ''
        return words, (
            'the calibration does not know the orientation well enough to correct it; positions '
            'hold near the measured target only. Measure orientations as well, or a target '
            'further off the last axis'
        )

    def _sigma(self, joints: FloatArray, components: slice) -> FloatArray:
        if self.covariance is None:
            return np.full(len(joints), np.nan)
        model = ErrorModel(self.after, self.names)
        squares = np.empty(len(joints))
        for first in range(0, len(joints), BLOCK):
            part = slice(first, first + BLOCK)
            rows = model.jacobian(joints[part])[:, components]
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
    base, tool = after.frame('base'), after.frame('tool')
    start = replace(nominal, base=base, tool=tool, frames=after.frames)
    names = [
        name
        for frame in ('base', 'tool')
        if not start.frame(frame).fixed
        for name in parameters_of(frame)
    ]
    if not names:
        return start
    independent = structurally_independent(start, names)
    return minimise(start, independent, System((Samples(wanted, 1e-4, 1e-4 / 0.3),))).chain


@dataclass(frozen=True, eq=False, repr=False)
class Survey(Shown):
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
    def parts(self) -> dict[str, FloatArray]:
        """Return the errors (N,) [m] by their names: only what is removed, if no more is known."""
        found = {'removed by the calibration': self.removed}
        if not np.isnan(self.remaining).any():
            found |= {'sigma of what remains': self.sigma, 'expected to remain': self.remaining}
        return found

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


def regions(positions: FloatArray, errors: FloatArray) -> tuple[Sector, ...]:
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


def in_words(survey: Survey) -> str:
    """Return the errors over the workspace as Markdown: figures, and where they are largest."""
    rest = 'What remains is not known: the covariance is in the folder of the result.'
    if len(survey.parts) > 1:
        rest = 'Expected to remain: sigma and the RMS error on poses that were not fitted.'
    lines = [
        f'Position errors [mm] at {len(survey.joints)} random poses of the joint range.',
        '',
        '| | RMS | mean | median | 95 % | max |',
        '|---|---|---|---|---|---|',
    ]
    for label, errors in survey.parts.items():
        figures = ' | '.join(f'{value:.4f}' for value in astuple(Spread.of(1e3 * errors)))
        lines.append(f'| {label} | {figures} |')
    lines += ['', rest]
    for label, errors in list(survey.parts.items())[:2]:
        found = regions(survey.positions, errors)
        lines += ['', f'Largest RMS, {label}:', '']
        lines += [f'- {_region_in_words(region)}' for region in found[:3]]
        lines += ['', f'Least: {_region_in_words(found[-1])}']
    return '\n'.join(lines) + '\n'


def _region_in_words(region: Sector) -> str:
    (near, far), (low, high) = region.radius, region.height
    return (
        f'{region.words}: {1e3 * region.rms:.4f} mm (radius {near:.2f} to {far:.2f} m, '
        f'height {low:.2f} to {high:.2f} m, {region.poses} poses)'
    )
