# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import START, stamps, stops, sweep

from calib_ros.sampling.collector import Collector
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.slices import Piece, Slice, StreamKey
from calib_ros.sampling.waiting import MOST_STREAMS, TOO_MANY
from calib_ros.settings import Settings

POSE = StreamKey('', '', False, False, False)
JUDGE = StreamKey('', '', True, False, False)
WIRE = StreamKey('distance', '', False, True, False)
NOISE = 5e-5
STOPS = np.array([[0.0, 0.0], [0.5, -0.4], [1.0, 0.3], [0.2, 0.9], [-0.6, 0.1]])
MOVE = STAND = 1.0
LATE = 'measurements: later than lateness allows'
MOVING = 'measurements: the arm was moving'
CALM = 'measurements: the arm had just stopped'
REST = 'measurements: of a stop that has its pose already'


def place(joints):
    """Return what a tracker would see of an arm with two joints."""
    return np.stack([joints[:, 0], joints[:, 1], joints[:, 0] + joints[:, 1]], axis=1) + 2.0


def joint_events(motion, end, rate=100.0, begin=0.0):
    """Return (time of arrival [s], stream, stamp, numbers) of joint samples."""
    times = np.arange(begin, end, 1.0 / rate)
    return [
        (time, (0, 1), stamp, row)
        for time, stamp, row in zip(times.tolist(), stamps(times), motion(times), strict=True)
    ]


def pose_events(motion, end, rate=50.0, begin=0.0, key=POSE, delay=0.0, noise=NOISE, seed=1):
    """Return (time of arrival [s], stream, stamp, numbers) of measurements stamped late."""
    times = np.arange(begin + 0.003, end, 1.0 / rate)
    values = place(motion(times))
    values = values + np.random.default_rng(seed).normal(scale=noise, size=values.shape)
    if key.distance:
        values = np.linalg.norm(values, axis=1, keepdims=True)
    return [
        (time + delay, key, stamp, value)
        for time, stamp, value in zip(times.tolist(), stamps(times + delay), values, strict=True)
    ]


def play(made, *events, finish=True):
    """Play events in the order of their arrival and return the samples."""
    come = []
    for time, *what in sorted((e for each in events for e in each), key=lambda event: event[0]):
        if len(what) > 1:
            come.append((time, *what))
            continue
        give(made, come)
        come = []
        what[0](made)
    give(made, come)
    if finish:
        made.finish()
    return made.maker.take()[0]


def give(made, come):
    """Let a collector take (time, stream, stamp, numbers), as a session does."""
    streams = {}
    for k, (_, key, *what) in enumerate(come):
        streams.setdefault(key, []).append((k, *what))
    pieces = [
        Piece(key, *(np.array(each) for each in zip(*rows, strict=True)))
        for key, rows in streams.items()
    ]
    left = Slice.of(pieces, round(1e9 * made.settings.delay)) if pieces else ()
    while len(left):
        count = made.reach(left, (0, 2 * START))
        if rounds := made.take(left.between(0, count)):
            made.round(rounds)
        left = left.between(count, len(left))


def collector(**settings):
    return Collector([True, True], Settings(**settings))


def tour(**settings):
    return stops(STOPS, settings.pop('move', MOVE), settings.pop('stand', STAND))


def assert_same(found, expected):
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        for field in fields(Sample):
            np.testing.assert_array_equal(
                getattr(one, field.name), getattr(other, field.name), field.name
            )


# Stops


def test_a_stop_is_one_sample_of_each_stream():
    motion = tour()
    made = collector()
    samples = play(
        made,
        joint_events(motion, 9.5),
        pose_events(motion, 9.5),
        pose_events(motion, 9.5, 20.0, key=WIRE),
        pose_events(motion, 9.5, 30.0, key=JUDGE),
    )
    assert len(samples) == 15
    for k, where in enumerate(STOPS):
        three = samples[3 * k : 3 * k + 3]
        assert {each.validation for each in three} == {True, False}
        assert sum(each.distance is not None for each in three) == 1
        for sample in three:
            np.testing.assert_allclose(sample.joints, where, atol=1e-3)
            assert (2 * k) < 1e-9 * (sample.stamp_ns - START) < 2 * k + 1.1
            truth = place(where[np.newaxis])[0]
            if sample.distance is None:
                np.testing.assert_allclose(sample.position, truth, atol=5 * NOISE)
                assert 0.5 * NOISE < sample.spread < 2.5 * NOISE
            else:
                assert sample.distance == pytest.approx(np.linalg.norm(truth), abs=1e-4)
                assert sample.position is None
            assert sample.velocity is None
            if k:
                sign = np.sign(where - STOPS[k - 1])
                np.testing.assert_array_equal(sample.approach, sign)
    # a stop of a second, without the tenth in which it vibrates, at 50 Hz
    assert [each.count for each in samples[:-3:3]] == pytest.approx([47] * 4, abs=6)
    assert made.dropped == {}
    assert set(made.unused) == {MOVING, CALM}


def test_the_covariance_of_a_stop_is_the_mean_of_its_measurements():
    motion = stops(STOPS[:2], MOVE, STAND)
    spread = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]) * 1e-8
    spread[0, 1] = spread[1, 0] = 5e-9
    times = np.arange(0.003, 3.5, 0.02)
    sizes = np.where(np.arange(len(times))[:, np.newaxis] % 2, 3.0, 1.0) * spread.ravel()
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
    rows = np.concatenate([place(motion(times)), turns, sizes], axis=1)
    events = [
        (time, POSE, stamp, row)
        for time, stamp, row in zip(times.tolist(), stamps(times), rows, strict=True)
    ]
    sample = play(collector(), joint_events(motion, 3.5), events)[0]
    share = 1.0 / sample.count  # an odd count has one more of either
    np.testing.assert_allclose(sample.covariance, 2.0 * spread, rtol=share)
    np.testing.assert_array_equal(sample.covariance == 0.0, spread == 0.0)


@pytest.mark.parametrize(('settle', 'count'), [(0.0, 50), (0.3, 35), (0.7, 15)])
def test_measuring_begins_after_the_arm_has_settled(settle, count):
    motion = tour()
    made = collector(settle=settle)
    first = play(made, joint_events(motion, 9.5), pose_events(motion, 9.5))[1]
    assert first.count == pytest.approx(count, abs=6)
    assert (made.unused[CALM] > 0) == (settle > 0.0)


def test_a_stop_that_is_too_short_is_no_sample():
    motion = tour()
    made = collector(shortest_stop=1.6)
    assert play(made, joint_events(motion, 9.5), pose_events(motion, 9.5)) == []
    assert made.unused['measurements: the stop was too short'] > 200


def test_of_a_long_stop_only_the_beginning_is_used():
    motion = stops(STOPS[:3], 1.0, 6.0)
    made = collector(longest_stop=2.0)
    samples = play(made, joint_events(motion, 20.0), pose_events(motion, 20.0))
    assert len(samples) == 3
    for k, sample in enumerate(samples):
        assert sample.count == pytest.approx(1.9 * 50, abs=4)
        assert 1e-9 * (sample.stamp_ns - START) == pytest.approx(7.0 * k + 1.05, abs=0.2)
    assert made.unused[REST] == pytest.approx(3 * 4 * 50, abs=20)


def test_a_long_stop_is_sampled_while_it_lasts():
    motion = stops(STOPS[:1], 1.0, 60.0)
    made = collector(longest_stop=2.0)
    events = joint_events(motion, 4.0), pose_events(motion, 4.0)
    assert len(play(made, *events, finish=False)) == 1
    assert made.state() == 'the pose is measured: move on'


def test_a_measurement_while_the_arm_vibrates_is_left_out():
    motion = tour()
    made = collector()
    noise = np.random.default_rng(4).normal(scale=NOISE, size=(950, 3))
    events = []
    for time, more in zip(np.arange(950) * 0.01, noise, strict=True):
        since = time % (MOVE + STAND)
        swing = 2e-3 * np.exp(-since / 0.08) * np.sin(50.0 * since)
        seen = place(motion([time]))[0] + swing + more
        events.append((time, POSE, int(stamps(time)), seen))
    samples = play(made, joint_events(motion, 9.5), events)
    assert len(samples) == 5
    assert made.dropped['measurements: still vibrating, or a spike'] > 20
    for sample, where in zip(samples, STOPS, strict=True):
        error = np.abs(sample.position - place(where[np.newaxis])[0]).max()
        assert error < 5.0 * NOISE / np.sqrt(sample.count)


def test_a_stop_at_which_the_target_moves_is_dropped_and_counted():
    motion = tour()
    made = collector()
    events = [
        (time, POSE, int(stamps(time)), np.array([1.0, 2.0, 3.0 + 5e-3 * time]))
        for time in np.arange(0.0, 9.5, 0.02).tolist()
    ]
    assert play(made, joint_events(motion, 9.5), events) == []
    assert made.dropped == {
        'measurements: a stop that spreads more than the noise': pytest.approx(270, abs=10)
    }


def test_joints_are_those_of_the_time_of_the_measurements():
    """Noise of the encoders is averaged too, about half a turn as well."""
    rng = np.random.default_rng(3)
    where = np.array([np.pi, 0.4])
    made = collector()
    events = []
    for time in np.arange(0.0, 2.0, 0.01).tolist():
        row = where + rng.normal(scale=1e-5, size=2)
        row = (row + np.pi) % (2.0 * np.pi) - np.pi
        events.append((time, (0, 1), int(stamps(time)), row))
    (sample,) = play(made, events, pose_events(stops(where[np.newaxis]), 1.95))
    error = (sample.joints - where + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(error).max() < 5e-6


# Every measurement


def test_in_continuous_mode_every_measurement_is_a_sample():
    motion = sweep(2, np.random.default_rng(2))
    made = collector(mode='continuous')
    samples = play(made, joint_events(motion, 5.1), pose_events(motion, 5.0))
    assert len(samples) == 250
    times = np.array([1e-9 * (each.stamp_ns - START) for each in samples])
    joints = np.array([each.joints for each in samples])
    np.testing.assert_allclose(joints[1:], motion(times[1:]), atol=1e-6)
    speed = (motion(times + 1e-5) - motion(times - 1e-5)) / 2e-5
    inner = slice(2, -2)
    np.testing.assert_allclose([s.velocity for s in samples][inner], speed[inner], atol=1e-3)
    assert {each.count for each in samples} == {1}
    assert made.dropped == made.unused == {}


def test_in_continuous_mode_samples_come_while_the_arm_moves():
    motion = sweep(2, np.random.default_rng(2))
    made = collector(mode='continuous', lateness=0.3)
    samples = play(made, joint_events(motion, 5.0), pose_events(motion, 5.0), finish=False)
    assert 250 - 15 - 26 < len(samples) < 250 - 14  # a round comes twice a second


# On request


def test_in_triggered_mode_nothing_is_taken_unasked():
    motion = tour()
    made = collector(mode='triggered')
    assert play(made, joint_events(motion, 9.5), pose_events(motion, 9.5)) == []
    assert set(made.unused) == {MOVING, 'measurements: nobody asked for them'}


def ask(times):
    answers = []
    return [(time, lambda made: answers.append(made.capture())) for time in times], answers


def test_a_sample_is_taken_when_it_is_asked_for():
    motion = tour()
    made = collector(mode='triggered')
    asking, answers = ask([0.8, 4.9])
    samples = play(
        made,
        joint_events(motion, 9.5),
        pose_events(motion, 9.5),
        pose_events(motion, 9.5, key=WIRE),
        asking,
    )
    assert answers == [(2, ''), (2, '')]
    assert len(samples) == 4
    for sample, where in zip(samples, STOPS[[0, 0, 2, 2]], strict=True):
        np.testing.assert_allclose(sample.joints, where, atol=1e-3)


def test_a_capture_that_gives_nothing_says_why():
    motion = tour()
    made = collector(mode='triggered')
    assert made.capture() == (0, 'no joint states have come')
    play(made, joint_events(motion, 0.5), finish=False)
    assert made.capture() == (0, 'no measurements have come since the last pose')
    play(
        made,
        joint_events(motion, 1.5, begin=0.5),
        pose_events(motion, 1.5, begin=0.5),
        finish=False,
    )
    count, why = made.capture()
    assert count == 0
    assert 'has not stood for 0.2 s' in why


def test_a_capture_in_dwell_mode_does_not_sample_the_stop_again():
    motion = stops(STOPS[:1], 1.0, 60.0)
    made = collector()
    asking, answers = ask([1.0])
    samples = play(made, joint_events(motion, 8.0), pose_events(motion, 8.0), asking)
    assert answers == [(1, '')]
    assert len(samples) == 1
    assert made.unused[REST] > 300


def test_a_capture_leaves_the_stop_before_its_sample():
    """It comes before `lateness` has passed since that stop."""
    motion = stops(STOPS[:3], 0.3, 0.5)
    made = collector()
    asking, answers = ask([1.25])
    samples = play(made, joint_events(motion, 2.4), pose_events(motion, 2.4), asking)
    assert answers == [(1, '')]
    for sample, where in zip(samples, STOPS[:3], strict=True):
        np.testing.assert_allclose(sample.joints, where, atol=1e-3)


def test_a_capture_that_gives_nothing_leaves_the_stop_its_sample():
    motion = stops(STOPS[:2], 1.0, 1.0)
    made = collector()
    asking, answers = ask([2.35])
    late = [(time + 0.4, *what) for time, *what in pose_events(motion, 8.0)]
    samples = play(made, joint_events(motion, 8.0), late, asking)
    assert answers == [(0, 'no measurement within this stop')]
    assert len(samples) == 2
    assert samples[1].count > 200


# Order of arrival


@settings(max_examples=16)
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
    samples = play(made, joint_events(motion, 9.5), late)
    assert samples == []
    assert made.dropped == {LATE: pytest.approx(350, abs=10)}
    made = collector(mode=mode, lateness=2.5)
    assert len(play(made, joint_events(motion, 9.5), late)) >= 4
    assert made.dropped == {}


def test_joint_samples_that_come_too_late_are_counted():
    motion = tour()
    made = collector(lateness=0.5)
    play(made, joint_events(motion, 9.5))
    play(made, [(0.0, (0, 1), START, np.zeros(2))], finish=False)
    assert made.dropped == {'joints: later than lateness allows': 1}


@pytest.mark.parametrize('delay', [0.2, -0.05])
@pytest.mark.parametrize('mode', ['dwell', 'continuous'])
def test_a_tracker_that_stamps_late_is_set_right_by_the_delay(delay, mode):
    """Dwells of half a second: without the delay half of what is measured belongs elsewhere."""
    motion = tour(move=0.6, stand=0.5)
    made = collector(mode=mode, delay=delay)
    samples = play(made, joint_events(motion, 5.0), pose_events(motion, 4.8, delay=delay))
    assert len(samples) >= 4
    for sample in samples[2:-3]:
        assert sample.delay == pytest.approx(delay)
        np.testing.assert_allclose(
            sample.position, place(sample.joints[np.newaxis])[0], atol=6 * NOISE + 1e-5
        )


# Going on


def test_a_flush_in_the_middle_of_a_stop_samples_it_once():
    motion = tour()
    made = collector()
    flushing = [(time, lambda made: made.flush()) for time in (2.6, 2.8, 4.05, 7.0)]
    samples = play(made, joint_events(motion, 9.5), pose_events(motion, 9.5), flushing)
    assert len(samples) == 5
    assert made.unused[REST] > 10
    for sample, where in zip(samples, STOPS, strict=True):
        np.testing.assert_allclose(sample.joints, where, atol=1e-3)


@pytest.mark.parametrize('mode', ['dwell', 'continuous'])
@pytest.mark.parametrize('rate', [50.0, 500.0])
def test_a_bag_in_a_loop_gives_nothing_twice(mode, rate):
    motion = tour()
    end = 9.5
    events = [*joint_events(motion, end, rate), *pose_events(motion, end)]
    once = collector(mode=mode)
    expected = play(once, events)
    made = collector(mode=mode)
    again = [(time + 10.0 * k, *what) for k in range(3) for time, *what in events]
    samples = play(made, again)
    assert made.notes['the clock jumped back'] == 2
    if mode == 'dwell':  # the last stop is cut off by the jump
        assert len(samples) == len(expected) == 5
    else:
        assert len({sample.stamp_ns for sample in samples}) == len(samples) == len(expected)


def test_a_stop_that_was_taken_back_is_sampled_when_it_comes_again():
    motion = tour()
    made = collector()
    events = [*joint_events(motion, 9.5), *pose_events(motion, 9.5)]
    samples = play(made, events)
    made.forget(samples[3])
    again = play(made, [(time + 10.0, *what) for time, *what in events])
    assert [each.stamp_ns for each in again] == [samples[3].stamp_ns]


def test_after_the_clock_jumped_back_new_stops_are_sampled():
    """As when a simulation begins anew: what was sampled before is kept."""
    motion, other = tour(), stops(STOPS[::-1] + 0.1)
    made = collector()
    events = [*joint_events(motion, 9.5), *pose_events(motion, 9.5)]
    more = [*joint_events(other, 9.5), *pose_events(other, 9.5, begin=0.007)]
    samples = play(made, events, [(time + 10.0, *what) for time, *what in more])
    assert len(samples) == 10
    for sample, where in zip(samples, [*STOPS, *(STOPS[::-1] + 0.1)], strict=True):
        np.testing.assert_allclose(sample.joints, where, atol=1e-3)


# Buffers


def test_a_small_joint_buffer_costs_only_what_it_cannot_hold():
    """Three seconds of joint samples are enough for stops of one."""
    motion = tour()
    made = collector(joint_buffer=300)
    samples = play(made, joint_events(motion, 9.5), pose_events(motion, 9.5))
    whole = collector()
    assert_same(samples, play(whole, joint_events(motion, 9.5), pose_events(motion, 9.5)))


@pytest.mark.parametrize('capacity', [2, 60])
def test_a_joint_buffer_that_is_too_small_says_so(capacity):
    motion = tour()
    made = collector(joint_buffer=capacity)
    play(made, joint_events(motion, 4.5), pose_events(motion, 4.5))
    assert made.notes['joint states let go, the joint buffer was full'] > 0


def test_a_full_pose_buffer_drops_new_measurements_and_counts_them():
    motion = tour()
    made = collector(pose_buffer=10)
    play(made, joint_events(motion, 9.5), pose_events(motion, 9.5))
    assert made.dropped['measurements: pose buffer full'] > 300


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
    assert made.waiting.count == MOST_STREAMS
    assert made.dropped == {TOO_MANY: 200 - MOST_STREAMS + 2}


def test_targets_that_gave_no_sample_make_room_for_others():
    """Many markers are seen in every motion; the one that is sampled stays."""
    motion = tour()
    made = collector()
    begins = np.array([1.2, 3.2, 5.2, 7.2])
    glimpses = [
        glimpse(100 * leg + k, begins[leg] + 5e-3 * k) for leg in range(4) for k in range(100)
    ]
    samples = play(made, joint_events(motion, 9.5), pose_events(motion, 9.5), glimpses)
    assert len(samples) == 5
    assert {each.target for each in samples} == {''}
    assert made.dropped == {TOO_MANY: 4 * (100 - (MOST_STREAMS - 1))}


def test_a_target_that_was_sampled_makes_no_room(monkeypatch):
    monkeypatch.setattr('calib_ros.sampling.waiting.MOST_STREAMS', 2)
    motion = tour()
    made = collector()
    both = [pose_events(motion, 1.5, key=marker(k)) for k in (1, 2)]
    samples = play(made, joint_events(motion, 9.5), *both, [glimpse(3, 4.5)])
    assert [each.target for each in samples] == ['1', '2']
    assert made.dropped == {TOO_MANY: 1}
    made.forget(samples[0])
    play(made, [glimpse(3, 9.6)], finish=False)
    assert made.waiting.count == 1
