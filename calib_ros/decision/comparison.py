# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Residuals of the same poses before and after, their figures, and what chance makes of a gain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import special

from calib_ros.decision.residuals import (
    ErrorFigures,
    Residuals,
    axes_of,
    by_axes,
    joined,
    residuals,
)
from calib_ros.estimation.configurations import renumber
from calib_ros.estimation.levels import CONFIDENT
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.visits import as_measured
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import Flags, FloatArray, Index, norms
from calib_ros.shown import Shown, as_frame, of_them

COUNTS = 0.005
"""Relative change of an RMS error that counts; less is chance (benchmarks/real_robots.py)."""


@dataclass(frozen=True)
class GroupVerdict:
    """Held-out RMS with and without a group of effects or a harmonic."""

    what: str
    rms_mm_before: float
    rms_mm_after: float
    pays: bool


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Shown):
    """Residuals of the same poses before and after.

    Before is the nominal chain with fitted base and tool frames, so that the gain is the arm's.
    `judged` (N,) is False for outliers; `repeated` (N,) is True for held-out pairs at fitted
    configurations, which count nowhere. If the device drifts, `together` pairs tell as much as
    one. Configurations are of the `kind` poses, stations or locations.
    """

    before: Residuals
    after: Residuals
    judged: Flags
    repeated: Flags | None = None
    together: float = 1.0
    kind: str = 'poses'

    @property
    def counting(self) -> Flags:
        """Return which pairs (N,) count, with outliers."""
        return np.ones_like(self.judged) if self.repeated is None else ~self.repeated

    @property
    def deciding(self) -> Flags:
        """Return which pairs (N,) are in the figures."""
        return self.counting & self.judged

    @property
    def outliers(self) -> int:
        """Return the number of outliers, which are left out of the figures."""
        return int((self.counting & ~self.judged).sum())

    @property
    def share_of_outliers(self) -> float:
        """Return their share of the pairs that count."""
        return self.outliers / int(self.counting.sum())

    @property
    def omitted(self) -> str:
        """Return in words which pairs are not in the figures."""
        return f', {of_them(self.outliers, "outlier")} not in the figures' if self.outliers else ''

    @cached_property
    def figures(self) -> tuple[ErrorFigures, ErrorFigures]:
        """Return the figures before and after, without outliers."""
        return self.before.figures(self.deciding), self.after.figures(self.deciding)

    def to_frame(self) -> Any:
        """Return the position residuals [m] before and after as a pandas.DataFrame."""
        columns = {
            f'{when}_{axis}': residuals.position[:, k]
            for when, residuals in (('before', self.before), ('after', self.after))
            for k, axis in enumerate('xyz')
        }
        groups = {'configuration': self.after.configurations, 'judged': self.deciding}
        return as_frame(columns | groups)

    @cached_property
    def figures_of_all(self) -> tuple[ErrorFigures, ErrorFigures]:
        """Return the figures before and after with outliers."""
        return self.before.figures(self.counting), self.after.figures(self.counting)


def compare(
    before: Chain,
    after: Chain,
    sets: Sequence[Observations],
    judged: Flags | None = None,
    together: float = 1.0,
) -> Comparison:
    """Return the residuals of all sets by both chains, with `judged` (N,) and `together`."""
    numbers = as_measured(sets)
    last, first = (  # `after` first: cached after a fit
        joined([residuals(chain, each) for each in sets], numbers) for chain in (after, before)
    )
    every = np.ones(len(numbers), dtype=bool)
    return Comparison(first, last, every if judged is None else judged, together=together)


def along_base(found: Comparison, chain: Chain, sets: Sequence[Observations]) -> Comparison:
    """Return residuals of sets along the axes of the arm's base, which all devices share."""
    turns = np.concatenate([axes_of(chain, each) for each in sets])

    def turned(which: Residuals) -> Residuals:
        position, orientation = by_axes(which.position, turns), by_axes(which.orientation, turns)
        return replace(which, position=position, orientation=orientation)

    return replace(found, before=turned(found.before), after=turned(found.after))


def mean_squares(before: FloatArray, after: FloatArray, configurations: Index) -> FloatArray:
    """Return the mean squared errors (2, K) of K configurations, for errors (N, 3) of pairs."""
    squares = np.stack([norms(before), norms(after)]) ** 2
    known = ~np.isnan(squares).any(axis=0)
    group = renumber(configurations[known])
    return np.stack([np.bincount(group, row) for row in squares[:, known]]) / np.bincount(group)


def log_gain(
    before: FloatArray, after: FloatArray, configurations: Index, confidence: float = CONFIDENT
) -> tuple[float, float]:
    """Return the log of RMS before / RMS after, and its size that chance could cause.

    Errors are (N, 3). The standard error is that of the difference of the two logarithms by the
    delta method, from the spread over configurations, because pairs of one are not independent.
    """
    means = mean_squares(before, after, configurations)
    count = means.shape[1]
    if count < 2:
        return 0.0, np.inf
    totals = np.maximum(means.mean(axis=1, keepdims=True), 1e-300)
    deviation = np.diff(means / totals, axis=0).std(ddof=1)
    limit = special.stdtrit(count - 1, confidence) * deviation / np.sqrt(count)
    return 0.5 * float(np.log(totals[0, 0] / totals[1, 0])), 0.5 * float(limit)
