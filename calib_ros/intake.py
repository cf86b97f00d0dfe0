# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Serialised messages into the session, by the batch: of live topics and of recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from calib_ros.cdr import readings
from calib_ros.messages import JOINT_STATE, JointReading
from calib_ros.session import CalibrationSession
from calib_ros.sources import Source


@dataclass(frozen=True)
class Stream:
    """What comes on one topic: its message type, and what it measures; None for joint states."""

    topic: str
    type: str
    source: Source | None = None


def feed(
    session: CalibrationSession,
    batch: Sequence[tuple[Stream, bytes]],
    deserialise: Callable[[bytes, str], Any],
) -> list[str]:
    """Let a session take messages in their order; return why some could not be decoded.

    Messages of one stream that are laid out alike are decoded at once, others one by one.

    Parameters
    ----------
    session : CalibrationSession
        Takes the messages.
    batch : sequence of (Stream, bytes)
        Messages in the order in which they came.
    deserialise : callable
        Makes a message of bytes and a message type.

    """
    blobs: dict[Stream, list[bytes]] = {}
    for stream, data in batch:
        blobs.setdefault(stream, []).append(data)
    decoded = {
        stream: iter(found)
        for stream, each in blobs.items()
        if (found := readings(stream.type, each)) is not None
    }
    problems = []
    for stream, data in batch:
        if stream in decoded:
            reading = next(decoded[stream])
            if isinstance(reading, JointReading):
                session.take_joint_reading(reading)
            elif stream.source is not None:
                session.take_reading(stream.source, reading)
            continue
        try:
            message = deserialise(data, stream.type)
        except Exception as err:  # damaged bytes fail in many ways
            problems.append(f'a message on {stream.topic} cannot be decoded: {err!r}')
            continue
        if stream.type == JOINT_STATE:
            session.take_joints(message)
        elif stream.source is not None:
            session.take(stream.source, stream.type, message)
    return problems
