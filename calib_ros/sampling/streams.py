# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Streams: messages of one topic, and what they measure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from calib_ros.sampling.messages import CAMERA_INFO, LINKS, TRANSFORMS
from calib_ros.sampling.sources import Source
from calib_ros.sampling.transforms import STATIC, Links

Batch: TypeAlias = 'Sequence[tuple[Stream, bytes]]'
"""Streams and their serialised messages, in order of arrival."""


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
