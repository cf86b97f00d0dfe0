# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the tests of the node share: an arm, a shift in which it is measured, a cell."""

import pytest


@pytest.fixture(scope='session')
def truth():
    from ros_cell import true_arm

    return true_arm()


@pytest.fixture(scope='session')
def recording(truth):
    from ros_cell import shift

    return shift(truth)


@pytest.fixture
def cell(tmp_path):
    from ros_cell import Cell

    with Cell(chain='ur10e', data_dir=str(tmp_path)) as cell:
        yield cell
