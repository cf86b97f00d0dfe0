# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS messages to numbers, by their attributes only: rclpy's and rosbags' messages alike.

Each decoder raises `MessageError` for a message that cannot be used; its text is the cause under
which the message is counted.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import InputError
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.values import LARGEST as LARGEST
from calib_ros.values import QUATERNION_TOLERANCE, covariance_fault

JOINT_STATE = 'sensor_msgs/msg/JointState'
TRANSFORM = 'geometry_msgs/msg/TransformStamped'
TRANSFORMS = 'tf2_msgs/msg/TFMessage'
BODIES = {
    'mocap4r2_msgs/msg/RigidBodies': ('rigidbodies', 'rigid_body_name'),
    'motion_capture_tracking_interfaces/msg/NamedPoseArray': ('poses', 'name'),
}
"""Types of poses by name in one frame, of motion capture: their fields of the poses and names."""
LINKS = (TRANSFORMS, *BODIES)
"""Types of messages that link several frames at once."""


class MessageError(InputError):
    """A message that cannot be used."""


class JointReading(NamedTuple):
    """Joint values of one JointState, in the message's own order [rad or m]."""

    stamp_ns: int
    names: Sequence[str]
    values: Sequence[float]


class JointReadings(NamedTuple):
    """Joint values (N, k) of N JointStates that name the same joints, at stamps (N,)."""

    stamps_ns: NDArray[np.int64]
    names: tuple[str, ...]
    values: FloatArray

    def row(self, k: int) -> JointReading:
        """Return one of them."""
        return JointReading(int(self.stamps_ns[k]), self.names, self.values[k].tolist())


class Reading(NamedTuple):
    """One measurement: position [m], quaternion and covariance (36) as far as they were measured.

    A measured distance [m] comes without a position. `child` names the target where the message
    does.
    """

    stamp_ns: int
    frame_id: str
    position: tuple[float, float, float] | None = None
    quat_xyzw: tuple[float, float, float, float] | None = None
    covariance: tuple[float, ...] | None = None
    distance: float | None = None
    child: str = ''

    @property
    def numbers(self) -> tuple[float, ...]:
        """Return what was measured in one row; what comes last may be missing."""
        if self.distance is not None:
            return (self.distance,)
        return (self.position or ()) + (self.quat_xyzw or ()) + (self.covariance or ())


class Readings(NamedTuple):
    """Measurements at stamps (N,) in one frame and of one target.

    `numbers` (N, w) are those of `Reading`, NaN for a covariance that was not measured.
    """

    stamps_ns: NDArray[np.int64]
    frame_id: str
    child: str
    distance: bool
    numbers: FloatArray

    def row(self, k: int) -> Reading:
        """Return one of them."""
        stamp_ns, numbers = int(self.stamps_ns[k]), tuple(self.numbers[k].tolist())
        if self.distance:
            return Reading(stamp_ns, self.frame_id, distance=numbers[0], child=self.child)
        x, y, z, *rest = numbers
        known = len(rest) > 4 and not math.isnan(rest[4])
        return Reading(
            stamp_ns,
            self.frame_id,
            (x, y, z),
            (rest[0], rest[1], rest[2], rest[3]) if rest else None,
            tuple(rest[4:]) if known else None,
            child=self.child,
        )


def joint_state(message: Any) -> JointReading:
    """Decode a sensor_msgs/JointState."""
    names, values = message.name, message.position
    if len(names) != len(values):
        raise MessageError('names and positions differ in number')
    return JointReading(stamp(message.header.stamp), names, values)


def pose_stamped(message: Any) -> Reading:
    """Decode a geometry_msgs/PoseStamped."""
    return _pose(message.header, message.pose.position, message.pose.orientation)


def pose_with_covariance(message: Any) -> Reading:
    """Decode a geometry_msgs/PoseWithCovarianceStamped; a covariance of zeros means none."""
    pose = message.pose.pose
    reading = _pose(message.header, pose.position, pose.orientation)
    return reading._replace(covariance=measured_covariance(message.pose.covariance))


def point_stamped(message: Any) -> Reading:
    """Decode a geometry_msgs/PointStamped."""
    return _pose(message.header, message.point, None)


def transform_stamped(message: Any) -> Reading:
    """Decode a geometry_msgs/TransformStamped; each child frame is a target."""
    transform = message.transform
    reading = _pose(message.header, transform.translation, transform.rotation)
    return reading._replace(child=_name(message.child_frame_id))


def odometry(message: Any) -> Reading:
    """Decode a nav_msgs/Odometry, of which only the pose counts."""
    return pose_with_covariance(message)._replace(child=_name(message.child_frame_id))


def distance(message: Any) -> Reading:
    """Decode a sensor_msgs/Range: the distance of a draw-wire or ball-bar."""
    value = float(message.range)
    if not (np.isfinite(value) and value > 0.0):
        raise MessageError('distance not a positive number')
    if value > LARGEST:
        raise MessageError('distance beyond 1000 km')
    return Reading(stamp(message.header.stamp), message.header.frame_id, distance=value)


DECODERS: dict[str, Callable[[Any], Reading]] = {
    'geometry_msgs/msg/PoseStamped': pose_stamped,
    'geometry_msgs/msg/PoseWithCovarianceStamped': pose_with_covariance,
    'geometry_msgs/msg/PointStamped': point_stamped,
    TRANSFORM: transform_stamped,
    'nav_msgs/msg/Odometry': odometry,
    'sensor_msgs/msg/Range': distance,
}
"""Types of measurements."""


def transforms_in(message: Any, kind: str) -> Sequence[Any]:
    """Return what a message that links several frames holds, each like a TransformStamped."""
    if kind == TRANSFORMS:
        found: Sequence[Any] = message.transforms
        return found
    bodies, name = BODIES[kind]
    return [
        SimpleNamespace(
            header=message.header,
            child_frame_id=getattr(body, name),
            transform=SimpleNamespace(
                translation=body.pose.position, rotation=body.pose.orientation
            ),
        )
        for body in getattr(message, bodies)
    ]


def frame_name(name: str) -> str:
    """Return the name of a frame without the slash that older programs write before it."""
    return name.removeprefix('/')


def stamp(time: Any) -> int:
    """Turn a builtin_interfaces/Time into nanoseconds."""
    stamp_ns: int = time.sec * 1_000_000_000 + time.nanosec
    if stamp_ns <= 0:
        raise MessageError('zero stamp')
    return stamp_ns


def _pose(header: Any, point: Any, quaternion: Any) -> Reading:
    stamp_ns = stamp(header.stamp)
    position = x, y, z = point.x, point.y, point.z
    if not math.isfinite(x + y + z):
        raise MessageError('NaN or infinite position')
    if max(abs(x), abs(y), abs(z)) > LARGEST:
        raise MessageError('position beyond 1000 km')
    quat = None
    if quaternion is not None:
        quat = qx, qy, qz, qw = quaternion.x, quaternion.y, quaternion.z, quaternion.w
        length = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
        if not abs(length - 1.0) <= QUATERNION_TOLERANCE:
            raise MessageError('quaternion not of length 1')
    return Reading(stamp_ns, header.frame_id, position, quat)


def _name(child: str) -> str:
    if not child.isprintable():  # it shall be a cell of a table
        raise MessageError('child frame whose name cannot be printed')
    return child


def measured_covariance(numbers: Any) -> tuple[float, ...] | None:
    """Return a covariance (36) row by row; one of zeros means none."""
    return _checked_covariance(np.asarray(numbers, dtype=np.float64).tobytes())


@functools.lru_cache(maxsize=16)  # most devices send the same one for ever
def _checked_covariance(data: bytes) -> tuple[float, ...] | None:
    covariance = np.frombuffer(data).reshape(6, 6)
    if not covariance.any():
        return None
    fault = covariance_fault(covariance)
    if fault:
        raise MessageError(fault)
    return tuple(covariance.ravel().tolist())
