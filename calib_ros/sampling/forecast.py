# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Progress of sampling as text: what is expected of the samples so far, and how many more."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_ros.estimation.levels import NEARER
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.estimate import Estimate
from calib_ros.settings import Settings
from calib_ros.shown import counted, rounded

LITTLE = 0.35
"""Range [rad] of a joint over all samples that is too little: 20 degrees (or 0.035 m). A
convention."""


def progress(
    chain: Chain, fitted: Sequence[FloatArray], estimate: Estimate | None, settings: Settings
) -> list[str]:
    """Return number and expected accuracy of the samples to fit, and joints that hardly moved.

    `fitted` holds the joint values (n,) of each.
    """
    told = counted(len(fitted), 'pose')
    if estimate is not None and estimate.astray(settings.largest_error):
        apart = f'{1e3 * estimate.rms:.0f} mm from where the joints are'
        if not estimate.excess or estimate.rms <= settings.largest_error:
            apart = 'which do not fit this arm'
        told += f', {apart}: check units, clocks, sigmas and chain'
    elif estimate is not None:
        told += f', {rounded(1e3 * estimate.sigma)} mm expected, {_forecast(estimate, settings)}'
    still = barely_moved(chain, np.array(fitted)) if fitted else ()
    return [told, f'hardly moved so far: {", ".join(still)}' if still else '']


def _forecast(estimate: Estimate, settings: Settings) -> str:
    wanted = settings.wanted_accuracy
    if estimate.enough(wanted):
        return 'enough for the accuracy wanted'
    if estimate.excess is None:
        return 'too few to predict how many are needed'
    if estimate.excess * NEARER > 1.0:  # not by chance, even with the fewest samples
        advice = 'is the target firm? More'
        if settings.model == 'geometric':
            advice = 'set model to auto, more'
        return f'{advice} will not help: what is left is {estimate.excess:.0f} x noise'
    more = estimate.more_for(wanted)
    if more > settings.pose_buffer:
        return f'{1e3 * wanted:g} mm is out of reach: are units, sigmas and wanted_accuracy right?'
    return f'about {more} more for {1e3 * wanted:g} mm'


def barely_moved(chain: Chain, joints: FloatArray) -> tuple[str, ...]:
    """Return the movable joints whose values (N, n) span too little to determine them."""
    least = [LITTLE if joint.type == 'revolute' else 0.1 * LITTLE for joint in chain.joints]
    little = np.flatnonzero(np.ptp(joints, axis=0) < least).tolist()
    return tuple(chain.joint_names[k] for k in little if k not in chain.held)
