# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""URDFs of known robots, and where another library says they are."""

import xml.etree.ElementTree as ET
from itertools import pairwise

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

PI, HALF = np.pi, np.pi / 2
CONVENTIONS = ('standard', 'modified')
SEEDS = st.integers(0, 2**32 - 1)
EXACT = 1e-12
"""Largest difference of poses [m or 1]; found in 600 random arms: 1e-13."""


def numbers(values):
    return ' '.join(repr(float(value)) for value in values)


def written(name, *joints):
    """Return the text of a URDF: joints are (name, type, parent, child, xyz, rpy, axis, rest)."""
    links = dict.fromkeys(link for joint in joints for link in joint[2:4])
    lines = [f'<robot name="{name}">', *(f'  <link name="{link}"/>' for link in links)]
    for joint, kind, parent, child, xyz, rpy, axis, *rest in joints:
        lines += [
            f'  <joint name="{joint}" type="{kind}">',
            f'    <parent link="{parent}"/>',
            f'    <child link="{child}"/>',
            f'    <origin xyz="{numbers(xyz)}" rpy="{numbers(rpy)}"/>',
            f'    <axis xyz="{numbers(axis)}"/>',
            *(f'    {line}' for line in rest),
            '  </joint>',
        ]
    return '\n'.join([*lines, '</robot>', ''])


def limits(lower, upper):
    return f'<limit lower="{float(lower)!r}" upper="{float(upper)!r}" effort="1" velocity="1"/>'


def arm(name, links, axes, origins, joints, ends, *tail):
    """Return the URDF of a serial arm of revolute joints."""
    rows = zip(joints, pairwise(links), origins, axes, ends, strict=True)
    moving = [
        (joint, 'revolute', *between, xyz, rpy, axis, limits(*end))
        for joint, between, (xyz, rpy), axis, end in rows
    ]
    return written(name, *moving, *tail)


ZERO, Z = (0, 0, 0), (0, 0, 1)
# ur_description: config/ur10e/default_kinematics.yaml, joint_limits.yaml, ur_macro.xacro
UR10E_ORIGINS = (
    ((0, 0, 0.1807), ZERO),
    (ZERO, (1.570796327, 0, 0)),
    ((-0.6127, 0, 0), ZERO),
    ((-0.57155, 0, 0.17415), ZERO),
    ((0, -0.11985, -2.458164590756244e-11), (1.570796327, 0, 0)),
    ((0, 0.11655, -2.390480459346185e-11), (1.570796326589793, PI, PI)),
)
UR_LINKS = ('base_link_inertia', 'shoulder_link', 'upper_arm_link', 'forearm_link')
UR_LINKS += ('wrist_1_link', 'wrist_2_link', 'wrist_3_link')
UR_JOINTS = ('shoulder_pan_joint', 'shoulder_lift_joint', 'elbow_joint')
UR_JOINTS += ('wrist_1_joint', 'wrist_2_joint', 'wrist_3_joint')
UR_LIMITS = [(-2 * PI, 2 * PI)] * 2 + [(-PI, PI)] + [(-2 * PI, 2 * PI)] * 3
UR_FIXED = (
    ('base_joint', 'fixed', 'base_link', 'base_link_inertia', ZERO, (0, 0, PI), ZERO),
    ('wrist_3-flange', 'fixed', 'wrist_3_link', 'flange', ZERO, (0, -HALF, -HALF), ZERO),
    ('flange-tool0', 'fixed', 'flange', 'tool0', ZERO, (HALF, 0, HALF), ZERO),
    ('base_link-base', 'fixed', 'base_link', 'base', ZERO, (0, 0, PI), ZERO),
)


def ur10e(origins=UR10E_ORIGINS):
    return arm('ur10e', UR_LINKS, [Z] * 6, origins, UR_JOINTS, UR_LIMITS, *UR_FIXED)


UR10E = ur10e()
MIMIC = '<mimic joint="panda_finger_joint1"/>'
# franka_ros: franka_description/robots/panda_arm.xacro, hand.xacro
PANDA = arm(
    'panda',
    [f'panda_link{k}' for k in range(8)],
    [Z] * 7,
    [
        ((0, 0, 0.333), ZERO),
        (ZERO, (-HALF, 0, 0)),
        ((0, -0.316, 0), (HALF, 0, 0)),
        ((0.0825, 0, 0), (HALF, 0, 0)),
        ((-0.0825, 0.384, 0), (-HALF, 0, 0)),
        (ZERO, (HALF, 0, 0)),
        ((0.088, 0, 0), (HALF, 0, 0)),
    ],
    [f'panda_joint{k}' for k in range(1, 8)],
    [
        *((-2.8973, 2.8973), (-1.7628, 1.7628), (-2.8973, 2.8973), (-3.0718, -0.0698)),
        *((-2.8973, 2.8973), (-0.0175, 3.7525), (-2.8973, 2.8973)),
    ],
    ('panda_joint8', 'fixed', 'panda_link7', 'panda_link8', (0, 0, 0.107), ZERO, ZERO),
    ('panda_hand_joint', 'fixed', 'panda_link8', 'panda_hand', ZERO, (0, 0, -PI / 4), ZERO),
    *(
        (f'panda_finger_joint{k}', 'prismatic', 'panda_hand', finger, (0, 0, 0.0584), ZERO, *rest)
        for k, finger, *rest in (
            (1, 'panda_leftfinger', (0, 1, 0), limits(0.0, 0.04)),
            (2, 'panda_rightfinger', (0, -1, 0), limits(0.0, 0.04), MIMIC),
        )
    ),
)
# kuka_lbr_iiwa_support: lbr_iiwa_14_r820_macro.xacro
IIWA = arm(
    'lbr_iiwa_14_r820',
    ['base_link', *(f'link_{k}' for k in range(1, 8))],
    [Z, (0, 1, 0), Z, (0, -1, 0), Z, (0, 1, 0), Z],
    [
        (xyz, ZERO)
        for xyz in (
            *(ZERO, (-0.00043624, 0, 0.36), ZERO, (0.00043624, 0, 0.42), ZERO, (0, 0, 0.4)),
            ZERO,
        )
    ],
    [f'joint_a{k}' for k in range(1, 8)],
    [(-np.radians(limit), np.radians(limit)) for limit in (170, 120, 170, 120, 170, 120, 175)],
    ('joint_a7-tool0', 'fixed', 'link_7', 'tool0', (0, 0, 0.126), ZERO, ZERO),
)
SCARA = written(
    'scara',
    ('lift', 'prismatic', 'base', 'column', (0, 0, 0.2), ZERO, Z, limits(0.0, 0.4)),
    ('shoulder', 'continuous', 'column', 'upper', (0.1, 0, 0), ZERO, Z),
    ('elbow', 'continuous', 'upper', 'lower', (0.4, 0, 0.05), ZERO, (0, 0, -1)),
    ('wrist', 'revolute', 'lower', 'hand', (0.3, 0, -0.1), (PI, 0, 0), Z, limits(-3.0, 3.0)),
)


def place(xyz, rotation):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), xyz
    return matrix


def reference_forward(text, values, base, tip):
    """Walk from a tip back to a base along the elements of a URDF; values by joint name."""
    leading = {j.find('child').get('link'): j for j in ET.fromstring(text).findall('joint')}
    pose = np.eye(4)
    while tip != base:
        joint = leading[tip]
        origin, axis = joint.find('origin'), joint.find('axis')
        xyz, rpy = (
            np.array((('' if origin is None else origin.get(key, '')) or '0 0 0').split(), float)
            for key in ('xyz', 'rpy')
        )
        turn = Rotation.from_rotvec([0, 0, rpy[2]]) * Rotation.from_rotvec([0, rpy[1], 0])
        step = place(xyz, turn * Rotation.from_rotvec([rpy[0], 0, 0]))
        if joint.get('type') not in ('fixed', 'floating'):
            way = np.array(('1 0 0' if axis is None else axis.get('xyz')).split(), float)
            way *= values[joint.get('name')] / np.linalg.norm(way)
            if joint.get('type') == 'prismatic':
                step = step @ place(way, Rotation.identity())
            else:
                step = step @ place(np.zeros(3), Rotation.from_rotvec(way))
        pose = step @ pose
        tip = joint.find('parent').get('link')
    return pose


def ends(text):
    joints = [joint for joint in ET.fromstring(text) if joint.tag == 'joint']
    children = {joint.find('child').get('link') for joint in joints}
    parents = {joint.find('parent').get('link') for joint in joints}
    (root,) = parents - children
    return root, 'tool0' if 'tool0' in children else sorted(children - parents)[0]


def poses_of(text, chain, q, base=None, tip=None):
    root, end = ends(text)
    return np.array(
        [
            reference_forward(
                text, dict(zip(chain.joint_names, row, strict=True)), base or root, tip or end
            )
            for row in q
        ]
    )


def some_joints(chain, rng, count=4):
    return rng.uniform(-PI, PI, (count, len(chain.joints)))


def random_arm(rng):
    """Return the URDF of an arm whose axes may be parallel, nearly so, intersect or coincide."""
    joints = []
    for _ in range(rng.integers(1, 9)):
        for k in range(rng.integers(1, 4)):
            kind = 'fixed'
            if k == 0:
                kind = rng.choice(['revolute', 'continuous', 'prismatic'], p=[0.4, 0.3, 0.3])
            rpy = (
                ZERO,
                rng.uniform(-PI, PI, 3),
                rng.choice([0.0, HALF, -HALF, PI], 3),
                rng.normal(size=3) * 10.0 ** rng.uniform(-12, -1),
                rng.choice([0.0, 1.57, 1.5708, -1.570796327, 3.14159], 3),
                (0.0, HALF, 0.0),
            )[rng.integers(6)]
            xyz = rng.uniform(-1, 1, 3) * rng.choice([0.0, 1e-6, 1.0], 3, p=[0.5, 0.1, 0.4])
            axis = (rng.normal(size=3), *np.eye(3), *-np.eye(3))[rng.integers(7)]
            n = len(joints)
            limit = (limits(-3.0, 2.5),) if kind in ('revolute', 'prismatic') else ()
            joints.append((f'j{n}', kind, f'l{n}', f'l{n + 1}', xyz, rpy, axis, *limit))
    return written('random', *joints)


def random_offsets(chain, rng, size=1e-3):
    """Return offsets of all parameters but those that only a fixed joint at the end can take."""
    kinds = ['a', 'alpha', 'beta', 'b', 'd', 'theta']
    names = [f'{name}.{kind}' for name in chain.joint_names for kind in kinds]
    if chain.convention == 'standard':
        names = [n for n in names if n not in [f'{chain.joint_names[-1]}.{k}' for k in kinds[:4]]]
    return dict(zip(names, rng.normal(scale=size, size=len(names)), strict=True))


# ---- forward kinematics


def by_kinpy(text, names, q, base, tip):
    import kinpy

    serial = kinpy.build_serial_chain_from_urdf(text, tip, base)
    assert tuple(serial.get_joint_parameter_names()) == names
    return np.array([serial.forward_kinematics(row).matrix() for row in q])
