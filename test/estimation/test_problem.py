# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What cannot be fitted is refused before; rows and unmodelled errors by name."""

from dataclasses import replace

import numpy as np
import pytest
from fits import UR10E

from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.configurations import SCATTER
from calib_ros.estimation.considered import considered
from calib_ros.estimation.joint_errors import Unmodelled
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.system import row_samples, stacked

SEEN = Observations.from_arrays(UR10E.random_joints(4, np.random.default_rng(0)), np.ones((4, 3)))


def test_measurements_of_an_arm_with_other_joints_are_refused():
    five = replace(SEEN, joints=SEEN.joints[:, :5])
    with pytest.raises(InputError, match=r'have \(5,\) joint values, chain "ur10e" has 6 joints'):
        Problem(UR10E, five)


def test_without_further_frames_or_effects_the_model_is_the_chain():
    """So what the chain found out about itself serves every problem."""
    assert Problem(UR10E, SEEN).model is UR10E
    further = Problem(UR10E, SEEN, more=[replace(SEEN, tool='tool_2')]).model
    assert further.frame_names == (*UR10E.frame_names, 'tool_2')


def test_a_joint_that_cannot_move_must_not_have_moved():
    held = replace(UR10E.joints[2], lower=0.5, upper=0.5)
    arm = replace(UR10E, joints=(*UR10E.joints[:2], held, *UR10E.joints[3:]))
    still = SEEN.joints.copy()
    still[:, 2] = 0.5 + 0.9 * SCATTER * np.array([1.0, -1.0, 0.0, 0.0])
    Problem(arm, replace(SEEN, joints=still))
    still[1, 2] = 0.5 - 1.1 * SCATTER
    with pytest.raises(InputError, match=r'elbow_joint was at .* both its limits are 0.5 in the'):
        Problem(arm, replace(SEEN, joints=still))
    Problem(arm.with_effect_values({'elbow_joint.coupling_shoulder_lift_joint': 1.0}), SEEN)


@pytest.mark.parametrize(
    ('effects', 'said'),
    [
        (('gear',), r'nothing to fit in "gear" \(gear needs the gear_ratio'),
        (('compliance',), 'compliance needs the masses of the links'),
        (('backlash',), 'backlash needs the signs of the last moves'),
    ],
)
def test_effects_that_cannot_be_told_are_refused(effects, said):
    with pytest.raises(ConfigError, match=said):
        Problem(UR10E, SEEN, effects=effects)


def test_backlash_is_considered_of_joints_with_known_moves_or_from_both_sides():
    signs = np.zeros((4, 6))
    signs[1, 2], signs[3, 4] = 1.0, -1.0
    rising = replace(SEEN, joints=np.arange(4.0)[:, np.newaxis] * np.ones(6))
    names = UR10E.parameter_names
    without = considered(UR10E, names, sets=[rising])
    found = considered(UR10E, names, sets=[replace(rising, approach=signs)])
    assert set(found) - set(without) == {'elbow_joint.backlash', 'wrist_2_joint.backlash'}
    back = rising.joints.copy()
    back[3, 0] = 0.0
    found = considered(UR10E, names, sets=[replace(rising, joints=back)])
    assert set(found) - set(without) == {'shoulder_pan_joint.backlash'}


def test_rows_know_their_samples():
    rows = [np.arange(12.0).reshape(2, 3, 2), 100.0 + np.arange(2.0).reshape(2, 1, 1)]
    samples = row_samples(rows)
    assert samples.tolist() == [0, 1, 0, 1, 0, 1, 2]
    np.testing.assert_array_equal(stacked(rows)[samples == 1], rows[0][:, :, 1].T)
    np.testing.assert_array_equal(stacked(rows)[samples == 2], rows[1][:, :, 0].T)


def test_unmodelled_waves_of_other_parameters():
    some = Unmodelled(waves=2.0, names=('a', 'b'), followed=np.array([[1.0, 0.0], [3.0, 4.0]]))
    found = some.for_names(['c', 'b'])
    assert found.names == ('c', 'b')
    np.testing.assert_array_equal(found.followed, [[0.0, 0.0], [3.0, 4.0]])
    np.testing.assert_allclose(found.square, [[0.0, 0.0], [0.0, 100.0]])
    assert some.for_names([]).followed.shape == (0, 2)
    assert found.sizes == {'turns': 0.0, 'tilts': 0.0, 'waves': 2.0}
