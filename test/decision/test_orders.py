# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joint values in the order of a controller, which names external axes behind those of the arm."""

from dataclasses import replace

import numpy as np
import pytest

from calib_ros import load_chain
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.decision.mistakes import explained
from calib_ros.estimation.problem import Problem


@pytest.mark.parametrize('oriented', [True, False])
def test_external_axes_that_come_last_are_named(oriented):
    arm, rng = load_chain('ur10e_on_linear_axis'), np.random.default_rng(1)
    q = arm.random_joints(40, rng)
    seen = measure(faulty(arm, Cell(), rng), q, rng, 5e-5, 2e-4, oriented)
    found = explained(Problem(arm, replace(seen, joints=np.roll(q, -1, axis=1)))).suspects[0]
    assert f'in another order, {arm.joint_names[0]} last' in found.what
    assert found.remedy == '--columns q1=q7,q2=q1,q3=q2,q4=q3,q5=q4,q6=q5,q7=q6'
