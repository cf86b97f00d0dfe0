# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From samples and settings to a problem of the identification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros.identification.observations import Observations
from calib_ros.identification.problem import Problem
from calib_ros.kinematics.chain import Chain
from calib_ros.sampling.sample import Frames, Sample, collect, socket_pairs
from calib_ros.settings import Settings


def check_settings(chain: Chain, settings: Settings) -> None:
    """Refuse settings that no identification of a chain could use, before anything is measured.

    Raises
    ------
    ConfigError
        When a name is unknown to this chain, say.

    """
    nothing = np.zeros((0, len(chain.joints)))
    empty = replace(Observations.from_arrays(nothing, np.zeros((0, 3))), approach=nothing)
    Problem(chain, empty, **settings.for_problem())


def problem_of(
    chain: Chain, samples: Sequence[Sample], settings: Settings, socket_distance: float
) -> Problem | None:
    """Return samples as a problem; None when there is none to fit.

    Two sockets of a location are `socket_distance` [m] apart.
    """
    frames = Frames()
    sigmas = settings.sigma_position, settings.sigma_orientation
    fitted, held_out = collect(samples, sigmas, frames)
    if not fitted:
        return None
    pairs = socket_pairs(samples, frames)
    return Problem(
        chain,
        fitted[0],
        held_out,
        more=fitted[1:],
        separations=tuple((*pair, socket_distance) for pair in pairs),
        world_frame=samples[0].frame_id,  # it is the frame of `base`
        **settings.for_problem(),
    )
