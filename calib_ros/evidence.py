# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How large the errors of this arm are, told by its own data (empirical Bayes).

Poses that hardly move a joint hardly determine its parameters. Least squares fits noise there,
and the arm gets worse wherever that joint is elsewhere. So offsets from the nominal arm are taken
to be normal about zero, with one size for each group of parameters: lengths, angles, what drives
do to a joint value (`ratio`, `sin_1`, ...), and what bends. The sizes s maximise the probability
of the data, parameters integrated out (evidence; MacKay 1992):

    s^2 = |x|^2 / gamma        gamma = sum over the group of (1 - V_ii / s^2)

with x the posterior mean and V its covariance, (L / t^2 + S^-1)^-1. L is the normal matrix with
the given sigmas, t the factor by which the noise is larger, shared errors included. gamma counts
the parameters that the data determine. Where these are few, a hyperprior holds: a size is about
TYPICAL, within a factor of SPREAD. Parameters that the data determine keep their values, and the
others shrink to nominal.

Effects that a model leaves out are *considered*: they are columns of the same posterior with sizes
of their own, so that the arm as it may be, effects included, can be held against the one that was
fitted (`region.py`; Schmidt 1966 has the idea).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib_ros import effects
from calib_ros.chain import DH_KINDS, Chain, is_length
from calib_ros.leastsquares import Samples, System, normal_equations
from calib_ros.se3 import FloatArray

TYPICAL = {'length': 5e-4, 'angle': 1e-3, 'drive': 1e-4, 'bending': 3e-4}
"""Size [m, rad] of the errors that arms have, by group."""
SPREAD = 10.0
"""Factor by which the size of one arm's errors differs from TYPICAL (one standard deviation)."""
BENDING = ('gravity', 'compliance', 'backlash')
CONSIDERED = ('eccentricity', 'gravity')
"""Effects that any arm may have, whether they are fitted or not."""
MOST = 2000
"""Samples from which the sizes are told; of more, every so many are taken."""
SETTLED = 0.02
"""Change of the logarithm of a size from which on it stands still."""
ROUNDS = 60
SINGULAR = 1e-13
"""Eigenvalue of the scaled precision from which a direction counts."""
LEAST = 1e-3
"""Share of TYPICAL below which, and above the inverse of which, no size is looked for."""


def group_of(chain: Chain, name: str) -> str | None:
    """Return the group of parameters whose errors are of one size; None for frames."""
    if chain.owns_frame(name):
        return None
    if name.partition('.')[2] in DH_KINDS:
        return 'length' if is_length(name) else 'angle'
    return 'bending' if effects.group_of(name) in BENDING else 'drive'


@dataclass(frozen=True, eq=False)
class Posterior:
    """What the data and the sizes of the errors tell about an arm that was fitted.

    Attributes
    ----------
    chain : Chain
        The fitted arm, with effects of no size where they were not fitted.
    names : tuple of str
        Fitted parameters and considered effects, (P,) in all.
    offsets : (P,)
        The fitted parameters less their nominal values; zero for frames.
    shift : (P,)
        The posterior mean less the fitted parameters.
    covariance : (P, P)
        Of the posterior.
    priors : mapping of str to float
        Standard deviation [m or rad] of every parameter that has a prior.
    sizes : mapping of str to float
        Size of the errors by group.

    """

    chain: Chain
    names: tuple[str, ...]
    offsets: FloatArray
    shift: FloatArray
    covariance: FloatArray
    priors: Mapping[str, float]
    sizes: Mapping[str, float]

    def held(self, name: str) -> float:
        """Return which share of a parameter's variance is that of its prior: 1 if untold."""
        variance = float(self.covariance[self.names.index(name), self.names.index(name)])
        return variance / self.priors[name] ** 2 if name in self.priors else 0.0


def considered(chain: Chain, names: Sequence[str]) -> tuple[str, ...]:
    """Return the effects that an arm may have besides those among the names."""
    every = [name for group in CONSIDERED for name in effects.members(chain, group)]
    return tuple(name for name in every if name not in names)


def posterior_of(
    chain: Chain,
    nominal: Chain,
    names: Sequence[str],
    system: System,
    noise: float,
    known: Mapping[str, float],
    sizes: Mapping[str, float] | None = None,
) -> Posterior:
    """Return the posterior of fitted parameters and considered effects, linearised at the fit.

    Parameters
    ----------
    chain, nominal : Chain
        The fitted arm, and the one whose offsets are normal about zero.
    names : sequence of str
        Parameters that were fitted.
    system : System
        The samples of the fit, with their weights.
    noise : float
        Size of the noise [sigma given].
    known : mapping of str to float
        Priors [m or rad] that were given.
    sizes : mapping of str to float, optional
        Sizes of the errors by group; found from the data when None.

    """
    more = considered(chain, names)
    chain = chain.with_effects(more)
    every = (*names, *more)
    few, share = _few(system)
    normal = normal_equations(chain, every, few)
    matrix, gradient = (share / noise**2 * part for part in (normal.matrix, normal.gradient))
    groups = [None if name in known else group_of(chain, name) for name in every]
    offsets = np.zeros(len(every))
    for k, name in enumerate(names):
        if not chain.owns_frame(name):
            offsets[k] = chain.offset(name, nominal)
    given = np.array([1.0 / known[name] ** 2 if name in known else 0.0 for name in every])
    vector = matrix @ offsets + gradient
    if sizes is None:
        sizes = _sizes(matrix, vector, given, groups)
    found = {n: sizes[group] for n, group in zip(every, groups, strict=True) if group is not None}
    precision = given + np.array([found[n] ** -2 if n in found else 0.0 for n in every])
    mean, covariance = _solved(matrix, vector, precision)
    return Posterior(chain, every, offsets, mean - offsets, covariance, found | dict(known), sizes)


def _few(system: System) -> tuple[System, int]:
    """Return the samples without priors, of many every so many, and how many each stands for."""
    share = max(1, -(-system.count // MOST))
    sets = []
    for samples in system.sets:
        few = samples
        if share > 1:
            few = Samples(samples.observations.select(np.arange(0, samples.count, share)), *samples.sigmas)
            few.weights = None if samples.weights is None else samples.weights[::share]
        sets.append(few)
    return System(tuple(sets), None, system.separations), share


def _solved(
    matrix: FloatArray, vector: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean (P,) and covariance (P, P); directions without any information stay at zero."""
    whole = matrix + np.diag(precision)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(whole), 1e-300))
    sizes, directions = np.linalg.eigh(whole * np.outer(scale, scale))
    good = sizes > SINGULAR
    root = scale[:, np.newaxis] * directions[:, good] / np.sqrt(sizes[good])
    return root @ (root.T @ vector), np.asarray(root @ root.T)


def _sizes(
    matrix: FloatArray, vector: FloatArray, given: FloatArray, groups: Sequence[str | None]
) -> dict[str, float]:
    """Return the size of each group that makes the data most probable, with the hyperprior."""
    names = list(dict.fromkeys(group for group in groups if group is not None))
    member = np.array([[group == name for group in groups] for name in names], dtype=float)
    typical = np.log([TYPICAL[name] for name in names])
    size, width = typical.copy(), np.log(SPREAD) ** -2
    for _ in range(ROUNDS):
        weight = member * np.exp(-2.0 * size)[:, np.newaxis]
        mean, covariance = _solved(matrix, vector, given + weight.sum(axis=0))
        told = (member - weight * np.diag(covariance)).sum(axis=1)
        slope = weight @ mean**2 - told - width * (size - typical)
        step = np.clip(slope / (2.0 * np.maximum(told, 0.0) + width), -1.0, 1.0)
        size = np.clip(size + step, typical + np.log(LEAST), typical - np.log(LEAST))
        if np.abs(step).max() < SETTLED:
            break
    return dict(zip(names, np.exp(size).tolist(), strict=True))
