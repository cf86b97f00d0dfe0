# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A calibration in use, and how it does on samples that were taken since."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calib_ros.errors import InputError
from calib_ros.identification.identification import Identification
from calib_ros.identification.region import Region
from calib_ros.identification.validation import ErrorFigures, compare
from calib_ros.kinematics.chain import Chain
from calib_ros.sampling.sample import Frames, Sample, collect, named


@dataclass(frozen=True, eq=False)
class Calibration:
    """A corrected chain in use.

    `before` is the nominal chain with fitted frames, where it was identified here; `rms_mm` is
    the error that it was judged to have, and `known` holds the samples that were there by then.
    `result` is the identification that it comes from, and `frames` holds the names that the
    frames had there, if it was here. `region` tells where it may be used, where that is known.
    """

    chain: Chain
    before: Chain | None
    world_frame: str
    rms_mm: float | None
    known: frozenset[Sample]
    result: Identification | None = None
    frames: Frames | None = None
    region: Region | None = None

    def judged(
        self, samples: Sequence[Sample], sigmas: tuple[float, float]
    ) -> tuple[ErrorFigures, ErrorFigures | None]:
        """Return the errors on those of all samples that it does not know; nothing is fitted.

        The second ones are those of the nominal chain with fitted frames, where that is known.
        `sigmas` (position [m], orientation [rad]) are those of poses without a covariance.

        Raises
        ------
        InputError
            Without such samples, or when they are between frames that it does not have.

        """
        frames = self.frames
        if frames is None:  # the first device and target are taken for those of the file
            frames = named(samples)
        since = [each for each in samples if each not in self.known]
        sets = [each for part in collect(since, sigmas, frames) for each in part]
        if not sets:
            raise InputError('no samples have been taken since: measure some new poses first')
        known = self.chain.frame_names
        for each in sets:
            if each.base not in known or each.tool not in known:
                raise InputError(
                    'the samples since were measured by a device or on a target that the '
                    'calibration does not know'
                )
        figures = compare(self.before or self.chain, self.chain, sets).figures
        return figures[1], figures[0] if self.before is not None else None
