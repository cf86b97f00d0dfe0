# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Origins and ratios, written back into the text of a URDF; all other bytes stay."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from calib_ros.kinematics.se3 import ROUNDING, FloatArray
from calib_ros.kinematics.urdf_elements import AT, parsed, placed

_NAME = re.compile(r'<[^\s/>]+')
_TAG = re.compile(r"""<[^\s/>]+(?:\s+[^\s=]+\s*=\s*(?:"[^"]*"|'[^']*'))*\s*/?>""")


def edited(text: str, origins: Mapping[str, FloatArray], ratios: Mapping[str, float]) -> str:
    """Return a URDF with other joint origins (4, 4), added first in joints without one.

    And with other `ratios` of joints that mimic others.
    """
    data = text.encode()
    for start, tag, name in sorted(_places(text, origins, ratios), reverse=True):
        before, rest = data[:start].decode(), data[start:].decode()
        match = _TAG.match(rest)
        assert match is not None  # without entities, expat's index is exact
        head, tail = rest[: match.end()], rest[match.end() :]
        if tag == 'mimic':
            head = _with_attribute(head, 'multiplier', np.array([ratios[name]]))
        elif tag == 'origin':
            head = _with_origin(head, origins[name])
        elif (added := _with_origin('<origin/>', origins[name])) != '<origin/>':
            head += tail[: len(tail) - len(tail.lstrip())] + added
        data = (before + head + tail).encode()
    return data.decode()


def _places(
    text: str, origins: Mapping[str, object], ratios: Mapping[str, object]
) -> list[tuple[int, str, str]]:
    """Return the start of each origin, or else of the joint, and mimic tag: byte, tag, joint."""
    joints = {joint.get('name', ''): joint for joint in parsed(text).findall('joint')}
    wanted = [*((name, 'origin') for name in origins), *((name, 'mimic') for name in ratios)]
    found = [(joints[name].find(tag), name) for name, tag in wanted]
    places = [(joints[name] if at is None else at, name) for at, name in found]
    return [(int(at.get(AT, '')), at.tag, name) for at, name in places]


def _with_origin(tag: str, origin: FloatArray) -> str:
    """Return an origin tag with another value; equal attributes are not touched."""
    element = parsed(tag if tag.endswith('/>') else tag[:-1] + '/>')
    written, rpy = placed(element, 'origin')
    change = np.abs(origin - written)
    if change[:3, :3].max() > ROUNDING:
        tag = _with_attribute(tag, 'rpy', to_rpy(origin[:3, :3], rpy))
    if change[:3, 3].max() > ROUNDING:
        tag = _with_attribute(tag, 'xyz', origin[:3, 3])
    return tag


def _with_attribute(tag: str, key: str, values: FloatArray) -> str:
    text = ' '.join(repr(round(value, 15) + 0.0) for value in values.tolist())
    found = re.search(rf"""\s{key}\s*=\s*(["'])(.*?)\1""", tag, re.DOTALL)
    if found is None:
        return _NAME.sub(rf'\g<0> {key}="{text}"', tag, count=1)
    return tag[: found.start(2)] + text + tag[found.end(2) :]


def to_rpy(rotation: FloatArray, near: FloatArray) -> FloatArray:
    """Return roll, pitch, yaw (3,) [rad] of a rotation, the solution nearer to `near` (3,).

    The roll follows from the found yaw and pitch, so that the three are consistent near a pitch of
    90 degrees, where yaw and roll alone are undetermined.
    """
    first = np.arctan2(rotation[1, 0], rotation[0, 0])
    level = np.hypot(rotation[0, 0], rotation[1, 0])
    solutions = []
    for yaw, cosine in ((first, level), (first + np.pi, -level)):
        across = np.array([-np.sin(yaw), np.cos(yaw), 0.0]) @ rotation
        roll, pitch = np.arctan2(-across[2], across[1]), np.arctan2(-rotation[2, 0], cosine)
        difference = np.array([roll, pitch, yaw]) - near
        solutions.append(near + np.remainder(difference + np.pi, 2.0 * np.pi) - np.pi)
    return min(solutions, key=lambda angles: float(np.abs(angles - near).sum()))
