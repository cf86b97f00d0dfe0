# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import pytest


@pytest.fixture(scope='session')
def earlier():
    """Return an arm, and its calibration as it is read from a file."""
    from fits import UR10E, arm, problem

    from calib_ros import Calibration, identify
    from calib_ros.identification.calibration import parse_calibration

    true = arm(4)
    text = Calibration.of(identify(problem(true, 60, 0))).dump()
    return true, parse_calibration(text, 'earlier.yaml', UR10E)
