# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Orientations of new measurements by a calibration that knows none.

Positions alone do not show how a target is turned on the flange.
"""

from __future__ import annotations

from collections.abc import Sequence

from calib_ros.estimation.observations import Observations
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics.parameter import FRAME_KINDS, Parameter


def with_known_turns(
    arm: Calibration, sets: Sequence[Observations], new: Sequence[str] = ()
) -> tuple[Observations, ...]:
    """Return measurements without the orientations that a calibration cannot judge.

    Those of `new` frames count: they are fitted to the measurements.
    """
    unknown = _unknown(arm, sets, new)
    return tuple(
        each.without_orientations() if unknown.intersection((each.base, each.tool)) else each
        for each in sets
    )


def turns_left_out(
    arm: Calibration, sets: Sequence[Observations], new: Sequence[str] = ()
) -> list[str]:
    """Return in words, if any, the orientations left out."""
    return [
        f'orientations ({name}) are left out: the calibration was identified from positions and '
        'does not know how the target is turned'
        for name in sorted(_unknown(arm, sets, new))
    ]


def _unknown(arm: Calibration, sets: Sequence[Observations], new: Sequence[str]) -> set[str]:
    """Return the frames with measured orientations of which it knows positions alone.

    Those of targets; of a target seen from the flange, its own.
    """
    if arm.noise is None or arm.noise.orientation is not None:
        return set()
    ends = {each.base if each.inverse else each.tool for each in sets if each.oriented.any()}
    turns = FRAME_KINDS[3:]
    fitted = {name.owner for name in map(Parameter, arm.names) if name.kind in turns}
    fixed = {name for name, frame in arm.chain.all_frames.items() if frame and frame.fixed}
    return ends - fitted - fixed - {*new}
