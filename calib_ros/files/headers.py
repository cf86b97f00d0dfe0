# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Names in the header of a table: their units, which are not read, and options for the missing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from calib_ros.errors import LONGEST, ColumnsError, InputError, shortened
from calib_ros.files.names import (
    MEASURED_WORDS,
    NO_PLACE,
    NOMINAL_WORDS,
    distance_in,
    groups,
    like_joints,
    matrix_in,
    named_in,
    numbers_in,
    option,
    positions_in,
    quaternions_in,
    words_of,
)
from calib_ros.files.vocabulary import (
    COVARIANCE,
    NUMBERS,
    POSITION,
    SEPARATORS,
    UNIT,
    UNIT_SIGNS,
    WORDS,
    joint_columns,
)
from calib_ros.shown import some

SEVERAL_POINTS = '; give one of several points, or a row for each, named in a column target'
OTHER_ARM = 'Is it another arm (--chain)? '
OF_ABB = 'If q1 to q4 are a quaternion, give the joint values (--joints FILE). '
TURNS_LEFT = 'rx, ry, rz are left out: give --euler or --rotation-vector to use them'
IN_ANOTHER_TABLE = '; are they in another file or sheet? Give that one, and this as --joints'


def name_and_unit(cell: str) -> tuple[str, str]:
    """Return the name of a column, and its unit if the header says it, or another in brackets."""
    match = UNIT.fullmatch(cell)
    unit = '' if match is None else next(filter(None, match.groups()[1:])).strip()
    if match is None or {*words_of(unit)} & (MEASURED_WORDS | NOMINAL_WORDS):
        return cell, ''
    return match[1].removesuffix(' in'), UNIT_SIGNS.get(unit.lower(), unit)


def places(header: Sequence[str], name: str) -> list[int]:
    """Return the indices of the columns of a name, with or without its unit.

    Those of another form (X_mm), or with something else in brackets, only count if there are none.
    """
    parts = [(k, cell, *name_and_unit(cell)) for k, cell in enumerate(header)]
    usual = [
        k
        for k, cell, bare, unit in parts
        if name == cell
        or (name == bare and unit in UNIT_SIGNS and cell.endswith((']', ')', '\uff09')))
    ]
    return usual or [k for k, _, bare, _ in parts if name == bare]


def only_index(found: Sequence[int], name: str) -> int:
    """Return the index of a column; refuse several."""
    if len(found) > 1:
        where = ', '.join(some([f'#{k + 1}' for k in found]))
        raise InputError(
            f'column "{name}" comes {len(found)} times: name it by its number ({where})'
        )
    return found[0]


def listed(names: Sequence[str]) -> str:
    """Return the names of columns, so many that a message has room for an option, too."""
    return shortened(', '.join(filter(None, names)), LONGEST // 4) or 'nothing'


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
    for name in ('semicolon', 'tab', 'bar'):
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
    low = [name.lower() for name in header]
    if several := [name for name in missing if low.count(name) > 1]:
        ways = [[f'#{k}' for k, n in enumerate(low, 1) if n == name] for name in several]
        given = ', or '.join(option(several, each) for each in zip(*ways, strict=False))
        return (
            f'Several columns are called {", ".join(several)}: rename all but one, or give each '
            f'by its number: {given}'
        )
    if len(numbers := numbers_in(header, len(missing))) >= len(missing):
        given = option(missing, numbers[: len(missing)])
        return f'Its first line holds numbers, not names: {given}, in its order'
    names = joint_columns(joints)
    lacking = [name for name in names if name in missing]
    whole = 0 < joints == len(lacking)
    fewer = bool(lacking) and 'q1' in header and 'q0' not in header
    ours = (*names, *COVARIANCE) if fewer else ()  # q1 to q4 may be a quaternion
    like = like_joints([name for name in header if name not in ours], joints) if lacking else {}
    fewer = fewer and not like
    more = '; joint values in another file or sheet: --joints FILE' if whole and not like else ''
    found = dict.fromkeys([name for name in missing if name not in lacking], 'NAME')
    found |= positions_in(header, [name for name in POSITION if name in missing])
    if more and called:
        theirs = [each for each in header if each and each.lower() not in (*NUMBERS, *WORDS)]
        if len(theirs) != joints or not {*POSITION} <= {*header}:
            theirs = [named_in(header, name) for name in called]
        if all(theirs):
            like, free = dict(zip(names, theirs, strict=True)), {*header} - {*theirs}
            found |= {n: 'NAME' for n in POSITION if not {n, found.get(n, '')} & free}
    if {*POSITION} <= {*missing}:
        if found['x'] != 'NAME':
            found |= quaternions_in(header, sure=False)
        elif other := matrix_in(header) or distance_in(header):
            found = {n: each for n, each in found.items() if n not in POSITION} | other
        elif joints and not lacking:
            points = len(groups(header, POSITION, without=NO_PLACE))
            more = SEVERAL_POINTS if points > 1 else IN_ANOTHER_TABLE
    # X_in is not read as a unit
    if (unit := words_of(found.get('x', ''))[1:]) in (['m'], ['in'], ['ft']):
        more = f' --length {unit[0]}{more}'
    found = (like or ({'q*': 'NAME*'} if whole else dict.fromkeys(lacking, 'NAME'))) | found
    given = option(found, found.values())
    if len(given) > LONGEST // 3 or '{' in ''.join(found.values()):  # cut, or not readable
        short = {name: f'#{k}' for k, name in reversed([*enumerate(header, 1)])}
        given = option(found, [short.get(each, each) for each in found.values()])
    perhaps = OTHER_ARM + OF_ABB * ([*names[4:]] == lacking)
    return f'{perhaps * fewer}Columns of other names: {given}{more}'
