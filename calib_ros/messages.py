# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS messages to numbers, by their attributes only: rclpy's and rosbags' messages alike.

Each decoder raises `MessageError` for a message that cannot be used; its text is the cause under
which the message is counted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from calib_ros.config import QUATERNION_TOLERANCE
from calib_ros.errors import InputError
from calib_ros.se3 import FloatArray

JOINT_STATE = 'sensor_msgs/msg/JointState'


class MessageError(InputError):
    """A message that cannot be used."""


class JointReading(NamedTuple):
    """Joint values of one JointState, in the message's own order [rad or m]."""

    stamp_ns: int
    names: list[str]
    values: FloatArray


class PoseReading(NamedTuple):
    """One measured pose: position [m]; quaternion and covariance when they were measured."""

    stamp_ns: int
    frame_id: str
    position: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float] | None
    covariance: FloatArray | None


def joint_state(message: Any) -> JointReading:
    """Decode a sensor_msgs/JointState."""
    values = np.asarray(message.position, dtype=np.float64)
    if len(message.name) != len(values):
        raise MessageError('names and positions differ in number')
    return JointReading(stamp(message.header.stamp), message.name, values)


def pose_stamped(message: Any) -> PoseReading:
    """Decode a geometry_msgs/PoseStamped."""
    return _pose(message.header, message.pose.position, message.pose.orientation, None)


def pose_with_covariance(message: Any) -> PoseReading:
    """Decode a geometry_msgs/PoseWithCovarianceStamped; a covariance of zeros means none."""
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    pose = message.pose.pose
    if not covariance.any():
        return _pose(message.header, pose.position, pose.orientation, None)
    if not np.isfinite(covariance).all():
        raise MessageError('covariance with NaN or infinite values')
    if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-15):
        raise MessageError('covariance not symmetric')
    if np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise MessageError('covariance not positive definite')
    return _pose(message.header, pose.position, pose.orientation, covariance)


def point_stamped(message: Any) -> PoseReading:
    """Decode a geometry_msgs/PointStamped."""
    return _pose(message.header, message.point, None, None)


def transform_stamped(message: Any) -> PoseReading:
    """Decode a geometry_msgs/TransformStamped; each child is a frame of its own."""
    transform = message.transform
    reading = _pose(message.header, transform.translation, transform.rotation, None)
    return reading._replace(frame_id=f'{reading.frame_id} to {message.child_frame_id}')


POSE_DECODERS: dict[str, Callable[[Any], PoseReading]] = {
    'geometry_msgs/msg/PoseStamped': pose_stamped,
    'geometry_msgs/msg/PoseWithCovarianceStamped': pose_with_covariance,
    'geometry_msgs/msg/PointStamped': point_stamped,
    'geometry_msgs/msg/TransformStamped': transform_stamped,
}


def stamp(time: Any) -> int:
    """Turn a builtin_interfaces/Time into nanoseconds."""
    stamp_ns = time.sec * 1_000_000_000 + time.nanosec
    if stamp_ns <= 0:
        raise MessageError('zero stamp')
    return int(stamp_ns)


def _pose(header: Any, point: Any, quaternion: Any, covariance: FloatArray | None) -> PoseReading:
    stamp_ns = stamp(header.stamp)
    position = (float(point.x), float(point.y), float(point.z))
    if not np.isfinite(position).all():
        raise MessageError('NaN or infinite position')
    quat = None
    if quaternion is not None:
        quat = (quaternion.x, quaternion.y, quaternion.z, quaternion.w)
        length = float(np.sqrt(sum(part * part for part in quat)))
        if not abs(length - 1.0) <= QUATERNION_TOLERANCE:
            raise MessageError('quaternion not of length 1')
    return PoseReading(stamp_ns, header.frame_id, position, quat, covariance)
