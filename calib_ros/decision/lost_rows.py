# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables put together wrongly: rows lost, or computed instead of measured.

A row missing in one of two tables put side by side mismatches later rows: one shift s of the joint
values fits the measurements before a row k, another from there on, and one of them is zero. Base
and tool are found from the first or last third of the session.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from calib_ros.decision.suspects import rows_away
from calib_ros.decision.trials import (
    fault_limit,
    in_frames,
    refine_trial,
    sample_errors,
    trials_of,
)
from calib_ros.decision.undoing import Suspect
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.levels import LEAST_ASIDE, NEARER
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.start import flange
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import IN_A_FRAME
from calib_ros.kinematics.se3 import Flags, FloatArray
from calib_ros.settings import EXCEPTION
from calib_ros.shown import rows_in_words, two_digits

SLIPS = (0, 1, -1, 2, -2)  # rows that may be missing (benchmarks/mistakes.py loses one)
FEWEST_ROWS = 3 * IN_A_FRAME
"""Rows of a table: with fewer, base and tool alone explain nearly all of a third."""
MOST_SEARCHED = 10 * SOME_POSES  # rows of a table; longer ones are not searched
EXPLAINED_ROWS = 1.0 - EXCEPTION  # share of the rows that a loss must explain


def row_loss(
    problem: Problem, nominal: Chain, seen: Observations, largest: float
) -> tuple[Suspect, float] | None:
    """Return the loss that explains nearly all pairs (N), if one does.

    A faulty arm has errors of up to `largest` [m]. Then follows the typical error [m] once
    corrected.
    """
    count = len(seen)
    if problem.of_messages or not FEWEST_ROWS <= count <= MOST_SEARCHED:
        return None
    best: tuple[Suspect, float] | None = None
    remedy = 'is a row missing or duplicated in one of two tables? Correct it'
    good, rows = EXPLAINED_ROWS * count, np.arange(count)
    inside = {s: (rows + s >= 0) & (rows + s < count) for s in SLIPS}
    paired = {
        s: replace(seen.select(own), joints=seen.joints[rows[own] + s])
        for s, own in inside.items()
    }
    arms = {s: flange(nominal, pairs) for s, pairs in paired.items()}
    thirds = product((rows < count // 3, rows >= count - count // 3), SLIPS)
    some = [paired[shift].select(part[inside[shift]]).spread() for part, shift in thirds]
    for trial in trials_of((nominal, (each,)) for each in some):
        if trial.sets[0].oriented.any() and trial.error > max(largest, NEARER * trial.spread):
            continue  # of another shift; of positions alone a right one may leave as much
        chain = refine_trial(problem, trial).chain
        tables = {s: np.full(count, np.inf) for s in SLIPS}
        for s, pairs in paired.items():
            tables[s][inside[s]] = sample_errors(chain, pairs, arms[s])
        for before, after in product(SLIPS, SLIPS):
            if before and after:
                continue
            row = _where(tables[before] <= largest, tables[after] <= largest)
            pieced = np.concatenate([tables[before][:row], tables[after][row:]])
            fitting = int(np.count_nonzero(pieced <= largest))
            if fitting >= good and _sides_differ(tables[before], tables[after], row, largest):
                good = fitting + 1
                name = rows_in_words([row], seen.stamps_ns)
                where = f'from {name} on' if after else f'before {name}'
                error = float(np.median(pieced[np.isfinite(pieced)]))
                best = Suspect(f'{where} {rows_away(after or before)}', remedy), error
    return best


def computed_rows(problem: Problem) -> str:
    """Return that the nominal arm gives some rows far better than any device measures others.

    Nominal poses may stand above or below measured ones, or each beside its own. They cover as
    much as these: base and tool alone explain a pose measured again and again. If no arm explains
    the others, they are wrong themselves, and these may be measured.
    """
    seen = problem.observations
    if seen.pixels is not None or seen.distances is not None or len(seen) < FEWEST_ROWS:
        return ''
    rows, arm = np.arange(len(seen)), replace(problem.chain, base=None, tool=None, frames=())
    third = len(seen) // 3
    least = NEARER * np.ptp(seen.joints, axis=0)
    for parts in (rows < third, rows >= len(seen) - third), (rows % 2 == 0, rows % 2 == 1):
        some = [each for each in map(seen.select, parts) if covers(each, least)]
        trials = [in_frames(problem, arm, (each,)) for each in some]
        found = sorted(trials, key=lambda one: one.error)
        if len(found) < 2 or found[1].error > fault_limit(problem):
            continue
        if found[0].error < EXCEPTION**2 * found[1].error:
            away = sample_errors(found[0].chain, seen, flange(found[0].chain, seen))
            near = np.flatnonzero(away < EXCEPTION * found[1].error).tolist()
            ours, others = (two_digits(1e3 * each.error) for each in found[:2])
            return (
                f'{rows_in_words(near, seen.stamps_ns, problem.of_messages)} fit the uncorrected '
                f'arm to {ours} mm, others to {others} mm: '
                'are these nominal poses, computed and not measured? Leave them out'
            )
    return ''


def covers(seen: Observations, least: FloatArray, fewest: int = IN_A_FRAME + 1) -> bool:
    """Tell whether joints vary by at least (n,) [rad] or [m], in so many configurations."""
    wide = bool((np.ptp(seen.joints, axis=0) >= least).all())
    return wide and count_distinct(seen.configurations) >= fewest


def _where(before: Flags, after: Flags) -> int:
    gain = before.astype(int) - after.astype(int)
    return int(np.argmax(np.concatenate([[0], np.cumsum(gain)])))


def _sides_differ(before: FloatArray, after: FloatArray, row: int, largest: float) -> bool:
    """Tell whether each side fits by its own shift and not by the other's."""
    sides = (before[:row], after[:row]), (after[row:], before[row:])
    return all(
        len(own) >= LEAST_ASIDE
        and np.mean(own <= largest) > EXPLAINED_ROWS - EXCEPTION
        and np.mean(other <= largest) < 0.5
        for own, other in sides
    )
