# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A plan: poses to measure, their visiting order, and the accuracy to expect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_ros.annotated import Count, NotNegative, as_annotated
from calib_ros.apply.candidates import travel_times, visit_order
from calib_ros.apply.choice import Choice
from calib_ros.apply.design import Design, accuracy, triangular
from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.configurations import STILL
from calib_ros.estimation.identifiability import independent
from calib_ros.kinematics.limits import check_limits
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.progress import Notify, quiet
from calib_ros.settings import Criterion
from calib_ros.shown import Shown, as_frame


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Shown):
    """Poses to measure, and the accuracy to expect."""

    joints: FloatArray
    """(K, n) joint values [rad or m], the most informative first."""
    visit: Index
    """(K,) visiting order."""
    travel: float
    """Time of all moves [s]."""
    accuracy: FloatArray
    """(K,) predicted RMS position error [m] with the first 1, 2, ... K of them."""
    at_random: FloatArray
    """(K,) the same with candidates taken at random (median of draws)."""
    efficiency: float | None
    """Lower bound relative to the best choice of as many candidates; None for o2 to o5 and for
    too few poses to determine all parameters."""
    lacking: tuple[str, ...]
    """Parameters that no choice of these candidates would determine; they are ignored."""
    least: int = 1
    """With fewer poses some parameter is certainly undetermined: each has so many rows."""

    def to_frame(self) -> Any:
        """Return the joint values [rad or m] in visiting order as a pandas.DataFrame.

        `telling` is the rank of a pose by information, from 1.
        """
        columns = {f'q{k}': column[self.visit] for k, column in enumerate(self.joints.T, 1)}
        return as_frame({'telling': self.visit + 1, **columns})


@as_annotated
def plan(
    design: Design,
    candidates: FloatArray,
    task: FloatArray,
    count: Count,
    criterion: Criterion = 'd',
    apart: NotNegative = STILL,
    velocities: FloatArray | None = None,
    draws: Count = 25,
    progress: Notify = quiet,
    chosen: Index | None = None,
) -> Plan:
    """Plan `count` measurements, and compare them with as many at random (`draws`).

    `candidates` (N, n) and the `task` (M, n), where the arm must be accurate, are joint values
    [rad or m]; `velocities` (n,) are the largest rates. `criterion` is d, task, or o2 to o5. Any
    two poses differ by at least `apart` [rad or m] in the joint that moves most. `chosen` (count,)
    are indices already found.

    Raises InputError if the candidates do not suffice or joint values are beyond their limits,
    ConfigError for a count below one or rates that are not positive.
    """
    candidates, task = map(design.chain.joint_values, (candidates, task))
    if not len(candidates) or not len(task):
        raise InputError('a plan needs candidates, and at least one pose of the task')
    check_limits(candidates, design.chain, lambda k, i: f'candidates[{k}, {i}]: ')
    check_limits(task, design.chain, lambda k, i: f'task[{k}, {i}]: ')
    joints = candidates.shape[1]
    speeds = np.ones(joints) if velocities is None else velocities
    if speeds.shape != (joints,) or not (speeds > 0.0).all():
        raise ConfigError(f'velocities must be {joints} positive numbers, not {speeds}')
    last = len(candidates) - 1
    if chosen is not None and (chosen.shape != (count,) or not set(chosen) <= {*range(last + 1)}):
        raise ConfigError(
            f'chosen must be {count} numbers from 0 to {last}, not {chosen.tolist()!r:.60}'
        )
    excited = design.determined_by(candidates)
    choice = Choice(excited, candidates, criterion, task, apart, progress)
    chosen = choice.best(count) if chosen is None else chosen
    found = candidates[chosen]
    visit = visit_order(found, speeds)
    rng = np.random.default_rng(0)
    orders = [rng.permutation(len(candidates))[:count] for _ in range(draws)]
    at_random = [accuracy(excited, candidates[order], task) for order in orders]
    predictions = accuracy(excited, found, task)
    unknown = len(excited.names) - len(independent(triangular(excited.known), excited.names))
    bound = None
    if criterion in ('d', 'task') and np.isfinite(predictions[-1]):
        bound = choice.efficiency(chosen)
    moves = travel_times(found[visit], speeds)
    return Plan(
        found,
        visit,
        float(np.diagonal(moves, 1).sum()),
        predictions,
        np.median(at_random, axis=0),
        bound,
        tuple(name for name in design.names if name not in excited.names),
        -(-unknown // excited.rows(candidates[:1]).shape[1]),
    )
