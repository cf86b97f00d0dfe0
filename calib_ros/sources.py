# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Where measurements come from: topics, what they carry, and between which frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from calib_ros.errors import ConfigError, UnknownNameError
from calib_ros.messages import DECODERS

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

    Attributes
    ----------
    topic : str
    type : str
        Message type, such as geometry_msgs/msg/PoseStamped; empty when any will do.
    device, target : str
        What measures, and what is measured. Each device has a base frame of its own, each target
        a tool frame. A message that names its child frame names the target.
    eye_in_hand : bool
        The poses are those of a fixed target in a camera on the flange.
    validation : bool
        The measurements judge the result and are never fitted.

    """

    topic: str
    type: str = ''
    device: str = ''
    target: str = ''
    eye_in_hand: bool = False
    validation: bool = False

    def __post_init__(self) -> None:
        """Refuse what no bag or node could use."""
        if self.type and self.type not in DECODERS:
            raise UnknownNameError(f'type of source "{self.topic}"', self.type, DECODERS)
        for name in (self.device, self.target):
            if '.' in name or ',' in name:
                raise ConfigError(f'a device or target needs a name without . and , not "{name}"')


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
"""What the node listens to unless it is told otherwise."""


def parse_source(text: str) -> Source:
    """Read a source from "TOPIC key=value ...".

    Keys: type, device, target, eye_in_hand (true or false), validation (true or false). A short
    type such as PoseStamped will do.
    """
    topic, *pairs = text.split() or ('',)
    if not topic or '=' in topic:
        raise ConfigError(f'source "{text}" must begin with its topic: "TOPIC key=value ..."')
    source = Source(topic, validation=topic.rpartition('/')[2].startswith(VALIDATION))
    for pair in pairs:
        key, equals, value = pair.partition('=')
        if not equals or key not in KEYS:
            raise UnknownNameError(f'key of source "{text}"', key, KEYS)
        flag = value == 'true'
        if key in ('eye_in_hand', 'validation') and not flag and value != 'false':
            raise ConfigError(f'{key} of source "{text}" must be true or false, not "{value}"')
        if key == 'eye_in_hand':
            source = replace(source, eye_in_hand=flag)
        elif key == 'validation':
            source = replace(source, validation=flag)
        elif key == 'type':
            source = replace(source, type=_full_type(value))
        elif key == 'device':
            source = replace(source, device=value)
        else:
            source = replace(source, target=value)
    if source.type.endswith('/Range') and not source.device:
        source = replace(source, device=DISTANCE)
    return source


KEYS = ('type', 'device', 'target', 'eye_in_hand', 'validation')


def parse_sources(texts: Sequence[str]) -> tuple[Source, ...]:
    """Read several sources; a topic may be named once."""
    sources = tuple(parse_source(text) for text in texts)
    topics = [source.topic for source in sources]
    for topic in topics:
        if topics.count(topic) > 1:
            raise ConfigError(f'source "{topic}" is named twice')
    return sources


def _full_type(name: str) -> str:
    matches = [known for known in DECODERS if name in (known, known.rpartition('/')[2])]
    return matches[0] if matches else name
