# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
from streams import (
    POSE,
    RANGE,
    TRACKER,
    TRANSFORM,
    distance,
    joint_state,
    of_joints,
    pose,
    stamps,
    stops,
    take,
    transform,
)

from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.errors import InputError
from calib_ros.identification.calibration import Calibration, parse_calibration
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.report.words import verdict
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.sources import Source
from calib_ros.settings import Settings

UR5E = load_chain('ur5e')
TRUE = faulty(UR5E, Cell(), np.random.default_rng(11))
NOISE = (5e-5, 2e-4)
SIGMAS = {'sigma_position': NOISE[0], 'sigma_orientation': NOISE[1]}


def samples(count=30, seed=5, true=TRUE, start=0, **more):
    rng = np.random.default_rng(seed)
    joints = UR5E.random_joints(count, rng)
    seen = measure(true, joints, rng, *NOISE)
    return [
        Sample(
            start + k + 1,
            joints[k],
            position=seen.positions[k],
            rotation=seen.rotations[k],
            **more,
        )
        for k in range(count)
    ]


def session(*given, **settings):
    made = CalibrationSession(UR5E, Settings(**SIGMAS | settings))
    made.restore([each for some in given for each in some])
    return made


def drive(made, configurations, sources, start=0.0, rate=25.0):
    """Let an arm stand at each configuration while sources (source, type, maker) measure."""
    motion = stops(configurations, 0.8, 0.8)
    end = 1.6 * len(configurations)
    times = np.arange(0.0, end, 1.0 / rate)
    rows = motion(times)
    come = []
    for row, stamp in zip(rows, stamps(times + start).tolist(), strict=True):
        come.append(of_joints(joint_state(stamp, UR5E.joint_names, row.tolist())))
        come += [(source, kind, make(stamp, row)) for source, kind, make in sources]
    take(made, *come)
    return end


def tracker(true=TRUE, seed=3):
    rng = np.random.default_rng(seed)

    def seen(stamp, row):
        found = measure(true, row[np.newaxis], rng, *NOISE)
        return pose(stamp, found.positions[0], found.rotations[0])

    return TRACKER, POSE, seen


# Samples


def test_samples_are_told_of_as_they_are_taken():
    heard = []
    made = CalibrationSession(UR5E, on_sample=heard.append)
    drive(made, UR5E.random_joints(4, np.random.default_rng(1)), [tracker()])
    assert 2 <= len(heard) <= 3
    made.finish()
    assert made.samples == heard
    assert len(heard) == 4


def test_restored_samples_come_first_and_are_as_good_as_new():
    made = session(samples(15), samples(15, seed=6, start=100))
    whole = session(samples(15, seed=6, start=100))
    whole.restore(samples(15))
    assert [each.stamp_ns for each in whole.samples] == [each.stamp_ns for each in made.samples]
    first, second = made.identify(), whole.identify()
    for one, other in zip(first.parameters, second.parameters, strict=True):
        assert one == other


def test_restored_samples_know_their_frame():
    made = session(samples(frame_id='world'))
    assert made.problem().world_frame == 'world'
    drive(made, UR5E.random_joints(2, np.random.default_rng(1)), [tracker()])  # in 'tracker'
    with pytest.raises(InputError, match=r'different frames \(tracker, world\)'):
        made.problem()


def renamed(tracked, frames):
    """Return a source whose measurements by their number are in other frames."""
    source, kind, seen = tracked
    counter = itertools.count()

    def make(stamp, row):
        message = seen(stamp, row)
        message.header.frame_id = frames.get(next(counter), message.header.frame_id)
        return message

    return source, kind, make


@pytest.mark.parametrize('where', [0, 10, 100])
def test_a_stray_frame_is_counted_and_the_others_are_identified(where):
    """Also of the first measurement, which would make a sample of its own."""
    configurations = UR5E.random_joints(16, np.random.default_rng(1))
    made, expected, removed = CalibrationSession(UR5E), CalibrationSession(UR5E), []
    made.on_removed = removed.append
    drive(made, configurations, [renamed(tracker(), {where: 'stray'})])
    drive(expected, configurations, [tracker()])
    made.finish()
    expected.finish()
    if where:  # the first comes in the time in which the arm has just stopped
        assert (
            made.account().dropped['measurements: in frame "stray", not in "tracker" as others']
            == 1
        )
    assert 'different frames' not in made.status()
    assert made.identify().accepted
    assert made.problem().world_frame == 'tracker'
    assert {sample.frame_id for sample in made.samples} == {'tracker'}
    assert not removed  # none had been made before the usual frame was known
    assert len(made.samples) == len(expected.samples)


def test_a_sample_in_a_stray_frame_goes_when_the_usual_one_is_known():
    """One measurement for each stop: that in another frame is a sample, and on the disk."""
    made, removed = session(), []
    made.on_removed = removed.append
    given = samples(30, frame_id='tracker')
    stray = replace(given[0], frame_id='stray')
    made.restore([stray, *given[1:5]])
    with pytest.raises(InputError, match=r'different frames \(stray, tracker\)'):
        made.problem()  # one of five may be right
    assert made.samples[0] is stray
    made.restore(given[5:])
    made.problem()
    assert removed == [stray]
    assert stray not in made.samples
    assert made.account().dropped == {
        'measurements: in frame "stray", not in "tracker" as others': 1
    }
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
    left_out = 'poses left out, in another frame or of a target measured once'
    assert made.account().notes[left_out] == 300
    made.restore(samples(1, seed=0, start=1000, target='junk 0'))  # seen again
    assert len(made.problem().sets) == 2
    assert made.estimate is not None
    assert session(samples(1, target='one')).problem().sets  # the only ones are better than none


def test_frames_without_end_are_not_remembered():
    made = session()
    drive(made, UR5E.random_joints(1, np.random.default_rng(1)), [])
    for k in range(60):
        message = pose(k + 1, np.zeros(3), np.eye(3))
        message.header.frame_id = f'frame {k}' if k else 'line\nbreak'
        take(made, (TRACKER, POSE, message))
    dropped = made.account().dropped
    assert dropped['measurements: in a frame whose name cannot be printed'] == 1
    assert dropped['measurements: in one of more than 50 frames'] == 9


def test_samples_of_another_robot_are_not_restored():
    made = session(samples())
    with pytest.raises(InputError, match='have 7 joint values, chain "ur5e" has 6 joints'):
        made.restore([Sample(1, np.zeros(7), position=np.zeros(3))])
    assert len(made.samples) == 30


def test_clear_forgets_samples_and_counts_but_not_the_calibration():
    made = CalibrationSession(UR5E, Settings(**SIGMAS))
    drive(made, UR5E.random_joints(30, np.random.default_rng(1)), [tracker()])
    made.finish()
    result = made.identify()
    assert result.accepted
    made.clear()
    assert made.samples == []
    assert made.account() == CalibrationSession(UR5E).account()
    assert made.calibration.chain is result.chain


# Sources


def test_devices_and_targets_have_frames_of_their_own():
    """Two markers of one tracker by their child frames, and a wire with an origin of its own."""
    rng = np.random.default_rng(7)
    ball = replace(TRUE, tool=random_frame(rng, 0.2))

    def marker(stamp, row):
        where = ball.forward(row[np.newaxis])[0]
        return transform(stamp, where[:3, 3], 'ball', where[:3, :3])

    def wire(stamp, row):
        return distance(stamp, np.linalg.norm(TRUE.forward(row[np.newaxis])[0, :3, 3]))

    made = CalibrationSession(UR5E, Settings(**SIGMAS))
    sources = [
        tracker(),
        (Source('marker'), TRANSFORM, marker),
        (Source('wire', device='wire'), RANGE, wire),
    ]
    drive(made, UR5E.random_joints(5, rng), sources)
    made.finish()
    sets = made.problem().sets
    # streams of one stop come in the order of their names
    assert {(each.base, each.tool, each.distances is not None) for each in sets} == {
        ('base', 'tool', False),
        ('base', 'tool_ball', False),
        ('base_wire', 'tool', True),
    }
    assert [len(each) for each in sets] == [5, 5, 5]


def test_the_world_is_the_frame_of_the_base():
    """Of two devices the one whose sample came first, and not the one that was heard first."""
    source, kind, seen = tracker()
    other = Source('a', device='A')

    def elsewhere(stamp, row):
        message = seen(stamp, row)
        message.header.frame_id = 'other'
        return message

    made = CalibrationSession(UR5E, Settings(**SIGMAS))
    two = [(other, kind, elsewhere), (source, kind, seen)]
    drive(made, UR5E.random_joints(3, np.random.default_rng(1)), two)
    problem = made.problem()
    assert [(each.device, each.frame_id) for each in made.samples[:2]] == [
        ('', 'tracker'),
        ('A', 'other'),
    ]
    assert [each.base for each in problem.sets] == ['base', 'base_A']
    assert problem.world_frame == 'tracker'


# Judging


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
    expected = made.validate()
    later.restore(made.samples)
    now, nominal = later.validate()
    assert now.rms_mm < 0.15 < 0.5 < nominal.rms_mm
    assert (now.rms_mm, nominal.rms_mm) == pytest.approx([each.rms_mm for each in expected])
    drive(made, UR5E.random_joints(5, rng), sources)
    now, nominal = made.validate()
    assert now.count > 5
    assert now.rms_mm < 0.15 < 0.5 < nominal.rms_mm
    assert made.calibration.chain is result.chain


def test_samples_that_were_fitted_are_known_again():
    """As where a recording is played once more to a node that loaded what came of it."""
    made = session(samples())
    made.identify()
    made.adopt(parse_calibration(made.calibration.dump(), 'file'), ())
    assert made.reused() == 1.0
    words = verdict(made.calibration, *made.validate(), made.reused())[1]
    assert 'these are the measurements that the calibration was fitted to' in words


def test_a_bumped_robot_is_noticed():
    made = session(samples())
    made.identify()
    bumped = TRUE.with_offsets({'elbow_joint.theta': 3e-3})
    drive(made, UR5E.random_joints(8, np.random.default_rng(1)), [tracker(bumped)])
    now, _ = made.validate()
    assert now.rms_mm > 0.5


def test_what_was_there_before_does_not_judge():
    """Neither samples before the calibration, nor those of an earlier session."""
    made = session(samples(30))
    made.identify()
    made.remove_last()
    drive(made, UR5E.random_joints(4, np.random.default_rng(1)), [tracker()])
    now, _ = made.validate()
    assert now.count == 4


def test_the_calibration_of_another_robot_is_refused():
    made = session(samples())
    panda = load_chain('franka_panda')
    with pytest.raises(InputError, match='the calibration has the joints panda_joint1'):
        made.adopt(Calibration(panda, panda))
    assert made.calibration is None


def test_samples_on_a_target_that_the_calibration_does_not_know_are_no_judges():
    made = session(samples())
    made.identify()
    _, kind, seen = tracker()
    drive(
        made,
        UR5E.random_joints(3, np.random.default_rng(1)),
        [(Source('x', target='new'), kind, seen)],
    )
    with pytest.raises(InputError, match='does not know'):
        made.validate()


# Settings and words


def test_settings_change_without_losing_anything():
    made = session(samples())
    made.change(replace(made.settings, fixed=('*.alpha',)))
    result = made.identify()
    assert len(made.samples) == 30
    assert {p.name for p in result.parameters if p.status == 'fixed'} == {
        f'{name}.alpha' for name in UR5E.joint_names
    }


def test_the_way_of_a_stop_can_be_changed_while_it_runs():
    made = CalibrationSession(UR5E, Settings(**SIGMAS))
    where = UR5E.random_joints(3, np.random.default_rng(1))
    end = drive(made, where, [tracker()])
    made.finish()
    made.change(replace(made.settings, shortest_stop=2.0))
    drive(made, where + 0.1, [tracker()], start=end)
    made.finish()
    assert len(made.samples) == 3
    assert made.account().unused['measurements: the stop was too short'] > 0


def test_the_status_tells_how_far_it_is():
    made = session(samples(6))
    assert made.status().startswith('waiting for joint states; 6 poses, ')
    assert 'too few to tell how many it takes' in made.status()
    assert 'more' not in made.status()
    made.restore(samples(60, start=100))
    assert 'mm expected' in made.status()
    made.change(replace(made.settings, wanted_accuracy=1e-2))
    assert 'enough for the accuracy wanted' in made.status()
    made.change(replace(made.settings, wanted_accuracy=1e-6))
    assert 'more expected for 0.001 mm' in made.status()


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
    assert 'expected for' not in made.status()
    made.change(replace(made.settings, sigma_position=1e-3))  # it is the noise of the device
    assert 'more expected for 0.1 mm' in made.status()
    as_noisy = session([replace(each, spread=1e-3) for each in given], loss='none', model=model)
    assert 'more expected for 0.1 mm' in as_noisy.status()


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
        'nothing can be sampled: no joint states of wrist_2_joint, wrist_3_joint come any more'
    )


def test_the_status_is_never_an_error():
    only_judging = session(samples(10, validation=True))
    assert '; 0 poses' in only_judging.status()
    (one,) = samples(1)
    same_place = session([replace(one, stamp_ns=k) for k in range(1, 20)])
    assert '; 19 poses' in same_place.status()
    assert '; 0 poses' in CalibrationSession(UR5E).status()
    assert CalibrationSession(UR5E).status('identifying') == (
        'waiting for joint states; identifying; 0 poses'
    )
