# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which of two triples of angles was meant. `test_mistakes.py` has the mistakes themselves."""

import numpy as np

from calib_ros.decision.rotation_conventions import _beyond


def test_angles_are_beyond_the_usual_range_by_the_one_that_is_furthest():
    angles = np.array([[3.0, -1.5, -3.0], [3.2, 0.0, -3.3], [3.2, -2.0, 0.0]])
    np.testing.assert_allclose(_beyond(angles, 'ZXY'), [0.0, 3.3 - np.pi, 2.0 - 0.5 * np.pi])
    vectors = np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 4.0]])
    np.testing.assert_allclose(_beyond(vectors, ''), [0.0, 5.0 - np.pi])
