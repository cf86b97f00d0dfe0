# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From samples to a problem: `collect` groups them into sets of observations with their frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.identification.records import Owner
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.sample import Frames, Sample, socket_pairs
from calib_ros.sampling.sources import parse_sources
from calib_ros.settings import Settings
from calib_ros.shown import Shown

AS_NUMBERS = (
    *('joints', 'position', 'rotation', 'covariance', 'approach'),
    *('distance', 'velocity', 'acceleration', 'delay'),
)
"""Fields of a sample that are columns of observations."""


def collect(
    samples: Sequence[Sample],
    sigmas: tuple[float, float],
    frames: Frames,
    posed: bool = False,
    columns: Callable[[Sequence[int]], Mapping[str, Any]] | None = None,
) -> Iterator[tuple[list[int], Observations]]:
    """Yield the indices of the samples of each set, and its observations.

    Samples to fit and held out of each pair of frames make sets of their own. `sigmas` (position
    [m], orientation [rad]) are those of poses seen by a camera on the flange without a covariance
    of their own. `frames` remembers the names given to earlier samples. With `posed` the poses of
    boards are taken instead of their corners. If the samples are examples of each kind only,
    `columns` returns the columns of one set by their indices.
    """
    groups: dict[tuple[Any, ...], list[int]] = {}
    for k, sample in enumerate(samples):
        cornered = sample.view is not None and not posed
        kind = (sample.socket, sample.plane, sample.distance is None, cornered)
        key = (*frames.of(sample), sample.eye_in_hand and not cornered, sample.validation, kind)
        groups.setdefault(key, []).append(k)
    for (base, tool, inverted, *_), members in groups.items():
        some = [samples[k] for k in members]
        found = _observations(some[0], columns(members) if columns else _columns(some))
        if some[0].view is not None and not posed:
            found = _seen(found, some)
        found = replace(found, base=base, tool=tool)
        yield members, found.inverted(sigmas) if inverted else found


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


def _seen(posed: Observations, samples: Sequence[Sample]) -> Observations:
    """Return the corners of images (N), given the poses of their boards."""
    views = [sample.view for sample in samples if sample.view is not None]
    rows = posed.select(np.repeat(np.arange(len(views)), [len(each.pixels) for each in views]))
    return replace(
        rows,
        positions=np.zeros((len(rows), 3)),
        rotations=np.tile(np.eye(3), (len(rows), 1, 1)),
        oriented=np.zeros(len(rows), dtype=bool),
        covariance=None,
        pixels=np.concatenate([each.pixels for each in views]),
        points=np.concatenate([each.points for each in views]),
        on_flange=samples[0].eye_in_hand,
    )


def _columns(samples: Sequence[Sample]) -> dict[str, Any]:
    """Return the columns (N, ...) of samples, None where none has a value, NaN where it lacks."""
    found: dict[str, Any] = {
        'stamps_ns': np.array([sample.stamp_ns for sample in samples], dtype=np.int64),
        'oriented': np.array([sample.rotation is not None for sample in samples]),
    }
    for name in AS_NUMBERS:
        rows = [getattr(sample, name) for sample in samples]
        shape = next((np.shape(row) for row in rows if row is not None), None)
        lacking = np.eye(3) if name == 'rotation' else np.full(shape or (), np.nan)
        filled = [lacking if row is None else row for row in rows]
        found[name] = None if shape is None else np.array(filled, dtype=np.float64)
    return found


def _observations(first: Sample, columns: Mapping[str, Any]) -> Observations:
    """Return the observations of columns (N, ...), of one kind with a sample."""

    def optional(name: str, lacking: float = 0.0) -> FloatArray | None:
        values = columns[name]
        if values is None or np.isnan(values).all():
            return None
        return np.where(np.isnan(values), lacking, values)

    count, rotation = len(columns['joints']), columns['rotation']
    return Observations(
        columns['stamps_ns'],
        columns['joints'],
        np.zeros((count, 3)) if first.position is None else columns['position'],
        np.broadcast_to(np.eye(3), (count, 3, 3)) if rotation is None else rotation,
        columns['oriented'],
        optional('covariance', np.nan),
        optional('approach'),
        None if first.distance is None else columns['distance'],
        optional('velocity'),
        optional('acceleration'),
        columns['delay'],
        socket=first.socket,
        plane=first.plane,
    )


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


def with_lenses(chain: Chain, found: Mapping[str, Lens]) -> Chain:
    """Return a chain with lenses at its frames."""
    for name, lens in found.items():
        frame = chain.frame(name) if name in chain.frame_names else Frame()
        chain = chain.with_frame(name, replace(frame, lens=lens))
    return chain


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
        return Problem(
            with_lenses(chain, self.lenses),
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
