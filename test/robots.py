# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measured robots; their data lie outside the repository, where CALIB_ROS_DATA says."""

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get('CALIB_ROS_DATA') or Path(__file__).parents[2] / 'shared' / 'data')
needs_data = pytest.mark.skipif(
    not (DATA.is_dir() or os.environ.get('CALIB_ROS_DATA')),
    reason=f'no measured robots at {DATA}; set CALIB_ROS_DATA',
)
