# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS messages to numbers.

Messages are read by their attributes only, so those of rclpy and rosbags are alike. Unusable ones
are counted by cause.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import InputError
from calib_ros.kinematics.se3 import Flags, FloatArray
from calib_ros.values import LARGEST, ROUNDED, covariance_faults

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
NO_STAMP = 'zero stamp (fill header.stamp where it is published)'
NOT_UNIT = 'quaternion not of length 1 (normalise it where it is published)'


Reading: TypeAlias = tuple[int, tuple[str, ...], Sequence[float]]
"""Stamp [ns], strings and numbers of one reading, as in `Readings`."""


class MessageError(InputError):
    """A message that cannot be used."""


class Readings(NamedTuple):
    """Numbers of N messages with the same names.

    `strings` are frame and child frame (if any) of a measurement, or the frame and the joint
    names. `numbers` (N, w) are joint values [rad or m]; or a distance [m] (w = 1), a position [m]
    (3), a pose with its quaternion x y z w (7), or a pose and a covariance row by row (43); of an
    image its number (1).
    """

    stamps_ns: NDArray[np.int64]
    strings: tuple[str, ...]
    numbers: FloatArray

    @property
    def child(self) -> str:
        """Return the child frame of a measurement, or empty text."""
        return self.strings[1] if len(self.strings) > 1 else ''

    def rows(self, which: slice | NDArray[np.generic]) -> Readings:
        """Return some readings, by a slice, a mask (N,) or indices (K,)."""
        return Readings(self.stamps_ns[which], self.strings, self.numbers[which])


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


def usable(kind: str, found: Readings) -> tuple[Flags, Counter[str]]:
    """Return which readings (N,) can be used, and the causes of the others."""
    numbers, causes = found.numbers, Counter[str]()
    good = np.ones(len(numbers), dtype=bool)

    def refuse(wrong: np.bool_ | Flags, cause: str) -> None:
        count = int((good & wrong).sum())
        if count:
            causes[cause] += count
            good[wrong] = False

    refuse(found.stamps_ns <= 0, NO_STAMP)
    if kind == JOINT_STATE:
        size = np.abs(numbers).max(axis=1)
        refuse(~np.isfinite(size), 'NaN or infinite joint value')
        refuse(size > LARGEST, 'joint value beyond 1e6')
        return good, causes
    if kind in PICTURES:
        return good, causes
    width = numbers.shape[1]
    if width == 1:
        far = numbers[:, 0]
        refuse(~((far > 0.0) & (far < np.inf)), 'distance not a positive number')
        refuse(far > LARGEST, 'distance beyond 1000 km')
    else:
        at = numbers[:, :3]
        refuse(~np.isfinite(at).all(axis=1), 'NaN or infinite position')
        refuse((np.abs(at) > LARGEST).any(axis=1), 'position beyond 1000 km')
    if width >= 7:
        with np.errstate(over='ignore'):  # refused anyway
            length = np.sqrt((numbers[:, 3:7] ** 2).sum(axis=1))
        refuse(~(np.abs(length - 1.0) <= ROUNDED), NOT_UNIT)
    if width > 7:
        rows = numbers[:, 7:]
        fresh = np.append(True, (rows[1:] != rows[:-1]).any(axis=1))  # most devices repeat one
        faults = covariance_faults(rows[fresh].reshape(-1, 6, 6))[np.cumsum(fresh) - 1]
        for fault in dict.fromkeys(faults.tolist()):
            if fault:
                refuse(faults == fault, f'{fault} (leave it zero if it is not known)')
    if not found.child.isprintable():  # it is written to tables
        refuse(good.copy(), 'child frame whose name cannot be printed')
    return good, causes


def frame_name(name: str) -> str:
    """Return a frame name without the leading slash of older programs."""
    return name.removeprefix('/')


def short_type(kind: str) -> str:
    """Return a message type without its package."""
    return kind.rpartition('/')[2]
