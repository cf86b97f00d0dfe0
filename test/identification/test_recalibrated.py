# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""By which figures a recalibration is accepted, part by part."""

from types import SimpleNamespace

import numpy as np
import pytest
from fits import UR10E, arm, problem

from calib_ros import Calibration, identify, load_chain, recalibrate
from calib_ros.decision.changes import FALSE_ALARM, LOAD, OUTSIDE
from calib_ros.estimation.considered import travels
from calib_ros.identification.recalibrated import Recalibration
from calib_ros.settings import Settings

LIMIT = 1e3 * Settings.largest_error


def result(before=0.1, after=0.1, owners=(), **change):
    """Return a recalibration with errors [mm] before and after."""
    figures = tuple(SimpleNamespace(rms_mm=each) for each in (before, after))
    known = {'known_before': 1e-4, 'known_after': 1e-4, 'moved': 1e-4, 'fitted_mm': 0.1}
    return Recalibration(
        **{'unexplained': 0.5, 'calibration': SimpleNamespace(residual=1e-4)} | known | change,
        changed=tuple((SimpleNamespace(owner=each),) for each in owners),
        comparison=SimpleNamespace(figures=figures),
    )


@pytest.mark.parametrize(
    ('change', 'accepted'),
    [
        ({}, True),
        ({'after': 0.149}, True),
        ({'after': 0.151}, False),  # more than chance
        ({'before': 0.0, 'after': 0.0}, True),  # simulated without noise
        ({'before': 0.0, 'after': 1e-7}, True),
        ({'before': 0.4, 'after': 0.49}, True),
        ({'before': 0.4, 'after': 0.51}, False),  # five times what is usual
        ({'before': LIMIT, 'after': 1.01 * LIMIT, 'fitted_mm': LIMIT}, False),
        ({'unexplained': FALSE_ALARM}, False),
        ({'reused': 0.1}, False),
        ({'owners': ['elbow_joint'], 'before': 0.2}, True),
        ({'owners': ['elbow_joint']}, False),  # which changed nothing
        ({'owners': [LOAD], 'before': 0.2}, False),
        ({'owners': ['elbow_joint', OUTSIDE[0]], 'before': 0.2}, False),
        ({'owners': [OUTSIDE[1]], 'before': 0.2}, False),
        ({'known_after': 1.49e-4}, True),
        ({'known_after': 1.51e-4}, False),
        ({'known_after': 1.51e-4, 'moved': 1e-3}, True),
    ],
)
def test_new_poses_agree_by_themselves_and_tell_enough(change, accepted):
    assert result(**change).accepted == accepted


def test_a_frame_may_have_moved_far_where_errors_are_large():
    far = {'before': 1.01 * LIMIT, 'unexplained': FALSE_ALARM}
    assert result(**far).perhaps_moved
    assert result(1.01 * LIMIT, owners=['elbow_joint', 'base']).perhaps_moved
    for change in ({'before': 0.99 * LIMIT}, {'reused': 0.1}, {'unexplained': 0.5}):
        assert not result(**far | change).perhaps_moved


def test_an_arm_is_known_less_the_longer_it_was_not_measured():
    previous = Calibration.of(identify(problem(UR10E, 40, 0)))
    years = [0.0, 1.0, 10.0]
    known = [recalibrate(previous, problem(UR10E, 8, 1), each).known_before for each in years]
    assert (np.diff(known) > 0.0).all()


@pytest.mark.parametrize('chain', [UR10E, load_chain('ur10e_on_linear_axis')])
def test_a_warm_arm_at_the_same_base_is_told(chain):
    """A joint was named, or the mean of both temperatures was accepted."""
    true = arm(4, chain=chain)
    previous = Calibration.of(identify(problem(true, 60, 0, chain=chain)))
    names = [name for joint in chain.joints for name in joint.parameters if name.is_length]
    warm = {name: 2.5e-4 * true.value(name) for name in names}
    warm |= dict.fromkeys(travels(chain), 2.5e-4)
    found = recalibrate(
        previous,
        problem(true.with_effects(travels(chain)).with_offsets(warm), 30, 1, chain=chain),
        0.1,
    )
    assert 1e6 * found.outside.change[0] == pytest.approx(250.0, abs=60.0)
    assert found.refusal()[0].startswith('all lengths of the arm changed alike, by')
    assert recalibrate(previous, problem(true, 30, 1, chain=chain), 0.1).accepted


def test_a_document_is_in_millimetres():
    told = result(known_before=1e-4, known_after=2e-4, moved=3e-4).document()
    keys = ('known_before_mm', 'known_after_mm', 'moved_mm')
    assert [told[key] for key in keys] == pytest.approx([0.1, 0.2, 0.3])
