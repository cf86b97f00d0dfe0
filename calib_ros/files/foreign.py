# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of tables of other systems to our columns (docs/tables.md).

`sheets` makes a header and columns of text of any file. Here the names in the header tell ours, as
expressions of theirs; `units` makes m and rad of them, `conventions` poses of one convention.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import product, takewhile
from pathlib import Path

import numpy as np

from calib_ros.errors import ConfigError, InputError
from calib_ros.files.columns import Columns, cell_number
from calib_ros.files.conventions import to_our_columns
from calib_ros.files.expressions import Expression
from calib_ros.files.headers import (
    TURNS_LEFT,
    listed,
    name_and_unit,
    named_by_option,
    not_read,
    only_index,
    places,
)
from calib_ros.files.layouts import Layout
from calib_ros.files.names import in_doubt, like_joints, named_in, option, quaternions_in, turns_in
from calib_ros.files.sheets import read_sheet
from calib_ros.files.skipped import drop_unmeasured
from calib_ros.files.summary_rows import without_statistics
from calib_ros.files.units import Units
from calib_ros.files.vocabulary import (
    IN_TURN,
    JOINT,
    MATRIX,
    MEASURED_COLUMNS,
    NUMBERS,
    POSITION,
    QUATERNION,
    SECONDS,
    SIGMAS,
    SOCKETS,
    TURNS,
    UNIT_SIGNS,
    WORDS,
    joint_columns,
)
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.effects import coupled
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.values import MOST_NAMES

LEADING_ZEROS = re.compile('(?<![0-9.])0+(?=[0-9])')
PARTS = re.compile(r'[^\W\d_]+|[0-9]+')
NUMBERED = re.compile(r'\D*?0*([0-9]+)(?:\.0*)?\D*')


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
        made, matched = table.columns(), ''
        notes = [f'{path}: {note}' for note in table.notes]
        if self.log is not None:
            log = _Table(self.log, self.log_layout, self.chain, True, table.decimal)
            joints, matched = self._logged(log, table, made)
            how = f'by the column "{matched}"' if matched else 'row by row'
            notes += [f'{self.log}: {note}' for note in log.notes]
            notes.append(f'{self.log}: holds the joint values of {path}, matched {how}')
            cells = {**joints, **made.cells}
            if matched.lower() == 'target' and 'target' not in self.layout.columns:
                del cells['target']  # it names the poses
            made = replace(made, cells=cells)
        if not self.layout.source:  # a preset is known to leave some out
            notes += not_read(path, [name for name in table.unread() if name != matched])
            if not {*QUATERNION, *TURNS, *IN_TURN} & {*made.cells}:
                notes += turns_in(path, table.names)
        if self.layout.shift:
            made = _shifted(made, self.layout.shift)
        made, skipped = drop_unmeasured(made)
        return to_our_columns(made, self.layout), (*notes, *skipped)

    def _logged(
        self, log: _Table, table: _Table, made: Columns
    ) -> tuple[Mapping[str, str | FloatArray], str]:
        """Return the joint values of the rows of a table, and the column that names them, if any.

        `made` are our columns of the table.
        """
        joints = log.columns()
        if 'q1' not in joints.cells:
            count = 0 if self.chain is None else len(self.chain.joints)
            like = like_joints(log.names, count)
            advice = option(like or ('q*',), like.values() or ('NAME*',))
            if not like:
                advice += ' (program: write its joint values to a table, a row for each pose)'
            advice = f'give {advice} or --joints-preset'
            raise InputError(f'{log.path} has no column q1; {log.has}: {advice}')
        matched, partners = _partners(table, log)
        if not {*MEASURED_COLUMNS} & {*made.cells}:
            raise InputError(
                f'{table.path} has no column x, y, z; {table.has}. '
                f'{named_by_option(table.names, POSITION, 0)}'
            )
        if len(partners) != len(made.lines):
            raise InputError(
                f'{log.path} has {len(joints.lines)} rows, {table.path} has {len(made.lines)}: '
                'give both a column that names the poses, or a row for each measurement (rows '
                'without values do not count). Times are not interpolated: keep one row for each '
                'stop, or record both in a bag'
            )
        joints = joints.select(partners)
        for ours in filter(re.compile('q[0-9]+').fullmatch, joints.cells):
            joints.refuse(joints.blank(ours), f'{ours} is blank: correct or leave out that row')
        return joints.cells, matched


class _Table:
    """A table whose columns are found: ours as expressions of theirs, by their numbers."""

    def __init__(
        self, path: Path, layout: Layout, chain: Chain | None, joints: bool, unclear: str = ''
    ) -> None:
        alone = bool(unclear)  # without measurements, beside a table with that decimal sign
        self.path, self._layout, self._chain = path, layout, chain
        most = MOST_NAMES if chain is None else len(chain.joints)
        asked: dict[str, Expression] = {}
        needed, optional = dict[str, None](), set[str]()
        for ours, theirs in layout.columns.items():
            of_joint = JOINT.fullmatch(ours)
            if not (joints and int(ours[1:]) <= most if of_joint else not alone):
                continue
            asked[ours] = (Expression.word if ours in WORDS else Expression.parse)(theirs)
            if chain is None and of_joint:  # as many as there are
                optional |= {*asked[ours].names}
            if chain is not None or not of_joint or ours == 'q1':
                needed |= dict.fromkeys(asked[ours].names)
        own: dict[str, str] = {}  # names that need no layout, and ours
        called = chain.joint_names if joints and chain is not None else ()
        ours_of = joint_columns(len(called))
        if joints:
            own = {name: name for name in joint_columns(most, 'qsva')}
            own |= zip(called, ours_of, strict=True)
        if not alone:
            own |= {name: name for name in (*NUMBERS, *WORDS)}
        self._sheet = read_sheet(path, layout, list(needed), own, unclear or '.')
        self.names = tuple(name_and_unit(name)[0] for name in self._sheet.header)
        self.has = f'it has {listed(self._sheet.header)}'
        self.decimal = self._sheet.columns.decimal
        kept, left = without_statistics(self._sheet.columns)
        self._sheet, self.count = replace(self._sheet, columns=kept), len(kept.lines)
        self.notes = [*self._sheet.notes, *left]
        self._columns = self._asked(asked, optional)
        low = {name.lower() for name in self.names}
        if {*map(str.lower, called)} <= low and not {*ours_of} <= low:  # q1 ... of a quaternion
            own = {name: own[name] for name in own if name not in {*ours_of} - {*called}}
        if not alone:
            own |= {name: ours for ours, name in quaternions_in(self.names).items()}
        taken = TURNS if {*IN_TURN} & {*asked} else IN_TURN * bool({*TURNS} & {*asked})  # r1=rx
        named = self._named({n: ours for n, ours in own.items() if ours not in (*asked, *taken)})
        self._columns |= named
        if joints and chain is not None:
            self._refuse_partial(chain)
        self._refuse_nominal(named)
        self._used = {name for each in self._columns.values() for name in each.names}
        self._leave_turns(named)

    def _asked(self, asked: Mapping[str, Expression], optional: set[str]) -> dict[str, Expression]:
        """Return the expressions whose columns are there; others must be optional."""
        kept, absent = {}, []
        for ours, each in asked.items():
            numbers = {name: self._sheet.number(name) for name in each.names}
            missing = [name for name, number in numbers.items() if number is None]
            if not missing:
                terms = tuple(numbers[t] or t if isinstance(t, str) else t for t in each.terms)
                kept[ours] = replace(each, terms=terms)
            elif not {*missing} <= optional:
                raise InputError(
                    f'{self.path} has no column {", ".join(missing)} for {ours}; {self.has}'
                )
            else:
                absent.append(f'{ours} ({", ".join(missing)})')
        if 0 < len(absent) <= 5:  # `q*=A*` names more than there are
            self.notes.append(f'it has no {", ".join(absent)}: left out')
        return kept

    def _named(self, own: Mapping[str, str]) -> dict[str, Expression]:
        """Return more of our columns, that the header calls by our names or the chain's."""
        kept, guessed = dict[str, Expression](), dict[str, str]()
        asked = {name for each in self._columns.values() for name in each.names}
        lower = [name.lower() for name in self._sheet.header]
        theirs = {*map(str.lower, self._chain.joint_names)} if self._chain else set[str]()
        for name, ours in own.items():
            found = places(self._sheet.header, name) or places(lower, name.lower())
            again = len(found) > 1 and ours not in (*WORDS, *QUATERNION)
            if ours in kept or ours in self._columns or not found or again:
                continue
            column = only_index(found, name)
            bare, unit = name_and_unit(self._sheet.header[column])
            rate = JOINT.fullmatch(ours) and ours[0] in 'sva'
            other = rate or ours in (*WORDS, *SIGMAS, 'time', 'delay')
            number = f'#{column + 1}'
            if (rate and (bare != name or number in asked or name in theirs)) or (
                other and unit not in (*UNIT_SIGNS, *SECONDS)
            ):
                continue  # the axes of KUKA are A1, a1, ...: no accelerations
            if ours == 'time' and math.isinf(self._first(number)):  # a date
                continue
            kept[ours] = Expression.parse(number)
            if name != ours:
                guessed[ours] = f'{ours} = {name}'
        known = self._columns | kept
        measured = {name for ours in POSITION if ours in known for name in known[ours].names}
        for ours in [ours for ours in guessed if measured & {*kept[ours].names}]:
            del kept[ours], guessed[ours]  # of a gantry: no column is both
        if len({*SOCKETS[:2]} & {*known}) == 1:  # a location may be anything
            kept = {ours: each for ours, each in kept.items() if ours not in SOCKETS[:2]}
        if guessed:
            self.notes.append(f'by their names, {", ".join(guessed.values())}')
        return kept

    def _leave_turns(self, named: Mapping[str, Expression]) -> None:
        """Leave out rx, ry, rz taken by our names if nobody told what they are, with a note."""
        told = self._layout.euler or self._layout.rotation_vector or self._layout.inverse
        others = {*QUATERNION, *MATRIX} & {*self._columns}
        if not (told or others) and {*TURNS} <= {*named} and {*POSITION} <= {*self._columns}:
            left = {*TURNS, *SIGMAS[3:]} & {*named}
            self._columns = {n: each for n, each in self._columns.items() if n not in left}
            self.notes.append(TURNS_LEFT)

    def _refuse_nominal(self, named: Mapping[str, Expression]) -> None:
        """Refuse columns taken by our names if they may be nominal ones."""
        called = [self._sheet.called(named[n].names[0]) for n in POSITION if n in named]
        joints = len({*named} & {*joint_columns(MOST_NAMES)}) * ('q1' in named)
        theirs = {*self._chain.joint_names} - {*named} if self._chain else set[str]()
        header = [name for name in self.names if name not in theirs]  # X of a gantry is its joint
        if doubt := in_doubt(header, [name_and_unit(name)[0] for name in called], joints):
            raise InputError(f'{self.path}: {doubt}')

    def _refuse_partial(self, chain: Chain) -> None:
        """Refuse a table with the values of some joints; those of coupled ones do not count."""
        names = joint_columns(len(chain.joints))
        given = [name for name in names if name in self._columns]
        called = all(named_in(self.names, name) for name in chain.joint_names)
        if not given and not called and not {*map(str.lower, chain.joint_names)} & {*NUMBERS}:
            return
        still = {names[k]: Expression.parse('0') for k in coupled(chain)}
        self._columns = still | self._columns
        if missing := [name for name in names if name not in self._columns]:
            missing += [] if {*MEASURED_COLUMNS} & {*self._columns} else POSITION
            advice = named_by_option(self.names, missing, len(names), chain.joint_names)
            moving = [name for name in names if name not in still]
            if len(given) == len(moving):  # of an arm whose hand is kept level
                pairs = [(a, b) for a, b in zip(moving, given, strict=True) if a != b]
                texts = [f'{a}={self._columns[b].text}' for a, b in pairs]
                texts += [f'{a}=0' for a in still]
                advice = f'If these are the joints with motors: --columns "{",".join(texts)}"'
            raise InputError(
                f'{self.path} has no column for {", ".join(missing)}; {self.has}. {advice}'
            )

    def _first(self, number: str) -> float:
        """Return the number in the first cell of a column, as `cell_number`."""
        sheet = self._sheet.columns
        return cell_number(next(iter(sheet.texts(number)), ''), sheet.decimal)

    def unread(self) -> list[str]:
        """Return the names of the columns that nothing is made of."""
        return [name for k, name in enumerate(self._sheet.header, 1) if f'#{k}' not in self._used]

    def labels(self, other: _Table) -> Iterator[tuple[str, str, list[str]]]:
        """Yield columns that may name the poses of both tables: a kind, the name, and the cells.

        Numbers name them under one name, their kind. Capitals, leading zeros and the signs in
        names may differ: P[1], p_01. A::T::p1 of SpatialAnalyzer may be p1, too.
        """
        theirs = {name.lower() for name in other._sheet.header}
        for k, name in enumerate(self._sheet.header, start=1):
            number = math.isfinite(self._first(f'#{k}'))
            if name and (not number or name.lower() in theirs):
                cells = self._sheet.columns.texts(f'#{k}')
                last = [cell.rpartition('::')[2] for cell in cells]
                for form in (cells, last)[: 1 + (last != cells)]:
                    bare = [LEADING_ZEROS.sub('', c.lower()).removesuffix('.0') for c in form]
                    if not number:
                        bare = ['.'.join(PARTS.findall(cell)) or cell for cell in bare]
                    yield name.lower() if number else '', name, bare

    def numbered(self) -> Iterator[tuple[str, list[str]]]:
        """Yield columns of names with a number, or of numbers that count, and these numbers.

        Numbers that are read count nothing.
        """
        for k, name in enumerate(self._sheet.header, start=1):
            if f'#{k}' in self._used:
                continue
            cells = self._sheet.columns.texts(f'#{k}')
            found = takewhile(bool, map(NUMBERED.fullmatch, cells))
            numbers = [each[1] for each in found if each]
            if len(numbers) == len(cells) and len({*numbers}) > len(POSITION):
                yield name or f'#{k}', numbers

    def columns(self) -> Columns:
        """Return our columns: words, and numbers in m and rad."""
        sheet, ours_in = self._sheet.columns, self._columns
        words = {ours: sheet.cells[ours_in[ours].names[0]] for ours in WORDS if ours in ours_in}
        made = Columns(self.path, sheet.lines, words, self.names)
        expressions = {ours: each for ours, each in ours_in.items() if ours not in WORDS}
        numbers = list(dict.fromkeys(n for each in expressions.values() for n in each.names))
        read = sheet.numbers(numbers, [self._sheet.called(n) or n for n in numbers])
        columns = dict(zip(numbers, read.T, strict=True))
        units = Units(self._sheet, expressions, self._layout, self._chain)
        self.notes += units.notes
        found = {}
        for ours, each in expressions.items():
            value = np.broadcast_to(each.of(columns), len(sheet.lines))
            found[ours] = value * units.factors.get(ours, 1.0)
            made.refuse(np.isinf(found[ours]), f'{ours} = {each.text} is infinite')
        return replace(made, cells={**words, **found})


def _partners(table: _Table, log: _Table) -> tuple[str, Index]:
    """Return a column that names the poses of both, if any, and the row in the log of each.

    If one names most, the others are refused. Numbers may count rows: words come first.
    """
    refused = ''
    first = sorted(table.labels(log), key=lambda each: each[0] != '')
    both = product(first, [*log.labels(table)])
    for (kind, name, named), (same, theirs, logged) in both:
        if kind != same or (kind and refused):
            continue
        ours, others = Counter(named), Counter(logged)
        again = sum(count for count in ours.values() if count > 1)
        often = 2 * again >= len(named) and (not kind or 2 * len(ours) >= len(logged))
        wrong = [cell for cell in named if others[cell] != 1 or not (often or ours[cell] == 1)]
        if not wrong:
            rows = {cell: row for row, cell in enumerate(logged)}
            return name, np.array([rows[cell] for cell in named])
        if 2 * len(wrong) < len(named):
            refused = refused or (
                f'{table.path}: "{wrong[0]}" of its column {name} must be in one row here and in '
                f'one of {log.path} (column {theirs}): correct it or leave it out; if all rows '
                'stand side by side, leave that column out of one of them'
            )
    if refused:
        raise InputError(refused)
    return _by_numbers(table, log)


def _by_numbers(table: _Table, log: _Table) -> tuple[str, Index]:
    """Return rows side by side, or, if some were left out, of one number in names (7, Motion7)."""
    both = [*product(table.numbered(), log.numbered())]
    if any(numbers == logged for (_, numbers), (_, logged) in both):
        return '', np.arange(log.count)
    for (name, numbers), (theirs, logged) in both:
        if Counter(numbers) == Counter(logged):
            raise InputError(
                f'the numbers in the column {name} of {table.path} come in another order in the '
                f'column {theirs} of {log.path}: if they name the poses, write the same names, '
                'each once, below the same header; if all rows stand side by side, leave one of '
                'these columns out'
            )
        skip = np.ptp(np.array(numbers, float)) >= len(numbers) == len({*numbers})
        rows = {number: row for row, number in enumerate(logged)}
        if skip and rows.keys() >= {*numbers} and len(rows) == len(logged):
            return name, np.array([rows[number] for number in numbers])
    return '', np.arange(log.count)


def _shifted(made: Columns, shift: int) -> Columns:
    count = len(made.lines)
    if abs(shift) >= count:
        raise ConfigError(f'--shift {shift} leaves none of {count} rows')
    measured = made.select(slice(max(0, -shift), count - max(0, shift)))
    joints = made.select(slice(max(0, shift), count - max(0, -shift)))
    moved = {name: given for name, given in joints.cells.items() if JOINT.fullmatch(name)}
    return replace(measured, cells={**measured.cells, **moved})
