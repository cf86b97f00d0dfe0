# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Serialised messages into the session, by the batch: of live topics and of recordings."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.cdr import Alike, readings, transforms, usable
from calib_ros.sampling.messages import (
    DECODERS,
    LINKS,
    TRANSFORM,
    TRANSFORMS,
    JointReading,
    JointReadings,
    MessageError,
    Readings,
    frame_name,
    transforms_in,
)
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.sources import Source
from calib_ros.sampling.track import Stamps
from calib_ros.sampling.transforms import STATIC, Links, Pair

Deserialise: TypeAlias = Callable[[bytes, str], Any]
"""Makes a message of its bytes and type."""

WINDOW = 1024
"""Messages that are looked at at once."""


@dataclass(frozen=True)
class Stream:
    """What comes on one topic: its message type, and what it measures; None for joint states.

    A topic of transforms between frames may measure several things, or hold what stands still.
    """

    topic: str
    type: str
    source: Source | None = None
    links: Links | None = None

    @property
    def still(self) -> bool:
        """Tell whether it holds links that stand still."""
        return self.links is not None and self.topic != self.links.topic


def measured(sources: Sequence[Source], types: Mapping[str, str]) -> list[Stream]:
    """Return the streams of sources; message types (by topic) where they name none."""
    streams = []
    linked: dict[tuple[str, str], list[Source]] = {}
    for source in sources:
        kind = source.type or types[source.topic]
        if kind in LINKS:
            linked.setdefault((source.topic, kind), []).append(source)
        else:
            streams.append(Stream(source.topic, kind, source))
    for (topic, kind), some in linked.items():
        links = Links(topic, some, kind)
        names = (topic + STATIC, topic) if kind == TRANSFORMS else (topic,)
        streams += [Stream(name, kind, None, links) for name in names]
    return streams


def links_of(streams: Iterable[Stream]) -> list[Links]:
    """Return the links between frames that come on some streams."""
    return list(dict.fromkeys(each.links for each in streams if each.links is not None))


@dataclass(frozen=True, eq=False)
class Group:
    """Decoded messages of one stream, and their places (N,) in the batch."""

    stream: Stream
    places: NDArray[np.intp]
    readings: JointReadings | Readings

    def between(self, begin: int, end: int) -> Group:
        """Return what has its place from `begin` on and before `end`."""
        part = slice(*np.searchsorted(self.places, (begin, end)).tolist())
        if isinstance(self.readings, JointReadings):
            stamps, names, values = self.readings
            cut: JointReadings | Readings = JointReadings(stamps[part], names, values[part])
        else:
            cut = self.readings._replace(
                stamps_ns=self.readings.stamps_ns[part], numbers=self.readings.numbers[part]
            )
        return Group(self.stream, self.places[part], cut)


def feed(
    session: CalibrationSession,
    batch: Sequence[tuple[Stream, bytes]],
    deserialise: Deserialise,
) -> list[str]:
    """Let a session take messages in their order; return what went wrong with some, in words.

    Messages of one stream that are laid out alike are decoded at once, and kept at once up to the
    next joint state after which there is more to do. That one is taken by itself, and so are
    messages that differ from the others. The outcome is that of taking each by itself. An error
    costs the messages that are taken with the one that makes it, and none after them.

    Parameters
    ----------
    session : CalibrationSession
        Takes the messages.
    batch : sequence of (Stream, bytes)
        Messages in the order in which they came.
    deserialise : Deserialise
        For those that are not decoded at once.

    """
    groups = decoded(batch)
    alone = np.ones(len(batch), dtype=bool)
    for group in groups:
        alone[group.places] = False
    more, known = linked(batch, deserialise)
    groups += more
    alone[known] = False
    problems = []
    begin = 0
    while begin < len(batch):
        stop = min(begin + WINDOW, len(batch))
        window = [group.between(begin, stop) for group in groups]
        window = [group for group in window if len(group.places)]
        eventful = (begin + np.flatnonzero(alone[begin:stop])[:1]).tolist()
        for group in window:
            if isinstance(group.readings, JointReadings):
                quiet = session.uneventful(group.readings, among=stop - begin)
            elif group.stream.source is not None:
                quiet = session.uneventful_poses(group.stream.source, group.readings.stamps_ns)
            eventful += group.places[~quiet][:1].tolist()
        end = min(eventful, default=stop)
        try:
            _keep(session, [group.between(begin, end) for group in window])
            if end < stop:
                _take_decoded(session, [group.between(end, end + 1) for group in window])
                if alone[end]:
                    _take(session, *batch[end], deserialise)
        except DecodingError as err:
            problems.append(str(err))
        except Exception:
            problems.append(f'internal error: {traceback.format_exc()}')
        begin = min(end + 1, stop)
    for links in links_of(stream for stream, _ in batch):
        count = links.let_go()
        if count:
            session.miss(count, 'buffer full before their frames were linked')
    return problems


class DecodingError(Exception):
    """A message that cannot be decoded."""


def decoded(batch: Sequence[tuple[Stream, bytes]]) -> list[Group]:
    """Return the messages that are laid out like others of their stream and length."""
    alike: dict[tuple[str, int], list[int]] = {}
    for place, (stream, data) in enumerate(batch):
        if stream.links is None:
            alike.setdefault((stream.topic, len(data)), []).append(place)
    groups = []
    for places in alike.values():
        stream = batch[places[0]][0]
        found = readings(stream.type, [batch[place][1] for place in places])
        if found is not None:
            groups.append(Group(stream, np.array(places)[found[1]], found[0]))
    return groups


@dataclass(frozen=True, eq=False)
class Bodies:
    """Messages that link the same frames: which of a batch they are, their stamps and numbers.

    Stamps (N,) are in ns, numbers (N, links, 7) are positions [m] and quaternions.
    """

    links: tuple[Pair, ...]
    which: NDArray[np.intp]
    stamps: Stamps
    numbers: FloatArray

    def of(self, k: int) -> tuple[Stamps, FloatArray, NDArray[np.bool_]]:
        """Return stamps (N,) and numbers (N, 7) of one body in each, and which are usable."""
        return self.stamps, self.numbers[:, k], usable(self.numbers[:, k])

    def span(self, k: int) -> tuple[int, int]:
        """Return the first and the last stamp."""
        return int(self.stamps[0]), int(self.stamps[-1])


def bodies(
    batch: Sequence[tuple[Stream, bytes]], places: Sequence[int], deserialise: Deserialise
) -> list[Bodies]:
    """Return what is in messages of bodies; those that cannot be decoded are in none."""
    alike: dict[tuple[Pair, ...], list[tuple[int, np.int64, list[list[float]]]]] = {}
    for k, place in enumerate(places):
        stream, data = batch[place]
        try:
            message = deserialise(data, stream.type)
            come = transforms_in(message, stream.type)
            head = message.header
            frame_id = frame_name(head.frame_id)
            links = tuple((frame_id, frame_name(each.child_frame_id)) for each in come)
            stamp_ns = np.int64(head.stamp.sec * 1_000_000_000 + head.stamp.nanosec)
            numbers = [_pose_numbers(each.transform) for each in come]
        except Exception:  # told when it is taken by itself
            continue
        alike.setdefault(links, []).append((k, stamp_ns, numbers))
    found = []
    for links, some in alike.items():
        which = np.array([k for k, _, _ in some])
        stamps = np.array([stamp_ns for _, stamp_ns, _ in some], dtype=np.int64)
        rows = np.array([row for _, _, row in some], dtype=np.float64)
        found.append(Bodies(links, which, stamps, rows.reshape(len(some), len(links), 7)))
    return found


def _pose_numbers(transform: Any) -> list[float]:
    """Return position and quaternion (7)."""
    at, turn = transform.translation, transform.rotation
    return [float(each) for each in (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)]


def linked(
    batch: Sequence[tuple[Stream, bytes]], deserialise: Deserialise
) -> tuple[list[Group], list[int]]:
    """Return what is measured by transforms between frames, and the places of all that are known.

    Frames that are named anywhere in the batch are known for all of it.
    """
    lengths: dict[tuple[str, int], list[int]] = {}
    for place, (stream, data) in enumerate(batch):
        if stream.links is not None:
            length = len(data) if stream.type == TRANSFORMS else 0
            lengths.setdefault((stream.topic, length), []).append(place)
    parts: list[tuple[Stream, NDArray[np.intp], Alike | Bodies]] = []
    for places in lengths.values():
        stream = batch[places[0]][0]
        assert stream.links is not None
        found: Sequence[Alike | Bodies] = (
            transforms([batch[place][1] for place in places], stream.links.layouts)
            if stream.type == TRANSFORMS
            else bodies(batch, places, deserialise)
        )
        parts += [(stream, np.array(places)[alike.which], alike) for alike in found]
    for stream, _, alike in parts:
        assert stream.links is not None
        for k, link in enumerate(alike.links):
            if stream.still:
                _, numbers, good = alike.of(k)
                for row in numbers[good]:
                    stream.links.fix(link, row)
            else:
                stream.links.move(link, len(alike.which), *alike.span(k))
    groups, known = [], []
    for links in links_of(stream for stream, _, _ in parts):
        first = min(int(places[0]) for stream, places, _ in parts if stream.links is links)
        for source, released in links.released():
            where = np.full(len(released.stamps_ns), first)
            groups.append(Group(Stream(links.topic, links.kind, source), where, released))
    for stream, where, alike in parts:
        assert stream.links is not None
        values = [
            (link, *alike.of(k))
            for k, link in enumerate(alike.links)
            if not stream.still and stream.links.wanted(link)
        ]
        kept = np.ones(len(where), dtype=bool)
        for _, stamps, _, good in values:
            kept &= good & (stamps > 0)
        known += where[kept].tolist()
        if not kept.all():  # they are learned of again when they are taken by themselves
            for k, link in enumerate(alike.links):
                stream.links.move(link, -int((~kept).sum()), *alike.span(k))
        for link, stamps, numbers, _ in values:
            for source, measured_by in stream.links.readings(link, stamps[kept], numbers[kept]):
                one = Stream(stream.topic, stream.type, source)
                groups.append(Group(one, where[kept], measured_by))
    return groups, known


def _keep(session: CalibrationSession, groups: Sequence[Group]) -> None:
    joints, measured = [], []
    present = [group for group in groups if len(group.places)]
    for group in sorted(present, key=lambda group: int(group.places[0])):  # who comes first counts
        if isinstance(group.readings, JointReadings):
            joints.append((group.places, group.readings))
        elif group.stream.source is not None:
            measured.append((group.places, group.stream.source, group.readings))
    session.keep(joints, measured)


def _take_decoded(session: CalibrationSession, groups: Sequence[Group]) -> None:
    """Let a session take what is decoded, one after the other."""
    for group in groups:
        for k in range(len(group.places)):
            reading = group.readings.row(k)
            if isinstance(reading, JointReading):
                session.take_joint_reading(reading)
            elif group.stream.source is not None:
                session.take_reading(group.stream.source, reading)


def _take(
    session: CalibrationSession,
    stream: Stream,
    data: bytes,
    deserialise: Deserialise,
) -> None:
    """Let a session take one message that is not decoded yet."""
    try:
        message = deserialise(data, stream.type)
        come = transforms_in(message, stream.type) if stream.links is not None else ()
    except Exception as err:  # damaged bytes fail in many ways
        raise DecodingError(f'a message on {stream.topic} cannot be decoded: {err!r}') from err
    if stream.links is not None:
        _take_transforms(session, stream, stream.links, come)
    elif stream.source is None:
        session.take_joints(message)
    else:
        session.take(stream.source, stream.type, message)


def _take_transforms(
    session: CalibrationSession, stream: Stream, links: Links, come: Sequence[Any]
) -> None:
    """Let a session take what is measured by some transforms, one after the other."""
    for each in come:
        link = frame_name(each.header.frame_id), frame_name(each.child_frame_id)
        still = stream.still
        try:
            reading = DECODERS[TRANSFORM](each)
        except MessageError:
            for source in () if still else links.measured_by(link):
                session.take(source, TRANSFORM, each)  # counted by what is wrong with it
            continue
        stamps, numbers = np.array([reading.stamp_ns]), np.array([reading.numbers])
        if still:
            links.fix(link, numbers[0])
        else:
            links.move(link, 1, reading.stamp_ns, reading.stamp_ns)
        found = links.released()
        if not still:
            found += links.readings(link, stamps, numbers)
        for source, some in found:
            for k in range(len(some.stamps_ns)):
                session.take_reading(source, some.row(k))
