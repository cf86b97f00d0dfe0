# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Robot programs in files: tables of joint values (CSV) and JointTrajectory messages (YAML).

What is not a joint value, velocity or acceleration of the arm is written as it was read.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.apply.program import Program
from calib_ros.errors import InputError
from calib_ros.files.csv_columns import columns_of
from calib_ros.files.layouts import joint_columns
from calib_ros.files.waypoints import header_of, joint_values
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.texts import LARGEST_TABLE, LARGEST_TEXT, csv_text, dump_yaml, parse_yaml, read_text
from calib_ros.values import parse_numbers

RATES = ('positions', 'velocities', 'accelerations')
"""What a point of a JointTrajectory holds that a correction changes."""


@dataclass(frozen=True, eq=False)
class ProgramFile:
    """A program, where each of its samples stands in the file, and how to write it again."""

    program: Program
    places: tuple[str, ...]
    text_with: Callable[[Program], str]


def read_program(path: Path, joints: Sequence[str]) -> ProgramFile:
    """Read a program for an arm with the named joints: CSV, or YAML by the file's suffix.

    CSV: joint values in q1 ... qn, or in columns with the joints' names; s1 ... sn, if present,
    are the signs of the joints' last moves. YAML: a trajectory_msgs/JointTrajectory as `ros2 topic
    echo` prints it.
    """
    readers = {'.csv': _read_csv, '.yaml': _read_yaml, '.yml': _read_yaml}
    if path.suffix.lower() not in readers:
        raise InputError(
            f'{path} must be a table (.csv with q1 ... qn) or a JointTrajectory (.yaml)'
        )
    reader = readers[path.suffix.lower()]
    largest = LARGEST_TABLE if reader is _read_csv else LARGEST_TEXT
    return reader(read_text(path, largest, InputError), path, joints)


def _read_csv(text: str, path: Path, joints: Sequence[str]) -> ProgramFile:
    found = columns_of(path, text.encode())
    positions = joint_values(found, joints)
    signs = joint_columns(len(joints), 's')
    signed = set(signs) <= set(found.header)
    approach = np.sign(found.block(signs)) if signed else None

    def text_with(corrected: Program) -> str:
        header, *rows = (row for row in csv.reader(io.StringIO(text, newline='')) if row)
        at = [found.header.index(name) for name in header_of(found, joints)]
        for row, values in zip(rows, corrected.positions.tolist(), strict=True):
            for k, value in zip(at, values, strict=True):
                row[k] = repr(value)
        return csv_text([header, *rows])

    places = tuple(f'line {line}' for line in found.lines)
    return ProgramFile(Program(tuple(joints), positions, approach=approach), places, text_with)


def _read_yaml(text: str, path: Path, joints: Sequence[str]) -> ProgramFile:

    where = str(path)
    message = parse_yaml(text, where, InputError)
    names = message.get('joint_names') if isinstance(message, dict) else None
    points = message.get('points') if isinstance(message, dict) else None
    if not isinstance(names, list) or not isinstance(points, list) or not points:
        raise InputError(
            f'{where} must be a trajectory_msgs/JointTrajectory with joint_names and points'
        )
    for k, point in enumerate(points):
        if not isinstance(point, dict):
            raise InputError(
                f'{where}, point {k + 1} must be a mapping, not {point!r}; a message that was cut '
                'short is printed as a whole by ros2 topic echo --full-length'
            )
    program = trajectory_program(names, points, where)

    def text_with(corrected: Program) -> str:
        arrays = {
            key: array.tolist() for key in RATES if (array := getattr(corrected, key)) is not None
        }
        new = [
            point | {key: rows[k] for key, rows in arrays.items()}
            for k, point in enumerate(points)
        ]
        return dump_yaml(message | {'points': new})

    return ProgramFile(program, tuple(f'point {k + 1}' for k in range(len(points))), text_with)


def trajectory_program(
    names: Sequence[object], points: Sequence[Mapping[str, Any]], where: str
) -> Program:
    """Return the program of a JointTrajectory: joint names, and points with lists of numbers.

    Velocities and accelerations are those of all points or of none.
    """

    def values(key: str) -> FloatArray | None:
        given = [point.get(key) or [] for point in points]
        if not any(given):
            return None
        return np.array(
            [
                parse_numbers(row, len(names), f'{where}, point {k + 1}: {key}', InputError)
                for k, row in enumerate(given)
            ]
        )

    positions = values('positions')
    if positions is None:
        raise InputError(f'{where} has no positions')
    return Program(
        tuple(map(str, names)), positions, values('velocities'), values('accelerations')
    )
