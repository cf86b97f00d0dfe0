# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sources: what a topic measures, and between which frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calib_ros.errors import ConfigError, UnknownNameError
from calib_ros.sampling.messages import LINKS, MEASURES, PICTURES, short_type

RANGEFINDER = 'distance'  # default device of distances: their origin is not that of a tracker


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
            raise UnknownNameError(f'source "{self.topic}": type', self.type, TYPES)
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
            raise UnknownNameError(f'source "{self.topic}": lens', self.lens, LENSES)
        for name in (self.device, self.target):
            if '.' in name or ',' in name:
                raise ConfigError(f'a device or target needs a name without . and , not "{name}"')

    @property
    def raw_topic(self) -> str:
        """Return the topic of the same images uncompressed."""
        return self.topic.removesuffix('/compressed')

    @property
    def camera_info(self) -> str:
        """Return the CameraInfo topic of images."""
        beside = self.raw_topic.rpartition('/')
        return self.info or f'{beside[0]}{beside[1]}camera_info'


LENSES = ('given', 'fitted')
TYPES = (*MEASURES, *LINKS, *PICTURES)  # message types of measurements

STANDARD = (
    Source('measured_pose', 'geometry_msgs/msg/PoseStamped'),
    Source('measured_pose_with_covariance', 'geometry_msgs/msg/PoseWithCovarianceStamped'),
    Source('measured_point', 'geometry_msgs/msg/PointStamped'),
    Source('measured_transform', 'geometry_msgs/msg/TransformStamped'),
    Source('measured_odometry', 'nav_msgs/msg/Odometry'),
    Source('measured_distance', 'sensor_msgs/msg/Range', device=RANGEFINDER),
    Source('validation_pose', 'geometry_msgs/msg/PoseStamped', validation=True),
    Source('validation_point', 'geometry_msgs/msg/PointStamped', validation=True),
)
"""Default subscriptions of the node."""


def _or(kinds: Sequence[str]) -> str:
    *first, last = map(short_type, kinds)
    return f'{", ".join(first)} or {last}'
