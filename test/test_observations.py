# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib_ros.errors import InputError
from calib_ros.observations import STILL, Observations, Pairing, configurations

MS = 1_000_000
MAX_GAP = 0.1
POSITION = (0.1, 0.2, 0.3)
BEFORE = 'poses: no joint sample before'
AFTER = 'poses: no joint sample after'
APART = 'poses: joint samples too far apart'
QUATERNION = (0.5, -0.5, 0.5, 0.5)


def pairing(revolute=(True, True), joint_capacity=1000, pose_capacity=1000):
    return Pairing(
        revolute, max_gap=MAX_GAP, joint_capacity=joint_capacity, pose_capacity=pose_capacity
    )


def feed(pairs, events):
    for kind, stamp_ns, values in events:
        if kind == 'joints':
            pairs.add_joints(stamp_ns, np.array(values))
        else:
            pairs.add_pose(stamp_ns, values, held_out=kind == 'held out')
    return pairs


def matched(events, **options):
    fitted, _, dropped = feed(pairing(**options), events).match()
    return fitted, dict(dropped)


def assert_equal(found, expected):
    for name in ('stamps_ns', 'joints', 'positions', 'rotations', 'oriented'):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
    assert (found.covariance is None) == (expected.covariance is None)
    if found.covariance is not None:
        np.testing.assert_array_equal(found.covariance, expected.covariance)


def test_joint_values_are_interpolated_at_the_stamp_of_the_pose():
    fitted, dropped = matched(
        [
            ('joints', 100 * MS, (0.0, 1.0)),
            ('joints', 140 * MS, (0.4, 3.0)),
            ('pose', 110 * MS, POSITION),
        ]
    )
    np.testing.assert_allclose(fitted.joints, [[0.1, 1.5]], atol=1e-15)
    np.testing.assert_array_equal(fitted.positions, [POSITION])
    assert fitted.stamps_ns.tolist() == [110 * MS]
    assert dropped == {}


def test_stamps_of_today_are_interpolated_to_the_nanosecond():
    start = 1_717_171_717_000_000_001  # beyond what a float64 holds exactly
    fitted, _ = matched(
        [
            ('joints', start, (0.0, 0.0)),
            ('joints', start + 10, (1.0, 2.0)),
            ('pose', start + 3, POSITION),
        ]
    )
    np.testing.assert_allclose(fitted.joints, [[0.3, 0.6]], atol=1e-15)


@pytest.mark.parametrize('hit', [100, 120, 140])
def test_a_joint_sample_at_the_very_stamp_is_taken_as_it_is(hit):
    samples = {100: (0.1, 0.7), 120: (0.3, -0.3), 140: (0.9, 0.1)}
    events = [('joints', ms * MS, values) for ms, values in samples.items()]
    fitted, dropped = matched([*events, ('pose', hit * MS, POSITION)])
    np.testing.assert_array_equal(fitted.joints, [samples[hit]])
    assert dropped == {}


def test_an_exact_hit_needs_no_neighbour():
    fitted, dropped = matched([('joints', 100 * MS, (0.1, 0.2)), ('pose', 100 * MS, POSITION)])
    np.testing.assert_array_equal(fitted.joints, [(0.1, 0.2)])
    assert dropped == {}


def test_an_exact_hit_beside_a_hole_is_no_gap():
    fitted, dropped = matched(
        [
            ('joints', 100 * MS, (0.1, 0.2)),
            ('joints', 900 * MS, (0.5, 0.6)),
            ('pose', 900 * MS, POSITION),
        ]
    )
    np.testing.assert_array_equal(fitted.joints, [(0.5, 0.6)])
    assert dropped == {}


@pytest.mark.parametrize(('gap_ns', 'pairs'), [(100 * MS, 1), (100 * MS + 1, 0)])
def test_a_bracket_wider_than_max_gap_makes_no_pair(gap_ns, pairs):
    fitted, dropped = matched(
        [
            ('joints', 200 * MS, (0.0, 0.0)),
            ('joints', 200 * MS + gap_ns, (0.0, 0.0)),
            ('pose', 201 * MS, POSITION),
        ]
    )
    assert len(fitted) == pairs
    assert dropped == ({} if pairs else {APART: 1})


def test_a_pose_outside_the_joint_samples_is_never_extrapolated():
    fitted, dropped = matched(
        [
            ('pose', 99 * MS, POSITION),
            ('joints', 100 * MS, (0.0, 0.0)),
            ('joints', 110 * MS, (0.0, 0.0)),
            ('pose', 111 * MS, POSITION),
            ('pose', 112 * MS, POSITION),
        ]
    )
    assert len(fitted) == 0
    assert fitted.joints.shape == (0, 2)
    assert dropped == {BEFORE: 1, AFTER: 2}


def test_without_joint_samples_every_pose_is_counted():
    fitted, dropped = matched([('pose', 99 * MS, POSITION), ('pose', 98 * MS, POSITION)])
    assert len(fitted) == 0
    assert dropped == {BEFORE: 2}


@pytest.mark.parametrize(('first', 'second'), [(3.1, -3.1), (-3.1, 3.1)])
def test_only_revolute_joints_wrap_at_half_a_turn(first, second):
    fitted, _ = matched(
        [
            ('joints', 100 * MS, (first, first)),
            ('joints', 104 * MS, (second, second)),
            ('pose', 101 * MS, POSITION),
        ],
        revolute=(True, False),
    )
    gap = 2.0 * (np.pi - 3.1)
    expected = first + np.sign(first) * 0.25 * gap
    assert np.exp(1j * fitted.joints[0, 0]) == pytest.approx(np.exp(1j * expected), abs=1e-12)
    assert fitted.joints[0, 1] == pytest.approx(0.5 * first, abs=1e-12)


def test_a_joint_that_counts_turns_is_left_alone():
    fitted, _ = matched(
        [
            ('joints', 100 * MS, (6.2, -9.0)),
            ('joints', 104 * MS, (6.4, -9.4)),
            ('pose', 102 * MS, POSITION),
        ]
    )
    np.testing.assert_allclose(fitted.joints, [[6.3, -9.2]], atol=1e-12)


def test_a_repeated_message_is_counted_once():
    joints = [('joints', 100 * MS, (0.1, 0.2)), ('joints', 110 * MS, (0.1, 0.2))]
    pose = ('pose', 105 * MS, POSITION)
    once, _ = matched([*joints, pose])
    twice, dropped = matched([*joints, *joints, pose, pose, pose])
    assert_equal(twice, once)
    assert dropped == {'joints: same stamp twice': 2, 'poses: same stamp twice': 2}


@pytest.mark.parametrize('order', [1, -1])
def test_of_two_samples_at_one_stamp_the_choice_is_not_by_arrival(order):
    joints = [('joints', 100 * MS, (0.1, 0.4)), ('joints', 100 * MS, (0.1, 0.3))]
    poses = [('pose', 100 * MS, (2.0, 0.0, 0.0)), ('pose', 100 * MS, (1.0, 9.0, 0.0))]
    fitted, dropped = matched([*joints[::order], *poses[::order]])
    np.testing.assert_array_equal(fitted.joints, [(0.1, 0.3)])
    np.testing.assert_array_equal(fitted.positions, [(1.0, 9.0, 0.0)])
    assert dropped == {'joints: same stamp twice': 1, 'poses: same stamp twice': 1}


def test_held_out_poses_never_come_among_those_to_fit():
    pairs = feed(
        pairing(),
        [
            ('joints', 100 * MS, (0.0, 0.0)),
            ('joints', 110 * MS, (0.1, 0.1)),
            ('pose', 102 * MS, (1.0, 0.0, 0.0)),
            ('held out', 104 * MS, (2.0, 0.0, 0.0)),
            ('pose', 106 * MS, (3.0, 0.0, 0.0)),
        ],
    )
    fitted, held_out, _ = pairs.match()
    assert fitted.positions[:, 0].tolist() == [1.0, 3.0]
    assert held_out.positions[:, 0].tolist() == [2.0]
    assert pairs.tally()[:2] == (2, 1)


def test_orientation_and_covariance_stay_with_their_pose():
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) + 0.1
    pairs = feed(pairing(), [('joints', 100 * MS, (0.0, 0.0)), ('joints', 110 * MS, (0.0, 0.0))])
    pairs.add_pose(103 * MS, POSITION)
    pairs.add_pose(102 * MS, POSITION, QUATERNION, covariance)
    pairs.add_pose(101 * MS, POSITION, QUATERNION)
    fitted, _, _ = pairs.match()
    assert fitted.oriented.tolist() == [True, True, False]
    np.testing.assert_allclose(
        fitted.rotations[1], [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-12
    )
    np.testing.assert_array_equal(fitted.rotations[2], np.eye(3))
    np.testing.assert_array_equal(fitted.covariance[1], covariance)
    assert np.isnan(fitted.covariance[[0, 2]]).all()


def test_without_any_covariance_there_is_none():
    fitted, _ = matched([('joints', 100 * MS, (0.1, 0.2)), ('pose', 100 * MS, POSITION)])
    assert fitted.covariance is None


def test_matching_twice_gives_the_same_and_later_samples_add_to_it():
    pairs = feed(pairing(), [('joints', 100 * MS, (0.0, 0.0)), ('pose', 104 * MS, POSITION)])
    assert pairs.match()[2] == {AFTER: 1}
    assert pairs.match()[2] == {AFTER: 1}
    pairs.add_joints(108 * MS, np.array([0.2, 0.2]))
    fitted, _, dropped = pairs.match()
    np.testing.assert_allclose(fitted.joints, [[0.1, 0.1]], atol=1e-15)
    assert dropped == {}


def test_a_match_is_a_snapshot():
    pairs = feed(pairing(), [('joints', 100 * MS, (0.1, 0.2)), ('pose', 100 * MS, POSITION)])
    fitted, _, _ = pairs.match()
    copies = fitted.joints.copy(), fitted.positions.copy()
    for k in range(20):
        pairs.add_joints(k * MS, np.array([9.0, 9.0]))
        pairs.add_pose(k * MS, (9.0, 9.0, 9.0))
    pairs.match()
    np.testing.assert_array_equal(fitted.joints, copies[0])
    np.testing.assert_array_equal(fitted.positions, copies[1])


# Few distinct stamps and values, so that equal stamps, hits and gaps are frequent.
stamps = st.integers(1, 12).map(lambda k: 50 * MS * k)
numbers = st.sampled_from([-3.1, -1.0, 0.0, 0.5, 3.1])
events = st.lists(
    st.one_of(
        st.tuples(st.just('joints'), stamps, st.tuples(numbers, numbers)),
        st.tuples(
            st.sampled_from(['pose', 'held out']),
            stamps | st.integers(1, 800 * MS),
            st.tuples(numbers, numbers, numbers),
        ),
    ),
    max_size=60,
)


@given(events, st.randoms(use_true_random=False))
def test_the_order_of_arrival_does_not_matter(recording, shuffle):
    shuffled = list(recording)
    shuffle.shuffle(shuffled)
    fitted, held_out, dropped = feed(pairing(), recording).match()
    other_fitted, other_held_out, other_dropped = feed(pairing(), shuffled).match()
    assert_equal(other_fitted, fitted)
    assert_equal(other_held_out, held_out)
    assert other_dropped == dropped


@given(events)
def test_pairs_are_those_of_a_search_through_all_samples(recording):
    unique = {}
    for kind, stamp_ns, values in recording:
        unique.setdefault((kind == 'joints', stamp_ns), []).append((kind, values))
    joints = {stamp: min(v for _, v in found) for (j, stamp), found in unique.items() if j}
    poses = {stamp for j, stamp in unique if not j}
    expected = {}
    for stamp in poses:
        before = [known for known in joints if known <= stamp]
        after = [known for known in joints if known >= stamp]
        if before and after and min(after) - max(before) <= MAX_GAP * 1e9:
            first, last = max(before), min(after)
            share = (stamp - first) / max(last - first, 1)
            turn = np.exp(1j * np.array(joints[first]))
            step = np.angle(np.exp(1j * (np.array(joints[last]) - joints[first])))
            expected[stamp] = turn * np.exp(1j * share * step)
    fitted, held_out, dropped = feed(pairing(), recording).match()
    found = dict(zip(fitted.stamps_ns.tolist(), fitted.joints, strict=True))
    found |= dict(zip(held_out.stamps_ns.tolist(), held_out.joints, strict=True))
    assert found.keys() == expected.keys()
    for stamp, values in found.items():
        np.testing.assert_allclose(np.exp(1j * values), expected[stamp], atol=1e-9)
    # Every message is a sample, a pair or counted as dropped.
    assert len(recording) == len(joints) + len(found) + sum(dropped.values())


@given(events, st.integers(2, 9))
def test_a_small_joint_buffer_keeps_the_pairs_of_an_orderly_recording(recording, capacity):
    # As it happens live: in the order of the stamps, each stamp once per stream.
    unique = {(kind == 'joints', stamp): (kind, stamp, v) for kind, stamp, v in recording}
    orderly = sorted(unique.values(), key=lambda event: (event[1], event[0]))
    whole = feed(pairing(), orderly)
    small = feed(pairing(joint_capacity=capacity), orderly)
    for found, expected in zip(small.match()[:2], whole.match()[:2], strict=True):
        assert_equal(found, expected)
    assert small.match()[2] == whole.match()[2]
    assert small.tally() == whole.tally()


def test_what_is_older_than_the_joint_buffer_is_counted():
    pairs = pairing(joint_capacity=4)
    for k in range(1, 12):
        pairs.add_joints(k * 10 * MS, np.array([k, 0.0]))
        pairs.add_pose(k * 10 * MS, (float(k), 0.0, 0.0))
    pairs.add_joints(5 * MS, np.array([0.5, 0.0]))
    pairs.add_pose(25 * MS, POSITION)
    fitted, _, dropped = pairs.match()
    assert fitted.joints[:, 0].tolist() == list(range(1, 12))
    assert fitted.positions[:, 0].tolist() == list(range(1, 12))
    assert dropped == {
        'joints: older than the joint buffer': 1,
        'poses: older than the joint buffer': 1,
    }


def test_a_joint_buffer_full_of_one_stamp_still_takes_samples():
    pairs = pairing(joint_capacity=2)
    for _ in range(5):
        pairs.add_joints(100 * MS, np.array([0.1, 0.1]))
    pairs.add_joints(110 * MS, np.array([0.3, 0.3]))
    pairs.add_pose(105 * MS, POSITION)
    fitted, _, dropped = pairs.match()
    np.testing.assert_allclose(fitted.joints, [[0.2, 0.2]], atol=1e-15)
    assert dropped == {'joints: same stamp twice': 4}


def test_a_full_pose_buffer_drops_new_poses_and_counts_them():
    pairs = pairing(pose_capacity=3)
    pairs.add_joints(100 * MS, np.zeros(2))
    pairs.add_joints(110 * MS, np.zeros(2))
    for k in range(5):
        pairs.add_pose((101 + k) * MS, (float(k), 0.0, 0.0))
    fitted, _, dropped = pairs.match()
    assert fitted.positions[:, 0].tolist() == [0.0, 1.0, 2.0]
    assert dropped == {'poses: pose buffer full': 2}


def test_buffers_grow_beyond_their_first_block():
    count = 3000
    pairs = pairing(joint_capacity=count, pose_capacity=count)
    order = list(range(count))
    random.Random(1).shuffle(order)
    for k in order:
        pairs.add_joints((k + 1) * MS, np.array([1e-3 * k, 0.0]))
        pairs.add_pose((k + 1) * MS, (float(k), 0.0, 0.0))
    fitted, _, dropped = pairs.match()
    np.testing.assert_array_equal(fitted.positions[:, 0], np.arange(count))
    np.testing.assert_allclose(fitted.joints[:, 0], 1e-3 * np.arange(count), atol=1e-12)
    assert dropped == {}


def test_standing_still_is_one_configuration(rng):
    places = np.repeat([[0.0, 0.0], [0.0, 0.5], [0.3, 0.5], [0.0, 0.0]], [3, 1, 4, 2], axis=0)
    jitter = rng.uniform(-0.4 * STILL, 0.4 * STILL, places.shape)
    expected = [0, 0, 0, 1, 2, 2, 2, 2, 0, 0]  # the first is visited again
    assert configurations(places + jitter).tolist() == expected
    observations = Observations.from_arrays(places + jitter, np.zeros((10, 3)))
    assert observations.configurations.tolist() == expected


@pytest.mark.parametrize(('step', 'count'), [((0.9, 0.9), 1), ((1.1, 0.0), 2), ((0.0, -1.1), 2)])
def test_the_joint_that_moved_most_makes_a_configuration(step, count):
    assert len(set(configurations(np.array([(0.0, 0.0), step]) * STILL).tolist())) == count


def test_configurations_of_nothing():
    assert configurations(np.zeros((0, 6))).tolist() == []
    assert configurations(np.zeros((1, 6))).tolist() == [0]


def test_tally_counts_configurations_of_the_pairs_to_fit():
    pairs = pairing()
    for k, place in enumerate([0.0, 0.0, 0.5, 1.0, 1.0]):
        pairs.add_joints((k + 1) * MS, np.array([place, 0.0]))
        pairs.add_pose((k + 1) * MS, POSITION, held_out=place == 0.5)
    assert pairs.tally()[:3] == (4, 1, 2)


def test_arrays_that_do_not_fit_together_are_refused():
    with pytest.raises(InputError, match=r'positions of 3 observations .*\(3, 3\), not \(2, 3\)'):
        Observations.from_arrays(np.zeros((3, 6)), np.zeros((2, 3)))
    with pytest.raises(InputError, match='rotations of 3 observations'):
        Observations.from_arrays(np.zeros((3, 6)), np.zeros((3, 3)), np.zeros((3, 4)))


@pytest.mark.parametrize('bad', [np.nan, np.inf])
@pytest.mark.parametrize('name', ['joints', 'positions'])
def test_numbers_that_are_none_are_refused(name, bad):
    arrays = {'joints': np.zeros((3, 6)), 'positions': np.zeros((3, 3))}
    arrays[name][1, 2] = bad
    with pytest.raises(InputError, match=f'{name} .* NaN or infinite'):
        Observations.from_arrays(**arrays)


def test_select_keeps_the_rows_together(rng):
    rotations = np.tile(np.eye(3), (5, 1, 1))
    whole = Observations.from_arrays(rng.normal(size=(5, 2)), rng.normal(size=(5, 3)), rotations)
    part = whole.select(np.array([False, True, False, True, False]))
    np.testing.assert_array_equal(part.joints, whole.joints[[1, 3]])
    np.testing.assert_array_equal(part.positions, whole.positions[[1, 3]])
    assert part.stamps_ns.tolist() == [2_000_000_000, 4_000_000_000]


def test_a_joint_that_stands_at_half_a_turn_is_one_configuration():
    joints = np.array([[3.14159], [-3.14159], [3.14159], [3.0]])
    assert configurations(joints).tolist() == [0, 0, 0, 1]
