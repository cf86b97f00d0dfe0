# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Why a calibration was refused, for readers without a background in calibration.

Each rule of acceptance has a heading, what it means, and what to do in the order in which to try
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from calib_ros.identification.reasons import Reason, Rule


@dataclass(frozen=True)
class Advice:
    """A refusal in plain words: heading, meaning, what to do, the refusal itself.

    `again` tells on what to identify then. What follows from another refusal has no steps: its
    `meaning` says so.
    """

    heading: str
    meaning: str
    steps: tuple[str, ...]
    refusal: str = ''
    again: str = 'on the measurements so far and the new ones'


RIGHT_CHAIN = (
    'Check that the chain is that of the arm measured (type, size and generation).',
    'Check the units: joint values in radians, positions in metres.',
    'Check that the joint values are in the order of the arm, from its foot to its tool.',
)
STOOD = (
    'If the error is much larger, check that the arm stood still at each pose, that the target is '
    'fixed to the flange, and the device to the floor.'
)
SPREAD = 'spread over the whole workspace, with every joint moved through most of its range'

RULES: dict[Rule, Advice] = {
    Rule.ENCODER: Advice(
        'A joint lost its zero while you measured',
        'From one pose on, one joint reads differently than before. Earlier measurements no '
        'longer describe the arm.',
        (
            'Check the mastering (zero position) of the joint named. Did its encoder slip?',
            'Keep only the measurements after the slip, or measure again.',
        ),
        again='on what was measured after the slip',
    ),
    Rule.MOVED: Advice(
        'Something moved while you measured',
        'From one pose on, all measurements are shifted alike. The target, the measuring '
        'device or the foot of the robot was bumped or moved.',
        (
            'Fasten the target, the device and the robot, then measure again.',
            'Or keep the data: name two sessions, before and after, in the column session of the '
            'table or journal, and fit both (--session with both names).',
        ),
        again='on the new measurements alone, or on the two sessions',
    ),
    Rule.OWN_BEHAVIOUR: Advice(
        'The poses set aside show the arm itself',
        'Some poses did not fit and were set aside as faulty measurements. But they all depend '
        'on one joint: the cause is the arm, not the device.',
        (
            'Set model to auto, which looks for such effects, and run again.',
            'Or set loss to none, so that no pose is set aside.',
        ),
    ),
    Rule.CONVERGENCE: Advice(
        'The computation found no stable answer',
        'The measurements contradict each other, or the description of the arm, too much: no '
        'set of corrections fits.',
        (*RIGHT_CHAIN, f'Measure more poses, {SPREAD}.'),
    ),
    Rule.EXCITATION: Advice(
        'Some joints hardly moved',
        'A joint shows its errors only when it moves. These poses say nothing about the '
        'parameters named.',
        (
            f'Add poses {SPREAD}. `calib_ros plan` chooses them.',
            'If a joint cannot move, name its parameters in fixed.',
        ),
    ),
    Rule.COMMON_SENSE: Advice(
        'This does not look like the right arm',
        'A correction as large as this cannot come from manufacturing or wear. Most often '
        'the description is that of another arm, or units or columns are mixed up. A small error '
        'afterwards proves nothing: so large a correction turns one arm into another.',
        RIGHT_CHAIN,
    ),
    Rule.LARGEST_ERROR: Advice(
        'The arm does not behave like its description',
        'A large error remains even after the correction. Most often the description is '
        'that of another arm, or units or columns are mixed up.',
        RIGHT_CHAIN,
    ),
    Rule.CONFIGURATIONS: Advice(
        'Too few poses were measured',
        'A correction must be tested on poses not used to compute it. There are not enough '
        'poses for both.',
        (f'Measure at least 30 different poses in all, {SPREAD}. Those you have count.',),
    ),
    Rule.OUTLIERS: Advice(
        'Too many measurements do not fit',
        'More than a third of the poses disagree with all the others. Then nobody can tell '
        'which ones are right.',
        (
            'Check that joint values and measurements belong to the same moment (the arm must '
            'stand still, and clocks must agree).',
            'Check that the target is fixed to the flange and the device to the floor.',
            *RIGHT_CHAIN,
        ),
    ),
    Rule.GAIN: Advice(
        'The correction does not make the arm better',
        'On poses not used to compute it, the corrected arm is no closer to the measurements '
        'than the uncorrected one, or only by as much as chance explains. The arm may be as '
        'good as it gets, or the device too coarse to show more.',
        (
            'Compare the error before with the accuracy of the measuring device. If they '
            'are similar, stop, because this device cannot measure any improvement.',
            STOOD,
            f'Measure more poses, {SPREAD}.',
            'Set model to auto: the error may come from gears or gravity.',
        ),
    ),
    Rule.DRIFT: Advice(
        'The measuring device may have drifted',
        'The errors may have changed slowly during the session, as when a measuring device '
        'warms up or settles. The correction would then make up for the device, not for the '
        'robot, and be wrong tomorrow.',
        (
            'Let the measuring device warm up.',
            'Measure the same poses again in random order.',
            'If that is refused as well, measure more poses, with larger movements between them.',
        ),
        again='on the new measurements alone',
    ),
    Rule.REGION: Advice(
        'The correction is not certain enough to help',
        'The correction is smaller than its own uncertainty, even at the poses measured. '
        'Used on the arm, it could make it worse.',
        (
            f'Measure more poses, {SPREAD}. `calib_ros plan --chain ROBOT --accuracy MM` says how '
            'many.',
            'Or use a more accurate device, and measure orientation too if it was position only.',
        ),
    ),
    Rule.GAIN_WITH_OUTLIERS: Advice(
        'The correction helps most poses and harms some',
        'Some poses were set aside as faulty measurements. Counting them, the corrected arm '
        'is worse than before. Perhaps they were right.',
        (
            'Look at the poses marked as outliers, and measure them again.',
            'Set model to auto or loss to none.',
        ),
    ),
    Rule.ROUNDING: Advice(
        'The joint values are too coarse',
        'The recording rounds the joint values. This rounding alone could cause the whole '
        'improvement.',
        (
            'Record the joint values with all their digits, as the controller knows them.',
            'Measure different poses rather than the same ones many times.',
        ),
    ),
    Rule.ORIENTATION: Advice(
        'The correction makes the orientation worse',
        'On poses not used to compute it, the corrected arm points less precisely than before. '
        'Often the stated accuracy of the device is wrong.',
        (
            'Check sigma_position and sigma_orientation against the data sheet of the device.',
            'Check that the target sits rigidly on the flange.',
        ),
    ),
    Rule.SCALE: Advice(
        'The measuring device is out of scale',
        'All lengths of the arm came out too long or too short by the same factor. No arm '
        'is built like that; a measuring device with a wrong scale looks just like it.',
        (
            'Check the scale of the device with a known length, such as a scale bar.',
            'Check the temperature and pressure set in the device.',
        ),
        again='on new measurements alone: those so far have the wrong scale',
    ),
    Rule.UNKNOWN_LOSS: Advice(
        'Nobody can tell how much of the recording is missing',
        'The recording does not say how many messages it should hold. Those missing could be '
        'just the poses that matter.',
        (
            'Repair the recording (`ros2 bag reindex`).',
            'If you know it is complete, run with --largest-loss 1.',
        ),
    ),
    Rule.UNREADABLE: Advice(
        'A part of the recording cannot be read',
        'The recording is damaged. The missing part could be just the poses that matter.',
        (
            'Copy the recording again from the computer that made it.',
            'If the rest is enough, run with the --largest-loss named.',
        ),
    ),
    Rule.DROPPED: Advice(
        'Much of the recording could not be used',
        'Joint values and measurements are matched by their time stamps. Too many stamps match '
        'nothing.',
        (
            'Make the clocks of robot and measuring device agree (NTP or PTP).',
            'Record both from the same computer.',
            'If the rest is enough, run with the --largest-loss named.',
        ),
    ),
    Rule.MISTAKE: Advice(
        'A setting does not match the measurements',
        'As given, the measurements do not fit this arm. With the change below they do.',
        (
            'Check at the robot and in the data whether it is so.',
            'If it is, make the change; where there are two, either of them.',
        ),
        again='on the same measurements: no new ones are needed',
    ),
    Rule.POSED: Advice(
        'The joint values were not measured',
        'Only the places of camera and board were computed, not the arm.',
        ('Record the joint values at each image to calibrate the arm.',),
    ),
}


GOOD_ARM = Advice(
    'There is nothing to correct that this device could see',
    'The error is within the stated noise of the measuring device: the arm is as good as this '
    'device can see.',
    ('To look for smaller errors, measure with a more accurate device.',),
)
"""In place of `Rule.GAIN`, where the error before is no larger than the noise."""

WRONG_ARM = (Rule.MISTAKE, Rule.COMMON_SENSE, Rule.LARGEST_ERROR)
"""Where the description does not fit the arm."""
WRONG = {
    *WRONG_ARM,
    Rule.CONVERGENCE,
    Rule.DRIFT,
    Rule.GAIN,
    Rule.REGION,
    Rule.ORIENTATION,
    Rule.SCALE,
}
"""What a description that does not fit brings by itself."""
BRINGS = dict.fromkeys(WRONG_ARM, WRONG) | {
    rule: {rule, Rule.OUTLIERS} for rule in (Rule.ENCODER, Rule.MOVED)
}
"""What each cause brings by itself; the first cause that is there counts."""

NOISY = 10.0
"""Ratio of what is left to the stated noise that an arm's own errors rarely reach."""


def advice(reasons: Sequence[Reason], left: float = 1.0) -> tuple[Advice, ...]:
    """Return the refusals in plain words, those of one rule together.

    `left` is the ratio of what is left after the correction to the stated noise.
    """
    found: dict[Rule, list[str]] = {}
    for each in reasons:
        found.setdefault(each.rule, []).append(str(each))
    told = []
    for rule, texts in found.items():
        one = replace(RULES[rule], refusal='; '.join(texts))
        causes = (each for each, brought in BRINGS.items() if each in found and rule in brought)
        if (cause := next(causes, rule)) is not rule:
            follows = f'This probably follows from "{RULES[cause].heading}": mend that first.'
            one = replace(one, meaning=follows, steps=())
        elif left >= NOISY and rule in {Rule.GAIN, Rule.REGION}:
            steps = (each for each in one.steps if each is not STOOD)
            one = replace(one, steps=(_coarse(left), *steps))
        told.append(one)
    return tuple(told)


def _coarse(left: float) -> str:
    """Return what to check before more is measured, where the measurements are far too coarse."""
    return (
        f'The measurements scatter {left:.0f} times as much as stated for the device: before you '
        'measure more, check that the target sits firmly, that the arm stood still, that clocks '
        'agree, and the units.'
    )
