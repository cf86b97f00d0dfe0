# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The posterior of the arm: plausible offsets of its parameters and of what is considered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TypeAlias

import numpy as np

from calib_ros.estimation.considered import held_frames, travels
from calib_ros.estimation.joint_errors import NOTHING, Unmodelled
from calib_ros.estimation.sizes import TYPICAL
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import Shown

MixtureTerm: TypeAlias = tuple[float, FloatArray, FloatArray]
"""A weight, with mean (P,) and covariance (P, P) of the offsets."""


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
    mixture: tuple[MixtureTerm, ...] = ()
    """The posterior of the offsets, then of waves in units of their size, for each plausible set
    of sizes, if the device may have a scale error and rounded joint values may be off."""
    rival: MixtureTerm | None = None
    """The same with log odds for a device out of scale, or further than `sigma_scale`; None of a
    printed board of unchecked scale, which may be."""
    scale: float = 0.0
    """The scale of that device or board, minus one."""
    strain: float = 0.0
    """By how much it is larger in one direction than in another."""
    unmodelled: Unmodelled = NOTHING
    """What none of the names explains (`unmodelled.py`)."""

    @cached_property
    def square(self) -> FloatArray:
        """Return the expected squares (P, P) of the parameter errors."""
        return np.asarray(self.covariance + np.outer(self.shift, self.shift))

    def expected(
        self,
        joints: FloatArray,
        base: str = 'base',
        tool: str = 'tool',
        approach: FloatArray | None = None,
    ) -> FloatArray:
        """Return the expected squares (N, 6, 6) of pose errors [m, rad] at joint values (N, n).

        In world axes, unmodelled effects included; `approach` as in `Unmodelled.expected`.
        """
        model = ErrorModel(self.chain, self.names, base, tool)
        return self.unmodelled.expected(model, self.square, joints, approach)

    def widened(self, factor: float) -> Posterior:
        """Return it with all expected errors larger by a factor, but for those of the device."""
        if factor == 1.0:
            return self
        own, waved = np.s_[: len(self.names)], np.s_[len(self.names) :]
        turns, tilts, waves = (factor * size for size in self.unmodelled.sizes.values())
        more = (factor**2 - 1.0) * self.square

        def wider(each: MixtureTerm) -> MixtureTerm:
            weight, mean, covariance = each
            followed, mean = np.eye(len(mean)), mean.copy()
            by_waves = np.linalg.solve(covariance[waved, waved], covariance[waved, own])
            followed[own, waved] = (factor - 1.0) * by_waves.T
            covariance = followed @ covariance @ followed.T
            covariance[own, own] += more
            mean[waved] /= factor  # in units of waves
            return weight, mean, covariance

        return replace(
            self,
            covariance=self.covariance + more,
            mixture=tuple(map(wider, self.mixture)),
            rival=self.rival and wider(self.rival),
            unmodelled=self.unmodelled._replace(turns=turns, tilts=tilts, waves=waves),
        )

    def stds_of(self, names: Sequence[str]) -> FloatArray:
        """Return the standard deviations (K,) of undetermined parameters of the arm."""
        groups = [_group(name) for name in names]
        return np.array([self.sizes.get(group, TYPICAL[group]) for group in groups])

    def held_at(self, names: Sequence[str], slopes: FloatArray) -> Posterior:
        """Return the posterior with K parameters held at nominal, as uncertain as others.

        The first F fitted parameters follow them by `slopes` (F, K).
        """
        wider = replace(self, names=(*self.names, *names))
        _, shift, covariance = wider.with_held((1.0, self.shift, self.covariance), names, slopes)
        return replace(
            wider,
            offsets=np.pad(self.offsets, (0, len(names))),
            shift=shift,
            covariance=covariance,
            device=np.pad(self.device, ((0, len(names)), (0, 0))),
        )

    def with_held(
        self, each: MixtureTerm, names: Sequence[str], slopes: FloatArray
    ) -> MixtureTerm:
        """Return mean (Q,) and covariance (Q, Q) with the K held names inserted before waves."""
        weight, mean, covariance = each
        count, own = len(names), len(self.names) - len(names)
        along = np.concatenate([slopes, np.zeros((own - len(slopes), count)), np.eye(count)])
        place = [own] * count
        covariance = np.insert(np.insert(covariance, place, 0.0, axis=0), place, 0.0, axis=1)
        covariance[: own + count, : own + count] += (along * self.stds_of(names) ** 2) @ along.T
        return weight, np.insert(mean, place, 0.0), covariance

    def prior_share(self, name: str) -> float:
        """Return the share of a parameter's variance due to its prior, 1 if undetermined."""
        variance = float(self.covariance[self.names.index(name), self.names.index(name)])
        return variance / self.priors[name] ** 2 if name in self.priors else 0.0


def size_group(chain: Chain, name: str) -> str | None:
    """Return the group of parameters with errors of one size; None for unknown frames."""
    if chain.owns_frame(name):
        return 'frame' if name in held_frames(chain) else None
    group = _group(name)
    return 'drive' if group == 'ratio' and name not in travels(chain) else group


@lru_cache(maxsize=1024)
def _group(name: str) -> str:
    if Parameter(name).of_dh:
        return 'length' if Parameter(name).is_length else 'angle'
    group = effects.group_of(name)
    return group if group in TYPICAL else 'drive'
