# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A fit, and the parameters it determines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special

from calib_ros.estimation.levels import CONFIDENT, KNOWN
from calib_ros.estimation.noise import Noise
from calib_ros.estimation.nuisances import Nuisances, nuisance_products
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.robust import Robust
from calib_ros.estimation.system import System
from calib_ros.estimation.uncertainty import Uncertainty
from calib_ros.estimation.visits import sided
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import DELAY, Parameter, parameters_of
from calib_ros.kinematics.se3 import FloatArray, left_jacobian_inverse


@dataclass(frozen=True)
class ParameterRow:
    """One parameter of the model: m for lengths, rad for angles.

    `status` is 'fitted', 'gauge' (redundant by the chain's structure), 'not excited' (the poses do
    not determine it) or 'fixed'; all but the first keep the nominal value. `freedom` are the
    degrees of freedom of `std`; infinite if the noise is known.
    """

    name: Parameter
    value: float
    offset: float
    std: float | None
    status: str
    freedom: float = np.inf

    def half_width(self, level: float = CONFIDENT) -> float | None:
        """Return the half width of the confidence interval, by Student's t."""
        if self.std is None:
            return None
        return self.std * float(special.stdtrit(min(self.freedom, KNOWN), 0.5 + 0.5 * level))

    def beyond(self, length: float, angle: float) -> bool:
        """Tell whether a DH parameter is certainly further from nominal than a limit."""
        limit = length if self.name.is_length else angle
        return self.std is not None and self.name.of_dh and abs(self.offset) - 3 * self.std > limit


@dataclass(frozen=True, eq=False)
class SimplerFit:
    """Results of the fit of a simpler model, without effects."""

    chain: Chain
    distances: tuple[FloatArray, ...]
    noise: Noise


@dataclass(frozen=True, eq=False)
class Fitted:
    """A robust fit with what follows from its residuals.

    `problem` has the last priors; `size` [sigma given] is the noise before data gave priors, of a
    model richer than a simpler one with them.
    `held` are K parameters held at nominal that only other kinds of measurement determine, and how
    the fitted ones follow them (P, K).
    """

    problem: Problem
    structural: tuple[str, ...]  # identifiable names, wherever the poses are
    start: Chain  # with start frames
    names: tuple[str, ...]
    robust: Robust
    factor: FloatArray
    noise: Noise
    uncertainty: Uncertainty
    size: float
    held: tuple[tuple[str, ...], FloatArray] | None = None

    @property
    def chain(self) -> Chain:
        """Return the fitted chain."""
        return self.robust.fit.chain

    @property
    def system(self) -> System:
        """Return the samples with their weights in the fit."""
        return self.robust.system

    @cached_property
    def sided(self) -> System:
        """Return these samples with signs of the last moves (`visits.sided`)."""
        seen = sided([samples.observations for samples in self.system.sets])
        pairs = [*zip(self.system.sets, seen, strict=True)]
        for samples, each in pairs:
            vars(each)['by_joint'] = samples.observations.by_joint  # known
        return replace(self.system, sets=tuple(samples.of(each) for samples, each in pairs))

    def good_sets(self, most: int = SOME_POSES) -> list[Observations]:
        """Return evenly spread samples of each set, at most `most`, without gross errors."""
        pairs = zip(self.problem.sets, self.robust.inliers, strict=True)
        return [each.select(good).spread(most) for each, good in pairs]

    @property
    def frames(self) -> list[str]:
        """Return what is fitted of frames beside the nominal arm: its errors delay no device."""
        own = filter(self.start.owns_frame, self.names)
        return [name for name in own if Parameter(name).kind != DELAY]

    @cached_property
    def offsets(self) -> FloatArray:
        """Return the fitted minus the nominal values (P,); zero for frames."""
        chain, nominal = self.chain, self.problem.model
        return np.array(
            [0.0 if chain.owns_frame(n) else chain.offset(n, nominal) for n in self.names]
        )

    @cached_property
    def products(self) -> FloatArray:
        """Return the products (P + 1, P + 1) of its columns and the residual, without priors."""
        return nuisance_products(self.chain, self.names, self.system, Nuisances()).plain


def parameter_rows(fitted: Fitted, uncertainty: Uncertainty) -> tuple[ParameterRow, ...]:
    """Return every parameter of a fitted chain, with its standard deviation if fitted."""
    problem, chain, names = fitted.problem, fitted.chain, fitted.names
    change = _value_jacobian(chain, names)
    turned = np.flatnonzero((change != np.eye(len(names))).any(axis=1))
    variances = np.einsum('kpp->kp', uncertainty.parts).copy()
    along = change[turned] @ uncertainty.parts
    variances[:, turned] = np.einsum('kvp,vp->kv', along, change[turned])
    std = dict(zip(names, np.sqrt(variances.sum(axis=0)).tolist(), strict=True))
    freedom = dict(zip(names, uncertainty.freedom_of(variances).tolist(), strict=True))
    free = set(problem.free)
    rows = []
    for name in problem.model.parameter_names:
        if name in std:
            status = 'fitted'
        elif name in fitted.structural:
            status = 'not excited'
        else:
            status = 'gauge' if name in free else 'fixed'
        offset = chain.offset(name, problem.model)
        value, spread = chain.value(name), std.get(name)
        rows.append(ParameterRow(name, value, offset, spread, status, freedom.get(name, np.inf)))
    return tuple(rows)


def _value_jacobian(chain: Chain, names: Sequence[str]) -> FloatArray:
    """Return the derivative (P, P) of the values, which differ for rotation vectors of frames.

    A turn by w in the parent's axes changes the vector v = log R by J_l(v)^-1 w.
    """
    change = np.eye(len(names))
    for frame in chain.frame_names:
        turns = parameters_of(frame)[3:]
        own = np.flatnonzero(np.isin(turns, names))  # two at a plane, which is alike all round
        index = [names.index(turns[k]) for k in own]
        if index:
            whole = left_jacobian_inverse(chain.frame(frame).offsets()[3:])
            change[np.ix_(index, index)] = whole[np.ix_(own, own)]
    return change
