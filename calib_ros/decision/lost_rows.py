# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A missing row in one of two tables put side by side: later rows are mismatched.

Base and tool are found from the first or last third of the session. Then each measurement i is
compared with the joint values i + s for small shifts s: one shift fits before a row k, another
from there on, and one of them is zero.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from calib_ros.decision.suspects import rows_away
from calib_ros.decision.trials import in_frames, misses
from calib_ros.estimation.levels import LEAST_ASIDE
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.start import flange
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import IN_A_FRAME
from calib_ros.kinematics.se3 import Flags, FloatArray
from calib_ros.settings import EXCEPTION

SLIPS = (0, 1, -1, 2, -2)  # rows that may be missing (benchmarks/mistakes.py loses one)
FEWEST_ROWS = 3 * IN_A_FRAME
"""Rows of a table: with fewer, base and tool alone explain nearly all of a third."""
MOST_SEARCHED = 10 * SOME_POSES  # rows of a table; longer ones are not searched
EXPLAINED_ROWS = 1.0 - EXCEPTION  # share of the rows that a loss must explain


def row_loss(
    problem: Problem, nominal: Chain, seen: Observations, largest: float
) -> tuple[str, float] | None:
    """Return the loss that explains nearly all pairs (N), if one does, in words.

    A faulty arm has errors of up to `largest` [m]. Then follows the typical error [m] once
    corrected.
    """
    count = len(seen)
    if not FEWEST_ROWS <= count <= MOST_SEARCHED:
        return None
    best: tuple[str, float] | None = None
    good, rows = EXPLAINED_ROWS * count, np.arange(count)
    inside = {s: (rows + s >= 0) & (rows + s < count) for s in SLIPS}
    paired = {
        s: replace(seen.select(own), joints=seen.joints[rows[own] + s])
        for s, own in inside.items()
    }
    for part, shift in product((rows < count // 3, rows >= count - count // 3), SLIPS):
        some = paired[shift].select(part[inside[shift]])
        if (found := in_frames(problem, nominal, (some,))) is None:
            continue
        tables = {s: np.full(count, np.inf) for s in SLIPS}
        for s, pairs in paired.items():
            tables[s][inside[s]] = misses(found.chain, pairs, flange(found.chain, pairs))
        for before, after in product(SLIPS, SLIPS):
            if before and after:
                continue
            row = _where(tables[before] <= largest, tables[after] <= largest)
            pieced = np.concatenate([tables[before][:row], tables[after][row:]])
            fitting = int(np.count_nonzero(pieced <= largest))
            if fitting >= good and _apart(tables[before], tables[after], row, largest):
                good = fitting + 1
                where = f'from pose {row + 1} on' if after else f'before pose {row + 1}'
                error = float(np.median(pieced[np.isfinite(pieced)]))
                best = f'{where} {rows_away(after or before)}', error
    return best


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
