# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from functools import partial

import pytest


@pytest.fixture(scope='session')
def cell():
    """Return a true arm, its identification and what was fitted."""
    from verified import cell

    return cell()


@pytest.fixture(scope='session')
def arm(cell):
    from calib_ros.identification.calibration import Calibration

    return Calibration.of(cell[1], fitted=[cell[2]])


@pytest.fixture
def hurried(monkeypatch):
    """Let inverse kinematics give up early: to try what is out of reach takes most of a search."""
    from calib_ros.kinematics import inverse

    monkeypatch.setattr(inverse, 'solve', partial(inverse.solve, iterations=15))
