# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The measurements pose by pose: place, errors before and after, and source.

Positions and errors are in the frame of the arm's base, which sets of several devices share.
Errors are measured minus predicted, of judged poses by a fit without them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics.joint import Joint
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.kinematics.walk import BLOCK
from calib_ros.progress import Notify, quiet
from calib_ros.shown import is_time, moment

FITTED, JUDGED, REPEATED = 'fitted', 'judged', 'repeated'
"""Roles: fitted; left out to judge; left out at a fitted configuration, not judged."""
WHEN = ('before', 'after')


@dataclass(frozen=True, eq=False)
class Poses:
    """N poses, or corners of a board, in stamp order.

    Errors of position [m] and orientation [rad] are in the arm's base: (error, 0, 0) for a
    distance, NaN without an orientation.
    """

    joints: FloatArray  # (N, n) [rad or m]
    stamps_ns: NDArray[np.int64]
    position: FloatArray  # (N, 3) of the target [m] in the arm's base, by the corrected arm
    before: FloatArray  # (N, 3)
    after: FloatArray
    turned_before: FloatArray
    turned_after: FloatArray
    in_sigma: FloatArray  # (N, 6) `after` in stated sigmas, position first; NaN: not measured
    role: NDArray[np.str_]  # FITTED, JUDGED or REPEATED
    outlier: Flags
    size: FloatArray  # of the residual in sigmas along an axis; NaN if not fitted
    corner: Flags  # of a board in an image
    set: Index  # of observations, by its number
    tools: FloatArray  # (S, 4, 4) of the sets
    by_line: bool = False  # stamps are the lines of a table, in seconds
    images: Mapping[int, str] = field(default_factory=dict)  # names by line
    repeats: bool = False  # some rows measure the same pose

    def __len__(self) -> int:
        return len(self.joints)

    @property
    def judged(self) -> Flags:
        """Return the poses (N,) that judge, all if none was held out, without outliers."""
        chosen = self.role == JUDGED
        return np.asarray((chosen | ~chosen.any()) & ~self.outlier)

    @property
    def oriented(self) -> bool:
        """Tell whether any orientation was measured."""
        return not bool(np.isnan(self.turned_after).all())

    @property
    def things(self) -> str:
        """Return the plural name of the rows."""
        if not self.corner.any():
            return 'measurements' if self.repeats else 'poses'
        return 'corners' if self.corner.all() else 'measurements'

    @property
    def timed(self) -> bool:
        """Tell whether the stamps are times."""
        return len(self) > 0 and not self.by_line and is_time(int(self.stamps_ns[0]))

    def source(self, row: int) -> str:
        """Return the source of a row: image, line of the table, or stamp."""
        stamp = int(self.stamps_ns[row])
        if self.corner[row] and (name := self.images.get(stamp // 10**9)):
            return name
        if self.by_line:
            return f'line {stamp // 10**9}'
        return moment(stamp)

    def select(self, rows: NDArray[np.generic]) -> Poses:
        """Return some poses by a mask (N,) or indices (K,)."""
        of_all = ('tools', 'by_line', 'images', 'repeats')
        names = (each.name for each in fields(self) if each.name not in of_all)
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def table(self, progress: Notify = quiet) -> str:
        """Return a CSV with a row for each pose, in metres and radians."""
        names = ['line' if self.by_line else 'stamp_ns', 'set', 'role', 'outlier', 'size']
        names += [f'q{k + 1}' for k in range(self.joints.shape[1])]
        names += ['x', 'y', 'z', *(f'{when}_{axis}' for when in WHEN for axis in 'xyz')]
        blocks = [self.joints, self.position, self.before, self.after]
        if self.oriented:
            names += [f'{when}_r{axis}' for when in WHEN for axis in 'xyz']
            blocks += [self.turned_before, self.turned_after]
        where = self.stamps_ns // 10**9 if self.by_line else self.stamps_ns
        form = ','.join(['%d,%d,%s,%d,%.3f', *('%.9f' for _ in names[5:])])
        parts = [','.join(names)]
        for first in range(0, len(self), BLOCK):
            rows = slice(first, first + BLOCK)
            heads = (where, self.set, self.role, self.outlier, self.size)
            columns = [each[rows].tolist() for each in heads]
            columns += np.column_stack([block[rows] for block in blocks]).T.tolist()
            lines = map(form.__mod__, zip(*columns, strict=True))  # faster than str.format
            parts.append('\n'.join(lines).replace('nan', ''))
            progress(min(1.0, rows.stop / len(self)))
        return '\n'.join([*parts, ''])


def numbers(values: FloatArray, digits: int = 5) -> list[Any]:
    """Return an array (...) as lists with `digits` significant digits; None for NaN."""
    flat = [None if x != x else float(f'{x:.{digits}g}') for x in values.ravel().tolist()]
    shaped: list[Any] = np.array(flat, dtype=object).reshape(values.shape).tolist()
    return shaped


def unit_of(joint: Joint) -> tuple[float, str, int]:
    """Return factor, unit and decimals for joint values."""
    return (180.0 / np.pi, '°', 2) if joint.type == 'revolute' else (1e3, 'mm', 1)
