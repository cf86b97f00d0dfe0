# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Public values on a screen."""

import re

import numpy as np
import pytest

import calib_ros
from calib_ros.apply.simulation import measure

CHAIN = calib_ros.load_chain('ur10e')
JOINTS = CHAIN.random_joints(200, np.random.default_rng(1))
SEEN = measure(CHAIN, JOINTS, np.random.default_rng(2), 1e-4, 1e-4)
PROBLEM = calib_ros.Problem(CHAIN, SEEN)
RESULT = calib_ros.identify(PROBLEM)
ARM = calib_ros.Calibration.of(RESULT)
VALUES = (CHAIN, SEEN, PROBLEM, RESULT, ARM, RESULT.posterior)


@pytest.mark.parametrize('value', VALUES, ids=lambda value: type(value).__name__)
def test_a_value_fits_on_a_screen(value):
    lines = repr(value).splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 99
    assert lines[0].startswith(type(value).__name__ + '(')
    assert len(re.findall('<tr>', value._repr_html_())) >= 5


def test_arrays_are_told_by_their_shape():
    assert 'joints=float64[200, 6]' in repr(SEEN)


def test_names_of_others_stay_text_in_html():
    robot = calib_ros.Chain('<b>arm</b>', 'standard', CHAIN.joints)
    assert '<b>' not in robot._repr_html_()
