# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Boards, the places of their corners, and tables of corners found in images.

A board is YAML: `type, columns, rows, square, marker, dictionary`, lengths in metres.

charuco   columns x rows squares, black at the upper left, markers in the white ones; its corners
          are the inner ones, numbered row by row
markers   columns x rows markers, `square` apart; marker k has the corners 4 k ... 4 k + 3,
          clockwise from its upper left

The frame of the board has x to the right, y down and z away from the viewer; its origin is the
upper left corner of the first square or marker.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros.errors import MOST_ENTRIES, ConfigError, InputError, UnknownNameError
from calib_ros.files.columns import check_quaternions, read_columns
from calib_ros.files.headers import joints_left_out
from calib_ros.files.vocabulary import POSE_COLUMNS, joint_columns
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.texts import parse_yaml, read_text
from calib_ros.values import parse_like, parse_mapping

BOARD_TYPES = ('charuco', 'markers')
BOARD_KEYS = ('type', 'columns', 'rows', 'square', 'marker', 'dictionary', 'legacy')
POSED = 'flange_pose'  # name of the virtual arm


@dataclass(frozen=True)
class Board:
    """A flat board: sizes in metres; `legacy` has a white square at the upper left."""

    type: str
    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str
    legacy: bool = False

    def __post_init__(self) -> None:
        if self.type not in BOARD_TYPES:
            raise UnknownNameError('type of board', self.type, BOARD_TYPES)
        least = 2 if self.type == 'charuco' else 1
        for count in (self.columns, self.rows):
            if not least <= count <= MOST_ENTRIES:
                may = f'must have {least} to {MOST_ENTRIES} columns and rows'
                raise ConfigError(f'a board of type {self.type} {may}, not {count}')
        if not 0.0 < self.marker < self.square < 1.0:
            sizes = f'{self.marker:g} and {self.square:g}'
            raise ConfigError(f'a board needs 0 < marker < square < 1 in metres, not {sizes}')

    @property
    def corners(self) -> FloatArray:
        """Return the corners (M, 3) [m] by number."""
        if self.type == 'charuco':
            flat = self.square * (grid(self.columns - 1, self.rows - 1) + 1)
        else:
            flat = self.around_markers.reshape(-1, 2)
        return np.column_stack([flat, np.zeros(len(flat))])

    @property
    def markers(self) -> FloatArray:
        """Return the upper left corners (K, 2) [m] of the markers by number."""
        place = grid(self.columns, self.rows)
        if self.type == 'markers':
            return np.asarray(self.square * place)
        white = place[place.sum(axis=1) % 2 == (0 if self.legacy_pattern else 1)]
        return np.asarray(self.square * white + 0.5 * (self.square - self.marker))

    @property
    def around_markers(self) -> FloatArray:
        """Return the corners (K, 4, 2) [m] of the markers, clockwise from the upper left."""
        around = self.marker * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        return np.asarray(self.markers[:, np.newaxis] + around)

    @property
    def legacy_pattern(self) -> bool:
        """Tell whether the upper left square is white: a legacy board with even rows."""
        return self.legacy and self.rows % 2 == 0

    @property
    def size(self) -> tuple[float, float]:
        """Return width and height [m]."""
        less = 0.0 if self.type == 'charuco' else self.square - self.marker
        return self.columns * self.square - less, self.rows * self.square - less


def grid(columns: int, rows: int) -> Index:
    """Return the column and row (N, 2) of each place of a grid, row by row."""
    return np.column_stack([each.ravel() for each in np.meshgrid(range(columns), range(rows))])


def read_board(path: Path) -> Board:
    """Read a board from YAML."""
    text = read_text(path, what='board ')
    content = parse_mapping(parse_yaml(text, str(path)), BOARD_KEYS, str(path), BOARD_KEYS[:-1])
    usual = {'columns': 0, 'rows': 0, 'square': 0.0, 'marker': 0.0, 'legacy': False}
    parsed: dict[str, Any] = {
        key: parse_like(usual[key], value, f'{path}: {key}') if key in usual else str(value)
        for key, value in content.items()
    }
    return Board(**parsed)


def posed_arm() -> Chain:
    """Return a virtual arm whose joint values are a pose: x y z [m], then turns about x y z.

    It replaces an arm of which only flange poses are known.
    """
    quarter = np.pi / 2
    joints = (
        Joint('flange_z', 'prismatic', theta=quarter, alpha=quarter),
        Joint('flange_x', 'prismatic', theta=quarter, alpha=quarter),
        Joint('flange_y', 'prismatic', alpha=-quarter),
        Joint('flange_rx', alpha=quarter),
        Joint('flange_ry', theta=quarter, alpha=quarter),
        Joint('flange_rz'),
    )
    return Chain(POSED, 'standard', joints)


def joints_of_poses(positions: FloatArray, rotations: FloatArray) -> FloatArray:
    """Return the joint values (N, 6) of the virtual arm at flange poses."""
    with warnings.catch_warnings():  # any turn about x will do in gimbal lock
        warnings.simplefilter('ignore')
        turns = Rotation.from_matrix(rotations).as_euler('XYZ')
    return np.column_stack([positions[:, [2, 0, 1]], turns])


def read_places(path: Path, joints: int) -> tuple[dict[str, FloatArray], bool, tuple[str, ...]]:
    """Read joint values (n,) of each image by name; return them, whether from poses, and warnings.

    The table has `image` and q1 ... qn, or the flange's pose x y z qx qy qz qw.
    """
    found = read_columns(path, ('image',))
    image, names = found.labels('image')
    twice = np.bincount(image)[image] > 1
    found.refuse(twice, lambda row: f'image {names[image[row]]} appears twice')
    posed = 'q1' not in found.header
    columns = POSE_COLUMNS if posed else joint_columns(joints)
    missing = [name for name in columns if name not in found.header]
    if missing:
        raise InputError(
            f'{path} has no column {", ".join(missing)}: give q1 ... q{joints}, or x y z qx qy qz '
            'qw of the flange'
        )
    values = found.block(columns)
    if posed:
        check_quaternions(found, values[:, 3:])
        values = joints_of_poses(values[:, :3], se3.from_quat(values[:, 3:]))
    left_out = joints_left_out(path, found.header, joints)
    return dict(zip(names, values, strict=True)), posed, left_out
