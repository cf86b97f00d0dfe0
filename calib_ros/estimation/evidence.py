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
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import special

from calib_ros.estimation.considered import lengths_of, lenses, travels
from calib_ros.estimation.distortion import STRAINS, differing
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.gain import about_nominal
from calib_ros.estimation.joint_errors import Unmodelled
from calib_ros.estimation.levels import CONFIDENT, OUT_OF_SCALE, PRINTED, SCALE, UNUSUAL
from calib_ros.estimation.nuisances import NuisanceProducts, Nuisances, nuisance_products
from calib_ros.estimation.posterior import Posterior, size_group
from calib_ros.estimation.sizes import TYPICAL, Evidence, mixed, solved
from calib_ros.kinematics import effects
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray


@dataclass(frozen=True, eq=False)
class Inference:
    """What the posterior of a fit and of `more` considered effects follows from.

    Offsets from the nominal chain are normal about zero. The samples have their weights in the
    fit, at which all is linear, and noise of size `noise` [sigma given]; without what the scale of
    linear joints explains, and a strain of the device if it is `strained`, that is `least`.
    `rounding` are standard deviations of parameters that rounded joint values move too. The device
    is considered unless `more` is None.
    """

    fitted: Fitted
    noise: float
    more: Sequence[str] | None = None
    rounding: Mapping[str, float] = field(default_factory=dict)
    strained: bool = False
    least: float = 0.0

    @cached_property
    def _without_waves(self) -> _Columns:
        return _Columns(self)

    def likeliest(self) -> Posterior:
        """Return the posterior of what is fitted, for the most probable sizes alone."""
        columns = self._without_waves
        evidence = columns.evidence()
        return columns.posterior(evidence, evidence.most_probable(columns.considered)[0])

    def judging(self) -> Posterior:
        """Return the posterior averaged over plausible sizes, with the device, to judge an arm."""
        columns = self._without_waves
        evidence, size, wider, near = columns.plausible
        found, sums = columns.posterior(evidence, size), columns.sums
        shift, covariance = columns.averaged(wider, near)
        precision, count = wider.precision(size), columns.arm.stop
        device = _device(sums.plain[:-1, :-1], sums.cross[:-1], sums.doubtful, precision, count)
        found = replace(found, shift=shift, covariance=self._shared(covariance), device=device)
        return found if self.fitted.held is None else found.held_at(*self.fitted.held)

    def with_mixture(self, posterior: Posterior) -> Posterior:
        """Return its posterior with the arms that may have given the data.

        Its axes may wobble by the `unmodelled` waves, and the device may be out of scale, and also
        strained, if it is or if linear joints look alike. If it is, errors are those of the arm
        itself, not as the device sees it.
        """
        waves, fitted = posterior.unmodelled.waves, self.fitted
        noisy = self.least > HALF_THE_DIGITS  # as all that is measured
        strained = noisy and (self.strained or bool(travels(fitted.chain)))
        again = replace(self, noise=self.least) if strained else self
        columns = _Columns(again, waves, strained) if waves or strained else self._without_waves
        (evidence, size, wider, near), arm = columns.plausible, columns.arm
        rival, device, checked = None, np.zeros(1), bool(fitted.problem.sigma_scale)
        if columns.scaled and fitted.held is None and (checked or columns.scale < PRINTED):
            far = max(OUT_OF_SCALE, columns.scale)
            ways = ('', *('strains', 'scale') * strained)
            rivals = [columns.evidence(far, sized) for sized in ways]
            against = (r.odds_against(evidence, size, columns.considered) for r in rivals)
            odds, mean, covariance = max(against, key=lambda each: each[0])
            # assumed: one stated scale in twenty is wrong (benchmarks/scale.py --checked)
            odds += float(special.logit(1.0 - CONFIDENT if checked else UNUSUAL))
            rival = odds, mean[arm], self._shared(covariance[arm, arm])
            device = mean[arm.stop :]
        found = [(w, *solved(*columns.normal, wider.precision(each))) for w, each in near]
        if self.strained:
            own, weights = np.s_[: len(posterior.names)], [weight for weight, _ in near]
            mean, covariance = mixed([(mean[own], root[own]) for _, mean, root in found], weights)
            posterior = replace(
                posterior, shift=mean - columns.offsets[own], covariance=self._shared(covariance)
            )
        mixture = [
            (w, mean[arm], self._shared(root[arm] @ root[arm].T)) for w, mean, root in found
        ]
        if fitted.held is not None:  # nothing measures the scale
            mixture = [posterior.with_held(each, *fitted.held) for each in mixture]
        elif columns.scaled and rival is None:
            device = found[0][1][arm.stop :]
        scale, strain = float(device[-1]), differing(device[:-1])
        likely = tuple(mixture)
        return replace(posterior, mixture=likely, rival=rival, scale=scale, strain=strain)

    def _shared(self, covariance: FloatArray) -> FloatArray:
        """Return a covariance with what errors shared by neighbours add."""
        more = self.fitted.uncertainty.shared
        return covariance + np.pad(more, (0, len(covariance) - len(more)))


class _Columns:
    """Columns of the arm, of its waves, of strains, and of the scale of a device with lengths.

    With the products of their rows for noise of a size.
    """

    def __init__(self, given: Inference, waves: float = 0.0, strained: bool = False) -> None:
        fitted = given.fitted
        problem, names, system = fitted.problem, fitted.names, fitted.system
        seen, more = given.more is not None, given.more or ()
        own = [n for n in more if not (Parameter(n).of_dh or problem.model.owns_frame(n))]
        self.names, self.chain = (*names, *more), fitted.chain.with_effects(own)
        beside = {name: std for name, std in given.rounding.items() if name in names}
        whole, lengths, self.scale = self.chain, dict[str, float](), SCALE
        if seen:
            if any(n.kind in effects.PLAY for n in map(Parameter, own)):
                system = fitted.sided
            whole, lengths, self.scale = lengths_of(self.chain, system)
        strained &= bool(lengths)
        noise = max(given.noise, HALF_THE_DIGITS)  # parameters that follow all exactly leave none
        if seen or beside or waves:
            unmodelled = Unmodelled(waves=waves)
            nuisances = Nuisances(beside, lengths, seen, unmodelled, True, strained)
            self.sums = nuisance_products(whole, self.names, system, nuisances, noise)
        else:
            plain = fitted.products / noise**2
            self.sums = NuisanceProducts(plain, plain[:, :0], plain[:0, :0])
        self.scaled, count = bool(lengths), len(self.sums.plain) - 1
        self._device = self.scaled + strained * len(STRAINS)
        self.arm = slice(0, count - self._device)  # with waves, in units of their size
        self.offsets = np.append(fitted.offsets, np.zeros(count - len(names)))
        self.normal = about_nominal(self.sums.reduced[:-1], self.offsets)
        known: dict[str, float] = {**problem.given} | {**lenses(problem.model)}
        higher = {name for name in own if effects.group_of(name) == 'gear'}
        sized = {n: 'harmonic' if n in higher else size_group(self.chain, n) for n in self.names}
        groups = [None if name in known else sized[name] for name in self.names]
        self.considered = {*groups[len(names) :]} - {*groups[: len(names)]}
        rest = self.arm.stop - len(groups)  # waves
        self._checked = 0.0 if given.strained else problem.sigma_scale
        self._groups = groups + [None] * rest
        self._given = [known.get(name, np.inf) for name in self.names] + [1.0] * rest

    def evidence(self, scale: float | None = None, sized: str = '') -> Evidence:
        """Return the evidence; with another usual `scale` of the device that nobody checked.

        And of its strains, all of one size; or usual ones, if either of both is `sized` alone.
        """
        far = self.scale if scale is None else scale
        typical = TYPICAL | {'scale': self.scale if sized == 'strains' else far}
        known = [self._checked if sized or scale is None else 0.0] * self._device
        if sized == 'strains':
            known[-1] = far
        elif sized:
            known = [each or self.scale for each in known[:-1]] + [0.0]
        groups = self._groups + [None if each else 'scale' for each in known]
        given = np.array(self._given + [each or np.inf for each in known])
        return Evidence(*self.normal, given**-2.0, groups, typical)

    @cached_property
    def plausible(self) -> tuple[Evidence, FloatArray, Evidence, list[tuple[float, FloatArray]]]:
        """Return the evidence, its most probable log sizes (G,), it `widened`, and sizes near."""
        evidence = self.evidence()
        size, slope = evidence.most_probable(self.considered)
        return evidence, size, evidence.widened(size), evidence.sigma_points(size, slope)

    def posterior(self, evidence: Evidence, size: FloatArray) -> Posterior:
        """Return the posterior for log sizes (G,), without the device."""
        usual = zip(self.names, evidence.precision(size).tolist(), strict=False)
        priors = {name: float(each**-0.5) for name, each in usual if each > 0.0}
        shift, covariance = self.averaged(evidence, [(1.0, size)])
        device, sizes = np.zeros((self.arm.stop, 0)), evidence.named(size)
        found = self.offsets[self.arm], shift, covariance, device, priors, sizes
        return Posterior(self.chain, self.names, *found)

    def averaged(
        self, evidence: Evidence, near: Sequence[tuple[float, FloatArray]]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the mean (P,) from the fit and the covariance (P, P), for weighted log sizes."""
        weights, tried = zip(*near, strict=True)
        matrix, vector = about_nominal(self.sums.plain[self.arm], self.offsets)
        wide = evidence.precision(np.array(tried))[:, self.arm]
        alone = [solved(matrix[:, self.arm], vector, each) for each in wide]
        mean, covariance = mixed(alone, weights)
        return mean - self.offsets[self.arm], covariance


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
