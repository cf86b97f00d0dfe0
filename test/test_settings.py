# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from calib_ros.errors import ConfigError
from calib_ros.settings import Settings


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('sigma_position', 0.0),
        ('sigma_position', -1e-4),
        ('sigma_position', np.nan),
        ('sigma_orientation', np.inf),
        ('max_gap', -0.1),
        ('max_gap', np.inf),
        ('joint_buffer', 1),
        ('pose_buffer', 0),
        ('folds', 1),
    ],
)
def test_a_setting_out_of_range_is_refused(name, value):
    with pytest.raises(ConfigError, match=f'{name} must be .*, not {value}'):
        Settings(**{name: value})


def test_settings_at_the_edge_are_taken():
    settings = Settings(max_gap=1e-6, joint_buffer=2, pose_buffer=1, folds=2, sigma_position=1e-9)
    assert (settings.joint_buffer, settings.pose_buffer, settings.folds) == (2, 1, 2)
