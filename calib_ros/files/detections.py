# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of the corners of a board that were found in images, and what they measure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib_ros.errors import InputError
from calib_ros.estimation.observations import Observations
from calib_ros.files.boards import Board
from calib_ros.files.columns import Columns, read_columns
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.shown import some
from calib_ros.texts import csv_text, to_cell

HEADER = ('image', 'corner', 'u', 'v')
SIZE = ('width', 'height')  # optional columns: size of the images [px]


@dataclass(frozen=True, eq=False)
class Detections:
    """Corners (N,) with their image numbers and `pixels` (N, 2); images begin at `lines`.

    All images have one `size`, width and height [px], if known.
    """

    names: tuple[str, ...]
    image: Index
    corner: Index
    pixels: FloatArray
    lines: tuple[int, ...] = ()
    size: tuple[int, int] | None = None

    def as_csv(self) -> str:
        """Return a table with a row per corner."""
        numbers = zip(self.image.tolist(), self.corner.tolist(), self.pixels.tolist(), strict=True)
        rows = ((to_cell(self.names[k]), n, f'{u:.4f}', f'{v:.4f}') for k, n, (u, v) in numbers)
        size = self.size or ()
        return csv_text([(*HEADER, *SIZE[: len(size)]), *((*row, *size) for row in rows)])


def read_detections(path: Path, board: Board) -> Detections:
    """Read a table of corners of a board."""
    found = read_columns(path, HEADER)
    image, names = found.labels('image')
    corner, most = found.integers('corner'), len(board.corners)
    found.refuse(
        (corner < 0) | (corner >= most),
        lambda row: f'corner must be from 0 to {most - 1} on this board, not {corner[row]}',
    )
    again = np.ones(len(image), dtype=bool)
    again[np.unique(image * most + corner, return_index=True)[1]] = False
    found.refuse(
        again, lambda row: f'corner {corner[row]} of image {names[image[row]]} already exists'
    )
    order, pixels = np.argsort(image, kind='stable'), found.block(('u', 'v'))
    corners = image[order], corner[order], pixels[order]
    lines = found.lines[np.unique(image, return_index=True)[1]].tolist()
    return Detections(tuple(names), *corners, tuple(lines), _size_of(found))


def _size_of(found: Columns) -> tuple[int, int] | None:
    if not {*SIZE} <= {*found.header}:
        return None
    pairs = zip(*(found.integers(name).tolist() for name in SIZE), strict=True)
    first, *others = sorted(set(pairs))
    if others:
        sizes = ' and '.join(f'{w} x {h}' for w, h in (first, others[0]))
        raise InputError(
            f'{found.path} has corners of images of {sizes} px: give those of one size only'
        )
    return first


def observed(
    found: Detections, board: Board, places: Mapping[str, FloatArray], on_flange: bool
) -> tuple[Observations, tuple[str, ...]]:
    """Return the corners of images with known joint values, stamped by line, and warnings.

    `places` are joint values (n,) by image name.
    """
    known = np.array([name in places for name in found.names], dtype=bool)
    if not known.any():
        raise InputError(
            'no image has joint values: the names in column "image" of both tables must match, '
            f'but {found.names[0]!r} and {next(iter(places))!r} do not'
        )
    lost = [name for name, yes in zip(found.names, known.tolist(), strict=True) if not yes]
    notes = (f'no joint values for {len(lost)} images: {", ".join(some(lost))}',) if lost else ()
    kept = known[found.image]
    image = found.image[kept]
    joints = np.array([places[found.names[k]] for k in image.tolist()])
    points = board.corners[found.corner[kept]]
    seen = Observations.from_pixels(joints, found.pixels[kept], points, image, on_flange)
    return seen.at(np.array(found.lines, dtype=np.int64)[image] * 10**9), notes
