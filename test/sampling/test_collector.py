# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from arriving import (
    JUDGE,
    MOVE,
    NOISE,
    POSE,
    STAND,
    STOPS,
    WIRE,
    collector,
    joint_events,
    place,
    play,
    pose_events,
    tour,
    toured,
)
from streams import START, stamps, stops, sweep

MOVING = 'measurements: the arm was moving'
CALM = 'measurements: the arm had just stopped'


# Stops


def test_a_stop_is_one_sample_of_each_stream():
    wire, judge = (
        pose_events(tour(), 9.5, rate, key=key) for rate, key in ((20.0, WIRE), (30.0, JUDGE))
    )
    made, samples = toured(wire, judge)
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
    made, (_, first, *_) = toured(settle=settle)
    assert first.count == pytest.approx(count, abs=6)
    assert (made.unused[CALM] > 0) == (settle > 0.0)


def test_a_long_stop_is_sampled_while_it_lasts():
    motion = stops(STOPS[:1], 1.0, 60.0)
    made = collector(longest_stop=2.0)
    events = joint_events(motion, 4.0), pose_events(motion, 4.0)
    assert len(play(made, *events, finish=False)) == 1
    assert made.state() == 'the arm stands and its pose is measured: move on'


@pytest.mark.parametrize('late', [2.1, 4.1, 6.0, 7.97])
def test_a_long_stop_is_sampled_where_it_is_measured(late):
    """As by hand, or when a tracker has found its target again: it was said to be measured."""
    motion = stops(STOPS[:1], 1.0, 60.0)
    joints = joint_events(motion, 12.0)
    made = collector(longest_stop=2.0, settle=0.2)
    assert play(made, [each for each in joints if each[0] < 1.8], finish=False) == []
    assert made.state() == 'the arm stands for 1.8 s'
    made = collector(longest_stop=2.0, settle=0.2)
    assert play(made, joints, finish=False) == []
    assert made.state() == 'the arm stands, and nothing has been measured yet'
    assert made.unmeasured == 1
    measured = pose_events(motion, 12.0, begin=late - 0.003)
    made = collector(longest_stop=2.0, settle=0.2)
    (sample,) = play(made, joints, measured[:1], finish=False)
    assert sample.count == 1
    assert not made.unused
    assert made.unmeasured == 0
    assert made.state() == 'the arm stands and its pose is measured: move on'
    assert len(play(collector(longest_stop=2.0), joints, measured)) == 1


def test_a_measurement_that_waits_for_the_end_of_its_part_is_told_of():
    motion = stops(STOPS[:1], 1.0, 60.0)
    made = collector(longest_stop=2.0)
    measured = pose_events(motion, 9.0, begin=4.5)[:1]
    assert play(made, joint_events(motion, 5.0), measured, finish=False) == []
    assert made.state() == 'the arm stands for 5.0 s'


def test_the_short_last_part_of_a_long_stop_is_no_short_stop():
    motion = stops(STOPS[:2], 1.0, 4.1)
    made = collector(longest_stop=2.0, shortest_stop=1.0)
    measured = pose_events(motion, 12.0, begin=4.05)[:1]
    assert len(play(made, joint_events(motion, 12.0), measured)) == 1
    assert not made.unused


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


def test_in_continuous_mode_samples_come_while_the_arm_moves():
    motion = sweep(2, np.random.default_rng(2))
    made = collector(mode='continuous', lateness=0.3)
    samples = play(made, joint_events(motion, 5.0), pose_events(motion, 5.0), finish=False)
    assert 250 - 15 - 26 < len(samples) < 250 - 14  # a round comes twice a second


# On request


def test_in_triggered_mode_nothing_is_taken_unasked():
    made, samples = toured(mode='triggered')
    assert samples == []
    assert set(made.unused) == {MOVING, 'measurements: not requested'}


def ask(times):
    answers = []
    return [(time, lambda made: answers.append(made.capture())) for time in times], answers


def test_a_sample_is_taken_when_it_is_asked_for():
    asking, answers = ask([0.8, 4.9])
    _, samples = toured(pose_events(tour(), 9.5, key=WIRE), asking, mode='triggered')
    assert answers == [(2, ''), (2, '')]
    np.testing.assert_allclose([each.joints for each in samples], STOPS[[0, 0, 2, 2]], atol=1e-3)


@pytest.mark.parametrize('way', ['settle', 'shortest_stop'])
def test_a_long_stand_is_known_from_its_begin(way):
    motion = stops(STOPS[:1], 1.0, 60.0)
    made = collector(mode='triggered', **{way: 3.0})
    play(made, joint_events(motion, 2.9), pose_events(motion, 2.9), finish=False)
    assert made.capture()[0] == 0
    made = collector(mode='triggered', **{way: 3.0})
    play(made, joint_events(motion, 6.0), pose_events(motion, 6.0), finish=False)
    assert made.state() == 'the arm stands for 6.0 s: call ~/capture'
    assert made.capture() == (1, '')
    assert made.capture() == (0, 'no measurements since the last pose')


def test_a_capture_that_gives_nothing_says_why():
    motion = tour()
    made = collector(mode='triggered')
    assert made.capture() == (0, 'no joint states of this arm received: see ~/status')
    play(made, joint_events(motion, 0.5), finish=False)
    assert made.capture() == (0, 'no measurements since the last pose')
    events = joint_events(motion, 1.5, begin=0.5), pose_events(motion, 1.5, begin=0.5)
    play(made, *events, finish=False)
    count, why = made.capture()
    assert count == 0
    assert 'has not been still for 0.2 s' in why


@pytest.mark.parametrize(
    ('count', 'move', 'stand', 'time', 'late', 'answer', 'least'),
    [
        (1, 1.0, 60.0, 1.0, 0.0, (1, ''), 10),  # it is not sampled again
        (3, 0.3, 0.5, 1.25, 0.0, (1, ''), 10),  # before `lateness` has passed since the one before
        (2, 1.0, 1.0, 2.35, 0.4, (0, 'no measurement within this stop'), 200),
    ],
)
def test_a_capture_leaves_each_stop_one_sample(count, move, stand, time, late, answer, least):
    motion = stops(STOPS[:count], move, stand)
    end = 2.4 if count == 3 else 8.0
    asking, answers = ask([time])
    measured = [(at + late, *what) for at, *what in pose_events(motion, end)]
    samples = play(collector(), joint_events(motion, end), measured, asking)
    assert answers == [answer]
    np.testing.assert_allclose([each.joints for each in samples], STOPS[:count], atol=1e-3)
    assert samples[-1].count >= least
