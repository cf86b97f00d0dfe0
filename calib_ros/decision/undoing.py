# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A possible mistake in the input, and the changes of samples that undo it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from calib_ros.decision.rotation_conventions import Turn
from calib_ros.estimation.observations import Observations
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray

Sets: TypeAlias = tuple[Observations, ...]
DataChange: TypeAlias = Callable[[Observations], Observations]


@dataclass(frozen=True, eq=False)
class Suspect:
    """A possible mistake, in words, and the option to give with a table.

    `changes` in order undo it in the samples, `chain` is the corrected nominal one, joint values
    are `rows` below their measurement. Of equivalent mistakes, those of lowest `rank` are named;
    with 0 the other rows may do. `published` is the remedy for messages, live or from a bag.
    Mistakes of different parts (those of `suspects.FIRST`, or a joint) may occur together.
    """

    what: str
    remedy: str
    changes: tuple[DataChange, ...] = ()
    rank: int = 1
    chain: Chain | None = None
    rows: int = 0
    published: str = 'correct the publisher and measure again (after ~/clear)'
    part: str = ''

    @property
    def in_file(self) -> bool:
        """Tell whether the remedy for messages holds for tables too: it is in the chain file."""
        return self.chain is not None or self.published in self.remedy

    def undo_in(self, sets: Sets) -> Sets:
        """Return the corrected samples."""
        for change in self.changes:
            sets = tuple(map(change, sets))
        return sets


def joint_map(matrix: FloatArray, shift: FloatArray | float = 0.0) -> DataChange:
    """Return the change of joint values by a matrix (n, n), then a shift (n,) or constant."""
    return lambda each: each.changed(joints=each.joints @ matrix.T + shift)


def scale_joints(chain: Chain, kind: str, size: float) -> DataChange:
    """Return the change of all joint values of a kind, 'revolute' or 'prismatic', by a factor."""
    return joint_map(np.diag([size if joint.type == kind else 1.0 for joint in chain.joints]))


def scale_lengths(chain: Chain, size: float) -> tuple[DataChange, DataChange]:
    """Return what `--length` changes: positions and the values of prismatic joints."""
    return scaled(size), scale_joints(chain, 'prismatic', size)


def scaled(size: float, axis: int | None = None) -> DataChange:
    """Return the change of positions, or of one coordinate, by a factor."""
    sizes = np.where(np.isin(np.arange(3), range(3) if axis is None else axis), size, 1.0)
    return lambda each: each.changed(positions=sizes * each.positions)


def change_axes(matrix: FloatArray) -> DataChange:
    """Return the change of positions to the axes in the rows of a matrix (3, 3)."""
    return lambda each: each.changed(positions=each.positions @ matrix.T)


def map_rotations(turn: Turn) -> DataChange:
    """Return the change of rotations by a function of these (N, 3, 3)."""
    return lambda each: each.changed(rotations=turn(each.rotations))


def mirrored(each: Observations) -> Observations:
    """Return the measurements with the y axis of the device reversed."""
    mirror = np.diag([1.0, -1.0, 1.0])
    return each.changed(
        positions=each.positions @ mirror, rotations=mirror @ each.rotations @ mirror
    )
