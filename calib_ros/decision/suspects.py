# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The usual mistakes in the input: how to undo each, and what to do."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, permutations, product
from typing import TypeAlias

import numpy as np

from calib_ros.decision.moved import RELEASE
from calib_ros.decision.printed_board import size_of
from calib_ros.decision.rotation_conventions import misread
from calib_ros.decision.undoing import (
    DataChange,
    Sets,
    Suspect,
    change_axes,
    joint_map,
    map_rotations,
    mirrored,
    scale_joints,
    scale_lengths,
    scaled,
)
from calib_ros.estimation.levels import NEARER
from calib_ros.estimation.observations import Observations
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Convention
from calib_ros.kinematics.chain_file import shipped_chains, too_long
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import counted

Rescaled: TypeAlias = Callable[[float], DataChange]
QUARTERS = {'+90': 0.5 * np.pi, '-90': -0.5 * np.pi, '+180': np.pi}
"""Zeros of joints [rad] that differ between conventions."""
MIXED_UP_UNITS = (
    ('degrees', 'radians', 'deg', np.radians(1.0)),
    ('radians', 'degrees', 'rad', np.degrees(1.0)),
)
"""Actual unit of angles, assumed unit, option, and size of the actual in the assumed one."""
UNITS = (('mm', 'mm', 1e-3), ('cm', 'cm', 1e-2), ('in', 'inches', 0.0254), ('ft', 'feet', 0.3048))
"""Units of lengths, in words, and their sizes [m]."""
FIRST = ('measured', 'handed', 'order')
"""Parts whose mistakes are undone before those of single joints."""
BACK = (Observations.inverted,)
"""Change between what a camera on the flange measured and what is fitted."""
ON_FLANGE = (
    'the positions are of a fixed point, seen by a camera on the flange',
    '--eye-in-hand',
)
NOT_ON_FLANGE = ('the camera is not on the flange', 'leave out --eye-in-hand (or eye_in_hand)')
UNHOLD = f'{RELEASE}; if it is right, raise largest_error'
ORIENTATIONS = Suspect(
    'the positions fit the arm, the orientations do not',
    'check their convention, their units and their columns, or leave them out',
    published='check the orientations where they are published',
)
"""Named if no other mistake explains the measurements."""


def suspects(chain: Chain, sets: Sets, of_images: bool = False) -> Iterator[Suspect]:
    """Yield possible mistakes, the most usual first.

    Poses `of_images` are those of a board in a camera; joint values come from a table of places.
    """
    if of_images:
        yield from (replace(each, part='measured') for each in _of_boards(chain, sets[0]))
        for each in _arm_mistakes(chain, sets):
            remedy = each.published if each.in_file else 'correct it in --places'
            yield replace(each, remedy=remedy)
        return
    if not sets[0].socket:
        back = BACK * sets[0].inverse  # to what was measured
        for each in _of_poses(chain, sets[0]):
            yield replace(each, changes=(*back, *each.changes, *back))
    yield from _arm_mistakes(chain, sets)


def _of_poses(chain: Chain, seen: Observations) -> Iterator[Suspect]:
    """Yield mistakes of what was measured."""
    yield from (replace(each, part='measured') for each in _units(chain))
    if seen.oriented.any():
        yield from (replace(each, part='measured') for each in _conventions(chain, seen))
        yield from _misread(chain, seen) if seen.oriented.sum() > 1 else ()
    else:
        what, remedy = NOT_ON_FLANGE if seen.seen else ON_FLANGE
        yield Suspect(what, remedy, BACK, published=_in_sources(not seen.seen))
    yield from _of_coordinates(seen)
    remedy = 'flip one of them, --columns y=-y (for poses qx=-qx,qz=-qz as well)'
    what = 'the axes of the measuring device are left-handed'
    yield Suspect(what, remedy, (mirrored,), 3, part='handed')


def _arm_mistakes(chain: Chain, sets: Sets) -> Iterator[Suspect]:
    """Yield mistakes of joint values and the arm."""
    for one, other, unit, size in MIXED_UP_UNITS:
        what = f'the joint values are in {one}, not {other}'
        change = scale_joints(chain, 'revolute', size)
        yield Suspect(what, f'--joint-angle {unit}', (change,), part='measured')
    yield from _of_lengths(
        'linear joints', _linear(chain), partial(scale_joints, chain, 'prismatic')
    )
    yield from _of_joints(chain, sets[0])
    yield from _of_one_unit(chain)
    yield from _of_arms(chain)
    yield from _of_frames(chain, sets)
    for rows in (1, -1, 2, -2):
        remedy, published = f'--shift {rows} (added to one given)', 'check the stamps, and delay'
        yield Suspect(rows_away(rows), remedy, rank=2, rows=rows, published=published)


def rows_away(rows: int) -> str:
    """Return that joint values stand some rows below their measurement, or above it."""
    count, where = counted(abs(rows), 'row'), 'below' if rows > 0 else 'above'
    return f'the joint values are {count} {where} their measurement'


def _of_boards(chain: Chain, seen: Observations) -> Iterator[Suspect]:
    """Yield mistakes of a camera and its board."""
    what, remedy = 'the camera is on the flange', '--eye-in-hand (or eye_in_hand)'
    if seen.inverse:
        what, remedy = NOT_ON_FLANGE
    yield Suspect(what, remedy, BACK, published=_in_sources(not seen.inverse))
    size = size_of(chain, seen)
    remedy = 'measure the print, and give square and marker in metres'
    what = f'the board is stated {float(f"{1.0 / size:.3g}"):g} times as large as it is'
    yield Suspect(what, remedy, (scaled(size),), published=remedy)
    remedy = 'give images and corners as the camera sees them, u to the right and v down'
    yield Suspect('the images are mirrored', remedy, (mirrored,), published=remedy)


def _in_sources(on_flange: bool) -> str:
    return f'set eye_in_hand={str(on_flange).lower()} in sources'


def _units(chain: Chain) -> Iterator[Suspect]:
    """Yield units of lengths, and of angles at the same time."""
    whole = 'positions and linear joints' if _linear(chain) else 'positions'
    degrees = scale_joints(chain, 'revolute', np.radians(1.0))
    for unit, name, size in UNITS:
        smaller = ' (or in mm, not um: --length mm)' * (unit == 'mm')
        for way, option, factor in (
            (f'in {name}, not metres', f'--length {unit}', size),
            (f'in metres, not {name}{smaller}', '--length m', 1.0 / size),
        ):
            what, changes = f'the {whole} are {way}', scale_lengths(chain, factor)
            yield Suspect(what, option, changes)
            both = f'{what} and the joint values in degrees'
            yield Suspect(both, f'{option} --joint-angle deg', (*changes, degrees), 2)
    if _linear(chain):
        yield from _of_lengths('positions', 'xyz', scaled)


def _linear(chain: Chain) -> list[str]:
    return [f'q{k}' for k, joint in enumerate(chain.joints, 1) if joint.type == 'prismatic']


def _of_lengths(key: str, columns: Sequence[str], change: Rescaled) -> Iterator[Suspect]:
    """Yield units of some lengths alone."""
    for _, name, size in UNITS if columns else ():
        for way, factor in ((f'{name}, not metres', size), (f'metres, not {name}', 1.0 / size)):
            option = '--columns ' + ','.join(f'{each}={each}*{factor:g}' for each in columns)
            yield Suspect(f'the {key} are in {way}', option, (change(factor),), 2, part='measured')


def _of_coordinates(seen: Observations) -> Iterator[Suspect]:
    """Yield other axes of the positions alone, and units of one coordinate."""
    for signs, order in product(product((1, -1), repeat=3), permutations(range(3))):
        if seen.oriented.any() and ({*signs} == {1}) != (order == (0, 1, 2)):
            matrix = np.diag(signs) @ np.eye(3)[[*order]]
            given = [f'{"-" * (n < 0)}{"xyz"[k]}' for n, k in zip(signs, order, strict=True)]
            option = '--columns x={},y={},z={}'.format(*given)
            what = f'the coordinates x, y, z of the positions are {", ".join(given)}'
            turned = bool(np.linalg.det(matrix) > 0.0)  # Euler angles' may look so
            if not np.array_equal(matrix, -np.eye(3)):  # as left-handed axes
                changes = (change_axes(matrix),)
                yield Suspect(what, option, changes, 3 - turned, part='measured')
    for k, name in enumerate('xyz'):
        yield from _of_lengths(f'{name} coordinates alone', name, partial(scaled, axis=k))


def _conventions(chain: Chain, seen: Observations) -> Iterator[Suspect]:
    """Yield ways to write a pose, also with lengths in mm or joint values in degrees.

    Only if all poses have an orientation, a camera on the flange may have measured them.
    """

    def rolled(turns: FloatArray, by: int) -> FloatArray:
        return se3.from_quat(np.roll(se3.to_quat(turns), by, 1))

    ways = []
    for meant, read, by in (('w x y z', 'x y z w', -1), ('x y z w', 'w x y z', 1)):
        what, option = f'the quaternions are {meant}, not {read}', meant.replace(' ', '')
        changes = (map_rotations(partial(rolled, by=by)),)
        ways.append(Suspect(what, f'--quaternion {option}', changes))
    what = 'the rotations are transposed: they are of the device in the target'
    transposed = map_rotations(lambda turns: np.swapaxes(turns, 1, 2))
    ways.append(Suspect(what, '--columns qx=-qx,qy=-qy,qz=-qz', (transposed,)))
    if seen.inverse:
        what = 'the poses are not of a fixed target seen from the flange'
        ways.append(Suspect(what, NOT_ON_FLANGE[1], BACK, published=_in_sources(False)))
    elif seen.oriented.all():
        what = 'the poses are of the world in the target, as from a camera on the flange'
        remedy = '--eye-in-hand (or --inverse, where the device stands)'
        ways.append(Suspect(what, remedy, BACK, published=_in_sources(True)))
    in_mm, degrees = scale_lengths(chain, 1e-3), scale_joints(chain, 'revolute', np.radians(1.0))
    for way in ways:
        yield way
        for units, option, others in (
            ('and the positions in mm', '--length mm', in_mm),
            ('and the joint values in degrees', '--joint-angle deg', (degrees,)),
            (
                'the positions in mm and the joint values in degrees',
                '--length mm --joint-angle deg',
                (*in_mm, degrees),
            ),
        ):
            published = way.published
            if published != Suspect.published:
                published += ', correct the rest in the publisher'
            what, remedy = f'{way.what}, {units}', f'{way.remedy} {option}'
            yield Suspect(what, remedy, (*others, *way.changes), 2, published=published)


def _misread(chain: Chain, seen: Observations) -> Iterator[Suspect]:
    """Yield other conventions of the rotations.

    Base and tool preserve the angle between two poses: it must equal that between the flanges.
    """
    arm = chain.forward(seen.joints)[seen.oriented, :3, :3]
    measured = (seen.inverted() if seen.inverse else seen).rotations[seen.oriented]
    between = se3.angles_between(arm[:-1], arm[1:])

    def away(turns: FloatArray) -> float:
        return float(np.median(np.abs(se3.angles_between(turns[:-1], turns[1:]) - between)))

    largest = NEARER * max(away(measured), float(np.median(between)))
    for what, remedy, turn in misread():
        if away(turn(measured)) < largest:
            yield Suspect(what, remedy, (map_rotations(turn),), 2)


def _of_joints(chain: Chain, seen: Observations) -> Iterator[Suspect]:
    """Yield signs, zeros, order, rest and couplings of joints, perhaps with a ball in a socket."""
    names = chain.joint_names
    last, same = len(names), np.eye(len(names))
    yield from (each for k in range(last) for each in _of_joint(chain, k))
    for i, j in combinations(range(last), 2):
        swap = [{i: j, j: i}.get(k, k) for k in range(last)]
        what = f'{names[i]} and {names[j]} are swapped'
        remedy = f'--columns q{i + 1}=q{j + 1},q{j + 1}=q{i + 1}'
        published = 'swap them in joint_names, start without resume'
        yield Suspect(what, remedy, (joint_map(same[swap]),), 2, published=published, part='order')
    orders = {'in the order from tool to base': [*range(last)][::-1]} if last > 3 else {}
    for more in (1, 2) if last > 6 else ():  # external axes, which controllers name last
        where = f'in another order, {" and ".join(names[:more])} last'
        orders[where] = [*range(last - more, last), *range(last - more)]
    for where, places in orders.items():
        yield replace(reordered(f'the joints are {where}', places, rank=2), part='order')
    least = last - 1 if seen.socket else 1  # on the first axes a ball stays in any socket
    tails = (('target does not move', slice(k, last)) for k in range(last - 1, least - 1, -1))
    for stands, which in (('device moves', slice(1)), *tails):
        listed = ', '.join(names[which])
        what, remedy = f'the {stands} with {listed}', f'leave {listed} out of the chain file'
        columns = ','.join(f'q{k + 1}=0' for k in range(last)[which])
        still = joint_map(same - np.diag(same[which].sum(axis=0)))
        yield Suspect(what, f'{remedy}, or --columns {columns}', (still,), published=remedy)
    for k in range(1, 0 if seen.socket else last - 1):
        rested = joint_map(same - np.diag(same[k]), seen.joints[0] * same[k])
        remedy = 'check its brake, clutch and encoder, and measure again'
        yield Suspect(f'{names[k]} did not move', remedy, (rested,), published=remedy)
    for k in range(1, last):
        for way in '+-' * (chain.joints[k - 1].type == chain.joints[k].type == 'revolute'):
            coupled = same + float(f'{way}1') * np.outer(same[k], same[k - 1])
            what = f'{names[k]} is not given against {names[k - 1]}: they are coupled'
            remedy = f'--columns q{k + 1}=q{k + 1}{way}q{k}'
            yield Suspect(what, remedy, (joint_map(coupled),), 2, part=names[k])


def reordered(what: str, places: Sequence[int], rank: int) -> Suspect:
    """Return that joint k is in another of the places (n,)."""
    columns = ','.join(f'q{k}=q{place + 1}' for k, place in enumerate(places, 1))
    change = joint_map(np.eye(len(places))[[*places]])
    published = 'set the order of joint_names, start without resume'
    return Suspect(what, f'--columns {columns}', (change,), rank, published=published)


def hidden(chain: Chain, others: Sequence[Suspect]) -> list[tuple[Suspect, ...]]:
    """Return mistakes that hide each other: of joints, signs also with others in hand or order."""
    every = [[*_of_joint(chain, k)] for k in range(len(chain.joints))]
    pairs = [pair for two in combinations(every, 2) for pair in product(*two)]
    signs = [each[0] for each in every]
    ones = [each for each in others if each.part in FIRST[1:]]
    return [*pairs, *product(ones, signs), *combinations(signs, 3)]


def _of_one_unit(chain: Chain) -> Iterator[Suspect]:
    """Yield that one joint has another angle unit than the others."""
    turning = [k for k, joint in enumerate(chain.joints) if joint.type == 'revolute']
    for k in turning if len(turning) > 1 else ():
        name, column = chain.joint_names[k], f'q{k + 1}'
        for one, others, _, size in MIXED_UP_UNITS:
            what = f'{name} is in {one}, the other joints in {others}'
            change = joint_map(np.diag(np.where(np.arange(len(chain.joints)) == k, size, 1.0)))
            remedy = f'--columns {column}={column}*{size:.9g}'
            yield Suspect(what, remedy, (change,), 2, part=name)


def _of_joint(chain: Chain, k: int) -> Iterator[Suspect]:
    """Yield that a joint has the other sign, then other zeros, with either sign."""
    name, column, own = chain.joint_names[k], f'q{k + 1}', np.eye(len(chain.joints))[k]
    other = ('counts the other way round', f'sign: {-chain.joints[k].sign}')
    quarters = QUARTERS if chain.joints[k].type == 'revolute' else {}
    for (degrees, angle), sign in product({'': 0.0, **quarters}.items(), (-1.0, 1.0)):
        parts, given = [other] * (sign < 0.0), f'{"-" * (sign < 0.0)}{column}'
        if degrees:
            turned = chain.joints[k].sign * round(np.degrees(angle))
            parts.append((f'has its zero {degrees[1:]} degrees away', f'theta {turned:+} degrees'))
            given += f'{degrees[0]}{abs(angle):.16g} ({degrees} if in degrees)'
        if parts:
            whats, in_file = zip(*parts, strict=True)
            remedy = f'{" and ".join(in_file)} in the chain file'
            yield Suspect(
                f'{name} {" and ".join(whats)}',
                f'{remedy}, or --columns {column}={given}',
                (joint_map(np.diag(np.where(own, sign, 1.0)), angle * own),),
                len(whats),
                published=remedy,
                part=name,
            )


def _of_signs(chain: Chain) -> Iterator[Suspect]:
    """Yield that the DH table has other signs: of one joint, or of one kind in all."""
    every = range(len(chain.joints))
    for kind, which in product(('a', 'd', 'alpha'), (every, *((k,) for k in every))):
        joints = list(chain.joints)
        for k in which:
            joints[k] = replace(joints[k], **{kind: -getattr(joints[k], kind)})
        if joints != [*chain.joints]:
            of = chain.joint_names[which[0]] if len(which) == 1 else 'all joints'
            what = f'{kind} of {of} has the other sign'
            whose = 'the same' if kind == 'd' else 'the next'
            remedy = f'correct {kind} in the chain file (in a URDF: origin of {whose} joint)'
            arm = replace(chain, joints=tuple(joints), parallel=None)
            yield Suspect(what, remedy, rank=2, chain=arm, published=remedy)


def _of_arms(chain: Chain) -> Iterator[Suspect]:
    """Yield lengths in mm, the other convention, wrong signs, and arms with like joints."""
    if length := too_long(chain, 10.0):  # no arm is under a centimetre
        small = tuple(replace(j, a=1e-3 * j.a, b=1e-3 * j.b, d=1e-3 * j.d) for j in chain.joints)
        what, remedy = 'the lengths of the chain file are in mm, not metres', 'give metres there'
        large = f' (--length m if the arm is {length:.0f} m long)' * (length <= 100.0)
        yield Suspect(what, remedy + large, chain=replace(chain, joints=small), published=remedy)
    other: Convention = 'modified' if chain.convention == 'standard' else 'standard'
    what = f'the DH table is in the {other} convention, not the {chain.convention} one'
    remedy = f'convention: {other} in the chain file'
    arm = replace(chain, convention=other, parallel=None)
    yield Suspect(what, remedy, rank=3, chain=arm, published=remedy)
    yield from _of_signs(chain)
    for ours in shipped_chains():
        if [joint.type for joint in ours.joints] != [joint.type for joint in chain.joints]:
            continue
        if ours.columns != chain.columns or not np.allclose(ours.table, chain.table, atol=1e-6):
            what, remedy = f'the arm is a {ours.name}, not a {chain.name}', f'--chain {ours.name}'
            if ours.name == chain.name:
                what = f'this is not the DH table of a {ours.name}'
            published = f'set chain (--chain) to {ours.name}'
            arm = replace(ours, base=chain.base, tool=chain.tool, frames=chain.frames)
            yield Suspect(what, remedy, rank=2, chain=arm, published=published)


def _of_frames(chain: Chain, sets: Sets) -> Iterator[Suspect]:
    """Yield frames that the chain file holds in wrong places: bases and tools, or one kind."""
    frames = dict(chain.all_frames)
    held = {name for name, frame in frames.items() if frame and frame.fixed}
    bases = tuple(dict.fromkeys(each.base for each in sets if each.base in held))
    tools = tuple(dict.fromkeys(each.tool for each in sets if each.tool in held))
    for names in filter(None, dict.fromkeys(((*bases, *tools), bases, tools))):
        what = f'the chain file gives a wrong {" and ".join(names)} (fixed: true)'
        (_, base), (_, tool), *others = (frames | dict.fromkeys(names)).items()
        arm = replace(chain, base=base, tool=tool, frames=tuple(others))
        yield Suspect(what, UNHOLD, rank=3, chain=arm, published=UNHOLD)
