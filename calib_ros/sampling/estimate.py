# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The estimate from samples: its accuracy, and how many more are expected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.sample import Sample


@dataclass(frozen=True, eq=False)
class Estimate:
    """The estimate from the samples so far.

    `excess` is the ratio of position residuals to the scatter of measurements: the given sigma, or
    the spread at a stop if larger. None with too few samples, whose sigma is mostly that of
    priors.
    """

    chain: Chain
    names: tuple[str, ...]
    covariance: FloatArray  # (P, P)
    samples: int
    sigma: float  # RMS standard deviation [m] of positions over the joint range
    noise: float  # of the residuals, used for sigma [sigma given]
    misfit: float  # the same noise, of positions [m]: beyond the arm's own if its parameters are
    rms: float  # of position residuals [m]
    excess: float | None

    def enough(self, wanted: float) -> bool:
        """Tell whether a wanted sigma [m] is reached, and not by the priors."""
        return self.excess is not None and self.sigma <= wanted

    def astray(self, largest_error: float) -> bool:
        """Tell whether positions, or the arm that explains them, are further off than any [m]."""
        left = self.rms if self.excess else 0.0
        return max(left, min(self.misfit, self.sigma)) > largest_error

    def more_for(self, wanted: float) -> int:
        """Return how many more samples are expected for a wanted sigma [m]."""
        return max(0, int(np.ceil(self.samples * ((self.sigma / wanted) ** 2 - 1.0))))


class Update(NamedTuple):
    """What an update has found."""

    estimate: Estimate | None = None  # None with too few samples
    refused: str = ''  # why the samples make no valid problem; empty if they do
    suspicious: tuple[Sample, ...] = ()  # too far from the prediction of the others, ignored
