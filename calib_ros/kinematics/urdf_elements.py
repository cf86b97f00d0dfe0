# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The elements of a robot description (URDF), and their numbers."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from xml.parsers import expat

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros.errors import ConfigError
from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.texts import LARGEST_TEXT
from calib_ros.values import LARGEST

AT = ' at'  # no attribute has such a name
_DOCTYPE = re.compile(r'<!DOCTYPE|<!ENTITY', re.IGNORECASE)
_NOT_READ = re.compile(rb'(?s)<(?:\?.*?(?:\?>|\Z)|!--.*?(?:-->|\Z)|!\[CDATA\[.*?(?:]]>|\Z))')


def robot_of(text: str) -> ET.Element:
    """Return the root element of a URDF, or raise ConfigError."""
    if _DOCTYPE.search(text):
        raise ConfigError(
            'the URDF has a <!DOCTYPE>, whose entities can stand for anything: remove it'
        )
    if len(text) > LARGEST_TEXT:
        raise ConfigError(f'the URDF is larger than {LARGEST_TEXT // 1_000_000} MB')
    try:
        root = parsed(text)
    except (expat.ExpatError, ValueError) as err:  # ValueError: not UTF-8
        path = '; expected its text: load_chain reads a file' * ('<' not in text)
        raise ConfigError(f'the URDF is not valid XML: {err}{path}') from err
    if any('xacro:' in element.tag for element in root.iter()):
        raise ConfigError('this is a xacro file, not a URDF: run "xacro FILE > robot.urdf" first')
    if root.tag != 'robot':
        raise ConfigError(f'a URDF has the root element <robot>, not <{root.tag}>: convert it')
    return root


def parsed(text: str) -> ET.Element:
    """Return the elements of a text, each with its first byte as an attribute.

    As in ROS, prefixes need no declaration, comments may hold --, and blanks or comments may come
    before <?xml.
    """
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        builder.start(tag, attributes | {AT: str(parser.CurrentByteIndex)})

    parser.StartElementHandler, parser.EndElementHandler = start, builder.end
    blanks = _NOT_READ.sub(lambda part: re.sub(rb'[^\n]', b' ', part[0]), text.encode())
    parser.Parse(blanks, True)
    return builder.close()


def placed(origin: ET.Element, where: str) -> tuple[FloatArray, FloatArray]:
    """Return the transform (4, 4) of an origin tag, and its roll, pitch, yaw [rad]."""
    xyz, rpy = (numbers_of(origin, key, where, '0 0 0') for key in ('xyz', 'rpy'))
    return se3.transform(np.asarray(Rotation.from_euler('xyz', rpy).as_matrix()), xyz), rpy


def child_of(element: ET.Element, tag: str) -> ET.Element:
    """Return the first child with a tag, empty if there is none."""
    found = element.find(tag)
    return ET.Element(tag) if found is None else found


def numbers_of(
    element: ET.Element,
    key: str,
    where: str,
    default: str,
    count: int = 3,
    largest: float = LARGEST,
) -> FloatArray:
    """Return the numbers (count,) of an attribute, or raise ConfigError."""
    text = element.get(key, default)
    if '${' in text:
        raise ConfigError(f'{key} in the {where} is a formula, "{text}": run xacro first')
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError:
        values = np.array([])
    if len(values) != count or not np.isfinite(values).all():
        what = f'{count} finite numbers' if count > 1 else 'a finite number'
        raise ConfigError(f'{key} in the {where} must be {what}, not "{text}"')
    if np.abs(values).max() > largest:
        raise ConfigError(f'{key} in the {where} must be at most {largest:g}, not "{text}"')
    return values
