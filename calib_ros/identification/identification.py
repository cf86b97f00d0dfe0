# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From matched pairs to the errors of the chain's parameters: Problem -> Identification.

The steps of `identify` are those of Vacarescu et al., section 3: measure, linearise the pose
errors in the parameter errors, solve by least squares, correct the parameters, and repeat until
the step vanishes. The rest makes the result trustworthy (docs/model.md, Judgement).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from calib_ros.annotated import as_annotated
from calib_ros.decision import mistakes, plausibility
from calib_ros.decision.acceptance import oddities, refusals
from calib_ros.decision.comparison import Comparison, compare
from calib_ros.decision.delays import timed
from calib_ros.decision.drift import chance_of_gain
from calib_ros.decision.frozen import frozen_sources
from calib_ros.decision.misfits import arms_own, coupling_share, outliers_of
from calib_ros.decision.region import Region
from calib_ros.decision.result import Identification
from calib_ros.decision.risk import region_of
from calib_ros.decision.rounding import (
    lost_digits,
    may_be_rounding,
    rounded_joints,
    rounding_errors,
    with_lost_digits,
)
from calib_ros.decision.steps import find_step
from calib_ros.decision.strain import strain_of
from calib_ros.decision.validation import as_at_rest, held_out_excess, validate
from calib_ros.decision.wires import wrong_distances
from calib_ros.errors import InputError
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.considered import considered
from calib_ros.estimation.evidence import Inference
from calib_ros.estimation.fitted import Fitted, ParameterRow, SimplerFit, parameter_rows
from calib_ros.estimation.fitting import SOME, fit
from calib_ros.estimation.gross_errors import SUSPICIOUS
from calib_ros.estimation.leastsquares import Fit, minimise
from calib_ros.estimation.levels import SCALE
from calib_ros.estimation.normal import normal_equations
from calib_ros.estimation.observability import observability, trades
from calib_ros.estimation.posterior import Posterior
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.system import System
from calib_ros.estimation.uncertainty import Uncertainty
from calib_ros.estimation.unmodelled import unmodelled_errors
from calib_ros.kinematics.chain import Chain
from calib_ros.progress import Notify, quiet
from calib_ros.settings import EXCEPTION


@as_annotated
@np.errstate(divide='ignore', over='ignore', invalid='ignore')  # of a diverging fit
def identify(
    problem: Problem, simpler: Identification | None = None, progress: Notify = quiet
) -> Identification:
    """Identify the parameters of a chain from matched pairs.

    With the result of a `simpler` model, without effects, samples that it explains are no gross
    errors: otherwise a rich model could leave out what contradicts it.

    Raises TooFewObservationsError with fewer equations than parameters. Raises InputError if the
    fit diverges; the message names the mistake that explains it, if any.
    """
    try:
        problem, late = timed(problem)
        result = _identified(problem, simpler, progress)
        told = sorted(result.refusals, key=lambda each: each.rule.value)
        remarks = (each for each in (*late, *result.remarks) if each not in told)
        return replace(result, refusals=tuple(told), remarks=tuple(remarks))
    except np.linalg.LinAlgError as err:
        if found := mistakes.diagnose(problem):
            raise InputError(f'the measurements do not fit the arm: {found}') from err
        raise InputError(
            'the fit found no stable solution: check the arm, joint values and units, or measure '
            'more poses all over the workspace'
        ) from err


def _identified(
    problem: Problem, simpler: Identification | None, progress: Notify
) -> Identification:
    known = SimplerFit(simpler.chain, simpler.distances, simpler.noise) if simpler else None
    fitted = fit(problem, known)
    problem, names, robust, chain = fitted.problem, fitted.names, fitted.robust, fitted.chain
    progress(1 / 2)  # with many poses (benchmarks/end_to_end.py)
    before = _in_best_frames(fitted)
    explained = simpler.validation.judged if simpler and simpler.validation else None
    progress(2 / 3)
    validation, validated_by = validate(fitted, before.chain, explained)
    by_couplings, lost = coupling_share(fitted), lost_digits(problem, chain)
    coarse = rounded_joints(problem) | lost
    more = considered(chain, names, problem.fixed, problem.sets)
    (strain, by_strain), rounding = strain_of(fitted), rounding_errors(problem, coarse)
    # of the least noise couplings are a part: they are no strain
    noise, least = _size(fitted, by_couplings), _size(fitted, by_strain)
    inference = Inference(fitted, noise, more, rounding, bool(strain), least)
    posterior, uncertainty, surprise, wider = _inferred(inference, validation)
    at_rest = partial(as_at_rest, fitted=fitted, posterior=posterior.widened(wider))
    judged = compare(before.chain, chain, problem.sets, ~robust.outliers, uncertainty.together)
    parameters = parameter_rows(fitted, uncertainty)
    region, scaled = _region(inference, posterior, wider)
    stuck, thawed = frozen_sources(fitted)
    wrong, corrected = wrong_distances(fit(problem.with_sets(thawed)) if stuck else fitted)
    result = Identification(
        chain=chain,
        before=before.chain,
        parameters=parameters,
        names=names,
        uncertainty=uncertainty,
        fitted=at_rest(judged),
        validation=validation and at_rest(replace(validation, together=uncertainty.together)),
        validated_by=validated_by,
        noise=fitted.noise,
        distances=robust.distances,
        outliers=outliers_of(fitted),
        gauges=_gauges(fitted),
        observability=observability(fitted.factor, robust.system.count),
        priors=_priors(problem),
        problem=problem,
        converged=before.converged and robust.fit.converged and robust.settled,
        chance=_chance(fitted, before.chain),
        refusals=wrong,
        posterior=posterior.widened(wider),
        region=region,
        weak=_weak(problem, parameters),
        step=(step := find_step(corrected) if corrected else None),
        remarks=(*stuck, *oddities(problem, posterior, step, coarse)),
        coupled=by_couplings > 0.0,
        surprise=surprise,
        strain=strain,
        images=sum(count_distinct(s.images) for s in problem.sets if s.pixels is not None),
    )
    own = None if step and not step.slow else arms_own(fitted)
    verdicts = own, may_be_rounding(fitted, before.chain, coarse), fitted.held is None, scaled
    refused = with_lost_digits(refusals(problem, result, *verdicts), lost)
    result = replace(result, refusals=wrong + refused)
    named = mistakes.with_mistake(problem, result)
    return plausibility.add_remarks(problem, named, another=named is result)


def _in_best_frames(fitted: Fitted) -> Fit:
    """Return the fit of the frames of the nominal arm; no error of it delays the device."""
    start, system, frames = fitted.start, fitted.robust.system, fitted.frames
    delays = {*filter(start.owns_frame, fitted.names)} - {*frames}
    start = start.with_offsets({n: fitted.chain.value(n) - start.value(n) for n in delays})
    if system.count > 4 * SOME:
        most = max(SOME, int(EXCEPTION * system.count))
        start = minimise(start, frames, system.spread(most)).chain
    return minimise(start, frames, system, tolerance=1e-5)


def _inferred(
    inference: Inference, validation: Comparison | None
) -> tuple[Posterior, Uncertainty, float, float]:
    """Return the posterior with what no parameter explains, and the uncertainty of the fit.

    Then follow by how much held-out poses surprise, and the factor that uncertainty has for it.
    """
    fitted, posterior = inference.fitted, inference.judging()
    unmodelled, moved = unmodelled_errors(posterior, fitted.factor, fitted.system)
    posterior = inference.with_mixture(replace(posterior, unmodelled=unmodelled))
    uncertainty = fitted.uncertainty.with_part(moved).with_part(unmodelled.square)
    surprise, wider = held_out_excess(fitted, posterior, validation)
    return posterior, replace(uncertainty, parts=wider**2 * uncertainty.parts), surprise, wider


def _region(
    inference: Inference, posterior: Posterior, wider: float
) -> tuple[Region | None, float]:
    """Return the region, and the error of the device's scale if that alone leaves none, or 0.

    All expected errors are larger by a factor `wider`.
    """
    fitted, problem = inference.fitted, inference.fitted.problem
    freedom = fitted.uncertainty.overall
    of = partial(region_of, sets=problem.sets, freedom=freedom, largest=problem.largest_error)
    if not fitted.noise.consistent and fitted.size > SUSPICIOUS:
        of = partial(of, incomplete=True)
    region = of(posterior.widened(wider))
    printed = all(each.pixels is not None for each in problem.sets)
    finer = SCALE if printed else EXCEPTION * SCALE  # as of a tracker
    doubtful = inference.strained or not 0.0 < problem.sigma_scale <= finer
    if region is None and posterior.scale and doubtful:
        robust = replace(fitted.robust, system=replace(fitted.system, sigma_scale=finer))
        checked = replace(fitted, problem=replace(problem, sigma_scale=finer), robust=robust)
        known = replace(inference, fitted=checked, strained=False).with_mixture(posterior)
        if of(known.widened(wider)) is not None:
            return None, posterior.scale
    return region, 0.0


def _size(fitted: Fitted, explained: float) -> float:
    """Return the size of the noise [sigma given] without the explained share.

    At least the given sigma counts. Targets of one stop share unmodelled errors.
    """
    size = max(float(np.sqrt(1.0 - explained)) * fitted.size, min(fitted.size, 1.0))
    if fitted.noise.consistent:
        return size
    numbers = fitted.problem.configurations
    seen = sum(count_distinct(each) for each in numbers)
    return size * float(np.sqrt(seen / count_distinct(np.concatenate(numbers))))


def _priors(problem: Problem) -> dict[str, float]:
    """Return the priors of effects and the given ones."""
    known = {name: problem.prior_sigmas[name] for name, _ in problem.model.effects}
    return {**known, **problem.given}


def _chance(fitted: Fitted, before: Chain) -> float | None:
    """Return the probability that the arm's parameters explain only drift (`drift.py`).

    None for sockets: no device could drift.
    """
    problem, names = fitted.problem, fitted.names
    if any(each.socket for each in problem.sets):
        return None
    frames = [name for name in names if before.owns_frame(name)]
    arm = [name for name in names if not before.owns_frame(name)]
    system = replace(problem, learned=None).system(fitted.good_sets(SOME))
    return chance_of_gain(before, frames, arm, system)


def _weak(problem: Problem, parameters: Sequence[ParameterRow]) -> tuple[str, ...]:
    """Return the DH parameters that the poses determine less than the learned priors."""
    if problem.learned is None:
        return ()
    known = _priors(problem)
    learned = {n: x for n, x in problem.learned.priors.items() if n not in known}
    stds = [(p.name, p.std) for p in parameters if p.std is not None and p.name in learned]
    return tuple(name for name, std in stds if std**2 > 0.5 * learned[name] ** 2)


def _gauges(fitted: Fitted) -> dict[str, list[str]]:
    """Return what each left-out parameter trades against, by a part of the pairs."""
    problem, names, free = fitted.problem, fitted.names, fitted.problem.free
    if len(names) == len(free):
        return {}
    few = problem.system([each.spread(SOME) for each in problem.sets])
    normal = normal_equations(fitted.chain, free, System(few.sets))
    return trades(normal.matrix, free, names)
