# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sources as users write them: TOPIC key=value ..."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

from calib_ros.errors import ConfigError, UnknownNameError
from calib_ros.sampling.messages import PICTURES, TRANSFORMS, frame_name, short_type
from calib_ros.sampling.sources import RANGEFINDER, TYPES, Source

VALIDATION = 'validation_'
"""Prefix of topics whose measurements judge the result and are never fitted."""


def parse_source(text: str, types: Mapping[str, str] | None = None) -> Source:
    """Parse a source "TOPIC key=value ...".

    Keys: type, device, target, eye_in_hand (true or false), validation (true or false), parent and
    child, and of images board, info and lens. Short types such as PoseStamped are accepted; the
    type defaults to that of the topic in `types`, to TFMessage for a topic named tf or with parent
    and child, and to images with a board. Values with blanks need quotes.
    """
    try:
        topic, *pairs = shlex.split(text) or ('',)
    except ValueError as err:
        raise ConfigError(f'source "{text}" cannot be read: {err}') from err
    if not topic or '=' in topic:
        raise ConfigError(f'source "{text}" must begin with its topic: "TOPIC key=value ..."')
    values: dict[str, Any] = {'validation': topic.rpartition('/')[2].startswith(VALIDATION)}
    for pair in pairs:
        key, equals, value = pair.partition('=')
        if not equals or key not in SOURCE_KEYS:
            raise UnknownNameError(f'source "{text}": key', key, SOURCE_KEYS)
        if key in ('eye_in_hand', 'validation'):
            if value not in ('true', 'false'):
                raise ConfigError(f'{key} of source "{text}" must be true or false, not "{value}"')
            values[key] = value == 'true'
        elif key == 'type':
            full = (known for known in TYPES if value in (known, short_type(known)))
            values[key] = next(full, value)
        else:
            values[key] = frame_name(value) if key in ('parent', 'child') else value
    if types and types.get(topic) in TYPES:
        values.setdefault('type', types[topic])
    if values.keys() & {'parent', 'child'} or topic.rpartition('/')[2] == 'tf':
        values.setdefault('type', TRANSFORMS)
    if 'board' in values:
        values.setdefault('type', PICTURES[topic.endswith('/compressed')])
    if values.get('type', '').endswith('/Range'):
        values['device'] = values.get('device') or RANGEFINDER
    return Source(topic, **values)


SOURCE_KEYS = tuple(item.name for item in fields(Source) if item.name != 'topic')


def parse_sources(
    texts: Sequence[str], types: Mapping[str, str] | None = None
) -> tuple[Source, ...]:
    """Parse sources; a topic may be named once, or once for each pair of frames."""
    sources = tuple(parse_source(text, types) for text in texts)
    names = [' '.join((each.topic, each.parent, each.child)).strip() for each in sources]
    for source, name in zip(sources, names, strict=True):
        if names.count(name) > 1:
            raise ConfigError(f'source "{name}" is named twice')
        if any(each.topic == source.topic and each.type != source.type for each in sources):
            raise ConfigError(f'source "{source.topic}" is named with different types')
    return sources
