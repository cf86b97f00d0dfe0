# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joint values beyond limits, or in degrees or millimetres, are refused with their place."""

import numpy as np
import pytest

from calib_ros.errors import InputError
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.chain_file import TWO_TURNS
from calib_ros.kinematics.limits import check_limits, check_turns

STAND = Chain(
    'stand',
    'standard',
    (
        Joint('turn', a=0.5, lower=-2.0, upper=2.5),
        Joint('lift', type='prismatic'),
        Joint('wrist', lower=-1.0),
    ),
)


def where(row, joint):
    return f'row {row}, joint {joint}: '


@pytest.mark.parametrize('check', [check_limits, check_turns])
def test_values_at_their_limits_are_taken(check):
    ends = np.array([[2.5009, TWO_TURNS, TWO_TURNS], [-2.0009, -TWO_TURNS, -1.0009]])
    check(ends, STAND, where)


@pytest.mark.parametrize(
    ('row', 'said'),
    [
        (
            [2.6, 0.0, 0.0],
            'row 1, joint 0: 2.6 is beyond the limits of turn, -2 to 2.5 (rad or m, ',
        ),
        ([-2.1, 0.0, 0.0], 'row 1, joint 0: -2.1 is beyond the limits of turn, -2 to 2.5'),
        ([0.0, 0.0, -1.1], 'row 1, joint 2: -1.1 is beyond the limits of wrist, -1 to inf'),
        ([-6.0, 0.0, 0.0], 'not degrees); a full turn away, 0.283185 is within them: give that'),
    ],
)
def test_a_value_beyond_its_limits_is_refused(row, said):
    values = np.array([[0.0, 0.0, 0.0], row])
    with pytest.raises(InputError) as caught:
        check_limits(values, STAND, where)
    assert said in str(caught.value)
    with pytest.raises(InputError, match=r'rad or m of 3\)'):
        check_limits(values, STAND, where, lambda joint: f' of {len(STAND.joints)}')
    check_turns(values, STAND, where)


@pytest.mark.parametrize('check', [check_limits, check_turns])
def test_degrees_and_millimetres_are_refused_also_without_limits(check):
    with pytest.raises(InputError) as caught:
        check(np.array([[0.0, 0.0, 90.0]]), STAND, where)
    assert str(caught.value) == (
        'row 0, joint 2: 90 is more than two turns of wrist, which has no limits: joint values '
        'must be in radians; if they are, give the joint limits (lower, upper) in the chain file'
    )
    with pytest.raises(InputError) as caught:
        check(np.array([[0.0, -300.0, 0.0]]), STAND, where)
    assert 'row 0, joint 1: -300 is more than 12.6 m for lift, which has' in str(caught.value)
    assert 'must be in metres' in str(caught.value)
