# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
from recorded import pose_with_covariance
from sessions import SIGMAS, UR5E, drive, samples, session, tracker
from streams import POSE, START, TRACKER, joint_state, of_joints, pose, stamps, stops, take

from calib_ros.errors import InputError
from calib_ros.sampling.sample_hints import of_two_places
from calib_ros.sampling.session import CalibrationSession
from calib_ros.settings import Settings
from calib_ros.values import MOST_NAMES

# Settings and words


def test_the_way_of_a_stop_can_be_changed_while_it_runs():
    made = CalibrationSession(UR5E, Settings(**SIGMAS))
    where = UR5E.random_joints(3, np.random.default_rng(1))
    end = drive(made, where, [tracker()])
    made.finish()
    made.change(replace(made.settings, shortest_stop=2.0))
    drive(made, where + 0.1, [tracker()], start=end)
    made.finish()
    assert len(made.samples) == 3
    assert made.account().unused['measurements: the stop was too short'] == 79


@pytest.mark.parametrize(('spread', 'size', 'told'), [(0.02, 1, 1), (0.005, 1, 0), (0.05, 1e3, 0)])
def test_measurements_of_two_places_are_told(spread, size, told):
    """Two devices on one topic were averaged and accepted, half their distance away."""
    given = [replace(s, spread=spread, position=size * s.position) for s in samples(15)]
    made = session([*given[:4], *(replace(each, spread=0.0) for each in given[4:])])
    assert 'two devices' not in made.status()  # of some an accident
    assert not of_two_places(6 * [spread], 6.0)  # of a usual share, too
    made = session(given)
    assert ('stops scatter by 20 mm: do two devices or targets' in made.status()) == told
    assert made.doubtful or not told
    assert len(made.warnings) == told


@pytest.mark.parametrize(
    ('apart', 'noise', 'count', 'burst', 'told'),
    [
        *[(1e-3, 0.0, 15, 1, '0.3'), (2e-2, 1e-3, 15, 1, '5.8'), (0.3, 0.0, 6, 1, '87')],
        *[(1e-4, 0.0, 15, 1, ''), (2e-3, 5e-4, 15, 1, '')],
        *[(0.3, 0.0, 15, 5, '120'), (0.3, 0.0, 15, 8, '120')],
    ],
)
def test_two_devices_are_told_by_their_turns(apart, noise, count, burst, told):
    """Close together they were averaged and accepted; far apart or in bursts, stops that shake."""
    made, rng, turns = CalibrationSession(UR5E), np.random.default_rng(7), itertools.count()
    *source, seen = tracker()

    def message(stamp, row):
        found = seen(stamp, row)
        where, shift = found.pose.position, rng.normal(scale=noise, size=3)
        second = next(turns) // burst % 2 and stamp < START + round(1.6e9 * count)
        where.x, where.y = where.x + shift[0], where.y + shift[1]
        where.z += shift[2] + second * apart
        return found

    drive(made, 15, [(*source, message)])
    made.finish()
    assert len(made.samples) == (15 if apart < 0.1 else 15 - count)
    assert ('two devices or targets' in made.status()) == bool(told)
    assert f'measurements at {count} stops scatter by {told} mm' in made.summary or not told


def test_the_status_tells_how_far_it_is():
    made = session(samples(6))
    assert made.status().startswith('waiting for joint states; 6 poses, ')
    assert 'too few to predict how many are needed' in made.status()
    assert 'more' not in made.status()
    made.change(replace(made.settings, wanted_accuracy=0.05))  # that is what priors say
    assert 'too few to predict how many are needed' in made.status()
    made.restore(samples(60, start=100))
    assert 'mm expected' in made.status()
    made.change(replace(made.settings, wanted_accuracy=1e-2))
    assert 'enough for the accuracy wanted' in made.status()
    made.change(replace(made.settings, wanted_accuracy=2e-6))
    assert 'more for 0.002 mm' in made.status()
    made.change(replace(made.settings, wanted_accuracy=1e-8))  # or positions in mm
    assert made.status().endswith(
        'expected, 1e-05 mm is out of reach: are units, sigmas and wanted_accuracy right?'
    )


@pytest.mark.parametrize(
    ('model', 'advice'),
    [('geometric', 'set model to auto, more'), ('ratio', 'is the target firm? More')],
)
def test_no_forecast_where_what_is_left_is_not_noise(rng, model, advice):
    """Errors that the model lacks do not average out."""
    given = [
        replace(each, position=each.position + 1e-3 * np.sin(7.0 * each.joints[:3]))
        for each in samples(60)
    ]
    made = session(given, loss='none', model=model)
    assert re.search(rf'{re.escape(advice)} will not help: what is left is 1\d x', made.status())
    assert ' more for ' not in made.status()
    made.change(replace(made.settings, sigma_position=1e-3))  # it is the noise of the device
    assert 'more for 0.1 mm' in made.status()
    as_noisy = session([replace(each, spread=1e-3) for each in given], loss='none', model=model)
    assert 'more for 0.1 mm' in as_noisy.status()


def test_no_accuracy_is_expected_of_positions_in_millimetres():
    made = session([replace(each, position=1e3 * each.position) for each in samples(15)])
    assert re.search(r'15 poses, \d+ mm from where the joints are: check units', made.status())
    assert made.doubtful
    assert 'expected' not in made.status()


def test_positions_in_millimetres_are_told_however_few_they_are():
    """ "2717202 mm expected": they were explained by lengths of which no arm is."""
    made = session([replace(each, position=1e3 * each.position) for each in samples(6)])
    assert '6 poses, which do not fit this arm: check units, clocks, sigmas' in made.status()
    assert made.doubtful
    assert 'expected' not in made.status()
    assert 'expected' in session(samples(6)).status()


def test_the_status_tells_of_measurements_only_between_the_stops():
    """By half a second apart, the clocks left each stop without a measurement, in silence."""
    made, motion = session(), stops(UR5E.random_joints(8, np.random.default_rng(1)))
    source, kind, measured = tracker()
    come = []
    for time in np.arange(0.0, 15.0, 0.04).tolist():
        (stamp,), (row,) = stamps(np.array([time])).tolist(), motion([time])
        come.append(of_joints(joint_state(stamp, UR5E.joint_names, row.tolist())))
        if 1.3 < time % 2.0 < 1.7:
            come.append((source, kind, measured(stamp, row)))
    take(made, *come)
    assert 'between the stops, none at one: do the clocks agree?' in made.status()


@pytest.mark.parametrize('moves', [True, False])
def test_a_motion_without_stops_is_told_of_mode_continuous(moves):
    """It was 'too few poses, measure 30 or more', of a recording that calibrates as it is."""
    made = session()
    motion = stops(UR5E.random_joints(8, np.random.default_rng(1)), move=12.0 if moves else 1.0)
    source, kind, measured = tracker()
    for time in np.arange(0.0, 14.0, 0.04).tolist():
        (stamp,), (row,) = stamps(np.array([time])).tolist(), motion([time])
        state = of_joints(joint_state(stamp, UR5E.joint_names, row.tolist()))
        take(made, state, (source, kind, measured(stamp, row)))
    made.finish()
    assert ('set mode to continuous (--mode continuous)' in made.summary) == moves


@pytest.mark.parametrize(('given', 'long'), [({}, '1 s'), ({'settle': 1.5}, '1.7 s')])
def test_the_status_says_what_is_needed_until_the_arm_has_stopped(given, long):
    """It was "the arm is moving; 0 poses", and of a call of ~/capture "no measurements"."""
    made = CalibrationSession(UR5E, Settings(**given))
    motion = stops(UR5E.random_joints(3, np.random.default_rng(1)), move=2.0, stand=3.0)
    source, kind, measured = tracker()

    def play(begin, end):
        for time in np.arange(begin, end, 0.04).tolist():
            (stamp,), (row,) = stamps(np.array([time])).tolist(), motion([time])
            state = of_joints(joint_state(stamp, UR5E.joint_names, row.tolist()))
            take(made, state, (source, kind, measured(stamp, row)))

    play(3.5, 4.5)
    assert made.status().startswith(f'the arm is moving: let it stand at each pose for {long}; ')
    assert 'the arm has not been still for 0.2 s yet' in made.capture()[1]
    play(4.5, 9.7)
    assert made.status().startswith('the arm is moving; 1 pose')


def test_joints_that_do_not_come_are_told_without_those_that_do():
    """The one that matters was behind the other names, where the status is cut."""
    names = [*UR5E.joint_names[:5], 'tool0']
    said = 'waiting for joint states, set joint_names? Received tool0, not wrist_3_joint; '
    assert named((names, [0.1] * 6)).status().startswith(said)
    some = named((UR5E.joint_names[:5], [0.1] * 5)).status()
    assert some.startswith('waiting for joint states of wrist_3_joint; ')


def test_the_status_names_a_sample_that_does_not_fit():
    given = samples(50)
    made = session(given[:45])
    assert 'does not fit' not in made.status()
    made.samples.append(replace(given[45], position=given[45].position + 0.01))
    assert 'pose 46 does not fit the others' in made.status()
    made.remove_last()
    assert 'does not fit' not in made.status()


def test_the_status_names_joints_that_hardly_moved():
    given = samples(10)
    joints = [np.array([*each.joints[:5], 0.01 * k]) for k, each in enumerate(given)]
    made = session([replace(each, joints=q) for each, q in zip(given, joints, strict=True)])
    assert 'hardly moved so far: wrist_3_joint' in made.status()


def test_the_status_names_joints_of_which_nothing_is_heard_any_more():
    """Of two drivers that each name some joints one has died."""
    made = session()
    come = []
    for k in range(200):
        stamp = 1_700_000_000_000_000_000 + k * 50_000_000
        come.append(of_joints(joint_state(stamp, UR5E.joint_names[:4], [0.0] * 4)))
        if k < 50:
            come.append(of_joints(joint_state(stamp, UR5E.joint_names[4:], [0.0] * 2)))
    take(made, *come[:110])
    assert 'the arm stands' in made.status()
    take(made, *come[110:])
    assert made.status().startswith(
        'nothing can be sampled: no more joint states of wrist_2_joint, wrist_3_joint'
    )
    assert made.status().count('wrist_2_joint') == 1
    assert made.doubtful
    made.finish()  # a bag has no status
    assert 'no more joint states of wrist_2_joint, wrist_3_joint: does' in made.summary


@pytest.mark.parametrize(
    ('stamp', 'value', 'cause'),
    [
        (10**18, np.nan, 'NaN or infinite joint value (shoulder_pan_joint)'),
        (0, 0.1, 'zero stamp (fill header.stamp where it is published)'),
    ],
)
def test_the_status_tells_why_no_joint_state_is_used(stamp, value, cause):
    made = session()
    refused = of_joints(joint_state(stamp, UR5E.joint_names, [value] * 6))
    said = f'nothing can be sampled: joint states are refused, {cause}'
    take(made, *[refused] * 50)
    assert made.status().startswith(said)
    assert made.capture() == (0, said)
    good = [joint_state(10**18 + k, UR5E.joint_names, [0.1] * 6) for k in range(3)]
    take(made, refused, *map(of_joints, good))
    assert 'refused' not in made.status()
    take(made, refused)  # a driver may fail later
    assert made.status().startswith(said)


def test_joint_states_without_positions_are_those_of_others_if_the_arm_sends_some():
    """A gripper's, or an estimate of efforts, kept the diagnostics at WARN."""
    gripper, efforts = (['finger'], []), (UR5E.joint_names, [])
    made = named(gripper, efforts, (UR5E.joint_names, [0.1] * 6), gripper, efforts)
    assert not made.doubtful
    assert made.account().dropped == {}
    made = named(gripper, *[(UR5E.joint_names[:3], [0.1] * 3), (UR5E.joint_names[3:], [])] * 2)
    assert made.doubtful
    assert made.status().startswith(
        'waiting for joint states with positions: none came of wrist_1_joint, wrist_2_joint, '
    )
    assert 'refused, names and positions differ in number' in named(([], [0.1] * 6)).status()
    made = named((UR5E.joint_names, [0.1] * 6))  # and a driver may send none later
    take(made, of_joints(joint_state(10**18 + 6 * 10**9, *efforts)))
    assert 'joint states are refused, no positions in the message' in made.status()


def named(*messages):
    """Return a session that has heard joint states (names, values)."""
    made = session()
    stamps = range(10**18, 10**18 + 10**7 * len(messages), 10**7)
    take(
        made, *(of_joints(joint_state(t, *each)) for t, each in zip(stamps, messages, strict=True))
    )
    return made


def test_joints_by_other_names_are_doubtful():
    made = named((UR5E.joint_names, [0.1] * 6))
    assert not made.doubtful
    made = named(([f'r1_{name}' for name in UR5E.joint_names], [0.1] * 6))
    assert 'set joint_names?' in made.status()
    assert made.doubtful


def test_a_joint_that_is_named_twice_has_no_value():
    twice = (*UR5E.joint_names, UR5E.joint_names[0])
    made = named((twice, [0.1] * 6 + [0.2]))
    assert 'joint states are refused, a joint is named twice' in made.status()
    assert made.latest is None
    assert made.account().dropped == {'joints: a joint is named twice': 1}
    others = (*UR5E.joint_names, 'finger', 'finger')  # not ours to judge
    assert named((others, [0.1] * 8)).account().dropped == {}
    mixed = named((UR5E.joint_names, [0.1] * 6), (twice, [0.1] * 6 + [0.2]))
    assert 'refused' not in mixed.status()  # "nothing can be sampled" while poses came


def test_what_was_heard_is_remembered_however_the_names_are_arranged(rng):
    """More arrangements than are kept, the last of them without one joint."""
    orders = [rng.permutation(6) for _ in range(MOST_NAMES)] + [np.arange(5)]
    made = named(*(([UR5E.joint_names[k] for k in each], 0.1 * each) for each in orders))
    assert (made.account().never_named, made.account().foreign_names) == ((), ())


def test_names_that_are_empty_are_shown():
    assert 'Received "", not shoulder' in named(([''] * 6, [0.1] * 6)).status()


def test_a_joint_that_moves_but_is_not_in_the_chain_is_told():
    names = [*UR5E.joint_names, 'rail', 'finger', 'unknown']
    made = named(*((names, [0.1] * 6 + [0.01 * k, 0.3, np.nan]) for k in range(3)))
    assert made.account().notes == {'joint that moves but is not in the chain: rail': 1}
    take(made, of_joints(joint_state(2 * 10**18, ['finger'], [0.0])))
    (note,) = made.account().notes
    assert note.endswith('finger, rail')
    hands = [f'finger {k}' for k in range(40)]
    take(
        made,
        *(of_joints(joint_state(2 * 10**18 + 1 + k, hands, [0.1 * k] * 40)) for k in range(2)),
    )
    (note,) = made.account().notes
    assert note.endswith(' more')


def test_the_status_tells_that_nothing_is_recorded():
    """What the arm did before would stand there for hours, and be captured."""
    made = CalibrationSession(UR5E, Settings(**SIGMAS, mode='triggered'))
    drive(made, UR5E.random_joints(1, np.random.default_rng(1)), [tracker()])
    assert made.status().startswith('the arm stands for')
    made.recording = False
    assert made.status().startswith('not recording: call ~/record with true; 0 poses')
    assert made.capture() == (0, 'not recording: call ~/record with true')
    made.recording = True
    assert made.capture()[0] == 1


def test_the_status_tells_why_no_measurement_is_used():
    made = session()
    take(made, (TRACKER, POSE, pose(10**18, np.full(3, np.nan), np.eye(3))))
    assert 'measurements are refused, NaN or infinite position' in made.status()
    take(made, (TRACKER, POSE, pose(10**18, np.zeros(3), np.eye(3))))
    assert 'refused' not in made.status()
    kind = 'geometry_msgs/msg/PoseWithCovarianceStamped'
    skew = np.eye(6) + np.eye(6, k=1)
    come = enumerate([np.eye(6), skew, skew, -np.eye(6)])  # a device repeats its last one
    take(made, *((TRACKER, kind, pose_with_covariance(10**18 + k, each)) for k, each in come))
    dropped, unknown = made.account().dropped, '(leave it zero if it is not known)'
    for fault, count in (('not symmetric', 2), ('not positive definite', 1)):
        assert dropped[f'measurements: covariance {fault} {unknown}'] == count


def test_poses_that_do_not_follow_the_arm_are_told():
    good = samples(30)
    made = session(good[:8])
    assert not made.warnings
    still = {'position': np.full(3, 1e-16), 'rotation': np.eye(3)}
    made.restore([replace(each, **still) for each in good[8:]])
    assert '22 poses repeat a position: is the device frozen?' in made.status()
    assert made.hints[0].explains  # told before the move of the device that it looks like
    made.samples += good[8:]  # it is well again
    assert 'frozen' not in made.status()
    assert '22 poses repeat a position to the last digit, such as 0, 0, 0 m' in made.warnings[0]


def test_the_status_is_never_an_error():
    only_judging = session(samples(10, validation=True))
    assert '; 0 poses' in only_judging.status()
    (one,) = samples(1)
    same_place = session([replace(one, stamp_ns=k) for k in range(1, 20)])
    assert '; 19 poses' in same_place.status()
    assert '19 poses, 1 of them different' in str(same_place.account())
    assert '; 0 poses' in CalibrationSession(UR5E).status()
    assert CalibrationSession(UR5E).status('identifying') == (
        'waiting for joint states; identifying; 0 poses'
    )


def test_a_silent_device_is_told():
    """The status said only "0 poses"; a wrong topic is the most frequent first mistake."""
    made = CalibrationSession(UR5E, Settings())
    assert made.warnings[0].startswith('nothing was received: check joint_topics, sources, their')
    made.miss('measurements', 30, 'unusable')
    assert made.warnings[0].startswith('no joint states received: is the robot on, and its topic')
    made = CalibrationSession(UR5E, Settings())
    where = UR5E.random_joints(3, np.random.default_rng(1))
    drive(made, where, [])
    assert 'no measurements received: check sources' in made.status()
    (words,) = made.warnings
    with pytest.raises(InputError, match=re.escape(words)):
        made.identify()
    in_sockets = CalibrationSession(UR5E, Settings(mode='triggered'))
    assert in_sockets.warnings != ()
    drive(in_sockets, where, [])
    assert in_sockets.warnings == ()
    drive(made, where, [tracker()], start=20.0)
    made.finish()
    assert made.warnings == ()
