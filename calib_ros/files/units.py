# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Units of the columns of other systems: given by options, told by the header, or assumed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from calib_ros.errors import InputError
from calib_ros.files.expressions import Expression
from calib_ros.files.headers import name_and_unit
from calib_ros.files.layouts import Layout
from calib_ros.files.sheets import Sheet
from calib_ros.files.vocabulary import (
    ANGLES,
    IN_TURN,
    JOINT,
    LENGTHS,
    POSITION,
    SIGMAS,
    TURNS,
    UNIT_SIGNS,
    UNITS_ARE,
)
from calib_ros.kinematics.chain import Chain

OPTIONS = {
    'length': ('lengths', LENGTHS, 'm'),
    'angle': ('angles', ANGLES, 'rad'),
    'joint-angle': ('joint values', ANGLES, 'rad'),
}
"""What an option gives the unit of, the units it may have, and the one assumed."""


class Units:
    """The units of our columns, of which `columns` are expressions of those of a sheet."""

    def __init__(
        self, sheet: Sheet, columns: Mapping[str, Expression], layout: Layout, chain: Chain | None
    ) -> None:
        self._sheet, self._columns, self._chain = sheet, columns, chain
        self.notes: list[str] = []
        self._assumed: list[str] = []
        joints = [name for name in columns if JOINT.fullmatch(name) and name[0] != 's']
        types = [] if chain is None else [joint.type for joint in chain.joints]
        slides = [name for name in joints if types[int(name[1:]) - 1 :][:1] == ['prismatic']]
        turns = [name for name in joints if name not in slides]
        given: dict[str, str] = {name: getattr(layout, name) for name in layout.insisted}
        length, angle, own = (given.get(name, '') for name in ('length', 'angle', 'joint_angle'))
        places, rotations = (*POSITION, 'distance'), (*TURNS, *IN_TURN)
        lengths, angles = (*slides, *SIGMAS[:3]), (*turns, *rotations, *SIGMAS[3:])
        usual = self._in_words('angles', ANGLES, layout.angle, angle or own, angles)
        far = self._in_words('lengths', LENGTHS, layout.length, length, (*places, *lengths))
        found = self._units_of('length', length, far, places, lengths)
        turned = self._units_of('angle', angle, usual, rotations, SIGMAS[3:])
        main = [name for name in turns if name[0] == 'q']
        said = (
            set()
            if any(map(self._header_unit, main))
            else {*map(self._header_unit, turned)} - {''}
        )
        given_of_joints = own or ('' if layout.joint_angle else angle)
        usual = layout.joint_angle or usual
        if len(said) == 1 and main and not (given_of_joints or usual):
            usual = said.pop()
            self.notes.append(f'joint values are taken in {usual}, as its other angles are')
        found |= turned | self._units_of(
            'joint-angle',
            given_of_joints,
            usual,
            main,
            [name for name in turns if name not in main],
        )
        self.factors = {name: (LENGTHS | ANGLES)[unit] for name, unit in found.items()}
        """Factors of our columns to m and rad."""
        if self._assumed:
            self.notes.append(f'no units are given: taking {", ".join(self._assumed)}')

    def _in_words(
        self, what: str, units: Mapping[str, float], usual: str, given: str, columns: Sequence[str]
    ) -> str:
        """Return the one of some units that lines of words tell, or the usual one.

        Lines that tell several are refused, unless one is given or each of our columns of this
        kind has its own.
        """
        found = [words for line in self._sheet.words for words in UNITS_ARE.findall(line)]
        known = [[UNIT_SIGNS.get(word.lower(), '') for word in words] for words in found]
        told = dict.fromkeys(
            ours[-1]  # the last: `units: in mm`
            for words in known
            if (ours := [unit for unit in words if unit in units])
        )
        bare = any(not self._header_unit(name) for name in columns if name in self._columns)
        if len(told) > 1 and not given and bare:
            raise InputError(
                f'{self._sheet.path}: {what} are in {" and ".join(told)}, as its lines of units '
                f'say: split the file there, or give --{what.removesuffix("s")} if one holds'
            )
        unit = next(iter(told), usual)
        if unit != usual:
            self.notes.append(f'its lines of units say that {what} are in {unit}')
        return unit

    def _units_of(
        self, option: str, given: str, usual: str, main: Sequence[str], more: Sequence[str]
    ) -> dict[str, str]:
        """Return the units of our columns of a kind: given, in the header, or of the main ones.

        Columns of which the header says nothing have the `usual` unit, if any.
        """
        what, _, assumed = OPTIONS[option]
        said = {name: self._header_unit(name) for name in (*main, *more) if name in self._columns}
        for name, unit in said.items():
            self._check(name, unit, option, given)
        other = given or usual
        self.notes += [
            f'its header says {unit}, but {other} is given: taking {given or unit}'
            for unit in dict.fromkeys(said.values())
            if other and unit not in ('', other)
        ]
        if given:
            return dict.fromkeys(said, given)
        found = {said[name] for name in main if name in said} - {''}
        bare = [name for name, unit in said.items() if not unit]
        if bare and len(found) > 1:
            raise InputError(
                f'{self._sheet.path}: {bare[0]} has no unit, others are in '
                f'{" and ".join(sorted(found))}: write it in the header, or convert them '
                f'(--columns) and give --{option}'
            )
        if bare and not found and not usual:
            self._assumed.append(f'{what} in {assumed} (--{option})')
        return {name: unit or next(iter(found), usual or assumed) for name, unit in said.items()}

    def _check(self, ours: str, unit: str, option: str, given: str) -> None:
        """Refuse a unit of another kind, or an unknown one if none is given.

        Note one that an expression may have converted.
        """
        each, units = self._columns[ours], OPTIONS[option][1]
        if unit and unit not in units and not (given and unit not in UNIT_SIGNS):
            called = ' '.join(map(self._sheet.called, each.names))
            remedy = 'name the right column (--columns)'
            if unit not in UNIT_SIGNS:
                remedy = f'give --{option}, or convert it: --columns "{ours}={{{called}}}*FACTOR"'
            elif self._chain is None and ours[0] == 'q':
                remedy += ', or give --chain if it is prismatic'
            raise InputError(
                f'{self._sheet.path}: {ours} = {called} cannot be in {unit}, expected '
                f'{", ".join(units)}: {remedy}'
            )
        if unit and not given and not {*each.terms} <= {*each.names}:
            self.notes.append(f'{ours} = {each.text} is in {unit}, as its header says')

    def _header_unit(self, ours: str) -> str:
        """Return the unit of one of our columns that the header says, `X [mm]`, or empty."""
        each = self._columns[ours]
        found = {name_and_unit(self._sheet.called(name))[1] for name in each.names} - {''}
        if not {*each.terms} <= {*each.names}:
            found &= {*UNIT_SIGNS}  # others are converted
        if len(found) > 1:
            raise InputError(
                f'{self._sheet.path}: {ours} = {each.text} mixes {" and ".join(sorted(found))}, '
                'as its header says: write these columns in one unit'
            )
        return found.pop() if found else ''
