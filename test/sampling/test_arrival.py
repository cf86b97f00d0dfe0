# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from arriving import (
    NOISE,
    POSE,
    REST,
    STOPS,
    WIRE,
    assert_same,
    collector,
    joint_events,
    place,
    play,
    pose_events,
    tour,
    toured,
)
from hypothesis import given, settings, strategies as st
from streams import START, stamps, stops, sweep

from calib_ros.sampling.buffers import TOO_MANY
from calib_ros.sampling.slices import NO_ACCIDENT
from calib_ros.values import MOST_NAMES

LATE = 'measurements: later than lateness allows'


# Order of arrival


@settings(max_examples=10)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from(['dwell', 'continuous']),
    st.sampled_from([0.03, 0.2, 1.0]),
    st.sampled_from([0.0, 0.15]),
)
def test_the_order_of_arrival_within_lateness_does_not_matter(seed, mode, lateness, delay):
    rng = np.random.default_rng(seed)
    motion = tour(move=0.7, stand=0.8)
    joints = joint_events(motion, 7.0)
    measured = pose_events(motion, 7.0, delay=delay)
    measured += pose_events(motion, 7.0, 17.0, key=WIRE, delay=delay)
    shaken = [(time + rng.uniform(0.0, 0.95 * lateness), *what) for time, *what in measured]
    given_ = {'mode': mode, 'lateness': lateness, 'delay': delay}
    orderly, other = (collector(**given_) for _ in range(2))
    expected = play(orderly, joints, measured)
    found = play(other, joints, shaken)

    def sorted_by_stamp(samples):
        return sorted(samples, key=lambda sample: (sample.stamp_ns, sample.device))

    assert_same(sorted_by_stamp(found), sorted_by_stamp(expected))
    assert other.unused == orderly.unused
    assert other.dropped == orderly.dropped


@pytest.mark.parametrize('mode', ['dwell', 'continuous'])
def test_what_comes_later_than_lateness_is_counted(mode):
    motion = tour()
    made = collector(mode=mode, lateness=0.5)
    late = [(time + 2.0, *what) for time, *what in pose_events(motion, 7.0)]
    assert play(made, joint_events(motion, 9.5), late) == []
    assert made.dropped == {LATE: pytest.approx(350, abs=10)}
    made = collector(mode=mode, lateness=2.5)
    assert len(play(made, joint_events(motion, 9.5), late)) == (4 if mode == 'dwell' else 350)
    assert made.dropped == {}


def test_joint_samples_that_come_too_late_are_counted():
    """Many in succession are a clock that jumped; now and then they are not."""
    made, late = collector(lateness=0.5), [(0.0, (0, 1), START, np.zeros(2))]
    for begin in (0.0, 9.5, 19.0):
        play(made, joint_events(tour(), begin + 9.5, begin=begin), finish=False)
        for _ in range(NO_ACCIDENT - 1):
            play(made, late, finish=False)
    assert made.dropped == {'joints: later than lateness allows': 3 * (NO_ACCIDENT - 1)}
    play(made, late, finish=False)
    assert made.notes['the clock jumped back'] == 1


@pytest.mark.parametrize('delay', [0.2, -0.05])
@pytest.mark.parametrize('mode', ['dwell', 'continuous'])
def test_a_tracker_that_stamps_late_is_set_right_by_the_delay(delay, mode):
    """Dwells of half a second: without the delay half of what is measured belongs elsewhere."""
    motion = tour(move=0.6, stand=0.5)
    made = collector(mode=mode, delay=delay)
    samples = play(made, joint_events(motion, 5.0), pose_events(motion, 4.8, delay=delay))
    assert len(samples) == (5 if mode == 'dwell' else 240)
    for sample in samples[2:-3]:
        assert sample.delay == pytest.approx(delay)
        np.testing.assert_allclose(
            sample.position, place(sample.joints[np.newaxis])[0], atol=6 * NOISE + 1e-5
        )


# Going on


def test_a_flush_in_the_middle_of_a_stop_samples_it_once():
    flushing = [(time, lambda made: made.flush()) for time in (2.6, 2.8, 4.05, 7.0)]
    made, samples = toured(flushing)
    assert made.unused[REST] > 10
    np.testing.assert_allclose([each.joints for each in samples], STOPS, atol=1e-3)


@pytest.mark.parametrize('time', [5.3, 5.8])
def test_a_flush_before_the_arm_has_settled_does_not_let_it_count_as_settled(time):
    motion = stops(STOPS[:2], 1.0, 4.0)
    events = joint_events(motion, 9.5), pose_events(motion, 9.5)
    flush = (time, lambda made: made.flush())
    expected, found = (play(collector(settle=1.5), *events, each) for each in ([], [flush]))
    assert [each.count for each in found] == [each.count for each in expected]


@pytest.mark.parametrize('mode', ['dwell', 'continuous'])
@pytest.mark.parametrize('rate', [50.0, 500.0])
def test_a_bag_in_a_loop_gives_nothing_twice(mode, rate):
    motion, made = tour(), collector(mode=mode)
    events = [*joint_events(motion, 9.5, rate), *pose_events(motion, 9.5)]
    expected = play(collector(mode=mode), events)
    again = [(time + 10.0 * k, *what) for k in range(3) for time, *what in events]
    samples = play(made, again)
    assert made.notes['the clock jumped back'] == 2
    if mode == 'dwell':  # the last stop is cut off by the jump
        assert len(samples) == len(expected) == 5
    else:
        assert len({sample.stamp_ns for sample in samples}) == len(samples) == len(expected)


def test_a_stop_that_was_taken_back_is_sampled_when_it_comes_again():
    motion, made = tour(), collector()
    events = [*joint_events(motion, 9.5), *pose_events(motion, 9.5)]
    samples = play(made, events)
    made.forget(samples[3])
    again = play(made, [(time + 10.0, *what) for time, *what in events])
    assert [each.stamp_ns for each in again] == [samples[3].stamp_ns]


# Buffers


def test_a_small_joint_buffer_costs_only_what_it_cannot_hold():
    """Three seconds of joint samples are enough for stops of one."""
    assert_same(toured(joint_buffer=300)[1], toured()[1])


@pytest.mark.parametrize('capacity', [2, 60])
def test_a_joint_buffer_that_is_too_small_says_so(capacity):
    made, _ = toured(joint_buffer=capacity, end=4.5)
    assert made.notes['joint states dropped, the joint buffer was full'] == 450 - capacity


def test_a_full_pose_buffer_drops_new_measurements_and_counts_them():
    made, _ = toured(pose_buffer=10)
    assert made.dropped == {'measurements: pose buffer full': 425}  # ten of each stop are kept


def test_samples_kept_are_bounded():
    motion = sweep(2, np.random.default_rng(2))
    made = collector(mode='continuous', pose_buffer=60, lateness=0.2)
    assert len(play(made, joint_events(motion, 5.0), pose_events(motion, 5.0))) == 60
    assert made.dropped['measurements: the memory for poses is full'] > 150


# Targets without end


def marker(number):
    return POSE._replace(target=str(number))


def glimpse(number, time):
    """Return the event of one measurement of a marker."""
    stamp = int(stamps(np.array([time]))[0])
    return time, marker(number), stamp, np.zeros(3)


def test_targets_without_end_are_dropped_and_counted():
    """A tracker numbers its markers anew with each measurement; memory stays bounded."""
    made = collector()
    play(made, [glimpse(k, 0.5 + 1e-4 * k) for k in range(200)], finish=False)
    play(made, [glimpse(200, time) for time in (0.6, 0.7)], finish=False)
    assert made.waiting.count == MOST_NAMES
    assert made.dropped == {TOO_MANY: 200 - MOST_NAMES + 2}


def test_targets_that_gave_no_sample_make_room_for_others():
    """Many markers are seen in every motion; the one that is sampled stays."""
    legs, few = range(4), range(100)
    glimpses = [glimpse(100 * leg + k, 1.2 + 2.0 * leg + 5e-3 * k) for leg in legs for k in few]
    made, samples = toured(glimpses)
    assert [each.target for each in samples] == [''] * 5
    assert made.dropped == {TOO_MANY: 4 * (100 - (MOST_NAMES - 1))}


def test_a_target_that_was_sampled_makes_no_room(monkeypatch):
    monkeypatch.setattr('calib_ros.sampling.buffers.MOST_NAMES', 2)
    motion = tour()
    made = collector()
    both = [pose_events(motion, 1.5, key=marker(k)) for k in (1, 2)]
    samples = play(made, joint_events(motion, 9.5), *both, [glimpse(3, 4.5)])
    assert [each.target for each in samples] == ['1', '2']
    assert made.dropped == {TOO_MANY: 1}
    made.forget(samples[0])
    play(made, [glimpse(3, 9.6)], finish=False)
    assert made.waiting.count == 1
