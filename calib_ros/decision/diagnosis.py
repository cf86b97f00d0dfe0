# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The mistakes that explain the measurements, and how they are told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_ros.decision.reasons import Reason, Rule
from calib_ros.decision.suspects import ORIENTATIONS, UNHOLD
from calib_ros.decision.undoing import Suspect
from calib_ros.shown import rounded


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The mistakes that explain the measurements, and typical errors [m] with and without them.

    The latter is NaN if unknown. `where` names the set if others fit the arm.
    """

    suspects: tuple[Suspect, ...]
    given: float
    corrected: float
    where: str = ''

    @property
    def alone(self) -> bool:
        """Tell whether this refuses a result by itself."""
        return all(
            each.rank
            and (not each.chain or each.remedy == UNHOLD)
            and each.what != ORIENTATIONS.what
            for each in self.suspects
        )

    @property
    def of_frames(self) -> bool:
        """Tell whether the chain file only holds frames in wrong places."""
        return all(each.remedy == UNHOLD for each in self.suspects)

    @property
    def reason(self) -> Reason:
        """Return the reason to refuse a result: the mistakes, then the typical errors."""
        whats = [f'{each.what}: {each.remedy}' for each in self.suspects]
        if np.isnan(self.corrected):
            return Reason(Rule.MISTAKE, f'{self.where}{whats[0]}')
        errors = (
            f' (the uncorrected arm is then typically {rounded(1e3 * self.corrected)} mm off, not '
            f'{rounded(1e3 * self.given)} mm)'
        )
        return Reason(Rule.MISTAKE, f'{self.where}{"; or ".join(whats)}', errors)

    def __str__(self) -> str:
        return str(self.reason)
