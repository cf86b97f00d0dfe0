# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How large the errors of this arm are, told by its own data (empirical Bayes).

Poses that hardly move a joint hardly determine its parameters. Least squares fits noise there,
and the arm gets worse wherever that joint is elsewhere. So offsets from the nominal arm are taken
to be normal about zero, with one size for each group of parameters: lengths, angles, what drives
do to a joint value (`ratio`, `sin_1`, ...), couplings, and what bends or has play. The sizes s
maximise the probability of the data, parameters integrated out (evidence; MacKay 1992):

    s^2 = |x|^2 / gamma        gamma = sum over the group of (1 - V_ii / s^2)

with x the posterior mean and V its covariance, (L / t^2 + S^-1)^-1. L is the normal matrix with
the given sigmas, t the factor by which the noise is larger, shared errors included. gamma counts
the parameters that the data determine. Where these are few, a hyperprior holds: a size is about
TYPICAL, within a factor of SPREAD; and where a calibration may be used is judged with sizes above
and below, because a size that few parameters tell may be wrong by much. Parameters that the data
determine keep their values, and the others shrink to nominal. One error may be far larger than the
others, as of a motor that was put in wrongly: the prior has the tails of Student's t with TAILS
degrees of freedom, as a normal one with the variance s^2 / w, w = (TAILS + 1) / (TAILS + (x^2 +
V_ii) / s^2).

Effects that a model leaves out are *considered*: they are columns of the same posterior with sizes
of their own, so that the arm as it may be, effects included, can be held against the one that was
fitted (`region.py`; Schmidt 1966 has the idea). So is the scale of the measuring device, which
makes all lengths grow alike: positions are linear in all lengths L, so its column is the sum of
L dp/dL; and all that it may do to space besides (`device.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy import linalg, special
from scipy.linalg import lapack

from calib_ros.identification.considered import told_of
from calib_ros.identification.leastsquares import Normal, System
from calib_ros.identification.levels import CONFIDENT
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import ROUNDING, ROUNDS, FloatArray
from calib_ros.shown import Shown

TYPICAL = {'length': 5e-4, 'angle': 1e-3, 'drive': 1e-4, 'coupling': 1e-3}
TYPICAL |= dict.fromkeys(('gravity', 'compliance', 'backlash'), 3e-4)
"""Size [m, rad] of the errors that arms have, by group."""
SPREAD = 10.0
"""Factor by which the size of one arm's errors differs from TYPICAL (one standard deviation;
benchmarks/harm.py)."""
TAILS = 3.0
"""Degrees of freedom of the prior (benchmarks/harm.py)."""
SHOWN, REFUTED = 0.5 * special.ndtri(CONFIDENT) ** 2, special.logit(CONFIDENT)
"""Logarithms of the ratio of probabilities beyond which effects show, and from which those of
usual size are refuted."""
SETTLED = 0.02
"""Change of the logarithm of a size from which on it stands still."""
LEAST_SIZE = SPREAD**-3
"""Share of TYPICAL below which, and above the inverse of which, no size is looked for."""


def group_of(chain: Chain, name: str) -> str | None:
    """Return the group of parameters whose errors are of one size; None for frames."""
    return None if chain.owns_frame(name) else _group(name)


@lru_cache(maxsize=1024)
def _group(name: str) -> str:
    if Parameter(name).of_dh:
        return 'length' if Parameter(name).is_length else 'angle'
    group = effects.group_of(name)
    return group if group in TYPICAL else 'drive'


@dataclass(frozen=True, eq=False, repr=False)
class Posterior(Shown):
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
        Of the posterior, for the device that measured.
    device : (P, K)
        Its product with itself is what the smooth errors of that device add to the covariance.
    priors : mapping of str to float
        Standard deviation [m or rad] of every parameter that has a prior.
    sizes : mapping of str to float
        Size of the errors by group.
    doubted : tuple of (float, (P,), (P, P))
        Mean and covariance of the offsets if the device may have a scale of its own, and if joint
        values that were rounded are off; for sizes that may as well be, each with its weight.

    """

    chain: Chain
    names: tuple[str, ...]
    offsets: FloatArray
    shift: FloatArray
    covariance: FloatArray
    device: FloatArray
    priors: Mapping[str, float]
    sizes: Mapping[str, float]
    doubted: tuple[tuple[float, FloatArray, FloatArray], ...]

    @cached_property
    def square(self) -> FloatArray:
        """Return the expected squares (P, P) of the fitted parameters' errors."""
        return np.asarray(self.covariance + np.outer(self.shift, self.shift))

    def expected(self, joints: FloatArray, base: str = 'base', tool: str = 'tool') -> FloatArray:
        """Return the expected squares (N, 6, 6) of errors of predicted poses [m, rad].

        At joint values (N, n); position and rotation in world axes. What is not modelled counts.
        """
        rows = ErrorModel(self.chain, self.names, base, tool).jacobian(joints)
        return np.asarray(rows @ self.square @ np.swapaxes(rows, 1, 2))

    def held_at(self, name: str, slope: FloatArray) -> Posterior:
        """Return it with a length kept nominal as uncertain as lengths are.

        The fitted parameters (F,), which come first, grow by `slope` as that does.
        """
        along = np.concatenate([slope, np.zeros(len(self.names) - len(slope)), [1.0]])
        more = self.sizes['length'] ** 2 * np.outer(along, along)
        return replace(
            self,
            names=(*self.names, name),
            offsets=np.append(self.offsets, 0.0),
            shift=np.append(self.shift, 0.0),
            covariance=np.pad(self.covariance, (0, 1)) + more,
            device=np.pad(self.device, ((0, 1), (0, 0))),
            doubted=tuple(
                (w, np.append(m, 0.0), np.pad(c, (0, 1)) + more) for w, m, c in self.doubted
            ),
        )

    def held(self, name: str) -> float:
        """Return which share of a parameter's variance is that of its prior: 1 if untold."""
        variance = float(self.covariance[self.names.index(name), self.names.index(name)])
        return variance / self.priors[name] ** 2 if name in self.priors else 0.0


def posterior_of(
    chain: Chain,
    nominal: Chain,
    names: Sequence[str],
    system: System,
    noise: float,
    known: Mapping[str, float],
    more: Sequence[str] = (),
    doubts: Mapping[str, float] | None = None,
    at_the_fit: Normal | None = None,
    judging: bool = True,
) -> Posterior:
    """Return the posterior of fitted parameters and considered effects, linearised at the fit.

    Offsets of the fitted `chain` from the `nominal` one are normal about zero. `names` were fitted
    to the `system` with its weights, and `more` effects are considered. `noise` is its size [sigma
    given], `known` are priors [m or rad] that were given. `doubts` are parameters that something
    else than the arm moves as well, with its standard deviation; `at_the_fit` are the last normal
    equations, if they are known. Nothing is `doubted` unless `judging` where it may be used.
    """
    chain = chain.with_effects(more)
    every = (*names, *more)
    beside = {name: std for name, std in (doubts or {}).items() if name in names}
    plain, cross, doubtful = told_of(chain, every, system, noise, beside, bool(more), at_the_fit)
    offsets = np.zeros(len(every))
    arms = [(k, n) for k, n in enumerate(names) if not chain.owns_frame(n)]
    offsets[[k for k, _ in arms]] = [chain.offset(n, nominal) for _, n in arms]
    told = plain - cross @ linalg.solve(doubtful, cross.T, assume_a='pos')
    matrix, vector = told[:-1, :-1], told[:-1, :-1] @ offsets + told[:-1, -1]
    groups = [None if n in known else group_of(chain, n) for n in every]
    given = np.array([known.get(n, np.inf) for n in every]) ** -2
    evidence = _Evidence(matrix, vector, given, groups)
    size, slope = evidence.told({group_of(chain, name) for name in more} - {*groups[: len(names)]})
    near = evidence.near(size, slope) if judging else ()
    stds = evidence.stds(size)
    priors = {name: std for name, std in zip(every, stds.tolist(), strict=True) if std < np.inf}
    mean, root = _solved(plain[:-1, :-1], plain[:-1, :-1] @ offsets + plain[:-1, -1], stds**-2)
    covariance = root @ root.T
    along = covariance @ cross[:-1]
    left, axes = np.linalg.eigh(doubtful - cross[:-1].T @ along)
    device = along @ axes / np.sqrt(np.maximum(left, 1.0))  # it is 1 and more but for rounding
    solved = [(w, *_solved(matrix, vector, evidence.stds(other) ** -2)) for w, other in near]
    doubted = tuple((w, there, its @ its.T) for w, there, its in solved)
    shift, sizes = mean - offsets, evidence.named(size)
    return Posterior(chain, every, offsets, shift, covariance, device, priors, sizes, doubted)


def _solved(
    matrix: FloatArray, vector: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean (P,) and a root (P, P) of the covariance."""
    scaled, scale = _scaled(matrix, precision)
    factor, failed = lapack.dpotrf(scaled.T, lower=1, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError('singular posterior')
    inverse = lapack.dtrtri(factor, lower=1, overwrite_c=1)[0]
    inverse *= scale
    return inverse.T @ (inverse @ vector), inverse.T


def _scaled(matrix: FloatArray, precision: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return matrices (..., P, P) of unit diagonal with precisions (..., P) added, and scales."""
    size = np.arange(len(matrix))
    diagonal = matrix[size, size] + precision
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-300))
    scaled = matrix * (scale[..., np.newaxis, :] * scale[..., np.newaxis])
    scaled[..., size, size] = diagonal * scale**2 + ROUNDING  # which cannot make it singular
    return scaled, scale


class _Evidence:
    """How probable sizes of the errors make the data."""

    def __init__(
        self,
        matrix: FloatArray,
        vector: FloatArray,
        given: FloatArray,
        groups: Sequence[str | None],
    ) -> None:
        self._matrix, self._vector, self._given = matrix, vector, given
        self._names = [*dict.fromkeys(group for group in groups if group is not None)]
        rows = [[group == name for group in groups] for name in self._names]
        self._member = np.array(rows, dtype=float).reshape(len(rows), len(groups))
        self._typical = np.log([TYPICAL[name] for name in self._names])
        self._own = np.array([group in ('length', 'angle') for group in groups])
        self._tails = np.ones(len(groups))

    def told(self, considered: set[str | None]) -> tuple[FloatArray, FloatArray]:
        """Return the logarithm of the size of each group (G,), and the curvature (G,) there.

        Effects that are only considered are of no size where the data would show the usual ones,
        and do not show any.
        """
        size, width = self._typical.copy(), np.log(SPREAD) ** -2
        if self._own.sum() == self._member.sum():
            free = self._given + self._weight(size - np.log(LEAST_SIZE)).sum(axis=0)
            mean, root = _solved(self._matrix, self._vector, free)
            surely = np.maximum(np.abs(mean) - 2.0 * np.sqrt((root**2).sum(axis=1)), 0.0)
            self._lengthen(surely**2, 1.0, size)
        for _ in range(ROUNDS):
            weight = self._weight(size)
            mean, root = _solved(self._matrix, self._vector, self._given + weight.sum(axis=0))
            variance = (root**2).sum(axis=1)
            told = (self._member - weight * variance).sum(axis=1)
            slope = weight @ mean**2 - told - width * (size - self._typical)
            step = np.clip(slope / (2.0 * np.maximum(told, 0.0) + width), -1.0, 1.0)
            size = self._within(size + step)
            self._lengthen(mean**2 + variance, 0.0, size)
            if np.abs(step).max(initial=0.0) < SETTLED:
                break
        for k, name in enumerate(self._names):
            if name in considered:
                tried = np.tile(size, (3, 1))
                tried[1:, k] = self._typical[k] + np.log(LEAST_SIZE), self._typical[k]
                here, without, usual = self._of(tried).tolist()
                if not here - without > SHOWN and without - usual > REFUTED:
                    size = tried[1]
        return size, 2.0 * np.maximum(told, 0.0) + width

    def near(self, size: FloatArray, slope: FloatArray) -> list[tuple[float, FloatArray]]:
        """Return sizes that may as well be, with their weights, by the curvature (G,) there.

        One group differs at a time, up and down, by as much as makes means right to the second
        order (the unscented transform, Julier and Uhlmann 1997); the evidence weighs both. What
        is of no size stays so.
        """
        some = np.flatnonzero(size > self._typical + np.log(LEAST_SIZE))
        if not len(some):
            return [(1.0, size)]
        steps = (np.sqrt(len(some) / slope) * np.eye(len(size)))[some]
        tried = self._within(size + np.stack([steps, -steps], axis=1).reshape(-1, len(size)))
        told = self._of(tried) - 0.5 * (((tried - self._typical) / np.log(SPREAD)) ** 2).sum(
            axis=1
        )
        upper = special.expit(told[::2] - told[1::2])
        weights = np.stack([upper, 1.0 - upper], axis=1).ravel() / len(some)
        return list(zip(weights.tolist(), tried, strict=True))

    def _within(self, size: FloatArray) -> FloatArray:
        """Return sizes (G,) no further from the typical ones than any that are looked for."""
        return self._typical + np.clip(
            size - self._typical, np.log(LEAST_SIZE), -np.log(LEAST_SIZE)
        )

    def stds(self, size: FloatArray) -> FloatArray:
        """Return the standard deviation (P,) of each parameter for sizes (G,), by logarithms."""
        precision = self._given + self._weight(size).sum(axis=0)
        with np.errstate(divide='ignore'):
            return np.asarray(1.0 / np.sqrt(precision))

    def named(self, size: FloatArray) -> dict[str, float]:
        """Return the size [m, rad] of each group, given by their logarithms (G,)."""
        return dict(zip(self._names, np.exp(size).tolist(), strict=True))

    def _lengthen(self, squares: FloatArray, more: float, size: FloatArray) -> None:
        """Give offsets of expected squares (P,), larger by `more` sizes, the tails of the prior.

        Effects have none: what a drive does is a matter of its make.
        """
        far = self._member.T @ np.exp(-2.0 * size) * squares + more
        self._tails = np.where(self._own, (TAILS + 1.0) / (TAILS + far), 1.0)

    def _weight(self, size: FloatArray) -> FloatArray:
        """Return (G, P) the inverse variances of the parameters of each group."""
        return np.asarray(self._member * self._tails * np.exp(-2.0 * size)[:, np.newaxis])

    def _of(self, sizes: FloatArray) -> FloatArray:
        """Return the logarithm of the evidence of sizes (S, G), given by their logarithms."""
        weights = (self._member * self._tails) * np.exp(-2.0 * sizes)[..., np.newaxis]
        scaled, scale = _scaled(self._matrix, self._given + weights.sum(axis=1))
        # the last row of the factor of [A b; b^T c] is L^-1 b
        wide = np.zeros((len(sizes), scaled.shape[1] + 1, scaled.shape[1] + 1))
        wide[:, :-1, :-1] = scaled
        wide[:, -1, :-1] = scale * self._vector
        wide[:, -1, -1] = 1e300  # more than any square
        factor = np.linalg.cholesky(wide)
        volume = 2.0 * np.log(scale / np.einsum('spp->sp', factor)[:, :-1]).sum(axis=1)
        fit = (factor[:, -1, :-1] ** 2).sum(axis=1)
        return np.asarray(0.5 * (fit + volume) - sizes @ self._member.sum(axis=1))
