# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS messages to numbers, and their sources.

Messages are read by their attributes only: rclpy's and rosbags' messages alike. What cannot be
used is told by its cause, under which it is counted. A source says what comes on a topic, and
between which frames.
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
from calib_ros.values import LARGEST as LARGEST, ROUNDED, covariance_fault

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
PICTURES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
NO_STAMP = 'zero stamp (fill header.stamp where it is published)'
NOT_UNIT = 'quaternion not of length 1 (normalise it where it is published)'


class MessageError(InputError):
    """A message that cannot be used."""


class Readings(NamedTuple):
    """What N messages say that name the same things; N may be one.

    `strings` are the frame and the child frame of a measurement if it has one, or the frame and
    the names of the joints. `numbers` (N, w) are joint values [rad or m]; or a distance [m]
    (w = 1), a position [m] (3), a pose with its quaternion x y z w (7), or that and a covariance
    row by row (43); of an image its number among those that are kept (1).
    """

    stamps_ns: NDArray[np.int64]
    strings: tuple[str, ...]
    numbers: FloatArray

    @property
    def child(self) -> str:
        """Return the child frame of a measurement; empty if it has none."""
        return self.strings[1] if len(self.strings) > 1 else ''

    def rows(self, which: slice | NDArray[np.generic]) -> Readings:
        """Return some of them, by a slice, a mask (N,) or indices (K,)."""
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
"""Types of measurements, and what finds the numbers in a message."""


def reading(kind: str, message: Any) -> tuple[int, tuple[str, ...], Sequence[float]]:
    """Return stamp [ns], strings and numbers of a message, as `Readings` hold them."""
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
    """Return which readings (N,) can be used, and the causes why others cannot.

    The values of joints are not looked at: some may be those of another robot.
    """
    numbers, causes = found.numbers, Counter[str]()
    good = np.ones(len(numbers), dtype=bool)

    def refuse(wrong: np.bool_ | Flags, cause: str) -> None:
        count = int((good & wrong).sum())
        if count:
            causes[cause] += count
            good[wrong] = False

    refuse(found.stamps_ns <= 0, NO_STAMP)
    if kind in (JOINT_STATE, *PICTURES):
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
        with np.errstate(over='ignore'):  # of numbers that are refused
            length = np.sqrt((numbers[:, 3:7] ** 2).sum(axis=1))
        refuse(~(np.abs(length - 1.0) <= ROUNDED), NOT_UNIT)
    if width > 7:  # mostly all have the same
        rows = numbers[:, 7:]
        changes = np.flatnonzero((rows[1:] != rows[:-1]).any(axis=1)) + 1
        for begin, end in itertools.pairwise((0, *changes.tolist(), len(rows))):
            if fault := _fault(rows[begin].tobytes()):
                here = np.zeros(len(rows), dtype=bool)
                here[begin:end] = True
                refuse(here, fault)
    if not found.child.isprintable():  # it shall be a cell of a table
        refuse(good.copy(), 'child frame whose name cannot be printed')
    return good, causes


@functools.lru_cache(maxsize=16)  # most devices send the same one for ever
def _fault(covariance: bytes) -> str:
    return covariance_fault(np.frombuffer(covariance).reshape(6, 6))


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


VALIDATION = 'validation_'
"""Topics whose last name starts so hold measurements that judge the result, never fitted."""
MARKERS = {
    'status': 'std_msgs/msg/String',
    'calibration': 'std_msgs/msg/String',
    'dh_parameters': 'std_msgs/msg/Float64MultiArray',
}
"""Topics that together tell that what is above them is one of our nodes."""
DISTANCE = 'distance'
"""Device of distances that name none: their origin is not that of a tracker."""


@dataclass(frozen=True)
class Source:
    """One topic of measurements.

    Each device has a base frame of its own, each target a tool frame; a message that names its
    child frame names the target.
    """

    topic: str
    type: str = ''  # such as geometry_msgs/msg/PoseStamped; empty when any will do
    device: str = ''  # what measures
    target: str = ''  # what is measured
    eye_in_hand: bool = False  # the poses are those of a fixed target in a camera on the flange
    validation: bool = False  # the measurements judge the result and are never fitted
    parent: str = ''  # of many transforms or bodies, as on /tf: the frames between which it is
    child: str = ''
    board: str = ''  # YAML of the board that images show, which has its type and sizes
    info: str = ''  # topic of the CameraInfo of images, by default camera_info beside them
    lens: str = 'given'  # by that topic, or `fitted` from there on

    def __post_init__(self) -> None:
        """Refuse what neither bag nor node could use."""
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
        """Return the topic of the CameraInfo of images."""
        beside = self.topic.removesuffix('/compressed').rpartition('/')
        return self.info or f'{beside[0]}{beside[1]}camera_info'


LENSES = ('given', 'fitted')
TYPES = (*DECODERS, *LINKS, *PICTURES)
"""Types of messages that hold measurements."""

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
    """Read a source from "TOPIC key=value ...".

    Keys: type, device, target, eye_in_hand (true or false), validation (true or false), parent and
    child, and of images board, info and lens. A short type such as PoseStamped will do; a topic
    named tf is of type TFMessage, and so is one with a parent or a child and no type; one with a
    board is of images. What holds blanks stands in quotes.
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
    """Read several sources; a topic may be named once, or once for each pair of its frames."""
    sources = tuple(parse_source(text) for text in texts)
    names = [' '.join((each.topic, each.parent, each.child)).strip() for each in sources]
    for source, name in zip(sources, names, strict=True):
        if names.count(name) > 1:
            raise ConfigError(f'source "{name}" is named twice')
        if any(each.topic == source.topic and each.type != source.type for each in sources):
            raise ConfigError(f'source "{source.topic}" is named with different types')
    return sources


def short_type(kind: str) -> str:
    """Return the name of a message type without its package."""
    return kind.rpartition('/')[2]


def _or(kinds: Sequence[str]) -> str:
    *first, last = map(short_type, kinds)
    return f'{", ".join(first)} or {last}'
