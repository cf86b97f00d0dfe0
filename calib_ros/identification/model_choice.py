# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The choice of a model: which effects pay on poses that were held out."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib_ros.annotated import as_annotated
from calib_ros.decision.comparison import GroupVerdict
from calib_ros.decision.delays import timed
from calib_ros.decision.result import Identification
from calib_ros.estimation.levels import SEVERAL
from calib_ros.estimation.problem import Problem
from calib_ros.identification.identification import identify
from calib_ros.identification.linear_model import COMPARED, HARMONICS, LinearModel
from calib_ros.kinematics import effects
from calib_ros.progress import Notify, quiet, share_of
from calib_ros.settings import effects_of


@as_annotated
def identify_model(problem: Problem, model: str, progress: Notify = quiet) -> Identification:
    """Identify with the errors named by `model`; `auto` chooses them by cross-validation.

    If the chosen model cannot be fitted, or is refused although the geometric one is not, the
    geometric result is returned with the verdicts and a remark. An exception from `progress` ends
    the work. Raises UnknownNameError for another model.
    """
    progress(f'model {"geometric" if model == "auto" else model}')
    if model != 'auto':
        return identify(replace(problem, effects=effects_of(model)), progress=progress)
    given = problem
    problem, late = timed(given)
    poses = max(1, sum(map(len, problem.sets)))
    columns = 2 * len(HARMONICS) * len(problem.chain.joints)
    fit, tried = len(problem.free) * poses, columns * min(poses, COMPARED)
    first, second = np.array([fit, fit + tried]) / (2 * fit + tried)  # entries of all columns
    result = identify(problem, progress=share_of(progress, 0.0, first))
    chosen, verdicts = _choose_effects(problem, result, share_of(progress, first, second))
    if late:
        result = replace(result, remarks=(*late, *result.remarks))
    if chosen:
        progress(f'model with {len(chosen)} effects')
        rest = share_of(progress, second, 1.0)
        richer = identify(replace(given, effects=chosen), result, rest)  # which hides no delay
        reasons: tuple[str, ...] = richer.refusals if result.accepted else ()
        if not richer.converged:
            reasons = ('its fit has not converged',)
        if reasons:
            remark = f'the richer model is not used, because {"; ".join(reasons)}'
            result = replace(result, remarks=(*result.remarks, remark))
        else:
            result = richer
    return replace(result, verdicts=verdicts)


def _choose_effects(
    problem: Problem, geometric: Identification, progress: Notify
) -> tuple[tuple[str, ...], tuple[GroupVerdict, ...]]:
    progress('effects')
    model = LinearModel(problem, geometric)
    groups = model.useful({name: effects.members(problem.chain, name) for name in effects.GROUPS})
    groups = {group: names for group, names in groups.items() if names}
    chosen: list[str] = []
    verdicts: dict[str, GroupVerdict] = {}
    while True:
        _choose_groups(model, groups, chosen, verdicts, progress)
        if not _choose_harmonics(model, chosen, verdicts, progress):
            return tuple(chosen), tuple(verdicts.values())


def _choose_groups(
    model: LinearModel,
    groups: Mapping[str, Sequence[str]],
    chosen: list[str],
    verdicts: dict[str, GroupVerdict],
    progress: Notify,
) -> None:
    """Choose the best group as long as one pays; then what is left together, where that pays.

    Alone, a group may vanish in the errors that the others leave.
    """
    left = [group for group, names in groups.items() if not set(names) <= set(chosen)]
    while True:
        for group in left:
            progress(f'effects: {group}')
            verdicts[group] = model.judge(chosen, groups[group], group)
        paying = [group for group in left if verdicts[group].pays]
        if not paying:
            break
        best = min(paying, key=lambda group: verdicts[group].rms_mm_after)
        left.remove(best)
        chosen += groups[best]
        model.shrink_noise(verdicts[best])
    every = [name for group in left for name in groups[group]]
    together = model.judge(chosen, every, 'all')
    if not together.pays:
        return
    for group in left:
        others = [name for name in every if name not in groups[group]]
        verdict = model.judge([*chosen, *others], groups[group], group)
        if verdict.pays:
            verdicts[group] = verdict
        else:
            every = others
    if every:
        chosen += every
        model.shrink_noise(together)


def _choose_harmonics(
    model: LinearModel, chosen: list[str], verdicts: dict[str, GroupVerdict], progress: Notify
) -> bool:
    """Choose the strongest harmonics, or all, as long as they pay; tell whether any did."""

    def added(verdict: GroupVerdict, names: Sequence[str]) -> bool:
        verdicts[verdict.what] = verdict
        if verdict.pays:
            chosen.extend(name for name in names if name not in chosen)
            model.shrink_noise(verdict)
        return verdict.pays

    before = len(chosen)
    for count in itertools.count(1):
        pair, several = model.strongest_harmonic(chosen, progress)
        more = False
        if pair:
            what = f'{pair[0].owner}, {pair[0].effect[1]} per turn'
            more = added(model.judge(chosen, pair, what), pair)
        if several and (count == SEVERAL or (count < SEVERAL and not more)):
            progress('effects: all harmonics')
            every = f'all harmonics up to {HARMONICS[-1]} per turn'
            verdict = model.judge(chosen, model.harmonics, every)
            more = not added(verdict, model.harmonics) and more
        if not more:
            break
    return len(chosen) > before
