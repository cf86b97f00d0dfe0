# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import os

# Read by rclpy and its messages when they are imported.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
# Read by numpy: small matrices only, a second thread costs more than it gives.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np
import pytest
from hypothesis import settings

settings.register_profile(
    'calib_ros', deadline=None, derandomize=True, max_examples=30, database=None
)
settings.load_profile('calib_ros')


@pytest.fixture
def rng():
    return np.random.default_rng(20240607)
