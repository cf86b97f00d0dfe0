# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Types of messages, and what is read of them.

Decoded ones are read by their attributes only, so those of rclpy and rosbags are alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

JOINT_STATE = 'sensor_msgs/msg/JointState'
TRANSFORM = 'geometry_msgs/msg/TransformStamped'
TRANSFORMS = 'tf2_msgs/msg/TFMessage'
BODIES = {
    'mocap4r2_msgs/msg/RigidBodies': ('rigidbodies', 'rigid_body_name'),
    'motion_capture_tracking_interfaces/msg/NamedPoseArray': ('poses', 'name'),
}
"""Message types of named poses in one frame (motion capture): fields of poses and names."""
LINKS = (TRANSFORMS, *BODIES)  # message types that link several frames at once
FORMS: dict[str, tuple[int, int, str, int]] = {
    'geometry_msgs/msg/PoseStamped': (1, 0, 'f8', 7),
    'geometry_msgs/msg/PoseWithCovarianceStamped': (1, 0, 'f8', 43),
    'geometry_msgs/msg/PointStamped': (1, 0, 'f8', 3),
    TRANSFORM: (2, 0, 'f8', 7),
    'nav_msgs/msg/Odometry': (2, 0, 'f8', 43),
    'sensor_msgs/msg/Range': (1, 13, 'f4', 1),  # after field of view, least and greatest range
    TRANSFORMS: (2, 0, 'f8', 7),
    JOINT_STATE: (1, 0, 'f8', 0),
}
"""By type: strings before the numbers, bytes between, kind and count of the numbers."""
MEASURES = tuple(kind for kind in FORMS if kind not in (TRANSFORMS, JOINT_STATE))
"""Types of messages that hold one measurement."""
PICTURES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'


Reading: TypeAlias = tuple[int, tuple[str, ...], Sequence[float]]
"""Stamp [ns], strings and numbers of one reading, as in `Part`."""


def bodies_of(kind: str, message: Any) -> list[Reading]:
    """Return a row for each body of a message, with its pose."""
    stamp_ns, frame_id = head_of(message)
    bodies, name = BODIES[kind]
    found: list[Reading] = []
    for body in getattr(message, bodies):
        at, turn = body.pose.position, body.pose.orientation
        numbers = (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)
        found.append((stamp_ns, (frame_id, getattr(body, name)), numbers))
    return found


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
