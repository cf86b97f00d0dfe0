# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Why a calibration was refused, for readers without a background in calibration.

The advice of `refusals.py` is sorted by causes, and suits the situation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from calib_ros.decision.reasons import Reason, Rule
from calib_ros.estimation.levels import ALIKE
from calib_ros.report.refusals import Advice, rules
from calib_ros.settings import EXCEPTION

ENOUGH = 25  # poses worth judging, and the default of `calib_ros plan`: a convention
SPREAD_OUT = 'spread over the whole workspace, with every joint moved through most of its range'

UNSURE = {Rule.GAIN, Rule.REGION}
WRONG = {*UNSURE, Rule.COMMON_SENSE, Rule.LARGEST_ERROR, Rule.CONVERGENCE}
WRONG |= {Rule.DRIFT, Rule.ORIENTATION}
"""Consequences of a description that does not fit."""
BRINGS = {
    Rule.LAG: {*WRONG, Rule.SCALE, Rule.OUTLIERS},
    Rule.MISTAKE: {*WRONG, Rule.SCALE, Rule.ENCODER, Rule.MOVED, Rule.OWN_BEHAVIOUR},
    Rule.SCALE: WRONG,
    Rule.CONFIGURATIONS: {Rule.ENCODER, Rule.MOVED},
    Rule.ENCODER: {*UNSURE, Rule.OUTLIERS, Rule.LARGEST_ERROR, Rule.ORIENTATION},
    Rule.MOVED: {*UNSURE, Rule.OUTLIERS, Rule.LARGEST_ERROR, Rule.ORIENTATION},
    Rule.EXCITATION: {*UNSURE, Rule.ORIENTATION},
    Rule.COMMON_SENSE: WRONG,
    Rule.LARGEST_ERROR: WRONG,
    Rule.GAIN: {Rule.ORIENTATION},
}
"""Consequences of each cause; the first cause told counts."""
TOLD_TWICE = {Rule.LAG, Rule.SCALE}
"""Rules whose steps tell the last part of their reasons, too."""

FAR = 1.0 / EXCEPTION
"""Ratio of residuals to stated noise that an arm's own errors rarely reach."""
COARSE = (
    'The remaining error is {:.0f} times the assumed device noise: check that target and device '
    'sit firmly, the arm stood still, the clocks agree, and joint values have all their digits.'
)
"""First check if the measurements are far too coarse."""
FEW_POSES = 'Only {} different poses were measured: too few to be sure of anything about the arm.'
LEFT = (
    'The remaining error corresponds to a device noise of {:.2g} mm in each direction; {:.2g} mm '
    'is assumed (--sigma-position).'
)
DRIFTS = (
    'Poses measured in succession have similar errors, as if the device drifted: let it warm up '
    'as long as its manual says, then measure all poses again in random order.'
)
DIGITS = (
    'Record the joint values with all their digits: their rounding alone causes an error of about '
    '{:.2g} mm.'
)
"""First step if rounded joint values explain most of what is left."""
FINER = (
    'If the device is accurate to less than {:.2g} mm by its data sheet, state that '
    '(--sigma-position, in metres): the measurements scatter by only {:.2g} mm.'
)
"""First step if a correction is uncertain by the stated noise of the device alone."""
OUTLYING = (
    'Look at what fits far worse than the rest ({} poses; in the report: outliers only): what do '
    'these have in common?'
)
"""First step if much is left, and it is not alike everywhere."""
IN_BETWEEN = (
    'The held-out poses do not fit the others: was the device, target or arm moved in between? '
    'Then measure all again.'
)
"""First step if these were chosen, and are further off than expected."""


@dataclass(frozen=True)
class Situation:
    """Different poses, residual over stated noise, that noise [m], and what else is known.

    Whether poses share errors in succession only, how many are outliers, whether chosen held-out
    poses are further off than expected, which marks in `refusals.md` make a step needless, and the
    error [mm] by rounded joint values if it is at least half of what is left.
    """

    poses: int = ENOUGH
    left: float = 1.0
    sigma: float | None = None
    drifts: bool = False
    outliers: int = 0
    contradicted: bool = False
    needless: tuple[str, ...] = ()
    rounding: float = 0.0

    @property
    def coarse(self) -> bool:
        """Tell whether the measurements are far too coarse, and not by rounding."""
        return self.left >= FAR and not self.rounding

    def first_of(self, rule: Rule) -> tuple[str, ...]:
        """Return what to do before the steps of a rule."""
        found = []
        if rule in {*UNSURE, Rule.LARGEST_ERROR} and self.rounding:
            found.append(DIGITS.format(self.rounding))
        if rule in {Rule.GAIN, Rule.LARGEST_ERROR} and self.contradicted:
            found.append(IN_BETWEEN)
        elif rule is Rule.LARGEST_ERROR and self.outliers:
            found.append(OUTLYING.format(self.outliers))
        elif rule is Rule.GAIN and self.drifts:
            found.append(DRIFTS)
        elif rule is Rule.REGION and self.sigma and self.left * ALIKE < 1.0:
            found.append(FINER.format(1e3 * self.sigma, 1e3 * self.left * self.sigma))
        return tuple(found)

    def said_of(self, one: Advice) -> Advice:
        """Return the advice on an unproven correction that suits the situation."""
        if self.coarse:
            return replace(one, steps=(COARSE.format(self.left), *one.steps))
        if self.poses < ENOUGH:
            marked = zip(one.steps, one.unless, strict=True)
            steps = [step for step, mark in marked if mark == 'auto']
            steps += rules()[Rule.CONFIGURATIONS].steps
            return replace(one, meaning=FEW_POSES.format(self.poses), steps=tuple(steps))
        if self.sigma is None:
            return one
        left = LEFT.format(1e3 * self.left * self.sigma, 1e3 * self.sigma)
        return replace(one, meaning=f'{one.meaning} {left}')


def advice(reasons: Sequence[Reason], situation: Situation = Situation()) -> tuple[Advice, ...]:
    """Return the refusals in plain words, grouped by rule, consequences last, each step once."""
    found: dict[Rule, list[Reason]] = {}
    for each in reasons:
        found.setdefault(each.rule, []).append(each)
    advised: list[Advice] = []
    following: dict[Rule, list[Reason]] = {}
    for rule, texts in found.items():
        causes = (each for each in found if rule in BRINGS.get(each, ()))
        if (cause := next(causes, rule)) is not rule:
            following.setdefault(cause, []).extend(texts)
            continue
        general = rules()[rule]
        short = general.heading
        if rule is Rule.MISTAKE:
            short += f': {"; ".join(each.short for each in texts)}'
        needless = (*situation.needless, *['coarse'] * situation.coarse)
        marked = zip(general.steps, general.unless, strict=True)
        kept = [each for each in marked if each[1] not in needless]
        steps, unless = (tuple(each[k] for each in kept) for k in (0, 1))
        told = replace(general, steps=steps, unless=unless)
        named = [each.short for each in texts] if rule in TOLD_TWICE else texts
        refusal = replace(told, refusal='; '.join(named), in_short=short)
        if rule in UNSURE:
            refusal = situation.said_of(refusal)
        first = situation.first_of(rule)
        if DRIFTS in first:
            refusal = replace(refusal, again=rules()[Rule.DRIFT].again)
        said = {step for each in advised for step in each.steps}
        steps = tuple(each for each in (*first, *refusal.steps) if each not in said)
        advised.append(replace(refusal, steps=steps))
    for cause, texts in following.items():
        heading = f'Likely consequences of "{rules()[cause].heading}"'
        advised.append(Advice(heading, '', (), '; '.join(each.short for each in texts)))
    return tuple(advised)
