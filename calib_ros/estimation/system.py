# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples of all sets with priors and known distances: the system that a fit solves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.estimation.samples import Samples
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import parameters_of
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.settings import Settings
from calib_ros.shown import Shown


@dataclass(frozen=True)
class Prior:
    """Gaussian priors: standard deviations [m or rad] of parameters about the nominal chain.

    `noise` scales the sigmas of the data: if these are too small, priors count for more.
    """

    nominal: Chain
    sigmas: Mapping[str, float] = field(default_factory=dict)
    noise: float = 1.0

    def rows(self, chain: Chain, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Return noise / sigma (P,), zero without a prior, and the weighted residual (P,)."""
        inverse = np.array([self.noise / self.sigmas.get(n, np.inf) for n in names])
        offsets = np.array(
            [chain.offset(n, self.nominal) if n in self.sigmas else 0.0 for n in names]
        )
        return inverse, -offsets * inverse


@dataclass(frozen=True, eq=False, repr=False)
class System(Shown):
    """Sets of samples to fit, with priors and known socket separations."""

    sets: tuple[Samples, ...]
    prior: Prior | None = None
    separations: tuple[tuple[str, str, float], ...] = ()
    sigma_scale: float = 0.0
    """Relative standard deviation of these; 0 for that of devices [m] by default."""

    def extra_rows(self, chain: Chain, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Return Jacobian (R, P) and residual (R,) in sigma of priors and known separations."""
        rows, residual = self.separation_rows(chain, names)
        if self.prior is not None:
            inverse, offsets = self.prior.rows(chain, names)
            rows, residual = np.vstack([np.diag(inverse), rows]), np.append(offsets, residual)
        return rows, residual

    def separation_rows(self, chain: Chain, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Return Jacobian (S, P) and residual (S,) in sigma of the known separations."""
        rows = np.zeros((len(self.separations), len(names)))
        residual = np.zeros(len(self.separations))
        column = {name: k for k, name in enumerate(names)}
        for i, (first, second, distance) in enumerate(self.separations):
            apart = chain.frame(second).matrix[:3, 3] - chain.frame(first).matrix[:3, 3]
            length = max(float(np.linalg.norm(apart)), 1e-12)
            residual[i] = distance - length
            for frame, sign in ((first, -1.0), (second, 1.0)):
                for k, name in enumerate(parameters_of(frame)[:3]):
                    if name in column:
                        rows[i, column[name]] = sign * apart[k] / length
        known = np.array([distance for *_, distance in self.separations])
        sigmas = self.sigma_scale * known if self.sigma_scale else Settings.sigma_position
        return (rows.T / sigmas).T, residual / sigmas

    def select(self, chosen: Sequence[NDArray[np.generic]]) -> System:
        """Return chosen samples and their weights, by masks (N,) or indices (K,) for each set."""
        pairs = zip(self.sets, chosen, strict=True)
        return replace(self, sets=tuple(samples.select(index) for samples, index in pairs))

    def spread(self, most: int) -> System:
        """Return every k-th sample of each set: at most `most` in all, or one of each set."""
        stride = -(-self.count // most)
        return self.select([np.arange(0, samples.count, stride) for samples in self.sets])

    def weighted(self, weights: Sequence[FloatArray | None]) -> System:
        """Return the samples with weights (N,) for each set; None for ones."""
        pairs = zip(self.sets, weights, strict=True)
        return replace(self, sets=tuple(samples.weighted(each) for samples, each in pairs))

    def rows_of(self, chain: Chain, names: Sequence[str]) -> list[FloatArray]:
        """Return the weighted rows (P + 1, c, N) of each set, the residual last."""
        return [samples.rows_of(chain, names) for samples in self.sets]

    @property
    def count(self) -> int:
        """Return the number of samples."""
        return sum(samples.count for samples in self.sets)

    @property
    def rows(self) -> int:
        """Return the number of measured equations."""
        return sum(samples.rows for samples in self.sets)

    @property
    def ends(self) -> Index:
        """Return the ends (K,) of the samples of all sets but the last."""
        return np.cumsum([samples.count for samples in self.sets])[:-1]

    def count_free(self, names: Sequence[str]) -> int:
        """Return the number of parameters without a prior."""
        known = {} if self.prior is None else self.prior.sigmas
        return sum(name not in known for name in names)


def stacked(rows: Sequence[FloatArray]) -> FloatArray:
    """Return the rows (P, c, N) of all sets as one array (R, P)."""
    return np.concatenate([each.reshape(len(each), -1) for each in rows], axis=1).T


def row_samples(rows: Sequence[FloatArray]) -> Index:
    """Return the sample number (R,), over all sets, of each row of `stacked`."""
    found, first = list[Index](), 0
    for _, width, count in (each.shape for each in rows):
        found.append(np.tile(np.arange(first, first + count), width))
        first += count
    return np.concatenate(found)
