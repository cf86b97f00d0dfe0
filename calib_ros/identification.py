# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From matched pairs to the errors of the chain's parameters: Problem -> Identification.

The steps of `identify` are those of Vacarescu et al., section 3: measure, write the pose errors
as a linear model of the parameter errors, solve by least squares, correct the parameters, and
repeat until the step vanishes. Around it stand what makes the result trustworthy: frames that
need no guess, gauge freedoms found and named, and a judgement on poses that were not fitted.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from calib_ros import identifiability
from calib_ros.chain import Chain
from calib_ros.errors import ConfigError, InputError, TooFewObservationsError, UnknownNameError
from calib_ros.frames import free_frame_parameters, start_frames
from calib_ros.leastsquares import Fit, Samples, minimise, triangular_factor
from calib_ros.observations import Observations
from calib_ros.se3 import FloatArray, log_rotation

CONFIDENCE = 0.95
"""One-sided confidence that a gain on held-out poses must have to be claimed."""
FOLD_TOLERANCE = 1e-3
"""Step [sigma] at which the fits of a cross-validation stop; their figures need no more."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What is known before an identification.

    Parameters
    ----------
    chain : Chain
        The nominal chain. Frames that it does not fix are fitted.
    observations : Observations
        Pairs to fit.
    held_out : Observations, optional
        Pairs that are never fitted and judge the result. Without them the result is judged by
        cross-validation over whole configurations.
    sigma_position, sigma_orientation : float
        Standard deviations [m, rad] of measurements without a covariance of their own. Their
        ratio weighs position against orientation; the size of the noise is estimated.
    fixed : sequence of str
        Parameters to hold at their nominal values; `*` and `?` match as in file names.
    folds : int
        Parts of the cross-validation.

    """

    chain: Chain
    observations: Observations
    held_out: Observations | None = None
    sigma_position: float = 1e-4
    sigma_orientation: float = 1e-4 / 0.3
    fixed: Sequence[str] = ()
    folds: int = 5

    def __post_init__(self) -> None:
        """Check what does not depend on the measured values."""
        for name in ('sigma_position', 'sigma_orientation'):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ConfigError(f'{name} must be a positive number, not {getattr(self, name)}')
        joints = len(self.chain.joints)
        for observations in (self.observations, self.held_out):
            if observations is not None and observations.joints.shape[1:] != (joints,):
                raise InputError(
                    f'observations have {observations.joints.shape[1:]} joint values, chain '
                    f'"{self.chain.name}" has {joints} joints'
                )

        names = self.chain.parameter_names
        for pattern in self.fixed:
            if not fnmatch.filter(names, pattern):
                raise UnknownNameError('parameter to fix', pattern, names)
            if pattern.startswith(('base', 'tool')):
                raise ConfigError(
                    f'a frame is held as a whole: give it in the chain file with "fixed: true", '
                    f'instead of fixing "{pattern}"'
                )
        if not self.free:
            raise ConfigError('every parameter is fixed: nothing is left to identify')

    @property
    def oriented(self) -> bool:
        """Tell whether any orientation was measured."""
        return bool(self.observations.oriented.any())

    @property
    def free(self) -> tuple[str, ...]:
        """Return the parameters that may be fitted, in the order of their priority."""
        held = [f'{key}.*' for key in ('base', 'tool') if self.chain.frame(key).fixed]
        return tuple(
            name
            for name in self.chain.parameter_names
            if not any(fnmatch.fnmatchcase(name, pattern) for pattern in (*self.fixed, *held))
        )


@dataclass(frozen=True)
class Parameter:
    """One parameter of the model: m for lengths, rad for angles.

    `status` is 'fitted', 'gauge' (redundant by the chain's structure), 'not excited' (the poses
    do not determine it) or 'fixed'; all but the first keep the nominal value.
    """

    name: str
    value: float
    offset: float
    std: float | None
    status: str


@dataclass(frozen=True)
class ErrorFigures:
    """Figures of the distance to the measurement over a set of poses."""

    count: int
    rms_mm: float
    mean_mm: float
    max_mm: float
    rms_mrad: float | None


@dataclass(frozen=True, eq=False)
class Residuals:
    """Measured minus predicted: position (N, 3) [m] and rotation vector (N, 3) [rad].

    Both in the world; the rotation is NaN where no orientation was measured. `configurations`
    (N,) tells which pairs belong to one standing configuration.
    """

    position: FloatArray
    orientation: FloatArray
    configurations: NDArray[np.intp]

    @property
    def figures(self) -> ErrorFigures:
        """Return RMS, mean and maximum."""
        distance = 1e3 * np.linalg.norm(self.position, axis=1)
        angle = 1e3 * np.linalg.norm(self.orientation, axis=1)
        angle = angle[~np.isnan(angle)]
        return ErrorFigures(
            len(distance),
            float(np.sqrt(np.mean(distance**2))),
            float(distance.mean()),
            float(distance.max()),
            float(np.sqrt(np.mean(angle**2))) if angle.size else None,
        )


@dataclass(frozen=True, eq=False)
class Comparison:
    """Residuals of the same poses before and after.

    Before is the nominal chain with base and tool frames fitted, so that the gain is the arm's
    and not the frames'.
    """

    before: Residuals
    after: Residuals


@dataclass(frozen=True, eq=False)
class Identification:
    """The result; a poor fit is data in it, not an error.

    Attributes
    ----------
    chain : Chain
        Corrected chain with fitted frames.
    before : Chain
        Nominal chain with fitted frames.
    parameters : tuple of Parameter
        Every parameter of the model.
    names, covariance : tuple of str, (P, P)
        Fitted parameters and their covariance, scaled to the noise found in the residuals.
    fitted, validation : Comparison
        Residuals on the fitted pairs and on pairs that were not fitted. The latter is None when
        there are too few configurations to hold any out.
    validated_by : str
        How the pairs of `validation` were held out.
    noise : float
        Size of the residuals in units of the sigma given.
    rank, iterations : int
    converged : bool
    refusals : tuple of str
        Rules of acceptance that failed, in words; none when the result is accepted.

    """

    chain: Chain
    before: Chain
    parameters: tuple[Parameter, ...]
    names: tuple[str, ...]
    covariance: FloatArray
    fitted: Comparison
    validation: Comparison | None
    validated_by: str
    noise: float
    iterations: int
    converged: bool
    refusals: tuple[str, ...]

    @property
    def accepted(self) -> bool:
        """Tell whether the result may replace the nominal parameters."""
        return not self.refusals

    @property
    def rank(self) -> int:
        """Return the number of parameters that the poses determine."""
        return len(self.names)

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Return the parameters that were free but could not be determined."""
        return tuple(p.name for p in self.parameters if p.status in ('gauge', 'not excited'))

    @property
    def not_excited(self) -> tuple[str, ...]:
        """Return those of them that other poses would determine."""
        return tuple(p.name for p in self.parameters if p.status == 'not excited')


def identify(problem: Problem) -> Identification:
    """Identify the parameters of a chain from matched pairs.

    Raises
    ------
    TooFewObservationsError
        With fewer equations than parameters.

    """
    structural = identifiability.structurally_independent(
        problem.chain, problem.free, problem.oriented
    )
    _require_enough(problem, structural)
    samples = Samples(problem.observations, problem.sigma_position, problem.sigma_orientation)
    before = _fit_frames(problem, samples)
    names = identifiability.independent(
        triangular_factor(before.chain, structural, samples), structural
    )
    fit = minimise(before.chain, names, samples)
    noise = np.sqrt(fit.cost / max(samples.rows - len(names), 1))
    covariance = noise**2 * identifiability.covariance(
        triangular_factor(fit.chain, names, samples)
    )
    validation, validated_by = _validate(problem, before.chain, fit.chain, names)
    parameters = _parameters(problem, fit.chain, structural, names, covariance)
    return Identification(
        chain=fit.chain,
        before=before.chain,
        parameters=parameters,
        names=names,
        covariance=covariance,
        fitted=_compare(before.chain, fit.chain, problem.observations),
        validation=validation,
        validated_by=validated_by,
        noise=float(noise),
        iterations=fit.iterations,
        converged=before.converged and fit.converged,
        refusals=_refusals(before.converged and fit.converged, parameters, validation),
    )


def residuals(chain: Chain, observations: Observations) -> Residuals:
    """Return measured minus predicted for every pair."""
    predicted = chain.forward(observations.joints)
    turned = observations.rotations @ np.swapaxes(predicted[:, :3, :3], 1, 2)
    orientation = np.full((len(observations), 3), np.nan)
    orientation[observations.oriented] = log_rotation(turned[observations.oriented])
    return Residuals(
        observations.positions - predicted[:, :3, 3], orientation, observations.configurations
    )


def _compare(before: Chain, after: Chain, observations: Observations) -> Comparison:
    return Comparison(residuals(before, observations), residuals(after, observations))


def _fit_frames(problem: Problem, samples: Samples) -> Fit:
    """Fit the frames of the nominal chain to all samples."""
    start = start_frames(
        problem.chain, problem.observations, problem.sigma_position, problem.sigma_orientation
    )
    names = free_frame_parameters(problem.chain, problem.oriented)
    kept = identifiability.independent(triangular_factor(start, names, samples), names)
    return minimise(start, kept, samples)


def _require_enough(problem: Problem, names: Sequence[str]) -> None:
    rows = 6 if problem.oriented else 3
    configurations = 0
    if len(problem.observations):
        configurations = int(problem.observations.configurations[-1]) + 1
    if configurations * rows < len(names):
        raise TooFewObservationsError(
            configurations,
            -(-len(names) // rows),
            f'{rows} equations each for {len(names)} parameters',
        )


def _validate(
    problem: Problem, before: Chain, after: Chain, names: Sequence[str]
) -> tuple[Comparison | None, str]:
    """Judge both chains on pairs that were not fitted."""
    if problem.held_out is not None and len(problem.held_out):
        count = len(problem.held_out)
        return _compare(before, after, problem.held_out), f'{count} held-out pairs'
    observations = problem.observations
    groups = observations.configurations
    folds = min(problem.folds, int(groups[-1]) + 1)
    rows = 6 if problem.oriented else 3
    if folds < 2 or (groups[-1] + 1) * (folds - 1) // folds * rows < len(names) + rows:
        return None, 'nothing: too few configurations to hold any out'
    frames = [name for name in names if name.partition('.')[0] in ('base', 'tool')]
    order, parts = [], []
    for fold in range(folds):
        left_out = groups % folds == fold
        samples = Samples(
            observations.select(~left_out), problem.sigma_position, problem.sigma_orientation
        )
        chains = (
            minimise(before, frames, samples, FOLD_TOLERANCE).chain,
            minimise(after, names, samples, FOLD_TOLERANCE).chain,
        )
        parts.append(_compare(*chains, observations.select(left_out)))
        order.append(np.flatnonzero(left_out))
    index = np.argsort(np.concatenate(order))

    def joined(which: str) -> Residuals:
        pieces = [getattr(part, which) for part in parts]
        return Residuals(
            np.concatenate([piece.position for piece in pieces])[index],
            np.concatenate([piece.orientation for piece in pieces])[index],
            groups,
        )

    return (
        Comparison(joined('before'), joined('after')),
        f'{folds}-fold cross-validation over {groups[-1] + 1} configurations',
    )


def _parameters(
    problem: Problem,
    chain: Chain,
    structural: Sequence[str],
    names: Sequence[str],
    covariance: FloatArray,
) -> tuple[Parameter, ...]:
    std = dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    free = set(problem.free)
    rows = []
    for name in chain.parameter_names:
        if name in std:
            status = 'fitted'
        elif name in structural:
            status = 'not excited'
        else:
            status = 'gauge' if name in free else 'fixed'
        offset = chain.offset(name, problem.chain)
        rows.append(Parameter(name, chain.value(name), offset, std.get(name), status))
    return tuple(rows)


def _refusals(
    converged: bool, parameters: Sequence[Parameter], validation: Comparison | None
) -> tuple[str, ...]:
    """Return the rules of acceptance that fail.

    1. The fit has converged.
    2. The rank is full after gauges: no parameter that other poses would determine is left out.
    3. The RMS error on held-out poses is lower than before, by more than its uncertainty: the
       mean of the squared position errors' decrease over configurations exceeds its one-sided
       95 % limit (Student's t); the orientation must not get worse by the same measure.
    """
    failed = []
    if not converged:
        failed.append('the fit has not converged')
    not_excited = [p.name for p in parameters if p.status == 'not excited']
    if not_excited:
        failed.append(
            f'the poses do not determine {", ".join(not_excited)}: move the joints further and '
            'in more combinations, or fix these parameters'
        )
    if validation is None:
        failed.append('there are too few configurations to judge the result on any held out')
        return tuple(failed)
    before, after = validation.before.figures, validation.after.figures
    groups = validation.after.configurations
    gain, limit = _gain(validation.before.position, validation.after.position, groups)
    if not gain > limit:
        failed.append(
            f'no gain on held-out poses beyond its uncertainty (RMS {before.rms_mm:.3f} mm '
            f'before, {after.rms_mm:.3f} mm after)'
        )
    if after.rms_mrad is not None:
        gain, limit = _gain(validation.before.orientation, validation.after.orientation, groups)
        if gain < -limit:
            failed.append(
                f'the orientation got worse on held-out poses (RMS {before.rms_mrad:.3f} mrad '
                f'before, {after.rms_mrad:.3f} mrad after)'
            )
    return tuple(failed)


def _gain(
    before: FloatArray, after: FloatArray, configurations: NDArray[np.intp]
) -> tuple[float, float]:
    """Return the mean decrease of the squared error (N, 3) per configuration, and its limit."""
    decrease = (before**2).sum(axis=1) - (after**2).sum(axis=1)
    known = ~np.isnan(decrease)
    _, group = np.unique(configurations[known], return_inverse=True)
    means = np.bincount(group, decrease[known]) / np.bincount(group)
    if len(means) < 2:
        return 0.0, np.inf
    limit = stats.t.ppf(CONFIDENCE, len(means) - 1) * means.std(ddof=1) / np.sqrt(len(means))
    return float(means.mean()), float(limit)
