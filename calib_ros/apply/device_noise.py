# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The noise of a device that nobody stated: at most what changes of the arm cannot explain.

Two bounds are sought, and the smaller counts. The first is what a fit of everything leaves: all
parameters, frames, wear and load. With M the share of the parameters that positions determine,
residuals of n coordinates with noise in positions alone have n - 2 tr M + tr M^2 degrees of
freedom. Few poses leave none.

The second is what one cause leaves: a zero, a joint, a frame, or everything, off from the first
pose on or wandering since. With position errors e and columns J of the cause, of usual sizes,

    e ~ N(0, s^2 (1 + t K))      K = J J^T, or for row i of pose k times min(k_i, k_j)

s is the noise, the largest beside any cause and t that is not clearly less likely than the best
(likelihood ratio). White errors are noise; the few poses of a cause are not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from calib_ros.decision.changes import SIZES
from calib_ros.errors import InputError
from calib_ros.estimation.fitting import fit
from calib_ros.estimation.levels import CERTAIN, CONFIDENT, TELLING
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.start import reframed
from calib_ros.estimation.system import row_samples, stacked
from calib_ros.estimation.uncertainty import covariance
from calib_ros.estimation.weights import OUTLIER
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import Parameter, parameters_of
from calib_ros.kinematics.se3 import FloatArray

WORN = ('ratio', 'coupling', 'eccentricity', 'gravity')
"""Effects that a repair, wear or another load change."""


def unstated(sets: Sequence[Observations]) -> list[Observations]:
    """Return the measurements without a covariance."""
    found = []
    for each in sets:
        own = each.covariance
        none = np.ones(len(each), dtype=bool) if own is None else np.isnan(own[:, 0, 0])
        if none.any():
            found.append(replace(each.select(none), covariance=None))
    return found


def noise_seen(chain: Chain, sets: Sequence[Observations]) -> float:
    """Return the noise [m] that measurements without a covariance show, at most, by an arm.

    The chain is the calibrated one, in the frames of the measurements.
    """
    worn = [name for group in WORN for name in effects.members(chain, group)]
    return min(_beside_all(chain, sets, worn), _beside_one(chain, sets, worn))


def _beside_all(chain: Chain, sets: Sequence[Observations], worn: Sequence[Parameter]) -> float:
    """Return the noise [m] that a fit of everything leaves, inf of few poses."""
    chain = reframed(chain, chain.frame_names, fixed=False)
    problem = Problem(chain, sets[0], more=sets[1:], effects=worn, loss='none')
    try:
        fitted = fit(problem)
    except (InputError, np.linalg.LinAlgError):
        return np.inf
    share = covariance(fitted.factor) @ fitted.robust.fit.normal.parts[0]
    count = float(sum(each.ways.sum() for each in sets))
    taken = float(np.trace(share))
    free = min(count - taken, count - 2.0 * taken + float(np.sum(share * share.T)))
    if free < TELLING:
        return np.inf
    likely = fitted.noise.position * np.sqrt((count - taken) / special.chdtri(free, CONFIDENT))
    return float(likely * problem.sigma_position)


def _beside_one(chain: Chain, sets: Sequence[Observations], worn: Sequence[Parameter]) -> float:
    """Return the noise [m] beside one cause, gross errors left out."""
    plain = [replace(each, oriented=np.zeros_like(each.oriented)) for each in sets]
    problem = Problem(chain, plain[0], more=plain[1:])
    frames = dict.fromkeys(frame for each in sets for frame in (each.base, each.tool))
    own = [name for frame in frames for name in parameters_of(frame)]
    names = (*own, *(name for name in chain.parameter_names if name.of_dh), *worn)
    system = problem.system(plain).spread(SOME_POSES // 2)
    rows = system.rows_of(chain.with_effects(worn), names)
    flat, number = stacked(rows), row_samples(rows)
    squares = np.bincount(number, flat[:, -1] ** 2)
    kept = (squares <= OUTLIER**2 * np.median(squares))[number]
    stamps = np.concatenate([samples.observations.stamps_ns for samples in system.sets])
    when = np.argsort(np.argsort(stamps, kind='stable'))[number[kept]] + 1.0
    sizes = [SIZES.get(name.unit) or effects.expected(name) for name in names]
    columns, errors = flat[kept, :-1] * sizes, flat[kept, -1]
    causes = [{joint.driven} for joint in chain.joints]
    causes += [{n for n in names if n.owner == owner} for owner in {n.owner: 0 for n in names}]
    kernels = []
    for cause in (*causes, {*names}):
        some = columns[:, [name in cause for name in names]]
        still = some @ some.T
        kernels += [still, still * np.minimum.outer(when, when)] if still.any() else []
    freedom = special.chdtri(len(errors), CONFIDENT)
    variance = _white(kernels, errors) * len(errors) / freedom
    return float(np.sqrt(variance) * problem.sigma_position)


def _white(kernels: Sequence[FloatArray], errors: FloatArray) -> float:
    """Return the largest likely variance of white noise in errors (R,), by kernels (R, R)."""
    count = len(errors)
    sizes = np.append(0.0, np.geomspace(1e-3, 1e6, 46))[:, np.newaxis]
    logs, whites = [], []
    for kernel in kernels:
        values, axes = np.linalg.eigh(kernel * (count / np.trace(kernel)))
        variances = 1.0 + sizes * np.maximum(values, 0.0)
        white = np.mean((axes.T @ errors) ** 2 / variances, axis=1)
        log = -0.5 * (count * np.log(np.maximum(white, 1e-300)) + np.log(variances).sum(axis=1))
        log[1:] -= np.log(len(kernels))  # each cause is as likely as another
        logs.append(log)
        whites.append(white)
    likely = np.array(logs) >= np.max(logs) - 0.5 * special.chdtri(1.0, 1.0 - CERTAIN)
    return float(np.array(whites)[likely].max())
