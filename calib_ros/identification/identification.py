# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From matched pairs to the errors of the chain's parameters: Problem -> Identification.

The steps of `identify` are those of Vacarescu et al., section 3: measure, write the pose errors
as a linear model of the parameter errors, solve by least squares, correct the parameters, and
repeat until the step vanishes. Around it stand what makes the result trustworthy: frames that
need no guess, gauge freedoms found and named, and a judgement on poses that were not fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import special

from calib_ros.errors import ConfigError, InputError
from calib_ros.identification import identifiability, mistakes, suspicions
from calib_ros.identification.acceptance import refusals, remarks
from calib_ros.identification.configurations import distinct
from calib_ros.identification.considered import considered
from calib_ros.identification.drift import chance_of_gain
from calib_ros.identification.evidence import Posterior
from calib_ros.identification.fitting import SOME, Fitted, Simpler, fit, parameter_rows
from calib_ros.identification.leastsquares import System, minimise, normal_equations
from calib_ros.identification.levels import KNOWN
from calib_ros.identification.misfits import Outlier, arms_own, outliers_of
from calib_ros.identification.noise import Noise
from calib_ros.identification.problem import Problem
from calib_ros.identification.reasons import Reason
from calib_ros.identification.region import Region, region_of
from calib_ros.identification.robust import Robust
from calib_ros.identification.rounding import may_be_rounding, rounded, rounding_errors
from calib_ros.identification.steps import Step, find_step
from calib_ros.identification.validation import (
    Comparison,
    ParameterRow,
    compare,
    residuals,
    validate,
)
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.progress import Told, nobody
from calib_ros.shown import Shown, as_frame, as_html

__all__ = ['Identification', 'Noise', 'Outlier', 'Problem', 'identify', 'residuals']


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Shown):
    """The result; a poor fit is data in it, not an error."""

    chain: Chain
    before: Chain
    """The nominal chain. Both have fitted frames."""
    parameters: tuple[ParameterRow, ...]
    """Every parameter of the model."""
    names: tuple[str, ...]
    """Fitted parameters, (P,)."""
    uncertainty: identifiability.Uncertainty
    """Their covariance for the noise found in the residuals."""
    fitted: Comparison
    """Residuals on the fitted pairs."""
    validation: Comparison | None
    """Residuals on pairs that were not fitted; None where there are too few poses for that."""
    validated_by: str
    """How these pairs were held out."""
    noise: Noise
    distances: tuple[FloatArray, ...]
    """Size (N,) of the residuals of each set's samples, in the usual one (`robust.py`)."""
    outliers: tuple[Outlier, ...]
    """Samples of gross error; they carry no or little weight in the fit."""
    gauges: dict[str, list[str]]
    """For each parameter that was left out, the fitted ones that it trades against."""
    observability: identifiability.Observability
    priors: dict[str, float]
    """Standard deviations [m, rad] that were known before."""
    world_frame: str
    iterations: int
    converged: bool
    chance: float | None
    """Probability that errors shared by what was measured in succession, as of a drifting tracker,
    would let the arm's parameters explain as much. None for a target in sockets."""
    refusals: tuple[Reason, ...]
    """Rules of acceptance that failed, in words; none when the result is accepted."""
    posterior: Posterior
    """What is known of the arm, effects that the model leaves out included."""
    region: Region | None
    """Where the calibration may be used; None where it may not be used anywhere."""
    weak: tuple[str, ...] = ()
    """Parameters that the poses hardly determine, held near their nominal values by a prior of the
    size that this arm's errors have."""
    verdicts: tuple[effects.Verdict, ...] = ()
    """Where the model was chosen: what paid for itself and what did not."""
    step: Step | None = None
    """What moved while it was measured (`steps.py`)."""
    remarks: tuple[str, ...] = ()
    """What is suspicious though the figures are good, and what to do (`suspicions.py`)."""
    coupled: bool = False
    """Whether couplings of the wrist that are not fitted explain most of what is left."""
    images: int = 0
    """How many images of a board were fitted."""

    @property
    def accepted(self) -> bool:
        """Tell whether the result may replace the nominal parameters."""
        return not self.refusals

    @property
    def rank(self) -> int:
        """Return the number of parameters that the poses determine."""
        return len(self.names)

    @property
    def covariance(self) -> FloatArray:
        """Return the covariance (P, P) of the fitted parameters."""
        return self.uncertainty.covariance

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Return the parameters that were free but could not be determined."""
        return tuple(p.name for p in self.parameters if p.status in ('gauge', 'not excited'))

    @property
    def not_excited(self) -> tuple[Parameter, ...]:
        """Return those of them that other poses would determine."""
        return tuple(p.name for p in self.parameters if p.status == 'not excited')

    def pose_covariance(self, q: FloatArray) -> FloatArray:
        """Return the expected squares (N, 6, 6) [m, rad] of errors of the pose at q (N, n).

        From the uncertainty of the parameters, and of effects that the model leaves out; position
        and rotation in world axes.
        """
        return self.posterior.expected(q)

    def confidence_ellipsoid(self, q: FloatArray, level: float = 0.95) -> FloatArray:
        """Return (N, 3, 3): rows are the semi-axes [m] of the region of the predicted position.

        By the F distribution where the size of the noise was estimated from the residuals, by
        chi-squared (its limit) where the sigmas given are right.
        """
        if not 0.0 < level < 1.0:
            raise ConfigError(f'level must be between 0 and 1, as 0.95, not {level}')
        jacobian = ErrorModel(self.chain, self.names).jacobian(q)[:, :3]
        sources = self.uncertainty.parts
        shares = np.array([np.einsum('ncp,pr,ncr->n', jacobian, s, jacobian) for s in sources])
        freedom = self.uncertainty.freedom_of(shares)
        values, vectors = np.linalg.eigh(self.pose_covariance(q)[:, :3, :3])
        square = 3.0 * special.fdtri(3, np.minimum(freedom, KNOWN), level)
        square = np.where(freedom > KNOWN, special.chdtri(3, 1.0 - level), square)
        length = np.sqrt(square[:, np.newaxis] * np.maximum(values, 0.0))
        return np.asarray(np.swapaxes(vectors * length[:, np.newaxis, :], 1, 2))

    def predicted_sigma(self, count: int = 300) -> FloatArray:
        """Return standard deviations (count,) [m] of positions predicted all over the joint range.

        The root of the trace of the position's covariance, at seeded random configurations.
        """
        q = self.chain.random_joints(count, np.random.default_rng(0))
        return np.asarray(np.sqrt(np.trace(self.pose_covariance(q)[:, :3, :3], axis1=1, axis2=2)))

    def correlated(self, threshold: float = 0.9) -> tuple[tuple[str, str, float], ...]:
        """Return pairs of parameters whose correlation exceeds a threshold, strongest first."""
        return identifiability.correlated(self.covariance, self.names, threshold)

    def to_frame(self) -> Any:
        """Return the parameters as a pandas.DataFrame [m, rad]; `within_95` are half widths."""
        rows = self.parameters
        return as_frame(
            {
                'parameter': [str(p.name) for p in rows],
                'value': [p.value for p in rows],
                'offset': [p.offset for p in rows],
                'std': [p.std for p in rows],
                'within_95': [p.half_width() for p in rows],
                'unit': [p.name.unit for p in rows],
                'status': [p.status for p in rows],
            }
        )

    def _repr_html_(self) -> str:
        """Return the verdict, its reasons and what was fitted, for notebooks."""
        before, after = (self.validation or self.fitted).figures
        rows = [('parameter', 'offset [mm, mrad]', '± (95 %)')]
        rows += [
            (str(p.name), f'{1e3 * p.offset:+.4f}', f'{1e3 * (p.half_width() or 0.0):.4f}')
            for p in self.parameters
            if p.std is not None
        ]
        figures = f'RMS {before.rms_mm:.3f} → {after.rms_mm:.3f} mm, by {self.validated_by}'
        verdict = 'accepted' if self.accepted else 'not accepted'
        notes = (figures, *self.refusals, *self.remarks)
        return as_html(f'{self.chain.name}: {verdict}', notes, rows)


def identify(
    problem: Problem, simpler: Identification | None = None, progress: Told = nobody
) -> Identification:
    """Identify the parameters of a chain from matched pairs.

    With the result of a `simpler` model, without effects, no sample that it explains is taken for
    a gross error: else a rich model could leave out what contradicts it.

    Raises
    ------
    TooFewObservationsError
        With fewer equations than parameters.
    InputError
        When the fit runs away, with the mistake that explains it, if one does.

    """
    try:
        return _identified(problem, simpler, progress)
    except np.linalg.LinAlgError as err:
        if found := mistakes.explained(problem):
            raise InputError(f'the measurements do not fit the arm at all: {found}') from err
        raise InputError(
            'the fit found no stable answer: check the arm, its joint values and the units, or '
            'measure more poses all over the workspace'
        ) from err


def _identified(
    problem: Problem, simpler: Identification | None, progress: Told
) -> Identification:
    known = Simpler(simpler.chain, simpler.distances, simpler.noise) if simpler else None
    structural, start, fitted = fit(problem, known)
    problem, names, robust, chain = fitted.problem, fitted.names, fitted.robust, fitted.chain
    progress(1 / 2)  # of many poses (benchmarks/end_to_end.py)
    frames = [name for name in names if start.owns_frame(name)]
    if robust.system.count > 4 * SOME:
        start = minimise(start, frames, robust.system.spread(SOME)).chain
    before = minimise(start, frames, robust.system, tolerance=1e-5)
    explained = simpler.validation.judged if simpler and simpler.validation else None
    progress(2 / 3)
    validation, validated_by = validate(problem, before.chain, chain, names, robust, explained)
    parameters = parameter_rows(problem, chain, structural, names, fitted.uncertainty)
    coarse = rounded(problem)
    share = suspicions.lacking(problem, chain, names, fitted.noise.position)
    size, doubts = _size(fitted, share), rounding_errors(problem, coarse)
    posterior = fitted.posterior(size, considered(chain, names, problem.fixed), doubts)
    step = find_step(problem, names, robust)
    result = Identification(
        chain=chain,
        before=before.chain,
        parameters=parameters,
        names=names,
        uncertainty=fitted.uncertainty,
        fitted=compare(before.chain, chain, problem.sets, ~robust.outliers),
        validation=validation,
        validated_by=validated_by,
        noise=fitted.noise,
        distances=robust.distances,
        outliers=outliers_of(problem, robust),
        gauges=_gauges(problem, chain, names),
        observability=identifiability.observability(fitted.factor, robust.system.count),
        priors=_priors(problem),
        world_frame=problem.world_frame,
        iterations=robust.iterations,
        converged=before.converged and robust.fit.converged and robust.settled,
        chance=_chance(problem, before.chain, names, robust),
        refusals=(),
        posterior=posterior,
        region=region_of(posterior, problem.sets, fitted.uncertainty.overall),
        weak=_weak(problem, parameters),
        step=step,
        remarks=remarks(problem, step, coarse),
        coupled=share > 0.0,
        images=sum(distinct(s.images) for s in problem.sets if s.pixels is not None),
    )
    own_behaviour = None if step else arms_own(problem, robust)
    rounding = may_be_rounding(problem, before.chain, names, coarse, robust.good)
    refused = refusals(problem, result, own_behaviour, rounding, fitted.held is None)
    result = replace(result, refusals=refused)
    named = mistakes.remarked(problem, result)
    return suspicions.remarked(problem, named, another=named is result)


def _size(fitted: Fitted, explained: float) -> float:
    """Return the size of the noise [sigma given] without the share that is explained.

    No explanation makes it smaller than that given. Targets of one stop share what a model lacks.
    """
    size = max(float(np.sqrt(1.0 - explained)) * fitted.size, min(fitted.size, 1.0))
    if fitted.noise.consistent:
        return size
    numbers = fitted.problem.configurations
    seen = sum(distinct(each) for each in numbers)
    return size * float(np.sqrt(seen / distinct(np.concatenate(numbers))))


def _priors(problem: Problem) -> dict[str, float]:
    """Return the priors that were known before: those of effects, and those given."""
    known = {name: problem.prior_sigmas[name] for name, _ in problem.model.effects}
    return {**known, **problem.given}


def _chance(problem: Problem, before: Chain, names: Sequence[str], robust: Robust) -> float | None:
    """Return how probable it is that what the arm's parameters explain is chance (`drift.py`).

    None for a target in sockets: nothing measures there that could drift.
    """
    if any(each.socket for each in problem.sets):
        return None
    sets = [
        each.select(np.flatnonzero(which)).spread(SOME)
        for each, which in zip(problem.sets, robust.good, strict=True)
    ]
    frames = [name for name in names if before.owns_frame(name)]
    arm = [name for name in names if not before.owns_frame(name)]
    return chance_of_gain(before, frames, arm, problem.system(sets, learned=False))


def _weak(problem: Problem, parameters: Sequence[ParameterRow]) -> tuple[str, ...]:
    """Return the DH parameters that the poses tell less of than what is known of other arms."""
    if problem.learned is None:
        return ()
    learned = {n: x for n, x in problem.learned.priors.items() if n not in _priors(problem)}
    stds = [(p.name, p.std) for p in parameters if p.std is not None and p.name in learned]
    return tuple(name for name, std in stds if std**2 > 0.5 * learned[name] ** 2)


def _gauges(problem: Problem, chain: Chain, names: Sequence[str]) -> dict[str, list[str]]:
    """Return what each parameter that was left out trades against, seen on a part of the pairs."""
    free = problem.free
    if len(names) == len(free):
        return {}
    few = problem.system([each.spread(SOME) for each in problem.sets])
    normal = normal_equations(chain, free, System(few.sets))
    return identifiability.trades(normal.matrix, free, names)
