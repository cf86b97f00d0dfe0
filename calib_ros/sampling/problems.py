# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples and settings to a problem of the identification, or to sets that judge a calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.lens import Lens
from calib_ros.sampling.messages import parse_sources
from calib_ros.sampling.sample import Frames, Sample, collect, lenses, named, socket_pairs
from calib_ros.settings import Settings
from calib_ros.shown import Shown


def check_joint_names(chain: Chain, names: Sequence[str]) -> None:
    """Refuse joint names with a ConfigError unless there is one for each joint."""
    count = len(chain.joints)
    if not len(names) == len(set(names)) == count:
        raise ConfigError(
            f'joint_names must be {count} different names, one for each of '
            f'{", ".join(chain.joint_names)}; not {", ".join(names)}'
        )


def check_settings(chain: Chain, settings: Settings) -> None:
    """Refuse settings with a ConfigError that no identification of a chain could use."""
    if settings.mode == 'continuous' and any(
        each.board for each in parse_sources(settings.sources)
    ):
        raise ConfigError('images are used only at stops of the arm: mode must not be continuous')
    nothing = np.zeros((0, len(chain.joints)))
    empty = replace(Observations.from_arrays(nothing, np.zeros((0, 3))), approach=nothing)
    Problem(chain, empty, **settings.for_problem())


def with_lenses(chain: Chain, found: Mapping[str, Lens]) -> Chain:
    """Return a chain with lenses at its frames."""
    for name, lens in found.items():
        frame = chain.frame(name) if name in chain.frame_names else Frame()
        chain = chain.with_frame(name, replace(frame, lens=lens))
    return chain


@dataclass(frozen=True, eq=False, repr=False)
class Measured(Shown):
    """The sets to fit and held out, each with its own frames."""

    fitted: Sequence[Observations]
    held_out: Sequence[Observations] = ()
    pairs: Sequence[tuple[str, str]] = ()  # frames of two sockets at one location
    world_frame: str = ''  # the first frame of the devices
    lenses: Mapping[str, Lens] = field(default_factory=dict)  # at the frames of cameras

    def problem(
        self, chain: Chain, sockets: float = Settings.socket_distance, **more: Any
    ) -> Problem:
        """Return the problem for a chain; two sockets of a location are `sockets` [m] apart."""
        return Problem(
            with_lenses(chain, self.lenses),
            self.fitted[0],
            self.held_out,
            more=self.fitted[1:],
            separations=tuple((*pair, sockets) for pair in self.pairs),
            world_frame=self.world_frame,
            **more,
        )


def problem_of(
    chain: Chain, samples: Sequence[Sample], settings: Settings, posed: bool = False
) -> Problem | None:
    """Return samples as a problem, or None; with `posed` boards as poses, not corners."""
    frames = Frames()
    sigmas = settings.sigma_position, settings.sigma_orientation
    fitted, held_out = collect(samples, sigmas, frames, posed)
    if not fitted:
        return None
    pairs, world_frame = socket_pairs(samples, frames), samples[0].frame_id  # that of `base`
    cameras = {} if posed else lenses(samples, frames)
    measured = Measured(fitted, held_out, pairs, world_frame, cameras)
    more = {'of_messages': True, **settings.for_problem()}
    return measured.problem(chain, settings.socket_distance, **more)


def in_frames_of(
    calibration: Calibration, since: Sequence[Sample], usable: Sequence[Sample], settings: Settings
) -> list[Observations]:
    """Return the poses measured since a calibration, among all usable ones, in its frames.

    Raises InputError if there are none, or if their frames are unknown to it.
    """
    sigmas = (settings.sigma_position, settings.sigma_orientation)
    # without owners, the first device and target have the frames
    frames = Frames(calibration.owners) if calibration.owners else named(usable)
    sets = [each for part in collect(since, sigmas, frames) for each in part]
    if not sets:
        raise InputError(
            'no poses since the calibration was identified or loaded: measure some new poses'
        )
    known = calibration.chain.frame_names
    if not all(each.base in known and each.tool in known for each in sets):
        raise InputError(
            'the new poses come from a device or target that the calibration does not know'
        )
    return sets


def problem_since(
    calibration: Calibration, chain: Chain, sets: Sequence[Observations], settings: Settings
) -> Problem:
    """Return sets between the frames of a calibration as a problem of the nominal chain."""
    cameras = {each.camera for each in sets if each.pixels is not None}
    known = {name: calibration.chain.frame(name).lens for name in cameras}
    seen = {name: lens for name, lens in known.items() if lens}
    return Measured(sets, lenses=seen).problem(chain, **settings.for_problem())
