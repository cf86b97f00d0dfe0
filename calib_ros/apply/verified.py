# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The outcome of a verification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calib_ros.apply.judgement import Judgement
from calib_ros.decision.moved import Step
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import LISTED, Shown, as_html, interval_mm, rounded


class Attained(NamedTuple):
    """Accuracy before and after [mm] and repeatability [mm] of a configuration (ISO 9283)."""

    cycles: int
    before: float
    after: float
    repeatability: float | None

    @classmethod
    def of(cls, before: FloatArray, after: FloatArray) -> Attained:
        """Return the figures of errors (N, 3) [mm]."""
        first, last = (float(np.linalg.norm(each.mean(axis=0))) for each in (before, after))
        apart = np.linalg.norm(after - after.mean(axis=0), axis=1)
        again = float(apart.mean() + 3.0 * apart.std(ddof=1)) if len(after) > 1 else None
        return cls(len(after), first, last, again)


@dataclass(frozen=True, eq=False, repr=False)
class Verification(Judgement, Shown):
    """A judgement of a calibrated arm, and what explains the errors."""

    tolerance: float | None
    """Wanted RMS position error [m]."""
    common: float
    """Share of the RMS error that remains without one common shift and turn of all positions."""
    by_program: bool
    """Whether the wanted poses are those of the uncorrected program."""
    chain: Chain
    """The calibrated arm in the frame of its base, with fitted tools."""
    fitted: tuple[str, ...] = ()
    """Frames fitted to the new measurements."""
    outside: float = 0.0
    """Share of the measurements outside the region of the calibration."""
    uncorrected: bool = False
    """Whether all measurements were taken at the joint values of the program as it was given."""
    odd: tuple[int, ...] = ()
    """Configurations without which the others would be within the limit."""
    step: Step | None = None
    """What moved during the measurement, if the arm exceeds the limit."""
    unseen: float | None = None
    """Largest error [m] in the joint range by one parameter that a good verdict leaves open."""

    def _repr_html_(self) -> str:
        before, after = self.comparison.figures
        between = interval_mm(1e3 * self.lower, 1e3 * self.upper)
        like = f'RMS over poses like these ({100 * self.confidence:g} %: {between})'
        rows = (
            ('position error [mm]', 'before', 'after'),
            ('RMS', rounded(before.rms_mm), rounded(after.rms_mm)),
            ('largest', rounded(before.max_mm), rounded(after.max_mm)),
            (like, '', rounded(1e3 * self.rms)),
            ('limit', '', '' if self.limit is None else rounded(1e3 * self.limit)),
        )
        return as_html(self.verdict, (), rows)

    @property
    def each(self) -> tuple[Attained, ...]:
        """Return the accuracy at each configuration; empty beyond LISTED of them."""
        if self.configurations > LISTED:
            return ()
        both = (self.comparison.before.position, self.comparison.after.position)
        return tuple(
            Attained.of(*(1e3 * errors[self.group == k] for errors in both))
            for k in range(self.configurations)
        )
