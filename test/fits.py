# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fits that are not judged: all that `identify` does before, in less than half of its time."""

from types import SimpleNamespace

from calib_ros.identification import fitting
from calib_ros.identification.leastsquares import minimise


def fitted(problem):
    """Return chains, names, parameters, covariance and noise of a fit."""
    known, start, fit = fitting.fit(problem)
    names = fit.names
    found = fitting.parameter_rows(fit.problem, fit.chain, known, names, fit.uncertainty)
    frames = [name for name in names if start.owns_frame(name)]
    return SimpleNamespace(
        before=minimise(start, frames, fit.system).chain,
        chain=fit.chain,
        names=names,
        parameters=found,
        covariance=fit.uncertainty.covariance,
        noise=fit.noise,
    )
