# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joint states that are slow, noisy or on another clock: as good as they can be, or told."""

import re
from dataclasses import replace

import numpy as np
import pytest
from fits import rms
from sessions import TRUE, UR5E, session
from streams import (
    POSE,
    START,
    TRACKER,
    S,
    hear,
    joint_state,
    of_joints,
    pose,
    stamps,
    stops,
    sweep,
    take,
)

from calib_ros import CalibrationSession, Settings
from calib_ros.apply.simulation import measure, random_frame
from calib_ros.errors import InputError
from calib_ros.kinematics import se3
from calib_ros.sampling.account import too_much_lost
from calib_ros.sampling.messages import PICTURES
from calib_ros.sampling.slices import Part
from calib_ros.sampling.sources import Source

PERIOD = 2.0


def tour(count, seed=2):
    """Return a function of times (N,) [s]: an arm that stands for a second every other second."""
    return stops(0.5 * UR5E.random_joints(count, np.random.default_rng(seed)))


def heard(
    motion,
    seconds,
    rate=100.0,
    noise=0.0,
    hole=(0.0, 0.0),
    late=lambda times: 0.0,
    early=lambda times: 0.0,
    shaken=(0.0, 0.0),
    creep=0.0,
    twice=None,
    other=0.0,
    precise=1.0,
    **more,
):
    """Return a session that has heard joint states at a rate, with noise, and poses at 50 Hz.

    There are no joint states in the `hole` [s]; poses are stamped `late` and joint states `early`
    by functions of times (N,) [s]. The target vibrates for half of each second while it is
    `shaken` [s], and moves by `creep` [m/s] for the first second of each two. Joint states or
    poses come `twice`, the second time off by `other`; poses are `precise` times as exact as
    usual. `more` are settings.
    """
    rng = np.random.default_rng(3)
    times, measured = np.arange(0.0, seconds, 1.0 / rate), np.arange(0.003, seconds - 0.3, 0.02)
    times = times[(times < hole[0]) | (times >= hole[1])]
    if twice == 'joints':
        times = np.repeat(times, 2)
    elif twice == 'measurements':
        measured = np.repeat(measured, 2)
    joints = motion(times)
    joints = joints + rng.normal(scale=noise, size=joints.shape)
    seen = measure(TRUE, motion(measured), rng, 2e-5 / precise, 1e-4 / precise)
    swing = 2e-3 * np.exp(-(measured % 1.0) / 0.08) * np.sin(50.0 * measured)
    swing *= (measured >= shaken[0]) & (measured < shaken[1])
    swing += creep * np.minimum(measured % PERIOD, 1.0)
    positions = seen.positions + swing[:, np.newaxis]
    if twice:
        (joints if twice == 'joints' else positions)[1::2] += other
    made = CalibrationSession(UR5E, Settings(**more))
    known = times, stamps(times - early(times)), joints
    comes = measured + np.maximum(late(measured), 0.0)
    hear(made, known, (comes, stamps(measured + late(measured)), positions, seen.rotations))
    return made


def error(chain, motion, seconds):
    """Return the RMS error [mm] of an arm along a motion."""
    return 1e3 * rms(chain, TRUE, motion(np.linspace(0.0, seconds, 500)))


@pytest.mark.parametrize('rate', [10.0, 20.0, 100.0])
def test_slow_joint_states_cost_no_accuracy_at_stops(rate):
    """With a share of the moves beside a stop the arm was off by 0.06 mm at 10 Hz."""
    motion = tour(25)
    made = heard(motion, 49.5, rate)
    made.finish()
    assert len(made.samples) == 25
    assert error(made.identify().chain, motion, 49.0) < 0.006


def told(made):
    """Return the warnings of a session, which its status and its refusals hold as well."""
    for hint in made.hints:
        assert hint.status in made.status()
    assert made.warnings == tuple(hint.text for hint in made.hints)
    return made.warnings


@pytest.mark.parametrize(('rate', 'mode'), [(50.0, 'dwell'), (500.0, 'triggered')])
def test_joints_that_hardly_rest_within_still_are_told_and_what_to_set(rate, mode):
    motion, noise = tour(15), 3e-4 * np.array([1.0, 1.0, 2.0, 1.0, 1.0, 1.0])
    made = heard(motion, 29.5, rate, noise=noise, mode=mode)
    assert len(told(made)) == 1  # while it lasts already
    made.finish()
    assert made.samples == []
    (warning,) = told(made)
    with pytest.raises(InputError, match=re.escape(warning)):
        made.identify()
    words = r'hardly ever rest within still \(0.0005\), above all elbow.* set still to (\S+),'
    found = re.search(words, warning)
    still = float(found[1])
    assert still == pytest.approx(6 * 6e-4, rel=0.3)
    better = heard(motion, 29.5, rate, noise=noise, still=still)
    better.finish()
    assert (len(better.samples), told(better)) == (15, ())


@pytest.mark.parametrize(('since', 'before'), [(0.0, 0), (11.0, 6)])
def test_two_robots_on_one_topic_are_told_and_no_still_to_set(since, before):
    """Two arms of the same names in turn look like noise; the second one was not told of."""
    noise = np.where(np.arange(0.0, 29.5, 0.02) < since, 0.0, 0.3)
    made = heard(tour(15), 29.5, 50.0, noise=noise[:, np.newaxis])
    assert len(told(made)) == 1
    made.finish()
    assert len(made.samples) == before
    assert 'do two robots publish the same joint names?' in ''.join(told(made))


@pytest.mark.parametrize(
    ('motion', 'noise'),
    [
        (sweep(6, np.random.default_rng(5)), 3e-4),  # never stands
        (stops(UR5E.random_joints(60, np.random.default_rng(5)), 0.4, 0.1), 0.0),  # hardly
        (tour(15), 5e-5),  # is sampled
    ],
)
@pytest.mark.parametrize('rate', [10.0, 100.0])
def test_nothing_is_told_of_still_where_the_arm_moves_or_is_sampled(motion, noise, rate):
    made = heard(motion, 29.5, rate, noise=noise)
    made.finish()
    assert told(made) == ()


def test_joint_states_that_are_too_slow_are_told_and_the_rate_needed():
    made = heard(tour(15), 29.5, 8.0, early=lambda times: 0.02 * np.sin(7.0 * times**2))
    made.finish()
    (warning,) = told(made)
    assert re.match(r'\d{4} of 1460 measurements lie between joint states', warning)
    assert 'further apart than max_gap (0.1 s): 20 Hz or more of every joint are' in warning
    with pytest.raises(InputError, match=re.escape(warning)):
        made.identify()
    better = heard(tour(15), 29.5, 20.0)
    better.finish()
    assert told(better) == ()


def test_joint_stamps_of_whole_seconds_are_told_rather_than_rare_joint_states():
    (words,) = told(heard(tour(15), 29.5, early=lambda times: times % 1.0))
    assert words.endswith('joint states share stamps: two publishers, or stamps too coarse?')


@pytest.mark.parametrize('seconds', [3.0, 37.0])
def test_measurements_that_go_on_without_joint_states_are_told(seconds):
    made = heard(tour(15), 29.5, late=lambda times: seconds)
    found = re.match(
        r'measurements go on for (\d+) s without joint states: does the driver', *told(made)
    )
    assert int(found[1]) == pytest.approx(seconds, abs=0.5)
    assert f'{found[1]} s without joint states: does the driver run?' in made.status()
    assert 'Do the clocks agree?' in made.summary  # both zones of time look like this


@pytest.mark.parametrize(
    ('step', 'of', 'words'),
    [
        (-5.0, 'measurements', '5.0 s before'),
        (5.0, 'joints', '5.0 s before'),
        (-1.3, 'joints', '1.3 s after'),
        (-5.0, 'joints', '5.0 s after'),
        (-1e9, 'measurements', '1000000000.0 s before'),
        (-1e9, 'joints', '1000000000.0 s after'),
        (0.0, 'joints', ''),
    ],
)
def test_a_clock_that_goes_far_astray_is_told_at_once(step, of, words):
    """In the last 2 s of 40, however many were matched before, and after it was set right."""

    def moved(times):
        return np.where((times > 18.0) & (times < 20.0), step, 0.0)

    clocks = {'late': moved} if of == 'measurements' else {'early': lambda t: -moved(t)}
    made = heard(tour(25), 20.0, **clocks)
    warnings = told(made)
    assert ('or raise lateness' in made.status()) == ('before' in words)  # the device sends late
    assert told(heard(tour(25), 40.0, **clocks)) == warnings
    assert len(warnings) == bool(words)
    said = f'measurements were stamped {words} the newest joint state'
    assert all(said in each and 'synchronise the clocks' in each for each in warnings)


@pytest.mark.parametrize(('speed', 'stops_taken'), [(0.0, 15), (0.02, 0)])
def test_stops_at_which_the_target_still_moves_are_told(speed, stops_taken):
    """A device that smooths, an arm that creeps: the operator stood there for nothing."""
    made = heard(tour(15), 29.5, creep=speed)
    made.finish()
    assert len(made.samples) == stops_taken
    warnings = told(made)
    assert len(warnings) == (stops_taken == 0)
    for words in warnings:
        assert re.match(r'1[45] of 1[45] stops are refused: the target still moves', words)
        assert 'set settle' in words


@pytest.mark.parametrize(
    ('share', 'count', 'off', 'cause'),
    [(0.05, 0, 0, ''), (0.2, 1, 0, r'zero stamp \(fill header'), (0.2, 1, -S, 'negative stamp')],
)
def test_much_that_is_dropped_is_told_and_why(share, count, off, cause):
    """A driver that does not always fill its stamps loses accuracy, and the operator time."""
    made, rng = session(), np.random.default_rng(4)
    stamp = np.where(rng.random(500) < share, off, START + np.arange(500) * S // 50)
    take(made, *((TRACKER, POSE, pose(each, np.ones(3), np.eye(3))) for each in stamp.tolist()))
    take(made, of_joints(joint_state(START, UR5E.joint_names, [0.0] * 6)))
    found = told(made)
    assert len(found) == count
    if count:
        assert re.match(rf'\d\d % of the measurements were dropped: {cause}', found[0])


@pytest.mark.parametrize(('names', 'lost'), [(('left', 'right'), False), (UR5E.joint_names, True)])
def test_messages_of_other_joints_are_no_loss(names, lost):
    """As of a gripper whose driver fills no stamps, on the topic of the arm."""
    made, still = session(), np.zeros(len(names)).tolist()
    stamp = START + np.arange(100) * S // 50
    take(made, *(of_joints(joint_state(t, UR5E.joint_names, [0.0] * 6)) for t in stamp.tolist()))
    take(made, *(of_joints(joint_state(0, names, still)) for _ in range(50)))
    reasons = [str(each) for each in too_much_lost(made.account(), 0.1)]
    assert len(reasons) == lost
    for words in reasons:
        assert '% of the joint states were dropped: zero stamp (fill header' in words
        assert 'or accept the rest with largest_loss (--largest-loss) 0.34' in words


def test_two_publishers_are_told_rather_than_what_comes_of_them():
    """Zeros with the stamps of the true joint values: some stops seem to move."""
    motion = tour(25)
    made = heard(motion, 49.5, twice='joints', other=-motion(np.arange(0.0, 49.5, 0.01)))
    made.finish()
    assert made.account().dropped['measurements: a stop with more spread than noise'] > 100
    (warning,) = told(made)
    assert 'two publishers' in warning


@pytest.mark.parametrize(
    ('of', 'other', 'count'),
    [
        ('measurements', 1e-3, 1),  # two targets on one topic, or stamps of whole seconds
        ('measurements', 0.0, 0),  # what a relay repeats
        ('joints', 1e-3, 1),
        ('joints', 1e-8, 0),  # and rounds
    ],
)
def test_other_values_with_the_same_stamp_are_told(of, other, count):
    made = heard(tour(15), 29.5, twice=of, other=other, precise=1e9)
    made.finish()
    kind, warnings = 'joint states' if of == 'joints' else of, told(made)
    assert len(warnings) == count
    for words in warnings:
        assert re.match(rf'[45]\d % of the {kind} were dropped: different values with ', words)


def test_images_that_come_twice_are_no_loss():
    """As of a camera whose images are published raw and compressed: each has its own number."""
    motion, camera = tour(5), Source('image', PICTURES[0], board='board.yaml')
    times, seen = np.arange(0.0, 9.5, 0.01), np.repeat(np.arange(0.003, 9.2, 0.05), 2)
    named = ('', *UR5E.joint_names), stamps(times), motion(times)
    images = ('camera',), stamps(seen), 1.0 + np.arange(float(len(seen)))[:, np.newaxis]
    places = np.argsort(np.argsort(np.concatenate([times, seen]), kind='stable'))
    first, second = np.split(places, [len(times)])
    made = CalibrationSession(UR5E)
    made.take([Part(first, None, *named), Part(second, camera, *images)])
    made.finish()
    account = made.account()
    assert account.unused['measurements: same stamp twice'] == len(seen) // 2
    assert not any('different values' in cause for cause in account.dropped)


@pytest.mark.parametrize(('pause', 'count'), [(2.0, 0), (4.0, 1)])
def test_of_a_pause_in_the_joint_states_a_tenth_must_have_been_measured(pause, count):
    made = heard(tour(15), 29.5, hole=(10.0, 10.0 + pause))
    made.finish()
    assert len(told(made)) == count


@pytest.mark.parametrize(
    ('mode', 'step'), [('dwell', 0.15), ('dwell', -0.4), ('continuous', -0.15)]
)
def test_a_clock_that_is_moved_is_told_with_the_sample(step, mode):
    seconds = 79.0
    made = heard(
        tour(40), seconds, late=lambda times: np.where(times > 30.0, step, 0.0), mode=mode
    )
    made.finish()
    (warning,) = told(made)
    found = re.search(r'by ([+-]\d\.\d+) s after about (\d+) poses', warning)
    assert float(found[1]) == pytest.approx(step, abs=0.01)
    stamps_ns = np.array([sample.stamp_ns for sample in made.samples])
    before = int((stamps_ns < START + 30 * S).sum())
    if mode == 'dwell':
        assert int(found[2]) - before in (0, 1)
    else:
        assert before - 15 * 50 <= int(found[2]) <= before


@pytest.mark.parametrize('mode', ['dwell', 'continuous'])
def test_clocks_that_agree_all_the_time_are_not_told_of(mode):
    """Measurements that vibrate at some stops, or a target that slips, move no clock."""
    made = heard(tour(40), 79.0, shaken=(30.0, 50.0), mode=mode)
    made.finish()
    assert told(made) == ()
    if mode == 'dwell':
        assert made.account().dropped['measurements: still vibrating, or a spike'] > 10


def back_and_forth(times):
    """Return joints that go to and fro between two places, 0.4 s each way, and rest 0.3 s."""
    ends = 0.5 * UR5E.random_joints(2, np.random.default_rng(0))
    return stops(np.tile(ends, (100, 1)), 0.4, 0.3)(times)


def test_a_delay_left_open_that_may_be_none_is_not_told_of_stops():
    made = heard(back_and_forth, 20.0)
    assert made.delay is None
    assert told(made) == ()


@pytest.mark.parametrize(
    ('mode', 'seconds', 'late', 'said'),
    [
        ('dwell', 20.0, 0.3, r'-1\.10 or -0\.40 or 0\.30 or 1\.00'),
        ('continuous', 20.0, 0.0, r'-0\.70 or 0\.00 or 0\.70'),
        ('continuous', 10.0, 0.0, r'-0\.70 or 0\.00 or 0\.70'),  # before clocks are looked at
    ],
)
def test_a_delay_that_periodic_motion_leaves_open_is_told_and_not_applied(
    mode, seconds, late, said
):
    made = heard(back_and_forth, seconds, mode=mode, late=lambda times: late)
    (warning,) = told(made)
    assert re.search(rf'is ambiguous \({said} s\) because the motion repeats itself', warning)
    made.finish()
    assert made.delay is None
    assert {sample.delay for sample in made.samples} <= {0.0}
    assert told(made) == (warning,)
    known = heard(back_and_forth, 20.0, mode=mode, delay=1e-4)
    assert told(known) == ()


def test_a_delay_left_open_is_found_when_the_motion_is_less_regular():
    def motion(times):
        later = np.asarray(times) > 20.0
        return np.where(later[:, np.newaxis], tour(60)(times), back_and_forth(times))

    made = heard(motion, 60.0, late=lambda times: 0.15)
    made.finish()
    (warning,) = told(made)
    assert re.search(r'0\.1[45]\d s later', warning)


def test_clocks_of_two_devices_are_watched_as_of_one():
    """What one device sees lies elsewhere for the other: between them nothing moves."""
    motion, rng = tour(15), np.random.default_rng(3)
    times = np.arange(0.0, 29.5, 0.01)
    come = [(times, None, ('', *UR5E.joint_names), stamps(times), motion(times))]
    for k, device in enumerate(('', 'B')):
        seen = np.arange(0.003 + 0.01 * k, 29.2, 0.02)
        found = measure(replace(TRUE, base=random_frame(rng, 1.0)), motion(seen), rng, 2e-5, 1e-4)
        rows = np.hstack([found.positions, se3.to_quat(found.rotations)])
        source = Source(f'tracker{device}', device=device)
        come.append((seen + 0.3, source, ('tracker',), stamps(seen + 0.3), rows))
    order = np.argsort(np.concatenate([each for each, *_ in come]), kind='stable')
    places = np.split(np.argsort(order), np.cumsum([len(each) for each, *_ in come])[:-1])
    made = CalibrationSession(UR5E)
    made.take([Part(place, *part) for place, (_, *part) in zip(places, come, strict=True)])
    (warning,) = told(made)
    assert re.search(r'0\.[23]\d\d s later', warning)
