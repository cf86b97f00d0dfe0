# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot description (URDF), read to a tree."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from calib_ros.errors import MOST_ENTRIES, ConfigError, UnknownNameError
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.kinematics.urdf_elements import child_of, numbers_of, placed, robot_of
from calib_ros.kinematics.urdf_tree import MOVING_TYPES, DescribedJoint, Description
from calib_ros.values import LARGEST, SAME, parse_name

JOINT_TYPES = (*MOVING_TYPES, 'fixed', 'floating', 'planar')
ENDS = ('lower', 'upper')
MOST_LINKS = 10 * MOST_ENTRIES


def parse_urdf(text: str) -> Description:
    """Parse a URDF to a tree of links and joints, or raise ConfigError."""
    root = robot_of(text)
    masses = [(element.get('name', ''), _inertial(element)) for element in root.findall('link')]
    links = dict(masses)
    described = root.findall('joint')
    if max(len(masses), len(described)) > MOST_LINKS:
        raise ConfigError(f'the URDF has more than {MOST_LINKS} links or joints')
    joints = [_joint(element, links) for element in described]
    loops = (
        ': robots with closed loops, such as delta robots and hexapods, have no serial chain, and '
        'the links of a parallelogram are joints that mimic others'
    )
    for what, names, why in (
        ('links are named', [name for name, _ in masses], ''),
        ('joints are named', [joint.name for joint in joints], ''),
        ('joints lead to link', [joint.child for joint in joints], loops),
    ):
        for name, count in Counter(names).items():
            if count > 1:
                raise ConfigError(f'two {what} "{name}" in the URDF{why}')
    children = {joint.child for joint in joints}
    roots = [name for name in links if name not in children]
    if len(roots) != 1:
        none = 'none' if links else 'none, it has no links: an SRDF, or a macro nobody called?'
        found = ', '.join(roots) or none
        raise ConfigError(
            f'the links of a URDF must form a tree with one root; roots here: {found}'
        )
    name = parse_name(root.get('name') or 'robot', 'the name of the robot')
    return Description(name, roots[0], links, _outwards(joints, roots[0]))


def _outwards(joints: Sequence[DescribedJoint], root: str) -> tuple[DescribedJoint, ...]:
    behind: dict[str, list[DescribedJoint]] = {}
    for joint in joints:
        behind.setdefault(joint.parent, []).append(joint)
    outwards = list(behind.get(root, ()))
    for joint in outwards:  # grows
        outwards += behind.get(joint.child, ())
    if len(outwards) < len(joints):
        reached = {joint.child for joint in outwards}
        loop = ', '.join(joint.name for joint in joints if joint.child not in reached)
        raise ConfigError(
            f'the links of a URDF must form a tree, but there is a loop among joints {loop}'
        )
    return tuple(outwards)


def _joint(element: ET.Element, links: Mapping[str, object]) -> DescribedJoint:
    name = parse_name(element.get('name', ''), 'the name of a joint')
    kind = element.get('type', '')
    where = f'joint "{name}"'
    if kind not in JOINT_TYPES:
        raise UnknownNameError(f'{where}: type', kind, JOINT_TYPES)
    parent, child = (child_of(element, key).get('link', '') for key in ('parent', 'child'))
    for link in (parent, child):
        if link not in links:
            raise UnknownNameError(f'{where}: link', link, links)
    axis = np.zeros(3)
    if kind in MOVING_TYPES:
        axis = numbers_of(child_of(element, 'axis'), 'xyz', f'axis of {where}', '1 0 0')
        if np.abs(axis).max() < SAME:  # a rounded zero
            raise ConfigError(f'the axis of {where} has no direction')
        axis = axis / np.linalg.norm(axis)
    lower, upper = None, None
    limit = child_of(element, 'limit')
    if kind in ('revolute', 'prismatic') and set(ENDS) & set(limit.keys()):
        ends = (numbers_of(limit, key, f'limit of {where}', '0', 1, math.inf) for key in ENDS)
        lower, upper = (float(x[0]) if abs(x[0]) < 0.09 * LARGEST else None for x in ends)
    follows, mimic = None, element.find('mimic')
    if mimic is not None and kind in MOVING_TYPES:
        of = f'mimic of {where}'
        ratio, offset = (
            float(numbers_of(mimic, key, of, default, 1)[0])
            for key, default in (('multiplier', '1'), ('offset', '0'))
        )
        follows = mimic.get('joint', ''), ratio, offset
    at = child_of(element, 'origin')
    if at.get('quat_xyzw'):
        raise ConfigError(f'quat_xyzw of {where} is not supported: write the rotation as rpy')
    origin, rpy = placed(at, f'origin of {where}')
    if (most := np.abs(rpy).max()) > 4.0 * math.pi:  # two turns
        raise ConfigError(
            f'the rpy of {where} must be in radians, not {most:g}: is it in degrees?'
        )
    return DescribedJoint(name, kind, parent, child, origin, axis, lower, upper, follows)


def _inertial(link: ET.Element) -> tuple[float, FloatArray]:
    """Return mass [kg] and centre (3,) [m] of a link in its frame."""
    where = f'inertial of link "{link.get("name", "")}"'
    inertial = child_of(link, 'inertial')
    mass = numbers_of(child_of(inertial, 'mass'), 'value', where, '0', 1)
    origin, _ = placed(child_of(inertial, 'origin'), f'origin of {where}')
    return float(mass[0]), origin[:3, 3]
