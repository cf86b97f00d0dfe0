# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Layouts of tables from other systems (docs/tables.md).

A layout gives expressions of their columns for ours (q1, x, qw ...), units, and the form of
rotations. Presets are layouts in YAML files; a user's own is named by its path.

Rotations become quaternions, standard deviations covariances. XYZ are turns about the axes as
turned before, R = Rx(r1) Ry(r2) Rz(r3); xyz about fixed ones, which is ZYX in the other order.
Standard deviations s of Euler angles make the covariance J diag(s^2) J' of the rotation about the
device's axes: the columns of J are the axes about which the angles turn, e1, R1 e2, R1 R2 e3. For
a rotation vector v it is J_l(v), for quaternions the standard deviations are those about the
device's axes.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.errors import LONGEST_NAME, MOST_ENTRIES, ConfigError, InputError, UnknownNameError
from calib_ros.estimation.observations import Observations
from calib_ros.files.columns import BETWEEN, Columns, check_quaternions
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import TWO_TURNS, shared_files
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.texts import parse_yaml, read_text
from calib_ros.values import MOST_NAMES, ROUNDED, parse_mapping

LENGTHS = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'um': 1e-6, 'in': 0.0254}
"""Metres in units of length."""
ANGLES = {'rad': 1.0, 'deg': np.pi / 180.0}  # radians in units of angle
SEPARATORS = {'comma': ',', 'semicolon': ';', 'tab': '\t', 'space': ' '}
POSITION, QUATERNION = ('x', 'y', 'z'), ('qx', 'qy', 'qz', 'qw')
UPPER = tuple((i, j) for i in range(6) for j in range(i, 6))
COVARIANCE = tuple(f'c{i + 1}{j + 1}' for i, j in UPPER)
TURNS = ('rx', 'ry', 'rz')
"""Angles about x, y, z of three different letters, or a rotation vector."""
IN_TURN = ('r1', 'r2', 'r3')  # Euler angles in the order of the letters
MATRIX = tuple(f'r{i}{j}' for i in (1, 2, 3) for j in (1, 2, 3))
"""Rotation matrices, row by row."""
SIGMAS = ('sx', 'sy', 'sz', 'srx', 'sry', 'srz')
"""Standard deviations of x y z, and of rx ry rz (or about x y z of the device)."""
WORDS = ('session', 'device', 'target', 'frame_id', 'split', 'eye_in_hand', 'stamp_ns')  # as text
ROTATION = (*QUATERNION, *TURNS, *IN_TURN, *MATRIX)
NUMBERS = (*POSITION, *ROTATION, *SIGMAS, 'distance', 'time', 'delay')
UNREADABLE = (
    '"{}" is not an expression of columns: give names, {{names with blanks}} or column '
    'numbers (#7) with + - * / and brackets'
)
TOKEN = re.compile(
    r'\s*(?:\{([^{}]+)\}|#([0-9]+)|((?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)'
    r'|([^\W\d]\w*(?:\.\w+)*)|([-+*/()]))\s*'
)
"""{any name}, #7 (a column number), a number, a plain name, or an operator."""
SIGNS: dict[type[ast.AST], Callable[..., Any]]
SIGNS = {ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.true_divide}
SIGNS |= {ast.UAdd: np.positive, ast.USub: np.negative}
JOINT = re.compile('[qsva][0-9]+')
"""Columns with a number of each joint: values, signs of last moves, and rates."""


def joint_columns(joints: int, letter: str = 'q') -> tuple[str, ...]:
    """Return the columns with a number of each joint."""
    return tuple(f'{letter}{k + 1}' for k in range(joints))


@dataclass(frozen=True)
class Expression:
    """A sum, difference, product or quotient of columns and numbers."""

    text: str
    terms: tuple[str | float, ...]  # columns by their names (`#7` is the seventh) and numbers
    tree: ast.expr  # with the terms as `_0`, `_1` and so on

    @classmethod
    def parse(cls, text: str) -> Expression:
        """Parse an expression."""
        terms: list[str | float] = []
        code, at = '', 0
        while at < len(text):
            match = TOKEN.match(text, at)
            if match is None or len(text) > LONGEST_NAME:
                raise ConfigError(UNREADABLE.format(text))
            braced, column, number, plain, sign = match.groups()
            if not sign:
                name = braced or plain or f'#{column}'
                terms.append(float(number) if number else name)
            code += sign or f' _{len(terms) - 1} '
            at = match.end()
        try:
            found = cls(text, tuple(terms), ast.parse(code.strip(), mode='eval').body)
            found.of(dict.fromkeys(found.names, np.ones(1)))
        except (SyntaxError, ValueError, KeyError, RecursionError, MemoryError) as err:
            raise ConfigError(UNREADABLE.format(text)) from err
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(dict.fromkeys(each for each in self.terms if isinstance(each, str)))

    def of(self, columns: Mapping[str, FloatArray]) -> FloatArray:
        """Return the value (N,) for columns (N,) by name."""
        values = [columns[each] if isinstance(each, str) else each for each in self.terms]
        with np.errstate(all='ignore'):
            return np.asarray(_value(self.tree, values))


def _value(tree: ast.expr, terms: Sequence[FloatArray | float]) -> Any:
    if isinstance(tree, ast.BinOp):
        return SIGNS[type(tree.op)](_value(tree.left, terms), _value(tree.right, terms))
    if isinstance(tree, ast.UnaryOp):
        return SIGNS[type(tree.op)](_value(tree.operand, terms))
    if not isinstance(tree, ast.Name):
        raise ValueError(type(tree).__name__)
    return terms[int(tree.id[1:])]


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

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name != 'columns' and type(value) is not type(item.default):
                raise ConfigError(
                    f'"{item.name}" of a layout must be a {item.type}, not {value!r}'
                )
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
        if not isinstance(self.columns, Mapping) or len(self.columns) > MOST_ENTRIES:
            raise ConfigError(
                '"columns" of a layout must map our columns to expressions of theirs'
            )
        for name in self.columns:
            if name not in (*NUMBERS, *WORDS) and not JOINT.fullmatch(name):
                raise UnknownNameError('column', name, ('q1', *NUMBERS, *WORDS))

    @property
    def cut(self) -> str:
        """Return the character between cells, empty to guess it."""
        return SEPARATORS.get(self.separator, self.separator)


def presets() -> dict[str, Path]:
    """Return the supplied layouts by name."""
    return shared_files('tables')


def load_layout(name_or_path: str) -> Layout:
    """Return a preset, or the layout in a YAML file."""
    path = Path(name_or_path)
    if path.suffix not in ('.yaml', '.yml'):
        shipped = presets()
        if name_or_path not in shipped:
            raise UnknownNameError('preset (or path of a .yaml)', name_or_path, sorted(shipped))
        path = shipped[name_or_path]
    known = [item.name for item in fields(Layout)]
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


def _in_their_names(text: str, known: Mapping[str, str]) -> str:
    """Return an expression with our columns that are `known` written in theirs."""

    def written(match: re.Match[str]) -> str:
        theirs = known.get(match[4] or '')
        return match[0] if theirs is None else f'({theirs})'

    return TOKEN.sub(written, text)


def layout_of(preset: str, columns: Sequence[str], given: Mapping[str, Any]) -> Layout:
    """Return the layout of a preset, if any, with the given values on top.

    Later `columns` may use our names of earlier ones: `q*=J*`, then `q3=q3+q2`. Of one text, a
    name that comes again begins the later ones.
    """
    layout = load_layout(preset) if preset else Layout()
    changes = {name: value for name, value in given.items() if value}
    for name in ('euler', 'quaternion', 'rotation_vector'):
        if name in changes:  # instead of the preset's way
            layout = replace(layout, euler='', quaternion='', rotation_vector=False)
    merged = dict(layout.columns)
    for text in columns:
        known, defined = dict(merged), set[str]()
        for ours, theirs in parse_columns(text):
            if ours in defined:
                known, defined = dict(merged), set()
            merged[ours] = theirs if ours in WORDS else _in_their_names(theirs, known)
            defined.add(ours)
    return replace(layout, columns=merged, **changes)


def finished(made: Columns, layout: Layout) -> Columns:
    """Return the columns with quaternions for rotations, covariances for standard deviations."""
    path, values, words = made.path, dict(made.values), dict(made.words)
    time = values.pop('time', None)
    if time is not None:
        for line in made.lines[~(np.abs(time) <= 9e9)][:1].tolist():
            raise InputError(
                f'{path}, line {line}: time [s] must be a number of at most 9e9: if it is in ms, '
                'give --columns time=NAME/1000'
            )
        words['stamp_ns'] = BETWEEN.join(str(round(each * 1e9)) for each in time.tolist())
    rotation, axes = _rotations(values, layout, made)
    sigmas = [values.pop(name, None) for name in SIGMAS]
    for name in (*TURNS, *IN_TURN, *MATRIX):
        values.pop(name, None)
    covariance = _covariance(sigmas, axes, path)
    if layout.inverse:
        if rotation is None or not set(POSITION) <= set(values):
            raise ConfigError('--inverse needs poses with their rotations')
        given = np.column_stack([values[name] for name in POSITION])
        poses = Observations.from_arrays(np.zeros((len(given), 1)), given, rotation)
        turned = replace(poses, covariance=covariance).inverted()
        values |= dict(zip(POSITION, turned.positions.T, strict=True))
        rotation, covariance = turned.rotations, turned.covariance
    if rotation is not None:
        values |= dict(zip(QUATERNION, se3.to_quat(rotation).T, strict=True))
    if covariance is not None:
        rows, columns = np.transpose(UPPER)
        values |= dict(zip(COVARIANCE, covariance[:, rows, columns].T, strict=True))
    return replace(made, values=values, words=words)


def _rotations(
    values: dict[str, FloatArray], layout: Layout, made: Columns
) -> tuple[FloatArray | None, FloatArray | None]:
    """Return rotations (N, 3, 3), and the axes (N, 3, 3) of their sigmas in columns, or None."""
    if set(QUATERNION) & set(values):
        return _from_quaternions(values, layout, made)
    if set(MATRIX) & set(values) and not (layout.euler or layout.rotation_vector):
        return _from_matrices(values, made)
    three = [each for each in (TURNS, IN_TURN) if set(each) & set(values)]
    if not three:
        for name in ('euler', 'rotation_vector', 'quaternion'):
            if getattr(layout, name):
                raise ConfigError(
                    f'{made.path}: {name.replace("_", " ")} is given, but no columns: --columns '
                    'rx=NAME,ry=NAME,rz=NAME (or qx, qy, qz, qw)'
                )
        return None, None
    names, called = three[0], ', '.join(three[0])
    if len(three) > 1:
        raise ConfigError(f'{made.path}: give rx, ry, rz or r1, r2, r3, not both')
    angles = _whole(values, names, made, 'Euler angles and rotation vectors have three columns')
    for row in np.flatnonzero(np.abs(angles).max(axis=1) > TWO_TURNS)[:1].tolist():
        raise InputError(
            f'{made.where(row, called)} are angles of up to '
            f'{np.abs(angles[row]).max():.6g} rad: if they are in degrees, give --angle deg '
            '(and --joint-angle rad if the joint values are in radians)'
        )
    if layout.rotation_vector:
        left = np.linalg.inv(se3.left_jacobian_inverse(angles))
        return se3.exp_rotation(angles), np.asarray(left)
    if not layout.euler:
        raise ConfigError(
            f'{made.path} has {called}: say which, --euler XYZ (ZYX, zyx ...) or --rotation-vector'
        )
    return _from_euler(angles, layout.euler, names)


def _from_euler(
    angles: FloatArray, letters: str, names: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Return rotations, and the axes of angles (N, 3) about the axes named by letters."""
    if names == TURNS:
        if len(set(letters.upper())) < 3:
            raise ConfigError(
                f'with --euler {letters} an axis comes twice: give r1, r2, r3 in its order'
            )
        angles = angles[:, ['XYZ'.index(letter) for letter in letters.upper()]]
    axes = np.zeros((len(angles), 3, 3))
    turned = np.tile(np.eye(3), (len(angles), 1, 1))
    for k in range(3) if letters.isupper() else (2, 1, 0):
        unit = 'XYZ'.index(letters[k].upper())
        axes[:, :, k] = turned[:, :, unit]
        turned = turned @ se3.exp_rotation(np.eye(3)[unit] * angles[:, k, np.newaxis])
    if names == TURNS:  # order rx, ry, rz
        axes = axes[:, :, [letters.upper().index(letter) for letter in 'XYZ']]
    return turned, axes


def _from_quaternions(
    values: dict[str, FloatArray], layout: Layout, made: Columns
) -> tuple[FloatArray, FloatArray]:
    quat = _whole(values, QUATERNION, made, 'a quaternion has four columns')
    if layout.quaternion == 'wxyz':
        quat = quat[:, [1, 2, 3, 0]]
    check_quaternions(made, quat)
    return se3.from_quat(quat), np.tile(np.eye(3), (len(quat), 1, 1))


def _from_matrices(values: dict[str, FloatArray], made: Columns) -> tuple[FloatArray, FloatArray]:
    given = _whole(values, MATRIX, made, 'a rotation matrix has nine columns').reshape(-1, 3, 3)
    rotations = se3.nearest_rotation(given)
    for row in np.flatnonzero(np.abs(given - rotations).max(axis=(1, 2)) > ROUNDED)[:1].tolist():
        raise InputError(
            f'{made.where(row, "r11 ... r33")} are no rotation: check the order of the columns, '
            'and that the axes are right-handed'
        )
    return rotations, np.tile(np.eye(3), (len(given), 1, 1))


def _whole(
    values: dict[str, FloatArray], names: Sequence[str], made: Columns, what: str
) -> FloatArray:
    """Return the values (N, len(names)) of columns that belong together."""
    if missing := [name for name in names if name not in values]:
        raise ConfigError(f'{made.path}: {what}, missing {", ".join(missing)}')
    found = np.column_stack([values[name] for name in names])
    for row in np.flatnonzero(np.isnan(found).any(axis=1))[:1].tolist():
        raise InputError(f'{made.where(row, ", ".join(names))} must be numbers, not blank')
    return found


def _covariance(
    sigmas: Sequence[FloatArray | None], axes: FloatArray | None, path: Path
) -> FloatArray | None:
    """Return covariances (N, 6, 6) of standard deviations (N,), or None."""
    place, turn = ([x for x in each if x is not None] for each in (sigmas[:3], sigmas[3:]))
    if not place and not turn:
        return None
    if len(place) < 3:
        raise ConfigError(f'{path}: standard deviations need sx, sy and sz')
    if turn and (len(turn) < 3 or axes is None):
        raise ConfigError(
            f'{path}: standard deviations of rotations need srx, sry, srz, and rotations'
        )
    found = np.zeros((len(place[0]), 6, 6))
    found[:, :3, :3] = np.square(np.column_stack(place))[:, :, np.newaxis] * np.eye(3)
    if turn and axes is not None:
        scaled = axes * np.column_stack(turn)[:, np.newaxis, :]
        found[:, 3:, 3:] = scaled @ np.swapaxes(scaled, 1, 2)
    return found
