# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot description (URDF) as a tree of links and joints, and origins back into its text.

Only origins and ratios are edited in the text; all other bytes stay.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from xml.parsers import expat

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros.errors import MOST_ENTRIES, ConfigError, UnknownNameError
from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import ROUNDING, FloatArray
from calib_ros.texts import LARGEST_TEXT
from calib_ros.values import LARGEST, SAME, parse_name

MOVING_TYPES = ('revolute', 'continuous', 'prismatic')
JOINT_TYPES = (*MOVING_TYPES, 'fixed', 'floating', 'planar')
USUAL_TIPS = ('tool0', 'flange')
ENDS = ('lower', 'upper')
MOST_LINKS = 10 * MOST_ENTRIES

_AT = ' at'  # no attribute has such a name
_DOCTYPE = re.compile(r'<!DOCTYPE|<!ENTITY', re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class DescribedJoint:
    """A joint of a URDF; `axis` is a unit vector in its frame, zero if fixed.

    It `follows` another joint, times a multiplier and plus an offset, if it mimics one.
    """

    name: str
    type: str
    parent: str
    child: str
    origin: FloatArray
    axis: FloatArray
    lower: float | None
    upper: float | None
    follows: tuple[str, float, float] | None

    @property
    def moves(self) -> bool:
        """Tell whether one number drives the joint."""
        return self.type in MOVING_TYPES


@dataclass(frozen=True, eq=False)
class Description:
    """A URDF: mass [kg] and centre (3,) [m] of its links, its joints from the root outwards."""

    name: str
    root: str
    links: dict[str, tuple[float, FloatArray]]
    joints: tuple[DescribedJoint, ...]

    def path(self, base: str | None, tip: str | None) -> tuple[DescribedJoint, ...]:
        """Return the joints from one link to another: by default from the root to the arm's end.

        Of joints that mimic one that is not among them, the first one leads the others. A joint
        that follows has equal limits.

        Raises ConfigError if no serial chain of joints connects them.
        """
        base = self.root if base is None else base
        for link in (base, tip):
            if link is not None and link not in self.links:
                raise UnknownNameError('link', link, self.links)
        tip = self._usual_tip(base) if tip is None else tip
        leading = {joint.child: joint for joint in self.joints}
        path: list[DescribedJoint] = []
        while (link := path[-1].parent if path else tip) != base:
            if link not in leading:
                before = ', '.join([link, *(joint.child for joint in reversed(path))])
                raise ConfigError(
                    f'no joints lead from link "{base}" out to link "{tip}": choose base_link '
                    f'among those before it, {before}'
                )
            path.append(leading[link])
        path.reverse()
        if not any(joint.moves for joint in path):
            raise ConfigError(f'no joint moves between link "{base}" and link "{tip}"')
        for joint in path:
            if joint.type in ('floating', 'planar'):
                raise ConfigError(
                    f'joint "{joint.name}" is {joint.type}: a serial chain has revolute, '
                    'continuous, prismatic and fixed joints only; choose base_link and tip_link '
                    'on one side of it'
                )
        leaders = {each.name: (each.name, 1.0, 0.0) for each in path if not each.follows}
        return tuple(self._as_mimic(joint, leaders) if joint.follows else joint for joint in path)

    def _as_mimic(
        self, joint: DescribedJoint, leaders: dict[str, tuple[str, float, float]]
    ) -> DescribedJoint:
        """Return a joint as it follows one of the `leaders`, or as the leader of its master."""
        known = {each.name: each for each in self.joints}
        master, ratio, offset = joint, 1.0, 0.0
        passed = []
        while master.follows:
            passed.append(master.name)
            name, times, more = master.follows
            if name not in known:
                raise UnknownNameError(f'joint that "{master.name}" mimics', name, known)
            if name in passed or not times:
                raise ConfigError(f'joint "{joint.name}" mimics itself, or another times zero')
            master, ratio, offset = known[name], ratio * times, offset + ratio * more
        leader, one, before = leaders.setdefault(master.name, (joint.name, ratio, offset))
        if leader == joint.name:
            return replace(joint, follows=None)
        offset -= ratio / one * before
        return replace(joint, lower=offset, upper=offset, follows=(leader, ratio / one, offset))

    def _usual_tip(self, base: str) -> str:
        behind, moved = {base}, dict[str, None]()
        for joint in self.joints:
            if joint.parent in behind:
                behind.add(joint.child)
                if joint.moves or joint.parent in moved:
                    moved[joint.child] = None
        for link in USUAL_TIPS:
            if link in moved:
                return link
        parents = {joint.parent for joint in self.joints}
        ends = [link for link in self.links if link in moved and link not in parents]
        if len(ends) == 1:
            return ends[0]
        usual = ([link for link in moved if link.endswith(name)] for name in USUAL_TIPS)
        prefixed = next((links for links in usual if links), ())
        if len(prefixed) == 1:
            return prefixed[0]
        found = f'ends in {", ".join(ends)}' if ends else f'moves nothing behind "{base}"'
        below = Counter(ends)
        for joint in reversed(self.joints):
            below[joint.parent] += below[joint.child]
        if forks := [link for link in moved if below[link] == len(ends)]:
            found += f', all behind {forks[-1]}'
        raise ConfigError(
            f'the URDF {found}: name the tip_link of the arm (calib_ros chain FILE '
            '--tip-link LINK --out arm.yaml; then --chain arm.yaml)'
        )

    def poses(self, base: str) -> dict[str, FloatArray]:
        """Return the frames (4, 4) of all links behind a base at zero, in the base."""
        poses = {base: np.eye(4)}
        for joint in self.joints:
            if joint.parent in poses:
                poses[joint.child] = poses[joint.parent] @ joint.origin
        return poses


def parse_urdf(text: str) -> Description:
    """Parse a URDF to a tree of links and joints, or raise ConfigError."""
    root = _robot(text)
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
        found = ', '.join(roots) or 'none'
        raise ConfigError(
            f'the links of a URDF must form a tree with one root; roots here: {found}'
        )
    name = parse_name(root.get('name') or 'robot', 'the name of the robot')
    return Description(name, roots[0], links, _outwards(joints, roots[0]))


def _robot(text: str) -> ET.Element:
    if _DOCTYPE.search(text):
        raise ConfigError(
            'the URDF has a <!DOCTYPE>, whose entities can stand for anything: remove it'
        )
    if len(text) > LARGEST_TEXT:
        raise ConfigError(f'the URDF is larger than {LARGEST_TEXT // 1_000_000} MB')
    try:
        root = _parsed(text)
    except (expat.ExpatError, ValueError) as err:  # ValueError: not UTF-8
        path = '; expected its text: load_chain reads a file' * ('<' not in text)
        raise ConfigError(f'the URDF is not valid XML: {err}{path}') from err
    if any('xacro:' in element.tag for element in root.iter()):
        raise ConfigError('this is a xacro file, not a URDF: run "xacro FILE > robot.urdf" first')
    if root.tag != 'robot':
        raise ConfigError(f'a URDF has the root element <robot>, not <{root.tag}>: convert it')
    return root


def _parsed(text: str) -> ET.Element:
    """Return the elements of a text, each with its first byte as an attribute.

    Prefixes need no declaration, as in ROS.
    """
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        builder.start(tag, attributes | {_AT: str(parser.CurrentByteIndex)})

    parser.StartElementHandler, parser.EndElementHandler = start, builder.end
    parser.Parse(text, True)
    return builder.close()


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
        raise UnknownNameError(f'type of {where}', kind, JOINT_TYPES)
    parent, child = (_child(element, key).get('link', '') for key in ('parent', 'child'))
    for link in (parent, child):
        if link not in links:
            raise UnknownNameError(f'link at {where}', link, links)
    axis = np.zeros(3)
    if kind in MOVING_TYPES:
        axis = _numbers(_child(element, 'axis'), 'xyz', f'axis of {where}', '1 0 0')
        if np.abs(axis).max() < SAME:  # a rounded zero
            raise ConfigError(f'the axis of {where} has no direction')
        axis = axis / np.linalg.norm(axis)
    lower, upper = None, None
    limit = _child(element, 'limit')
    if kind in ('revolute', 'prismatic') and set(ENDS) & set(limit.keys()):
        ends = (_numbers(limit, key, f'limit of {where}', '0', 1, math.inf) for key in ENDS)
        lower, upper = (float(x[0]) if abs(x[0]) < 0.09 * LARGEST else None for x in ends)
    follows, mimic = None, element.find('mimic')
    if mimic is not None and kind in MOVING_TYPES:
        of = f'mimic of {where}'
        ratio, offset = (
            float(_numbers(mimic, key, of, default, 1)[0])
            for key, default in (('multiplier', '1'), ('offset', '0'))
        )
        follows = mimic.get('joint', ''), ratio, offset
    origin, rpy = _placed(_child(element, 'origin'), f'origin of {where}')
    if (most := np.abs(rpy).max()) > 4.0 * math.pi:  # two turns
        raise ConfigError(
            f'the rpy of {where} must be in radians, not {most:g}: is it in degrees?'
        )
    return DescribedJoint(name, kind, parent, child, origin, axis, lower, upper, follows)


def _inertial(link: ET.Element) -> tuple[float, FloatArray]:
    """Return mass [kg] and centre (3,) [m] of a link in its frame."""
    where = f'inertial of link "{link.get("name", "")}"'
    inertial = _child(link, 'inertial')
    mass = _numbers(_child(inertial, 'mass'), 'value', where, '0', 1)
    origin, _ = _placed(_child(inertial, 'origin'), f'origin of {where}')
    return float(mass[0]), origin[:3, 3]


def _placed(origin: ET.Element, where: str) -> tuple[FloatArray, FloatArray]:
    """Return the transform (4, 4) of an origin tag, and its roll, pitch, yaw [rad]."""
    xyz, rpy = (_numbers(origin, key, where, '0 0 0') for key in ('xyz', 'rpy'))
    return se3.transform(np.asarray(Rotation.from_euler('xyz', rpy).as_matrix()), xyz), rpy


def _child(element: ET.Element, tag: str) -> ET.Element:
    found = element.find(tag)
    return ET.Element(tag) if found is None else found


def _numbers(
    element: ET.Element,
    key: str,
    where: str,
    default: str,
    count: int = 3,
    largest: float = LARGEST,
) -> FloatArray:
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


# ---- back into the text

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
    joints = {joint.get('name', ''): joint for joint in _parsed(text).findall('joint')}
    wanted = [*((name, 'origin') for name in origins), *((name, 'mimic') for name in ratios)]
    found = [(joints[name].find(tag), name) for name, tag in wanted]
    places = [(joints[name] if at is None else at, name) for at, name in found]
    return [(int(at.get(_AT, '')), at.tag, name) for at, name in places]


def _with_origin(tag: str, origin: FloatArray) -> str:
    """Return an origin tag with another value; equal attributes are not touched."""
    element = _parsed(tag if tag.endswith('/>') else tag[:-1] + '/>')
    written, rpy = _placed(element, 'origin')
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
