# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Decoding of serialised messages of a recording straight to arrays.

Messages of one topic mostly differ only in stamps and numbers. The layout is derived from the
first message, others of its length are compared with it byte by byte, and all numbers are read at
once, and then divided by names.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence

import numpy as np

from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.sampling.message_layout import Layouts, message_layout
from calib_ros.sampling.messages import FORMS
from calib_ros.sampling.slices import Part, Stamps
from calib_ros.sampling.streams import Batch, Stream
from calib_ros.values import MOST_NAMES

UNDECODED = 'a message on {} cannot be decoded: {}'


def alike(
    kind: str, blobs: Sequence[bytes], known: Layouts
) -> Iterator[tuple[Index, tuple[str, ...], Stamps, FloatArray]]:
    """Yield what messages of one type, encoding and length hold, those of each layout at once.

    Their indices (N,), the strings, stamps (N,) and numbers (N, w) of a part; damaged ones are
    left out. Layouts that are `known` are reused, and new ones added, up to MOST_NAMES.
    """
    length, encoding = len(blobs[0]), blobs[0][:2]
    rows = np.frombuffer(b''.join(blobs), dtype=np.uint8).reshape(len(blobs), length)
    rest = np.arange(len(rows))
    if len(known) == MOST_NAMES:
        known.clear()
    layouts = known.setdefault((length, encoding), [])
    untried, tried = list(layouts), 0
    while len(rest):
        if untried:
            layout = untried.pop(0)
        else:
            try:
                layout = message_layout(kind, blobs[rest[0]])
            except (struct.error, UnicodeDecodeError):
                rest = rest[1:]
                continue
            if len(layouts) == MOST_NAMES:
                layouts.clear()
            layouts.append(layout)
        some = rest if tried < MOST_NAMES else rest[:1]  # of so many layouts, each by itself
        tried += 1
        same, found = layout.read(rows if len(some) == len(rows) else rows[some])
        own = some[same]
        for which, strings, stamps, numbers in found if len(own) else ():
            yield own[which], strings, stamps, numbers
        rest = np.concatenate([some[~same], rest[len(some) :]])


def by_layout(batch: Batch, problems: list[str]) -> Iterator[tuple[Stream, Part]]:
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
