# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings: bag to session, and synthetic or tabulated measurements to bag."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from calib_ros.errors import InputError
from calib_ros.messages import JOINT_STATE, POSE_DECODERS
from calib_ros.observations import Observations
from calib_ros.salvage import recorded, salvage
from calib_ros.se3 import FloatArray, to_quat
from calib_ros.session import CalibrationSession

VALIDATION = 'validation_'
"""Topics whose last name starts so hold poses that judge the result and are never fitted."""
STORAGES = {'sqlite3': StoragePlugin.SQLITE3, 'mcap': StoragePlugin.MCAP}
_TYPESTORE = get_typestore(Stores.ROS2_JAZZY)


@dataclass(frozen=True)
class Topics:
    """Topics of a bag to replay, and their message types."""

    joint_states: str
    poses: Mapping[str, str]

    @property
    def all(self) -> dict[str, str]:
        """Return every topic to read, with its type."""
        return {self.joint_states: JOINT_STATE, **self.poses}

    @classmethod
    def choose(
        cls, available: Mapping[str, str], joint_topic: str | None, pose_topic: str | None
    ) -> Topics:
        """Choose topics by type from those available (topic to type), unless they are named.

        Raises
        ------
        InputError
            When there is none or more than one; it lists the candidates.

        """
        poses = {topic: kind for topic, kind in available.items() if kind in POSE_DECODERS}
        judging = {
            topic: kind
            for topic, kind in poses.items()
            if topic.rpartition('/')[2].startswith(VALIDATION)
        }
        measured = [topic for topic in poses if topic not in judging]
        joints = [topic for topic, kind in available.items() if kind == JOINT_STATE]
        chosen = _choose('pose', pose_topic, measured, sorted(POSE_DECODERS), available)
        return cls(
            _choose('joint', joint_topic, joints, [JOINT_STATE], available),
            {chosen: available[chosen], **judging},
        )


def _choose(
    what: str,
    named: str | None,
    candidates: Sequence[str],
    types: Sequence[str],
    available: Mapping[str, str],
) -> str:
    if named is not None and named in available and available[named] in types:
        return named
    if named is None and len(candidates) == 1:
        return candidates[0]
    contents = ', '.join(f'{t} ({kind})' for t, kind in sorted(available.items())) or 'nothing'
    if named is not None:
        problem = f'has no topic "{named}" of type {" or ".join(types)}'
    elif candidates:
        problem = (
            f'has several {what} topics, choose one with --{what}-topic: '
            f'{", ".join(sorted(candidates))}'
        )
    else:
        problem = f'has no {what} topic (of type {" or ".join(types)})'
    raise InputError(f'the bag {problem}; it holds {contents}')


def replay(
    path: Path,
    session: CalibrationSession,
    joint_topic: str | None = None,
    pose_topic: str | None = None,
) -> tuple[str, ...]:
    """Feed a bag to a session; return warnings about what could not be read.

    Parameters
    ----------
    path : Path
        Folder of a rosbag2 recording, or one of its .mcap or .db3 files.
    session : CalibrationSession
        Takes the messages.
    joint_topic, pose_topic : str, optional
        Needed only where the types leave a choice.

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
        topics = Topics.choose(found.topics, joint_topic, pose_topic)
        count, problem = _feed(session, topics, iter(found.messages))
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
        topics = Topics.choose(available, joint_topic, pose_topic)
        connections = [c for c in reader.connections if c.topic in topics.all]
        expected = sum(c.msgcount for c in connections)
        raw = ((c.topic, data) for c, _, data in reader.messages(connections))
        count, problem = _feed(session, topics, raw)
    if problem is not None and count == 0:
        found = salvage(path)
        if found is not None:
            count, _ = _feed(session, topics, iter(found.messages))
    if problem is None:
        return ()
    return (f'{path} is damaged ({problem}): {expected - count} of {expected} messages are lost',)


def _feed(
    session: CalibrationSession, topics: Topics, raw: Iterator[tuple[str, bytes]]
) -> tuple[int, str | None]:
    """Feed serialised messages; return how many, and what is wrong with the others if any."""
    count, problem = 0, None
    while True:
        try:
            topic, data = next(raw)
        except StopIteration:
            return count, problem
        except Exception as err:  # see `replay`
            return count, str(err) or type(err).__name__
        kind = topics.all.get(topic)
        try:
            message = None if kind is None else _TYPESTORE.deserialize_cdr(data, kind)
        except Exception as err:
            problem = f'a message on {topic} cannot be decoded: {err!r}'
            continue
        if topic == topics.joint_states:
            session.take_joints(message)
        elif kind is not None:
            session.take_pose(kind, message, topic.rpartition('/')[2].startswith(VALIDATION))
        count += kind is not None


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
        half_dwell_ns: int = 10_000_000,
    ) -> Recording:
        """Turn a table into a recording: the arm stands around the stamp of every pose."""
        stamps = observations.stamps_ns
        return cls(
            joint_names,
            np.stack([stamps - half_dwell_ns, stamps + half_dwell_ns], axis=1).ravel(),
            np.repeat(observations.joints, 2, axis=0),
            observations,
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
    types = _TYPESTORE.types
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
        joint_connection = writer.add_connection(
            '/joint_states', JOINT_STATE, typestore=_TYPESTORE
        )
        pose_connections = [
            writer.add_connection(f'/{prefix}{noun}', kind, typestore=_TYPESTORE)
            for prefix in ('measured_', VALIDATION)[: 1 + int(recording.held_out.any())]
        ]
        for k in np.argsort(stamps, kind='stable').tolist():
            stamp_ns = int(stamps[k])
            if k < len(recording.joints):
                values = np.ascontiguousarray(recording.joints[k])
                message = joint_state(head(stamp_ns, ''), names, values, none, none)
                data = _TYPESTORE.serialize_cdr(message, JOINT_STATE)
                writer.write(joint_connection, stamp_ns, data)
                continue
            k -= len(recording.joints)
            data = _TYPESTORE.serialize_cdr(measured(k, stamp_ns), kind)
            writer.write(pose_connections[int(recording.held_out[k])], stamp_ns, data)
