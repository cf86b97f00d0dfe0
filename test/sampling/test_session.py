# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import itertools
from dataclasses import replace

import numpy as np
import pytest
from sessions import TRUE, UR5E, drive, samples, session, tracker
from streams import POSE, TRACKER, joint_state, of_joints, pose, stamps, stops, take

from calib_ros.apply.judgement import judge
from calib_ros.apply.simulation import random_frame
from calib_ros.errors import InputError
from calib_ros.identification.calibration import Calibration, parse_calibration
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.report.words import verdict_in_words
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.slices import NO_ACCIDENT
from calib_ros.sampling.sources import Source
from calib_ros.settings import Settings

LEFT_OUT = 'poses left out, in another frame or of a target measured once'

# Samples


def test_samples_are_told_of_as_they_are_taken():
    heard = []
    made = CalibrationSession(UR5E, on_sample=heard.append)
    drive(made, 4, [tracker()])
    assert 2 <= len(heard) <= 3
    made.finish()
    assert made.samples == heard
    assert len(heard) == 4


def test_hardly_any_stop_is_told_unless_poses_are_known():
    """Of stops too short but for one the answer was to measure 30 or more."""
    made = session(shortest_stop=1.0)
    drive(made, 5, [tracker()])
    made.restore(samples(2))
    assert 'hardly any at a stop' in made.last_hints[0].status
    made.restore(samples(2, start=2))
    assert made.last_hints == []


def test_restored_samples_come_first_and_are_as_good_as_new():
    made = session(samples(15), samples(15, seed=6, start=100))
    whole = session(samples(15, seed=6, start=100))
    whole.restore(samples(15))
    assert [each.stamp_ns for each in whole.samples] == [each.stamp_ns for each in made.samples]
    first, second = made.identify(), whole.identify()
    for one, other in zip(first.parameters, second.parameters, strict=True):
        assert one == other


def test_poses_that_only_judge_are_told_to_be_no_fit():
    """Of a tracker on validation_pose it said only: 0 poses to fit and 12 held out."""
    made = CalibrationSession(UR5E)
    made.restore([replace(each, validation=True) for each in samples(12)])
    take(made, (TRACKER, POSE, pose(5, np.full(3, np.nan))))
    said = 'all 12 came on topics for validation, measure on others too; .*dropped: 1 x measurem'
    with pytest.raises(InputError, match=said):  # why others gave none
        made.problem()


@pytest.mark.parametrize(
    ('until', 'answer', 'kept'),
    [(0.8, (0, 'no measurement within this stop'), 1), (1.6, (1, ''), 2)],
)
def test_a_capture_counts_no_pose_of_an_earlier_stop(until, answer, kept):
    """Which only it has ended; the tracker loses the target `until` then."""
    made = CalibrationSession(UR5E)
    motion = stops(UR5E.random_joints(2, np.random.default_rng(1)), 0.3, 0.8)
    source, kind, seen = tracker()
    times = np.arange(0.0, 1.6, 0.02)
    for time, stamp, row in zip(times, stamps(times).tolist(), motion(times), strict=True):
        take(made, of_joints(joint_state(stamp, UR5E.joint_names, row.tolist())))
        if time < until:
            take(made, (source, kind, seen(stamp, row)))
    assert made.samples == []
    assert made.capture() == answer
    assert len(made.samples) == kept


def renamed(tracked, frames):
    """Return a source whose measurements by their number are in other frames."""
    source, kind, seen = tracked
    counter = itertools.count()

    def make(stamp, row):
        message = seen(stamp, row)
        message.header.frame_id = frames.get(next(counter), message.header.frame_id)
        return message

    return source, kind, make


def test_measurements_with_and_without_a_frame_are_told():
    made = CalibrationSession(UR5E)
    drive(made, 6, [renamed(tracker(), dict.fromkeys(range(0, 10**4, 2), ''))])
    with pytest.raises(InputError, match=r'different frames \(one without name, tracker\)'):
        made.problem()


def test_a_leading_slash_makes_no_other_frame():
    """As older programs write it; tf and RViz refuse it."""
    made = CalibrationSession(UR5E, Settings(frame_id='/tracker'))
    drive(made, 5, [renamed(tracker(), dict.fromkeys(range(0, 10**4, 2), '/tracker'))])
    made.finish()
    assert made.problem().world_frame == 'tracker'
    assert len(made.samples) == 5


def test_a_frame_id_that_was_set_right_is_no_longer_told_as_wrong():
    made = CalibrationSession(UR5E, Settings(frame_id='elsewhere'))
    drive(made, 4, [tracker()])
    assert 'refused, in frame "tracker", not in frame_id "elsewhere"' in made.status()
    made.change(replace(made.settings, sigma_position=1e-4))
    assert 'measurements are refused' in made.status()
    made.change(replace(made.settings, frame_id='/tracker'))
    assert 'measurements are refused' not in made.status()


@pytest.mark.parametrize('where', [0, 100])
def test_a_stray_frame_is_counted_and_the_others_are_identified(where):
    """Also of the first measurement, which would make a sample of its own."""
    made = CalibrationSession(UR5E)
    drive(made, 16, [renamed(tracker(), {where: 'stray'})])
    made.finish()
    if where:  # the first comes in the time in which the arm has just stopped
        dropped = made.account().dropped
        assert dropped['measurements: in frame "stray", not in "tracker" like the others'] == 1
    assert 'different frames' not in made.status()
    assert made.identify().accepted
    assert made.problem().world_frame == 'tracker'
    assert {sample.frame_id for sample in made.samples} == {'tracker'}
    assert len(made.samples) == 16


def test_a_sample_in_a_stray_frame_is_left_out_when_the_usual_one_is_known():
    """One measurement for each stop: that in another frame is a sample, too."""
    made, given = session(), samples(30, frame_id='tracker')
    stray = replace(given[0], frame_id='stray')
    made.restore([stray, *given[1:5]])
    with pytest.raises(InputError, match=r'different frames \(stray, tracker\)'):
        made.problem()  # one of five may be right
    made.restore(given[5:])
    assert len(made.problem().observations) == 29
    assert made.account().notes == {LEFT_OUT: 1}
    assert made.identify().accepted


@pytest.mark.parametrize('first', ['odom', ''])
def test_a_device_that_renames_its_frame_is_told(first):
    """As a driver once it has started: the few poses before that were identified unasked."""
    made = CalibrationSession(UR5E)
    drive(made, 6, [renamed(tracker(), dict.fromkeys(range(NO_ACCIDENT), first))])
    dropped = made.account().dropped
    cause = f'measurements: in frame "tracker", not in "{first}" like the others'
    assert dropped[cause] > made.account().poses // 2
    said = f'different frames ({first or "one without name"}, tracker): set frame_id'
    assert said in made.status()
    with pytest.raises(InputError, match=r'different frames .*: set frame_id'):
        made.problem()
    assert {sample.frame_id for sample in made.usable} == {first}


def test_poses_of_another_frame_can_be_removed():
    made = session(samples(30, frame_id='left'), samples(5, seed=6, start=100, frame_id='right'))
    assert 'different frames (left, right)' in made.status()
    for _ in range(5):
        made.remove_last()
    assert 'different frames' not in made.status()
    assert made.identify().accepted


def test_frame_id_helps_at_once_when_frames_differ():
    made = session(samples(30, frame_id='left'), samples(20, seed=6, start=100, frame_id='right'))
    with pytest.raises(InputError, match='set frame_id'):
        made.identify()
    assert len(made.samples) == 50
    made.change(replace(made.settings, frame_id='right'))
    assert made.identify().accepted
    assert made.problem().world_frame == 'right'
    assert sum(len(each) for each in made.problem().sets) == 20
    made.change(replace(made.settings, frame_id='left'))
    assert sum(len(each) for each in made.problem().sets) == 30
    assert len(made.samples) == 50


def test_a_frame_id_in_which_nothing_is_measured_is_told_at_once():
    """It was mistyped, in the last session or now, and leaves no pose to use."""
    begun = session(samples(5, frame_id='left'), frame_id='lefd')
    with pytest.raises(InputError, match=r'other than frame_id "lefd" \(left\)'):
        begun.problem()
    begun.change(replace(begun.settings, frame_id='left'))
    assert 'frame_id' not in begun.status()
    begun.change(replace(begun.settings, frame_id='none'))
    assert 'other than frame_id "none" (left): set frame_id' in begun.status()
    assert begun.doubtful
    assert begun.account().notes == {LEFT_OUT: 5}


@pytest.mark.parametrize('late', [False, True])
def test_frame_id_chooses_among_the_frames_of_a_device_that_has_it(late):
    """Another device may have a frame of its own."""
    first = samples(20, device='left', frame_id='a')
    second = samples(20, seed=6, start=100, device='right', frame_id='b')
    moved = samples(20, seed=7, start=200, device='right', frame_id='c')
    made = session(*((second, moved, first) if late else (first, second, moved)), frame_id='b')
    assert [sample.frame_id for sample in made.usable].count('a') == 20
    assert [sample.frame_id for sample in made.usable].count('b') == 20
    assert len(made.usable) == 40
    made.change(replace(made.settings, frame_id=''))
    with pytest.raises(InputError, match=r'different frames \(b, c\)'):
        made.problem()


def test_a_stop_elsewhere_at_the_stamps_of_another_is_a_sample_too():
    """A simulation began again, and its clock with it."""
    made, twice = session(), UR5E.random_joints(10, np.random.default_rng(7))
    for configurations in (*np.split(twice, 2), twice[:5], twice[5:]):
        drive(made, configurations, [tracker()])
    made.finish()
    assert len(made.samples) == len({sample.stamp_ns for sample in made.samples}) == 10
    later = session(made.samples)
    drive(later, twice[5:], [tracker()])
    later.finish()
    assert len(later.samples) == 10


def test_stops_at_which_nothing_is_measured_are_told():
    """As of a target that is lost, or of a frame with another name from now on."""
    made = session()
    words = 'no measurements at the last 5 stops: does the device see the target?'
    start = 0.0
    for count, seen in ((3, True), (6, False), (3, True)):
        start += drive(made, count, [tracker()] if seen else [], start=start)
        assert (words in made.status()) is not seen
    made.finish()
    assert len(made.samples) == 6


def test_targets_that_were_measured_once_are_left_out():
    """Each would bring six parameters and tell nothing about the arm."""
    good = samples(20, target='ball')
    junk = [
        each for k in range(300) for each in samples(1, seed=k, start=100 + k, target=f'junk {k}')
    ]
    made = session(junk[:150], good, junk[150:])
    assert [len(each) for each in made.problem().sets] == [20]
    assert '; 20 poses' in made.status()
    assert made.identify().accepted
    assert made.account().notes[LEFT_OUT] == 300
    made.restore(samples(1, seed=0, start=1000, target='junk 0'))  # seen again
    assert len(made.problem().sets) == 2
    assert made.estimate is not None
    assert session(samples(1, target='one')).problem().sets  # the only ones are better than none


def test_frames_without_end_are_not_remembered():
    made = session()
    drive(made, 1, [])
    for k in range(60):
        message = pose(k + 1, np.zeros(3), np.eye(3))
        message.header.frame_id = f'frame {k}' if k else 'line\nbreak'
        take(made, (TRACKER, POSE, message))
    dropped = made.account().dropped
    assert dropped['measurements: in a frame whose name cannot be printed'] == 1
    assert dropped['measurements: in one of more than 50 frames'] == 9


def test_frames_without_end_are_not_told_each():
    """With frame_id each of them was a cause of its own, in the diagnostics of each second."""
    made = CalibrationSession(UR5E, Settings(frame_id='cell'))
    for k in range(60):
        message = pose(k + 1, np.zeros(3), np.eye(3))
        message.header.frame_id = f'frame {k}'
        take(made, (TRACKER, POSE, message))
    dropped = made.account().dropped
    assert dropped['measurements: in frame "frame 49", not in frame_id "cell"'] == 1
    assert dropped['measurements: in frame "...", not in frame_id "cell"'] == 10
    assert len(dropped) == 51


def test_samples_of_another_robot_are_not_restored():
    made = session(samples())
    with pytest.raises(InputError, match='have 7 joint values, chain "ur5e" has 6 joints'):
        made.restore([Sample(1, np.zeros(7), position=np.zeros(3))])
    assert len(made.samples) == 30


def test_clear_forgets_samples_and_counts_but_not_the_calibration():
    made = session(samples())
    drive(made, 2, [tracker()])
    made.finish()
    result = made.identify()
    assert result.accepted
    made.clear()
    assert made.samples == []
    assert made.account() == CalibrationSession(UR5E).account()
    assert made.calibration.chain is result.chain


# Sources


def test_the_world_is_the_frame_of_the_base():
    """Of two devices the one whose sample came first, and not the one that was heard first."""
    made, every = session(), dict.fromkeys(range(1000), 'other')
    elsewhere = renamed((Source('a', device='A'), *tracker()[1:]), every)
    drive(made, 3, [elsewhere, tracker()])
    frames = [(each.device, each.frame_id) for each in made.samples[:2]]
    assert frames == [('', 'tracker'), ('A', 'other')]
    assert [each.base for each in made.problem().sets] == ['base', 'base_A']
    assert made.problem().world_frame == 'tracker'


# Judging


def judged(made):
    """Return the errors of the nominal and the calibrated arm since, as ~/validate takes them."""
    calibration, sets = made.since()
    return judge(calibration, sets).comparison


@pytest.mark.parametrize('first', [0, 1])
def test_later_samples_are_judged_in_the_frames_of_their_targets(first):
    """Whichever target is seen first, or alone, and by a file that knows whose its frames are."""
    rng = np.random.default_rng(5)
    ball = replace(TRUE, tool=random_frame(rng, 0.2))
    sources = [tracker(), (Source('ball', target='ball'), *tracker(ball)[1:])]
    made = session(samples(), samples(seed=6, true=ball, start=100, target='ball'))
    result = made.identify()
    later = session()
    later.adopt(parse_calibration(made.calibration.dump(), 'c.yaml', UR5E))
    made.clear()
    drive(made, UR5E.random_joints(5, rng), sources[first : first + 1])
    expected = judged(made).figures
    later.restore(made.samples)
    nominal, now = judged(later).figures
    assert now.rms_mm < 0.15 < 0.5 < nominal.rms_mm
    assert (now.rms_mm, nominal.rms_mm) == pytest.approx([each.rms_mm for each in expected[::-1]])
    drive(made, UR5E.random_joints(5, rng), sources)
    nominal, now = judged(made).figures
    assert now.count > 5
    assert now.rms_mm < 0.15 < 0.5 < nominal.rms_mm
    assert made.calibration.chain is result.chain


def test_samples_that_were_fitted_are_known_again():
    """As where a recording is played once more to a node that loaded what came of it."""
    made = session(samples())
    made.identify()
    made.adopt(parse_calibration(made.calibration.dump(), 'file'), ())
    calibration, sets = made.since()
    found = judge(calibration, sets)
    assert (found.verdict, found.reused) == ('no verdict', 1.0)
    assert 'the calibration was fitted to these measurements' in verdict_in_words(found)


def test_what_was_there_before_does_not_judge():
    """Neither samples before the calibration, nor those of an earlier session."""
    made = session(samples(30))
    made.identify()
    made.remove_last()
    drive(made, 4, [tracker()])
    _, now = judged(made).figures
    assert now.count == 4
    assert made.recent()[1].of_messages  # so that advice names topics, not columns


def test_the_calibration_of_another_robot_is_refused():
    made = session(samples())
    panda = load_chain('franka_panda')
    with pytest.raises(
        InputError, match=r'panda_joint7 \(revolute\); the robot has shoulder_pan_joint'
    ):
        made.adopt(Calibration(panda, panda))
    assert made.calibration is None


def test_samples_on_a_target_that_the_calibration_does_not_know_are_no_judges():
    made = session(samples())
    made.identify()
    drive(made, 3, [(Source('x', target='new'), *tracker()[1:])])
    with pytest.raises(InputError, match='unknown to the cal'):
        made.since()
