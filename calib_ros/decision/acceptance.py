# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The rules of acceptance: what a result must show before it may replace the nominal parameters.

docs/model.md (Judgement) lists and explains them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from calib_ros.decision.delays import wrong_ratio
from calib_ros.decision.improvement import gain_refusals, harm_refusals
from calib_ros.decision.moved import Step
from calib_ros.decision.reasons import Reason, Rule
from calib_ros.decision.result import Identification
from calib_ros.decision.rounding import resolution_in_words
from calib_ros.decision.trials import position_fault_limit
from calib_ros.estimation.configurations import STILL, count_distinct
from calib_ros.estimation.fitted import ParameterRow
from calib_ros.estimation.identifiability import DEGENERATE
from calib_ros.estimation.levels import ALIKE, MOST_OUTLIERS, NEARER
from calib_ros.estimation.posterior import Posterior
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.trimmed import most_left_out
from calib_ros.kinematics import effects
from calib_ros.kinematics.parameter import Parameter
from calib_ros.settings import EXCEPTION
from calib_ros.shown import some


def refusals(
    problem: Problem,
    result: Identification,
    own_behaviour: Reason | None,
    may_be_rounding: bool,
    sized: bool,
    scaled: float = 0.0,
) -> tuple[Reason, ...]:
    """Return the acceptance rules that fail.

    `own_behaviour` describes outliers that are the arm's own (`misfits.py`), `may_be_rounding` is
    the verdict of `rounding.py`, `sized` tells whether the measurements fix the size and shape of
    the arm, and `scaled` is the error of the device's scale if that alone leaves no region.
    """
    failed, validation = [*_fit_refusals(problem, result, own_behaviour)], result.validation
    if validation is None:
        count = count_distinct(result.fitted.after.configurations)
        text = f'{count} different poses, too few to hold some out'
        return (*failed, Reason(Rule.CONFIGURATIONS, text))
    share = validation.share_of_outliers
    if share > MOST_OUTLIERS:
        if result.step is not None and not result.step.harmful:
            failed.append(result.step.reason)
        text = f'{100.0 * share:.0f} % of the judged poses are outliers'
        return (*failed, Reason(Rule.OUTLIERS, text))
    if hiding := _hidden_outliers(problem, result):
        failed.append(Reason(Rule.OUTLIERS, hiding))
    gained = tuple(gain_refusals(problem, result, validation, sized, scaled))
    before, after = validation.figures
    helps = after.rms_mm < before.rms_mm or all(each.rule is not Rule.GAIN for each in gained)
    if after.rms_mm > max(1e3 * position_fault_limit(problem), before.rms_mm / ALIKE):
        # of a fit that explains nothing the parameters tell nothing
        failed = [each for each in failed if each.rule is not Rule.COMMON_SENSE]
    return (*failed, *gained, *harm_refusals(validation, may_be_rounding, helps))


def _hidden_outliers(problem: Problem, result: Identification) -> str:
    """Return that as many gross errors were found as can be, and the rest does not fit either.

    Those of a repeated stop, or of corners in an image, show without the others.
    """
    found, size = 0, result.noise.position
    if not result.outliers or size <= 1.0 / NEARER:
        return ''
    for number, each in enumerate(problem.sets):
        stops = each.configurations
        good = np.delete(stops, [one.sample for one in result.outliers if one.set == number])
        found += int((~np.isin(stops, good)).sum()) * (each.pixels is None)
    alone = replace(problem, learned=None).system(problem.sets)
    if not found or found < most_left_out(result.names, alone):
        return ''
    count = sum(map(len, problem.sets))
    return (
        f'{found} of {count} poses are outliers, the most that so few can show, and the others are'
        f' {size:.1f} times as far off as the stated sigma: more may be among them'
    )


def _fit_refusals(
    problem: Problem, result: Identification, own_behaviour: Reason | None
) -> Iterator[Reason]:
    """Yield failed rules that do not depend on held-out poses."""
    if result.step is not None and result.step.harmful:
        yield result.step.reason
    if own_behaviour is not None:
        yield own_behaviour
    if not result.converged:
        yield Reason(Rule.CONVERGENCE, 'the fit has not converged')
    if missing := result.not_excited:
        kinds: dict[str, list[str]] = {}
        for each in missing:
            kinds.setdefault(each.owner, []).append(each.kind)
        named = ', '.join(f'{owner} ({", ".join(names)})' for owner, names in kinds.items())
        yield Reason(Rule.EXCITATION, f'{_idle_joints(problem)}the poses do not determine {named}')
    limits = (problem.largest_length, problem.largest_angle)
    if beyond := [p for p in result.parameters if p.beyond(*limits)]:
        far = some([f'{p.name} by {_far(p, problem.largest_angle)}' for p in beyond])
        text = f'further off than even a faulty robot of this kind: {", ".join(far)}'
        several = sum(p.name.is_length for p in beyond) > 1
        yield Reason(Rule.COMMON_SENSE, _other_unit(result) * several + text)


def _other_unit(result: Identification) -> str:
    """Return that all lengths are the same multiple of the nominal ones; empty if not."""
    rows = [p for p in result.parameters if p.name.of_dh and p.name.is_length and p.std]
    offset = np.array([p.offset for p in rows])
    nominal = np.array([p.value for p in rows]) - offset
    change = offset @ nominal / (nominal @ nominal or 1.0)
    if np.linalg.norm(offset - change * nominal) > EXCEPTION * np.linalg.norm(offset):
        return ''
    times = f'all lengths come out {1.0 + change:.3g} times as long as nominal'
    return f'{times}, as if positions were in another unit (table: --length); '


def _far(parameter: ParameterRow, largest: float) -> str:
    """Return an offset beyond the largest one [rad]; angles without whole turns, in degrees."""
    offset = parameter.offset
    if parameter.name.is_length:
        return f'{1e3 * offset:.0f} mm'
    turned = math.remainder(offset, math.tau)
    return f'{math.degrees(turned if abs(turned) > largest else offset):.3g}°'


def _idle_joints(problem: Problem) -> str:
    """Return which joints stood still, or only moved together, and a colon; empty if none."""
    joints = np.concatenate([each.joints for each in problem.sets])
    turns = problem.chain.forward(joints)[:, :3, :3]
    held = [*problem.chain.held]  # reported or not, they stand still or are coupled
    joints, names = (np.delete(x, held, -1) for x in (joints, problem.chain.joint_names))
    moved, found = np.ptp(joints, axis=0) > STILL, ''
    if not moved.all():
        found = f'{", ".join(names[~moved])} stood still (or was not recorded): '
    own = joints[:, moved] - joints[:, moved].mean(axis=0)
    if len(own) > own.shape[1] > 1:
        _, sizes, ways = np.linalg.svd(own, full_matrices=False)
        still = ways[sizes <= STILL * np.sqrt(len(own))]
        alike = names[moved][(np.abs(still) > EXCEPTION).any(axis=0)]
        if len(alike) > 1:
            found += f'{", ".join(alike)} only moved together (if the arm couples them, give '
            found += 'their couplings and equal limits in the chain file): '
    least = np.linalg.norm((turns - turns.mean(axis=0)).reshape(-1, 3), -2) / len(turns) ** 0.5
    level = 'the tool points one way in all poses (tilt it): '
    return found or (level if least < DEGENERATE else '')


def oddities(
    problem: Problem, posterior: Posterior, step: Step | None, coarse: Mapping[Parameter, float]
) -> tuple[str, ...]:
    """Return what is suspicious about a result but no reason to refuse it.

    `coarse` holds the steps [rad or m] of rounded joint values.
    """
    found = [] if step is None or step.harmful else [str(step)]
    steps: dict[str, list[str]] = {}
    for name, size in coarse.items():
        steps.setdefault(resolution_in_words(size, name.unit), []).append(name.owner)
    if steps:
        each = [f'{step} ({", ".join(names)})' for step, names in steps.items()]
        found.append(f'joint values are multiples of {", ".join(each)}: record more digits')
    ratios = [n for n in effects.members(posterior.chain, 'ratio') if n in posterior.names]
    found += [wrong_ratio(name.owner, posterior.chain.value(name)) for name in ratios]
    listed, chain = problem.chain.parallel or (), problem.chain
    ours = replace(chain, parallel=None).parallel or ()
    for names, others, does, are in ((ours, listed, 'omits', ''), (listed, ours, 'has', 'not ')):
        if wrong := [name for name in names if name not in others]:
            found.append(
                f'"parallel" in the chain file {does} {", ".join(wrong)}, but the axes connected '
                f'there are {are}parallel: leave "parallel" out to derive it'
            )
    return tuple(filter(None, (*found, _one_sided(problem, posterior))))


def _one_sided(problem: Problem, posterior: Posterior) -> str:
    """Return which joints moved to all poses from one side, and the play expected of them."""
    signs = [each.approach for each in problem.sets if each.approach is not None]
    if not signs:
        return ''
    moves, found = np.concatenate(signs), list[str]()
    known = np.median(np.abs(moves), axis=0) > 0.0  # of most poses
    same = (moves.min(axis=0) * moves.max(axis=0) >= 0.0) & known
    play = effects.members(problem.chain, 'backlash')
    for name in (play[k] for k in np.flatnonzero(same) if play[k] not in problem.given):
        if name in posterior.names:
            k = posterior.names.index(name)
            size = float(np.sqrt(posterior.square[k, k]))
            if size > EXCEPTION * effects.expected(name):
                found.append(f'{name.owner} (± {1e3 * size:.2g} m{name.unit})')
    stated = ','.join(dict.fromkeys(f'*.{name.kind}=1e-6' for name in play))
    return bool(found) * (
        f'{", ".join(some(found))} moved to all poses from the same side, which hides play: '
        'expected errors include its likely size. Approach poses from both sides to measure '
        'it; if the same side is also used later, it does no harm: --model backlash --priors '
        f'"{stated}"'
    )
