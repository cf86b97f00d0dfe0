# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import struct

import numpy as np
import pytest
from hypothesis import given, strategies as st
from recorded import (
    TYPES,
    TYPESTORE,
    distance,
    header,
    odometry,
    point_stamped,
    pose_stamped,
    pose_with_covariance,
    transform_stamped,
)

from calib_ros.sampling.cdr import trajectory_size
from calib_ros.sampling.decoding import alike
from calib_ros.sampling.message_layout import message_layout
from calib_ros.sampling.messages import JOINT_STATE, MEASURES, head_of
from calib_ros.sampling.slices import Part
from calib_ros.sampling.usable import usable

NAMES = st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=12)
NUMBERS = st.floats(-1e6, 1e6)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)


def decode(kind, blobs):
    """Return what messages of one layout say; None where they are of several or of none."""
    found = list(alike(kind, blobs, {}))
    if len(found) != 1 or len(found[0][0]) != len(blobs):
        return None
    which, *held = found[0]
    return Part(which, None, *held)


def of_pose(pose):
    return [*(getattr(pose.position, x) for x in 'xyz'), *of_turn(pose.orientation)]


def of_turn(turn):
    return [getattr(turn, x) for x in 'xyzw']


def of_covariance(message):
    return [*of_pose(message.pose.pose), *message.pose.covariance]


NUMBERS_OF = {
    'geometry_msgs/msg/PoseStamped': lambda m: of_pose(m.pose),
    'geometry_msgs/msg/PoseWithCovarianceStamped': of_covariance,
    'geometry_msgs/msg/PointStamped': lambda m: [m.point.x, m.point.y, m.point.z],
    'geometry_msgs/msg/TransformStamped': lambda m: [
        *(getattr(m.transform.translation, x) for x in 'xyz'),
        *of_turn(m.transform.rotation),
    ],
    'nav_msgs/msg/Odometry': of_covariance,
    'sensor_msgs/msg/Range': lambda m: [m.range],
    JOINT_STATE: lambda m: m.position,
}


def assert_decoded(kind, blobs):
    """At once as one by one, by another library."""
    found = decode(kind, blobs)
    assert found.numbers.flags.writeable
    for k, blob in enumerate(blobs):
        told = TYPESTORE.deserialize_cdr(blob, kind)
        names = told.name if kind == JOINT_STATE else vars(told).get('child_frame_id')
        strings = told.header.frame_id, *([names] if isinstance(names, str) else names or ())
        stamp_ns, numbers = head_of(told)[0], NUMBERS_OF[kind](told)
        assert (stamp_ns, strings) == (found.stamps[k], found.strings)
        np.testing.assert_array_equal(numbers, found.numbers[k])


def message(kind, head, child, numbers):
    where, covariance = (numbers[:3], numbers[3:]), np.arange(36.0) + numbers[0]
    made = {
        'geometry_msgs/msg/PoseStamped': lambda: pose_stamped(0, *where),
        'geometry_msgs/msg/PointStamped': lambda: point_stamped(0, where[0]),
        'geometry_msgs/msg/PoseWithCovarianceStamped': lambda: pose_with_covariance(
            0, covariance, where
        ),
        'geometry_msgs/msg/TransformStamped': lambda: transform_stamped(0, *where, child),
        'nav_msgs/msg/Odometry': lambda: odometry(0, covariance, child, where),
        'sensor_msgs/msg/Range': lambda: distance(0, np.float32(numbers[0])),
    }[kind]()
    made.header = head
    return made


@given(
    st.sampled_from(sorted(MEASURES)),
    NAMES,
    NAMES,
    st.lists(st.tuples(STAMPS, st.lists(NUMBERS, min_size=7, max_size=7)), min_size=1, max_size=5),
    st.booleans(),
)
def test_measurements_are_decoded_as_by_rosbags(kind, frame_id, child, rows, little_endian):
    made = [message(kind, header(stamp, frame_id), child, n) for stamp, n in rows]
    write = TYPESTORE.serialize_cdr
    assert_decoded(kind, [bytes(write(each, kind, little_endian=little_endian)) for each in made])


@given(
    NAMES,
    st.lists(NAMES, max_size=8),
    st.lists(st.tuples(STAMPS, NUMBERS), min_size=1, max_size=5),
)
def test_joint_states_are_decoded_as_by_rosbags(frame_id, names, rows):
    blobs = []
    for stamp, value in rows:
        positions = value + np.arange(float(len(names)))
        blobs.append(joint_blob(names, positions, frame_id, stamp, positions))
    assert_decoded(JOINT_STATE, blobs)


def joint_blob(names, positions, frame_id='', stamp_ns=10**9, velocities=()):
    head, velocities = header(stamp_ns, frame_id), np.array(velocities, dtype=float)
    given_ = TYPES[JOINT_STATE](head, names, np.array(positions), velocities, np.zeros(0))
    return bytes(TYPESTORE.serialize_cdr(given_, JOINT_STATE))


def test_layouts_without_end_are_decoded_and_not_kept():
    names = [['a' * (4 * k + 3), 'b' * (239 - 4 * k)] for k in range(60)]
    blobs, known = [joint_blob(each, [1.0, 2.0]) for each in names], {}
    found = alike(JOINT_STATE, blobs, known)
    assert [list(strings[1:]) for _, strings, *_ in found] == names
    assert sum(map(len, known.values())) == 10


def test_names_of_the_same_lengths_share_a_layout():
    """Each of more than fifty names had one of its own: 37 to 60 us a message, now 1 to 9."""
    blobs, known = [joint_blob([f'{k % 60:03d}'], [float(k)]) for k in range(180)], {}
    blobs[67] = blobs[67].replace(b'007', b'\xff07')  # left out
    found = list(alike(JOINT_STATE, blobs, known))
    assert [strings[1] for _, strings, *_ in found] == [f'{k:03d}' for k in range(60)]
    for k, (which, _, _, numbers) in enumerate(found):
        whole = [each for each in (k, k + 60, k + 120) if each != 67]
        assert which.tolist() == numbers[:, 0].tolist() == whole
    assert sum(map(len, known.values())) == 1


def test_a_message_with_more_names_than_bytes_is_refused_before_they_are_read():
    blob = joint_blob(['aa', 'bb'], [1.0, 2.0]).replace(b'aa', b'\xff\xff')
    with pytest.raises(UnicodeDecodeError):
        message_layout(JOINT_STATE, blob)
    with pytest.raises(struct.error, match='cut off'):
        message_layout(JOINT_STATE, blob[:20] + b'\xff\xff\xff\x7f' + blob[24:])


@pytest.mark.parametrize('cut', [3, 9, 14, 30, -9, -1])
def test_broken_messages_are_left_to_others(cut):
    blob = joint_blob(['a', 'b'], [1.0, 2.0])
    decoded = decode(JOINT_STATE, [blob[:cut]])
    assert decoded is None or decoded.numbers.shape == (1, 2)
    assert decode(JOINT_STATE, [b'\x00\x00' + blob[2:]]) is None  # big-endian


@pytest.mark.parametrize(
    ('good', 'bad', 'cause'),
    [
        ([0.5], [0.0], 'distance not a positive number'),
        ([0.5], [np.inf], 'distance not a positive number'),
        ([0.5], [1.1e6], 'distance beyond 1000 km'),
        ([1.0, 0.0, 0.0], [0.0, -1.1e6, 0.0], 'position beyond 1000 km'),
    ],
)
def test_what_cannot_be_used_is_told_by_its_cause(good, bad, cause):
    stamps, numbers = np.array([5, 6, 0]), np.array([good, bad, good])
    usable_, causes = usable(Part(np.arange(3), None, ('tracker',), stamps, numbers))
    assert usable_.tolist() == [True, False, False]
    assert causes == {cause: 1, 'zero stamp (fill header.stamp where it is published)': 1}


def trajectory(frame_id, names, points):
    duration = TYPES['builtin_interfaces/msg/Duration'](0, 0)
    row, none = np.zeros(len(names)), np.zeros(0)
    point = TYPES['trajectory_msgs/msg/JointTrajectoryPoint'](row, none, none, none, duration)
    kind = 'trajectory_msgs/msg/JointTrajectory'
    message = TYPES[kind](header(1_000_000_002, frame_id), names, [point] * points)
    return [bytes(TYPESTORE.serialize_cdr(message, kind, little_endian=e)) for e in (True, False)]


@given(NAMES, st.lists(NAMES, max_size=8), st.integers(0, 20))
def test_the_size_of_a_trajectory_is_known_without_decoding_it(frame_id, names, points):
    for data in trajectory(frame_id, names, points):
        assert trajectory_size(data, 10_000) == (len(names), points)
        for end in range(len(data)):
            found = trajectory_size(data[:end], 10_000)
            assert found[0] in (0, len(names))
            assert found[1] in (0, points)


def test_a_trajectory_that_names_joints_without_end_is_not_gone_through():
    little, _ = trajectory('', [''] * 20_000, 3)
    assert trajectory_size(little, 10_000) == (20_000, 0)
