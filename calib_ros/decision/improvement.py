# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a correction improves the arm beyond chance, and makes nothing worse."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import special

from calib_ros.decision.comparison import COUNTS, Comparison, log_gain, mean_squares
from calib_ros.decision.moved import name_of
from calib_ros.decision.reasons import Reason, Rule
from calib_ros.decision.result import Identification
from calib_ros.decision.scale import out_of_scale, stated_length
from calib_ros.decision.trials import position_fault_limit
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.levels import ALIKE, CERTAIN, CLEARLY, CONFIDENT
from calib_ros.estimation.problem import Problem
from calib_ros.kinematics.se3 import Flags, norms
from calib_ros.shown import rounded


def _gain(
    validation: Comparison, part: str, which: Flags, *confidence: float
) -> tuple[float, float]:
    """Return the `log_gain` in `position` or `orientation` of pairs by a mask (N,)."""
    before, after = (getattr(each, part)[which] for each in (validation.before, validation.after))
    return log_gain(before, after, validation.after.configurations[which], *confidence)


def gain_refusals(
    problem: Problem, result: Identification, validation: Comparison, sized: bool, scaled: float
) -> Iterator[Reason]:
    """Yield why the gain on held-out poses does not count; arguments as in `refusals`."""
    before, after = validation.figures
    judged = validation.deciding
    gain, limit = _gain(validation, 'position', judged)
    largest = 1e3 * position_fault_limit(problem)
    tiny = largest < 1e3 * problem.largest_error
    if after.rms_mm > largest and (before.rms_mm > largest or gain > limit):
        yield Reason(
            Rule.LARGEST_ERROR,
            f'RMS {rounded(after.rms_mm)} mm remains on held-out poses, more than '
            f'{largest:.3g} mm (largest_error{"; less of so small an arm" * tiny})',
        )
    if not gain > limit:
        text = f'RMS {rounded(before.rms_mm)} mm before, {rounded(after.rms_mm)} mm after'
        if gain > 0.0:
            count = count_distinct(validation.after.configurations[judged])
            chance = before.rms_mm * np.exp(-limit)
            text += f'; with {count} {validation.kind}, chance alone can lower it to '
            text += f'{rounded(chance)} mm'
        if validation.kind == 'stations':
            text += '; most joints stood still within each: move all joints from pose to pose'
        text += _without_worst(problem, validation)
        yield Reason(Rule.GAIN, f'no gain on held-out poses beyond chance ({text})')
    elif result.chance is not None and result.chance > 1.0 - CONFIDENT:
        yield Reason(
            Rule.DRIFT,
            'a slow drift may explain the gain: errors shifted to the wrong poses can be '
            f'corrected just as well in {100.0 * result.chance:.0f} % of cases '
            f'(limit {100.0 * (1.0 - CONFIDENT):.0f} %)',
        )
    elif scaled and not result.surprise:
        length, strain = stated_length(problem), result.posterior.strain
        text = out_of_scale(scaled, length, problem.sigma_scale, strain)
        yield Reason.with_remedy(Rule.SCALE, result.strain or text)
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


def _without_worst(problem: Problem, validation: Comparison) -> str:
    """Return which pose alone hides a gain, certain without it, as the end of a sentence."""
    after, judged = validation.after, validation.deciding
    far = np.where(judged, norms(after.position), 0.0)
    worst = int(far.argmax())
    judged[worst] = False
    gain, limit = _gain(validation, 'position', judged, CERTAIN)
    if not gain > limit:
        return ''
    ends = np.cumsum([len(each) for each in problem.all_sets])
    row = worst + (0 if validation.repeated is None else ends[len(problem.sets) - 1])
    number = int(np.searchsorted(ends, row, 'right'))
    seen = problem.all_sets[number]
    if seen.pixels is not None:  # rows are points of an image
        return ''
    name, off = name_of(problem, number, row - ends[number] + len(seen)), 1e3 * far[worst]
    return f'; without {name}, {rounded(off)} mm off, there is one: measure it again'


def harm_refusals(validation: Comparison, may_be_rounding: bool, helps: bool) -> Iterator[Reason]:
    """Yield what the correction makes worse; arguments as in `refusals`."""
    if helps and validation.outliers:
        first, second = validation.figures_of_all
        gain, limit = _gain(validation, 'position', validation.counting, CERTAIN)
        limit = max(limit, _loss_by_chance(validation), COUNTS)
        caused = second.rms_mm > first.rms_mm and _causes_outliers(validation)
        if second.mean_mm > first.mean_mm or gain < -limit or caused:
            yield Reason(
                Rule.GAIN_WITH_OUTLIERS,
                'with the outliers the error on held-out poses got worse (RMS '
                f'{rounded(first.rms_mm)} mm before, {rounded(second.rms_mm)} mm after; mean '
                f'{rounded(first.mean_mm)} and {rounded(second.mean_mm)} mm)',
            )
    if may_be_rounding:
        text = 'rounded joint values that repeat in many poses may cause most of the correction'
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
