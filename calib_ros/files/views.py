# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a camera saw of a board, as a cell of a table.

The lens, fx fy cx cy k1 k2 p1 p2 k3 and whether it is fixed (1 or 0), then x y z u v of each
corner, joined by semicolons.
"""

from __future__ import annotations

import numpy as np

from calib_ros.errors import InputError
from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.parameter import LENS_KINDS
from calib_ros.sampling.sample import View
from calib_ros.values import parse_number


def view_cell(view: View) -> str:
    """Return a view as a cell; numbers are exact."""
    rows = np.column_stack([view.points, view.pixels]).tolist()
    lens = [*view.lens.values.values(), int(view.lens.fixed)]
    return ';'.join(' '.join(map(repr, row)) for row in (lens, *rows))


def view_of(text: str, where: str) -> View:
    """Return the view in a cell; `where` names it in an error."""
    first, *rows = [
        [parse_number(cell, where, InputError) for cell in part.split(' ')]
        for part in text.split(';')
    ]
    if len(first) != len(LENS_KINDS) + 1 or not rows or any(len(row) != 5 for row in rows):
        raise InputError(f'{where} must be a lens of 10 numbers, then x y z u v of each corner')
    corners = np.array(rows)
    values = dict(zip(LENS_KINDS, first, strict=False))
    return View(corners[:, :3], corners[:, 3:], Lens(**values, fixed=bool(first[-1])))
