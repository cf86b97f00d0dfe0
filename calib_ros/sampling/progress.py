# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How far the samples are, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.live import Estimate, barely_moved
from calib_ros.settings import Settings

NOT_NOISE = 3.0
"""RMS residual [what measurements scatter by] from which it is no noise, and more samples would
average nothing: chance alone does not reach it with the fewest samples of which it is told."""


def progress(
    chain: Chain, fitted: Sequence[FloatArray], estimate: Estimate | None, settings: Settings
) -> list[str]:
    """Return how many samples there are to fit, what they promise, and which joints hardly moved.

    `fitted` holds the joint values (n,) of each.
    """
    counted = f'{len(fitted)} samples'
    if estimate is not None:
        counted += f', {1e3 * estimate.sigma:.3f} mm expected, {_forecast(estimate, settings)}'
    still = barely_moved(chain, np.array(fitted)) if fitted else ()
    return [counted, f'hardly moved so far: {", ".join(still)}' if still else '']


def _forecast(estimate: Estimate, settings: Settings) -> str:
    """Return in words what it takes until positions are known as well as wanted."""
    wanted = settings.wanted_accuracy
    more = estimate.more_for(wanted)
    if not more:
        return 'enough for the accuracy wanted'
    if estimate.excess is None:
        return 'too few to tell how many it takes'
    if estimate.excess > NOT_NOISE:
        advice = 'is the target firm? More'
        if settings.model == 'geometric':
            advice = 'set model to auto, more'
        return f'{advice} will not help: what is left is {estimate.excess:.0f} x noise'
    return f'{more} more expected for {1e3 * wanted:g} mm'
