# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS messages to numbers, by their attributes only: rclpy's and rosbags' messages alike.

Each decoder raises `MessageError` for a message that cannot be used; its text is the cause under
which the message is counted.
"""

from __future__ import annotations

import math
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


class Reading(NamedTuple):
    """One measurement: position [m], quaternion and covariance as far as they were measured.

    A measured distance [m] comes without a position. `child` names the target where the message
    does.
    """

    stamp_ns: int
    frame_id: str
    position: tuple[float, float, float] | None = None
    quat_xyzw: tuple[float, float, float, float] | None = None
    covariance: FloatArray | None = None
    distance: float | None = None
    child: str = ''


def joint_state(message: Any) -> JointReading:
    """Decode a sensor_msgs/JointState."""
    values = np.asarray(message.position, dtype=np.float64)
    if len(message.name) != len(values):
        raise MessageError('names and positions differ in number')
    return JointReading(stamp(message.header.stamp), message.name, values)


def pose_stamped(message: Any) -> Reading:
    """Decode a geometry_msgs/PoseStamped."""
    return _pose(message.header, message.pose.position, message.pose.orientation)


def pose_with_covariance(message: Any) -> Reading:
    """Decode a geometry_msgs/PoseWithCovarianceStamped; a covariance of zeros means none."""
    pose = message.pose.pose
    reading = _pose(message.header, pose.position, pose.orientation)
    return reading._replace(covariance=_covariance(message.pose.covariance))


def point_stamped(message: Any) -> Reading:
    """Decode a geometry_msgs/PointStamped."""
    return _pose(message.header, message.point, None)


def transform_stamped(message: Any) -> Reading:
    """Decode a geometry_msgs/TransformStamped; each child frame is a target."""
    transform = message.transform
    reading = _pose(message.header, transform.translation, transform.rotation)
    return reading._replace(child=message.child_frame_id)


def odometry(message: Any) -> Reading:
    """Decode a nav_msgs/Odometry, of which only the pose counts."""
    return pose_with_covariance(message)._replace(child=message.child_frame_id)


def distance(message: Any) -> Reading:
    """Decode a sensor_msgs/Range: the distance of a draw-wire or ball-bar."""
    value = float(message.range)
    if not (np.isfinite(value) and value > 0.0):
        raise MessageError('distance not a positive number')
    return Reading(stamp(message.header.stamp), message.header.frame_id, distance=value)


DECODERS: dict[str, Callable[[Any], Reading]] = {
    'geometry_msgs/msg/PoseStamped': pose_stamped,
    'geometry_msgs/msg/PoseWithCovarianceStamped': pose_with_covariance,
    'geometry_msgs/msg/PointStamped': point_stamped,
    'geometry_msgs/msg/TransformStamped': transform_stamped,
    'nav_msgs/msg/Odometry': odometry,
    'sensor_msgs/msg/Range': distance,
}
"""Types of measurements."""


def stamp(time: Any) -> int:
    """Turn a builtin_interfaces/Time into nanoseconds."""
    stamp_ns = time.sec * 1_000_000_000 + time.nanosec
    if stamp_ns <= 0:
        raise MessageError('zero stamp')
    return int(stamp_ns)


def _pose(header: Any, point: Any, quaternion: Any) -> Reading:
    stamp_ns = stamp(header.stamp)
    position = (float(point.x), float(point.y), float(point.z))
    if not all(map(math.isfinite, position)):
        raise MessageError('NaN or infinite position')
    quat = None
    if quaternion is not None:
        quat = (quaternion.x, quaternion.y, quaternion.z, quaternion.w)
        length = math.sqrt(sum(part * part for part in quat))
        if not abs(length - 1.0) <= QUATERNION_TOLERANCE:
            raise MessageError('quaternion not of length 1')
    return Reading(stamp_ns, header.frame_id, position, quat)


def _covariance(numbers: Any) -> FloatArray | None:
    covariance = np.array(numbers, dtype=np.float64).reshape(6, 6)
    if not covariance.any():
        return None
    if not np.isfinite(covariance).all():
        raise MessageError('covariance with NaN or infinite values')
    if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-15):
        raise MessageError('covariance not symmetric')
    if np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise MessageError('covariance not positive definite')
    return covariance
