# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From matched pairs to the errors of the chain's parameters: Problem -> Identification.

The steps of `identify` are those of Vacarescu et al., section 3: measure, write the pose errors
as a linear model of the parameter errors, solve by least squares, correct the parameters, and
repeat until the step vanishes. Around it stand what makes the result trustworthy: frames that
need no guess, gauge freedoms found and named, and a judgement on poses that were not fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from calib_ros.errors import InputError, TooFewObservationsError
from calib_ros.identification import identifiability, mistakes, suspicions
from calib_ros.identification.drift import chance_of_gain
from calib_ros.identification.evidence import Posterior, considered, posterior_of
from calib_ros.identification.leastsquares import (
    System,
    factor_of,
    factor_of_some,
    minimise,
    triangular_factor,
)
from calib_ros.identification.misfits import arms_own
from calib_ros.identification.noise import Noise, noise_of
from calib_ros.identification.observations import Observations
from calib_ros.identification.problem import Learned, Problem
from calib_ros.identification.reasons import Reason
from calib_ros.identification.region import KNOWN, Region, region_of
from calib_ros.identification.robust import OUTLIER, Robust, reweighted, thorough_fit
from calib_ros.identification.rounding import may_be_rounding, rounded, rounding_errors
from calib_ros.identification.start import start_frames
from calib_ros.identification.steps import Step, find_step
from calib_ros.identification.validation import (
    Comparison,
    ParameterRow,
    compare,
    refusals,
    remarks,
    residuals,
    validate,
)
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import parameters_of
from calib_ros.kinematics.se3 import FloatArray, left_jacobian_inverse
from calib_ros.shown import Shown

__all__ = ['Identification', 'Noise', 'Outlier', 'Problem', 'identify', 'residuals']

SOME = 500
"""Pairs that are enough for a first fit."""
FOLLOWED = 2.0
"""Part of what it lacks that the geometric model does not follow: one over this."""
HELD = 0.05
"""Share of a parameter's variance that is its prior's from which on the prior is fitted with."""


@dataclass(frozen=True)
class Outlier:
    """A sample of gross error: where it is found, and its size in units of the usual error."""

    set: int
    sample: int
    stamp_ns: int
    size: float


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Shown):
    """The result; a poor fit is data in it, not an error.

    Attributes
    ----------
    chain : Chain
        Corrected chain with fitted frames.
    before : Chain
        Nominal chain with fitted frames.
    parameters : tuple of ParameterRow
        Every parameter of the model.
    names, uncertainty : tuple of str, Uncertainty
        Fitted parameters and their covariance for the noise found in the residuals.
    fitted, validation : Comparison
        Residuals on the fitted pairs and on pairs that were not fitted. The latter is None when
        there are too few configurations to hold any out.
    validated_by : str
        How the pairs of `validation` were held out.
    noise : Noise
    distances : tuple of (N,)
        Size of the residuals of each set's samples in units of the usual one (`robust.py`).
    outliers : tuple of Outlier
        Samples of gross error; they carry no or little weight in the fit.
    gauges : dict
        For each parameter that was left out, the fitted ones that it trades against.
    observability : Observability
    rank, iterations : int
    converged : bool
    chance : float or None
        Probability that errors shared by what was measured in succession, as of a drifting
        tracker, would let the arm's parameters explain as much. None for a target in sockets.
    refusals : tuple of Reason
        Rules of acceptance that failed, in words; none when the result is accepted.
    posterior : Posterior
        What is known of the arm, effects that the model leaves out included.
    region : Region or None
        Where the calibration may be used; None where it may not be used anywhere.
    weak : tuple of str
        Parameters that the poses hardly determine, held near their nominal values by a prior of
        the size that this arm's errors have.
    verdicts : tuple of Verdict
        Where the model was chosen: what paid for itself and what did not.
    step : Step or None
        What moved while it was measured (`steps.py`).
    remarks : tuple of str
        What is suspicious though the figures are good, and what to do (`suspicions.py`).

    """

    chain: Chain
    before: Chain
    parameters: tuple[ParameterRow, ...]
    names: tuple[str, ...]
    uncertainty: identifiability.Uncertainty
    fitted: Comparison
    validation: Comparison | None
    validated_by: str
    noise: Noise
    distances: tuple[FloatArray, ...]
    outliers: tuple[Outlier, ...]
    gauges: dict[str, list[str]]
    observability: identifiability.Observability
    priors: dict[str, float]
    world_frame: str
    iterations: int
    converged: bool
    chance: float | None
    refusals: tuple[Reason, ...]
    posterior: Posterior
    region: Region | None
    weak: tuple[str, ...] = ()
    verdicts: tuple[effects.Verdict, ...] = ()
    step: Step | None = None
    remarks: tuple[str, ...] = ()

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
        """Return the pairs of parameters whose correlation exceeds a threshold."""
        return identifiability.correlated(self.covariance, self.names, threshold)

    @property
    def not_excited(self) -> tuple[str, ...]:
        """Return those of them that other poses would determine."""
        return tuple(p.name for p in self.parameters if p.status == 'not excited')


def identify(problem: Problem, simpler: Identification | None = None) -> Identification:
    """Identify the parameters of a chain from matched pairs.

    With the result of a `simpler` model, without effects, no sample that it explains is taken for
    a gross error: else a rich model could leave out what contradicts it.

    Raises
    ------
    TooFewObservationsError
        With fewer equations than parameters.

    """
    model = problem.model
    system = problem.system(problem.sets)
    structural = identifiability.structurally_independent(
        model, problem.free, problem.kinds, system.separation_rows
    )
    priors = problem.prior_sigmas
    determined = [name for name in structural if name not in priors]
    _require_enough(problem, determined)
    start = start_frames(
        model, problem.sets, problem.sigma_position, problem.sigma_orientation, problem.loss
    )
    wanted = [n for n in problem.free if n in structural or n in priors]
    few = problem.system([_some(each) for each in problem.sets])
    factor = factor_of(start, wanted, few)
    names = identifiability.excited(factor, wanted)
    if len(names) < len(wanted) and few.count < system.count:  # more samples may determine more
        names = identifiability.excited(triangular_factor(start, wanted, system), wanted)
    factor = factor_of_some(factor, [k for k, name in enumerate(wanted) if name in names])
    problem = _guarded(problem, names, factor, simpler)
    rough = start
    if simpler is not None:
        rough = simpler.chain.with_effects([name for name, _ in model.effects])
    elif few.count < system.count // 2:
        few = problem.system([_some(each) for each in problem.sets])
        rough = minimise(start, names, few, tolerance=1e-2).chain
    fitted = _fit(problem, rough, names, simpler)
    guarded = _guarded(problem, names, fitted.factor, simpler)
    if guarded is not problem:  # without its outliers a session tells less
        problem = guarded
        fitted = _fit(problem, rough, names, simpler)
    whole = fitted.noise.size
    size = _told_by(fitted.noise, simpler)
    told = _posterior(problem, fitted, names, size)
    if _matter(problem, names, told):
        priors = {
            name: min(told.priors[name], problem.common_sense(name))
            for name in names
            if not model.owns_frame(name)
        }
        problem = replace(problem, learned=Learned(priors, size))
        fitted = _fit(problem, fitted.robust.fit.chain, names, simpler, again=True)
    robust, noise, uncertainty = fitted.robust, fitted.noise, fitted.uncertainty
    fit = robust.fit
    before = minimise(start, [n for n in names if model.owns_frame(n)], fitted.system)
    explained = (
        None if simpler is None or simpler.validation is None else simpler.validation.judged
    )
    validation, validated_by = validate(problem, before.chain, fit.chain, names, robust, explained)
    parameters = _parameters(problem, fit.chain, structural, names, uncertainty)
    chance = _chance(problem, before.chain, names, robust)
    converged = before.converged and fit.converged and robust.settled
    if not noise.consistent:  # targets of one stop share what the model lacks
        whole *= _targets(problem)
    coarse = rounded(problem)
    posterior = _posterior(
        problem,
        fitted,
        names,
        whole,
        considered(fit.chain, names),
        rounding_errors(problem, coarse),
    )
    region = region_of(posterior, problem.sets, uncertainty.overall)
    step = find_step(problem, names, robust)
    own = arms_own(problem, robust) if step is None else None
    good = [distances <= OUTLIER for distances in robust.distances]
    unsure = bool(coarse) and may_be_rounding(problem, before.chain, names, coarse, good)
    known = {name: problem.prior_sigmas[name] for name, _ in model.effects}
    failed = refusals(
        problem, converged, parameters, validation, chance, region, step, own, unsure
    )
    result = Identification(
        chain=fit.chain,
        before=before.chain,
        parameters=parameters,
        names=names,
        uncertainty=uncertainty,
        fitted=replace(compare(before.chain, fit.chain, problem.sets), judged=~robust.outliers),
        validation=validation,
        validated_by=validated_by,
        noise=noise,
        distances=robust.distances,
        outliers=_outliers(problem, robust),
        gauges=_gauges(problem, fit.chain, names),
        observability=identifiability.observability(fitted.factor, system.count),
        priors={**known, **problem.given},
        world_frame=problem.world_frame,
        iterations=robust.iterations,
        converged=converged,
        chance=chance,
        refusals=failed,
        posterior=posterior,
        region=region,
        weak=_weak(problem, parameters),
        step=step,
        remarks=remarks(problem, step, coarse),
    )
    named = mistakes.remarked(problem, result)
    return suspicions.remarked(problem, named, another=named is result)


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A robust fit with what follows from its residuals."""

    system: System
    robust: Robust
    factor: FloatArray
    noise: Noise
    uncertainty: identifiability.Uncertainty


def _fit(
    problem: Problem,
    chain: Chain,
    names: Sequence[str],
    simpler: Identification | None,
    again: bool = False,
) -> _Fitted:
    """Fit the named parameters from a chain that is near, or `again` from one that was fitted."""
    system = problem.system(problem.sets)
    if simpler is None and not again:
        robust = thorough_fit(chain, names, system, problem.loss)
    else:
        distances = None if simpler is None else simpler.distances
        robust = reweighted(chain, names, system, problem.loss, distances)
    fit = robust.fit
    factor = fit.normal.factor()
    if factor is None:
        factor = triangular_factor(fit.chain, names, system)
    noise, uncertainty = noise_of(fit, names, system, factor)
    return _Fitted(system, robust, factor, noise, uncertainty)


def _posterior(
    problem: Problem,
    fitted: _Fitted,
    names: Sequence[str],
    noise: float,
    more: Sequence[str] = (),
    doubts: Mapping[str, float] | None = None,
) -> Posterior:
    """Return what the data of a fit tell, with `more` effects considered."""
    chain, system = fitted.robust.fit.chain, fitted.system
    return posterior_of(chain, problem.model, names, system, noise, problem.given, more, doubts)


def _targets(problem: Problem) -> float:
    """Return the root of how many sets see a configuration, on average."""
    numbers = problem.configurations
    seen = sum(len(np.unique(each)) for each in numbers)
    return float(np.sqrt(seen / len(np.unique(np.concatenate(numbers)))))


def _told_by(noise: Noise, simpler: Identification | None) -> float:
    """Return the size of the noise [sigma given] against which a prior is weighed.

    What the geometric model lacks is no noise to it: it can follow a part of it. On measured
    robots errors in regions left out were least with more weight on the prior, those on held-out
    rows of the same session with less; with what is not shared by neighbours, over FOLLOWED, they
    are those of least squares (`benchmarks/real_robots.py`).
    """
    if simpler is not None or noise.consistent:
        return noise.size
    return max(noise.size / (FOLLOWED * noise.widened), min(noise.size, 1.0))


def _guarded(
    problem: Problem, names: Sequence[str], factor: FloatArray, simpler: Identification | None
) -> Problem:
    """Return the problem with priors that keep a first fit from going astray.

    `factor` (P, P) is that of some samples at the start, or of what a robust fit has left. DH
    parameters that they tell no better than common sense does get a third of what no faulty robot
    exceeds as a prior.
    """
    known = problem.prior_sigmas
    stds = np.sqrt(np.diag(identifiability.covariance(factor))).tolist()
    guards = {
        name: problem.common_sense(name)
        for name, std in zip(names, stds, strict=True)
        if name not in known
        and not problem.model.owns_frame(name)
        and std > problem.common_sense(name)
    }
    if problem.learned is not None:
        more = replace(problem.learned, priors={**problem.learned.priors, **guards})
        return replace(problem, learned=more) if guards else problem
    noise = 1.0 if simpler is None else _told_by(simpler.noise, None)
    return replace(problem, learned=Learned(guards, noise)) if guards or simpler else problem


def _matter(problem: Problem, names: Sequence[str], posterior: Posterior) -> bool:
    """Tell whether priors that the data have told would change a fit without them."""
    if problem.learned is not None or problem.model.effects:
        return True
    return any(posterior.held(name) > HELD for name in names if name not in problem.given)


def _chance(problem: Problem, before: Chain, names: Sequence[str], robust: Robust) -> float | None:
    """Return how probable it is that what the arm's parameters explain is chance (`chance.py`).

    None for a target in sockets: nothing measures there that could drift.
    """
    if any(each.socket for each in problem.sets):
        return None
    good = [distances <= OUTLIER for distances in robust.distances]
    sets = [
        _some(each.select(np.flatnonzero(which)))
        for each, which in zip(problem.sets, good, strict=True)
    ]
    frames = [name for name in names if before.owns_frame(name)]
    arm = [name for name in names if not before.owns_frame(name)]
    return chance_of_gain(before, frames, arm, problem.system(sets, learned=False))


def _weak(problem: Problem, parameters: Sequence[ParameterRow]) -> tuple[str, ...]:
    """Return the DH parameters that the poses tell less of than what is known of other arms."""
    if problem.learned is None:
        return ()
    known, learned = {*dict(problem.model.effects), *problem.given}, problem.learned.priors
    return tuple(
        p.name
        for p in parameters
        if p.std is not None
        and p.name in learned
        and p.name not in known
        and p.std**2 > 0.5 * learned[p.name] ** 2
    )


def _some(observations: Observations) -> Observations:
    """Return enough pairs, evenly spread, to come close to the result and to see its rank."""
    return observations.select(np.arange(0, len(observations), 1 + len(observations) // SOME))


def _gauges(problem: Problem, chain: Chain, names: Sequence[str]) -> dict[str, list[str]]:
    """Return what each parameter that was left out trades against, seen on a part of the pairs."""
    free = problem.free
    if len(names) == len(free):
        return {}
    few = problem.system([_some(each) for each in problem.sets])
    factor = triangular_factor(chain, free, few, priors=False)
    return identifiability.trades(factor, free, names)


def _outliers(problem: Problem, robust: Robust) -> tuple[Outlier, ...]:
    if problem.loss == 'none':
        return ()
    found = []
    for number, (each, distances) in enumerate(zip(problem.sets, robust.distances, strict=True)):
        for sample in np.flatnonzero(distances > OUTLIER):
            stamp = int(each.stamps_ns[sample])
            found.append(Outlier(number, int(sample), stamp, float(distances[sample])))
    return tuple(found)


def _require_enough(problem: Problem, names: Sequence[str]) -> None:
    rows = configurations = 0
    for each, kind in zip(problem.sets, problem.kinds, strict=True):
        if not len(each):
            raise InputError(f'there are no pairs to fit between {each.base} and {each.tool}')
        count = int(each.configurations.max()) + 1
        rows += count * kind.rows
        configurations += count
    if rows < len(names):
        width = problem.kinds[0].rows
        raise TooFewObservationsError(
            configurations,
            -(-len(names) // width),
            f'{width} equations each for {len(names)} parameters',
        )


def _parameters(
    problem: Problem,
    chain: Chain,
    structural: Sequence[str],
    names: Sequence[str],
    uncertainty: identifiability.Uncertainty,
) -> tuple[ParameterRow, ...]:
    change = _to_values(chain, names)
    variances = np.einsum('vp,kpr,vr->kv', change, uncertainty.parts, change, optimize=True)
    std = dict(zip(names, np.sqrt(variances.sum(axis=0)).tolist(), strict=True))
    freedom = dict(zip(names, uncertainty.freedom_of(variances).tolist(), strict=True))
    free = set(problem.free)
    rows = []
    for name in chain.parameter_names:
        if name in std:
            status = 'fitted'
        elif name in structural:
            status = 'not excited'
        else:
            status = 'gauge' if name in free else 'fixed'
        offset = chain.offset(name, problem.model)
        value, spread = chain.value(name), std.get(name)
        rows.append(ParameterRow(name, value, offset, spread, status, freedom.get(name, np.inf)))
    return tuple(rows)


def _to_values(chain: Chain, names: Sequence[str]) -> FloatArray:
    """Return the derivative (P, P) of the values: of rotation vectors, where frames were turned.

    A turn by w in the parent's axes changes the vector v = log R by J_l(v)^-1 w.
    """
    change = np.eye(len(names))
    for frame in chain.frame_names:
        index = [names.index(name) for name in parameters_of(frame)[3:] if name in names]
        if len(index) == 3:
            vector = chain.frame(frame).offsets()[3:]
            change[np.ix_(index, index)] = left_jacobian_inverse(vector)
    return change
