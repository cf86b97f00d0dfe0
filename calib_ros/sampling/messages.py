# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS messages to numbers.

Messages are read by their attributes only, so those of rclpy and rosbags are alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from calib_ros.errors import InputError

JOINT_STATE = 'sensor_msgs/msg/JointState'
TRANSFORM = 'geometry_msgs/msg/TransformStamped'
TRANSFORMS = 'tf2_msgs/msg/TFMessage'
BODIES = {
    'mocap4r2_msgs/msg/RigidBodies': ('rigidbodies', 'rigid_body_name'),
    'motion_capture_tracking_interfaces/msg/NamedPoseArray': ('poses', 'name'),
}
"""Message types of named poses in one frame (motion capture): fields of poses and names."""
LINKS = (TRANSFORMS, *BODIES)  # message types that link several frames at once
PICTURES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'


Reading: TypeAlias = tuple[int, tuple[str, ...], Sequence[float]]
"""Stamp [ns], strings and numbers of one reading, as in `Part`."""


class MessageError(InputError):
    """A message that cannot be used."""


def _pose(at: Any, turn: Any) -> Sequence[float]:
    return at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w


def _pose_with_covariance(message: Any) -> Sequence[float]:
    pose = message.pose.pose
    return *_pose(pose.position, pose.orientation), *message.pose.covariance


DECODERS: dict[str, Callable[[Any], Sequence[float]]] = {
    'geometry_msgs/msg/PoseStamped': lambda m: _pose(m.pose.position, m.pose.orientation),
    'geometry_msgs/msg/PoseWithCovarianceStamped': _pose_with_covariance,
    'geometry_msgs/msg/PointStamped': lambda m: (m.point.x, m.point.y, m.point.z),
    TRANSFORM: lambda m: _pose(m.transform.translation, m.transform.rotation),
    'nav_msgs/msg/Odometry': _pose_with_covariance,
    'sensor_msgs/msg/Range': lambda m: (m.range,),
}
"""Measurement types, and functions from messages to numbers."""


def readings_of(kind: str, message: Any) -> list[Reading]:
    """Return what a message holds: one row, or one for each of its transforms or bodies."""
    if kind == TRANSFORMS:
        return [row for each in message.transforms for row in readings_of(TRANSFORM, each)]
    stamp_ns, frame_id = head_of(message)
    if kind == JOINT_STATE:
        if len(message.name) != len(message.position):
            raise MessageError('names and positions differ in number')
        return [(stamp_ns, (frame_id, *message.name), message.position)]
    if kind in BODIES:
        bodies, name = BODIES[kind]
        return [
            (stamp_ns, (frame_id, getattr(body, name)), _pose(at.position, at.orientation))
            for body in getattr(message, bodies)
            for at in (body.pose,)
        ]
    child = getattr(message, 'child_frame_id', None)
    strings = (frame_id,) if child is None else (frame_id, child)
    return [(stamp_ns, strings, DECODERS[kind](message))]


def head_of(message: Any) -> tuple[int, str]:
    """Return stamp [ns] and frame of a message."""
    head = message.header
    return head.stamp.sec * 1_000_000_000 + head.stamp.nanosec, head.frame_id


def frame_name(name: str) -> str:
    """Return a frame name without the leading slash of older programs."""
    return name.removeprefix('/')


def short_type(kind: str) -> str:
    """Return a message type without its package."""
    return kind.rpartition('/')[2]
