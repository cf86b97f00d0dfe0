# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Robust least squares by weights (docs/model.md, Fit).

A sample's distance is the length of its residual in units of the median length of all, the larger
one of position and orientation, or of a corner and the sum over its image. Fits are repeated with
weights by distance until they converge (Holland and Welsch 1977):

    first        w = min(1, 1 / distance)                  least absolute lengths
    redescending w = 1 below INNER, 0 beyond OUTER, falling in between (Hampel 1974)
    huber        w = min(1, INNER / distance)              (Huber 1964)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros.estimation.leastsquares import PATIENCE, STEP_TOLERANCE, Fit, minimise
from calib_ros.estimation.system import System
from calib_ros.estimation.trimmed import trimmed_sum
from calib_ros.estimation.weights import INNER, OUTLIER, distances_of, weights_of
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import ROUNDS, Flags, FloatArray


@dataclass(frozen=True, eq=False)
class Robust:
    """A robust fit, the weighted system, and the distances (N,) of the samples of each set."""

    fit: Fit
    system: System
    distances: tuple[FloatArray, ...]
    settled: bool
    loss: str

    @property
    def inliers(self) -> tuple[Flags, ...]:
        """Return which samples (N,) of each set are no gross errors."""
        return tuple((each <= OUTLIER) | (self.loss == 'none') for each in self.distances)

    @property
    def outliers(self) -> Flags:
        """Return which samples (N,) of all sets are gross errors."""
        return ~np.concatenate(self.inliers)


def robust_fit(chain: Chain, names: Sequence[str], system: System, loss: str) -> Robust:
    """Fit the named parameters without gross errors."""
    fit = minimise(chain, names, system)
    distances = distances_of(fit.chain, names, system)
    if loss == 'none' or max(d.max(initial=0.0) for d in distances) < INNER:
        return Robust(fit, system, distances, True, loss)
    if trimmed_sum(chain, system) < trimmed_sum(fit.chain, system):  # misled from a good start
        fit = replace(fit, chain=chain)
        distances = distances_of(chain, names, system)
    for _ in range(ROUNDS):
        before = distances
        bounded = system.weighted([1.0 / np.maximum(d, 1.0) for d in distances])
        fit = minimise(fit.chain, names, bounded, iterations=2)
        distances = distances_of(fit.chain, names, system)
        now, then = map(np.concatenate, (distances, before))
        if np.allclose(now, then, rtol=0.1, atol=0.1):
            break
    return reweighted(fit.chain, names, system, loss)


def reweighted(
    chain: Chain,
    names: Sequence[str],
    system: System,
    loss: str,
    simpler: Sequence[FloatArray] | None = None,
    tolerance: float = 1e-3,
) -> Robust:
    """Fit with the weights of a loss, from a start that is good enough to detect gross errors.

    Fits are repeated to a `tolerance` until the weights converge. A sample at the edge may lose
    weight, come nearer, regain it, and so on: the more often weights swing, the smaller their
    steps. Weights that creep take the step of the secant. With the distances (N,) of all samples
    by a `simpler` model, samples that it explains are no gross errors: a richer model has to
    explain them too.
    """
    ends = system.ends

    def judged(chain: Chain) -> FloatArray:  # over all sets
        found = np.concatenate(distances_of(chain, names, system))
        return found if simpler is None else np.minimum(found, np.concatenate(simpler))

    distances = judged(chain)
    settled, swung = False, 0
    moved: FloatArray | None = None  # the last move of the weights
    due: FloatArray | None = None  # and the one that their fit asked for
    weights: FloatArray | None = None
    for _ in range(ROUNDS):
        found = weights_of(distances, loss)
        if weights is not None:
            settled = np.allclose(found, weights, rtol=0, atol=1e-4)
            if settled:
                break
            before, due = due, found - weights
            swings = moved is not None and float(due @ moved) < 0.0
            swung += swings
            share = min(1.0, PATIENCE / (swung + 1.0)) * (0.5 if swings else 1.0)
            if moved is not None and before is not None and not swings:
                rate = float((before - due) @ moved) / max(float(moved @ moved), 1e-300)
                creeps = np.abs(due).max() < 0.1 * rate < 0.1  # near where the secant leads
                share /= rate if creeps else 1.0
            moved = np.clip(weights + share * due, 0.0, 1.0) - weights
            found = weights + moved
        weights = found
        system = system.weighted(np.split(weights, ends))
        fit = minimise(chain, names, system, tolerance)
        chain = fit.chain
        distances = judged(chain)
        if not fit.converged:
            break
    if not (settled and fit.next_step_rms < STEP_TOLERANCE):
        fit = minimise(chain, names, system)
    return Robust(fit, system, tuple(np.split(distances, ends)), settled, loss)
