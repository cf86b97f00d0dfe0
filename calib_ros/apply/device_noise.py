# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The noise of a device that nobody stated: at most what no change of the arm explains.

A zero, a joint, a frame, all zeros, the arm, its effects, or everything, may be off from the first
pose on or wander since. With position errors e and columns J of such a cause, of usual sizes,

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
from calib_ros.estimation.levels import CERTAIN
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.system import row_samples, stacked
from calib_ros.estimation.weights import OUTLIER
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import parameters_of
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

    The chain is the calibrated one, in the frames of the measurements. Gross errors are left out.
    """
    worn = [name for group in WORN for name in effects.members(chain, group)]
    plain = [each.without_orientations() for each in sets]
    problem = Problem(chain, plain[0], more=plain[1:])
    frames = dict.fromkeys(frame for each in sets for frame in (each.base, each.tool))
    own = [name for frame in frames for name in parameters_of(frame)]
    arm = [name for name in chain.parameter_names if name.of_dh]
    names = (*own, *arm, *worn)
    system = problem.system(plain).spread(SOME_POSES // 2)
    rows = system.rows_of(chain.with_effects(worn), names)
    flat, number = stacked(rows), row_samples(rows)
    squares = np.bincount(number, flat[:, -1] ** 2)
    kept = (squares <= OUTLIER**2 * np.median(squares))[number]
    stamps = np.concatenate([samples.observations.stamps_ns for samples in system.sets])
    when = np.argsort(np.argsort(stamps, kind='stable'))[number[kept]] + 1.0
    sizes = [SIZES.get(name.unit) or effects.expected(name) for name in names]
    columns, errors = flat[kept, :-1] * sizes, flat[kept, -1]
    zeros = [joint.driven for joint in chain.joints]
    causes = [*({zero} for zero in zeros), {*zeros}, {*arm}, {*worn}, {*names}]
    causes += [{n for n in names if n.owner == owner} for owner in {n.owner: 0 for n in names}]
    kernels = []
    for cause in causes:
        some = columns[:, [name in cause for name in names]]
        still = some @ some.T
        kernels += [still, still * np.minimum.outer(when, when)] if still.any() else []
    return float(np.sqrt(_white(kernels, errors)) * problem.sigma_position)


def _white(kernels: Sequence[FloatArray], errors: FloatArray) -> float:
    """Return the largest likely variance of white noise in errors (R,), by kernels (R, R)."""
    count = len(errors)
    sizes = np.append(0.0, np.geomspace(1e-3, 1e6, 46))[:, np.newaxis]
    logs, whites = [], []
    for kernel in kernels:
        values, axes = np.linalg.eigh(kernel * (count / np.trace(kernel)))
        variances = 1.0 + sizes * np.maximum(values, 0.0)
        white = np.mean((axes.T @ errors) ** 2 / variances, axis=1)
        logs.append(count * np.log(np.maximum(white, 1e-300)) + np.log(variances).sum(axis=1))
        whites.append(white)
    likely = np.array(logs) <= np.min(logs) + special.chdtri(1.0, 1.0 - CERTAIN)
    return float(np.array(whites)[likely].max())
