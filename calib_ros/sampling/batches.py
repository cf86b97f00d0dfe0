# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages into the session in batches, of live topics and of recordings.

Serialised messages of one stream with the same layout are decoded at once; others one by one, and
grouped by their names. Both give the same arrays, with the place of each message in the batch.
"""

from __future__ import annotations

import itertools
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.sampling.cdr import alike, read_header
from calib_ros.sampling.message_filter import Part
from calib_ros.sampling.messages import (
    CAMERA_INFO,
    LINKS,
    PICTURES,
    TRANSFORM,
    TRANSFORMS,
    MessageError,
    Readings,
    frame_name,
    head_of,
    reading,
    transforms_in,
    usable,
)
from calib_ros.sampling.pictures import Pictures
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.slices import JOINTS, POSES
from calib_ros.sampling.sources import Source
from calib_ros.sampling.transforms import STATIC, Linked, Links
from calib_ros.texts import LARGEST_TABLE

BATCH = 2000  # messages taken at once (benchmarks/bags.py, benchmarks/soak.py)
OF_CAMERAS = (*PICTURES, CAMERA_INFO)
Deserialise: TypeAlias = Callable[[Any, str], Any]  # converts bytes and a type to a message
Batch: TypeAlias = 'Sequence[tuple[Stream, Any]]'
"""Streams and their messages, serialised or not, in order of arrival."""
MessageRow: TypeAlias = tuple[int, int, FloatArray]  # place, stamp [ns] and numbers of one message
Decoded: TypeAlias = (
    'tuple[Stream, Index, tuple[str, ...], tuple[int, int], Callable[[], Readings]]'
)
"""Messages with the same names: places (N,), names, first and last stamp, reader."""


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


def batches(
    messages: Iterator[tuple[Stream, bytes]],
) -> Iterator[tuple[list[tuple[Stream, bytes]], Exception | None]]:
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
    found = DecodedBatch(batch, deserialise, session.pictures)
    for kind, causes in found.faults.items():
        for cause, count in causes.items():
            session.miss(kind, count, cause)
    try:
        session.take(found.parts)
    except Exception:
        found.problems.append(f'internal error: {traceback.format_exc()}')
    return found.problems


class DecodedBatch:
    """The content of a batch of messages.

    Usable `parts`, counts of others by kind and cause (`faults`), and texts about messages that
    cannot be decoded (`problems`).
    """

    def __init__(
        self, batch: Batch, deserialise: Deserialise, pictures: Pictures | None = None
    ) -> None:
        self._batch, self._deserialise, self._pictures = batch, deserialise, pictures
        self.parts: list[Part] = []
        self.faults: dict[str, Counter[str]] = {JOINTS: Counter(), POSES: Counter()}
        self.problems: list[str] = []
        groups: dict[tuple[str, int], list[int]] = {}
        for place, (stream, data) in enumerate(batch):
            if stream.type in OF_CAMERAS:
                self._keep(place, stream, data)
                continue
            size = len(data) if isinstance(data, bytes) else 0
            groups.setdefault((stream.topic, size), []).append(place)
        linked: dict[Links, list[Linked]] = {}
        for stream, where, strings, span, read in self._read(groups):
            if stream.links is None:
                self._add(stream.source, stream.type, where, read())
                continue
            link = frame_name(strings[0]), frame_name(strings[1])
            one = Linked(where, stream.still, link, span, read)
            linked.setdefault(stream.links, []).append(one)
        for links, come in linked.items():
            measured, causes = links.take(come)
            self.faults[POSES] += causes
            for each in measured:
                self._add(each.source, TRANSFORM, each.places, each.readings)

    def _read(self, groups: Mapping[tuple[str, int], Sequence[int]]) -> Iterator[Decoded]:
        single: list[int] = []
        for (_, size), group in groups.items():
            stream, places = self._batch[group[0]][0], np.array(group)
            left = np.ones(len(places), dtype=bool)
            known = {} if stream.links is None else stream.links.layouts
            blobs = [self._batch[place][1] for place in group]
            for some in alike(stream.type, blobs, known) if size else ():
                left[some.which] = False
                where = places[some.which]
                for k, item in enumerate(some.layout.items):
                    yield stream, where, item.strings, some.span(k), partial(some.of, k)
            single += places[left].tolist()
        yield from self._decode(sorted(single))

    def _add(self, source: Source | None, kind: str, places: Index, found: Readings) -> None:
        if source is not None:  # some joint states may be those of another robot
            found = found._replace(strings=tuple(map(frame_name, found.strings)))
            good, causes = usable(kind, found)
            self.faults[POSES] += causes
            if not good.all():
                places, found = places[good], found.rows(good)
        if len(places):
            self.parts.append(Part(places, source, found))

    def _keep(self, place: int, stream: Stream, data: Any) -> None:
        source, pictures = stream.source, self._pictures
        if source is None or pictures is None:
            return
        message = partial(self._deserialise, data, stream.type)
        try:
            if stream.type == CAMERA_INFO:
                pictures.cameras[source.topic].learn(message())
                return
            serialised = isinstance(data, bytes)
            stamp_ns, frame_id = read_header(data) if serialised else head_of(message())
        except Exception as err:  # damaged bytes fail in many ways
            self.problems.append(f'a message on {stream.topic} cannot be decoded: {err!r}')
            return
        number = pictures.keep(source.topic, len(data) if serialised else 0, message)
        stamps = np.array([stamp_ns], dtype=np.int64)
        found = Readings(stamps, (frame_id,), np.array([[float(number)]]))
        self._add(source, stream.type, np.array([place]), found)

    def _decode(self, places: Sequence[int]) -> Iterator[Decoded]:
        alike: dict[tuple[Stream, tuple[str, ...], int], list[MessageRow]] = {}
        for place in places:
            stream, data = self._batch[place]
            try:
                message = self._deserialise(data, stream.type)
                if stream.links is None:
                    found = [reading(stream.type, message)]
                else:
                    found = [reading(TRANSFORM, e) for e in transforms_in(message, stream.type)]
                rows = [(t, (place, s, np.array(n, dtype=np.float64))) for s, t, n in found]
            except MessageError as err:
                self.faults[JOINTS][str(err)] += 1
                continue
            except Exception as err:  # damaged bytes fail in many ways
                self.problems.append(f'a message on {stream.topic} cannot be decoded: {err!r}')
                continue
            for strings, row in rows:
                alike.setdefault((stream, strings, len(row[2])), []).append(row)
        for (stream, strings, _), some in alike.items():
            where, stamps, numbers = zip(*some, strict=True)
            stamps_ns = np.array(stamps, dtype=np.int64)
            read = partial(Readings, stamps_ns, strings, np.array(numbers))
            yield stream, np.array(where), strings, (stamps[0], stamps[-1]), read
