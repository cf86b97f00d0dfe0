# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From samples to a problem: sets to fit and held out, with their frames and lenses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.identification.records import Owner
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.lens import Lens
from calib_ros.sampling.sample import Frames, Sample, socket_pairs
from calib_ros.sampling.sets import collect
from calib_ros.sampling.source_texts import parse_sources
from calib_ros.settings import Settings
from calib_ros.shown import Shown


def lenses_by_frame(samples: Iterable[Sample], frames: Frames) -> dict[str, Lens]:
    """Return the lens at each camera frame, which must not change."""
    found: dict[str, Lens] = {}
    for sample in samples:
        if sample.view is not None:
            camera = frames.of(sample)[sample.eye_in_hand]
            if found.setdefault(camera, sample.view.lens) != sample.view.lens:
                raise InputError(
                    f'the CameraInfo of {sample.device or "the camera"} has changed: one setting '
                    'of the lens for all images (~/remove_last those since, or ~/clear)'
                )
    return found


def check_settings(chain: Chain, settings: Settings) -> None:
    """Refuse settings with a ConfigError that no identification of a chain could use."""
    names = settings.joint_names or chain.joint_names
    if not len(names) == len({*names}) == len(chain.joints):
        raise ConfigError(
            f'joint_names must be {len(chain.joints)} different names, one for each of '
            f'{", ".join(chain.joint_names)}; not {", ".join(names)}'
        )
    if settings.mode == 'continuous' and any(
        each.board for each in parse_sources(settings.sources)
    ):
        raise ConfigError('images are used only at stops of the arm: mode must not be continuous')
    nothing = np.zeros((0, len(chain.joints)))
    empty = replace(Observations.from_arrays(nothing, np.zeros((0, 3))), approach=nothing)
    Problem(chain, empty, **settings.for_problem())


@dataclass(frozen=True, eq=False, repr=False)
class Dataset(Shown):
    """The sets to fit and held out, each with its own frames."""

    fitted: Sequence[Observations]
    held_out: Sequence[Observations] = ()
    pairs: Sequence[tuple[str, str]] = ()  # frames of two sockets at one location
    world_frame: str = ''  # the first frame of the devices
    lenses: Mapping[str, Lens] = field(default_factory=dict)  # at the frames of cameras
    owners: Mapping[str, Owner] = field(default_factory=dict)  # whose frame each is
    warnings: tuple[str, ...] = ()
    by_line: bool = False  # stamps are the lines of a table, in seconds

    def problem(self, chain: Chain, settings: Settings | None = None, **more: Any) -> Problem:
        """Return the problem for a chain, by default with the usual settings.

        Raises InputError if all rows judge.
        """
        if not self.fitted:
            raise InputError(
                'the table has no rows to fit, only rows marked test in its column split'
            )
        settings = settings or Settings()
        for name, lens in self.lenses.items():
            frame = chain.frame(name) if name in chain.frame_names else Frame()
            chain = chain.with_frame(name, replace(frame, lens=lens))
        return Problem(
            chain,
            self.fitted[0],
            self.held_out,
            more=self.fitted[1:],
            separations=tuple((*pair, settings.socket_distance) for pair in self.pairs),
            world_frame=self.world_frame,
            **settings.for_problem(),
            **more,
        )


def dataset_of(
    samples: Sequence[Sample],
    sigmas: tuple[float, float],
    posed: bool = False,
    columns: Callable[[Sequence[int]], Mapping[str, Any]] | None = None,
) -> Dataset:
    """Return the sets of samples with their frames; arguments as in `collect`."""
    frames = Frames()
    sets: tuple[list[Observations], list[Observations]] = ([], [])  # fitted, held out
    for members, found in collect(samples, sigmas, frames, posed, columns):
        sets[samples[members[0]].validation].append(found)
    pairs = tuple(socket_pairs(samples, frames))
    free = (each.frame_id for each in samples if not (each.socket or each.plane))
    world_frame = next(free, '')  # of `base`
    cameras = {} if posed else lenses_by_frame(samples, frames)
    return Dataset(*sets, pairs, world_frame, cameras, frames.owners)
