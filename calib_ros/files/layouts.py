# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Layouts of tables from other systems (docs/tables.md).

A layout gives expressions of their columns for ours (q1, x, qw ...), units, and the form of
rotations. Presets are layouts in YAML files; a user's own is named by its path.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from calib_ros.annotated import check_fields
from calib_ros.errors import MOST_ENTRIES, ConfigError, UnknownNameError
from calib_ros.files.expressions import in_their_names
from calib_ros.files.vocabulary import (
    ANGLES,
    IN_TURN,
    JOINT,
    LENGTHS,
    MATRIX,
    NUMBERS,
    QUATERNION,
    SEPARATORS,
    TURNS,
    WORDS,
    joint_columns,
)
from calib_ros.kinematics.chain_file import shared_files
from calib_ros.texts import parse_yaml, read_text
from calib_ros.values import MOST_NAMES, parse_mapping


@dataclass(frozen=True)
class Layout:
    """The layout of a table; empty fields are guessed or absent."""

    description: str = ''
    source: str = ''  # documentation of the format
    separator: str = ''  # between cells: comma, semicolon, tab or space
    decimal: str = ''  # '.' or ','
    columns: Mapping[str, str] = field(default_factory=dict)  # ours as expressions of theirs
    length: str = ''
    angle: str = ''  # unit of Euler angles and rotation vectors
    joint_angle: str = ''
    euler: str = ''  # axes: XYZ intrinsic, xyz extrinsic
    quaternion: str = ''  # order of the four columns qx qy qz qw, xyzw or wxyz
    rotation_vector: bool = False  # rx ry rz are one
    inverse: bool = False  # poses of the device in the target's frame
    shift: int = 0  # rows by which joint values are below their measurement
    comment: str = ''  # start of lines to ignore
    sheet: str = ''  # of a workbook
    insisted: tuple[str, ...] = ()  # options given, whose units hold against the header's

    def __post_init__(self) -> None:
        check_fields(self)
        known = {'separator': (*SEPARATORS, *SEPARATORS.values()), 'decimal': ('.', ',')}
        known |= {'length': (*LENGTHS,), 'angle': (*ANGLES,), 'joint_angle': (*ANGLES,)}
        for name, values in {**known, 'quaternion': ('xyzw', 'wxyz')}.items():
            value = getattr(self, name)
            if value and value not in values:
                raise UnknownNameError(name.replace('_', ' '), value, values)
        axes = r'(?!.?(.)\1)([XYZ]{3}|[xyz]{3})'  # none twice in a row
        if self.euler and not re.fullmatch(axes, self.euler):
            raise ConfigError(
                f'Euler angles must be three axes, ZYX (each about the axis as turned before) or '
                f'zyx (about fixed axes), not "{self.euler}"'
            )
        ways = [name for name in ('euler', 'quaternion', 'rotation_vector') if getattr(self, name)]
        if len(ways) > 1:
            raise ConfigError(f'only one form of rotation is allowed: give {" or ".join(ways)}')
        if self.decimal == ',' and self.cut == ',':
            raise ConfigError('the comma cannot separate both cells and decimals')
        if len(self.columns) > MOST_ENTRIES:
            raise ConfigError(f'columns must be at most {MOST_ENTRIES}, not {len(self.columns)}')
        for name in self.columns:
            if name not in (*NUMBERS, *WORDS) and not JOINT.fullmatch(name):
                raise UnknownNameError('column', name, ('q1', *NUMBERS, *WORDS))

    @property
    def cut(self) -> str:
        """Return the character between cells, empty to guess it."""
        return SEPARATORS.get(self.separator, self.separator)


def load_layout(name_or_path: str) -> Layout:
    """Return a preset, or the layout in a YAML file."""
    path = Path(name_or_path)
    if path.suffix not in ('.yaml', '.yml'):
        shipped = shared_files('tables')
        if name_or_path not in shipped:
            raise UnknownNameError('preset (or path of a .yaml)', name_or_path, sorted(shipped))
        path = shipped[name_or_path]
    known = [item.name for item in fields(Layout) if item.name != 'insisted']
    content = parse_mapping(parse_yaml(read_text(path), str(path)), known, str(path))
    if isinstance(columns := content.get('columns'), dict):
        content['columns'] = {str(k): str(v) for k, v in columns.items()}
    try:
        return Layout(**content)
    except ConfigError as err:
        raise ConfigError(f'{path}: {err}') from err


def parse_columns(text: str) -> Iterator[tuple[str, str]]:
    """Yield the columns of `q1=A1,x={Pos X},...`.

    `q*=A*` stands for up to 50 joints, `r*=t*` for the nine elements of a matrix.
    """
    for part in re.split(r',(?![^{]*\})', text):
        ours, equals, theirs = part.partition('=')
        ours, theirs = ours.strip(), theirs.strip()
        if not equals or not ours or not theirs:
            raise ConfigError(f'columns are given as OURS=THEIRS,..., not "{part.strip()}"')
        if re.fullmatch(r'[qsvar]\*', ours):
            for name in MATRIX if ours == 'r*' else joint_columns(MOST_NAMES, ours[0]):
                yield name, theirs.replace('*', name[1:])
        else:
            yield ours, theirs


def layout_of(preset: str, columns: Sequence[str], given: Mapping[str, Any]) -> Layout:
    """Return the layout of a preset, if any, with the given values on top.

    Later `columns` may use our names of earlier ones: `q*=J*`, then `q3=q3+q2`. Of one text, a
    name that comes again begins the later ones.
    """
    layout = load_layout(preset) if preset else Layout()
    changes = {name: value for name, value in given.items() if value}
    merged = dict(layout.columns)
    for name in ('euler', 'quaternion', 'rotation_vector'):
        if name in changes:  # instead of the preset's way, and of its columns
            layout = replace(layout, euler='', quaternion='', rotation_vector=False)
            others = (*TURNS, *IN_TURN) if name == 'quaternion' else QUATERNION
            merged = {
                ours: theirs
                for ours, theirs in merged.items()
                if ours not in others or '#' in theirs
            }
    for text in columns:
        known, defined = dict(merged), set[str]()
        for ours, theirs in parse_columns(text):
            if ours in defined:
                known, defined = dict(merged), set()
            merged[ours] = theirs if ours in WORDS else in_their_names(theirs, known)
            defined.add(ours)
    return replace(layout, columns=merged, insisted=(*changes,), **changes)
