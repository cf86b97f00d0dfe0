# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The typical size of this arm's errors, estimated from its own data (empirical Bayes).

Offsets from the nominal arm have normal priors about zero, with one size s for each group of
parameters. The sizes maximise the probability of the data with the parameters integrated out
(evidence; MacKay 1992):

    s^2 = |x|^2 / gamma        gamma = sum over the group of (1 - V_ii / s^2)

with x the posterior mean and V its covariance, (L / t^2 + S^-1)^-1; docs/model.md (Sizes of
errors) explains them, the hyperprior and the considered effects (Schmidt 1966).

The tails of Student's t with TAILS degrees of freedom are a normal prior with the variance s^2 /
w, w = (TAILS + 1) / (TAILS + (x^2 + V_ii) / s^2). To judge an arm, variances are averaged over w,
whose inverse has the mean (TAILS + (x^2 + V_ii) / s^2) / (TAILS - 1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import TypeAlias

import numpy as np
from scipy import special

from calib_ros.estimation.considered import Doubted, Doubts, doubted_products, lengths_of, lenses
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.joint_errors import NOTHING, Unmodelled
from calib_ros.estimation.levels import CONFIDENT, OUT_OF_SCALE, PRINTED, SCALE, UNUSUAL
from calib_ros.estimation.sizes import TYPICAL, Evidence, mixed, solved
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import ROUNDING, FloatArray
from calib_ros.shown import Shown

Mixed: TypeAlias = tuple[float, FloatArray, FloatArray]
"""A weight, with mean (P,) and covariance (P, P) of the offsets."""


def size_group(chain: Chain, name: str) -> str | None:
    """Return the group of parameters with errors of one size; None for frames."""
    return None if chain.owns_frame(name) else _group(name)


@lru_cache(maxsize=1024)
def _group(name: str) -> str:
    if Parameter(name).of_dh:
        return 'length' if Parameter(name).is_length else 'angle'
    group = effects.group_of(name)
    return group if group in TYPICAL else 'drive'


@dataclass(frozen=True, eq=False, repr=False)
class Posterior(Shown):
    """Posterior of a fitted arm, given the data and the sizes of its errors."""

    chain: Chain  # the fitted arm, with considered effects of size zero
    names: tuple[str, ...]  # fitted parameters and considered effects, (P,) in all
    offsets: FloatArray  # (P,) fitted minus nominal values; zero for frames
    shift: FloatArray  # (P,) posterior mean minus fitted values
    covariance: FloatArray
    """(P, P) for the measuring device; averaged over plausible sizes if used to judge."""
    device: FloatArray
    """(P, K), square root of the covariance that smooth errors of that device add."""
    priors: Mapping[str, float]  # standard deviation [m or rad] of parameters with a prior
    sizes: Mapping[str, float]  # size of the errors by group
    doubted: tuple[Mixed, ...]
    """The posterior of the offsets for each plausible set of sizes, if the device may have a
    scale error and rounded joint values may be off."""
    rival: Mixed | None = None
    """The same with log odds for a device out of scale, or further than `sigma_scale`; None of a
    printed board of unchecked scale, which may be."""
    scale: float = 0.0
    """The scale of that device or board, minus one."""
    unmodelled: Unmodelled = NOTHING
    """What none of the names explains (`unmodelled.py`)."""

    @cached_property
    def square(self) -> FloatArray:
        """Return the expected squares (P, P) of the parameter errors."""
        return np.asarray(self.covariance + np.outer(self.shift, self.shift))

    def expected(self, joints: FloatArray, base: str = 'base', tool: str = 'tool') -> FloatArray:
        """Return the expected squares (N, 6, 6) of pose errors [m, rad] at joint values (N, n).

        In world axes, unmodelled effects included.
        """
        model = ErrorModel(self.chain, self.names, base, tool)
        return self.unmodelled.expected(model, self.square, joints)

    def stds_of(self, names: Sequence[str]) -> FloatArray:
        """Return the standard deviations (K,) of undetermined parameters of the arm."""
        groups = [_group(name) for name in names]
        return np.array([self.sizes.get(group, TYPICAL[group]) for group in groups])

    def held_at(self, names: Sequence[str], slopes: FloatArray) -> Posterior:
        """Return the posterior with K parameters held at nominal, as uncertain as others.

        The first F fitted parameters follow them by `slopes` (F, K).
        """
        count, between = len(names), len(self.names) - len(slopes)
        along = np.concatenate([slopes, np.zeros((between, count)), np.eye(count)])
        more = (along * self.stds_of(names) ** 2) @ along.T

        def padded(matrix: FloatArray) -> FloatArray:
            return np.asarray(np.pad(matrix, (0, count)) + more)

        return replace(
            self,
            names=(*self.names, *names),
            offsets=np.pad(self.offsets, (0, count)),
            shift=np.pad(self.shift, (0, count)),
            covariance=padded(self.covariance),
            device=np.pad(self.device, ((0, count), (0, 0))),
            rival=None,  # nothing measures the scale
            scale=0.0,
            doubted=tuple((w, np.pad(m, (0, count)), padded(c)) for w, m, c in self.doubted),
        )

    def held(self, name: str) -> float:
        """Return the share of a parameter's variance due to its prior, 1 if undetermined."""
        variance = float(self.covariance[self.names.index(name), self.names.index(name)])
        return variance / self.priors[name] ** 2 if name in self.priors else 0.0


def posterior_of(
    fitted: Fitted,
    noise: float,
    more: Sequence[str] = (),
    rounding: Mapping[str, float] | None = None,
    judging: bool = True,
) -> Posterior:
    """Return the posterior of a fit and of `more` considered effects, linearised at the fit.

    Offsets from the nominal chain are normal about zero. The samples have their weights in the
    fit, and noise of size `noise` [sigma given]. `rounding` are standard deviations of parameters
    that rounded joint values move too. Plausible sizes and the device only count if `judging`.
    """
    noise = max(noise, ROUNDING)  # parameters that follow all exactly leave none
    problem, names, system = fitted.problem, fitted.names, fitted.system
    nominal, every = problem.model, (*names, *more)
    arm = np.s_[: len(every)]  # all columns but the scale of the device
    own = [n for n in more if not (Parameter(n).of_dh or nominal.owns_frame(n))]
    chain = fitted.chain.with_effects(own)
    beside = {name: std for name, std in (rounding or {}).items() if name in names}
    whole, lengths, scale = lengths_of(chain, system) if more else (chain, {}, SCALE)
    sums = _sums_of(fitted, whole, every, Doubts(beside, lengths, bool(more)), noise)
    offsets = np.append(fitted.offsets, np.zeros(len(sums.plain) - 1 - len(names)))
    alone, along = _about_nominal(sums.plain, offsets)
    matrix, vector = _about_nominal(sums.reduced, offsets)
    columns = [*every, *['scale'] * bool(lengths)]
    evidence_of = partial(_evidence_of, chain, columns, (matrix, vector))
    known: dict[str, float] = {**problem.given} | {**lenses(nominal)}
    checked = {'scale': problem.sigma_scale} if problem.sigma_scale else {}
    evidence = evidence_of(known | checked, scale)
    considered = {size_group(chain, name) for name in more}
    considered -= {size_group(chain, name) for name in names if name not in known}
    size, slope = evidence.most_probable(considered)
    rival, out, judges_scale = None, 0.0, judging and lengths
    if judges_scale and (checked or scale < PRINTED):
        elsewhere = evidence_of(known, max(OUT_OF_SCALE, scale))
        odds, mean, covariance = elsewhere.against(evidence, size, considered)
        # assumed: one stated scale in twenty is wrong (benchmarks/scale.py --checked)
        odds += float(special.logit(1.0 - CONFIDENT if checked else UNUSUAL))
        rival, out = (odds, mean[arm], covariance[arm, arm]), float(mean[-1])
    near = evidence.near(size, slope) if judging else []
    usual = zip(every, evidence.precision(size).tolist(), strict=False)
    priors = {name: float(each**-0.5) for name, each in usual if each > 0.0}
    if judging:
        evidence.widen(size)
    weights, tried = zip(*(near or [(1.0, size)]), strict=True)
    precisions = [evidence.precision(each) for each in tried]
    each_alone = [solved(alone[arm, arm], along[arm], each[arm]) for each in precisions]
    mean, covariance = mixed(each_alone, weights)
    other = alone, sums.cross[:-1], sums.doubtful, evidence.precision(size), len(every)
    device = _device(*other) if judging else np.zeros((len(every), 0))
    wider = [solved(matrix, vector, each) for each in precisions if near]
    parts = zip(weights, wider, strict=False)
    doubted = tuple((w, centre[arm], root[arm] @ root[arm].T) for w, (centre, root) in parts)
    out = float(wider[0][0][-1]) if judges_scale and not rival else out
    found = offsets[arm], mean - offsets[arm], covariance, device, priors, evidence.named(size)
    posterior = Posterior(chain, every, *found, doubted, rival, out)
    return posterior if fitted.held is None else posterior.held_at(*fitted.held)


def _sums_of(
    fitted: Fitted, whole: Chain, every: Sequence[str], doubts: Doubts, noise: float
) -> Doubted:
    """Return the products of columns for noise of a size, those of the fit if without doubts."""
    if doubts.by_device or doubts.sizes:
        return doubted_products(whole, every, fitted.system, doubts, noise)
    products = fitted.products / noise**2
    return Doubted(products, products[:, :0], products[:0, :0])


def _evidence_of(
    chain: Chain,
    columns: Sequence[str],
    normal: tuple[FloatArray, FloatArray],
    known: Mapping[str, float],
    scale: float,
) -> Evidence:
    """Return the evidence of normal equations, with known deviations and the usual `scale`."""
    own = [n if n == 'scale' else size_group(chain, n) for n in columns]
    groups = [None if n in known else group for n, group in zip(columns, own, strict=True)]
    given = np.array([known.get(n, np.inf) for n in columns]) ** -2
    return Evidence(*normal, given, groups, TYPICAL | {'scale': scale})


def _about_nominal(products: FloatArray, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the normal equations (P, P), (P,) of all offsets from the products of their rows."""
    matrix = products[:-1, :-1]
    return matrix, matrix @ offsets + products[:-1, -1]


def _device(
    matrix: FloatArray, cross: FloatArray, doubtful: FloatArray, precision: FloatArray, count: int
) -> FloatArray:
    """Return (P, K), the root of what another device adds to the covariance of `count` columns.

    From the products of columns, the scale last, with those of device errors (Woodbury).
    """
    arm, scale = np.s_[:count], np.s_[count:]
    std = precision[scale, np.newaxis] ** -0.5
    beside = np.column_stack([matrix[arm, scale] * std.T, cross[arm]])
    own = np.block(
        [
            [std * matrix[scale, scale] * std.T + np.eye(len(std)), std * cross[scale]],
            [(std * cross[scale]).T, doubtful],
        ]
    )
    root = solved(matrix[arm, arm], np.zeros(count), precision[arm])[1]
    along = root @ (root.T @ beside)
    left, axes = np.linalg.eigh(own - beside.T @ along)
    return np.asarray(along @ axes / np.sqrt(np.maximum(left, 1.0)))  # >= 1 but for rounding
