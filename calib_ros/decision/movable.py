# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What may move beside an arm, or with it: frames, zeros of joints and distances, the load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calib_ros.decision.moved import ZERO
from calib_ros.estimation.problem import Problem
from calib_ros.kinematics.parameter import Parameter, parameters_of


@dataclass(frozen=True, eq=False)
class Moving:
    """Columns switched on together: frames of some sets, zeros of joints, or the load.

    `owners` are the frames or joints by name. A frame among them may be `held`: then from the
    first pose on.
    """

    owners: tuple[str, ...]
    kind: str
    names: tuple[str, ...]
    sets: tuple[int, ...]
    held: bool = False


def of_the_arm(problem: Problem) -> list[Moving]:
    """Return the load, with the torque of a weight at the last joint, and the zeros of all."""
    joints, everywhere = problem.chain.joints, tuple(range(len(problem.sets)))
    last = joints[-1].name
    load = tuple(Parameter(j.name, f'gravity_{last}') for j in joints if j.type == 'revolute')
    zeros = tuple(joint.driven for joint in joints)
    loads = [Moving(('the load',), 'load', load, everywhere)] if load else []
    return [*loads, Moving(('all joints',), 'joints', zeros, everywhere)]


def groups_of(problem: Problem) -> list[Moving]:
    """Return what may move: frames, zeros of joints, then of distances, one and all together."""
    found = []
    for kind in ('base', 'tool'):
        for frame in dict.fromkeys(getattr(each, kind) for each in problem.sets):
            sets = [k for k, each in enumerate(problem.sets) if getattr(each, kind) == frame]
            seen = problem.sets[sets[0]]
            socket = kind == 'base' and (seen.socket or seen.seen)  # the ball turns in it
            names = parameters_of(frame)[: 3 if socket else 6]
            held = problem.model.frame(frame).fixed
            found.append(Moving((frame,), kind, names, tuple(sets), held))
        alike = [g for g in found if g.kind == kind and (kind == 'base' or g.held)]
        if len(alike) > 1:  # the robot's foot, or what the chain file says of all tools
            found.append(_together(alike))
    joints, everywhere = problem.chain.joints, tuple(range(len(problem.sets)))
    found += [Moving((each.name,), 'joint', (each.driven,), everywhere) for each in joints]
    wires: dict[str, list[int]] = {}
    for k, each in enumerate(problem.sets):
        if each.of_wire:
            wires.setdefault(each.base, []).append(k)
    found += [Moving((w,), ZERO, (Parameter(w, ZERO),), tuple(sets)) for w, sets in wires.items()]
    if len(wires) > 1:
        found.append(_together(found[-len(wires) :]))
    return found


def _together(groups: Sequence[Moving]) -> Moving:
    names = tuple(name for each in groups for name in each.names)
    sets = tuple(number for each in groups for number in each.sets)
    held = any(each.held for each in groups)
    owners = tuple(owner for each in groups for owner in each.owners)
    return Moving(owners, groups[0].kind, names, sets, held)
