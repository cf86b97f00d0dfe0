# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The chain from a robot description (URDF), and the corrected arm back into it.

    URDF     T_base_tip(q) = O_1 M_1(q_1) ... O_n M_n(q_n) O_tip
    chain    T_base_tip(q) = base A_1(q_1) ... A_n(q_n) tool

O are origins of joints, fixed joints multiplied in; M turns about an axis, or shifts along it.
Only the lines of the axes at q = 0 matter. In both conventions the same five parameters lead from
a frame on one axis to a frame on the next,

    Rz(theta_i) Tz(d_i) Tx(a) Rx(alpha) Ry(beta)

with a, alpha and beta in row i of the standard convention and in row i + 1 of the modified one.
Skew or intersecting axes take their common normal, with beta = 0. (Nearly) parallel ones take
d = 0: theta and a lead to the point where the next axis pierces the plane across this one, alpha
and beta tilt z into it. Nothing is divided by the angle between the axes there, so the tilts in a
calibrated URDF give no absurd lengths (Hayati and Mirmirani 1985).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib_ros.annotated import as_annotated
from calib_ros.errors import ConfigError
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import (
    PARALLEL_TOLERANCE,
    Chain,
    Convention,
    Frame,
    Joint,
    JointType,
    nearly_parallel,
    refuse_other_joints,
)
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.kinematics.urdf_tree import DescribedJoint, Description, edited, parse_urdf
from calib_ros.settings import Settings
from calib_ros.values import MOST_NAMES, SAME

MOST_APART = 2.0 * Settings.largest_angle
"""Mean pose difference [m or rad] at which a chain is not the arm of a URDF."""


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
        rows[i] = _row_to_axis(rows[i], frame, axes[i + 1], places[i + 1][:3, 3])
        frame = frame @ _ends(Chain('row', 'standard', (rows[i],)))[0]
    rows[-1] = replace(rows[-1], d=_clean(float(frame[:3, 2] @ (tip - frame)[:3, 3])))
    if convention == 'modified':  # bends are in the next row
        bends = [Joint('straight'), *rows[:-1]]
        pairs = zip(rows, bends, strict=True)
        rows = [replace(row, a=bend.a, alpha=bend.alpha, beta=bend.beta) for row, bend in pairs]
    x, y, z = (_clean(Chain.gravity[2] * part) for part in first[2, :3].tolist())
    chain = Chain(robot.name, convention, tuple(rows), base=Frame(first), gravity=(x, y, z))
    couplings = {_coupling(joint): joint.follows[1] for joint in moving if joint.follows}
    chain = chain.with_effect_values(couplings)
    ends = _ends(chain)
    return replace(
        chain,
        joints=_with_masses(rows, ends, robot, moving, poses),
        tool=Frame(se3.invert(ends[-1]) @ tip),
    )


@as_annotated
def corrected_urdf(
    text: str, chain: Chain, base_link: str | None = None, tip_link: str | None = None
) -> str:
    """Return a URDF with the forward kinematics of a corrected arm between two links.

    Only `<origin>` of joints on the path changes, and the `multiplier` of those that mimic others.
    Base and tool of the chain lead to the measuring device and its target, which are not parts of
    the robot, so the URDF's own transforms before the first axis and behind the last frame are
    kept. Errors of theta and d go into the origin of their joint; everything behind it follows.

    The chain is the corrected one, identified from this nominal URDF and these links (as for
    `chain_from_urdf`) or from an equal chain.

    Raises ConfigError if the chain is not of this arm, or has effects beyond these couplings,
    which a URDF cannot represent.
    """
    nominal = chain_from_urdf(text, base_link, tip_link, chain.convention)
    arm = replace(chain, base=nominal.base, tool=nominal.tool, frames=())
    _refuse_others(arm, nominal)
    robot = parse_urdf(text)
    path = robot.path(base_link, tip_link)
    poses = robot.poses(path[0].parent)
    tip = _ends(arm)[-1] @ arm.frame('tool').matrix
    shifts = dict(zip(arm.joint_names, _on_axes(arm) @ se3.invert(_on_axes(nominal)), strict=True))

    last, end = arm.joint_names[-1], path[-1].child
    corrected, origins = {path[0].parent: np.eye(4)}, {}
    for before, joint in zip([None, *path[:-1]], path, strict=True):
        parent, pose = corrected[joint.parent], poses[joint.child]
        if joint.moves:
            pose = shifts[joint.name] @ pose
        elif before is not None and before.name == last:
            pose = tip @ se3.invert(poses[end]) @ pose
        else:
            pose = parent @ joint.origin
        corrected[joint.child] = pose
        origins[joint.name] = se3.invert(parent) @ pose
    text = edited(text, origins, _multipliers(robot, path, nominal, arm))
    found = chain_from_urdf(text, base_link, tip_link, arm.convention)
    if any(abs(found.held[k] - value) > SAME for k, value in arm.held.items()):
        raise ConfigError(
            'a joint mimics one that has an offset itself, so the URDF cannot hold the fitted '
            'couplings: identify with --fixed "*.coupling_*"'
        )
    q = arm.random_joints(1000, np.random.default_rng(0))
    if np.abs(found.forward(q) - arm.forward(q)).max() > SAME:
        raise ConfigError(
            f'a, alpha or beta of joint "{last}" changed, and no fixed joint behind it can '
            'absorb that: let the tool frame be fitted instead, or add a fixed joint and a link'
        )
    return text


def _multipliers(
    robot: Description, path: Sequence[DescribedJoint], nominal: Chain, arm: Chain
) -> dict[str, float]:
    """Return the multipliers of joints whose fitted couplings are not nominal.

    A coupling to the leader is the product of the multipliers on the way to it.
    """
    known, values = dict(nominal.effects), dict(arm.effects)
    couplings = {joint.name: _coupling(joint) for joint in path if joint.follows}
    changes = {name: values.get(each, 0.0) / known[each] for name, each in couplings.items()}
    found = {}
    for joint in robot.joints:
        if joint.follows and changes.get(joint.name, 1.0) != 1.0:
            master, multiplier, _ = joint.follows
            found[joint.name] = multiplier * changes[joint.name] / changes.get(master, 1.0)
    return found


def _refuse_others(arm: Chain, nominal: Chain) -> None:
    refuse_other_joints('the chain', arm, 'the URDF, between these links,', nominal)
    known = dict(nominal.effects)
    if effects := [name for name, value in arm.effects if value and name not in known]:
        raise ConfigError(
            f'a URDF cannot represent the effects {", ".join(effects)}, and the chain is not '
            'accurate without them: identify with the model "geometric"'
        )
    q = nominal.random_joints(50, np.random.default_rng(0))
    found, expected = arm.forward(q), nominal.forward(q)
    shift = np.linalg.norm(found[:, :3, 3] - expected[:, :3, 3], axis=1).mean()
    turns = found[:, :3, :3] @ np.swapaxes(expected[:, :3, :3], 1, 2)
    turn = np.linalg.norm(se3.log_rotation(turns), axis=1).mean()
    if max(shift, turn) > MOST_APART:
        raise ConfigError(
            f'the chain is not the arm of this URDF between these links: the poses differ by '
            f'{shift:.3g} m and {turn:.3g} rad on average; identify again with the URDF as chain'
        )


def _coupling(joint: DescribedJoint) -> str:
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


def with_common_normals(chain: Chain) -> Chain:
    """Return the same arm without b, and beta only between axes closer than PARALLEL_TOLERANCE."""
    rows = list(chain.joints)
    for i in range(len(rows) - 1):
        k = i if chain.convention == 'standard' else i + 1  # row of the bend
        bend = rows[k]
        row = replace(rows[i], a=bend.a, alpha=bend.alpha, beta=bend.beta, b=bend.b)
        close = row.tilt < np.sin(PARALLEL_TOLERANCE)
        if not row.b and (close or not row.beta):
            continue
        end = _ends(Chain('row', 'standard', (row,)))[0]
        plain = _row_to_axis(row, np.eye(4), end[:3, 2], end[:3, 3], common_normal=not close)
        rest = se3.invert(_ends(Chain('row', 'standard', (plain,)))[0]) @ end
        rows[i] = replace(rows[i], theta=plain.theta, d=plain.d)
        rows[k] = replace(rows[k], a=plain.a, alpha=plain.alpha, beta=plain.beta, b=0.0)
        turn = float(np.arctan2(rest[1, 0], rest[0, 0]))
        later = rows[i + 1]
        rows[i + 1] = replace(later, theta=later.theta + turn, d=later.d + float(rest[2, 3]))
    return replace(chain, joints=tuple(rows), parallel=None)


def _row_to_axis(
    row: Joint, frame: FloatArray, axis: FloatArray, point: FloatArray, common_normal: bool = False
) -> Joint:
    """Return a standard row that leads from a frame on its axis to the next axis.

    Of the two directions of its x the one within 90 degrees of the frame's is chosen.
    """
    z = frame[:3, :3].T @ axis
    p = frame[:3, :3].T @ (point - frame[:3, 3])
    tilt = float(np.hypot(z[0], z[1]))
    x, y = p[:2] - p[2] / (z[2] or 1.0) * z[:2]
    parallel = not common_normal and nearly_parallel(tilt, float(np.hypot(x, y)))
    if parallel:
        d, a = 0.0, float(np.hypot(x, y))
        theta = float(np.arctan2(y, x)) if _clean(a) else 0.0
    else:
        normal = np.array([-z[1], z[0]]) / tilt
        d, a = float(p[2] - z[2] * (p[:2] @ z[:2]) / tilt**2), float(normal @ p[:2])
        theta = float(np.arctan2(normal[1], normal[0]))
    if _clean(np.cos(theta)) < 0.0:
        theta, a = theta - np.copysign(np.pi, theta), -a
    theta = _clean_angle(theta)
    across = np.cos(theta) * z[1] - np.sin(theta) * z[0]
    along = np.cos(theta) * z[0] + np.sin(theta) * z[1]
    return replace(
        row,
        theta=theta,
        d=_clean(d),
        a=_clean(a),
        alpha=_clean_angle(float(np.arctan2(-across, z[2]))),
        beta=_clean_angle(float(np.arcsin(along))) if parallel else 0.0,
        b=0.0,
    )


def _clean(length: float) -> float:
    """Return a length [m] without the rounding of sums in its last digit."""
    return round(length, np.finfo(float).precision - 1) + 0.0


def _clean_angle(angle: float) -> float:
    """Return an angle [rad] without rounding; a right angle if that close."""
    right = round(angle / (np.pi / 2)) * (np.pi / 2)
    return _clean(angle) if _clean(angle - right) else right


def _ends(chain: Chain) -> FloatArray:
    """Return the frames (n, 4, 4) at the ends of the links at zero."""
    ends = chain.walk.along(np.zeros((len(chain.joints), 1)), chain.frame('base').matrix)[1]
    found = ends[..., 0]
    return se3.transform(np.swapaxes(found[:, :3], 1, 2), found[:, 3])


def _on_axes(chain: Chain) -> FloatArray:
    """Return the frames (n, 4, 4) at zero after theta and d of each row, z along the motion."""
    frames = _ends(chain)
    if chain.convention == 'standard':
        for i, row in enumerate(chain.joints):
            bend = replace(row, theta=0.0, d=0.0)
            frames[i] = frames[i] @ se3.invert(_ends(Chain('bend', 'standard', (bend,)))[0])
    signs = np.array([[1.0, row.sign, row.sign, 1.0] for row in chain.joints])
    return np.asarray(frames * signs[:, np.newaxis, :])


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
