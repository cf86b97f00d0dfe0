# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import re
from collections import Counter

import numpy as np
import pytest
from recorded import (
    ARM,
    MS,
    account_of,
    assert_equal,
    joint_state,
    observations_of,
    odometry,
    point_stamped,
    pose_stamped,
    pose_with_covariance,
    record,
    record_in_chunks,
    recording,
    session_of,
    stamp_ns,
    standing,
    storages,
    text_message,
    transform_stamped,
)
from rosbags.rosbag2 import Reader

from calib_ros.errors import InputError
from calib_ros.files.bags import replay
from calib_ros.files.recording import write_bag
from calib_ros.sampling import batches
from calib_ros.sampling.messages import JOINT_STATE
from calib_ros.sampling.session import CalibrationSession


@storages
@pytest.mark.parametrize(
    ('oriented', 'held_out', 'mode'),
    [(True, 0, 'continuous'), (True, 2, 'dwell'), (False, 2, 'continuous'), (False, 0, 'dwell')],
)
def test_a_bag_gives_what_its_arrays_hold(tmp_path, storage, oriented, held_out, mode):
    made = recording(oriented=oriented, held_out=held_out)
    write_bag(tmp_path / 'bag', made, storage)
    noun, kind = ('pose', 'PoseStamped') if oriented else ('point', 'PointStamped')
    topics = ['/joint_states', f'/measured_{noun}', f'/validation_{noun}'][: 2 + (held_out > 0)]
    with Reader(tmp_path / 'bag') as reader:
        kinds = [JOINT_STATE, *[f'geometry_msgs/msg/{kind}'] * 2]
        assert {c.topic: c.msgtype for c in reader.connections} == dict(
            zip(topics, kinds, strict=False)
        )
    session, warnings = session_of(tmp_path / 'bag', mode=mode, settle=0.0, shortest_stop=0.05)
    problem = session.problem()
    account = session.account()
    assert warnings == ()
    assert (account.samples, account.held_out) == (30 - 6 * held_out, 6 * held_out)
    assert ('18 poses to fit and 12 held out' in str(account)) == (held_out > 0)
    assert (account.waiting, account.unused, account.dropped) == (0, {}, {})
    sets = (problem.observations, *problem.held_out)
    assert len(sets) == 1 + (held_out > 0)
    for found, chosen in zip(sets, (~made.held_out, made.held_out), strict=False):
        expected = made.poses.select(chosen)
        for name in ('stamps_ns', 'positions', 'oriented'):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        np.testing.assert_allclose(found.rotations, expected.rotations, atol=1e-14)
        np.testing.assert_allclose(found.joints, expected.joints, atol=1e-12)


@storages
@pytest.mark.parametrize('mode', ['none', 'file'])
def test_a_file_of_a_bag_is_as_good_as_its_folder(tmp_path, storage, mode):
    """As it is, or packed by the recorder as a whole."""
    record_in_chunks(tmp_path / 'bag', storage, mode)
    (file,) = (path for path in (tmp_path / 'bag').iterdir() if path.suffix != '.yaml')
    folder, _ = session_of(tmp_path / 'bag', mode='continuous', delay=1e-12)
    alone, warnings = session_of(file, mode='continuous', delay=1e-12)
    assert warnings == ()
    assert_equal(alone.problem().observations, folder.problem().observations)


def test_a_bag_is_never_overwritten(tmp_path):
    write_bag(tmp_path / 'bag', recording(5))
    before = {path.name: path.read_bytes() for path in (tmp_path / 'bag').iterdir()}
    with pytest.raises(InputError, match='exists already'):
        write_bag(tmp_path / 'bag', recording(6))
    assert {path.name: path.read_bytes() for path in (tmp_path / 'bag').iterdir()} == before


def test_messages_in_any_order_give_the_same(tmp_path, rng):
    events = standing([pose_stamped((k * 33 + 15) * MS, (k, 0.0, 0.0)) for k in range(25)])
    shuffled = [events[k] for k in rng.permutation(len(events))]
    first, _ = session_of(record(tmp_path / 'first', events))
    second, _ = session_of(record(tmp_path / 'second', shuffled))
    assert_equal(second.problem().observations, first.problem().observations)
    assert second.account().samples == 25
    assert second.account().dropped == first.account().dropped == {}
    assert first.account().notes == {}
    for topic, kind in (('/joint_states', 'joints'), ('/pose', 'measurements')):
        stamps = np.array([stamp_ns(each) for at, each in shuffled if at == topic])
        back = int((stamps < np.maximum.accumulate(stamps)).sum())
        note = f'{kind} with a stamp older than the one before'
        assert second.account().notes[note] == back > 5
        assert f'{back} x {note}' in str(second.account())


def test_joints_by_other_names(tmp_path):
    joints = [joint_state(k * MS, (3.0, 1.0, 2.0), ('r/c', 'r/a', 'r/b')) for k in (10, 20)]
    events = [*(('/joint_states', message) for message in joints), ('/p', pose_stamped(15 * MS))]
    path = record(tmp_path / 'bag', events)
    session, _ = session_of(path, joint_names=('r/a', 'r/b', 'r/c'))
    np.testing.assert_array_equal(session.problem().observations.joints, [[1.0, 2.0, 3.0]])
    said = 'joint states never name a, b, c, but r/a, r/b, r/c: give the chain'
    with pytest.raises(InputError, match=f'no poses to fit: .* gave 0 poses; {said}'):
        session_of(path)[0].problem()
    names = [f'{part}_joint' for part in ('elbow', 'lift', 'pan', 'wrist_1', 'wrist_2', 'wrist_3')]
    names = [f'left_shoulder_{name}' for name in names]
    joints = [joint_state(k * MS, tuple(6 * [0.1 * k]), names) for k in (10, 20)]
    others = [*(('/joint_states', message) for message in joints), events[2]]
    with pytest.raises(InputError, match=f'but {", ".join(names)}: give the chain'):  # not cut
        session_of(record(tmp_path / 'others', others))[0].problem()


def test_of_several_topics_some_must_be_chosen(tmp_path):
    events = standing([pose_stamped(105 * MS, (1, 0, 0))], '/left')
    events.append(('/right', point_stamped(105 * MS, (2, 0, 0))))
    path = record(tmp_path / 'bag', events)
    with pytest.raises(InputError, match=r'several pose topics, .*--sources: /left, /right'):
        session_of(path)
    for topic, expected in (('/left', 1.0), ('/right', 2.0)):
        assert observations_of(path, sources=(topic,)).positions[:, 0].tolist() == [expected]
    both, _ = session_of(path, sources=('/left device=L', '/right device=R'))
    assert [each.base for each in both.problem().sets] == ['base', 'base_R']


def test_all_joint_topics_are_heard_together(tmp_path):
    """As of an arm and the axis it stands on, each with a driver of its own."""
    arm = [joint_state(k * 10 * MS, (0.1 * k, 0.2), ('a', 'b')) for k in range(1, 100)]
    axis = [joint_state((k * 20 + 3) * MS, (7.0, -0.3 * k), ('grip', 'c')) for k in range(50)]
    events = [('/arm/joint_states', each) for each in arm]
    events += [('/axis/joint_states', each) for each in axis]
    events += [('/pose', pose_stamped(505 * MS)), ('/pose', pose_stamped(603 * MS))]
    joints = observations_of(record(tmp_path / 'bag', events)).joints
    np.testing.assert_allclose(joints, [[5.05, 0.2, -7.53], [6.03, 0.2, -9.0]], atol=1e-12)


@pytest.mark.parametrize(
    ('settings', 'named'),
    [
        ({'joint_topics': ('/joints',)}, '"/joints" (JointState);'),
        ({'joint_topics': ('/pose',)}, '"/pose" (JointState);'),
        ({'sources': ('/poze',)}, '"/poze" (PoseStamped, '),
        ({'sources': ('/joint_states',)}, '"/joint_states" (PoseStamped, '),
        ({'sources': ('/pose type=PointStamped',)}, '"/pose" (PointStamped);'),
    ],
)
def test_a_topic_that_is_not_there_lists_the_contents(tmp_path, settings, named):
    path = record(tmp_path / 'bag', [*standing([pose_stamped(105 * MS)]), ('/x', text_message())])
    with pytest.raises(InputError, match=re.escape(f'no {named}')) as caught:
        session_of(path, **settings)
    contents = 'it holds /joint_states (JointState), /pose (PoseStamped), /x (String)'
    assert str(caught.value).endswith(contents)


@storages
@pytest.mark.parametrize(
    ('events', 'missing'),
    [
        ([('/chatter', text_message())], 'joint topic'),
        ([('/joint_states', joint_state(10 * MS))], 'pose topic'),
        ([('/pose', pose_stamped(10 * MS))], 'joint topic'),
        (standing([pose_stamped(105 * MS)], '/validation_pose'), 'pose topic'),  # never guessed
    ],
)
def test_a_bag_without_the_topics_is_refused(tmp_path, storage, events, missing):
    path = record(tmp_path / 'bag', events, storage)
    with pytest.raises(InputError, match=f'has no {missing}') as caught:
        session_of(path)
    assert events[0][0] in str(caught.value)


@storages
def test_topics_without_messages_make_no_pairs(tmp_path, storage):
    kinds = [('/joint_states', JOINT_STATE), ('/pose', 'geometry_msgs/msg/PoseStamped')]
    path = record(tmp_path / 'bag', [('/chatter', text_message())], storage, silent=kinds)
    session, _ = session_of(path)
    with pytest.raises(InputError, match='no poses to fit: nothing was received'):
        session.problem()


GOOD = np.eye(6)
NAN = GOOD.copy()
NAN[0, 0] = np.nan
SKEW = GOOD.copy()
SKEW[0, 1] = 0.5
ZERO = np.diag([1, 1, 1, 1, 1, 0])
ZERO_STAMP = 'measurements: zero stamp (fill header.stamp where it is published)'
NOT_FINITE = 'measurements: NaN or infinite position (does the device see the target?)'
COVARIANCE = 'measurements: covariance {} (leave it zero if it is not known)'
NOT_UNIT = 'measurements: quaternion not of length 1 (normalise it where it is published)'
BAD_POSES = [
    (pose_stamped(0), ZERO_STAMP),
    (pose_stamped(105 * MS, (np.nan, 0, 0)), NOT_FINITE),
    (pose_stamped(115 * MS, (0, 0, np.inf)), NOT_FINITE),
    (pose_stamped(125 * MS, quat=(0, 0, 0, 0)), NOT_UNIT),
    (pose_stamped(135 * MS, quat=(0, 0, 0, 1.01)), NOT_UNIT),
    (pose_stamped(145 * MS, quat=(0, 0, np.nan, 1)), NOT_UNIT),
    (point_stamped(155 * MS, (0, -np.inf, 0)), NOT_FINITE),
    (transform_stamped(0), ZERO_STAMP),
    (
        transform_stamped(165 * MS, child='a\nb'),
        'measurements: child frame whose name cannot be printed',
    ),
    (transform_stamped(175 * MS, quat=(1, 1, 1, 1)), NOT_UNIT),
    (pose_with_covariance(185 * MS, NAN), COVARIANCE.format('with NaN or infinite values')),
    (pose_with_covariance(195 * MS, SKEW), COVARIANCE.format('not symmetric')),
    (pose_with_covariance(205 * MS, -GOOD), COVARIANCE.format('not positive definite')),
    (pose_with_covariance(215 * MS, ZERO), COVARIANCE.format('not positive definite')),
    (pose_stamped(5 * MS), 'measurements: no joint state before'),
    (pose_stamped(1005 * MS), 'measurements: no joint state after'),
]


def test_bad_measurements_are_dropped_and_counted_by_cause(tmp_path):
    good = [pose_stamped(905 * MS), point_stamped(905 * MS), transform_stamped(905 * MS)]
    good += [pose_with_covariance(905 * MS, GOOD), odometry(905 * MS)]
    for right in good:
        bad = [(message, cause) for message, cause in BAD_POSES if type(message) is type(right)]
        path = tmp_path / type(right).__msgtype__.rpartition('/')[2]
        events = standing([*(message for message, _ in bad), right])
        account = account_of(record(path, events))
        assert (account.poses, account.samples) == (len(bad) + 1, 1)
        assert account.dropped == Counter(cause for _, cause in bad)
        for cause, count in account.dropped.items():
            assert f'{count} x {cause}' in str(account)


BAD_JOINTS = [
    (joint_state(0), 'joints: zero stamp (fill header.stamp where it is published)'),
    (joint_state(55 * MS, (0.1, np.nan, 0.3)), 'joints: NaN or infinite joint value (b)'),
    (joint_state(55 * MS, (0.1, np.inf, 0.3)), 'joints: NaN or infinite joint value (b)'),
    (joint_state(55 * MS, (0.1, 0.2)), 'joints: names and positions differ in number'),
]
OTHERS = [joint_state(55 * MS, (0.1,), ('gripper',)), joint_state(55 * MS, (), ())]
OTHERS += [joint_state(55 * MS, values, ('gripper', 'grip')) for values in ((), (0.1,))]


@pytest.mark.parametrize(('first', 'behind'), [(True, 0), (False, 12)])
def test_bad_joint_states_are_dropped_and_counted_by_cause(tmp_path, first, behind):
    events = standing([pose_stamped(55 * MS)])
    bad = [('/joint_states', message) for message in (*(each for each, _ in BAD_JOINTS), *OTHERS)]
    bad.append(('/joint_states', joint_state(55 * MS, ())))
    events = [*bad, *events] if first else [*events, *bad]
    account = account_of(record(tmp_path / 'bag', events, behind=behind * b'x'))
    assert (account.joint_states, account.samples) == (100 + len(bad), 1)
    assert account.dropped == Counter(cause for _, cause in BAD_JOINTS)
    assert account.unused['joints: none of the joints in the message'] == len(OTHERS)
    assert account.unused['joints: no positions in the message'] == 1


def test_a_nan_of_a_foreign_joint_does_not_matter(tmp_path):
    events = [
        ('/joint_states', joint_state(k * MS, (1, 2, 3, np.nan), ('a', 'b', 'c', 'grip')))
        for k in (10, 20)
    ]
    account = account_of(record(tmp_path / 'bag', [*events, ('/pose', pose_stamped(15 * MS))]))
    assert (account.samples, account.dropped) == (1, {})


def test_a_bag_tells_how_much_of_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(batches, 'BATCH', 100)
    told = []
    path = record_in_chunks(tmp_path / 'bag', 'mcap')
    replay(path, CalibrationSession(ARM), told.append)
    assert told == sorted(told)
    assert len(told) > 2
    assert told[-1] == 1.0
