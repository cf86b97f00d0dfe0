# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Boards and the places of their corners.

A board is YAML: `type, columns, rows, square, marker, dictionary`, lengths in metres.

charuco   columns x rows squares, black at the upper left, markers in the white ones; its corners
          are the inner ones, numbered row by row
markers   columns x rows markers, `square` apart; marker k has the corners 4 k ... 4 k + 3,
          clockwise from its upper left

The frame of the board has x to the right, y down and z away from the viewer; its origin is the
upper left corner of the first square or marker.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.errors import MOST_ENTRIES, ConfigError, UnknownNameError
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.texts import parse_yaml, read_text
from calib_ros.values import parse_like, parse_mapping

BOARD_TYPES = ('charuco', 'markers')
BOARD_KEYS = ('type', 'columns', 'rows', 'square', 'marker', 'dictionary', 'legacy')


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
