# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every measurement that came is in a sample, waits, or is counted with a cause: none is lost."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import Phase, given, settings, strategies as st
from recorded import distance, point_stamped, pose_stamped, pose_with_covariance, serialised
from streams import (
    MS,
    POSE,
    RANGE,
    START,
    TRACKER,
    TRANSFORM,
    joint_state,
    of_joints,
    pose,
    stops,
    take,
    transform,
)

from calib_ros.decision.reasons import Rule
from calib_ros.errors import InputError
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.sampling.account import Account, Cause, Lost, lost, too_much_lost
from calib_ros.sampling.batches import decode
from calib_ros.sampling.frame_names import FrameNames
from calib_ros.sampling.joint_names import JointNames
from calib_ros.sampling.message_filter import MessageFilter
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.slices import POSES, Part
from calib_ros.sampling.sources import Source
from calib_ros.sampling.streams import Stream
from calib_ros.settings import Mode, Settings

POINT = 'geometry_msgs/msg/PointStamped'
WITH_COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
ARM = Chain('arm', 'standard', (Joint('a', alpha=1.5, d=0.3), Joint('b', a=0.4), Joint('c')))
SOURCES = (
    (Source('pose'), POSE, lambda stamp, where: pose(stamp, where)),
    (Source('judge', validation=True), POSE, lambda stamp, where: pose(stamp, where)),
    (Source('marker'), TRANSFORM, lambda stamp, where: transform(stamp, where, 'ball')),
    (Source('wire', device='wire'), RANGE, lambda stamp, where: distance(stamp, where[0])),
)
PARTS = (
    (('a', 'b', 'c'),),
    (('a',), ('b', 'c')),
    (('c', 'b', 'a'), ('b',)),
    (('a', 'b'), ('b', 'c')),
    (('a', 'b'),),
)
CALLS = ('flush', 'capture', 'finish', 'remove', 'pause', 'judge', 'status')


def balance(session):
    """Return how many measurements came, and how many are accounted for."""
    account = session.account()
    lost = sum(
        count
        for counts in (account.unused, account.dropped)
        for cause, count in counts.items()
        if cause.startswith('measurements')
    )
    return account.poses, sum(s.count for s in session.samples) + account.waiting + lost


def call(session, name):
    try:
        if name == 'flush':
            session.problem()
        elif name == 'capture':
            session.capture()
        elif name == 'finish':
            session.finish()
        elif name == 'remove':
            session.remove_last()
        elif name == 'pause':
            session.recording = not session.recording
        elif name == 'judge':
            session.since()
        else:
            session.status()
    except InputError:
        pass


plans = st.fixed_dictionaries(
    {
        'mode': st.sampled_from(get_args(Mode)),
        'lateness': st.sampled_from([0.0, 0.05, 0.4, 1.0]),
        'settle': st.sampled_from([0.0, 0.1]),
        'shortest_stop': st.sampled_from([0.0, 0.2, 1.0]),
        'longest_stop': st.sampled_from([0.3, 5.0]),
        'joint_buffer': st.sampled_from([2, 3, 10, 60, 10_000]),
        'pose_buffer': st.sampled_from([1, 5, 10_000]),
        'delay': st.sampled_from([0.0, 0.1, -0.1]),
    }
).filter(lambda plan: plan['shortest_stop'] < plan['longest_stop'])
traffic = st.fixed_dictionaries(
    {
        'seed': st.integers(0, 2**32 - 1),
        'parts': st.sampled_from(PARTS),
        'dies': st.sampled_from([3.0, 9.0]),  # all publishers of joints but the first
        'joint_period': st.sampled_from([0.02, 0.037]),
        'sources': st.lists(st.sampled_from(range(len(SOURCES))), min_size=1, max_size=3),
        'period': st.sampled_from([0.03, 0.11]),
        'stand': st.sampled_from([0.3, 1.0]),
        'latest': st.sampled_from([0.0, 0.02, 0.3, 3.0]),
        'wild': st.sampled_from([0.0, 0.02]),  # share of stamps that are wrong, and of repeats
        'calls': st.lists(st.sampled_from(CALLS), max_size=6),
        'again': st.booleans(),  # the bag is played in a loop
    }
)


def happening(seed, parts, dies, joint_period, sources, period, stand, latest, wild, calls, again):
    """Return messages and calls in the order of their arrival."""
    rng = np.random.default_rng(seed)
    joints = stops(rng.uniform(-3.5, 3.5, (5, 3)), move=0.4, stand=stand)
    events = []

    def add(stamp_s, name, *values):
        stamp_ns = START + round(stamp_s * 1e9)
        if rng.random() < wild:
            stamp_ns += int(rng.choice([-30_000, -500, 500, 30_000])) * MS
        late = rng.exponential(latest) if latest else 0.0
        repeats = 1 + (rng.random() < wild)
        events.extend([(stamp_s + late, (name, stamp_ns, *values))] * repeats)

    for k, names in enumerate(parts):
        for stamp_s in np.arange(0.0, min(6.0, dies if k else 9.0), joint_period):
            if wild and 2.0 < stamp_s < 2.3:
                continue  # a hole
            values = (joints([stamp_s])[0] + np.pi) % (2.0 * np.pi) - np.pi
            add(stamp_s, 'joints', names, values[[ARM.joint_names.index(n) for n in names]])
    for source in sources:
        for stamp_s in np.arange(0.005, 6.2, period):
            where = rng.normal(scale=1e-4, size=3) + [1.0, 2.0, 3.0] + joints([stamp_s])[0]
            add(stamp_s, 'measured', source, np.abs(where))
    events.extend((rng.uniform(0.0, 6.0), (name,)) for name in calls)
    events.sort(key=lambda event: event[0])
    return [what for _, what in events] * (1 + again)


@settings(max_examples=16, phases=[Phase.generate])  # to shrink takes minutes
@given(plans, traffic)
def test_every_measurement_is_accounted_for(plan, traffic):
    session, come = CalibrationSession(ARM, Settings(**plan)), []
    for k, (name, *values) in enumerate(happening(**traffic)):
        if name == 'joints':
            come.append(of_joints(joint_state(*values)))
        elif name == 'measured':
            stamp_ns, number, where = values
            source, kind, make = SOURCES[number]
            come.append((source, kind, make(stamp_ns, where)))
        else:
            take(session, *come)
            come = []
            call(session, name)
        if k % 200 == 0 or name in CALLS:
            take(session, *come)
            come = []
            came, found = balance(session)
            assert came == found, f'after {name}, message {k}'
    take(session, *come)
    session.finish()
    came, found = balance(session)
    assert came == found
    assert 'waiting' not in str(session.account())


def test_the_name_of_a_frame_makes_no_loss():
    cause = Cause('measurements', 'in frame "stamping press", not in frame_id "memory"')
    assert lost('measurements', 100, {cause: 50})[0] == 0.0


ALLOWED = 'accept the rest with largest_loss (--largest-loss) 0.36'
LATE, EMPTY = Cause(POSES, Lost('stamp too late')), Cause(POSES, 'empty')
COUNTED = Account(
    joint_states=900,
    poses=30,
    waiting=4,
    samples=12,
    held_out=3,
    configurations=11,
    unused={Cause(POSES, 'the arm was moving'): 7},
    dropped={LATE: 2, Cause(POSES, Lost('zero stamp')): 5, EMPTY: 9},
    notes={'two publishers': 1},
    foreign_names=(),
    never_named=(),
)


def test_an_account_tells_every_count():
    assert str(COUNTED) == (
        '900 joint states and 30 measurements gave 12 poses to fit and 3 held out, 11 of them '
        'different, 4 measurements waiting; not used: 7 x measurements: the arm was moving; '
        'dropped: 2 x measurements: stamp too late, 5 x measurements: zero stamp, '
        '9 x measurements: empty; note: 1 x two publishers'
    )
    plain = replace(COUNTED, held_out=0, configurations=12, waiting=0, unused={}, dropped={})
    assert str(replace(plain, notes={})) == '900 joint states and 30 measurements gave 12 poses'
    another = replace(plain, foreign_names=('j1', 'j2'), never_named=('a', 'b'))
    assert str(another) == (
        '900 joint states and 30 measurements gave 12 poses; joint states never name a, b, but '
        'j1, j2: give the chain of this arm (--chain) or, if only the names differ, set '
        'joint_names (--joint-names)'
    )


def test_the_largest_of_the_causes_of_a_loss_is_told():
    share, text = lost(POSES, 20, COUNTED.dropped)
    assert share == 7 / 20
    assert text == '35 % of the measurements were dropped: zero stamp'
    (reason,) = too_much_lost(replace(COUNTED, poses=20), 0.34)
    assert (reason.rule, str(reason)) == (Rule.DROPPED, f'{text}; remove the cause, or {ALLOWED}')
    assert too_much_lost(replace(COUNTED, poses=20), 0.35) == []


@pytest.mark.parametrize('full', [0, 1])
def test_a_driver_that_publishes_each_pose_twice_loses_nothing(full):
    """As a position and a pose, or without and with covariance: half was lost, it was told."""
    session, motion = CalibrationSession(ARM), stops(np.full((3, 3), 0.1) * [[1], [2], [3]])
    covariance = np.diag([1e-8] * 3 + [1e-6] * 3)
    for time_s in np.arange(0.0, 5.5, 0.02):
        stamp_ns, joints = START + round(time_s * 1e9), motion([time_s])[0]
        at = joints + 1.0, (0.0, 0.0, 0.0, 1.0)
        poor = POINT, point_stamped(stamp_ns, at[0] - 1e-12)
        rich = POSE, pose(stamp_ns, at[0])
        if full:
            poor, rich = rich, (WITH_COVARIANCE, pose_with_covariance(stamp_ns, covariance, at))
        come = [(Source(kind), kind, message) for kind, message in (poor, rich)]
        take(session, of_joints(joint_state(stamp_ns, ARM.joint_names, joints)), *come)
    session.finish()
    account = session.account()
    assert not account.dropped  # the diagnostics were WARN for ever
    assert account.unused['measurements: same stamp twice'] == account.poses // 2
    assert len(session.samples) == 3
    for sample in session.samples:
        assert sample.rotation is not None
        assert (sample.covariance is not None) == full


def test_a_covariance_of_zeros_is_none_and_what_is_not_recorded_is_counted():
    numbers = np.zeros((2, 43))
    numbers[:, 6], numbers[1, 7::7] = 1.0, 1e-8
    part = Part(np.arange(2), TRACKER, ('world', 'ball'), np.array([1, 2]), numbers)
    admitted = MessageFilter(JointNames(['a']), FrameNames(), 1)
    (piece,) = admitted.pieces([part._replace(numbers=numbers.copy())], recording=True)
    assert np.isnan(piece.numbers[:, 7:]).all(axis=1).tolist() == [True, False]
    assert admitted.pieces([part], recording=False) == []
    assert admitted.unused == {Cause(POSES, 'not recording'): 2}


def test_a_frame_is_the_same_with_a_slash_before_its_name():
    come = [serialised(pose_stamped(1, frame=name)) for name in ('/world', 'world')]
    parts, _ = decode([(Stream('pose', POSE, TRACKER), each) for each in come], None)
    assert {part.strings[0] for part in parts} == {'world'}
