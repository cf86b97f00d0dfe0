# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A cell measured in motion by a device whose clock or transport is late."""

import re
from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, UR10E, rms
from hypothesis import given, strategies as st
from scipy.signal import find_peaks
from streams import START, TRACKER, S, hear, stamps, stops, sweep

from calib_ros import CalibrationSession, Settings, identify
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.kinematics import se3
from calib_ros.sampling.delay import LEAST_MOTION, find_delay, peaks
from calib_ros.sampling.slices import Part

SECONDS = 40.0


def true_cell(seed):
    rng = np.random.default_rng(seed)
    return faulty(UR10E, Cell(), rng), sweep(6, rng, reach=2.0), rng


def told(session, joint_times, joints, times, positions, rotations, lag=0.0):
    """Let a session hear joint values, and poses a lag [s] late, every other after the next."""
    known = joint_times, stamps(joint_times), joints
    arrival = times + max(lag, 0.0) + 0.005 + 0.03 * (np.arange(len(times)) % 2)
    seen = arrival, stamps(times + lag), positions, rotations
    order = np.argsort(arrival)
    hear(session, known, [None if each is None else each[order] for each in seen])


def recorded(lag, seed=0, oriented=True, seconds=SECONDS, motion=None, **settings):
    """Return a session that has heard a moving arm, its true chain and its motion."""
    true, moving, rng = true_cell(seed)
    motion = motion or moving
    session = CalibrationSession(UR10E, Settings(**{'mode': 'continuous'} | settings))
    joint_times = np.arange(0.0, seconds, 0.005)
    times = np.arange(0.05, seconds - 0.3, 0.02)
    seen = measure(true, motion(times), rng, *NOISE, oriented)
    rotations = seen.rotations if oriented else None
    told(session, joint_times, motion(joint_times), times, seen.positions, rotations, lag)
    session.finish()
    return session, true, motion


def error(chain, true, motion):
    """Return the RMS error [m] along the motion, at times in between."""
    return rms(chain, true, motion(np.linspace(1.0, SECONDS - 1.0, 777)))


@pytest.mark.parametrize(('delay', 'oriented'), [(0.2, False), (-0.05, True)])
def test_a_delay_is_found_and_costs_nothing(delay, oriented):
    session, true, motion = recorded(delay, oriented=oriented)
    assert session.delay.seconds == pytest.approx(delay, abs=5e-3)
    result = session.identify()
    (found,) = (p for p in result.parameters if p.name == 'base.delay')
    assert found.value == pytest.approx(delay, abs=5e-5)
    assert result.accepted
    known, *_ = recorded(0.0, oriented=oriented, delay=1e-12)
    best = error(known.identify().chain, true, motion)
    assert best < NOISE[0]
    assert error(result.chain, true, motion) < 1.2 * best


def test_the_delay_is_fitted_where_it_was_given_wrong():
    """5 ms at up to 1 m/s are millimetres; the fit takes what is left."""
    session, true, motion = recorded(0.030, delay=0.025)
    assert session.delay is None
    result = session.identify()
    (found,) = (p for p in result.parameters if p.name == 'base.delay')
    assert found.value == pytest.approx(0.030, abs=1e-4)
    assert error(result.chain, true, motion) < NOISE[0]


def test_a_delay_that_little_motion_tells_roughly_is_looked_for_in_more():
    _, moving, _ = true_cell(0)
    session, *_ = recorded(0.2, oriented=False, motion=lambda times: moving(0.4 * times))
    assert session.delay.seconds == pytest.approx(0.2, abs=2e-2)


def test_a_delay_is_found_between_stops_so_long_that_hardly_anything_moves():
    """Each few seconds were evaluated alone: of 1.5 s of motion they showed none."""
    motion = stops(0.7 * UR10E.random_joints(20, np.random.default_rng(0)), 0.5, 2.0)
    session, *_ = recorded(0.15, oriented=False, motion=motion, mode='dwell')
    assert session.delay.seconds == pytest.approx(0.15, abs=5e-3)


def test_without_motion_there_is_no_delay():
    still, *_ = recorded(0.1, seconds=10.0, motion=stops(np.array([[0, -1.2, 1.2, -1, 1, 0.0]])))
    assert still.delay is None
    account = still.account()
    assert account.samples > 400
    assert account.waiting == 0


@pytest.mark.parametrize(
    ('jitter', 'smoothing', 'said'),
    [(0.0, 0.0, ''), (0.05, 0.0, 'stamps jitter'), (0.0, 0.05, 'at once, unfiltered')],
)
def test_errors_of_time_are_told(jitter, smoothing, said):
    """In motion they pass for errors of the arm, and an arm without any may look better for it."""
    true, _, rng = true_cell(0)
    motion = stops(UR10E.random_joints(6, rng) * 0.5, 1.5, 0.05)
    joint_times, times = np.arange(0.0, 9.0, 0.005), np.arange(0.05, 8.7, 0.15)
    seen = measure(true, motion(times), rng, *NOISE)
    joints = motion(joint_times)
    for k in range(1, len(joints)) if smoothing else ():
        joints[k] = joints[k - 1] + (joints[k] - joints[k - 1]) * 0.005 / smoothing
    late = times + jitter * rng.random(len(times))
    session = CalibrationSession(UR10E, Settings(mode='continuous', largest_error=1.0))
    told(session, joint_times, joints, late, seen.positions, seen.rotations)
    session.finish()
    result = identify(session.problem())
    words = [*result.refusals, *result.remarks]
    assert bool(words) == bool(said)
    assert not said or any(said in each for each in words)


def test_a_target_that_was_carried_to_the_arm_stays_in_the_account_alone():
    """Once a joint moves, the status asks no longer whether joint states are frozen."""
    true, _, rng = true_cell(0)
    motion = stops(UR10E.random_joints(60, rng) * 0.5, 0.5, 0.5)
    session = CalibrationSession(UR10E)
    times = np.arange(0.05, 49.7, 0.02)
    seen = measure(true, motion(np.maximum(times - 20.0, 0.0)), rng, *NOISE)
    carried = np.clip(18.0 - times, 0.0, None)[:, np.newaxis] * [0.1, 0.0, 0.05]
    joint_times = np.arange(0.0, 50.0, 0.005)
    joints = motion(np.maximum(joint_times - 20.0, 0.0))
    for part in (times < 19.0, times >= 19.0):
        now = (joint_times < 19.0) == part[0]
        given = times, seen.positions + carried, seen.rotations
        told(session, joint_times[now], joints[now], *(each[part] for each in given))
        assert ('are joint states frozen?' in session.status()) == part[0]
    session.finish()
    (stood,) = [each for each in session.hints if 'joint states stood still' in each.text]
    assert (stood.status, stood.explains) == ('', False)


@pytest.mark.filterwarnings('error')
def test_a_device_that_falls_silent_while_the_arm_stands_moves_no_target():
    """The median of none was a warning of numpy on the console."""
    at = np.zeros(6)
    joint_times, times = np.arange(0.0, 40.0, 0.01), np.arange(0.05, 10.0, 0.05)
    seen = measure(UR10E, np.tile(at, (len(times), 1)), np.random.default_rng(0), *NOISE)
    session = CalibrationSession(UR10E)
    for known, count in ((joint_times < 20.0, len(times)), (joint_times >= 20.0, 0)):
        given = (each[:count] for each in (times, seen.positions, seen.rotations))
        told(session, joint_times[known], np.tile(at, (sum(known), 1)), *given)
    assert 'frozen' not in session.status()


@pytest.mark.parametrize(('seed', 'jump'), [(1, 0.0), (1, 0.08), (3, 0.0), (3, 0.08)])
def test_a_shift_of_the_clocks_is_told_by_positions_alone(seed, jump):
    """Although the target is not the flange, and moves at another speed."""
    true, motion, rng = true_cell(seed)
    joint_times, times = np.arange(0.0, 60.0, 0.01), np.arange(0.05, 59.0, 0.02)
    seen = measure(true, motion(times), rng, *NOISE, oriented=False)
    session = CalibrationSession(UR10E, Settings(mode='continuous'))
    for k in range(0, 60, 15):
        known, now = (each // 15 == k // 15 for each in (joint_times, times))
        of_joints, lag = motion(joint_times[known]), 0.02 + jump * (k >= 30)
        given = times[now], seen.positions[now], None, lag
        told(session, joint_times[known], of_joints, *given)
    assert any('clocks shifted' in each.status for each in session.hints) == (jump > 0.0)


@pytest.mark.parametrize('last', [9.9, 10.25, None])  # at rest, on the way, never
def test_joint_states_that_freeze_are_told(last):
    """Where they go on nothing is told, though the target is lost for a tenth of the time."""
    true, _, rng = true_cell(0)
    motion = stops(UR10E.random_joints(50, rng) * 0.5, 0.5, 0.5)
    session = CalibrationSession(UR10E)
    joint_times, times = np.arange(0.0, 50.0, 0.005), np.arange(0.05, 49.7, 0.02)
    end = 10.0 if last is None else last  # then the arm stands, or is only said to
    seen = measure(true, motion(np.minimum(times, end) if last is None else times), rng, *NOISE)
    lost = rng.random(len(times)) < 0.1
    places = np.where(lost[:, np.newaxis], 0.0, seen.positions)
    joints = motion(np.minimum(joint_times, end))
    told(session, joint_times, joints, times, places, seen.rotations)
    session.finish()
    frozen = [each for each in session.warnings if 'joint states stood still' in each]
    assert len(frozen) == (last is not None)
    assert ('are joint states frozen?' in session.status()) == (last is not None)


@pytest.mark.parametrize(
    ('lag', 'settings', 'said'),
    [
        (0.09, {}, None),  # within settle
        (0.15, {}, '0.150 s later .* set delay to 0.150'),
        (0.15, {'settle': 0.2}, None),
        (0.15, {'delay': 0.15}, None),
        (-0.01, {}, None),
        (-0.09, {}, '0.090 s earlier .* set delay to -0.090'),  # nothing settles as it leaves
        (-0.09, {'delay': -0.09}, None),
    ],
)
def test_stops_spoilt_by_a_delay_are_told(lag, settings, said):
    """Where nothing is told the mean of a stop is as good as without a delay, or nearly."""
    motion = stops(UR10E.random_joints(25, np.random.default_rng(1)) * 0.5, 0.5, 0.5)
    session, true, _ = recorded(lag, motion=motion, seconds=24.0, mode='dwell', **settings)
    assert session.delay.seconds == pytest.approx(lag, abs=5e-4)
    if said:
        (warning,) = session.warnings
        assert re.search(said.replace('0.150', '0.1[45].').replace('0.090', '0.0[89].'), warning)
        assert f'set delay to {session.delay.seconds:.3f}' in warning
        assert f'stamps disagree: set delay to {session.delay.seconds:.3f}' in session.status()
        return
    assert session.warnings == ()
    assert len(session.samples) >= 23
    joints = np.array([each.joints for each in session.samples])
    found = np.array([each.position for each in session.samples])
    errors = found - true.forward(joints)[:, :3, 3]
    expected = NOISE[0] / np.sqrt(np.mean([each.count for each in session.samples]))
    early = lag < settings.get('delay', 0.0)  # the first of the motion is no spike yet
    assert np.sqrt((errors**2).mean()) < (0.5 * NOISE[0] if early else 1.3 * expected)


def test_measurements_at_stops_alone_tell_a_delay_roughly():
    """They began as the arm arrived: where clocks agreed, a delay of -0.05 s was to be set."""
    true, _, rng = true_cell(1)
    motion, joint_times = stops(UR10E.random_joints(25, rng), 0.6, 1.0), np.arange(0.0, 30.0, 0.02)
    times = (1.6 * np.arange(18)[:, np.newaxis] + 0.1 * np.arange(10)).ravel()
    seen = measure(true, motion(times), rng, *NOISE)
    for lag in (0.0, 0.3):
        session, joints = CalibrationSession(UR10E), motion(joint_times)
        told(session, joint_times, joints, times, seen.positions, seen.rotations, lag)
        session.finish()
        assert session.delay.seconds == pytest.approx(lag, abs=0.1)
        assert ('stamps disagree: set delay' in session.status()) == (lag > 0.0)


def test_joints_published_in_parts_show_a_delay():
    """They were not watched: the advice was to set settle."""
    true, _, rng = true_cell(0)
    times, session = np.arange(0.0, 24.0, 0.02), CalibrationSession(UR10E)
    joints = stops(UR10E.random_joints(25, rng) * 0.5, 0.5, 0.5)(times)
    seen = measure(true, joints, rng, *NOISE)
    poses = np.hstack([seen.positions, se3.to_quat(seen.rotations)])
    names, places = session.joint_names, 3 * np.arange(len(times))
    session.take(
        [
            Part(places, None, ('', *names[:2]), stamps(times), joints[:, :2]),
            Part(places + 1, None, ('', *names[2:]), stamps(times), joints[:, 2:]),
            Part(places + 2, TRACKER, ('tracker',), stamps(times - 0.3), poses),
        ]
    )
    session.finish()
    assert f'stamps disagree: set delay to {session.delay.seconds:.3f}' in session.status()
    assert session.delay.seconds == pytest.approx(-0.3, abs=1e-3)


def speeds(delay, seconds, rng, motion, true=None):
    joint_times, times = np.arange(0.0, seconds, 0.01), np.arange(0.0, seconds, 0.02)
    true = true or faulty(UR10E, Cell(), rng)
    seen = measure(true, motion(times), rng, *NOISE)
    joints = motion(joint_times)
    return (
        *(UR10E, stamps(joint_times), joints, stamps(times + delay)),
        *(seen.positions, seen.rotations),
    )


@pytest.mark.parametrize('oriented', [True, False])
def test_a_device_that_holds_its_last_pose_without_a_target_hides_no_delay(oriented):
    true, motion, rng = true_cell(0)
    joint_times, times = np.arange(0.0, 30.0, 0.01), np.arange(0.05, 29.7, 0.02)
    index = np.arange(len(times))
    held = np.where(index % 100 < 15, index - index % 100, index)  # 0.3 s of every 2 s
    seen = measure(true, motion(times), rng, *NOISE).select(held)
    session = CalibrationSession(UR10E, Settings(mode='continuous'))
    turns = seen.rotations if oriented else None
    told(session, joint_times, motion(joint_times), times, seen.positions, turns, 0.2)
    session.finish()
    assert session.delay.seconds == pytest.approx(0.2, abs=5e-3)


@pytest.mark.parametrize('delay', [0.0, 0.9024, -0.9024])
def test_find_delay_looks_up_to_a_second_to_both_sides(rng, delay):
    _, motion, _ = true_cell(3)
    found = find_delay(*speeds(delay, 30.0, rng, motion))
    assert found.seconds == pytest.approx(delay, abs=1e-4)
    assert found.correlation > 0.95


@pytest.mark.parametrize('lost', [0.0, 0.05])
def test_find_delay_by_positions_far_from_the_flange_or_lost_at_times(rng, lost):
    """Where halves of the motion tell each other, speeds may differ; zeros are no motion."""
    true, motion, _ = true_cell(3)
    far = replace(true, tool=true.tool.moved({'y': 0.5, 'z': 0.3}))
    *given, positions, _ = speeds(0.1, 30.0, rng, motion, far)
    positions[rng.random(len(positions)) < lost] = 0.0
    found = find_delay(*given, positions, None)
    assert found.seconds == pytest.approx(0.1, abs=2e-2 if lost else 2e-3)


def test_find_delay_names_none_where_none_shows(rng):
    _, motion, _ = true_cell(3)
    _, other, _ = true_cell(4)
    assert find_delay(*speeds(1.5, 30.0, rng, motion)) is None  # further than it looks
    assert find_delay(*speeds(0.0, LEAST_MOTION - 0.5, rng, motion)) is None
    arguments = list(speeds(0.0, 30.0, rng, motion))
    arguments[2] = other((arguments[1] - START) * 1e-9)
    assert find_delay(*arguments) is None  # another arm
    nothing = [UR10E, *(each[:0] for each in arguments[1:])]
    assert find_delay(*nothing) is None


def test_a_far_stamp_costs_no_time_and_no_memory(rng, monkeypatch):
    """Of one in both streams the speeds would be looked at every 5 ms up to it."""
    _, motion, _ = true_cell(3)
    chain, *arrays = speeds(0.1, 30.0, rng, motion)
    looked_at = []
    arange = np.arange

    def counting(*arguments):
        found = arange(*arguments)
        looked_at.append(len(found))
        return found

    for k in (0, 2):
        arrays[k] = np.append(arrays[k], START + 10_000_000 * 10**9)
    for k in (1, 3, 4):
        arrays[k] = np.concatenate([arrays[k], arrays[k][:1]])
    monkeypatch.setattr(np, 'arange', counting)
    assert find_delay(chain, *arrays) is None
    assert looked_at
    assert max(looked_at) <= 100_000


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.02, 0.2, 0.5]))
def test_peaks_are_those_of_scipy(seed, rise):
    rng = np.random.default_rng(seed)
    score = np.tanh(np.convolve(rng.normal(size=200), np.ones(9) / 6.0, 'valid'))
    expected, _ = find_peaks(np.pad(score, 1, constant_values=-1.0), prominence=rise)
    np.testing.assert_array_equal(peaks(score, rise), expected - 1)


def test_motion_between_joint_states_too_far_apart_tells_no_delay(rng):
    """Of an arm that is heard for half of each second nobody knows how it moved in the other."""
    _, motion, _ = true_cell(3)
    chain, joint_stamps, joints, *measured = speeds(0.1, 30.0, rng, motion)
    heard = (joint_stamps - START) % S < 5e8
    arguments = chain, joint_stamps[heard], joints[heard], *measured
    assert find_delay(*arguments, 0.1).seconds == pytest.approx(0.1, abs=3e-2)
    heard &= (joint_stamps - START) % S < 5e7
    assert find_delay(chain, joint_stamps[heard], joints[heard], *measured, 0.1) is None
