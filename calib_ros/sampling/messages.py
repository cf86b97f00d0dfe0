# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS messages to numbers, and their sources.

Messages are read by their attributes only, so those of rclpy and rosbags are alike. Unusable ones
are counted by cause. A source tells what a topic measures, and between which frames.
"""

from __future__ import annotations

import functools
import itertools
import shlex
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ConfigError, InputError, UnknownNameError
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


def reading(kind: str, message: Any) -> tuple[int, tuple[str, ...], Sequence[float]]:
    """Return stamp [ns], strings and numbers of a message, as in `Readings`."""
    stamp_ns, frame_id = head_of(message)
    if kind == JOINT_STATE:
        if len(message.name) != len(message.position):
            raise MessageError('names and positions differ in number')
        return stamp_ns, (frame_id, *message.name), message.position
    child = getattr(message, 'child_frame_id', None)
    strings = (frame_id,) if child is None else (frame_id, child)
    return stamp_ns, strings, DECODERS[kind](message)


def head_of(message: Any) -> tuple[int, str]:
    """Return stamp [ns] and frame of a message."""
    head = message.header
    return head.stamp.sec * 1_000_000_000 + head.stamp.nanosec, head.frame_id


def usable(kind: str, found: Readings) -> tuple[Flags, Counter[str]]:
    """Return which readings (N,) can be used, and the causes of the others.

    Joint states are not checked: some may be those of another robot.
    """
    numbers, causes = found.numbers, Counter[str]()
    good = np.ones(len(numbers), dtype=bool)

    def refuse(wrong: np.bool_ | Flags, cause: str) -> None:
        count = int((good & wrong).sum())
        if count:
            causes[cause] += count
            good[wrong] = False

    if kind == JOINT_STATE:
        return good, causes
    refuse(found.stamps_ns <= 0, NO_STAMP)
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
        changes = np.flatnonzero((rows[1:] != rows[:-1]).any(axis=1)) + 1
        for begin, end in itertools.pairwise((0, *changes.tolist(), len(rows))):
            if fault := _fault(rows[begin].tobytes()):
                faulty = np.zeros(len(rows), dtype=bool)
                faulty[begin:end] = True
                refuse(faulty, fault)
    if not found.child.isprintable():  # it is written to tables
        refuse(good.copy(), 'child frame whose name cannot be printed')
    return good, causes


@functools.lru_cache(maxsize=16)  # most devices repeat one
def _fault(covariance: bytes) -> str:
    fault = str(covariance_faults(np.frombuffer(covariance).reshape(1, 6, 6))[0])
    return fault and f'{fault} (leave it zero if it is not known)'


def transforms_in(message: Any, kind: str) -> Sequence[Any]:
    """Return the links in a message, each like a TransformStamped."""
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
    """Return a frame name without the leading slash of older programs."""
    return name.removeprefix('/')


VALIDATION = 'validation_'
"""Prefix of topics whose measurements judge the result and are never fitted."""
MARKERS = {
    'status': 'std_msgs/msg/String',
    'calibration': 'std_msgs/msg/String',
    'dh_parameters': 'std_msgs/msg/Float64MultiArray',
}
"""Topics that together identify a calibration node."""
DISTANCE = 'distance'  # default device of distances: their origin is not that of a tracker


@dataclass(frozen=True)
class Source:
    """One topic of measurements.

    Each device has its own base frame, each target its own tool frame; a child frame in the
    message names the target.
    """

    topic: str
    type: str = ''  # such as geometry_msgs/msg/PoseStamped; empty for any
    device: str = ''
    target: str = ''
    eye_in_hand: bool = False  # a camera on the flange measures a fixed target
    validation: bool = False  # judges the result, never fitted
    parent: str = ''  # frames of the measurement, among many transforms or bodies, as on /tf
    child: str = ''
    board: str = ''  # YAML of the board in images
    info: str = ''  # CameraInfo topic of images, by default camera_info beside them
    lens: str = 'given'  # by that topic, or `fitted` from there

    def __post_init__(self) -> None:
        if self.type and self.type not in TYPES:
            raise UnknownNameError(f'type of source "{self.topic}"', self.type, TYPES)
        frames = {self.parent, self.child} - {''}
        if len(frames) != (2 if self.type in LINKS else 0):
            raise ConfigError(
                f'source "{self.topic}" needs parent=FRAME child=FRAME, between which it '
                f'measures, if its type is {_or(LINKS)}, and only then'
            )
        if bool(self.board) != (self.type in PICTURES):
            raise ConfigError(
                f'source "{self.topic}" needs board=FILE, the board that it sees, if its type is '
                f'{_or(PICTURES)}, and only then'
            )
        if self.lens not in LENSES:
            raise UnknownNameError(f'lens of source "{self.topic}"', self.lens, LENSES)
        for name in (self.device, self.target):
            if '.' in name or ',' in name:
                raise ConfigError(f'a device or target needs a name without . and , not "{name}"')

    @property
    def camera_info(self) -> str:
        """Return the CameraInfo topic of images."""
        beside = self.topic.removesuffix('/compressed').rpartition('/')
        return self.info or f'{beside[0]}{beside[1]}camera_info'


LENSES = ('given', 'fitted')
TYPES = (*DECODERS, *LINKS, *PICTURES)  # message types of measurements

STANDARD = (
    Source('measured_pose', 'geometry_msgs/msg/PoseStamped'),
    Source('measured_pose_with_covariance', 'geometry_msgs/msg/PoseWithCovarianceStamped'),
    Source('measured_point', 'geometry_msgs/msg/PointStamped'),
    Source('measured_transform', 'geometry_msgs/msg/TransformStamped'),
    Source('measured_odometry', 'nav_msgs/msg/Odometry'),
    Source('measured_distance', 'sensor_msgs/msg/Range', device=DISTANCE),
    Source('validation_pose', 'geometry_msgs/msg/PoseStamped', validation=True),
    Source('validation_point', 'geometry_msgs/msg/PointStamped', validation=True),
)
"""Default subscriptions of the node."""


def parse_source(text: str) -> Source:
    """Parse a source "TOPIC key=value ...".

    Keys: type, device, target, eye_in_hand (true or false), validation (true or false), parent and
    child, and of images board, info and lens. Short types such as PoseStamped are accepted; the
    type defaults to TFMessage for a topic named tf or with parent and child, and to images with a
    board. Values with blanks need quotes.
    """
    try:
        topic, *pairs = shlex.split(text) or ('',)
    except ValueError as err:
        raise ConfigError(f'source "{text}" cannot be read: {err}') from err
    if not topic or '=' in topic:
        raise ConfigError(f'source "{text}" must begin with its topic: "TOPIC key=value ..."')
    values: dict[str, Any] = {'validation': topic.rpartition('/')[2].startswith(VALIDATION)}
    for pair in pairs:
        key, equals, value = pair.partition('=')
        if not equals or key not in KEYS:
            raise UnknownNameError(f'key of source "{text}"', key, KEYS)
        if key in ('eye_in_hand', 'validation'):
            if value not in ('true', 'false'):
                raise ConfigError(f'{key} of source "{text}" must be true or false, not "{value}"')
            values[key] = value == 'true'
        elif key == 'type':
            full = (known for known in TYPES if value in (known, short_type(known)))
            values[key] = next(full, value)
        else:
            values[key] = frame_name(value) if key in ('parent', 'child') else value
    if values.keys() & {'parent', 'child'} or topic.rpartition('/')[2] == 'tf':
        values.setdefault('type', TRANSFORMS)
    if 'board' in values:
        values.setdefault('type', PICTURES[topic.endswith('/compressed')])
    source = Source(topic, **values)
    if source.type.endswith('/Range') and not source.device:
        source = replace(source, device=DISTANCE)
    return source


KEYS = tuple(item.name for item in fields(Source) if item.name != 'topic')


def parse_sources(texts: Sequence[str]) -> tuple[Source, ...]:
    """Parse sources; a topic may be named once, or once for each pair of frames."""
    sources = tuple(parse_source(text) for text in texts)
    names = [' '.join((each.topic, each.parent, each.child)).strip() for each in sources]
    for source, name in zip(sources, names, strict=True):
        if names.count(name) > 1:
            raise ConfigError(f'source "{name}" is named twice')
        if any(each.topic == source.topic and each.type != source.type for each in sources):
            raise ConfigError(f'source "{source.topic}" is named with different types')
    return sources


def short_type(kind: str) -> str:
    """Return a message type without its package."""
    return kind.rpartition('/')[2]


def _or(kinds: Sequence[str]) -> str:
    *first, last = map(short_type, kinds)
    return f'{", ".join(first)} or {last}'
