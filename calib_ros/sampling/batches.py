# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages into the session in batches, of live topics and of recordings.

Messages of one stream with the same layout are decoded at once; those of bodies and cameras one by
one, and grouped by their names. Both give the same arrays, with the place of each in the batch.
"""

from __future__ import annotations

import itertools
import struct
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.cdr import alike, message_layout, read_header
from calib_ros.sampling.messages import (
    BODIES,
    CAMERA_INFO,
    FORMS,
    JOINT_STATE,
    LINKS,
    TRANSFORMS,
    Reading,
    bodies_of,
    frame_name,
)
from calib_ros.sampling.pictures import Pictures
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.slices import POSES, Part
from calib_ros.sampling.sources import Source
from calib_ros.sampling.transforms import STATIC, Links
from calib_ros.texts import LARGEST_TABLE

BATCH = 2000  # messages taken at once (benchmarks/bags.py, benchmarks/soak.py)
Deserialise: TypeAlias = Callable[[bytes, str], Any]  # converts bytes and a type to a message
Batch: TypeAlias = 'Sequence[tuple[Stream, bytes]]'
"""Streams and their serialised messages, in order of arrival."""


UNDECODED = 'a message on {} cannot be decoded: {}'


@dataclass(frozen=True)
class Stream:
    """Messages of one topic: their type, and what they measure; None for joint states.

    A topic of transforms may measure several things, or hold static ones; a CameraInfo belongs to
    the topic of the images.
    """

    topic: str
    type: str
    source: Source | None = None
    links: Links | None = None

    @property
    def still(self) -> bool:
        """Tell whether it holds static links."""
        return self.links is not None and self.topic != self.links.topic


def source_streams(sources: Sequence[Source], types: Mapping[str, str]) -> list[Stream]:
    """Return the streams of sources; `types` (by topic) apply where they name none."""
    streams = []
    linked: dict[tuple[str, str], list[Source]] = {}
    for source in sources:
        kind = source.type or types[source.topic]
        if kind in LINKS:
            linked.setdefault((source.topic, kind), []).append(source)
            continue
        streams.append(Stream(source.topic, kind, source))
        if source.board:
            streams.append(Stream(source.camera_info, CAMERA_INFO, source))
    for (topic, kind), some in linked.items():
        links = Links(topic, some, kind)
        names = (topic + STATIC, topic) if kind == TRANSFORMS else (topic,)
        streams += [Stream(name, kind, None, links) for name in names]
    return streams


def links_of(streams: Iterable[Stream]) -> list[Links]:
    """Return the links between frames on some streams."""
    return list(dict.fromkeys(each.links for each in streams if each.links is not None))


def batches(messages: Iterator[tuple[Stream, bytes]]) -> Iterator[tuple[Batch, Exception | None]]:
    """Yield batches of messages; the last one has the error that ended them, if any."""
    error, ended = None, False
    while not ended:
        batch: list[tuple[Stream, bytes]] = []
        size = 0
        try:
            for each in itertools.islice(messages, BATCH):
                batch.append(each)
                size += len(each[1])
                if size > LARGEST_TABLE:  # images
                    break
            else:
                ended = len(batch) < BATCH
        except Exception as err:  # a damaged recording fails in many ways
            error, ended = err, True
        yield batch, error


def feed(session: CalibrationSession, batch: Batch, deserialise: Deserialise) -> list[str]:
    """Pass messages to a session in order; return problems as text.

    Batching makes no difference. `deserialise` decodes messages without a known layout.
    """
    parts, problems = decode(batch, deserialise, session.pictures, session.miss)
    try:
        session.take(parts)
    except Exception:
        problems.append(f'internal error: {traceback.format_exc()}')
    return problems


def decode(
    batch: Batch,
    deserialise: Deserialise,
    pictures: Pictures | None = None,
    miss: Callable[[str, int, str], None] = lambda kind, count, cause: None,
) -> tuple[list[Part], list[str]]:
    """Return the content of messages, and texts about those that cannot be decoded.

    Images are kept in `pictures`. `miss` is called with kind, number and cause of unusable ones.
    """
    parts: list[Part] = []
    problems: list[str] = []
    linked: dict[Links, tuple[list[Part], list[Part]]] = {}  # moving and still ones
    decoded = _by_layout(batch, problems)
    others = _one_by_one(batch, deserialise, pictures, problems)
    for stream, part in itertools.chain(decoded, others):
        if stream.type != JOINT_STATE and any(name[:1] == '/' for name in part.strings):
            part = part._replace(strings=tuple(map(frame_name, part.strings)))
        if stream.links is None:
            parts.append(part)
        else:
            linked.setdefault(stream.links, ([], []))[stream.still].append(part)
    for links, come in linked.items():
        measured, faults = links.take(*come)
        parts += measured
        for cause, count in faults.items():
            miss(POSES, count, cause)
    return parts, problems


def _by_layout(batch: Batch, problems: list[str]) -> Iterator[tuple[Stream, Part]]:
    """Yield joint states and measurements with the same names, and their stream."""
    groups: dict[tuple[str, int, bytes], list[int]] = {}
    for place, (stream, data) in enumerate(batch):
        if stream.type in FORMS:
            groups.setdefault((stream.topic, len(data), data[:2]), []).append(place)
    for group in groups.values():
        stream, places = batch[group[0]][0], np.array(group)
        left = np.ones(len(places), dtype=bool)
        known = {} if stream.links is None else stream.links.layouts
        blobs = [batch[place][1] for place in group]
        for which, names, stamps, numbers in alike(stream.type, blobs, known):
            left[which] = False
            yield stream, Part(places[which], stream.source, names, stamps, numbers)
        for k in np.flatnonzero(left).tolist():
            try:
                message_layout(stream.type, blobs[k])
            except (struct.error, UnicodeDecodeError) as err:
                problems.append(UNDECODED.format(stream.topic, err))


def _one_by_one(
    batch: Batch, deserialise: Deserialise, pictures: Pictures | None, problems: list[str]
) -> Iterator[tuple[Stream, Part]]:
    """Yield bodies and images with the same names, and their stream; learn from cameras."""
    rows: dict[tuple[Stream, tuple[str, ...]], list[tuple[int, int, FloatArray]]] = {}
    for place, (stream, data) in enumerate(batch):
        if stream.type in FORMS:
            continue
        message = partial(deserialise, data, stream.type)
        try:
            if stream.type in BODIES:
                found = bodies_of(stream.type, message())
            else:
                found = _kept(stream, data, message, pictures)
            held = [(stamp, names, np.array(row, dtype=float)) for stamp, names, row in found]
        except Exception as err:  # damaged bytes fail in many ways
            problems.append(UNDECODED.format(stream.topic, repr(err)))
        else:
            for stamp, names, row in held:
                rows.setdefault((stream, names), []).append((place, stamp, row))
    for (stream, names), same in rows.items():
        places, stamps, numbers = map(np.array, zip(*same, strict=True))
        yield stream, Part(places, stream.source, names, stamps, numbers)


def _kept(
    stream: Stream, data: bytes, message: Callable[[], Any], pictures: Pictures | None
) -> list[Reading]:
    """Keep an image, or learn from a CameraInfo; return the stamp and number of an image."""
    if stream.source is None or pictures is None:
        return []
    if stream.type == CAMERA_INFO:
        pictures.cameras[stream.source.topic].learn(message())
        return []
    stamp_ns, frame_id = read_header(data)
    number = pictures.keep(stream.source.topic, len(data), message)
    return [(stamp_ns, (frame_id,), (float(number),))]
