# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Non-geometric errors of joints (Vacarescu et al., section 1): what a joint value hides.

Each effect adds `value * phi(q)` to the value of one joint, so its column of the error model is
that of the joint's motion times phi. An effect is a parameter named after its joint:

    joint_2.ratio               phi = q_2                                          [1]
    joint_6.coupling_joint_5    phi = q_5                                          [1]
    joint_2.sin_1, .cos_1       phi = sin(1 q_2), cos(1 q_2)                       [rad or m]
    joint_2.gravity_joint_4     phi = torque on joint 2 of unit weight at joint 4's end  [rad/m]
    joint_2.compliance          phi = torque on joint 2 of the masses given [N m]  [rad/(N m)]
    joint_2.backlash            phi = sign of the approach: -1, 0 or 1             [rad or m]

Eccentricities of gears and encoders are harmonics 1 and 2; a harmonic drive shows harmonics near
its ratio and twice that. Unknown masses: torques by weights at the joints' ends span the torques
of any masses that lie along the arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calib_ros.errors import UnknownNameError
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from calib_ros.kinematics.chain import Chain


@dataclass(frozen=True)
class Verdict:
    """What a group of effects, or a harmonic of a joint, would bring: RMS on poses left out."""

    what: str
    rms_mm_before: float
    rms_mm_after: float
    pays: bool


GROUPS = ('ratio', 'coupling', 'eccentricity', 'gear', 'gravity', 'compliance', 'backlash')
"""Groups of effects that can be switched on together. `gear` has the harmonics at the gear ratio
and twice that of joints that give one; others are found from data (`selection.py`)."""
WRIST = 3
"""Couplings are looked for among so many last joints."""


def group_of(name: str) -> str:
    """Return the group that an effect belongs to."""
    first, rest = Parameter(name).effect
    if first in ('sin', 'cos'):
        return 'eccentricity' if rest in ('1', '2') else 'gear'
    return first


def members(chain: Chain, group: str) -> tuple[Parameter, ...]:
    """Return the names of all effects of a group for a chain."""
    joints = chain.joints
    names = chain.joint_names
    revolute = [joint.name for joint in joints if joint.type == 'revolute']
    if group == 'ratio':
        return tuple(Parameter(name, group) for name in names)
    if group == 'coupling':
        wrist = names[-WRIST:]
        return tuple(
            Parameter(wrist[i], f'coupling_{wrist[j]}')
            for i in range(len(wrist))
            for j in range(i)
        )
    if group == 'eccentricity':
        return tuple(name for joint in revolute for k in (1, 2) for name in waves(joint, k))
    if group == 'gear':
        return tuple(
            name
            for joint in joints
            if joint.gear_ratio
            for k in (1, 2)
            for name in waves(joint.name, k * joint.gear_ratio)
        )
    if group == 'gravity':
        return tuple(
            Parameter(joint.name, f'gravity_{other}')
            for i, joint in enumerate(joints)
            if joint.type == 'revolute'
            for other in names[i:]
        )
    if group in ('compliance', 'backlash'):
        return tuple(Parameter(name, group) for name in revolute)
    raise UnknownNameError('group of effects', group, GROUPS)


WAVES = ('sin', 'cos')


def waves(joint: str, harmonic: float) -> tuple[Parameter, ...]:
    """Return sine and cosine of a harmonic of a joint."""
    return tuple(Parameter(joint, f'{wave}_{harmonic:g}') for wave in WAVES)


def resolve(chain: Chain, name: str) -> tuple[str, ...]:
    """Return the effects that a group or a single name stands for."""
    if name in GROUPS:
        return members(chain, name)
    joint = Parameter(name).owner
    if joint not in chain.joint_names:
        known = name if '.' not in name else joint
        raise UnknownNameError('effect or joint', known, (*GROUPS, *chain.joint_names))
    check(name, chain.joint_names)
    return (name,)


def check(name: str, joints: Sequence[str]) -> None:
    """Refuse the name of an effect that does not exist."""
    first, rest = Parameter(name).effect
    if first in ('coupling', 'gravity'):
        if rest not in joints:
            raise UnknownNameError(f'joint in effect {name}', rest, joints)
    elif first in WAVES:
        try:
            known = np.isfinite(float(rest))
        except ValueError:
            known = False
        if not known:
            raise UnknownNameError(f'harmonic in effect {name}', rest, ('1', '2', '...'))
    elif first not in ('ratio', 'compliance', 'backlash') or rest:
        raise UnknownNameError('effect', name, GROUPS)


def expected(name: str) -> float:
    """Return the size that an effect may have: the standard deviation of its prior.

    A third of an arc minute of a drive's own errors, an arc minute of what bends (for a torque arm
    of a metre) or has play. Without it a harmonic that is sampled over part of a turn trades
    against constants without bound, and misleads wherever else the arm goes.
    """
    return 3e-4 if group_of(name) in ('gravity', 'compliance', 'backlash') else 1e-4


def basis(
    chain: Chain, names: Sequence[str], q: FloatArray, approach: FloatArray | None
) -> FloatArray:
    """Return phi (E, B) of the named effects at joint values (n, B).

    `approach` (n, B) holds the signs of the velocity with which each joint came to its value;
    without it no backlash shows.
    """
    phi = np.empty((len(names), q.shape[1]))
    number = {name: i for i, name in enumerate(chain.joint_names)}
    torques: Torques | None = None
    for row, name in enumerate(names):
        first, rest = Parameter(name).effect
        i = number[Parameter(name).owner]
        if first == 'ratio':
            phi[row] = q[i]
        elif first == 'coupling':
            phi[row] = q[number[rest]]
        elif first == 'sin':
            phi[row] = np.sin(float(rest) * q[i])
        elif first == 'cos':
            phi[row] = np.cos(float(rest) * q[i])
        elif first == 'backlash':
            phi[row] = 0.0 if approach is None else approach[i]
        else:
            torques = torques or Torques(chain, q)
            phi[row] = (
                torques.of_weight(i, number[rest]) if first == 'gravity' else torques.of_masses(i)
            )
    return phi


class Torques:
    """Torques of gravity on the joints of a chain at joint values (n, B)."""

    def __init__(self, chain: Chain, q: FloatArray) -> None:
        self._chain = chain
        self._axes: dict[str, FloatArray] = {}
        self._points: dict[str, FloatArray] = {}
        self._links: list[tuple[list[FloatArray], FloatArray]] = []

        def record(name: Parameter, rotates: bool, axis: FloatArray, point: FloatArray) -> None:
            if name.kind == 'theta':
                self._axes[name.owner], self._points[name.owner] = axis, point

        chain.trace(q, record, links=self._links)
        direction = np.asarray(chain.gravity) / np.linalg.norm(chain.gravity)
        self._down = chain.frame('base').matrix[:3, :3] @ direction

    def of_weight(self, joint: int, end: int) -> FloatArray:
        """Return the torque (B,) [m] on a joint of a unit weight at the end of another's link."""
        return self._about(joint, self._links[end][1])

    def of_masses(self, joint: int) -> FloatArray:
        """Return the torque (B,) [N m] on a joint of all masses that it carries."""
        weight = float(np.linalg.norm(self._chain.gravity))
        total = np.zeros(1)
        for (axes, end), link in list(zip(self._links, self._chain.joints, strict=True))[joint:]:
            if link.mass:
                point = end + sum(link.com[i] * axes[i] for i in range(3))
                total = total + link.mass * weight * self._about(joint, point)
        return total

    def _about(self, joint: int, point: FloatArray) -> FloatArray:
        name = self._chain.joints[joint].name
        arm = point - self._points[name]
        x, y, z = self._down
        moment = (arm[1] * z - arm[2] * y, arm[2] * x - arm[0] * z, arm[0] * y - arm[1] * x)
        axis = self._axes[name]
        sign = self._chain.joints[joint].sign  # the work is done along the reported value
        return np.asarray(sign * (axis[0] * moment[0] + axis[1] * moment[1] + axis[2] * moment[2]))
