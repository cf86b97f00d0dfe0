# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements out of /tf and /tf_static."""

import itertools

import numpy as np
import pytest
from recorded import (
    ARM,
    MS,
    TYPES,
    TYPESTORE,
    joint_state,
    record,
    session_of,
    stamp_ns,
    standing,
    storages,
    transform_stamped,
)

from calib_ros.errors import InputError
from calib_ros.kinematics import se3
from calib_ros.sampling.batches import feed
from calib_ros.sampling.decoding import alike
from calib_ros.sampling.messages import JOINT_STATE, TRANSFORMS
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.slices import Part
from calib_ros.sampling.source_texts import parse_sources
from calib_ros.sampling.streams import Stream, source_streams
from calib_ros.sampling.transforms import Links
from calib_ros.settings import Settings

PLAIN = '/tf parent=world child=tool'
TIMES = [105, 205, 333, 601]


def tf(*links):
    return TYPES[TRANSFORMS](list(links))


def link(parent, child, stamp_ns=0, matrix=None):
    matrix = np.eye(4) if matrix is None else matrix
    quat = se3.to_quat(matrix[:3, :3])
    message = transform_stamped(stamp_ns, matrix[:3, 3].tolist(), quat.tolist(), child)
    message.header.frame_id = parent
    return message


def frame(rng):
    return se3.transform(se3.exp_rotation(rng.normal(size=3)), rng.normal(size=3))


def robot(stamp_ns, rng):
    """Return what robot_state_publisher sends: six moving links and two that hang on them."""
    names = ['base_link', *(f'link_{k}' for k in range(1, 7))]
    return tf(*(link(*pair, stamp_ns, frame(rng)) for pair in itertools.pairwise(names)))


def events(rng, moving, still=(), with_robot=True):
    """Return a bag: the robot's own frames, and those of a tracker."""
    found = standing([])
    if with_robot:
        ends = ('world', 'base_link'), ('link_6', 'flange'), ('flange', 'tool0')
        fixed = tf(*(link(*pair, 0, frame(rng)) for pair in ends))
        found.insert(0, ('/tf_static', fixed))
        found += [('/tf', robot(ms * MS, rng)) for ms in range(10, 1000, 20)]
    found = [*(('/tf_static', each) for each in still), *found]
    return [*found, *(('/tf', each) for each in moving)]


def poses_of(path, *sources):
    session, _ = session_of(path, sources=sources or (PLAIN,))
    observations = session.problem().observations
    return se3.transform(observations.rotations, observations.positions), session


CHAINS = {
    'direct': ([], [('world', 'tool')]),
    'turned round': ([], [('tool', 'world')]),
    'before': ([('world', 'tracker')], [('tracker', 'tool')]),
    'behind': ([('marker', 'tool')], [('world', 'marker')]),
    'on both sides': (
        [('world', 'hall'), ('hall', 'tracker'), ('marker', 'plate'), ('plate', 'tool')],
        [('tracker', 'marker')],
    ),
    'beside': ([('world', 'tracker')], [('world', 'tool')]),
    'from a sister': ([('hall', 'world'), ('hall', 'tracker')], [('tracker', 'tool')]),
    'turned round between': ([('tracker', 'world'), ('tool', 'reflector')], [('tracker', 'tool')]),
    'of the measured side': ([('world', 'camera')], [('tool', 'world')]),
}


@pytest.mark.parametrize('late', [False, True])
@pytest.mark.parametrize('name', CHAINS)
def test_links_that_stand_still_are_composed(tmp_path, rng, name, late):
    still, (pair,) = CHAINS[name]
    known = {each: frame(rng) for each in still}
    numbers = [frame(rng) for _ in TIMES]
    moving = [tf(link(*pair, ms * MS, t)) for ms, t in zip(TIMES, numbers, strict=True)]
    fixed = [tf(link(*each, 0, matrix)) for each, matrix in known.items()]
    content = events(rng, moving, fixed, with_robot=False)
    if late:
        content = [*content[len(fixed) :], *content[: len(fixed)]]
    ends = {'from a sister': 'world', 'turned round between': 'world'}
    child = 'reflector' if name == 'turned round between' else 'tool'
    parent = ends.get(name, 'world')
    found, _ = poses_of(record(tmp_path / 'bag', content), f'/tf parent={parent} child={child}')
    for pose, number in zip(found, numbers, strict=True):
        frames = {'world': np.eye(4)}
        links = known | {pair: number}
        for _ in range(8):
            for (a, b), matrix in links.items():
                if a in frames:
                    frames[b] = frames[a] @ matrix
                elif b in frames:
                    frames[a] = frames[b] @ se3.invert(matrix)
        np.testing.assert_allclose(pose, frames[child], rtol=0, atol=1e-12)


@storages
def test_a_bag_tells_what_stands_still_even_at_its_end(tmp_path, rng, storage):
    """Later than measurements may come, and more messages later than are read at once."""
    matrices = [frame(rng) for _ in TIMES]
    known = frame(rng)
    content = [('/joint_states', joint_state(2 * k * MS)) for k in range(1, 2600)]
    content += [
        ('/tf', tf(link('tracker', 'tool', ms * MS, matrix)))
        for ms, matrix in zip(TIMES, matrices, strict=True)
    ]
    content.sort(key=lambda item: stamp_ns(item[1]))
    content.append(('/tf_static', tf(link('world', 'tracker', 0, known))))
    found, session = poses_of(record(tmp_path / 'bag', content, storage))
    np.testing.assert_allclose(found, [known @ each for each in matrices], rtol=0, atol=1e-12)
    assert session.account().dropped == {}


def refusal(path, *sources):
    with pytest.raises(InputError) as caught:
        session_of(path, sources=sources or (PLAIN,))
    return str(caught.value)


@storages
def test_a_bag_without_named_sources_lists_the_frames(tmp_path, rng, storage):
    moving = [tf(link('world', 'marker', ms * MS, frame(rng))) for ms in range(10, 1000, 5)]
    path = record(tmp_path / 'bag', events(rng, moving), storage)
    with pytest.raises(InputError, match='has no pose topic') as caught:
        session_of(path)
    assert 'world to marker at 200 Hz' in str(caught.value)
    assert 'such as "/tf parent=world child=marker"' in str(caught.value)
    assert len(poses_of(path, '/tf parent=world child=marker')[0]) == 198


@pytest.mark.parametrize(
    ('still', 'moving', 'source', 'said'),
    [
        ([], [], '/tf parent=world child=tool0', '6 links move from world to tool0 (base_link'),
        ([], [], '/tf parent=world child=base_link', 'nothing moves from world to base_link'),
        (
            [('world', 'tracker'), ('tool0', 'tool')],
            [('tracker', 'tool')],
            *(PLAIN, 'frame "tool" has several parents, tool0 and tracker'),
        ),
        ([], [('a', 'tool'), ('tool', 'a')], PLAIN, 'is above itself'),
        (
            *([('world', 'tool')], [('world', 'tool')]),
            *(PLAIN, 'world to tool comes on both /tf and /tf_static'),
        ),
    ],
)
def test_what_is_no_measurement_is_refused(tmp_path, rng, still, moving, source, said):
    fixed = [tf(*(link(*pair) for pair in still))]
    come = [tf(*(link(*pair, 105 * MS, frame(rng)) for pair in moving))]
    path = record(tmp_path / 'bag', events(rng, come, fixed))
    assert said in refusal(path, source)
    if 'parents' in said:
        assert len(poses_of(path, '/tf parent=tracker child=tool')[0]) == 1
    (path / 'metadata.yaml').unlink()  # as of a bag that was not closed
    assert said in refusal(path, source)


def test_a_link_that_has_changed_is_refused(tmp_path, rng):
    first = frame(rng)
    moved = first.copy()
    moved[0, 3] += 1e-4
    moving = [tf(link('tracker', 'tool', ms * MS, frame(rng))) for ms in TIMES]
    still = tf(link('world', 'tracker', 0, first))
    content = events(rng, moving, [still, still])
    assert len(poses_of(record(tmp_path / 'same', content))[0]) == 4
    content.append(('/tf_static', tf(link('world', 'tracker', 0, moved))))
    text = refusal(record(tmp_path / 'bag', content))
    assert 'world to tracker has changed on /tf_static' in text


def test_a_pair_that_repeats_is_one_measurement(tmp_path, rng):
    same = link('world', 'tool', 105 * MS, frame(rng))
    moving = [tf(same, same), tf(same), tf(link('world', 'tool', 205 * MS), same)]
    found, session = poses_of(record(tmp_path / 'bag', events(rng, moving)))
    assert len(found) == 2
    assert session.account().poses == 5
    assert session.account().unused == {'measurements: same stamp twice': 3}


@pytest.mark.parametrize('big_endian', [False, True])
def test_bad_transforms_are_counted_if_they_are_of_the_pair(rng, big_endian):
    good, bad, foreign = (
        link(*pair, 105 * MS, frame(rng))
        for pair in (('world', 'tool'), ('world', 'tool'), ('base_link', 'link_1'))
    )
    bad.header.stamp.sec = foreign.header.stamp.sec = -1
    session = session_fed([tf(foreign, good), tf(bad, foreign), tf(foreign)], not big_endian)
    account = session.account()
    assert account.poses == 2
    (cause,) = account.dropped
    assert account.dropped[cause] == 1
    assert cause.startswith('measurements: negative stamp')


def session_fed(come, little_endian=True, at_once=True):
    """Return a session that has taken joint states and then transforms."""
    settings = Settings(mode='continuous', delay=1e-12, sources=(PLAIN,))
    session = CalibrationSession(ARM, settings)
    streams = {each.topic: each for each in source_streams(parse_sources([PLAIN]), {})}
    streams['/joint_states'] = Stream('/joint_states', JOINT_STATE)
    batch = []
    for each in (*standing([]), *come):
        topic, message = each if isinstance(each, tuple) else ('/tf', each)
        kind = streams[topic].type
        data = TYPESTORE.serialize_cdr(message, kind, little_endian=little_endian)
        batch.append((streams[topic], bytes(data)))
    for some in [batch] if at_once else [[each] for each in batch]:
        assert feed(session, some, TYPESTORE.deserialize_cdr) == []
    session.finish()
    return session


def test_frames_without_end_are_not_remembered(rng):
    """As of a tracker that numbers its markers: the one that is wanted is told from them."""
    come = [('/tf_static', tf(link('world', 'tracker', 1, frame(rng))))]
    come += [tf(link('tracker', f'marker {k}', 101 * MS)) for k in range(1200)]
    come += [tf(link('tracker', 'tool', ms * MS, frame(rng))) for ms in TIMES]
    come += [tf(link('tracker', f'later {k}', 601 * MS)) for k in range(1200)]
    session = session_fed([*come, tf(link('tracker', 'tool', 701 * MS, frame(rng)))])
    assert session.account().samples == 5
    links = Links('/tf')
    assert str(links) == 'nothing moves on /tf'
    at, numbers = np.zeros(1, int), np.array([[0.0] * 6 + [1.0]])
    for k in range(1500):
        links.take([Part(at, None, ('tracker', f'marker {k}'), at + k, numbers)])
    assert 'and 980 more' in str(links)


def test_what_could_not_wait_for_its_frames_is_counted(monkeypatch, rng):
    monkeypatch.setattr(Settings, 'pose_buffer', 5)
    stamps = [100 + 5 * k for k in range(20)]
    come = [tf(link('tracker', 'tool', ms * MS, frame(rng))) for ms in stamps]
    come += [robot(300 * MS, rng), ('/tf_static', tf(link('world', 'tracker', 1, frame(rng))))]
    come.append(tf(link('tracker', 'tool', 400 * MS, frame(rng))))
    account = session_fed(come, at_once=False).account()
    assert account.poses == 21
    assert account.samples == 1
    assert account.dropped == {'measurements: buffer full before their frames were linked': 20}
    assert session_fed(come).account().samples == 21


@pytest.mark.parametrize('little_endian', [False, True])
def test_one_by_one_is_as_good_as_by_the_batch(rng, little_endian):
    still = tf(link('world', 'tracker', 1, frame(rng)))
    come = [
        message
        for ms in TIMES
        for message in (robot(ms * MS, rng), tf(link('tracker', 'tool', ms * MS, frame(rng))))
    ]
    come.insert(5, ('/tf_static', still))
    expected = session_fed(come)
    found = session_fed(come, little_endian, at_once=False)
    assert found.account().samples == expected.account().samples == 4
    for a, b in zip(found.samples, expected.samples, strict=True):
        np.testing.assert_allclose(a.position, b.position, rtol=0, atol=1e-14)
        assert a.stamp_ns == b.stamp_ns


def test_messages_are_read_whatever_stands_between_their_names(rng):
    """Serialisers leave bytes of any kind where numbers are aligned."""
    message = tf(link('world', 'tool', 105 * MS, frame(rng)), link('a', 'bc', 7, frame(rng)))
    data = bytes(TYPESTORE.serialize_cdr(message, TRANSFORMS))
    assert [strings for _, strings, *_ in alike(TRANSFORMS, [data], {})] == [
        ('world', 'tool'),
        ('a', 'bc'),
    ]
    other = bytearray(data)
    gap = data.index(b'world\0') + 6
    other[gap : gap + 2] = b'\xff\xff'
    _, (which, _, stamps, numbers) = alike(TRANSFORMS, [data, bytes(other)], {})
    assert which.tolist() == [0, 1]
    assert stamps.tolist() == [7, 7]
    np.testing.assert_array_equal(numbers[0], numbers[1])


WHOLE = bytes(TYPESTORE.serialize_cdr(tf(link('world', 'tool', 105 * MS)), TRANSFORMS))


@pytest.mark.parametrize('cut', range(4, len(WHOLE), 7))
def test_messages_that_are_cut_off_are_not_read(cut):
    assert not list(alike(TRANSFORMS, [WHOLE[:cut]], {}))


def test_a_name_of_absurd_length_is_not_read():
    assert not list(alike(TRANSFORMS, [WHOLE[:16] + b'\xff\xff\xff\xff' + WHOLE[20:]], {}))
