# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Choice of the topics of a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeAlias

from calib_ros.errors import InputError
from calib_ros.sampling.batches import Deserialise, batches, decode
from calib_ros.sampling.messages import (
    CAMERA_INFO,
    JOINT_STATE,
    LINKS,
    MEASURES,
    PICTURES,
    short_type,
)
from calib_ros.sampling.source_texts import parse_source, parse_sources
from calib_ros.sampling.sources import TYPES, Source
from calib_ros.sampling.streams import Stream, source_streams
from calib_ros.sampling.transforms import STATIC, Links
from calib_ros.settings import Settings

MARKERS = {
    'status': 'std_msgs/msg/String',
    'calibration': 'std_msgs/msg/String',
    'dh_parameters': 'std_msgs/msg/Float64MultiArray',
}
"""Topics that together identify a calibration node."""
OF_TAGS = ('Detection', 'ArucoMarker', 'PoseArray')
"""Parts of message types of what detectors of tags, such as apriltag_ros, publish beside /tf."""
MessagesOn: TypeAlias = Callable[[Mapping[str, Stream]], Iterator[tuple[Stream, bytes]]]
"""Returns the messages of a recording on some topics."""


class Recorded(NamedTuple):
    """The types of a recording by topic, its messages, and how they are decoded."""

    available: Mapping[str, str]
    messages_on: MessagesOn
    deserialise: Deserialise


def choose_topics(recorded: Recorded, settings: Settings) -> dict[str, Stream]:
    """Choose topics by type from those available, unless named in the settings.

    Raises InputError with the candidates if there is none, or more than one.
    """
    available = recorded.available
    own = outputs(available)
    sources = parse_sources(settings.sources, available)
    for topic in (*settings.joint_topics, *(source.topic for source in sources)):
        if topic in own:
            raise InputError(f'{topic} is an output of the calibration node: it measures nothing')
    joints = [topic for topic, kind in available.items() if kind == JOINT_STATE]
    for topic in settings.joint_topics:
        if topic not in joints:
            raise _no_topic(f'"{topic}"', (JOINT_STATE,), available)
    joints = list(settings.joint_topics) or [topic for topic in joints if topic not in own]
    if not joints:
        raise _no_topic('joint topic', (JOINT_STATE,), available)
    sources = sources or _found(available)
    for source in sources:
        kind = available.get(source.topic, '')
        if kind not in TYPES or source.type != kind:
            expected = (source.type,) if source.type else MEASURES
            raise _no_topic(f'"{source.topic}"', expected, available)
        if source.board and available.get(source.camera_info) != CAMERA_INFO:
            error = _no_topic(f'"{source.camera_info}"', (CAMERA_INFO,), available)
            raise InputError(f'{error}; name its topic in sources (info=TOPIC), or record it too')
    if all(source.validation for source in sources):
        error = _no_topic('pose topic', MEASURES, available)
        raise InputError('; '.join([str(error), *_others(recorded)]))
    streams = [Stream(topic, JOINT_STATE) for topic in joints] + source_streams(sources, available)
    chosen = {stream.topic: stream for stream in streams if stream.topic in available}
    still = {topic: stream for topic, stream in chosen.items() if stream.still}
    if still:  # read first: measurements must not wait for it
        _learn(recorded, still)
    return chosen


def _others(recorded: Recorded) -> list[str]:
    """Return how to use links and images, which are no measurements of their own."""
    found = []
    for topic, kind in recorded.available.items():
        if kind in LINKS and not topic.endswith(STATIC):
            links = Links(topic, kind=kind)
            _learn(recorded, {topic: Stream(topic, kind, None, links)})
            found.append(str(links))
        elif kind in PICTURES:
            found.append(
                f'images of a board need --sources "{topic} board=board.yaml", with '
                'eye_in_hand=true if the camera is on the flange'
            )
        elif any(word in short_type(kind) for word in OF_TAGS):
            found.append(f'{topic} is not read: record /tf with it, where tags are published')
    return found


def _learn(recorded: Recorded, streams: Mapping[str, Stream]) -> None:
    for batch, _ in batches(recorded.messages_on(streams)):
        decode(batch, recorded.deserialise)


def outputs(available: Mapping[str, str]) -> set[str]:
    """Return the topics of calibration nodes, recognised by their MARKERS."""
    nodes = [each.removesuffix('status') for each in available if each.endswith('/status')]
    known = [n for n in nodes if all(available.get(n + k) == kind for k, kind in MARKERS.items())]
    return {topic for topic in available if topic.startswith(tuple(n for n in known if n != '/'))}


def check_joints(
    recorded: Recorded, streams: Mapping[str, Stream], joint_names: Sequence[str]
) -> None:
    """Refuse joint states with an InputError if several topics name the same joints."""
    topics: dict[str, set[str]] = {name: set() for name in joint_names}
    for batch, _ in batches(recorded.messages_on(streams)):
        for part in decode(batch, recorded.deserialise)[0]:
            for name in topics.keys() & part.strings[1:] if part.numbers.size else ():
                topics[name].add(batch[part.places[0]][0].topic)
    twice = {name: found for name, found in topics.items() if len(found) > 1}
    if twice:
        raise InputError(
            f'joints {", ".join(twice)} come on several topics: '
            f'{", ".join(sorted(set().union(*twice.values())))}. Choose the measured one '
            '(or several that name different joints) with --joint-topics'
        )


def _found(available: Mapping[str, str]) -> tuple[Source, ...]:
    own = outputs(available)
    sources = [
        parse_source(topic, available)
        for topic, kind in available.items()
        if kind in MEASURES and topic not in own
    ]
    fitted = sorted(source.topic for source in sources if not source.validation)
    if len(fitted) > 1:
        raise InputError(
            'the bag has several pose topics, choose one or more with --sources: '
            f'{", ".join(fitted)}; it holds {_contents(available)}'
        )
    return tuple(sources)


def _no_topic(what: str, types: Sequence[str], available: Mapping[str, str]) -> InputError:
    kinds, held = ', '.join(map(short_type, types)), _contents(available)
    return InputError(f'the bag has no {what} ({kinds}); it holds {held}')


def _contents(available: Mapping[str, str]) -> str:
    kinds = {topic: short_type(kind) for topic, kind in sorted(available.items())}
    kinds |= dict.fromkeys(outputs(available), 'own output')
    return ', '.join(f'{topic} ({kind})' for topic, kind in kinds.items()) or 'nothing'
