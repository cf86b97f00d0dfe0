# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Streams of messages from a moving arm."""

import numpy as np
import recorded

from calib_ros.apply.simulation import motion
from calib_ros.kinematics import se3
from calib_ros.sampling.batches import feed
from calib_ros.sampling.messages import JOINT_STATE
from calib_ros.sampling.slices import Part
from calib_ros.sampling.sources import Source
from calib_ros.sampling.streams import Stream

MS = 1_000_000
S = 1_000_000_000
START = 1_717_171_717 * S  # beyond what a float64 holds to the nanosecond
POSE = 'geometry_msgs/msg/PoseStamped'
TRANSFORM = 'geometry_msgs/msg/TransformStamped'
RANGE = 'sensor_msgs/msg/Range'
TRACKER = Source('measured_pose')


def take(session, *come):
    """Let a session take messages (source or None for joints, type, message) in their order."""
    batch = [
        (Stream(source.topic if source else '', kind, source), recorded.serialised(message))
        for source, kind, message in come
    ]
    assert feed(session, batch, recorded.TYPESTORE.deserialize_cdr) == []


def of_joints(message):
    return None, JOINT_STATE, message


def hear(session, joints, measured):
    """Let a session hear joint values (N, n), and positions and rotations or None, in order.

    Each comes after the times at which they arrive (N,) and their stamps (N,).
    """
    (came, joint_stamps, values), (seen, seen_stamps, positions, rotations) = joints, measured
    places = np.empty(len(came) + len(seen), dtype=int)
    places[np.argsort(np.concatenate([came, seen]), kind='stable')] = np.arange(len(places))
    if rotations is not None:
        positions = np.hstack([positions, se3.to_quat(rotations)])
    first, second = np.split(places, [len(came)])
    named = Part(first, None, ('', *session.joint_names), joint_stamps, values)
    session.take([named, Part(second, TRACKER, ('tracker',), seen_stamps, positions)])


def joint_state(stamp_ns, names, values):
    return recorded.joint_state(stamp_ns, values, names)


def pose(stamp_ns, position, rotation=None):
    turn = [] if rotation is None else [se3.to_quat(rotation).tolist()]
    return recorded.pose_stamped(stamp_ns, position, *turn)


def transform(stamp_ns, position, child, rotation=None):
    turn = {} if rotation is None else {'quat': se3.to_quat(rotation).tolist()}
    return recorded.transform_stamped(stamp_ns, position, child=child, **turn)


def stops(configurations, move=1.0, stand=1.0):
    """Return a function of times (N,) [s]: joints that stand at each row for a while."""
    return motion(configurations, move, stand)


def sweep(count, rng, reach=1.0):
    """Return a smooth function of times (N,) [s]: each joint by sines of its own."""
    shape = (4, count)
    frequency, phase = rng.uniform(0.05, 0.3, shape), rng.uniform(0.0, 2.0 * np.pi, shape)
    size = rng.uniform(0.2, 1.0, shape) * reach / 2.0

    def joints(times):
        angle = 2.0 * np.pi * frequency * np.asarray(times)[:, np.newaxis, np.newaxis] + phase
        return (size * np.sin(angle)).sum(axis=1)

    return joints


def stamps(times):
    return START + np.round(np.asarray(times) * 1e9).astype(np.int64)
