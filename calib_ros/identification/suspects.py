# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The usual mistakes in what is given for an arm: how each is undone, and what to do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from calib_ros.identification.levels import NEARER
from calib_ros.identification.misread import Turn, misread
from calib_ros.identification.observations import Observations
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import shipped_chains
from calib_ros.kinematics.se3 import FloatArray

Sets: TypeAlias = tuple[Observations, ...]
Change: TypeAlias = Callable[[Observations], Observations]
QUARTERS = {'+90': 0.5 * np.pi, '-90': -0.5 * np.pi, '+180': np.pi}
"""Zeros of joints [rad] that differ between conventions."""
SCALES = {'mm': 1e-3, 'cm': 1e-2, 'in': 0.0254}


@dataclass(frozen=True, eq=False)
class Suspect:
    """A mistake that may have been made, in words, and the option to give with a table.

    `change` makes of the samples those that should have been given, `chain` is the nominal one as
    it had to be; joint values stand so many `rows` below their measurement. Of those that explain
    the same, the lowest in `rank` are named. `published` is what to do about messages, live or of
    a bag. Mistakes of different parts, what is `measured` or a `joint`, may come together.
    """

    what: str
    remedy: str
    change: Change
    rank: int = 1
    chain: Chain | None = None
    rows: int = 0
    published: str = 'correct it where it is published'
    part: str = ''


ORIENTATIONS = Suspect(
    'the positions fit the arm, the orientations do not',
    'check their convention, their units and their columns, or leave them out',
    lambda each: each,
    published='check the orientations where they are published',
)
"""What is left to say where no other mistake explains what was measured."""


def suspects(chain: Chain, sets: Sets, of_images: bool = False) -> Iterator[Suspect]:
    """Yield what may have gone wrong, the most usual first.

    Poses `of_images` are those of a board in a camera; joint values stand in a table of places.
    """
    if of_images:
        yield from _measured(_of_boards(sets[0].inverse))
        for each in _of_places(chain):
            remedy = each.published if 'chain' in each.published else 'correct it in --places'
            yield replace(each, remedy=remedy)
        return
    if not any(each.socket for each in sets):
        degrees = _turned(chain, np.radians(1.0))
        yield from _measured(_units(chain, degrees))
        if all(each.oriented.any() for each in sets):
            whole = all(each.oriented.all() for each in sets)
            in_mm = _lengths(chain, SCALES['mm'])
            inverse = any(each.inverse for each in sets)
            yield from _measured(_conventions(in_mm, degrees, inverse, whole))
            yield from _misread(chain, sets[0])
        yield Suspect(
            'the axes of the measuring device are left-handed',
            'turn one of them round, --columns y=-y (of poses qx=-qx,qz=-qz as well)',
            _mirrored,
            3,
        )
    yield from _of_places(chain)


def _measured(found: Iterator[Suspect]) -> Iterator[Suspect]:
    for each in found:
        yield replace(each, part='measured')


def _of_places(chain: Chain) -> Iterator[Suspect]:
    """Yield what may be wrong about joint values and the arm."""
    for one, other, unit, size in (
        ('degrees', 'radians', 'deg', np.radians(1.0)),
        ('radians', 'degrees', 'rad', np.degrees(1.0)),
    ):
        what = f'the joint values are in {one}, not {other}'
        yield Suspect(what, f'--joint-angle {unit}', _turned(chain, size), part='measured')
    yield from _of_joints(chain)
    yield from _of_arms(chain)
    for rows in (1, -1, 2, -2):
        where = 'below' if rows > 0 else 'above'
        count = f'{abs(rows)} row{"s" if abs(rows) > 1 else ""}'
        yield Suspect(
            f'the joint values stand {count} {where} the measurement that they belong to',
            f'--shift {rows}',
            _as_it_is,
            2,
            rows=rows,
            published='check the stamps, and delay',
        )


def _of_boards(inverse: bool) -> Iterator[Suspect]:
    """Yield what may be wrong about a camera and its board."""
    ways = (
        ('the camera is on the flange', '--eye-in-hand (or eye_in_hand)', 'true'),
        ('the camera is not on the flange', 'leave out --eye-in-hand (or eye_in_hand)', 'false'),
    )
    what, remedy, value = ways[inverse]
    in_sources = f'set eye_in_hand={value} in sources'
    yield Suspect(what, remedy, Observations.inverted, published=in_sources)
    for unit, size in SCALES.items():
        remedy = 'give square and marker in metres'
        what = f'the lengths of the board are in {unit}, not metres'
        yield Suspect(what, remedy, _scaled(size), published=remedy)
    remedy = 'give images and corners as the camera sees them, u to the right and v down'
    yield Suspect('the images are mirrored', remedy, _mirrored, published=remedy)


def _units(chain: Chain, degrees: Change) -> Iterator[Suspect]:
    """Yield units of lengths, and of angles at the same time."""
    linear = [k for k, joint in enumerate(chain.joints, 1) if joint.type == 'prismatic']
    what = 'positions and linear joints' if linear else 'positions'
    for unit, size in SCALES.items():
        for way, option, factor in (
            (f'in {unit}, not metres', f'--length {unit}', size),
            (f'in metres, not {unit}', '--length m', 1.0 / size),
        ):
            scaled, positions = _lengths(chain, factor), _scaled(factor)
            yield Suspect(f'the {what} are {way}', option, scaled)
            yield Suspect(
                f'the {what} are {way} and the joint values in degrees',
                f'{option} --joint-angle deg',
                _one_by_one(scaled, degrees),
                2,
            )
            if linear:
                alone = _one_by_one(scaled, _scaled(1.0 / factor))
                for name, columns, change in (
                    ('positions', 'xyz', positions),
                    ('linear joints', [f'q{k}' for k in linear], alone),
                ):
                    option = ','.join(f'{each}={each}*{factor:g}' for each in columns)
                    yield Suspect(f'the {name} are {way}', f'--columns {option}', change, 2)


def _conventions(in_mm: Change, degrees: Change, inverse: bool, whole: bool) -> Iterator[Suspect]:
    """Yield ways to write a pose, with lengths in millimetres or joint values in degrees, too.

    Only `whole` poses, all with an orientation, may be those of a camera on the flange.
    """
    flange = (
        'the poses are those of the world in the target, as by a camera on the flange',
        '--eye-in-hand (or --inverse, where the device stands)',
    )
    in_sources = 'set eye_in_hand=true in sources'
    if inverse:
        flange = ('the camera is not on the flange', 'leave out --eye-in-hand (or eye_in_hand)')
        in_sources = 'set eye_in_hand=false in sources'
    again: Change = Observations.inverted if inverse else _as_it_is
    ways: tuple[tuple[str, str, Change], ...] = (
        (
            'the quaternions are w x y z, not x y z w',
            '--quaternion wxyz',
            _one_by_one(_reordered([1, 2, 3, 0]), again),
        ),
        (
            'the quaternions are x y z w, not w x y z',
            '--quaternion xyzw',
            _one_by_one(_reordered([3, 0, 1, 2]), again),
        ),
        (
            'the rotations are transposed, those of the device in the target',
            '--columns qx=-qx,qy=-qy,qz=-qz',
            _one_by_one(_transposed, again),
        ),
        (*flange, _as_it_is if inverse else Observations.inverted),
    )
    for what, remedy, change in ways if whole else ways[:-1]:
        for more, option, others in (
            ('', '', ()),
            (', and the positions in mm', ' --length mm', (in_mm,)),
            (', and the joint values in degrees', ' --joint-angle deg', (degrees,)),
            (
                ', the positions in mm and the joint values in degrees',
                ' --length mm --joint-angle deg',
                (in_mm, degrees),
            ),
        ):
            found = Suspect(
                f'{what}{more}',
                f'{remedy}{option}',
                _one_by_one(_as_measured, *others, change),
                2 if more else 1,
            )
            if (what, remedy) == flange:
                rest = ', and correct the rest where it is published' if more else ''
                found = replace(found, published=in_sources + rest)
            yield found


def _misread(chain: Chain, each: Observations) -> Iterator[Suspect]:
    """Yield other conventions that the rotations may have been written in.

    Base and tool leave the angle between two poses as it is: it must be that between two flanges.
    """
    arm = replace(chain, base=None, tool=None).forward(each.joints)[each.oriented, :3, :3]
    between = se3.angles_between(arm[:-1], arm[1:])

    def away(rotations: FloatArray) -> float:
        some = rotations[each.oriented]
        return float(np.median(np.abs(se3.angles_between(some[:-1], some[1:]) - between)))

    largest = NEARER * max(away(each.rotations), float(np.median(between)))
    again: Change = Observations.inverted if each.inverse else _as_it_is
    for what, remedy, turn in misread():
        change = _one_by_one(_as_measured, _with(turn), again)
        if away(change(each).rotations) < largest:
            yield Suspect(what, remedy, change, 2)


def _of_joints(chain: Chain) -> Iterator[Suspect]:
    """Yield signs, zeros, order and couplings of joints."""
    names = chain.joint_names
    count = len(names)
    revolute = [joint.type == 'revolute' for joint in chain.joints]
    for k in range(count):
        for sign in (1.0, -1.0):
            zeros = {'': 0.0, **(QUARTERS if revolute[k] else {})}
            for degrees, angle in zeros.items():
                if sign < 0.0 or degrees:
                    yield _of_joint(chain, k, sign, degrees, angle)
    for i in range(count):
        for j in range(i + 1, count):
            order = np.arange(count)
            order[[i, j]] = j, i
            yield Suspect(
                f'{names[i]} and {names[j]} are swapped',
                f'--columns q{i + 1}=q{j + 1},q{j + 1}=q{i + 1}',
                _joints(np.eye(count)[order]),
                2,
                published='swap them in joint_names',
            )
    for k in range(1, count):
        for sign in (1.0, -1.0) if revolute[k] and revolute[k - 1] else ():
            coupled = np.eye(count)
            coupled[k, k - 1] = sign
            yield Suspect(
                f'{names[k]} is not given against {names[k - 1]}: they are coupled',
                f'--columns q{k + 1}=q{k + 1}{"+" if sign > 0.0 else "-"}q{k}',
                _joints(coupled),
                2,
            )


def _of_joint(chain: Chain, k: int, sign: float, degrees: str, angle: float) -> Suspect:
    """Return that a joint counts the other way round, has another zero [rad], or both."""
    whats, in_file, column = [], [], f'q{k + 1}'
    if sign < 0.0:
        whats.append('counts the other way round')
        in_file.append(f'sign: {-chain.joints[k].sign}')
        column = f'-{column}'
    if degrees:
        whats.append(f'has its zero {degrees[1:]} degrees away')
        in_file.append(f'theta {degrees} degrees')
        column += f'{degrees[0]}{abs(angle):.16g}'
    count = len(chain.joints)
    matrix = np.eye(count)
    matrix[k, k] = sign
    remedy = f'{" and ".join(in_file)} in the chain file'
    return Suspect(
        f'{chain.joint_names[k]} {" and ".join(whats)}',
        f'{remedy}, or --columns q{k + 1}={column}',
        _joints(matrix, angle * np.eye(count)[k]),
        len(whats),
        published=remedy,
        part=chain.joint_names[k],
    )


def _of_arms(chain: Chain) -> Iterator[Suspect]:
    """Yield lengths in mm, the other convention, and other arms with the same kinds of joints."""
    small = [replace(j, a=SCALES['mm'] * j.a, d=SCALES['mm'] * j.d) for j in chain.joints]
    remedy = 'give a and d in metres there'
    yield Suspect(
        'the lengths of the chain file are in mm, not metres',
        remedy,
        _as_it_is,
        chain=replace(chain, joints=tuple(small)),
        published=remedy,
    )
    other = 'modified' if chain.convention == 'standard' else 'standard'
    yield Suspect(
        f'the DH table is in the {other} convention, not the {chain.convention} one',
        f'convention: {other} in the chain file',
        _as_it_is,
        3,
        replace(
            chain, convention='modified' if other == 'modified' else 'standard', parallel=None
        ),
        published=f'convention: {other} in the chain file',
    )
    types = [joint.type for joint in chain.joints]
    for ours in shipped_chains():
        alike = [joint.type for joint in ours.joints] == types
        if alike and not np.allclose(ours.table, chain.table, atol=1e-6):
            yield Suspect(
                f'the arm is a {ours.name}, not a {chain.name}',
                f'--chain {ours.name}',
                _as_it_is,
                2,
                replace(ours, base=chain.base, tool=chain.tool),
                published=f'set chain to {ours.name}',
            )


def _as_it_is(each: Observations) -> Observations:
    return each


def _one_by_one(*changes: Change) -> Change:
    def changed(each: Observations) -> Observations:
        for change in changes:
            each = change(each)
        return each

    return changed


def _joints(matrix: FloatArray, shift: FloatArray | float = 0.0) -> Change:
    return lambda each: replace(each, joints=each.joints @ matrix.T + shift)


def _turned(chain: Chain, size: float) -> Change:
    return _joints(np.diag([size if j.type == 'revolute' else 1.0 for j in chain.joints]))


def _lengths(chain: Chain, size: float) -> Change:
    """Return what `--length` changes: positions and the values of prismatic joints."""
    sizes = [size if joint.type == 'prismatic' else 1.0 for joint in chain.joints]
    return _one_by_one(_scaled(size), _joints(np.diag(sizes)))


def _scaled(size: float) -> Change:
    return lambda each: replace(each, positions=size * each.positions)


def _with(turn: Turn) -> Change:
    return lambda each: replace(each, rotations=turn(each.rotations))


def _reordered(order: list[int]) -> Change:
    return _with(lambda rotations: se3.from_quat(se3.to_quat(rotations)[:, order]))


def _transposed(each: Observations) -> Observations:
    return replace(each, rotations=np.swapaxes(each.rotations, 1, 2))


def _as_measured(each: Observations) -> Observations:
    return each.inverted() if each.inverse else each


def _mirrored(each: Observations) -> Observations:
    """Return what a device with its y axis the other way round should have measured."""
    mirror = np.diag([1.0, -1.0, 1.0])
    return replace(
        each, positions=each.positions @ mirror, rotations=mirror @ each.rotations @ mirror
    )
