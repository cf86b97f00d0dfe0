# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A part of the positions in mm, and calibrations simulated without noise."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E

from calib_ros import Calibration, Problem, identify, recalibrate
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.errors import InputError
from calib_ros.kinematics import se3

TRUE = faulty(UR10E, Cell(), np.random.default_rng(4))


def seen(count, noise=NOISE, in_mm=0, true=TRUE, **sigmas):
    rng = np.random.default_rng(count)
    measured = measure(true, UR10E.random_joints(count, rng), rng, *noise)
    positions = measured.positions.copy()
    positions[:in_mm] *= 1e3
    return Problem(UR10E, replace(measured, positions=positions), **sigmas)


@pytest.fixture(scope='module')
def earlier():
    """Return a calibration, and one simulated without noise."""
    first = seen(60, **SIGMAS), seen(60, (0.0, 0.0))
    return [Calibration.of(identify(each)) for each in first]


@pytest.mark.parametrize('without_noise', [False, True])
def test_a_part_in_mm_is_named_between_new_frames_too(earlier, without_noise):
    there = replace(TRUE, base=random_frame(np.random.default_rng(1), 2.0))
    few = seen(15, in_mm=7, true=there)
    with pytest.raises(InputError, match='in lines 1 to 7 alone, the positions are in mm'):
        recalibrate(earlier[without_noise], few, 0.1, new=('base',))


@pytest.mark.parametrize(
    ('without_noise', 'new'), [(False, ('base', 'tool')), (True, ()), (True, ('base', 'tool'))]
)
def test_two_positions_in_mm_update_nothing(earlier, without_noise, new, unsearched, none_odd):
    """Between new frames the arm was moved by kilometres, or a traceback came."""
    few = seen(10, in_mm=2)
    with suppress(InputError):  # check their units
        assert not recalibrate(earlier[without_noise], few, 0.1, new=new).accepted


def test_a_calibration_simulated_without_noise_is_updated(earlier):
    assert recalibrate(earlier[1], seen(8, (0.0, 0.0)), 0.1).accepted


def test_a_device_that_moved_far_and_a_slipped_zero_are_named(earlier):
    """No change of a few parameters explained them: from so far off the model is not linear."""
    now, rng = TRUE.with_offsets({'shoulder_lift_joint.theta': 1e-2}), np.random.default_rng(3)
    now = replace(now, base=random_frame(rng, 2.0))
    found = recalibrate(earlier[0], seen(16, true=now, **SIGMAS), 0.1)
    assert found.accepted
    assert [reasons[0].owner for reasons in found.changed] == ['base', 'shoulder_lift_joint']
    words = found.calibration.record['changed']
    assert ['shoulder_lift_joint.theta' in each for each in words] == [False, True]


def test_moved_frames_and_a_slipped_zero_are_placed_as_well_as_the_arm_is_known(earlier):
    """The frames were accepted before they converged, 7 mm off."""
    now, rng = TRUE.with_offsets({'elbow_joint.theta': 2e-3}), np.random.default_rng(3)
    for end, size in (('base', 0.3), ('tool', 0.05)):
        frame, matrix = now.frame(end), np.eye(4)
        matrix[:3, :3] = se3.exp_rotation(0.3 * rng.normal(size=3))
        matrix[:3, 3] = size * rng.normal(size=3)
        now = now.with_frame(end, replace(frame, matrix=frame.matrix @ matrix))
    found = recalibrate(earlier[0], seen(16, true=now, **SIGMAS), 0.1)
    assert found.accepted
    assert [reasons[0].owner for reasons in found.changed] == ['base', 'tool', 'elbow_joint']
    joints = now.random_joints(200, rng)
    left = found.calibration.chain.forward(joints) - now.forward(joints)
    assert np.sqrt((left[:, :3, 3] ** 2).sum(axis=1).mean()) < 1.5e-4
