# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples in sets of observations, one for each pair of frames and purpose."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib_ros.estimation.observations import Observations
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.sample import Frames, Sample

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
