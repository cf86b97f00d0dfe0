# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Non-geometric errors of joints (Vacarescu et al., section 1).

Each effect adds `value * phi(q)` to the value of one joint, so its column of the error model is
that of the joint's motion times phi. An effect is a parameter named after its joint:

    joint_2.ratio               phi = q_2                                          [1]
    joint_6.coupling_joint_5    phi = q_5                                          [1, in SI]
    joint_2.sin_1, .cos_1       phi = sin(1 q_2), cos(1 q_2)                       [rad or m]
    joint_2.gravity_joint_4     phi = torque on joint 2 of unit weight at joint 4's end  [rad/m]
    joint_2.compliance          phi = torque on joint 2 of the given masses [N m]  [rad/(N m)]
    joint_2.backlash            phi = sign of the approach: -1, 0 or 1             [rad]
    rail.play                   the same of a linear joint                         [m]

Eccentricities of gears and encoders are harmonics 1 and 2; a harmonic drive has harmonics near its
ratio and twice that. With unknown masses, torques of weights at the joints' ends span the torques
of any masses along the arm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Protocol

import numpy as np

from calib_ros.errors import ConfigError, UnknownNameError
from calib_ros.kinematics.joint import Frame, Joint
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import ROUNDING, FloatArray, Index, cos_sin, cross
from calib_ros.kinematics.walk import Walk


class _Arm(Protocol):
    """Interface of a chain for effects."""

    @property
    def joints(self) -> tuple[Joint, ...]: ...
    @property
    def joint_names(self) -> tuple[str, ...]: ...
    @property
    def effects(self) -> tuple[tuple[str, float], ...]: ...
    @property
    def held(self) -> Mapping[int, float]: ...
    @property
    def gravity(self) -> tuple[float, float, float]: ...
    @property
    def walk(self) -> Walk: ...
    def frame(self, name: str) -> Frame: ...


GROUPS = ('ratio', 'coupling', 'eccentricity', 'gear', 'gravity', 'compliance', 'backlash')
"""Groups of effects that can be fitted together. `gear` has the harmonics at the gear ratio and
twice that; others are found from data (`identify_model`). `coupling` is that of the wrist, the
last three joints, and of a SCARA's quill."""
EXPECTED = dict.fromkeys(GROUPS, 1e-4) | dict.fromkeys(('gravity', 'compliance', 'backlash'), 3e-4)
"""Typical size [rad or m] of an effect by group: a third of an arc minute for drives, an arc
minute for bending (at a torque arm of a metre) and play; 0.3 mm for that of linear joints."""


@lru_cache(maxsize=1024)
def group_of(name: str) -> str:
    """Return the group of an effect."""
    first, rest = Parameter(name).effect
    if first in ('sin', 'cos'):
        return 'eccentricity' if rest in ('1', '2') else 'gear'
    return 'backlash' if first == 'play' else first


def members(chain: _Arm, group: str) -> tuple[Parameter, ...]:
    """Return the names of all effects of a group for a chain."""
    joints = ((each.name, each.type == 'revolute', each.gear_ratio) for each in chain.joints)
    return _members(tuple(joints), group)


@lru_cache(maxsize=256)
def _members(joints: tuple[tuple[str, bool, float], ...], group: str) -> tuple[Parameter, ...]:
    names, revolute = [name for name, *_ in joints], [name for name, turns, _ in joints if turns]
    geared = [(name, gear) for name, _, gear in joints if gear]
    links = [(name, end) for k, name in enumerate(names) for end in names[k:] if name in revolute]
    found: dict[str, list[Parameter]] = {
        'ratio': [Parameter(name, group) for name in names],
        'coupling': couplings(names[-3:]) + _ball_screws(joints),
        'eccentricity': [wave for name in revolute for k in (1, 2) for wave in waves(name, k)],
        'gear': [wave for name, gear in geared for k in (1, 2) for wave in waves(name, k * gear)],
        'gravity': [Parameter(name, f'gravity_{end}') for name, end in links],
        'compliance': [Parameter(name, group) for name in revolute],
        'backlash': [
            Parameter(name, 'backlash' if turns else 'play') for name, turns, _ in joints
        ],
    }
    return tuple(found[group])


def couplings(joints: Sequence[str]) -> list[Parameter]:
    """Return the names of the couplings of joints with those before them."""
    return [Parameter(name, f'coupling_{o}') for i, name in enumerate(joints) for o in joints[:i]]


def _ball_screws(joints: Sequence[tuple[str, bool, float]]) -> list[Parameter]:
    """Return the couplings of a linear joint with the turning one after it: a SCARA's quill."""
    pairs = pairwise(joints[-3:])
    return [
        Parameter(z, f'coupling_{o}') for (z, turns, _), (o, after, _) in pairs if after > turns
    ]


def coupled(chain: _Arm) -> frozenset[int]:
    """Return the numbers of the held joints that couplings move."""
    led = {name.partition('.coupling_')[0] for name, _ in chain.effects if '.coupling_' in name}
    return frozenset(k for k in chain.held if chain.joint_names[k] in led)


WAVES = ('sin', 'cos')
PLAY = ('backlash', 'play')  # of a revolute and of a linear joint


def waves(joint: str, harmonic: float) -> tuple[Parameter, ...]:
    """Return sine and cosine of a harmonic of a joint."""
    return tuple(Parameter(joint, f'{wave}_{harmonic:g}') for wave in WAVES)


def resolve(chain: _Arm, name: str) -> tuple[str, ...]:
    """Return the effects of a group or a single name."""
    if name in GROUPS:
        return members(chain, name)
    joint, _, kind = name.partition('.')
    if joint not in chain.joint_names:
        if name in (alone := ('geometric', 'auto')):
            raise ConfigError(f'model {name} stands alone: no effects can be joined to it')
        if '.' not in name:
            raise UnknownNameError('model', name, (*alone, *GROUPS))
        raise UnknownNameError(f'effect {name}: joint', joint, chain.joint_names)
    check_effect(name, chain.joint_names)
    if kind in PLAY and name not in (known := members(chain, 'backlash')):
        raise UnknownNameError('effect', name, known)
    return (name,)


@lru_cache(maxsize=1024)
def check_effect(name: str, joints: tuple[str, ...]) -> None:
    """Refuse an unknown effect."""
    first, rest = Parameter(name).effect
    if first in ('coupling', 'gravity'):
        if rest not in joints:
            raise UnknownNameError(f'effect {name}: joint', rest, joints)
    elif first in WAVES:
        try:
            known = np.isfinite(float(rest))
        except ValueError:
            known = False
        if not known:
            raise UnknownNameError(f'effect {name}: harmonic', rest, ('1', '2', '...'))
    elif first not in ('ratio', 'compliance', *PLAY) or rest:
        raise UnknownNameError('effect', name, GROUPS)


def expected(name: str) -> float:
    """Return the typical size of an effect: the standard deviation of its prior.

    Without a prior, a harmonic sampled over part of a turn trades off against constants without
    bound, and is wrong elsewhere.
    """
    return EXPECTED[group_of(name)]


def basis(
    chain: _Arm, names: Sequence[str], q: FloatArray, approach: FloatArray | None
) -> FloatArray:
    """Return phi (E, B) of the named effects at joint values (n, B).

    `approach` (n, B) holds the signs of the preceding velocities; without it there is no backlash.
    """
    phi = np.zeros((len(names), q.shape[1]))
    q, turned = couple_held(chain, q), dict[bytes, tuple[FloatArray, ...]]()
    for kind, (rows, joints, others) in _by_kind(tuple(names), chain.joint_names).items():
        if kind == 'ratio':
            phi[rows] = q[joints]
        elif kind == 'coupling':
            phi[rows] = q[others.astype(int)]
        elif kind in WAVES:
            angles = joints.tobytes() + others.tobytes()  # the same of both, as a rule
            if angles not in turned:
                turned[angles] = cos_sin(others[:, np.newaxis] * q[joints])
            phi[rows] = turned[angles][kind == 'sin']
        elif kind in PLAY and approach is not None:
            phi[rows] = approach[joints]
        elif kind in ('gravity', 'compliance'):
            phi[rows] = _torques(chain, q, joints, others if kind == 'gravity' else None)
    return phi


def couple_held(
    chain: _Arm, values: FloatArray, couplings: bool = True, rates: bool = False
) -> FloatArray:
    """Return joint values (n, B), or their `rates`, held joints where their couplings lead them.

    Whatever is reported of these; without `couplings` at their limit.
    """
    if not chain.held:
        return values
    values, number = values.copy(), {name: k for k, name in enumerate(chain.joint_names)}
    for k, end in chain.held.items():
        values[k] = 0.0 if rates else end
    if not couplings:
        return values
    still = values
    for _ in chain.held:  # one may lead another
        leaders, values = values, still.copy()
        for name, value in chain.effects:
            joint, _, leader = name.partition('.coupling_')
            if leader and number[joint] in chain.held:
                values[number[joint]] += value * leaders[number[leader]]
    return values


def moved_joints(chain: _Arm, names: Sequence[str], phi: FloatArray, q: FloatArray) -> FloatArray:
    """Return joint values (n, B) plus effects with phi (E, B); of held joints their limit."""
    q = couple_held(chain, q, couplings=False)
    if not names:
        return q
    known, shares = dict(chain.effects), np.zeros((len(q), len(names)))
    driven = _driven(tuple(names), chain.joint_names)
    shares[driven, np.arange(len(names))] = [known[name] for name in names]
    return np.asarray(q + shares @ phi)


@lru_cache(maxsize=256)
def _driven(names: tuple[str, ...], joint_names: tuple[str, ...]) -> Index:
    return np.array([joint_names.index(Parameter(name).owner) for name in names])


@lru_cache(maxsize=256)
def _by_kind(
    names: tuple[str, ...], joint_names: tuple[str, ...]
) -> dict[str, tuple[Index, Index, FloatArray]]:
    number = {name: i for i, name in enumerate(joint_names)}
    found: dict[str, list[tuple[int, int, float]]] = {}
    for row, name in enumerate(names):
        first, rest = Parameter(name).effect
        joint = Parameter(name).owner
        other = number[rest] if rest in number else float(rest or 0)
        found.setdefault(first, []).append((row, number[joint], other))
    return {
        kind: (np.array(rows), np.array(joints), np.array(others, dtype=float))
        for kind, (rows, joints, others) in (
            (kind, zip(*each, strict=True)) for kind, each in found.items()
        )
    }


def _torques(chain: _Arm, q: FloatArray, joints: Index, ends: FloatArray | None) -> FloatArray:
    """Return torques (E, B) of unit weights [m] at the `ends` (E,) of links, or of all masses."""
    start = chain.frame('base').matrix
    frames, places = chain.walk.along(q, start)
    down = start[:3, :3] @ np.asarray(chain.gravity)
    # a weight along g at r turns the axis u through c by u . ((r - c) x g) = (r - c) . (g x u)
    axes, points = frames[:-1, 2], frames[:-1, 3]
    turned = cross(down[:, np.newaxis], axes)
    turned[np.abs(turned) < ROUNDING * np.linalg.norm(down)] = 0.0  # of a vertical axis
    turned *= chain.walk.signs[..., np.newaxis]
    if ends is not None:
        torques = np.empty((len(joints), q.shape[1]))
        turned /= np.linalg.norm(down) or 1.0  # nothing bends without gravity
        for i, axis in enumerate(turned):
            own = np.flatnonzero(joints == i)
            arms = places[ends[own].astype(int), 3] - points[i]
            torques[own] = np.einsum('ecb,cb->eb', arms, axis)
        return torques
    masses = np.array([joint.mass for joint in chain.joints])
    centres = np.einsum('ik,ikcb->icb', [(*joint.com, 1.0) for joint in chain.joints], places)
    carried = np.arange(len(masses)) >= joints[:, np.newaxis]  # (E, n)
    moments = np.einsum('ei,i,icb->ecb', carried, masses, centres)
    moments -= (carried @ masses)[:, np.newaxis, np.newaxis] * points[joints]
    return np.asarray(np.einsum('ecb,ecb->eb', moments, turned[joints]))
