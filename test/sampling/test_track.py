# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import random

import numpy as np
import pytest
from hypothesis import given, strategies as st
from tracked import BOTH, MAX_GAP, MS, add, at, came, causes, fill, filled, track

from calib_ros.estimation.configurations import STILL
from calib_ros.sampling.track import CAUSES

_, APART, BEFORE, AFTER = CAUSES


def words(made, *ms):
    return [CAUSES[cause] for cause in causes(made, *ms)]


# Interpolation


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_a_cubic_motion_is_met_exactly(seed, even):
    rng = np.random.default_rng(seed)
    times = np.arange(40) * 0.01
    if not even:
        times = times + rng.uniform(-0.002, 0.002, len(times))
    stamps = np.round(times * 1e9).astype(np.int64) + 10**9
    cubic = [np.polynomial.Polynomial(rng.normal(size=4)) for _ in BOTH]

    def values(stamps_ns, order=0):
        seconds = (stamps_ns - 10**9) * 1e-9
        return np.stack([(each.deriv(order) if order else each)(seconds) for each in cubic], 1)

    made = track(revolute=(False, True))
    for stamp_ns, row in zip(stamps.tolist(), values(stamps), strict=True):
        add(made, BOTH, stamp_ns, row)
    made.sort()
    wanted = np.sort(rng.integers(stamps[1], stamps[-2], 200))
    motion = made.at(wanted)
    assert not made.causes(wanted).any()
    np.testing.assert_allclose(motion.joints, values(wanted), atol=1e-12)
    np.testing.assert_allclose(motion.velocity, values(wanted, 1), atol=1e-9)
    np.testing.assert_allclose(motion.acceleration, values(wanted, 2), atol=1e-6)


def test_a_cubic_does_not_reach_over_a_pause_in_the_samples():
    """By the speed before it the joint would pass beyond both ends, and come back."""
    made = filled([(0, (-2, 0)), (2, (-1, 0)), (4, (0, 0)), (90, (1, 1)), (92, (1, 1))])
    motion = at(made, *range(4, 91))
    straight = np.arange(87)[:, np.newaxis] / 86.0
    np.testing.assert_allclose(motion.joints, np.repeat(straight, 2, axis=1), atol=1e-12)


def test_within_a_stop_nothing_of_the_moves_beside_it_shows():
    """The cubic through a sample of the move would be off by a sixteenth of it."""
    made = filled([(0, (0.5, 0)), (50, (0, 0)), (100, (1e-4, 0)), (150, (0.5, 0))])
    assert at(made, 75).joints[0, 0] < -0.05
    stood = at(made, 50, 75, 100, standing=True)
    np.testing.assert_allclose(stood.joints, [[0, 0], [5e-5, 0], [1e-4, 0]], atol=1e-15)
    assert words(made, 50, 75, 100) == ['', '', '']


def test_stamps_of_today_are_interpolated_to_the_nanosecond():
    start = 1_717_171_717_000_000_001  # beyond what a float64 holds exactly
    made = track()
    for k in (0, 10):
        add(made, BOTH, start + k, np.array([0.1 * k, 0.2 * k]))
    made.sort()
    np.testing.assert_allclose(made.at(np.array([start + 3])).joints, [[0.3, 0.6]], atol=1e-15)


@pytest.mark.parametrize(('gap_ns', 'why'), [(100 * MS, ''), (100 * MS + 1, APART)])
def test_samples_further_apart_than_max_gap_are_not_joined(gap_ns, why):
    made = track()
    for stamp_ns in (200 * MS, 200 * MS + gap_ns):
        add(made, BOTH, stamp_ns, np.zeros(2))
    assert words(made, 201) == [why]


def test_nothing_is_extrapolated():
    made = filled([(100, (0.0, 0.0)), (110, (0.0, 0.0))])
    assert words(made, 99, 100, 105, 110, 111) == [BEFORE, '', '', '', AFTER]
    assert words(track(), 99) == [AFTER]


@pytest.mark.parametrize(('first', 'second'), [(3.1, -3.1), (-3.1, 3.1)])
def test_only_revolute_joints_wrap_at_half_a_turn(first, second):
    made = filled([(100, (first, first)), (104, (second, second))], revolute=(True, False))
    motion = at(made, 101)
    gap = 2.0 * (np.pi - 3.1)
    assert motion.joints[0, 0] == pytest.approx(first + np.sign(first) * 0.25 * gap, abs=1e-12)
    assert motion.joints[0, 1] == pytest.approx(0.5 * first, abs=1e-12)
    assert motion.velocity[0, 0] == pytest.approx(np.sign(first) * gap / 4e-3)


def test_a_joint_that_counts_turns_is_left_alone():
    motion = at(filled([(100, (6.2, -9.0)), (104, (6.4, -9.4))]), 102)
    np.testing.assert_allclose(motion.joints, [[6.3, -9.2]], atol=1e-12)


# Order of arrival
# Few distinct stamps and values, so that equal stamps, hits and gaps are frequent.
ticks = st.integers(1, 12).map(lambda k: 50 * k)
numbers = st.sampled_from([-3.1, -1.0, 0.0, 0.5, 3.1])
samples = st.lists(
    st.one_of(
        st.tuples(st.just((0, 1)), ticks, st.tuples(numbers, numbers)),
        st.tuples(st.just((0,)), ticks, st.tuples(numbers)),
        st.tuples(st.just((1,)), ticks, st.tuples(numbers)),
    ),
    max_size=40,
)
instants = st.lists(ticks | st.integers(1, 800), max_size=20)


def of_parts(events, capacity=1000):
    made = track(capacity=capacity)
    for columns, ms, values in events:
        add(made, columns, ms * MS, np.array(values))
    return made


@given(samples, instants, st.integers(0, 2**32 - 1))
def test_the_order_of_arrival_does_not_matter(events, when, seed):
    first, second = of_parts(events), of_parts(random.Random(seed).sample(events, len(events)))
    assert first.sort() == second.sort()
    assert first.newest_ns == second.newest_ns
    assert first.standing(0.1, 0.1).tolist() == second.standing(0.1, 0.1).tolist()
    one, other = at(first, *when), at(second, *when)
    np.testing.assert_array_equal(causes(first, *when), causes(second, *when))
    good = causes(first, *when) == 0
    signs = came(first, *when), came(second, *when)
    for mine, theirs in (*zip(one, other, strict=True), signs):
        np.testing.assert_array_equal(mine[good], theirs[good])


@given(samples, instants)
def test_values_are_there_where_every_joint_is_bracketed(events, when):
    """By a search through all samples of each publisher that names the joint."""
    made = of_parts(events)
    made.sort()

    def bracketed(joint, ms):
        for part in {columns for columns, *_ in events if joint in columns}:
            known = [stamp for columns, stamp, _ in events if columns == part]
            before = [stamp for stamp in known if stamp <= ms]
            after = [stamp for stamp in known if stamp >= ms]
            if before and after and min(after) - max(before) <= 1e3 * MAX_GAP:
                return True
        return False

    found = causes(made, *when) == 0
    assert found.tolist() == [all(bracketed(j, ms) for j in BOTH) for ms in when]


def test_of_equal_stamps_one_sample_is_kept_and_not_by_arrival():
    both = [(100, (0.1, 0.4)), (100, (0.1, 0.3))]
    for order in (1, -1):
        made = track()
        for ms, values in both[::order]:
            add(made, BOTH, ms * MS, np.array(values))
        assert made.sort() == (0, 1)
        assert made.sort() == (0, 0)
        np.testing.assert_array_equal(at(made, 100).joints, [(0.1, 0.3)])


# Several publishers


def test_publishers_of_parts_make_one_arm():
    """Each is interpolated on its own, at its own rate and stamps."""
    made = track((True, True, False))
    fill(made, [(ms, (1e-3 * ms, 1.0 - 1e-3 * ms)) for ms in range(0, 500, 5)], (0, 2))
    fill(made, [(ms, (-2e-3 * ms,)) for ms in range(3, 500, 20)], (1,))
    motion = at(made, 77, 201)
    np.testing.assert_allclose(
        motion.joints, [[0.077, -0.154, 0.923], [0.201, -0.402, 0.799]], atol=1e-12
    )
    np.testing.assert_allclose(motion.velocity, [[1.0, -2.0, -1.0]] * 2, atol=1e-9)
    assert made.newest_ns == 483 * MS
    assert made.missing == ()
    assert words(made, 2, 484) == [BEFORE, AFTER]


def test_a_joint_that_nobody_names_is_missing():
    made = filled([(0, (0.0,)), (10, (0.0,))], columns=(1,))
    assert made.missing == (0,)
    assert made.silent(MS) == ()
    assert words(made, 5) == [AFTER]
    assert made.samples()[0].tolist() == []


@pytest.mark.parametrize('order', [1, -1])
@pytest.mark.parametrize(
    ('publishers', 'expected'),
    [
        ({(1,): (9.0,), (0, 1, 2): (1.0, 2.0, 3.0)}, [1.0, 2.0, 3.0]),  # the one that names more
        ({(0, 1): (1.0, 2.0), (1, 2): (9.0, 3.0)}, [1.0, 9.0, 3.0]),
    ],
)
def test_of_two_publishers_of_a_joint_it_does_not_count_which_came_first(
    publishers, expected, order
):
    made = track((True, True, True))
    for columns, values in [*publishers.items()][::order]:
        fill(made, [(ms, values) for ms in range(0, 100, 10)], columns)
    np.testing.assert_allclose(at(made, 55).joints, [expected])


def test_a_publisher_that_falls_silent_holds_nothing_up_while_others_name_its_joints():
    """As a driver that publishes the gripper's and one joint of the arm once, at the start."""
    made = filled([(10, (0.0,))], (1,))
    fill(made, [(ms, (0.0, 0.0)) for ms in range(10, 1000, 10)])
    assert made.newest_ns == 990 * MS
    made.release(500 * MS)
    assert made.standing(1e-3, 0.1).tolist() == [[500 * MS, 990 * MS]]


def test_a_publisher_that_falls_silent_stops_everything_where_nobody_else_names_its_joints():
    made = filled([(ms, (0.0,)) for ms in range(0, 1000, 10)], (0,))
    fill(made, [(ms, (0.0,)) for ms in range(0, 310, 10)], (1,))
    assert made.newest_ns == 300 * MS
    assert made.silent(MS) == (1,)
    made.release(500 * MS)
    assert made.newest_ns == 300 * MS
    assert made.missing == ()


# Signs of the last moves


def brute_approach(stamps, values, when, before):
    signs = []
    now = np.array([np.interp(when, stamps, column) for column in values.T])
    for j, value in enumerate(now):
        past = values[stamps <= when, j]
        far = np.flatnonzero(np.abs(value - past) > STILL)
        signs.append(np.sign(value - past[far[-1]]) if len(far) else before[j])
    return signs


@given(st.integers(0, 2**32 - 1), st.sampled_from([0, 37, 80]))
def test_the_sign_is_that_of_the_last_move(seed, released):
    """By a search back through all samples, those let go included."""
    rng = np.random.default_rng(seed)
    count = 150
    moving = np.repeat(rng.random((count // 5, 2)) < 0.3, 5, axis=0)
    speed = np.repeat(rng.choice([-0.02, 0.003, 0.02], (count // 5, 2)), 5, axis=0)
    values = np.cumsum(moving * speed, axis=0) + rng.normal(scale=5e-5, size=(count, 2))
    stamps = 10 * np.arange(count)
    made = filled(zip(stamps.tolist(), values.tolist(), strict=True))
    made.release(10 * released * MS)
    when = np.arange(10 * released, 10 * count - 10, 10)
    found = came(made, *when)
    before = np.zeros(2)
    if released:
        before = brute_approach(stamps, values, 10 * released, before)
    expected = [
        brute_approach(stamps[released:], values[released:], ms, before) for ms in when.tolist()
    ]
    np.testing.assert_array_equal(found, expected)


# Buffers


def test_release_keeps_the_last_sample_and_the_signs():
    made = filled([(k * 10, (0.01 * k, -0.01 * k)) for k in range(10)])
    assert made.release(1000 * MS) == 9
    assert made.newest_ns == 90 * MS
    assert made.horizon_ns == 1000 * MS
    np.testing.assert_array_equal(came(made, 90), [[1.0, -1.0]])
    made.release(500 * MS)
    assert made.horizon_ns == 1000 * MS


def test_in_a_pause_joint_states_are_too_far_apart_whatever_was_let_go():
    made = filled([(ms, (0.0, 0.0)) for ms in (*range(10), *range(900, 910))])
    assert made.release(500 * MS) == 9
    assert words(made, 5, 600, 905) == [BEFORE, APART, '']


@pytest.mark.parametrize('capacity', [1, 2, 3, 4, 5, 100])
def test_a_full_track_is_halved(capacity):
    made = track(capacity=capacity)
    taken = gone = 0
    for k in range(500):
        if not made.room(BOTH):
            made.sort()
            gone += made.halve()
        assert made.room(BOTH) or capacity == 1
        if made.room(BOTH):
            add(made, BOTH, k * MS, np.zeros(2))
            taken += 1
    made.sort()
    held, _ = made.samples()
    assert len(held) == taken - gone
    assert held.tolist() == [k * MS for k in range(500 - len(held), 500)] or capacity == 1
    if capacity > 3:
        assert capacity // 2 <= len(held) <= capacity


# Noise


def test_the_noise_of_a_joint_at_rest_is_that_of_its_newest_samples():
    rng = np.random.default_rng(0)
    sizes = np.where(np.arange(400) < 200, 1e-3, 1e-5)[:, np.newaxis] * [0.5, 1.0]
    values = rng.normal(size=(400, 2)) * sizes + [3.14159, -1.0]  # about half a turn
    made = filled([(10 * k, row) for k, row in enumerate(values)])
    assert made.noise_at_rest(1500 * MS, 1990 * MS) == pytest.approx(1e-3, rel=0.2)
    assert made.noise_at_rest(1500 * MS, 3990 * MS) == pytest.approx(1e-5, rel=0.2)
    assert made.noise_at_rest(10 * MS, 3990 * MS) == pytest.approx(1e-5, rel=0.8)  # of a few
    assert made.noise_at_rest(1500 * MS, 60 * MS) is None  # too few there are
    assert made.noise_at_rest(1500 * MS, 70 * MS) == pytest.approx(1e-3, rel=0.8)
    assert made.noisiest == {1: 4}


def test_a_joint_that_moves_tells_no_noise():
    rng = np.random.default_rng(0)
    values = 1e-4 * rng.normal(size=(100, 2)) + 1e-3 * np.arange(100)[:, np.newaxis] * [0.0, 1.0]
    assert (
        filled([(10 * k, row) for k, row in enumerate(values)]).noise_at_rest(500 * MS, 990 * MS)
        is None
    )
