# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fits that are not judged: all that `identify` does before, in less than half of its time."""

from types import SimpleNamespace

from calib_ros.identification.fitting import excited_names, fit_all, parameter_rows
from calib_ros.identification.identifiability import structurally_independent
from calib_ros.identification.leastsquares import minimise
from calib_ros.identification.start import start_frames


def fitted(problem):
    """Return chains, names, parameters, covariance and noise of a fit."""
    rows = problem.system(problem.sets).separation_rows
    known = structurally_independent(problem.model, problem.free, problem.kinds, rows)
    sigmas = (problem.sigma_position, problem.sigma_orientation)
    start = start_frames(problem.model, problem.sets, *sigmas, problem.loss)
    names, factor = excited_names(problem, known, start)
    fit = fit_all(problem, names, start, factor, None)
    found = parameter_rows(fit.problem, fit.chain, known, names, fit.uncertainty)
    frames = [name for name in names if start.owns_frame(name)]
    return SimpleNamespace(
        before=minimise(start, frames, fit.system).chain,
        chain=fit.chain,
        names=names,
        parameters=found,
        covariance=fit.uncertainty.covariance,
        noise=fit.noise,
    )
