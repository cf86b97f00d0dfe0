# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings: bag to session, and synthetic or tabulated measurements to bag."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import InputError
from calib_ros.intake import Stream, feed
from calib_ros.mcap import logged
from calib_ros.messages import DECODERS, JOINT_STATE
from calib_ros.observations import Observations
from calib_ros.salvage import recorded, salvage
from calib_ros.se3 import FloatArray, to_quat
from calib_ros.session import CalibrationSession
from calib_ros.settings import Settings
from calib_ros.sources import VALIDATION, Source, parse_source, parse_sources

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

STORAGES = ('sqlite3', 'mcap')
STORAGE = ('chunks', 'connections', 'messages_scan', 'path')
TIMES = ('message_start_time', 'message_end_time')
CHUNK = (*TIMES, 'channel_count', 'chunk_start_offset', 'chunk_length')
"""What the library does not promise: without them, it is asked for the messages itself."""
BATCH = 2000
"""Messages that are decoded at once."""
STAND_NS = 400_000_000
"""Time for which the arm stands at each row of a table that is made into a bag."""


@dataclass(frozen=True)
class Topics:
    """Topics of a bag to replay: their message types, and the sources of measurements."""

    types: Mapping[str, str]
    sources: Mapping[str, Source]

    @classmethod
    def choose(cls, available: Mapping[str, str], settings: Settings) -> Topics:
        """Choose topics by type from those available (topic to type), unless they are named.

        Raises
        ------
        InputError
            When there is none or more than one; it lists the candidates.

        """
        named = settings.joint_topics
        joints = [topic for topic, kind in available.items() if kind == JOINT_STATE]
        if named:
            for topic in named:
                if topic not in joints:
                    raise _no_topic(f'"{topic}"', (JOINT_STATE,), available)
            joints = list(named)
        elif not joints:
            raise _no_topic('joint topic', (JOINT_STATE,), available)
        sources = parse_sources(settings.sources)
        if not sources:
            sources = _found(available)
        for source in sources:
            kind = available.get(source.topic, '')
            if kind not in DECODERS or source.type not in ('', kind):
                expected = (source.type,) if source.type else tuple(DECODERS)
                raise _no_topic(f'"{source.topic}"', expected, available)
        if all(source.validation for source in sources):
            raise _no_topic('pose topic', tuple(DECODERS), available)
        chosen = {source.topic: source for source in sources}
        return cls({topic: available[topic] for topic in (*joints, *chosen)}, chosen)

    @property
    def streams(self) -> dict[str, Stream]:
        """Return what comes on each topic."""
        return {
            topic: Stream(topic, k, self.sources.get(topic)) for topic, k in self.types.items()
        }

    def of(self, messages: Iterable[tuple[str, bytes]]) -> Iterator[tuple[Stream, bytes]]:
        """Return those of some messages that are on these topics."""
        streams = self.streams
        return ((streams[topic], data) for topic, data in messages if topic in streams)


def _found(available: Mapping[str, str]) -> tuple[Source, ...]:
    """Return the sources of a bag by their types; one at most is fitted."""
    sources = [
        parse_source(f'{topic} type={kind}')
        for topic, kind in available.items()
        if kind in DECODERS
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
        f'the bag has no {what} of type {" or ".join(types)}; it holds {_contents(available)}'
    )


def _contents(available: Mapping[str, str]) -> str:
    return ', '.join(f'{t} ({kind})' for t, kind in sorted(available.items())) or 'nothing'


def replay(path: Path, session: CalibrationSession) -> tuple[str, ...]:
    """Feed a bag to a session; return warnings about what could not be read.

    Parameters
    ----------
    path : Path
        Folder of a rosbag2 recording, or one of its .mcap or .db3 files.
    session : CalibrationSession
        Takes the messages; its settings name topics where the types leave a choice.

    """
    if not path.exists():
        raise InputError(f'there is no bag at {path}')
    library = _rosbag2()
    try:
        reader = library.Reader(path)
        reader.open()
    except Exception as err:  # a damaged file fails in many ways, in the library and below it
        found = salvage(path)
        if found is None:
            raise InputError(f'{path} is not a readable rosbag2 recording: {err}') from err
        topics = Topics.choose(found.topics, session.settings)
        count, problem = _feed(session, topics.of(found.messages))
        total = recorded(path if path.is_dir() else path.parent)
        lost = 'how many are lost is not known'
        if total is not None:
            lost = f'{total - len(found.messages)} of {total} messages are lost'
        return (
            f'{path} is damaged ({problem or found.problem}): {count} messages could be read '
            f'and are used, {lost}',
        )
    with closing(reader):
        available = {c.topic: c.msgtype for c in reader.connections}
        topics = Topics.choose(available, session.settings)
        expected = sum(c.msgcount for c in reader.connections if c.topic in topics.types)
        count, problem = _feed(session, read(reader, topics.streams))
    if problem is not None and count == 0:
        found = salvage(path)
        if found is not None:
            count, _ = _feed(session, topics.of(found.messages))
    if problem is None:
        return session.warnings
    return (
        *session.warnings,
        f'{path} is damaged ({problem}): {expected - count} of {expected} messages are lost',
    )


def read(reader: Reader, streams: Mapping[str, Stream]) -> Iterator[tuple[Stream, bytes]]:
    """Return the messages of an open bag on some topics, in the order in which they were logged.

    Those of mcap files come chunk by chunk where each chunk ends before the next begins, and as
    they stand in the file where it has none. All others come as the library merges them, which
    takes twice as long for mcap.
    """
    storage = getattr(reader, 'storage', None)
    storages = getattr(storage, 'storages', [storage])
    if reader.compression_mode != 'message' and all(map(_is_consecutive, storages)):
        return itertools.chain.from_iterable(_in_place(each, streams) for each in storages)
    connections = [c for c in reader.connections if c.topic in streams]
    return (
        (streams[c.topic], data)
        for c, _, data in reader.messages(connections)
        if c.msgtype == streams[c.topic].type
    )


def _is_consecutive(storage: Any) -> bool:
    """Return whether it is an mcap file of which each chunk ends before the next one begins."""
    if not all(hasattr(storage, name) for name in STORAGE):
        return False
    if not all(hasattr(each, name) for each in storage.chunks for name in CHUNK):
        return False
    pairs = itertools.pairwise(storage.chunks)
    return all(a.message_end_time <= b.message_start_time for a, b in pairs)


def _in_place(storage: Any, streams: Mapping[str, Stream]) -> Iterator[tuple[Stream, bytes]]:
    """Yield the messages of an mcap file; what is wrong with a chunk is raised at the end."""
    channels = {
        each.id: streams[each.topic]
        for each in storage.connections
        if each.topic in streams and each.msgtype == streams[each.topic].type
    }
    if not storage.chunks:
        wanted = [each for each in storage.connections if each.id in channels]
        yield from ((channels[c.id], data) for c, _, data in storage.messages_scan(wanted))
    problem = None
    with storage.path.open('rb') as file:
        for chunk in storage.chunks:
            counts = chunk.channel_count  # empty where the recorder wrote no index of messages
            if counts and not any(counts.get(key) for key in channels):
                continue
            file.seek(chunk.chunk_start_offset)
            try:
                yield from logged(file.read(chunk.chunk_length), channels)
            except Exception as err:  # see `replay`
                problem = err
    if problem is not None:
        raise problem


def _rosbag2() -> Any:
    """Return the library that reads and writes bags; nothing but bags needs it.

    Raises
    ------
    InputError
        When it is not installed: Ubuntu does not package it.

    """
    try:
        from rosbags import rosbag2
    except ImportError as err:
        raise InputError(
            f'bags need the Python package rosbags, which is not installed ({err}): pip install '
            'rosbags, in a virtual environment where the system is managed (README, "Bags"); '
            'tables (--csv) and the node do without'
        ) from err
    return rosbag2


@cache
def _typestore() -> Any:
    """Return the library's message types, which take a tenth of a second that few bags need."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def _deserialised(data: bytes, kind: str) -> Any:
    return _typestore().deserialize_cdr(data, kind)


def _feed(
    session: CalibrationSession, messages: Iterator[tuple[Stream, bytes]]
) -> tuple[int, str | None]:
    """Feed serialised messages; return how many, and what is wrong with the others if any."""
    count, problem, ended = 0, None, False
    while not ended:
        batch: list[tuple[Stream, bytes]] = []
        try:
            batch.extend(itertools.islice(messages, BATCH))  # up to an error
            ended = len(batch) < BATCH
        except Exception as err:  # see `replay`
            problem, ended = str(err) or type(err).__name__, True
        problems = feed(session, batch, _deserialised)
        count += len(batch) - len(problems)
        problem = (problem, *problems)[-1]
    session.finish()
    return count, problem


@dataclass(frozen=True, eq=False)
class Recording:
    """What to write into a bag: joint samples (M, n), poses (N) and which of those judge only."""

    joint_names: tuple[str, ...]
    joint_stamps_ns: NDArray[np.int64]
    joints: FloatArray
    poses: Observations
    held_out: NDArray[np.bool_]

    @classmethod
    def of_dwells(
        cls,
        joint_names: tuple[str, ...],
        observations: Observations,
        held_out: NDArray[np.bool_],
    ) -> Recording:
        """Turn a table into a recording: the arm stands for a while at every row."""
        count = len(observations)
        begin = (1 + np.arange(count)[:, np.newaxis]) * 1_000_000_000
        stamps = begin + np.arange(0, STAND_NS + 1, STAND_NS // 4)
        return cls(
            joint_names,
            stamps.ravel(),
            np.repeat(observations.joints, stamps.shape[1], axis=0),
            observations.at(begin.ravel() + STAND_NS * 3 // 4),
            held_out,
        )


def write_bag(path: Path, recording: Recording, storage: str = 'mcap') -> None:
    """Write a recording as a rosbag2 folder, in the order of the stamps.

    Topics: /joint_states, and /measured_pose or /measured_point; /validation_pose or
    /validation_point for held-out poses.

    Raises
    ------
    InputError
        When there is something at the path already.

    """
    if path.exists():
        raise InputError(f'{path} exists already: remove it or choose another name')
    library = _rosbag2()
    store = _typestore()
    types = store.types
    time, header = types['builtin_interfaces/msg/Time'], types['std_msgs/msg/Header']
    joint_state, poses = types[JOINT_STATE], recording.poses
    oriented = bool(poses.oriented.all())
    kind = f'geometry_msgs/msg/{"PoseStamped" if oriented else "PointStamped"}'
    noun = 'pose' if oriented else 'point'
    none = np.zeros(0)
    quats = to_quat(poses.rotations)

    def head(stamp_ns: int, frame_id: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        return header(time(sec=seconds, nanosec=nanoseconds), frame_id)

    def measured(k: int, stamp_ns: int) -> Any:
        point = types['geometry_msgs/msg/Point'](*poses.positions[k].tolist())
        if not oriented:
            return types[kind](head(stamp_ns, 'tracker'), point)
        turn = types['geometry_msgs/msg/Quaternion'](*quats[k].tolist())
        pose = types['geometry_msgs/msg/Pose'](point, turn)
        return types[kind](head(stamp_ns, 'tracker'), pose)

    stamps = np.concatenate([recording.joint_stamps_ns, poses.stamps_ns])
    names = list(recording.joint_names)
    plugin = library.StoragePlugin[storage.upper()]
    with library.Writer(path, version=9, storage_plugin=plugin) as writer:
        joint_connection = writer.add_connection('/joint_states', JOINT_STATE, typestore=store)
        pose_connections = [
            writer.add_connection(f'/{prefix}{noun}', kind, typestore=store)
            for prefix in ('measured_', VALIDATION)[: 1 + int(recording.held_out.any())]
        ]
        for k in np.argsort(stamps, kind='stable').tolist():
            stamp_ns = int(stamps[k])
            if k < len(recording.joints):
                values = np.ascontiguousarray(recording.joints[k])
                message = joint_state(head(stamp_ns, ''), names, values, none, none)
                data = store.serialize_cdr(message, JOINT_STATE)
                writer.write(joint_connection, stamp_ns, data)
                continue
            k -= len(recording.joints)
            data = store.serialize_cdr(measured(k, stamp_ns), kind)
            writer.write(pose_connections[int(recording.held_out[k])], stamp_ns, data)
