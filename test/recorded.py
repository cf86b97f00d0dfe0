# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of a small arm, and bags of them."""

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from calib_ros.apply import simulation
from calib_ros.files.bags import replay
from calib_ros.files.recording import Recording
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.sampling.messages import JOINT_STATE
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.streams import Stream
from calib_ros.settings import STORAGES, Settings

MS = 1_000_000
TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = TYPESTORE.types
ARM = Chain(
    'arm',
    'standard',
    (Joint('a', alpha=1.5, d=0.3), Joint('b', a=0.4), Joint('c', 'prismatic', a=0.1)),
)
STREAMS = {
    '/joint_states': Stream('/joint_states', JOINT_STATE),
    '/pose': Stream('/pose', 'geometry_msgs/msg/PoseStamped'),
}
storages = pytest.mark.parametrize('storage', sorted(STORAGES))


def header(stamp_ns, frame_id='tracker'):
    time = TYPES['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 1_000_000_000))
    return TYPES['std_msgs/msg/Header'](time, frame_id)


def stamp_ns(message):
    stamp = getattr(message, 'transforms', [message])[0].header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def joint_state(stamp_ns, values=(0.1, 0.2, 0.3), names=('a', 'b', 'c')):
    values, none = np.array(values, dtype=float), np.zeros(0)
    return TYPES[JOINT_STATE](header(stamp_ns, ''), list(names), values, none, none)


def pose(position=(1.0, 2.0, 3.0), quat=(0.0, 0.0, 0.0, 1.0)):
    return TYPES['geometry_msgs/msg/Pose'](
        TYPES['geometry_msgs/msg/Point'](*position), TYPES['geometry_msgs/msg/Quaternion'](*quat)
    )


def pose_stamped(stamp_ns, position=(1.0, 2.0, 3.0), quat=(0.0, 0.0, 0.0, 1.0), frame='tracker'):
    return TYPES['geometry_msgs/msg/PoseStamped'](header(stamp_ns, frame), pose(position, quat))


def point_stamped(stamp_ns, position=(1.0, 2.0, 3.0)):
    point = TYPES['geometry_msgs/msg/Point'](*position)
    return TYPES['geometry_msgs/msg/PointStamped'](header(stamp_ns), point)


def transform_stamped(
    stamp_ns, position=(1.0, 2.0, 3.0), quat=(0.0, 0.0, 0.0, 1.0), child='target'
):
    transform = TYPES['geometry_msgs/msg/Transform'](
        TYPES['geometry_msgs/msg/Vector3'](*position), TYPES['geometry_msgs/msg/Quaternion'](*quat)
    )
    kind = TYPES['geometry_msgs/msg/TransformStamped']
    return kind(header(stamp_ns), child, transform)


def pose_with_covariance(stamp_ns, covariance, where=()):
    covariance = np.array(covariance, dtype=float).ravel()
    with_covariance = TYPES['geometry_msgs/msg/PoseWithCovariance'](pose(*where), covariance)
    kind = TYPES['geometry_msgs/msg/PoseWithCovarianceStamped']
    return kind(header(stamp_ns), with_covariance)


def odometry(stamp_ns, covariance=None, child='base_link', where=()):
    covariance = np.zeros(36) if covariance is None else np.array(covariance, dtype=float).ravel()
    nothing = TYPES['geometry_msgs/msg/Vector3'](0.0, 0.0, 0.0)
    twist = TYPES['geometry_msgs/msg/Twist'](nothing, nothing)
    return TYPES['nav_msgs/msg/Odometry'](
        header(stamp_ns),
        child,
        TYPES['geometry_msgs/msg/PoseWithCovariance'](pose(*where), covariance),
        TYPES['geometry_msgs/msg/TwistWithCovariance'](twist, np.zeros(36)),
    )


def distance(stamp_ns, length):
    return TYPES['sensor_msgs/msg/Range'](header(stamp_ns), 0, 0.0, 0.0, 9.0, length, 0.0)


def text_message(text='hello'):
    return TYPES['std_msgs/msg/String'](text)


def write(path, types, content, storage='mcap', mode='none', texts=()):
    """Write (topic, log time, bytes) in the order given, of topics with their types.

    Other `texts` (topic, definition) may define some of these.
    """
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if mode != 'none':
        writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind in types.items():
            given = {'msgdef': dict(texts).get(topic), 'rihs01': TYPESTORE.hash_rihs01(kind)}
            connections[topic] = writer.add_connection(topic, kind, typestore=TYPESTORE, **given)
        for topic, time, data in content:
            writer.write(connections[topic], time, data)
    return path


def serialised(message):
    return bytes(TYPESTORE.serialize_cdr(message, message.__msgtype__))


def record(path, events, storage='mcap', silent=(), behind=b'', texts=()):
    """Write (topic, message) in the order given; `silent` topics (topic, type) get none.

    Some bytes may stand behind each message.
    """
    types = dict([*silent, *((topic, message.__msgtype__) for topic, message in events)])
    content = [(topic, k, serialised(m) + behind) for k, (topic, m) in enumerate(events, 1)]
    return write(path, types, content, storage, texts=texts)


def standing(messages, topic='/pose'):
    """Return joint samples every 10 ms from 10 ms to 1 s, and the messages after them."""
    samples = [('/joint_states', joint_state(k * 10 * MS)) for k in range(1, 101)]
    return [*samples, *((topic, message) for message in messages)]


def session_of(path, **settings):
    """Replay a bag, every measurement a sample of its own unless told otherwise."""
    each = {'mode': 'continuous', 'delay': 1e-12}  # known, so that it is not looked for
    session = CalibrationSession(ARM, Settings(**each | settings))
    warnings = replay(path, session).warnings
    return session, warnings


def account_of(path, **settings):
    return session_of(path, **settings)[0].account()


def observations_of(path, **settings):
    return session_of(path, **settings)[0].problem().observations


def recording(count=30, oriented=True, held_out=0, seed=3):
    rng = np.random.default_rng(seed)
    configurations = ARM.random_joints(count, rng)
    stamps, joints, pose_stamps = simulation.drive(
        configurations, simulation.Cell(move=0.2, dwell=0.1, poses_per_dwell=1), 10**18
    )
    measured = simulation.measure(ARM, configurations, rng, 1e-4, 1e-4, oriented)
    judging = np.arange(count) % 5 < held_out
    return Recording(ARM.joint_names, stamps, joints, measured.at(pose_stamps), judging)


def assert_equal(found, expected):
    for name in ('stamps_ns', 'joints', 'positions', 'oriented'):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
    np.testing.assert_allclose(found.rotations, expected.rotations, atol=1e-14)
    assert found.covariance is None
    assert expected.covariance is None


def record_in_chunks(path, storage, mode='none', log_time=lambda k, rng: k):
    """Write 300 messages in some chunks of 1 MB, filled with long texts that nobody wants."""
    rng = np.random.default_rng(7)
    types = {each.topic: each.type for each in STREAMS.values()} | {'/x': 'std_msgs/msg/String'}
    content = []
    for k in range(300):
        topic, message = '/joint_states', joint_state((k + 1) * 10 * MS, rng.normal(size=3))
        if k % 3 == 1:
            topic, message = '/pose', pose_stamped((k + 1) * 10 * MS, rng.normal(size=3))
        elif k % 10 == 0:
            topic, message = '/x', text_message(rng.bytes(200_000).hex())
        content.append((topic, 10 + int(log_time(k, rng)), serialised(message)))
    return write(path, types, content, storage, mode)


def damage(path, share=None, metadata=True):
    """Cut the bag's file off, as by a full disk; without metadata as by kill -9."""
    (file,) = (item for item in path.iterdir() if item.suffix in ('.mcap', '.db3'))
    if share is not None:
        content = file.read_bytes()
        file.write_bytes(content[: int(share * len(content))])
    if not metadata:
        (path / 'metadata.yaml').unlink()
    return file
