# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages into the session in batches, of live topics and of recordings.

Messages of one stream with the same layout are decoded at once; those of bodies and cameras one by
one, and grouped by their names. Both give the same arrays, with the place of each in the batch.
"""

from __future__ import annotations

import itertools
import traceback
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.cdr import read_header
from calib_ros.sampling.decoding import UNDECODED, by_layout
from calib_ros.sampling.messages import (
    BODIES,
    CAMERA_INFO,
    FORMS,
    JOINT_STATE,
    Reading,
    bodies_of,
    frame_name,
)
from calib_ros.sampling.pictures import Pictures
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.slices import POSES, Part
from calib_ros.sampling.streams import Batch, Stream
from calib_ros.sampling.transforms import Links
from calib_ros.texts import LARGEST_TABLE

BATCH = 2000  # messages taken at once (benchmarks/bags.py, benchmarks/soak.py)
Deserialise: TypeAlias = Callable[[bytes, str], Any]  # converts bytes and a type to a message


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
    decoded = by_layout(batch, problems)
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
