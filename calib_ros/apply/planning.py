# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How many poses to measure, which, in what order, and the accuracy to expect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.apply.candidates import travel_times, visit_order
from calib_ros.apply.choice import choose, efficiency
from calib_ros.apply.design import Design, accuracy, predicted
from calib_ros.errors import InputError
from calib_ros.identification.configurations import STILL
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.progress import Told, nobody
from calib_ros.settings import Criterion
from calib_ros.shown import Shown, as_frame


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Shown):
    """Poses to measure, and the accuracy to expect.

    Attributes
    ----------
    joints : (K, n)
        Joint values [rad or m], the most informative first.
    visit : (K,)
        Their order of visit.
    travel : float
        Time of the moves [s].
    accuracy : (K,)
        Predicted RMS position error [m] with the first 1, 2, ... K of them.
    at_random : (K,)
        The same with candidates taken at random (median of draws).
    efficiency : float or None
        Lower bound against the best choice of as many candidates; None for o2 to o5 and for too
        few poses to determine all parameters.
    lacking : tuple of str
        Parameters that no choice of these candidates would determine; they are left out.

    """

    joints: FloatArray
    visit: NDArray[np.intp]
    travel: float
    accuracy: FloatArray
    at_random: FloatArray
    efficiency: float | None
    lacking: tuple[str, ...]

    def to_frame(self) -> Any:
        """Return the joint values [rad or m] in the order of visit as a pandas.DataFrame.

        `telling` is the place of a pose among the most telling ones, the first of which is 1.
        """
        columns = {f'q{k}': column[self.visit] for k, column in enumerate(self.joints.T, 1)}
        return as_frame({'telling': self.visit + 1, **columns})


def plan(
    design: Design,
    candidates: FloatArray,
    task: FloatArray,
    count: int,
    criterion: Criterion = 'd',
    apart: float = STILL,
    velocities: FloatArray | None = None,
    draws: int = 25,
    told: Told = nobody,
    chosen: NDArray[np.intp] | None = None,
) -> Plan:
    """Plan a number of measurements, and compare them with so many random draws.

    `chosen` are indices that `fewest` found already; `choose` and `visit_order` say what the other
    arguments mean.
    """
    excited = design.determined_by(candidates)
    if chosen is None:
        chosen = choose(excited, candidates, count, criterion, task, apart, told)
    joints = candidates[chosen]
    speeds = np.ones(joints.shape[1]) if velocities is None else velocities
    visit = visit_order(joints, speeds)
    rng = np.random.default_rng(0)
    orders = [rng.permutation(len(candidates))[:count] for _ in range(draws)]
    at_random = [accuracy(excited, candidates[order], task) for order in orders]
    predictions = accuracy(excited, joints, task)
    bound = None
    if criterion in ('d', 'task') and np.isfinite(predictions[-1]):
        bound = efficiency(excited, candidates, chosen, task if criterion == 'task' else None)
    moves = travel_times(joints[visit], speeds)
    return Plan(
        joints,
        visit,
        float(np.diagonal(moves, 1).sum()),
        predictions,
        np.median(at_random, axis=0),
        bound,
        tuple(name for name in design.names if name not in excited.names),
    )


def fewest(
    design: Design,
    candidates: FloatArray,
    task: FloatArray,
    wanted: float,
    criterion: Criterion = 'd',
    apart: float = STILL,
    told: Told = nobody,
) -> NDArray[np.intp]:
    """Return the indices (K,) of the fewest poses with the accuracy `wanted`, the best first.

    It is the predicted RMS position error [m] at the task poses (T, n).
    """
    excited = design.determined_by(candidates)
    best = predicted(excited.after(candidates), task)
    if best > wanted:
        raise InputError(
            f'all {len(candidates)} candidates together predict {1e3 * best:.4f} mm, '
            f'{1e3 * wanted:g} mm are wanted: give more candidates or a better measurement'
        )
    count = len(excited.names)  # poses determine several parameters each
    while True:
        count = min(count, len(candidates))
        found = choose(excited, candidates, count, criterion, task, apart, told, exchanged=False)
        errors = accuracy(excited, candidates[found], task)
        if errors[-1] <= wanted:
            break
        growth = (errors[-1] / wanted) ** 2  # errors fall with the root of the number
        count = max(count + 1, int(count * min(growth, 2.0)))
    reached = int(np.flatnonzero(errors <= wanted)[0]) + 1
    while reached > 1:  # the first of many are not quite the best of few
        start = found[:reached] if reached < len(found) else found[: reached - 1]
        for begin in (start, None):  # the quick way first
            fewer = choose(excited, candidates, len(start), criterion, task, apart, told, begin)
            errors = accuracy(excited, candidates[fewer], task)
            if errors[-1] <= wanted:
                break
        else:
            break
        found, reached = fewer, int(np.flatnonzero(errors <= wanted)[0]) + 1
    return found[:reached]


def in_words(plan: Plan, candidates: int, wanted_mm: float | None, needed: int | None) -> str:
    """Return the expected accuracy by number of poses, and the efficiency of the plan."""
    count = len(plan.joints)
    first = int(np.isfinite(plan.accuracy).sum())
    shown = np.unique(np.linspace(count - first + 1, count, min(first, 12)).round().astype(int))
    head = 'predicted RMS position error [mm], from measurement noise alone'
    lines = [head, ' poses   planned   random']
    for number in shown.tolist():
        planned, random = (1e3 * each[number - 1] for each in (plan.accuracy, plan.at_random))
        by_chance = f'{random:8.4f}' if np.isfinite(random) else '       -'
        lines.append(f'{number:6} {planned:9.4f} {by_chance}')
    if not first:
        lines.append(f'{count:6}         - too few poses to determine all parameters')
    text = f'{count} of {candidates} candidates'
    if plan.efficiency is not None:
        text += f', at least {100.0 * plan.efficiency:.0f} % of what the best choice would bring'
    lines.append(f'{text}; moves take {plan.travel:.0f} s')
    if needed is not None:
        lines.append(f'{needed} poses reach {wanted_mm:g} mm')
    if plan.lacking:
        lines.append(
            f'no choice of these candidates determines {", ".join(plan.lacking)}: move the joints '
            'further and in more combinations, or fix these parameters. The figures leave out '
            'what these bring, and hold only where the joints move as in the candidates'
        )
    return '\n'.join(lines)
