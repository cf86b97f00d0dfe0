# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from fits import UR10E

from calib_ros.apply.simulation import measure
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.visits import sided, stations


def test_sides_follow_from_the_order_of_all_stops_where_no_signs_are_stated():
    joints = np.array([[0.0, 1.0], [0.1, 1.0], [0.1, 1.0], [0.3, 0.5], [0.2, 0.5]])
    every = Observations.from_arrays(joints, np.zeros((5, 3)))
    wanted = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, -1.0], [-1.0, -1.0]])
    even, odd = every.select(np.array([4, 0, 2])), every.select(np.array([1, 3]))
    first, second = sided([even, odd])
    np.testing.assert_array_equal(first.approach, wanted[[4, 0, 2]])
    np.testing.assert_array_equal(second.approach, wanted[[1, 3]])
    stated = replace(odd, approach=-np.ones((2, 2)))
    assert sided([even, stated])[1] is stated


def test_sets_whose_stamps_disagree_where_the_arm_was_come_one_after_another():
    """Of two sets stamped by row 11 of 12 arms with play were accepted, 9 worse than nominal."""
    joints = np.array([[0.0], [0.1], [0.3], [0.2], [0.5], [0.4]])
    places = np.zeros((6, 3))
    every = Observations.from_arrays(joints, places)
    halves = [Observations.from_arrays(joints[k], places[k]) for k in np.split(np.arange(6), 2)]
    found = np.concatenate([each.approach for each in sided(halves)])
    np.testing.assert_array_equal(found, sided([every])[0].approach)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('scatter', [0.0, 4e-4])
def test_few_stations_are_told_from_poses(scatter, rng):
    q = UR10E.random_joints(48, rng)
    for first, wanted in ((2, 2), (4, 4), (16, 48), (1, 48)):
        still = np.repeat(q[:first, :3], 48 // first, axis=0)
        joints = np.concatenate([still, q[:, 3:]], axis=1)
        seen = measure(UR10E, joints + scatter * rng.normal(size=q.shape), rng)
        (numbers,) = stations([seen])
        assert len(set(numbers.tolist())) == wanted
    assert stations([seen.select(slice(1))])[0].tolist() == [0]
