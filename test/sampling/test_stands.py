# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from sessions import UR5E
from streams import hear, stamps, stops

from calib_ros import CalibrationSession
from calib_ros.estimation.configurations import SCATTER
from calib_ros.sampling.means import SPIKE
from calib_ros.sampling.rests import Rests
from calib_ros.sampling.slices import NO_ACCIDENT
from calib_ros.sampling.stops import SAMPLED, SampledStops, Schedule, seen_stops
from calib_ros.sampling.track import Track
from calib_ros.settings import Settings

S = 10**9
MOVING = 'the arm was moving'
NEVER = [(2, MOVING, 0), (5, '', 2), (8, MOVING, 5)]  # a stop of two parts, none measured


@pytest.mark.parametrize(
    ('stand', 'until', 'newest', 'done', 'sampled', 'seen', 'expected'),
    [
        ((2, 9), 10, 12, 0, 0, 3, [(2, MOVING, 0), (5, '', 2), (9, SAMPLED, 0), (10, MOVING, 0)]),
        ((2, 9), 8, 12, 0, 0, 6, [(2, MOVING, 0), (5, '', 2), (8, '', 5)]),  # measured later
        ((2, 9), 10, 12, 0, 0, 1, [*NEVER, (9, MOVING, 8), (10, MOVING, 0)]),
        ((2, 5), 5, 5, 0, 0, 3, [(2, MOVING, 0)]),  # one that goes on is waited for
        ((2, 6), 4, 6, 0, 0, 3, [(2, MOVING, 0)]),
        ((3, 8), 10, 12, 5, 5, 6, [(8, SAMPLED, 0), (10, MOVING, 0)]),  # there is a sample of it
        ((3, 8), 10, 12, 5, 0, 6, [(8, '', 5), (10, MOVING, 0)]),  # its begin was dealt with
    ],
)
def test_a_stand_becomes_a_stop_of_the_longest_time_at_most(
    stand, until, newest, done, sampled, seen, expected
):
    plan = Schedule(done * S, sampled * S, 0)
    stands, settings = S * np.array([stand]), Settings(shortest_stop=1.0, longest_stop=3.0)
    plan.of_stands(
        stands, until * S, newest * S, settings, lambda begin, end: begin <= seen * S <= end
    )
    found = zip(plan.ends, plan.why, plan.begins, strict=True)
    assert [(end // S, why, begin // S) for end, why, begin in found] == expected


def test_a_stop_seen_before_is_known_where_and_when_it_was():
    known = SampledStops(np.array([True, False]), 9)
    where, near = np.array([3.0, 0.2]), 1e-3
    assert not known.seen_before(10, 20, where, near)
    assert known.seen_before(20, 30, where, near)  # they touch
    assert known.seen_before(5, 10, where, near)
    assert known.seen_before(12, 14, where - [2.0 * np.pi, 0.0], near)
    assert known.seen_before(12, 14, where + 0.9 * near, near)
    assert not known.seen_before(12, 14, where + 1.1 * near, near)
    assert not known.seen_before(12, 14, where - [0.0, 2.0 * np.pi], near)
    assert not known.seen_before(1, 9, where, near)
    assert not known.seen_before(21, 22, where, near)


@pytest.mark.parametrize(('stamp', 'met'), [(9, True), (10, False), (20, False), (21, True)])
def test_only_the_stop_that_stands_at_a_stamp_is_forgotten(stamp, met):
    known = SampledStops(np.array([True]), 9)
    where = np.zeros(1)
    known.seen_before(10, 20, where, 1e-3)
    known.forget(stamp)
    assert known.seen_before(10, 20, where, 1e-3) == met


def test_rests_unseen_count_once_each_up_to_a_capacity():
    rests = Rests(3)
    assert rests.needed(0.0) is None
    rests.note(1.0)
    assert rests.needed(0.0) == SPIKE
    for noise in (9.0, None, 2.0, None, 4.0, None, 8.0):  # 9 within the first, 8 too many
        rests.note(noise)
    assert rests.needed(0.0) == SPIKE * 2.0
    assert rests.needed(SPIKE * 2.0) is None
    rests.sampled = 2
    assert rests.needed(0.0) == SPIKE * 2.0
    rests.sampled = 3
    assert rests.needed(0.0) is None


def test_values_that_jump_for_long_are_no_rest():
    rests = Rests(99)
    rests.sampled = 9
    for noise in [SCATTER] * NO_ACCIDENT:
        assert rests.needed(0.0) is None
        rests.note(noise)
    assert rests.needed(0.0) == SPIKE * SCATTER
    rests.note(None)
    assert rests.needed(0.0) is None


def test_a_stop_shows_from_its_shortest_time_on_until_it_is_dealt_with():
    stands = np.array([[10, 20]])
    rounds = [13, 14, 19, 23, 24, 25]
    found = seen_stops(stands, rounds, 9, 4, 4)
    assert found == [False, True, True, True, True, False]
    assert seen_stops(stands, [15], 20, 4, 4) == [False]
    assert seen_stops(stands, [15], 19, 4, 4) == [True]
    assert seen_stops(np.array([[0, 3]]), [9], 0, 4, 4) == [False]  # too short, now as then


@pytest.mark.parametrize('mode', ['dwell', 'continuous'])
@pytest.mark.parametrize(
    ('late', 'off', 'told'), [(3e-3, 3e-4, 1), (3e-3, 0.0, 0), (5e-3, 1e-3, 1)]
)
def test_two_publishers_of_the_same_joints_by_turns_are_told(mode, late, off, told):
    """Other values, within `still`, were averaged without a word; 1 mrad was noise to allow."""
    motion = stops(0.5 * UR5E.random_joints(25, np.random.default_rng(2)))
    made, times = CalibrationSession(UR5E, Settings(mode=mode)), np.arange(0.0, 49.5, 0.01)
    both = np.ravel(np.column_stack([times, times + late]))
    joints = motion(both)
    joints[1::2] += off
    poses = UR5E.forward(motion(times))
    hear(
        made,
        (both, stamps(both), joints),
        (times, stamps(times), *(poses[:, :3, k] for k in (3, np.s_[:3]))),
    )
    made.finish()
    assert sum('two robots publish the same joint names' in each for each in made.warnings) == told


def test_noise_at_rest_hardly_ever_jumps_by_turns():
    rng, found = np.random.default_rng(0), 0
    for _ in range(500):
        track = Track([True] * 6, 0.2, 100)
        track.extend(tuple(range(6)), np.arange(25) * S // 100, 1e-4 * rng.normal(size=(25, 6)))
        found += track.swings_at_rest(S, [24 * S // 100]) != [0.0]
    assert found < 5
