# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters say of themselves what they are."""

import copy
import pickle

import pytest

from calib_ros.kinematics.parameter import Parameter


@pytest.mark.parametrize(
    ('owner', 'kind', 'unit'),
    [
        ('elbow', 'a', 'm'),
        ('elbow', 'theta', 'rad'),
        ('base', 'rx', 'rad'),
        ('tool', 'y', 'm'),
        ('base_hall', 'delay', 's'),
        ('tool_camera', 'fx', 'px'),
        ('tool_camera', 'k3', '1'),
        ('elbow', 'sin_100', 'rad'),
        ('elbow', 'coupling_a', '1'),
        ('elbow', 'gravity_d', 'rad/m'),
        ('elbow', 'compliance', 'rad/(N m)'),
        ('elbow', 'backlash', 'rad'),
    ],
)
def test_a_parameter_is_its_name(owner: str, kind: str, unit: str) -> None:
    one = Parameter(owner, kind)
    assert one == f'{owner}.{kind}' == Parameter(f'{owner}.{kind}')
    assert (one.owner, one.kind, one.unit) == (owner, kind, unit)
    assert one.is_length == (unit == 'm')
    assert {one: 1}[f'{owner}.{kind}'] == 1
    copies = (copy.deepcopy(one), pickle.loads(pickle.dumps(one)))
    assert [type(each) for each in copies] == [Parameter, Parameter]
    assert copies == (one, one)


@pytest.mark.parametrize(
    ('name', 'factor', 'unit'),
    [
        ('elbow.a', 1e3, 'mm'),
        ('elbow.theta', 1e3, 'mrad'),
        ('elbow.coupling_a', 1e3, '‰'),
        ('camera.fx', 1.0, 'px'),
        ('camera.k1', 1.0, '1'),
    ],
)
def test_errors_are_shown_in_thousandths_except_of_lenses(name, factor, unit):
    assert Parameter(name).small_unit == (factor, unit)
