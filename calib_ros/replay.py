# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings: bag to session, and synthetic or tabulated measurements to bag."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from calib_ros.errors import InputError
from calib_ros.intake import Stream, feed, links_of
from calib_ros.mcap import logged
from calib_ros.messages import JOINT_STATE
from calib_ros.observations import Observations
from calib_ros.salvage import recorded, salvage
from calib_ros.se3 import FloatArray, to_quat
from calib_ros.session import CalibrationSession
from calib_ros.sources import VALIDATION
from calib_ros.topics import Reading, check_joints, choose

STORAGES = {'sqlite3': StoragePlugin.SQLITE3, 'mcap': StoragePlugin.MCAP}
STORAGE = ('chunks', 'connections', 'messages_scan', 'path')
TIMES = ('message_start_time', 'message_end_time')
CHUNK = (*TIMES, 'channel_count', 'chunk_start_offset', 'chunk_length')
"""What the library does not promise: without them, it is asked for the messages itself."""
BATCH = 2000
"""Messages that are decoded at once."""
STAND_NS = 400_000_000
"""Time for which the arm stands at each row of a table that is made into a bag."""


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
    try:
        reader = Reader(path)
        reader.open()
    except Exception as err:  # a damaged file fails in many ways, in the library and below it
        found = salvage(path)
        if found is None:
            raise InputError(f'{path} is not a readable rosbag2 recording: {err}') from err
        streams = choose(found.topics, session.settings, found.on)
        _check_joints(session, streams, found.on)
        count, problem = _feed(session, found.on(streams))
        _check_links(streams)
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
        streams = choose(available, session.settings, partial(read, reader))
        expected = sum(c.msgcount for c in reader.connections if c.topic in streams)
        _check_joints(session, streams, partial(read, reader))
        count, problem = _feed(session, read(reader, streams))
    if problem is not None and count == 0:
        found = salvage(path)
        if found is not None:
            _check_joints(session, streams, found.on)
            count, _ = _feed(session, found.on(streams))
    _check_links(streams)
    if problem is None:
        return session.warnings
    return (
        *session.warnings,
        f'{path} is damaged ({problem}): {expected - count} of {expected} messages are lost',
    )


def _check_joints(
    session: CalibrationSession, streams: Mapping[str, Stream], messages_on: Reading
) -> None:
    """Refuse several topics of the same joints, unless they were named."""
    joints = {topic: stream for topic, stream in streams.items() if stream.type == JOINT_STATE}
    if len(joints) > 1 and not session.settings.joint_topics:
        check_joints(messages_on(joints), session.joint_names, _deserialised)


def _check_links(streams: Mapping[str, Stream]) -> None:
    """Refuse sources that could not be measured between their frames."""
    problems = [words for links in links_of(streams.values()) for words in links.problems()]
    if problems:
        raise InputError('; '.join(problems))


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
    with Writer(path, version=9, storage_plugin=STORAGES[storage]) as writer:
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
