# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of tables of other systems to our columns (docs/tables.md)."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calib_ros.errors import ConfigError, InputError
from calib_ros.files.columns import (
    BETWEEN,
    Columns,
    as_typed,
    cell_number,
    like_joints,
    lines_in_words,
    named_by_option,
)
from calib_ros.files.layouts import (
    ANGLES,
    COVARIANCE,
    IN_TURN,
    JOINT,
    LENGTHS,
    NUMBERS,
    POSITION,
    QUATERNION,
    SIGMAS,
    TURNS,
    WORDS,
    Expression,
    Layout,
    finished,
    joint_columns,
)
from calib_ros.files.sheets import UNIT_SIGNS, Sheet, name_and_unit, only, places, read_sheet
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.effects import coupled
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.shown import some
from calib_ros.texts import csv_text
from calib_ros.values import MOST_NAMES

MEASURED_COLUMNS = (*POSITION, 'distance', 'socket', 'plane')
WHAT = {'length': 'lengths', 'angle': 'angles', 'joint-angle': 'joint values'}


@dataclass(frozen=True, eq=False)
class Foreign:
    """How to read a table of another system.

    `chain` gives the number of joints, their names, and which are prismatic. Without it there are
    as many as columns for them, all revolute.
    """

    layout: Layout
    chain: Chain | None = None
    log: Path | None = None  # separate table of the joint values
    log_layout: Layout = field(default_factory=Layout)

    def convert(self, path: Path) -> tuple[Columns, tuple[str, ...]]:
        """Return our columns of a table, and notes about guesses and omissions."""
        table = _Table(path, self.layout, self.chain, self.log is None)
        values, lines = table.values(), table.lines
        notes, matched = [f'{path}: {note}' for note in table.notes], ''
        if self.log is not None:
            log = _Table(self.log, self.log_layout, self.chain, True, alone=True)
            joints = log.values()
            if 'q1' not in joints:
                joined = 0 if self.chain is None else len(self.chain.joints)
                like = like_joints(log.names, joined) or {'q*': 'NAME*'}
                given = ','.join(f'{ours}={as_typed(name)}' for ours, name in like.items())
                raise InputError(
                    f'{self.log} has no column q1; {log.has}: give --columns "{given}" or '
                    '--joints-preset'
                )
            matched, partners = _partners(table, log)
            if not {*MEASURED_COLUMNS} & {*values}:
                raise InputError(
                    f'{path} has no column x, y, z; {table.has}. '
                    f'{named_by_option(table.names, POSITION, 0)}'
                )
            if len(partners) != len(lines):
                raise InputError(
                    f'{self.log} has {len(log.lines)} rows, {path} has {len(lines)}: give both a '
                    'column of the same name that names the poses, or a row for each measurement'
                )
            how = f'by the column "{matched}"' if matched else 'row by row'
            notes += [f'{self.log}: {note}' for note in log.notes]
            notes.append(f'{self.log}: holds the joint values of {path}, matched {how}')
            joints = {ours: each[partners] for ours, each in joints.items()}
            for ours in filter(re.compile('q[0-9]+').fullmatch, joints):
                for line in log.lines[partners][np.isnan(joints[ours])][:1].tolist():
                    raise InputError(
                        f'{self.log}, line {line}: {ours} is blank: correct or leave out that row'
                    )
            values = joints | values
        if not self.layout.source:  # a preset is known to leave some out
            notes += not_read(path, [name for name in table.unread() if name != matched])
        made = Columns(path, lines, table.words(), values, table.names)
        if self.layout.shift:
            made = _shifted(made, self.layout.shift)
        made, skipped = measured(made)
        return finished(made, self.layout), (*notes, *skipped)


def measured(made: Columns) -> tuple[Columns, tuple[str, ...]]:
    """Return the rows in which something was measured, and a note about the others."""
    blank = [made.blank(name) for name in MEASURED_COLUMNS if name in made.header]
    if not blank or not (empty := np.logical_and.reduce(blank)).any():
        return made, ()
    left = lines_in_words(made.lines[empty].tolist())
    if empty.all():
        raise InputError(f'{made.path}: nothing measured in {left}: rows need x, y, z or distance')
    return made.select(~empty), (f'{made.path}: nothing measured in {left}: skipped',)


def not_read(path: Path, names: Sequence[str]) -> tuple[str, ...]:
    """Return a warning about columns that are not read, by their names in the file."""
    named = [name for name in names if name and not name.startswith('#')]
    return (
        f'{path}: columns not read: {", ".join(some(named))} (--columns OURS=NAME reads one)',
    ) * bool(named)


def as_csv(columns: Columns) -> str:
    """Return the text of a table; numbers are exact."""
    names = sorted(columns.header, key=_place)
    return csv_text([names, *zip(*map(columns.texts, names), strict=True)])


def _place(name: str) -> tuple[int, int]:
    if JOINT.fullmatch(name):
        return 1 + 'qsva'.index(name[0]), int(name[1:])
    order = ('session', 'split', 'stamp_ns', *POSITION, *QUATERNION, 'distance', *COVARIANCE)
    rank = order.index(name) if name in order else len(order)
    return (0 if rank < 3 else 5), rank


class _Table:
    def __init__(
        self, path: Path, layout: Layout, chain: Chain | None, joints: bool, alone: bool = False
    ) -> None:
        self._path, self._layout, self._chain = path, layout, chain
        most = MOST_NAMES if chain is None else len(chain.joints)
        self._ours: dict[str, str] = {}
        expressions: dict[str, Expression] = {}
        needed: dict[str, None] = {}
        self._optional: set[str] = set()
        self._assumed: list[str] = []
        for ours, theirs in layout.columns.items():
            of_joint = JOINT.fullmatch(ours)
            if not (joints and int(ours[1:]) <= most if of_joint else not alone):
                continue
            self._ours[ours] = theirs
            names: tuple[str, ...] = (_bare(theirs),)
            if ours not in WORDS:
                expressions[ours] = Expression.parse(theirs)
                names = expressions[ours].names
            if chain is None and of_joint:  # as many as there are
                self._optional |= {*names}
            if chain is not None or not of_joint or ours == 'q1':
                needed |= dict.fromkeys(names)
        own = _own_names(chain, joints, alone)
        self._sheet: Sheet = read_sheet(path, layout, list(needed), list(own))
        self.notes = list(self._sheet.notes)
        self._expressions = self._completed(expressions, own)
        self.lines = self._sheet.columns.lines

    def _completed(
        self, expressions: dict[str, Expression], own: dict[str, str]
    ) -> dict[str, Expression]:
        """Return the expressions with what the header calls by our names, or the chain's."""
        kept, guessed = self._there(expressions), []
        lower = [name.lower() for name in self._sheet.header]
        for name, ours in own.items():
            found = places(lower, name.lower())
            if ours in kept or ours in self._ours or not found:
                continue
            if len(found) > 1 and ours not in (*WORDS, *QUATERNION):
                continue
            column = only(found, name)
            if ours in WORDS:
                self._ours[ours] = f'#{column + 1}'
                continue
            bare, _ = name_and_unit(self._sheet.header[column])
            if ours[0] in 'sva' and ours[1:].isdigit() and bare != name:
                continue  # the axes of KUKA are A1, A2, ...: no accelerations
            if ours == 'time' and self._has_dates(column):
                continue
            kept[ours] = Expression.parse(f'#{column + 1}')
            if name != ours:
                guessed.append(f'{ours} = {name}')
        if guessed:
            self.notes.append(f'by the names of the joints, {", ".join(guessed)}')
        if self._chain is not None and any(re.fullmatch('q[0-9]+', ours) for ours in kept):
            names = joint_columns(len(self._chain.joints))
            # what is reported of coupled joints does not count
            kept = {names[k]: Expression.parse('0') for k in coupled(self._chain)} | kept
            if missing := [name for name in names if name not in kept]:
                raise InputError(
                    f'{self._path} has no column for {", ".join(missing)}; {self.has}. '
                    f'{named_by_option(self.names, missing, len(names))}'
                )
        return kept

    def _has_dates(self, column: int) -> bool:
        first = self.cells(f'#{column + 1}')[0].replace(self._sheet.columns.decimal, '.')
        return math.isinf(cell_number(first))

    def _there(self, expressions: dict[str, Expression]) -> dict[str, Expression]:
        """Return the expressions whose columns are there; others must be optional."""
        kept, absent = {}, []
        for ours, each in expressions.items():
            missing = [name for name in each.names if self._sheet.number(name) is None]
            if not missing:
                kept[ours] = each
            elif not set(missing) <= self._optional:
                raise InputError(
                    f'{self._path} has no column {", ".join(missing)} for {ours}; {self.has}'
                )
            else:
                absent.append(f'{ours} ({", ".join(missing)})')
        if 0 < len(absent) <= 5:  # `q*=A*` names more than there are
            self.notes.append(f'it has no {", ".join(absent)}: left out')
        return kept

    @property
    def has(self) -> str:
        """Return in words which columns there are."""
        return f'it has {", ".join(self.header)}'

    @property
    def header(self) -> tuple[str, ...]:
        return tuple(filter(None, self._sheet.header))

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the columns without their units."""
        return tuple(name_and_unit(name)[0] for name in self.header)

    def unread(self) -> list[str]:
        """Return the names of the columns that nothing is made of."""
        used = {n for each in self._expressions.values() for n in each.names}
        used |= {_bare(self._ours[ours]) for ours in WORDS if ours in self._ours}
        numbers = {self._sheet.number(name) for name in used}
        header = enumerate(self._sheet.header, 1)
        return [name for k, name in header if f'#{k}' not in numbers]

    def words(self) -> dict[str, str]:
        used = {ours: _bare(self._ours[ours]) for ours in WORDS if ours in self._ours}
        return {ours: BETWEEN.join(self.cells(name)) for ours, name in used.items()}

    def cells(self, name: str) -> list[str]:
        """Return the texts of a column."""
        return self._sheet.columns.texts(self._sheet.number(name) or '')

    def values(self) -> dict[str, FloatArray]:
        """Return our columns in m and rad."""
        names = list(dict.fromkeys(n for each in self._expressions.values() for n in each.names))
        numbers = [self._sheet.number(name) or '' for name in names]
        called = [self._called(name) or name for name in names]
        read = self._sheet.columns.numbers(numbers, called)
        columns = dict(zip(names, read.T, strict=True))
        factors = self._factors()
        found = {}
        for ours, each in self._expressions.items():
            value = np.broadcast_to(each.of(columns), len(self.lines)) * factors.get(ours, 1.0)
            if np.isinf(value).any():
                line = self.lines[int(np.argmax(np.isinf(value)))]
                raise InputError(f'{self._path}, line {line}: {ours} = {each.text} is infinite')
            found[ours] = value
        return found

    def _called(self, name: str) -> str:
        """Return the text above the column of a name or `#k`."""
        return self._sheet.header[int((self._sheet.number(name) or '')[1:]) - 1]

    def _factors(self) -> dict[str, float]:
        """Return the factors of our columns to m and rad."""
        layout, length = self._layout, self._layout.length
        for cells in self._sheet.above:
            if 'Length Units' in cells[:-1]:
                unit = UNIT_SIGNS.get(cells[cells.index('Length Units') + 1].lower(), '')
                if unit in LENGTHS and unit != length:
                    self.notes.append(f'lengths are in {unit}, as its head says')
                    length = unit
        joints = [name for name in self._expressions if JOINT.fullmatch(name) and name[0] != 's']
        types = [] if self._chain is None else [joint.type for joint in self._chain.joints]
        slides = [name for name in joints if types[int(name[1:]) - 1 :][:1] == ['prismatic']]
        turns = [name for name in joints if name not in slides]
        lengths = self._told('length', length, (*POSITION, 'distance'), (*slides, *SIGMAS[:3]))
        angles = self._told('angle', layout.angle, (*TURNS, *IN_TURN), SIGMAS[3:])
        said = {self._said(name) for name in angles} - {''}
        given = layout.joint_angle or layout.angle
        if not given and len(said) == 1 and not any(map(self._said, turns)):
            given = said.pop()
        main = [name for name in turns if name[0] == 'q']
        told = self._told('joint-angle', given, main, [name for name in turns if name[0] != 'q'])
        if self._assumed:
            self.notes.append(f'no units are given: taking {", ".join(self._assumed)}')
        return {name: (LENGTHS | ANGLES)[unit] for name, unit in (lengths | angles | told).items()}

    def _told(
        self, option: str, given: str, main: Sequence[str], more: Sequence[str]
    ) -> dict[str, str]:
        """Return the units of our columns of a kind: given, in the header, or of the main ones."""
        units, usual = (LENGTHS, 'm') if option == 'length' else (ANGLES, 'rad')
        said = {name: self._said(name) for name in (*main, *more) if name in self._expressions}
        for name, unit in said.items():
            self._check_unit(name, unit, units, given)
        if given:
            for unit in dict.fromkeys(said.values()):
                if unit not in ('', given):
                    self.notes.append(
                        f'its header says {unit}, but {given} is given: taking {given}'
                    )
            return dict.fromkeys(said, given)
        found = {said[name] for name in main if name in said} - {''}
        bare = [name for name, unit in said.items() if not unit]
        if bare and len(found) > 1:
            raise InputError(
                f'{self._path}: {bare[0]} has no unit, others are in {" and ".join(sorted(found))}'
                f': write it in the header, or convert them (--columns) and give --{option}'
            )
        if bare and not found:
            self._assumed.append(f'{WHAT[option]} in {usual} (--{option})')
        return {name: unit or next(iter(found), usual) for name, unit in said.items()}

    def _check_unit(self, ours: str, unit: str, units: Mapping[str, float], given: str) -> None:
        """Refuse a unit of another kind; note one that an expression may have converted."""
        each = self._expressions[ours]
        of = f'{ours} = {" ".join(map(self._called, each.names))}'
        if unit and unit not in units:
            raise InputError(
                f'{self._path}: {of} cannot be in {unit}, expected {", ".join(units)}: name the '
                'right column (--columns)'
                + ', or give --chain if it is prismatic'
                * (self._chain is None and ours[0] == 'q')
            )
        if unit and not given and not {*each.terms} <= {*each.names}:
            self.notes.append(f'{ours} = {each.text} is in {unit}, as its header says')

    def _said(self, ours: str) -> str:
        """Return the unit of one of our columns that the header says, `X [mm]`, or empty."""
        each = self._expressions[ours]
        found = {name_and_unit(self._called(name))[1] for name in each.names} - {''}
        if len(found) > 1:
            raise InputError(
                f'{self._path}: {ours} = {each.text} mixes {" and ".join(sorted(found))}, as its '
                'header says: write these columns in one unit'
            )
        return found.pop() if found else ''


def _partners(table: _Table, log: _Table) -> tuple[str, Index]:
    """Return a column that names the poses of both, if any, and the row in the log of each.

    It may have other capitals in the log.
    """
    others = {name.lower(): name for name in log.header} | {name: name for name in log.header}
    for name in table.header:
        if theirs := others.get(name, others.get(name.lower())):
            named, logged = table.cells(name), log.cells(theirs)
            rows = {cell: row for row, cell in enumerate(logged)}
            if len(rows) == len(logged) and len({*named}) == len(named) and {*named} <= {*rows}:
                return name, np.array([rows[cell] for cell in named])
    return '', np.arange(len(log.lines))


def _bare(name: str) -> str:
    return name[1:-1] if name.startswith('{') and name.endswith('}') else name


def _own_names(chain: Chain | None, joints: bool, alone: bool) -> dict[str, str]:
    found: dict[str, str] = {}
    if joints:
        count = MOST_NAMES if chain is None else len(chain.joints)
        found = {name: name for letter in 'qsva' for name in joint_columns(count, letter)}
        if chain is not None:
            found |= {name: f'q{k + 1}' for k, name in enumerate(chain.joint_names)}
    if not alone:
        found |= {name: name for name in (*NUMBERS, *WORDS)}
    return found


def _shifted(made: Columns, shift: int) -> Columns:
    count = len(made.lines)
    if abs(shift) >= count:
        raise ConfigError(f'--shift {shift} leaves none of {count} rows')
    measured = made.select(slice(max(0, -shift), count - max(0, shift)))
    partners = slice(max(0, shift), count - max(0, -shift))
    moved = {name: made.values[name][partners] for name in made.values if JOINT.fullmatch(name)}
    return replace(measured, values={**measured.values, **moved})
