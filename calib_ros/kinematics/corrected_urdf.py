# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A corrected arm, written back into its URDF."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros.annotated import as_annotated
from calib_ros.errors import ConfigError
from calib_ros.kinematics import se3
from calib_ros.kinematics.axes import link_ends
from calib_ros.kinematics.chain import Chain, Frame, refuse_other_joints
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.kinematics.urdf import chain_from_urdf, coupling_of
from calib_ros.kinematics.urdf_editor import edited
from calib_ros.kinematics.urdf_reader import parse_urdf
from calib_ros.kinematics.urdf_tree import DescribedJoint, Description
from calib_ros.settings import Settings
from calib_ros.values import SAME

MOST_APART = 2.0 * Settings.largest_angle
"""Mean pose difference [m or rad] at which a chain is not the arm of a URDF."""


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
    refuse_other_joints('the chain', chain, 'the URDF, between these links,', nominal)
    arm = min(_in_frames_of(nominal, chain), key=lambda each: sum(_apart(each, nominal)))
    _refuse_others(arm, nominal)
    robot = parse_urdf(text)
    path = robot.path(base_link, tip_link)
    poses = robot.poses(path[0].parent)
    tip = link_ends(arm)[-1] @ arm.frame('tool').matrix
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
    couplings = {joint.name: coupling_of(joint) for joint in path if joint.follows}
    changes = {name: values.get(each, 0.0) / known[each] for name, each in couplings.items()}
    found = {}
    for joint in robot.joints:
        if joint.follows and changes.get(joint.name, 1.0) != 1.0:
            master, multiplier, _ = joint.follows
            found[joint.name] = multiplier * changes[joint.name] / changes.get(master, 1.0)
    return found


def _in_frames_of(nominal: Chain, chain: Chain) -> Iterator[Chain]:
    """Yield an arm with base and tool of a nominal one by first and last frames as tables may be.

    There z is against the axis of a joint of sign -1, and x in any of four directions.
    """
    turns = Rotation.from_rotvec([[0.0, 0.0, k * np.pi / 2.0] for k in range(4)]).as_matrix()
    ways = [turns * [1.0, joint.sign, joint.sign] for joint in (chain.joints[0], chain.joints[-1])]
    for first, last in product(*(se3.transform(each, np.zeros((4, 3))) for each in ways)):
        base = nominal.frame('base').matrix @ first
        tool = se3.invert(last) @ nominal.frame('tool').matrix
        yield replace(chain, base=Frame(base), tool=Frame(tool), frames=())


def _refuse_others(arm: Chain, nominal: Chain) -> None:
    known = dict(nominal.effects)
    if effects := [name for name, value in arm.effects if value and name not in known]:
        raise ConfigError(
            f'a URDF cannot represent the effects {", ".join(effects)}, and the chain is not '
            'accurate without them: identify with the model "geometric"'
        )
    shift, turn = _apart(arm, nominal)
    if max(shift, turn) > MOST_APART:
        raise ConfigError(
            f'the chain is not the arm of this URDF between these links: the poses differ by '
            f'{shift:.3g} m and {turn:.3g} rad on average; identify again with the URDF as chain'
        )


def _apart(arm: Chain, nominal: Chain) -> tuple[float, float]:
    """Return the mean distance [m] and angle [rad] between the poses of two arms."""
    q = nominal.random_joints(50, np.random.default_rng(0))
    found, expected = arm.forward(q), nominal.forward(q)
    shift = np.linalg.norm(found[:, :3, 3] - expected[:, :3, 3], axis=1).mean()
    turns = found[:, :3, :3] @ np.swapaxes(expected[:, :3, :3], 1, 2)
    turn = np.linalg.norm(se3.log_rotation(turns), axis=1).mean()
    return float(shift), float(turn)


def _on_axes(chain: Chain) -> FloatArray:
    """Return the frames (n, 4, 4) at zero after theta and d of each row, z along the motion."""
    frames = link_ends(chain)
    if chain.convention == 'standard':
        for i, row in enumerate(chain.joints):
            bend = replace(row, theta=0.0, d=0.0)
            frames[i] = frames[i] @ se3.invert(link_ends(Chain('bend', 'standard', (bend,)))[0])
    signs = np.array([[1.0, row.sign, row.sign, 1.0] for row in chain.joints])
    return np.asarray(frames * signs[:, np.newaxis, :])
