# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Choice of non-geometric effects by cross-validation (docs/model.md, Non-geometric errors)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros.decision.result import Identification
from calib_ros.estimation.levels import SEVERAL
from calib_ros.estimation.problem import Problem
from calib_ros.identification.identification import identify
from calib_ros.identification.linear_model import COMPARED, HARMONICS, LinearModel
from calib_ros.kinematics import effects
from calib_ros.kinematics.effects import Verdict
from calib_ros.progress import Notify, quiet, share_of


def identify_model(problem: Problem, model: str, progress: Notify = quiet) -> Identification:
    """Identify with the errors named by `model`; `auto` chooses them by cross-validation.

    If the chosen model cannot be fitted, or is refused although the geometric one is not, the
    geometric result is returned with the verdicts and a remark. An exception from `progress` ends
    the work.
    """
    progress(f'model {"geometric" if model == "auto" else model}')
    if model != 'auto':
        return identify(problem, progress=progress)
    poses = max(1, sum(map(len, problem.sets)))
    columns = 2 * len(HARMONICS) * len(problem.chain.joints)
    fit, tried = len(problem.free) * poses, columns * min(poses, COMPARED)
    first, second = np.array([fit, fit + tried]) / (2 * fit + tried)  # entries of all columns
    result = identify(problem, progress=share_of(progress, 0.0, first))
    chosen, verdicts = _chosen(problem, result, share_of(progress, first, second))
    if chosen:
        progress(f'model with {len(chosen)} effects')
        rest = share_of(progress, second, 1.0)
        richer = identify(replace(problem, effects=chosen), result, rest)
        reasons: tuple[str, ...] = ()
        if not richer.converged:
            reasons = ('its fit has not converged',)
        if result.accepted:
            reasons = reasons or richer.refusals
        if reasons:
            remark = f'the richer model is not used, because {"; ".join(reasons)}'
            result = replace(result, remarks=(*result.remarks, remark))
        else:
            result = richer
    return replace(result, verdicts=verdicts)


def _chosen(
    problem: Problem, geometric: Identification, progress: Notify
) -> tuple[tuple[str, ...], tuple[Verdict, ...]]:
    progress('effects')
    model = LinearModel(problem, geometric)
    chosen: list[str] = []
    verdicts: dict[str, Verdict] = {}
    groups = model.useful({name: effects.members(problem.chain, name) for name in effects.GROUPS})
    while True:
        tried = []
        for group, names in groups.items():
            if names and not set(names) <= set(chosen):
                progress(f'effects: {group}')
                tried.append((model.judge(chosen, names, group), group))
        if not tried:
            break
        for verdict, group in tried:
            verdicts[group] = verdict
        paying = [pair for pair in tried if pair[0].pays]
        if not paying:
            break
        best, group = min(paying, key=lambda pair: pair[0].rms_mm_after)
        verdicts[group] = best
        chosen += groups[group]
    return _with_harmonics(model, chosen, list(verdicts.values()), progress)


def _with_harmonics(
    model: LinearModel, chosen: list[str], verdicts: list[Verdict], progress: Notify
) -> tuple[tuple[str, ...], tuple[Verdict, ...]]:
    def added(verdict: Verdict, names: Sequence[str]) -> bool:
        verdicts.append(verdict)
        chosen.extend(name for name in names if verdict.pays and name not in chosen)
        return verdict.pays

    for count in itertools.count(1):
        pair, several = model.strongest_harmonic(chosen, progress)
        more = False
        if pair:
            what = f'{pair[0].owner}, {pair[0].effect[1]} per turn'
            more = added(model.judge(chosen, pair, what), pair)
        if several and (count == SEVERAL or (count < SEVERAL and not more)):
            progress('effects: all harmonics')
            more = not added(model.judge_all_harmonics(chosen), model.harmonics) and more
        if not more:
            break
    return tuple(chosen), tuple(verdicts)
