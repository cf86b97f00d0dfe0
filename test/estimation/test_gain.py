# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from calib_ros.estimation.gain import gain_of


def test_added_columns_explain_what_the_known_ones_leave_in_their_own_directions():
    rng = np.random.default_rng(0)
    known, residual = np.zeros((30, 2)), rng.normal(size=30)
    known[:10] = rng.normal(size=(10, 2))
    added = np.zeros((30, 3))
    added[5:20, 0], added[20:, 1] = rng.normal(size=15), rng.normal(size=10)
    added[:, 2] = known[:, 1] - 2.0 * known[:, 0]  # none of its own
    every = np.column_stack([known, added, residual])
    gain, rank, left = gain_of(every.T @ every, 2)
    beside, rest = (
        np.sum((residual - x @ np.linalg.lstsq(x, residual, rcond=None)[0]) ** 2)
        for x in (known, every[:, :4])
    )
    assert (gain, rank, left) == (pytest.approx(beside - rest), 2, pytest.approx(beside))
