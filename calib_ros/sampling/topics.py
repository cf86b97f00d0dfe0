# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Choice of the topics of a recording."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from calib_ros.errors import InputError
from calib_ros.sampling.intake import Deserialise, Intake, Stream, batches, measured
from calib_ros.sampling.messages import (
    CAMERA_INFO,
    DECODERS,
    JOINT_STATE,
    LINKS,
    MARKERS,
    TYPES,
    Source,
    parse_source,
    parse_sources,
    short_type,
)
from calib_ros.sampling.slices import Series
from calib_ros.sampling.transforms import STATIC, Links
from calib_ros.settings import Settings
from calib_ros.values import SAME

Reading: TypeAlias = Callable[[Mapping[str, Stream]], Iterator[tuple[Stream, bytes]]]
"""Returns the messages of a recording on some topics."""


class Recorded(NamedTuple):
    """The types of a recording by topic, its messages, and how they are decoded."""

    available: Mapping[str, str]
    messages_on: Reading
    deserialise: Deserialise


def choose(recorded: Recorded, settings: Settings) -> dict[str, Stream]:
    """Choose topics by type from those available, unless named in the settings.

    Raises InputError with the candidates if there is none, or more than one.
    """
    available = recorded.available
    own = outputs(available)
    sources = parse_sources(settings.sources)
    for topic in (*settings.joint_topics, *(source.topic for source in sources)):
        if topic in own:
            raise InputError(
                f'{topic} is published by the calibration node itself: it measures nothing'
            )
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
        if kind not in TYPES or source.type not in ('', kind):
            expected = (source.type,) if source.type else tuple(DECODERS)
            raise _no_topic(f'"{source.topic}"', expected, available)
        if source.board and available.get(source.camera_info) != CAMERA_INFO:
            raise _no_topic(f'"{source.camera_info}"', (CAMERA_INFO,), available)
    if all(source.validation for source in sources):
        error = _no_topic('pose topic', tuple(DECODERS), available)
        raise InputError('; '.join([str(error), *_links(recorded)]))
    streams = [Stream(topic, JOINT_STATE) for topic in joints] + measured(sources, available)
    chosen = {stream.topic: stream for stream in streams if stream.topic in available}
    still = {topic: stream for topic, stream in chosen.items() if stream.still}
    if still:  # read first: measurements must not wait for it
        _learn(recorded, still)
    return chosen


def _links(recorded: Recorded) -> list[str]:
    found = []
    for topic, kind in recorded.available.items():
        if kind in LINKS and not topic.endswith(STATIC):
            links = Links(topic, kind=kind)
            _learn(recorded, {topic: Stream(topic, kind, None, links)})
            found.append(str(links))
    return found


def _learn(recorded: Recorded, streams: Mapping[str, Stream]) -> None:
    for batch, _ in batches(recorded.messages_on(streams)):
        Intake(batch, recorded.deserialise)


def outputs(available: Mapping[str, str]) -> set[str]:
    """Return the topics of calibration nodes, recognised by their MARKERS."""
    nodes = [
        topic.rpartition('/')[0]
        for topic in available
        if topic.rpartition('/')[2] in MARKERS and topic.rpartition('/')[0]
    ]
    known = {
        f'{node}/'
        for node in nodes
        if all(available.get(f'{node}/{name}') == kind for name, kind in MARKERS.items())
    }
    return {topic for topic in available if topic.startswith(tuple(known))}


def check_joints(
    recorded: Recorded, streams: Mapping[str, Stream], joint_names: Sequence[str]
) -> None:
    """Refuse joint states if several topics name the same joints.

    The InputError names the topics, and how far their values differ.
    """
    series: dict[str, dict[str, Series]] = defaultdict(dict)
    for (topic, name), parts in _joint_values(recorded, streams).items():
        if name in joint_names:
            stamps = np.concatenate([each for each, _ in parts])
            values = np.concatenate([each for _, each in parts])
            order = np.argsort(stamps, kind='stable')
            series[topic][name] = stamps[order], values[order]
    twice = [
        (a, b, shared)
        for a, b in itertools.combinations(sorted(series), 2)
        if (shared := [name for name in joint_names if name in series[a] and name in series[b]])
    ]
    if twice:
        names = [name for name in joint_names if any(name in shared for *_, shared in twice)]
        apart = '; '.join(_apart(a, b, series[a], series[b], shared) for a, b, shared in twice)
        raise InputError(
            f'joints {", ".join(names)} come on several topics: {apart}. Choose the measured one '
            '(or several that name different joints) with --joint-topics'
        )


def _joint_values(
    recorded: Recorded, streams: Mapping[str, Stream]
) -> dict[tuple[str, str], list[Series]]:
    found = defaultdict(list)
    for batch, _ in batches(recorded.messages_on(streams)):
        for topic in dict.fromkeys(stream.topic for stream, _ in batch):
            of_topic = [each for each in batch if each[0].topic == topic]
            for _, _, (stamps, (_, *names), values) in Intake(
                of_topic, recorded.deserialise
            ).parts:
                for name, column in zip(names, values.T, strict=True):
                    found[topic, name].append((stamps, column))
    return found


def _apart(
    a: str, b: str, first: Mapping[str, Series], second: Mapping[str, Series], names: Sequence[str]
) -> str:
    largest: tuple[float, str] | None = None
    for name in names:
        dense, sparse = sorted((first[name], second[name]), key=lambda each: -len(each[0]))
        begin, end = dense[0][[0, -1]]
        known = (sparse[0] >= begin) & (sparse[0] <= end)
        if known.any():
            resampled = np.interp(sparse[0][known] - begin, dense[0] - begin, dense[1])
            error = float(np.abs(sparse[1][known] - resampled).max())
            largest = max(largest or (error, name), (error, name))
    if largest is None:
        return f'{a} and {b} never come at the same time'
    if largest[0] < SAME:
        return f'{a} and {b} are the same'
    return f'{a} and {b} differ by up to {largest[0]:.3g} rad or m, as for {largest[1]}'


def _found(available: Mapping[str, str]) -> tuple[Source, ...]:
    own = outputs(available)
    sources = [
        parse_source(f'{topic} type={kind}')
        for topic, kind in available.items()
        if kind in DECODERS and topic not in own
    ]
    fitted = sorted(source.topic for source in sources if not source.validation)
    if len(fitted) > 1:
        raise InputError(
            'the bag has several pose topics, choose one or more with --sources: '
            f'{", ".join(fitted)}; it holds {_contents(available)}'
        )
    return tuple(sources)


def _no_topic(what: str, types: Sequence[str], available: Mapping[str, str]) -> InputError:
    return InputError(
        f'the bag has no {what} ({", ".join(map(short_type, types))}); it holds '
        f'{_contents(available)}'
    )


def _contents(available: Mapping[str, str]) -> str:
    own = outputs(available)
    return (
        ', '.join(
            f'{t} (own output)' if t in own else f'{t} ({short_type(kind)})'
            for t, kind in sorted(available.items())
        )
        or 'nothing'
    )
