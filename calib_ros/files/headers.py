# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Names in the header of a table: their units, which are not read, and options for the missing."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path

from calib_ros.errors import ColumnsError, InputError
from calib_ros.files.vocabulary import (
    NUMBERS,
    POSITION,
    SEPARATORS,
    UNIT,
    UNIT_SIGNS,
    WORDS,
    joint_columns,
)
from calib_ros.shown import some


def name_and_unit(cell: str) -> tuple[str, str]:
    """Return the name of a column, and its unit if the header says it, or another in brackets."""
    match = UNIT.fullmatch(cell)
    if match is None:
        return cell, ''
    unit = next(filter(None, match.groups()[1:])).strip()
    return match[1], UNIT_SIGNS.get(unit.lower(), unit)


def places(header: Sequence[str], name: str) -> list[int]:
    """Return the indices of the columns of a name, with or without its unit.

    Those of another form (X_mm), or with something else in brackets, only count if there are none.
    """
    parts = [(k, cell, *name_and_unit(cell)) for k, cell in enumerate(header)]
    usual = [
        k
        for k, cell, bare, unit in parts
        if name == cell or (name == bare and unit in UNIT_SIGNS and cell.endswith((']', ')')))
    ]
    return usual or [k for k, _, bare, _ in parts if name == bare]


def only(found: Sequence[int], name: str) -> int:
    """Return the index of a column; refuse several."""
    if len(found) > 1:
        where = ', '.join(some([f'#{k + 1}' for k in found]))
        raise InputError(
            f'column "{name}" comes {len(found)} times: name it by its number ({where})'
        )
    return found[0]


def not_read(path: Path, names: Sequence[str]) -> tuple[str, ...]:
    """Return a warning about columns that are not read, by their names in the file."""
    named = [name for name in names if name and not name.startswith('#')]
    return (
        f'{path}: columns not read: {", ".join(some(named))} (--columns OURS=NAME reads one)',
    ) * bool(named)


def joints_left_out(path: Path, header: Sequence[str], joints: int) -> tuple[str, ...]:
    """Return a warning about joint values that the arm does not have."""
    name = f'q{joints + 1}'
    told = f'{path}: the column {name} is left out: the arm has {joints} joints'
    return (told,) * (name in header)


def refuse_separator(path: Path, header: Sequence[str]) -> None:
    """Raise with advice if cells are not separated by commas."""
    for name in ('semicolon', 'tab'):
        if any(SEPARATORS[name] in cell for cell in header):
            raise ColumnsError(
                f'the cells of {path} are separated by {name}s: save it with commas between cells '
                'and points in numbers (measurements: calib_ros import)'
            )


def named_by_option(
    header: Sequence[str], missing: Sequence[str], joints: int, called: Sequence[str] = ()
) -> str:
    """Return --columns for the missing columns, with similar names of the header or NAME.

    The joints may be `called` as the positions, in a gantry: these are named too.
    """
    if several := [name for name in missing if header.count(name) > 1]:
        return f'Several columns are called {", ".join(several)}: rename all but one'
    if _only_numbers(header):
        numbers = ','.join(f'{name}=#{k}' for k, name in enumerate(missing, 1))
        return f'Its first line holds numbers, not names: --columns "{numbers}", in its order'
    found = {
        name: next((each for each in header if re.match(rf'{name}\b', each, re.I)), 'NAME')
        for name in missing
    }
    of_joints = {*joint_columns(joints)}
    lacking = of_joints & found.keys()
    whole = bool(joints) and lacking == of_joints
    fewer = bool(lacking) and 'q1' in header and 'q0' not in header
    like = like_joints(header, joints) if lacking and not fewer else {}
    more = '; joint values in another file: --joints FILE' if whole and not like else ''
    theirs = [next((each for each in header if each.lower() == n.lower()), '') for n in called]
    rest = [each for each in header if each.lower() not in (*NUMBERS, *WORDS)]
    if whole and not like and called and len(rest) == joints and {*POSITION} <= {*header}:
        like = dict(zip(joint_columns(joints), rest, strict=True))
    elif whole and not like and called and all(theirs):
        like = dict(zip(joint_columns(joints), theirs, strict=True))
        found |= {name: 'NAME' for name in POSITION if name in theirs or name not in header}
    if whole or like:
        others = {name: found[name] for name in found if name not in of_joints}
        found = {**(like or {'q*': 'NAME*'}), **others}
    given = ','.join(f'{name}={as_typed(each)}' for name, each in found.items())
    options = f'Columns of other names: --columns "{given}"{more}'
    return f'Is it another arm (--chain)? {options}' if fewer else options


def as_typed(name: str) -> str:
    """Return the name of a column as --columns takes it."""
    return name if re.fullmatch(r'[#\w.*]+', name) else f'{{{name}}}'


def _only_numbers(header: Sequence[str]) -> bool:
    return bool(header) and all(re.fullmatch(r'-?[\d.]+(e[+-]?\d+)?', name) for name in header)


def like_joints(header: Sequence[str], joints: int) -> dict[str, str]:
    """Return the names in a header that count the joints, with a star for the number from 1."""
    if _only_numbers(header):
        return {'q*': '#*'}
    for name, first in product(header, (1, 0)):
        for one in re.finditer(str(first), name):
            before, after = name[: one.start()], name[one.end() :]
            like = [f'{before}{k}{after}' for k in range(first, joints + first)]
            if {*like} <= {*header}:
                count = dict(zip(joint_columns(joints), like, strict=True))
                return {'q*': f'{before}*{after}'} if first else count
    return {}
