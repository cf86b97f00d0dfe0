# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The verdict of a verification as a reader sees it first, and what to do next."""

from __future__ import annotations

from dataclasses import replace

from calib_ros.apply.verified import Verification
from calib_ros.estimation.levels import ALIKE
from calib_ros.report.advice import SPREAD_OUT
from calib_ros.report.content import Headline
from calib_ros.report.remarks import causes
from calib_ros.shown import sentence

SOMETHING_MOVED = (
    'Check that measuring device, target and robot have not moved since the calibration; if one '
    'has, use --new-base or --new-tool.'
)
ACTIVE = 'Check that the correction is active in the controller.'
TOLERANCE = 'For PASS or FAIL, give --tolerance, the RMS error [mm] that your task allows.'
ARCHIVE = 'Keep this page with the calibration. Verify again after a collision or repair.'
STANDINGS: dict[str, tuple[Headline, tuple[str, ...]]] = {
    'PASS': (Headline('good', 'PASS: the arm is within the tolerance'), (ARCHIVE,)),
    'FAIL': (
        Headline('bad', 'FAIL: the arm exceeds the tolerance'),
        (SOMETHING_MOVED, ACTIVE, 'Calibrate again with new poses; try --model auto.'),
    ),
    'UNDECIDED': (
        Headline('open', 'UNDECIDED: too few measurements to tell'),
        (f'Measure more poses, {SPREAD_OUT}, and verify again with all of them.',),
    ),
    'does not hold': (
        Headline('bad', 'The calibration no longer holds'),
        (
            SOMETHING_MOVED,
            'Calibrate again with new poses, or update the calibration with a few (identify '
            '--previous).',
        ),
    ),
    'holds': (
        Headline('good', f'The calibration holds: at most {ALIKE:g} times the expected error'),
        (ARCHIVE, TOLERANCE),
    ),
    'no verdict': (Headline('info', 'No verdict without a tolerance'), (TOLERANCE,)),
}
AT_THE_LIMIT = (
    Headline('open', 'UNDECIDED: the error is as large as the limit'),
    (
        'More poses would hardly decide. Set a larger --tolerance if the task allows it; else '
        'calibrate again with new poses, and try --model auto.',
    ),
)
NOISY = (
    Headline('open', 'UNDECIDED: the device has too much noise to tell'),
    (
        'Verify with a device as accurate as that of the calibration, or give a --tolerance.',
        'If it is as accurate, check for play in the joints and a loose target.',
    ),
)
UNSAID = (
    'State the noise of the device (--sigma-position), or, with few poses, measure more: 30 tell '
    'noise from a change.'
)
REUSED = (
    Headline('open', 'No verdict: the calibration was computed from these measurements'),
    (f'Measure new poses, {SPREAD_OUT}, and verify with those alone.',),
)
WITHIN = (
    'Measure more poses within the region of the calibration, and verify again with all that are '
    'within it.'
)
MISTAKEN = (
    Headline('open', 'No verdict: the measurements do not fit the arm'),
    ('Check what is named in the robot and in the data, correct it, and verify again.',),
)


def standing(found: Verification) -> tuple[Headline, tuple[str, ...]]:
    """Return the verdict as a reader sees it first, and what to do next."""
    if found.mistake:
        return MISTAKEN
    if found.reused and found.verdict == 'no verdict':
        return REUSED
    state, steps = STANDINGS[found.verdict]
    if found.verdict == 'UNDECIDED' and found.needed is None and not found.outside:
        state, steps = NOISY if found.noise else AT_THE_LIMIT
        steps = (sentence(found.overstated),) if found.overstated else steps
        steps = (UNSAID, *steps) if found.noise and found.unstated else steps
    if not found.by_program:  # nor whether the correction reaches the arm
        state = replace(state, heading=state.heading.replace('the arm', 'the calibration'))
        steps = tuple(each for each in steps if each != ACTIVE)
    if found.verdict == 'UNDECIDED' and found.outside:
        steps = (WITHIN,)
    if state.state in ('bad', 'open') and (why := causes(found)):
        steps = tuple(map(sentence, why))
    return state, steps
