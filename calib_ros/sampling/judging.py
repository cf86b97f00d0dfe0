# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The samples by which a calibration in use is judged: those that it was not fitted to."""

from __future__ import annotations

from collections.abc import Sequence

from calib_ros.errors import InputError
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.observations import Observations
from calib_ros.identification.problem import Problem
from calib_ros.kinematics.chain import Chain
from calib_ros.sampling.problems import with_lenses
from calib_ros.sampling.sample import Frames, Sample, collect, named
from calib_ros.settings import Settings


def in_frames_of(
    calibration: Calibration,
    since: Sequence[Sample],
    usable: Sequence[Sample],
    settings: Settings,
) -> list[Observations]:
    """Return the samples taken since a calibration, those among all usable ones, in its frames.

    Raises
    ------
    InputError
        Without such samples, or when they are between frames that it does not have.

    """
    sigmas = (settings.sigma_position, settings.sigma_orientation)
    # the first device and target are those of a file that does not name any
    frames = Frames(calibration.owners) if calibration.owners else named(usable)
    sets = [each for part in collect(since, sigmas, frames) for each in part]
    if not sets:
        raise InputError('no samples have been taken since: measure some new poses first')
    known = calibration.chain.frame_names
    if not all(each.base in known and each.tool in known for each in sets):
        raise InputError(
            'the samples since were measured by a device or on a target that the '
            'calibration does not know'
        )
    return sets


def problem_since(
    calibration: Calibration, chain: Chain, sets: Sequence[Observations], settings: Settings
) -> Problem:
    """Return sets between the frames of a calibration as a problem of the nominal chain."""
    first, *more = sets
    cameras = {each.camera for each in sets if each.pixels is not None}
    known = {name: calibration.chain.frame(name).lens for name in cameras}
    chain = with_lenses(chain, {name: lens for name, lens in known.items() if lens})
    return Problem(chain, first, more=tuple(more), **settings.for_problem())


def refuse_other_joints(calibration: Calibration, chain: Chain) -> None:
    """Refuse a calibration of another robot.

    Raises
    ------
    InputError
        When it has other joints.

    """
    theirs = calibration.chain.joint_names
    if theirs != chain.joint_names:
        raise InputError(
            f'the calibration has the joints {", ".join(theirs)}, the robot has '
            f'{", ".join(chain.joint_names)}'
        )
