# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The size of the noise, pairs that share it, and the uncertainty of the parameters."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import special

from calib_ros.estimation import uncertainty
from calib_ros.estimation.gross_errors import SUSPICIOUS
from calib_ros.estimation.leastsquares import Fit
from calib_ros.estimation.levels import SURE
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.shared_errors import shared_errors, squares_of
from calib_ros.estimation.system import System
from calib_ros.estimation.uncertainty import Uncertainty
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.values import SAME


@dataclass(frozen=True)
class Noise:
    """Size of the residuals in units of the given sigma, for position and orientation.

    `consistent` tells whether a chi-squared test accepts the sigmas. Then standard deviations
    follow the larger of given and found sigmas, because a test of few residuals would accept
    sigmas that are too small; otherwise the found ones.

    `successive` and `near` are the correlations of residuals of configurations that follow each
    other, and that are near each other in joint space; `shared` names those with shared errors by
    a test (`shared_errors.py`), which widens the standard deviations by the factor `widened`
    (median). `size` is their total ratio to those by the given sigmas. `given` are these [m, rad,
    px] by their names in `Problem`, where known.
    """

    position: float
    orientation: float | None
    consistent: bool
    successive: float
    near: float
    shared: tuple[str, ...]
    widened: float = 1.0
    size: float = 1.0
    given: Mapping[str, float] = field(default_factory=dict)

    def expected_in(self, problem: Problem, stated: Collection[str] = ()) -> Problem:
        """Return a problem of new poses with their sigmas by the stated ones and this noise.

        A default sigma becomes the earlier one, unless `stated` names it. Residuals larger than
        the earlier sigma need not come from the device: the excess is added to a new sigma too.
        """
        found: dict[str, Any] = {}
        for name, sigma in problem.sigmas.items():
            then = self.given.get(name, sigma)
            if sigma == getattr(Problem, name) and name not in stated:
                sigma = then
            ratio = 1.0
            if not self.consistent:
                turned = self.orientation if name == 'sigma_orientation' else None
                ratio = turned or self.position
            lacking = then * np.sqrt(max(ratio**2 - 1.0, 0.0))
            least = sigma * (min(ratio, 1.0) if sigma == then else 1.0)
            found[name] = max(float(np.hypot(least, lacking)), SAME)  # simulated without noise
        return replace(problem, **found)


def noise_of(
    fit: Fit, names: Sequence[str], system: System, factor: FloatArray
) -> tuple[Noise, Uncertainty]:
    """Return the noise and the resulting uncertainty of the parameters.

    `factor` R (P, P) is that of the weighted Jacobian, R^T R = H. Each part (position,
    orientation) has as many degrees of freedom as equations, minus its share of the parameters,
    trace(H^-1 H_part). Pairs of one configuration share the model error, and count for fewer.
    """
    plain = uncertainty.covariance(factor)
    taken = np.array([float(np.sum(plain * part)) for part in fit.normal.parts])
    squares = squares_of(fit.chain, system)
    if not fit.normal.parts[1].any():  # whitened as a whole, or no orientation
        squares = np.column_stack([squares.sum(axis=1), np.zeros(4)])
    sums, counts, joint_sums, joint_counts = squares
    freedom = counts - taken
    known = freedom > 1e-9
    variances = np.where(known, sums / np.where(known, freedom, 1.0), 1.0)
    beyond = 0.5 * (1.0 - SURE)
    low, high = (special.chdtri(np.where(known, freedom, 1.0), p) for p in (1.0 - beyond, beyond))
    consistent = bool(np.all(~known | ((low <= sums) & (sums <= high))))
    position, orientation = np.sqrt(variances).tolist()
    orientation = orientation if known[1] else None
    neighbours = shared_errors(fit, names, system)
    noise = Noise(
        position, orientation, consistent, neighbours.successive, neighbours.near, neighbours.found
    )
    together = joint_sums / np.maximum(sums, 1e-300)
    alone = np.maximum(variances, 1.0) if consistent else variances
    sizes = np.where(together > SUSPICIOUS, together, 1.0) * alone
    middles = [size * part for size, part in zip(sizes, fit.normal.parts, strict=True)]
    extra, _ = system.extra_rows(fit.chain, names)
    if system.prior is not None:
        extra[: len(names)] *= system.prior.noise
    alike = neighbours.middles.keys() | neighbours.drifting.keys()
    estimated = np.array([not consistent or sizes[k] != 1.0 or k in alike for k in (0, 1)])
    seen = np.where(together > SUSPICIOUS, joint_counts, counts)
    freedom = np.maximum(seen - taken, 1.0)
    freedom = np.append(np.where(estimated, freedom, np.inf), np.inf)
    weighed = system.prior is not None and system.prior.noise != 1.0  # against other noise
    if not (estimated.any() or weighed):
        return noise, Uncertainty(plain[np.newaxis], np.array([np.inf]))

    sources = [neighbours.middles.get(k, middle) for k, middle in enumerate(middles)]
    parts = [uncertainty.covariance(factor, middle) for middle in sources]
    by_priors = plain @ extra.T
    found = Uncertainty(np.array([*parts, by_priors @ by_priors.T]), freedom)
    if neighbours.middles:
        alone = uncertainty.covariance(factor, sum(middles, extra.T @ extra))
        widened = float(np.median(np.sqrt(np.diag(found.covariance) / np.diag(alone))))
        noise = replace(noise, widened=widened)
    if neighbours.drifting:
        drift = sum(neighbours.drifting.get(k, source) for k, source in enumerate(sources))
        shared = uncertainty.covariance(factor, drift - noise.widened**2 * sum(middles))
        found = replace(found, shared=shared, together=neighbours.together)
    if estimated.any():
        size = np.sqrt(np.median(np.diag(found.covariance) / np.diag(plain)))
        noise = replace(noise, size=float(size))
    return noise, found
