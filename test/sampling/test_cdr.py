# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, strategies as st
from rosbags.typesys import Stores, get_typestore

from calib_ros.sampling.cdr import alike, trajectory_size
from calib_ros.sampling.messages import DECODERS, JOINT_STATE, Readings, reading, usable

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
NAMES = st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=12)
NUMBERS = st.floats(-1e6, 1e6)
SECONDS, NANOSECONDS = st.integers(0, 2**31 - 1), st.integers(0, 999_999_999)


def decode(kind, blobs):
    """Return what messages of one layout say; None where they are of several or of none."""
    found = alike(kind, blobs, {})
    return found[0].of(0) if len(found) == 1 and len(found[0].which) == len(blobs) else None


def assert_decoded(kind, blobs):
    """At once as one by one."""
    found = decode(kind, blobs)
    for k, blob in enumerate(blobs):
        stamp_ns, strings, numbers = reading(kind, STORE.deserialize_cdr(blob, kind))
        assert (stamp_ns, strings) == (found.stamps_ns[k], found.strings)
        np.testing.assert_array_equal(numbers, found.numbers[k])


def header(seconds, nanoseconds, frame_id):
    time = TYPES['builtin_interfaces/msg/Time'](seconds, nanoseconds)
    return TYPES['std_msgs/msg/Header'](time, frame_id)


def pose(numbers):
    point = TYPES['geometry_msgs/msg/Point'](*numbers[:3])
    return TYPES['geometry_msgs/msg/Pose'](
        point, TYPES['geometry_msgs/msg/Quaternion'](*numbers[3:7])
    )


def message(kind, head, child, numbers):
    cls = TYPES[kind]
    covariance = np.arange(36.0) + numbers[0]
    if kind == 'geometry_msgs/msg/PoseStamped':
        return cls(head, pose(numbers))
    if kind == 'geometry_msgs/msg/PointStamped':
        return cls(head, TYPES['geometry_msgs/msg/Point'](*numbers[:3]))
    if kind == 'sensor_msgs/msg/Range':
        return cls(head, 0, *np.float32(numbers[:5]))
    if kind == 'geometry_msgs/msg/TransformStamped':
        shift = TYPES['geometry_msgs/msg/Vector3'](*numbers[:3])
        turn = TYPES['geometry_msgs/msg/Quaternion'](*numbers[3:7])
        return cls(head, child, TYPES['geometry_msgs/msg/Transform'](shift, turn))
    with_covariance = TYPES['geometry_msgs/msg/PoseWithCovariance'](pose(numbers), covariance)
    if kind == 'nav_msgs/msg/Odometry':
        zero = TYPES['geometry_msgs/msg/Vector3'](0.0, 0.0, 0.0)
        twist = TYPES['geometry_msgs/msg/Twist'](zero, zero)
        return cls(
            head,
            child,
            with_covariance,
            TYPES['geometry_msgs/msg/TwistWithCovariance'](twist, covariance),
        )
    return cls(head, with_covariance)


@given(
    st.sampled_from(sorted(DECODERS)),
    NAMES,
    NAMES,
    st.lists(
        st.tuples(SECONDS, NANOSECONDS, st.lists(NUMBERS, min_size=7, max_size=7)),
        min_size=1,
        max_size=5,
    ),
)
def test_measurements_are_decoded_as_by_rosbags(kind, frame_id, child, rows):
    made = [message(kind, header(s, ns, frame_id), child, n) for s, ns, n in rows]
    assert_decoded(kind, [bytes(STORE.serialize_cdr(each, kind)) for each in made])


@given(
    NAMES,
    st.lists(NAMES, max_size=8),
    st.lists(st.tuples(SECONDS, NANOSECONDS, NUMBERS), min_size=1, max_size=5),
)
def test_joint_states_are_decoded_as_by_rosbags(frame_id, names, rows):
    empty = np.zeros(0)
    blobs = []
    for seconds, nanoseconds, value in rows:
        positions = value + np.arange(float(len(names)))
        head = header(seconds, nanoseconds, frame_id)
        given_ = TYPES[JOINT_STATE](head, names, positions, positions, empty)
        blobs.append(bytes(STORE.serialize_cdr(given_, JOINT_STATE)))
    assert_decoded(JOINT_STATE, blobs)


def joint_blob(names, positions, frame_id=''):
    empty = np.zeros(0)
    given_ = TYPES[JOINT_STATE](header(1, 0, frame_id), names, np.array(positions), empty, empty)
    return bytes(STORE.serialize_cdr(given_, JOINT_STATE))


def test_messages_of_one_length_are_told_apart_by_their_names():
    one, other = joint_blob(['a', 'b'], [1.0, 2.0]), joint_blob(['b', 'a'], [1.0, 2.0])
    in_frame = joint_blob(['a', 'b'], [1.0, 2.0], 'x')
    assert len(one) == len(other) == len(in_frame)
    known = {}
    for _ in range(2):
        found = alike(JOINT_STATE, [one, other, one, in_frame], known)
        assert [each.which.tolist() for each in found] == [[0, 2], [1], [3]]
        strings = [('', 'a', 'b'), ('', 'b', 'a'), ('x', 'a', 'b')]
        assert [each.of(0).strings for each in found] == strings
    assert [len(each) for each in known.values()] == [3]


def test_of_more_layouts_than_there_are_names_the_others_are_left():
    blobs = [joint_blob([f'{k:03d}'], [float(k)]) for k in range(60)]
    found = alike(JOINT_STATE, blobs, {})
    assert [each.of(0).strings[1] for each in found] == [f'{k:03d}' for k in range(50)]


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
    found = Readings(np.array([5, 6, 0]), ('tracker',), np.array([good, bad, good]))
    usable_, causes = usable('', found)
    assert usable_.tolist() == [True, False, False]
    assert causes == {cause: 1, 'zero stamp (fill header.stamp where it is published)': 1}


def trajectory(frame_id, names, points):
    duration = TYPES['builtin_interfaces/msg/Duration'](0, 0)
    row, none = np.zeros(len(names)), np.zeros(0)
    point = TYPES['trajectory_msgs/msg/JointTrajectoryPoint'](row, none, none, none, duration)
    kind = 'trajectory_msgs/msg/JointTrajectory'
    message = TYPES[kind](header(1, 2, frame_id), names, [point] * points)
    return [bytes(STORE.serialize_cdr(message, kind, little_endian=e)) for e in (True, False)]


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
