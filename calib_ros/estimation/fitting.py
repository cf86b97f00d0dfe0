# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The fit itself: its parameters, start, priors and noise.

A first fit to some samples comes close. If the robust fit to all yields priors that would change
it (`evidence.py`), it is repeated with them; with effects, until the noise no longer falls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.linalg import solve_triangular

from calib_ros.errors import InputError, TooFewObservationsError
from calib_ros.estimation.evidence import Inference
from calib_ros.estimation.fitted import Fitted, SimplerFit
from calib_ros.estimation.gauges import identifiable_and_held
from calib_ros.estimation.gross_errors import SUSPICIOUS, thorough_fit
from calib_ros.estimation.identifiability import excited
from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.levels import CONFIDENT
from calib_ros.estimation.noise import Noise, noise_of
from calib_ros.estimation.normal import factor_of, triangular_factor
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.pixels import in_view
from calib_ros.estimation.problem import Learned, Problem
from calib_ros.estimation.robust import reweighted
from calib_ros.estimation.shared_errors import squares_of
from calib_ros.estimation.sizes import LEAST_SIZE, SETTLED, SPREAD
from calib_ros.estimation.start import start_frames
from calib_ros.estimation.system import System
from calib_ros.estimation.uncertainty import covariance
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import ROUNDING, ROUNDS, FloatArray
from calib_ros.shown import counted

SOME = 2 * SOME_POSES  # samples for a first fit or a linear model
FOLLOWED = 2.0
"""Inverse share of the unmodelled error that the geometric model does not follow
(benchmarks/real_robots.py)."""


def fit(problem: Problem, simpler: SimplerFit | None = None) -> Fitted:
    """Fit what the poses determine."""
    model, separations = problem.model, System((), None, (*problem.separations,)).separation_rows
    structural, held = identifiable_and_held(model, problem.free, problem.sets, separations)
    _require_enough(problem, [name for name in structural if name not in problem.prior_sigmas])
    fitted = _fit_all(problem, structural, start_frames(problem), simpler)
    held = tuple(name for name in held if name not in fitted.names)  # unless a prior tells them
    return _widened(fitted, held) if held else fitted


def _widened(fitted: Fitted, held: tuple[str, ...]) -> Fitted:
    """Return a fit with K parameters held at nominal, as uncertain as others of the arm."""
    count = len(fitted.names)
    factor = factor_of(fitted.chain, (*fitted.names, *held), fitted.system)
    slopes = -solve_triangular(factor[:count, :count], factor[:count, count:])
    stds = Inference(fitted, fitted.size).likeliest().stds_of(held)
    shared = (slopes * stds**2) @ slopes.T
    return replace(fitted, uncertainty=fitted.uncertainty.with_part(shared), held=(held, slopes))


def _excited_names(
    problem: Problem, structural: Sequence[str], start: Chain
) -> tuple[tuple[str, ...], FloatArray]:
    """Return the parameters that the poses determine, and their factor by some samples."""
    priors = problem.prior_sigmas
    wanted = [n for n in problem.free if n in structural or n in priors]
    few, every = problem.system([each.spread(SOME) for each in problem.sets]), problem.sets
    factor = factor_of(start, wanted, _seen(start, few))
    names = excited(factor, wanted)
    if len(names) < len(wanted) and few.count < sum(map(len, every)):  # more may determine more
        system = _seen(start, problem.system(every))
        names = excited(triangular_factor(start, wanted, system), wanted)
    return names, np.asarray(np.linalg.qr(factor[:, np.isin(wanted, names)], mode='r'))


def _seen(start: Chain, system: System) -> System:
    """Return a system without the few board points that a start sees far from where they are."""
    return system.weighted([in_view(start, e.observations).astype(float) for e in system.sets])


def _fit_all(
    problem: Problem, structural: tuple[str, ...], start: Chain, simpler: SimplerFit | None
) -> Fitted:
    """Fit what the poses determine from start frames, with priors where needed."""
    names, factor = _excited_names(problem, structural, start)
    fit_from = partial(_fit, structural, start, names)
    problem = _guarded(problem, names, factor, simpler)
    rough = start
    if simpler is not None:
        rough = simpler.chain.with_effects([name for name, _ in problem.model.effects])
    few = problem.system([each.spread(SOME) for each in problem.sets])
    if few.count < sum(map(len, problem.sets)) // 2:
        rough = minimise(rough, names, few, tolerance=1e-2).chain
    fitted = fit_from(rough, *_thin_problem(problem, simpler))
    guarded = _guarded(problem, names, fitted.factor, simpler)
    if guarded is not problem:  # outliers carried the information
        problem = guarded
        fitted = fit_from(rough, *_thin_problem(problem, simpler))
    richer = simpler is not None or bool(problem.model.effects)
    size, first = _noise_for_priors(fitted.noise, richer), fitted.size
    if simpler is None and (fitted.noise.consistent or size <= 1.0):
        size = min(size, _likely_noise(fitted))
    posterior = Inference(fitted, size).likeliest()
    told = (posterior.prior_share(n) <= 1.0 - CONFIDENT for n in names if n not in problem.given)
    if problem.learned is None and not problem.model.effects and all(told):
        return fitted  # the priors found would not change the fit
    for _ in range(ROUNDS):
        priors = {
            name: min(posterior.priors[name], problem.common_sense(name))
            for name in names
            if not problem.model.owns_frame(name)
        }
        problem = replace(problem, learned=Learned(priors, size))
        fitted = fit_from(fitted.chain, problem, simpler, again=True)
        less = _noise_for_priors(fitted.noise, richer)
        if not richer or SUSPICIOUS * less > size:
            break
        size = less  # too narrow priors had made it larger
        posterior = Inference(fitted, size).likeliest()
    return replace(fitted, size=first if simpler is None else min(first, less))


def _thin_problem(
    problem: Problem, simpler: SimplerFit | None
) -> tuple[Problem, SimplerFit | None]:
    """Thin a problem to the samples that determine the priors of a richer model."""
    stride = -(-sum(map(len, problem.sets)) // (2 * SOME))
    if simpler is None or stride < 2:
        return problem, simpler
    few = problem.with_sets(s.select(np.arange(0, len(s), stride)) for s in problem.sets)
    return few, replace(simpler, distances=tuple(each[::stride] for each in simpler.distances))


def _fit(
    structural: tuple[str, ...],
    start: Chain,
    names: tuple[str, ...],
    chain: Chain,
    problem: Problem,
    simpler: SimplerFit | None,
    again: bool = False,
) -> Fitted:
    """Fit the named parameters from a near chain, or `again` from a fitted one."""
    system = problem.system(problem.sets)
    if simpler is None and not again:
        robust = thorough_fit(chain, names, system, problem.loss)
    else:
        distances = None if simpler is None else simpler.distances
        robust = reweighted(chain, names, system, problem.loss, distances)
    fit = robust.fit
    factor = factor_of(fit.chain, names, robust.system, fit.normal)
    noise, uncertainty = noise_of(fit, names, robust.system, factor)
    found = factor, replace(noise, given=problem.sigmas), uncertainty, noise.size
    return Fitted(problem, structural, start, names, robust, *found)


def _noise_for_priors(noise: Noise, richer: bool) -> float:
    """Return the size of the noise [sigma given] that priors are weighed against.

    What the geometric model lacks is no noise to it: it can follow a part of it. On measured
    robots errors in held-out regions were least with more weight on the prior, those on held-out
    rows of the same session with less. With the noise that neighbours do not share, over FOLLOWED,
    they are those of least squares (`benchmarks/real_robots.py`).

    Of a richer model, priors hold most parameters, and harmonics named by the user follow errors
    of other kinds, but only in the session: the size by their uncertainty may be that of the
    priors. Residuals tell it if they are as given, or far smaller.
    """
    if richer:
        told = max(noise.widened * max(noise.position, noise.orientation or 0.0), 1.0)
        return told if noise.consistent or noise.size > FOLLOWED * told else noise.size
    if noise.consistent:
        return noise.size
    return max(noise.size / (FOLLOWED * noise.widened), min(noise.size, 1.0))


def _likely_noise(fitted: Fitted) -> float:
    """Return the most probable size of the noise [sigma given], together with those of the errors.

    Few poses leave least squares little to tell the noise by, and a test accepts sigmas that are
    far too large. Priors leave more:

        t^2 = |r|^2 / (R - gamma)

    with R rows, residuals r of the posterior mean, and gamma the number of parameters that the
    data determine (MacKay 1992). The hyperprior of t about the given sigmas is that of the errors.
    """
    products = fitted.robust.fit.normal.products.sum(axis=0)
    sums, rows, shared, _ = squares_of(fitted.chain, fitted.system).sum(axis=1).tolist()
    width, size = np.log(SPREAD) ** -2, 1.0
    for _ in range(ROUNDS):
        found = Inference(fitted, size).likeliest()
        along = np.append(-found.shift, 1.0)
        squares = float(along @ products @ along) / size**2
        free = rows - float(np.sum(products[:-1, :-1] * found.covariance)) / size**2
        step = (squares - free - width * np.log(size)) / (2.0 * max(free, 0.0) + width)
        last, size = size, max(size * float(np.exp(np.clip(step, -1.0, 1.0))), LEAST_SIZE)
        if abs(np.log(size / last)) < SETTLED:
            break
    together = shared / max(sums, ROUNDING)  # of the rows of one configuration
    size *= fitted.noise.widened
    return size * float(np.sqrt(together)) if together > SUSPICIOUS else size


def _guarded(
    problem: Problem, names: Sequence[str], factor: FloatArray, simpler: SimplerFit | None
) -> Problem:
    """Return the problem with priors that keep a first fit from diverging.

    `factor` (P, P) is that of some samples at the start, or of a robust fit. DH parameters that it
    determines no better than common sense get a third of the largest error of a faulty robot as a
    prior.
    """
    known = problem.prior_sigmas
    stds = np.sqrt(np.diag(covariance(factor))).tolist()
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
    noise = 1.0 if simpler is None else _noise_for_priors(simpler.noise, richer=False)
    return replace(problem, learned=Learned(guards, noise)) if guards or simpler else problem


def _require_enough(problem: Problem, names: Sequence[str]) -> None:
    rows = configurations = 0
    for each in problem.sets:
        if not len(each):
            raise InputError(f'no pairs to fit between {each.base} and {each.tool}')
        count = int(each.configurations.max()) + 1
        rows += count * each.width
        configurations += count
    if rows < len(names):
        widths, sets = {each.width for each in problem.sets}, len(problem.sets)
        of = f', with frames for {sets} sessions, devices or targets' if sets > 1 else ''
        width = f'{min(widths)} to ' * (len(widths) > 1) + counted(max(widths), 'equation')
        raise TooFewObservationsError(
            configurations,
            -(-len(names) * configurations // rows),
            f'{width} each for {len(names)} parameters{of}',
        )
