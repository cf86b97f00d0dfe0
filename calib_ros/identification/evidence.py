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

Where an arm is judged, variances are means over all that is not known: over w, whose inverse has
the mean (TAILS + (x^2 + V_ii) / s^2) / (TAILS - 1), so that a parameter of which the data tell
nothing has the variance of Student's t, TAILS / (TAILS - 2) s^2; and over the sizes.

Effects that a model leaves out are *considered*: they are columns of the same posterior with sizes
of their own, so that the arm as it may be, effects included, can be held against the one that was
fitted (`region.py`; Schmidt 1966 has the idea). So is the scale of the measuring device, which
makes all lengths grow alike: positions are linear in all lengths L, so its column is the sum of
L dp/dL.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from calib_ros.identification.leastsquares import Normal, System, normal_equations
from calib_ros.identification.levels import PRINTED, SCALE
from calib_ros.identification.observations import SOME_POSES
from calib_ros.identification.sizes import TYPICAL, Evidence, solved
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter, parameters_of
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import Shown

CONSIDERED = ('eccentricity', 'gravity')
"""Effects that any arm may have, fitted or not; couplings hardly show in moves of one joint."""


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
        Of the posterior; where it is judged, over all sizes that may as well be.
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
            doubted=tuple(
                (w, np.append(m, 0.0), np.pad(c, (0, 1)) + more) for w, m, c in self.doubted
            ),
        )

    def held(self, name: str) -> float:
        """Return which share of a parameter's variance is that of its prior: 1 if untold."""
        variance = float(self.covariance[self.names.index(name), self.names.index(name)])
        return variance / self.priors[name] ** 2 if name in self.priors else 0.0


def considered(chain: Chain, names: Sequence[str]) -> tuple[str, ...]:
    """Return the effects that an arm may have besides those among the names."""
    every = [name for group in CONSIDERED for name in effects.members(chain, group)]
    every += effects.couplings([each.name for each in chain.joints if each.type == 'revolute'])
    return tuple(name for name in every if name not in names)


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
    beside = [({name: 1.0}, std) for name, std in (doubts or {}).items() if name in names]
    whole, lengths, scale = _lengths(chain, system) if more else (chain, {}, SCALE)
    beside += [(lengths, scale)] if lengths else []
    told = _told(whole, every, [parts for parts, _ in beside], system, at_the_fit) / noise**2
    matrix = told[:-1, :-1]
    offsets = np.zeros(len(matrix))
    arms = [(k, n) for k, n in enumerate(names) if not chain.owns_frame(n)]
    offsets[[k for k, _ in arms]] = [chain.offset(n, nominal) for _, n in arms]
    vector = matrix @ offsets + told[:-1, -1]
    groups = [None if n in known else group_of(chain, n) for n in every] + [None] * len(beside)
    given = np.array([known.get(n, np.inf) for n in every] + [std for _, std in beside]) ** -2
    if lengths:
        groups[-1], given[-1] = 'scale', 0.0
    evidence = Evidence(matrix, vector, given, groups, TYPICAL | {'scale': scale})
    size, slope = evidence.told({group_of(chain, name) for name in more} - {*groups[: len(names)]})
    near = evidence.near(size, slope) if judging else ()
    known_by = zip(every, evidence.precision(size).tolist(), strict=False)
    priors = {name: float(each**-0.5) for name, each in known_by if each > 0.0}
    if judging:
        evidence.widen(size)
    arm = np.s_[: len(every)]
    weights = [weight for weight, _ in near] or [1.0]
    precisions = [evidence.precision(each) for _, each in near or [(1.0, size)]]
    own = [solved(matrix[arm, arm], vector[arm], each[arm]) for each in precisions]
    mean = np.average([each for each, _ in own], axis=0, weights=weights)
    covariance = np.average([root @ root.T for _, root in own], axis=0, weights=weights)
    covariance += np.cov([each for each, _ in own], rowvar=False, ddof=0, aweights=weights)
    wider = [solved(matrix, vector, each) for each in precisions if near]
    parts = zip(weights, wider, strict=False)
    doubted = tuple((w, there[arm], root[arm] @ root[arm].T) for w, (there, root) in parts)
    shift, sizes = mean - offsets[arm], evidence.named(size)
    return Posterior(chain, every, offsets[arm], shift, covariance, priors, sizes, doubted)


def _lengths(chain: Chain, system: System) -> tuple[Chain, dict[str, float], float]:
    """Return all lengths [m] that positions are made of, and how well their scale is known.

    There are none by sockets and planes, which are where they are. The travel of a prismatic joint
    grows by its ratio, which the chain returned has.
    """
    sets = [samples.observations for samples in system.sets]
    if any(each.socket or each.plane for each in sets):
        return chain, {}, SCALE
    travels = [Parameter(j.name, 'ratio') for j in chain.joints if j.type == 'prismatic']
    chain = chain.with_effects(travels)
    names: list[str] = [name for frame in chain.frame_names for name in parameters_of(frame)[:3]]
    names += [name for joint in chain.joints for name in joint.parameters if name.is_length]
    scale = PRINTED if all(each.pixels is not None for each in sets) else SCALE
    return chain, {n: chain.value(n) for n in names} | {str(n): 1.0 for n in travels}, scale


def _told(
    chain: Chain,
    names: Sequence[str],
    beside: Sequence[Mapping[str, float]],
    system: System,
    known: Normal | None,
) -> FloatArray:
    """Return the products (K + 1, K + 1) of columns and residual, without priors.

    Columns are those of the names, and sums of columns `beside` them. Of many samples every so
    many are taken; `known` holds the products of all of them for the names alone.
    """
    columns = list(dict.fromkeys([*names, *(name for parts in beside for name in parts)]))
    most = 10 * SOME_POSES
    share = -(-system.count // most)
    if known is None or share > 1 or beside:
        few = replace(system.spread(most), prior=None)
        known = normal_equations(chain, columns, few)
    extra = np.column_stack(system.separation_rows(chain, columns))
    mixing = np.eye(len(columns) + 1, len(names))
    for parts in beside:
        sums = [parts.get(name, 0.0) for name in columns]
        mixing = np.column_stack([mixing, [*sums, 0.0]])
    mixing = np.column_stack([mixing, np.eye(len(columns) + 1)[-1]])
    products = known.products.sum(axis=0) + extra.T @ extra
    return np.asarray(share * (mixing.T @ products @ mixing))
