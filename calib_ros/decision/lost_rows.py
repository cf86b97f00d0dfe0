# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A missing row in one of two tables put side by side: later rows are mismatched.

Base and tool are found from the first or last third of the session. Then each measurement i is
compared with the joint values i + s for small shifts s: one shift fits before a row k, another
from there on, and one of them is zero.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from calib_ros.estimation.levels import LEAST_ASIDE
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import IN_A_FRAME
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.settings import EXCEPTION

SLIPS = (0, 1, -1, 2, -2)  # rows that may be missing (benchmarks/mistakes.py loses one)
FEWEST_ROWS = 3 * IN_A_FRAME
"""Rows of a table: with fewer, base and tool alone explain nearly all of a third."""
MOST_SEARCHED = 10 * SOME_POSES  # rows of a table; longer ones are not searched
EXPLAINED_ROWS = 1.0 - EXCEPTION  # share of the rows that a loss must explain

Errors = Callable[[Chain, Observations], FloatArray]
Framed = Callable[[Observations], Chain | None]


@dataclass(frozen=True)
class RowLoss:
    """Joint values that are `after` rows below their measurement from `row` (from 0) on.

    Before it, they are `before` rows below. `error` [m] is the typical one once corrected.
    """

    row: int
    before: int
    after: int
    error: float

    @property
    def what(self) -> str:
        """Return what happened, in words."""
        rows, late = (self.after, True) if self.after else (self.before, False)
        count = f'{abs(rows)} row{"s" if abs(rows) > 1 else ""}'
        where = f'from pose {self.row + 1} on' if late else f'before pose {self.row + 1}'
        return (
            f'{where} the joint values stand {count} {"below" if rows > 0 else "above"} their '
            'measurement'
        )


def row_loss(seen: Observations, framed: Framed, errors: Errors, largest: float) -> RowLoss | None:
    """Return the loss that explains nearly all pairs (N), if one does.

    `framed` returns the chain with frames fitted to some pairs, `errors` (N,) [m] those of pairs;
    a faulty arm has errors of up to `largest`.
    """
    count = len(seen)
    if not FEWEST_ROWS <= count <= MOST_SEARCHED:
        return None
    best: RowLoss | None = None
    good = EXPLAINED_ROWS * count
    for chain in _frames(seen, framed):
        tables = {s: _shifted(chain, seen, s, errors) for s in SLIPS}
        for before, after in product(SLIPS, SLIPS):
            if before == after or (before and after):
                continue
            row = _where(tables[before] <= largest, tables[after] <= largest)
            pieced = np.concatenate([tables[before][:row], tables[after][row:]])
            fitting = int(np.count_nonzero(pieced <= largest))
            if fitting >= good and _apart(tables[before], tables[after], row, largest):
                good = fitting + 1
                best = RowLoss(row, before, after, float(np.median(pieced[np.isfinite(pieced)])))
    return best


def _frames(seen: Observations, framed: Framed) -> Iterator[Chain]:
    third = len(seen) // 3
    for part, shift in product((slice(third), slice(-third, None)), SLIPS):
        rows = np.arange(len(seen))[part]
        rows = rows[(rows + shift >= 0) & (rows + shift < len(seen))]
        chain = framed(_paired(seen, rows, shift))
        if chain is not None:
            yield chain


def _paired(seen: Observations, rows: Index, shift: int) -> Observations:
    """Return measurements of some rows with the joint values of `shift` rows below."""
    return replace(seen.select(rows), joints=seen.joints[rows + shift])


def _shifted(chain: Chain, seen: Observations, shift: int, errors: Errors) -> FloatArray:
    """Return the errors (N,) [m] of measurements at joint values `shift` rows below."""
    rows = np.arange(len(seen))
    inside = (rows + shift >= 0) & (rows + shift < len(seen))
    found = np.full(len(seen), np.inf)
    found[inside] = errors(chain, _paired(seen, rows[inside], shift))
    return found


def _where(before: Flags, after: Flags) -> int:
    gain = before.astype(int) - after.astype(int)
    return int(np.argmax(np.concatenate([[0], np.cumsum(gain)])))


def _apart(before: FloatArray, after: FloatArray, row: int, largest: float) -> bool:
    """Tell whether each side fits by its own shift and not by the other's."""
    sides = (before[:row], after[:row]), (after[row:], before[row:])
    return all(
        len(own) >= LEAST_ASIDE
        and np.mean(own <= largest) > EXPLAINED_ROWS - EXCEPTION
        and np.mean(other <= largest) < 0.5
        for own, other in sides
    )
