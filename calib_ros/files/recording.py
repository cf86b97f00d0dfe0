# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings to bags: measurements that are synthetic, or of a table."""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.atomic import whole_folder, write_file
from calib_ros.estimation.observations import Observations
from calib_ros.files.bags import rosbag2, typestore
from calib_ros.kinematics.se3 import Flags, FloatArray, to_quat
from calib_ros.progress import Notify, quiet
from calib_ros.sampling.messages import JOINT_STATE
from calib_ros.sampling.source_texts import VALIDATION


@dataclass(frozen=True, eq=False)
class Recording:
    """Content of a bag: joint samples (M, n), poses (N), and which of these are held out."""

    joint_names: tuple[str, ...]
    joint_stamps_ns: NDArray[np.int64]
    joints: FloatArray
    poses: Observations
    held_out: Flags

    @classmethod
    def of_dwells(
        cls, joint_names: tuple[str, ...], observations: Observations, held_out: Flags
    ) -> Recording:
        """Return a table as a recording: the arm stands for 0.4 s at every row, once a second.

        `held_out` (N,) rows go to the validation topic.
        """
        begin = (1 + np.arange(len(observations))[:, np.newaxis]) * 1_000_000_000
        stamps = begin + np.arange(5) * 100_000_000
        joints = np.repeat(observations.joints, stamps.shape[1], axis=0)
        poses = observations.at(stamps[:, 3])
        return cls(joint_names, stamps.ravel(), joints, poses, held_out)


def write_bag(
    path: Path,
    recording: Recording,
    storage: str = 'mcap',
    beside: Mapping[Path, str] | None = None,
    progress: Notify = quiet,
) -> None:
    """Write a recording as a rosbag2 folder, ordered by stamp, whole or not at all.

    Topics: /joint_states, and /measured_pose or /measured_point; /validation_pose or
    /validation_point for held-out poses. Files `beside` the bag are written before it.
    """
    with whole_folder(path) as folder:
        try:
            _write_bag(folder, recording, storage, progress)
        except (OSError, sqlite3.Error) as err:
            full = errno.ENOSPC if 'full' in str(err) else None
            raise OSError(getattr(err, 'errno', None) or full, str(err), str(path)) from err
        for file, text in (beside or {}).items():
            write_file(file, text, overwrite=True)


def _write_bag(path: Path, recording: Recording, storage: str, progress: Notify) -> None:
    library = rosbag2()
    store = typestore()
    types = store.types
    time, header = types['builtin_interfaces/msg/Time'], types['std_msgs/msg/Header']
    joint_state, poses = types[JOINT_STATE], recording.poses
    oriented = bool(poses.oriented.all())
    noun = 'pose' if oriented else 'point'
    kind = f'geometry_msgs/msg/{noun.capitalize()}Stamped'
    none = np.zeros(0)
    quats = to_quat(poses.rotations)

    def head(stamp_ns: int, frame_id: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        return header(time(sec=seconds, nanosec=nanoseconds), frame_id)

    def measured(k: int, stamp_ns: int) -> Any:
        place = types['geometry_msgs/msg/Point'](*poses.positions[k].tolist())
        if oriented:
            turn = types['geometry_msgs/msg/Quaternion'](*quats[k].tolist())
            place = types['geometry_msgs/msg/Pose'](place, turn)
        return types[kind](head(stamp_ns, 'tracker'), place)

    stamps = np.concatenate([recording.joint_stamps_ns, poses.stamps_ns])
    names = list(recording.joint_names)
    plugin = library.StoragePlugin[storage.upper()]
    with library.Writer(path, version=9, storage_plugin=plugin) as writer:
        joint_connection = writer.add_connection('/joint_states', JOINT_STATE, typestore=store)
        pose_connections = [
            writer.add_connection(f'/{prefix}{noun}', kind, typestore=store)
            for prefix in ('measured_', VALIDATION)[: 1 + int(recording.held_out.any())]
        ]
        for done, k in enumerate(np.argsort(stamps, kind='stable').tolist()):
            progress(done / len(stamps))
            stamp_ns = int(stamps[k])
            pose = k - len(recording.joints)
            if pose < 0:
                values = recording.joints[k]
                message = joint_state(head(stamp_ns, ''), names, values, none, none)
                connection = joint_connection
            else:
                message = measured(pose, stamp_ns)
                connection = pose_connections[int(recording.held_out[pose])]
            data = store.serialize_cdr(message, connection.msgtype)
            writer.write(connection, stamp_ns, data)
