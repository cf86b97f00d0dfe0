# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The chain from a robot description (URDF).

    URDF     T_base_tip(q) = O_1 M_1(q_1) ... O_n M_n(q_n) O_tip
    chain    T_base_tip(q) = base A_1(q_1) ... A_n(q_n) tool

O are origins of joints, fixed joints multiplied in; M turns about an axis, or shifts along it.
Only the lines of the axes at q = 0 matter (`axes.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib_ros.annotated import as_annotated
from calib_ros.errors import ConfigError
from calib_ros.kinematics import se3
from calib_ros.kinematics.axes import clean, link_ends, row_to_axis
from calib_ros.kinematics.chain import Chain, Convention, Frame, Joint, JointType
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.kinematics.urdf_reader import parse_urdf
from calib_ros.kinematics.urdf_tree import DescribedJoint, Description
from calib_ros.values import MOST_NAMES


@as_annotated
def chain_from_urdf(
    text: str,
    base_link: str | None = None,
    tip_link: str | None = None,
    convention: Convention = 'standard',
) -> Chain:
    """Return the chain between two links of a URDF, with the same forward kinematics.

    Base: from base_link to a frame with z along the first axis, the origin at the foot of
    base_link's origin on it, and x as in the first joint. Tool: from the last frame, whose origin
    is the foot of tip_link's origin on the last axis, to tip_link. Neither is fixed. Limits are
    kept, and the masses of everything attached to a link; moving side branches count in their zero
    position. Gravity points along -z of base_link.

    The links are by default the root, and `tool0`, `flange` or the only end behind a moving joint.
    The table gets the given convention.

    Raises ConfigError if the text is not a URDF, or no serial chain connects the links.
    """
    robot = parse_urdf(text)
    path = robot.path(base_link, tip_link)
    poses = robot.poses(path[0].parent)
    moving = [joint for joint in path if joint.moves]
    if len(moving) > MOST_NAMES:
        raise ConfigError(
            f'{len(moving)} joints move between the links, more than {MOST_NAMES}: choose '
            'base_link and tip_link nearer to each other'
        )
    places = [poses[joint.child] for joint in moving]
    axes = [place[:3, :3] @ joint.axis for place, joint in zip(places, moving, strict=True)]
    tip = poses[path[-1].child]

    frame = first = _first_frame(places[0], axes[0])
    rows = [_row(joint) for joint in moving]
    for i in range(len(rows) - 1):
        rows[i] = row_to_axis(rows[i], frame, axes[i + 1], places[i + 1][:3, 3])
        frame = frame @ link_ends(Chain('row', 'standard', (rows[i],)))[0]
    rows[-1] = replace(rows[-1], d=clean(float(frame[:3, 2] @ (tip - frame)[:3, 3])))
    if convention == 'modified':  # bends are in the next row
        bends = [Joint('straight'), *rows[:-1]]
        pairs = zip(rows, bends, strict=True)
        rows = [replace(row, a=bend.a, alpha=bend.alpha, beta=bend.beta) for row, bend in pairs]
    x, y, z = (clean(Chain.gravity[2] * part) for part in first[2, :3].tolist())
    chain = Chain(robot.name, convention, tuple(rows), base=Frame(first), gravity=(x, y, z))
    couplings = {coupling_of(joint): joint.follows[1] for joint in moving if joint.follows}
    chain = chain.with_effect_values(couplings)
    ends = link_ends(chain)
    return replace(
        chain,
        joints=_with_masses(rows, ends, robot, moving, poses),
        tool=Frame(se3.invert(ends[-1]) @ tip),
    )


def coupling_of(joint: DescribedJoint) -> str:
    """Return the name of the effect that couples a joint to the one that it mimics."""
    return f'{joint.name}.coupling_{joint.follows[0] if joint.follows else ""}'


def _row(joint: DescribedJoint) -> Joint:
    if joint.lower is not None and joint.lower == joint.upper and not joint.follows:
        raise ConfigError(
            f'limits of joint "{joint.name}" are equal: correct them or, if it never moves, '
            'leave them out and give them in the chain file (calib_ros chain)'
        )
    kind: JointType = 'prismatic' if joint.type == 'prismatic' else 'revolute'
    return Joint(joint.name, kind, lower=joint.lower, upper=joint.upper)


def _first_frame(joint: FloatArray, axis: FloatArray) -> FloatArray:
    """Return a frame (4, 4) with z along an axis, near the origin and x of the joint."""
    across = joint[:3, 0] - axis * (axis @ joint[:3, 0])
    if np.linalg.norm(across) < 0.1:  # the axis is the joint's x
        across = joint[:3, 1] - axis * (axis @ joint[:3, 1])
    x = across / np.linalg.norm(across)
    foot = joint[:3, 3] - axis * (axis @ joint[:3, 3])
    return se3.transform(np.column_stack([x, np.cross(axis, x), axis]), foot)


def _with_masses(
    rows: Sequence[Joint],
    ends: FloatArray,
    robot: Description,
    moving: Sequence[DescribedJoint],
    poses: Mapping[str, FloatArray],
) -> tuple[Joint, ...]:
    number = {joint.child: i for i, joint in enumerate(moving)}
    masses, moments = np.zeros(len(rows)), np.zeros((len(rows), 3))
    for joint in robot.joints:  # from the root outwards
        if joint.parent in number:
            number.setdefault(joint.child, number[joint.parent])
        if joint.child in number:
            mass, centre = robot.links[joint.child]
            masses[number[joint.child]] += mass
            moments[number[joint.child]] += mass * (poses[joint.child] @ [*centre, 1.0])[:3]
    loaded = []
    for row, end, mass, moment in zip(rows, ends, masses.tolist(), moments, strict=True):
        if mass:
            x, y, z, _ = (se3.invert(end) @ [*(moment / mass), 1.0]).tolist()
            row = replace(row, mass=mass, com=(x, y, z))
        loaded.append(row)
    return tuple(loaded)
