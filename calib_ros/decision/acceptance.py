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
from scipy import special

from calib_ros.decision.comparison import COUNTS, Comparison, log_gain, mean_squares
from calib_ros.decision.moved import Step
from calib_ros.decision.reasons import Reason, Rule
from calib_ros.decision.result import Identification
from calib_ros.estimation.configurations import STILL
from calib_ros.estimation.fitted import ParameterRow
from calib_ros.estimation.identifiability import DEGENERATE
from calib_ros.estimation.levels import (
    ALIKE,
    CERTAIN,
    CLEARLY,
    CONFIDENT,
    LARGEST_SCALE,
    MOST_OUTLIERS,
)
from calib_ros.estimation.problem import Problem
from calib_ros.kinematics.se3 import Flags
from calib_ros.settings import EXCEPTION
from calib_ros.shown import rounded, some


def refusals(
    problem: Problem,
    result: Identification,
    own_behaviour: str | None,
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
        count = len(np.unique(result.fitted.after.configurations))
        text = f'{count} different poses: too few to hold some out'
        return (*failed, Reason(Rule.CONFIGURATIONS, text))
    share = validation.share_of_outliers
    if share > MOST_OUTLIERS:
        if result.step is not None and not result.step.harmful:
            failed.append(result.step.reason)
        text = f'{100.0 * share:.0f} % of the judged poses are outliers'
        return (*failed, Reason(Rule.OUTLIERS, text))
    gained = tuple(_gain_refusals(problem, result, validation, sized, scaled))
    before, after = validation.figures
    helps = after.rms_mm < before.rms_mm or all(each.rule is not Rule.GAIN for each in gained)
    if after.rms_mm > max(1e3 * problem.largest_error, before.rms_mm / ALIKE):
        # of a fit that explains nothing the parameters tell nothing
        failed = [each for each in failed if each.rule is not Rule.COMMON_SENSE]
    return (*failed, *gained, *_harm_refusals(validation, may_be_rounding, helps))


def _fit_refusals(
    problem: Problem, result: Identification, own_behaviour: str | None
) -> Iterator[Reason]:
    """Yield failed rules that do not depend on held-out poses."""
    if result.step is not None and result.step.harmful:
        yield result.step.reason
    if own_behaviour is not None:
        yield Reason(Rule.OWN_BEHAVIOUR, own_behaviour)
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
        text = f'off by more than even a faulty robot of this kind: {", ".join(far)}'
        yield Reason(Rule.COMMON_SENSE, text)


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


def _gain(
    validation: Comparison, part: str, which: Flags, *confidence: float
) -> tuple[float, float]:
    """Return the `log_gain` in `position` or `orientation` of pairs by a mask (N,)."""
    before, after = (getattr(each, part)[which] for each in (validation.before, validation.after))
    return log_gain(before, after, validation.after.configurations[which], *confidence)


def _gain_refusals(
    problem: Problem, result: Identification, validation: Comparison, sized: bool, scaled: float
) -> Iterator[Reason]:
    before, after = validation.figures
    judged = validation.deciding
    gain, limit = _gain(validation, 'position', judged)
    largest = 1e3 * problem.largest_error
    if after.rms_mm > largest and (before.rms_mm > largest or gain > limit):
        yield Reason(
            Rule.LARGEST_ERROR,
            f'RMS {rounded(after.rms_mm)} mm remains on held-out poses, more than '
            f'{largest:g} mm (largest_error)',
        )
    if not gain > limit:
        text = f'RMS {before.rms_mm:.3f} mm before, {after.rms_mm:.3f} mm after'
        if gain > 0.0:
            count = len(np.unique(validation.after.configurations[judged]))
            kind = 'places' if all(each.socket for each in problem.sets) else 'poses'
            chance = before.rms_mm * np.exp(-limit)
            text += f'; with {count} {kind}, chance alone can lower it to {chance:.3f} mm'
        yield Reason(Rule.GAIN, f'no gain on held-out poses beyond chance ({text})')
    elif result.chance is not None and result.chance > 1.0 - CONFIDENT:
        yield Reason(
            Rule.DRIFT,
            'a slow drift may explain the gain: shifted to the wrong poses, errors can be '
            f'corrected just as well in {100.0 * result.chance:.0f} % of cases '
            f'(limit {100.0 * (1.0 - CONFIDENT):.0f} %)',
        )
    elif scaled and not result.surprise:
        printed = all(each.pixels is not None for each in problem.sets)
        yield Reason(Rule.SCALE, out_of_scale(scaled, printed))
    elif result.region is not None and result.surprise and before.rms_mm < ALIKE * after.rms_mm:
        yield Reason(
            Rule.REGION,
            f'{result.contradiction}, and the correction lowers their error by less than a third',
        )
    elif result.region is None:
        text = 'the correction is not larger than its own uncertainty, even at the poses measured'
        text += f': {result.contradiction}' if result.surprise else ''
        if not sized:
            text += (
                '; measure something that fixes the size and shape of the arm: positions, or two '
                'sockets a known distance apart'
            )
        used = dict.fromkeys(key for each in problem.sets for key in (each.base, each.tool))
        if held := [key for key in used if problem.model.frame(key).fixed]:
            text += (
                f'; if the {" or ".join(held)} held by the chain file may be off, remove fixed: '
                'true there'
            )
        yield Reason(Rule.REGION, text)


def out_of_scale(scale: float, printed: bool = False, checked: bool = False) -> str:
    """Return that a scale of the device, given minus one, may make the calibrated arm worse.

    Of a `printed` board it is that of its stated size.
    """
    way, size = ('grow', 'large') if scale > 0.0 else ('shrink', 'small')
    grown = f'all lengths of the arm {way} alike, by {percent(abs(scale))} %'
    if checked:
        return (
            f'{grown}, more than sigma_scale allows: measure a known length, or the printed '
            'board, again'
        )
    text = f'{grown}, as if the measuring device were out of scale; then'
    check = 'If a known length shows that its'
    if printed:
        check = 'Measure the print; if its'
        text = f'{grown}, as if the board were stated too {size}; then'
        if abs(scale) < LARGEST_SCALE:  # as arms do
            text = 'the size of the board is not known well enough:'
    return (
        f'{text} the correction may make the arm worse. {check} scale is right, set sigma_scale '
        '(--sigma-scale) to its accuracy'
    )


def percent(share: float) -> str:
    """Return a small share in percent, with two digits."""
    return np.format_float_positional(100.0 * share, 2, fractional=False, trim='-')


def _harm_refusals(validation: Comparison, may_be_rounding: bool, helps: bool) -> Iterator[Reason]:
    if helps and validation.outliers:
        first, second = validation.figures_of_all
        gain, limit = _gain(validation, 'position', validation.counting, CERTAIN)
        limit = max(limit, _loss_by_chance(validation), COUNTS)
        caused = second.rms_mm > first.rms_mm and _causes_outliers(validation)
        if second.mean_mm > first.mean_mm or gain < -limit or caused:
            yield Reason(
                Rule.GAIN_WITH_OUTLIERS,
                f'with the outliers the error on held-out poses got worse (RMS {first.rms_mm:.3f} '
                f'mm before, {second.rms_mm:.3f} mm after; mean {first.mean_mm:.3f} and '
                f'{second.mean_mm:.3f} mm)',
            )
    if may_be_rounding:
        text = 'the improvement may only come from rounded joint values that repeat in many poses'
        yield Reason(Rule.ROUNDING, text)
    before, after = validation.figures
    if after.rms_mrad is not None:
        gain, limit = _gain(validation, 'orientation', validation.deciding)
        if gain < -max(limit, COUNTS):
            yield Reason(
                Rule.ORIENTATION,
                f'the orientation got worse on held-out poses (RMS {before.rms_mrad:.3f} mrad '
                f'before, {after.rms_mrad:.3f} mrad after)',
            )


def _loss_by_chance(validation: Comparison) -> float:
    """Return the log of RMS after / RMS before, outliers included, that chance could cause.

    A correction makes a much larger gross error bigger or smaller at random. Student's t of the
    differences of squares accounts for that, even with a single outlier.
    """
    which, groups = validation.counting, validation.after.configurations
    before, after = (each.position[which] for each in (validation.before, validation.after))
    means = mean_squares(before, after, groups[which])
    count = means.shape[1]
    if count < 2:
        return np.inf
    error = np.diff(means, axis=0).std(ddof=1) / np.sqrt(count)
    likely = special.stdtrit(count - 1, CERTAIN) * error
    return 0.5 * float(likely / max(means[0].mean(), 1e-300))


def _causes_outliers(validation: Comparison) -> bool:
    """Tell whether the correction itself causes outliers, so that these are no gross errors.

    Gross errors e do not know the correction c: 2 e c, by which their squares before exceed those
    after (beside c^2), has either sign and a variance of 4/3 |e|^2 |c|^2. Errors clearly larger
    than the correction are not caused by it.
    """
    which = validation.counting & ~validation.judged
    before, after = (each.position[which] for each in (validation.before, validation.after))
    change = before - after
    lengths, errors = (np.linalg.norm(each, axis=1) for each in (change, after))
    near = errors < CLEARLY * lengths
    along = (after * change)[near].sum()
    chance = special.ndtri(CERTAIN) * np.linalg.norm((errors * lengths)[near]) / np.sqrt(3.0)
    return bool(along < -chance)


def oddities(problem: Problem, step: Step | None, coarse: Mapping[str, float]) -> tuple[str, ...]:
    """Return what is suspicious about a result but no reason to refuse it.

    `coarse` holds the steps [rad or m] of rounded joint values.
    """
    found = [] if step is None or step.harmful else [str(step)]
    units = {joint.name: joint.driven.unit for joint in problem.chain.joints}
    steps: dict[str, list[str]] = {}
    for name, size in coarse.items():
        steps.setdefault(f'{1e3 * size:.3g} m{units[name]}', []).append(name)
    if steps:
        each = [f'{step} ({", ".join(names)})' for step, names in steps.items()]
        found.append(f'joint values are multiples of {", ".join(each)}: record more digits')
    listed, chain = problem.chain.parallel or (), problem.chain
    ours = replace(chain, parallel=None).parallel or ()
    for names, others, does, are in ((ours, listed, 'omits', ''), (listed, ours, 'has', 'not ')):
        if wrong := [name for name in names if name not in others]:
            found.append(
                f'"parallel" in the chain file {does} {", ".join(wrong)}, but the axes connected '
                f'there are {are}parallel: leave "parallel" out to derive it'
            )
    return tuple(found)
