# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The measurements pose by pose: place, errors before and after, and source.

Positions and errors are in the frame of the arm's base, which sets of several devices share.
Errors are measured minus predicted, of judged poses by a fit without them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.decision.comparison import Comparison
from calib_ros.decision.residuals import axes_of, by_axes
from calib_ros.decision.result import Identification
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.pixels import samples_of
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.samples import Samples
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.kinematics.walk import BLOCK
from calib_ros.progress import Notify, quiet
from calib_ros.settings import Settings
from calib_ros.shown import is_time, moment

FITTED, JUDGED, REPEATED = 'fitted', 'judged', 'repeated'
"""Roles: fitted; left out to judge; left out at a fitted configuration, not judged."""
WHEN = ('before', 'after')
NAMELESS: Mapping[int, str] = {}


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
        form = ','.join(['{:d},{:d},{},{:d},{:.3f}', *('{:.9f}' for _ in names[5:])])
        parts = [','.join(names)]
        for first in range(0, len(self), BLOCK):
            rows = slice(first, first + BLOCK)
            heads = (where, self.set, self.role, self.outlier, self.size)
            columns = [each[rows].tolist() for each in heads]
            columns += np.column_stack([block[rows] for block in blocks]).T.tolist()
            parts.append('\n'.join(map(form.format, *columns)).replace('nan', ''))
            progress(min(1.0, rows.stop / len(self)))
        return '\n'.join([*parts, ''])


def _poses(
    chain: Chain,
    groups: Sequence[tuple[Sequence[Samples], Comparison, NDArray[np.str_], FloatArray]],
    by_line: bool,
    images: Mapping[int, str],
    repeats: bool = False,
) -> Poses:
    """Return the poses of sets with residuals, roles (N,) and sizes (N,), in stamp order."""
    parts: list[dict[str, NDArray[Any]]] = []
    for measured, comparison, role, sizes in groups:
        first, before, after = 0, comparison.before, comparison.after
        for samples in measured:
            each = samples.observations
            rows = slice(first, first + len(each))
            first = rows.stop
            base, turn = chain.frame(each.base).matrix, axes_of(chain, each)
            reached = chain.forward(each.joints, each.approach, each.base, each.tool)
            along = turn if each.distances is None else np.broadcast_to(np.eye(3), turn.shape)
            left = after.position[rows] if each.pixels is None else after.pixels[rows]
            left = left[:, :1] if each.distances is not None else left
            parts_in_sigma = samples.in_sigma(left, after.orientation[rows])
            in_sigma = np.full((len(each), 6), np.nan)
            in_sigma[:, : left.shape[1]], in_sigma[:, 3:] = parts_in_sigma
            part = {
                'joints': each.joints,
                'stamps_ns': each.stamps_ns,
                'position': (reached[:, :3, 3] - base[:3, 3]) @ base[:3, :3],
                'before': by_axes(before.position[rows], along),
                'after': by_axes(after.position[rows], along),
                'turned_before': by_axes(before.orientation[rows], turn),
                'turned_after': by_axes(after.orientation[rows], turn),
                'in_sigma': in_sigma,
                'role': role[rows],
                'outlier': ~comparison.judged[rows],
                'size': sizes[rows],
                'corner': np.full(len(each), each.pixels is not None),
                'set': np.full(len(each), len(parts)),
                'tools': chain.frame(each.tool).matrix[np.newaxis],
            }
            parts.append(part)
    tools = np.concatenate([part.pop('tools') for part in parts])
    order = np.argsort(np.concatenate([part['stamps_ns'] for part in parts]), kind='stable')
    names = list(parts[0])  # let go one by one: of many poses they are large
    ordered = {name: np.concatenate([p.pop(name) for p in parts])[order] for name in names}
    return Poses(**ordered, tools=tools, by_line=by_line, images=images, repeats=repeats)


def poses_of(
    problem: Problem,
    result: Identification,
    by_line: bool = False,
    images: Mapping[int, str] = NAMELESS,
) -> Poses:
    """Return all poses of an identification, judged ones by a fit without them."""
    sizes = np.concatenate(result.distances)
    judged, sets = result.validation, problem.system(problem.sets).sets
    if judged is None or judged.repeated is not None:
        groups = [(sets, result.fitted, np.full(len(sizes), FITTED), sizes)]
    else:  # each was left out once
        groups = [(sets, judged, np.full(len(sizes), JUDGED), sizes)]
    if judged is not None and judged.repeated is not None:
        role = np.where(judged.repeated, REPEATED, JUDGED)
        sets = problem.system(problem.judging).sets
        groups.append((sets, judged, role, np.full(len(role), np.nan)))
    return _poses(result.chain, groups, by_line, images)


def poses_to_verify(
    chain: Chain, sets: Sequence[Observations], comparison: Comparison, by_line: bool = False
) -> Poses:
    """Return the poses of new measurements, all judged."""
    count = len(comparison.judged)
    samples = [samples_of(each, Settings().sigmas, Settings.sigma_pixel) for each in sets]
    groups = [(samples, comparison, np.full(count, JUDGED), np.full(count, np.nan))]
    repeats = count_distinct(comparison.after.configurations) < count
    return _poses(chain, groups, by_line, NAMELESS, repeats)


def numbers(values: FloatArray, digits: int = 5) -> list[Any]:
    """Return an array (...) as lists with `digits` significant digits; None for NaN."""
    flat = [None if x != x else float(f'{x:.{digits}g}') for x in values.ravel().tolist()]
    shaped: list[Any] = np.array(flat, dtype=object).reshape(values.shape).tolist()
    return shaped


def unit_of(joint: Joint) -> tuple[float, str, int]:
    """Return factor, unit and decimals for joint values."""
    return (180.0 / np.pi, '°', 2) if joint.type == 'revolute' else (1e3, 'mm', 1)
