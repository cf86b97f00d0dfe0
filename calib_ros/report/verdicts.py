# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A verification in words, and its page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros.apply.judgement import DECIDING
from calib_ros.apply.verified import Verification
from calib_ros.estimation.levels import ALIKE, NEARER
from calib_ros.identification.records import reused_in_words
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import table_hash
from calib_ros.kinematics.se3 import norms
from calib_ros.report import sections
from calib_ros.report.advice import SPREAD_OUT
from calib_ros.report.content import Headline, Origin, Report, Section, section
from calib_ros.report.explorer import explorer
from calib_ros.report.poses import Poses
from calib_ros.report.words import interval_mm, turned_in_words
from calib_ros.settings import Settings
from calib_ros.shown import rounded, sentence, some

SOMETHING_MOVED = (
    'Check that measuring device, target and robot have not moved since the calibration; if one '
    'has, use --new-base or --new-tool.'
)
ACTIVE = 'Check that the correction is active in the controller.'
COMPUTED = (
    '"Before" is not measured but computed: the nominal arm in its best frames, at the same '
    'joint values.'
)
NO_SCALE = 'Intervals do not include a scale error of the device: check it with a known length.'
TOLERANCE = 'For PASS or FAIL, give --tolerance, the RMS error [mm] that your task allows.'
ARCHIVE = 'Keep this page with the calibration. Verify again after a collision or repair.'
STANDINGS: dict[str, tuple[Headline, tuple[str, ...]]] = {
    'PASS': (
        Headline('good', 'PASS: the arm is within the tolerance'),
        (ARCHIVE,),
    ),
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
        state, steps = AT_THE_LIMIT
    if not found.by_program:  # nor whether the correction reaches the arm
        state = replace(state, heading=state.heading.replace('the arm', 'the calibration'))
        steps = tuple(each for each in steps if each != ACTIVE)
    if found.verdict == 'UNDECIDED' and found.outside:
        steps = (WITHIN,)
    if state.state in ('bad', 'open') and (why := causes(found)):
        steps = tuple(map(sentence, why))
    return state, steps


def likely_rms(found: Verification) -> str:
    """Return the RMS error over poses like these, with its interval."""
    between = interval_mm(1e3 * found.lower, 1e3 * found.upper)
    return f'{rounded(1e3 * found.rms)} mm ({100.0 * found.confidence:g} %: {between} mm)'


def each_in_words(found: Verification) -> list[str]:
    """Return the table lines of the poses [mm]; of ISO 9283 only if the program is known."""
    repeated = any(pose.repeatability is not None for pose in found.each)
    what = 'repeatability' if found.by_program else 'scatter'
    lines = ['  pose   measured   before    after' + repeated * f'   {what} (mean + 3 std)']
    for k, pose in enumerate(found.each, 1):
        line = f'  {k:4} {pose.cycles:10} {rounded(pose.before):>8} {rounded(pose.after):>8}'
        again = '' if pose.repeatability is None else f' {rounded(pose.repeatability):>8}'
        lines.append(line + again)
    return lines if found.each else []


def caveats(found: Verification) -> list[str]:
    """Return what the verdict leaves open, or why there is none."""
    lines = [warning] if (warning := reused_in_words(found.reused)) else []
    if found.mistake:
        return [*lines, str(found.mistake)]
    if not found.by_program:
        lines.append(
            'this judges the calibration, not the corrected robot: give the uncorrected program '
            '(--commanded) to test whether the correction reaches the arm'
        )
    turned = turned_in_words(found.comparison.figures[1])
    return [*lines, turned] if turned and found.common >= NEARER else lines


def remarks(found: Verification) -> list[str]:
    """Return remarks on the figures, and what to do."""
    return [*caveats(found), *hints(found), *causes(found)]


def not_steps(lines: Sequence[str], steps: Sequence[str]) -> list[str]:
    """Return the remarks that are not among the steps."""
    return [each for each in lines if sentence(each) not in steps]


def hints(found: Verification) -> list[str]:
    """Return what was refitted, and what else the figures tell."""
    lines = []
    if found.fitted:
        lines.append(f'{" and ".join(found.fitted)} refitted, before and after alike')
    if found.verdict == 'UNDECIDED' and not found.outside:
        enough, side = f'not even {DECIDING:,}', 'decide'
        if found.needed and found.limit:
            side = f'be {"within" if found.rms <= found.limit else "beyond"} {_wanted(found)}'
            enough = f'about {found.needed:,}'
        lines.append(f'{enough} poses with the same RMS error would {side}, these included')
    before, rms = (each.rms_mm for each in found.comparison.figures)
    if found.outside and not found.mistake:
        share = round(100.0 * found.outside) or 'less than 1'
        lines.append(
            f'{share} % of the measurements are outside the region of the calibration, where it '
            'may make the arm worse and compensate refuses: verify within it, or identify with '
            'poses like these'
        )
    if rms > before and not (found.mistake or found.uncorrected or causes(found)):
        whose = '' if found.outside > 0.5 else ': is the calibration that of this robot?'
        lines.append(f'the nominal arm has the smaller error{whose}')
    return lines


def causes(found: Verification) -> list[str]:
    """Return what explains the error, each with what to do about it; empty if nothing does."""
    lines: list[str] = []
    if found.mistake:
        return lines
    if found.uncorrected and found.failed:
        lines.append(
            'the arm stood at the joint values of --commanded themselves: either the correction '
            'is not active, or this is the corrected program: give the program as it was before '
            'calib_ros compensate'
        )
    rms, common = 1e-3 * found.comparison.figures[1].rms_mm, 100.0 * found.common
    largest = max(Settings.largest_error, found.limit or 0.0)
    if found.step or found.odd:
        lines += [f'something moved while you measured: {found.step}'] if found.step else []
        lines.append(
            _odd_in_words(found) if found.odd else 'put right what moved, and measure again'
        )
    elif (found.common if found.common < NEARER else 1.0) * rms > largest:
        lines.append(
            'no arm is that far off: check the units and columns of the measurements (--length, '
            '--joint-angle, --columns), their rows, the robot, and whether the device '
            '(--new-base) or the target (--new-tool) was moved'
        )
    elif found.common < NEARER:
        lines.append(
            f'one common shift and turn of all positions explains all but {common:.2g} % of the '
            'error: was the measuring device moved (with a camera on the flange: its target)? If '
            'so, verify again with --new-base (and --new-tool for a new target); if not, find out '
            'what moved'
        )
    return lines


def _wanted(found: Verification) -> str:
    return 'the limit' if found.tolerance is None else 'the tolerance'


def _odd_in_words(found: Verification) -> str:
    """Return which poses are beyond the limit while the others are within it."""
    first, last = found.odd[0] + 1, found.odd[-1] + 1
    names = f'poses {", ".join(some([str(k + 1) for k in found.odd]))} alone are up to'
    if first == last:
        names = f'pose {first} alone is'
    elif last - first < len(found.odd):
        names = f'poses {first} to {last} alone are up to'
    far = 1e3 * norms(found.comparison.after.position[np.isin(found.group, found.odd)]).max()
    return (
        f'{names} {rounded(far)} mm off; the others are within {_wanted(found)}: measure again; '
        'if the error stays, find out what moved, changed or was hit; an arm may also be worse in '
        'part of its range'
    )


def verification_report(
    chain: Chain, found: Verification, poses: Poses, origin: Origin, warnings: Sequence[str] = ()
) -> Report:
    """Return the report of a verification of a calibrated chain."""
    text = [f'Over poses like these, each counted once: RMS {likely_rms(found)}.']
    if found.fitted:
        text.append('The interval allows for the refitted frames.')
    if found.limit is not None and not found.mistake:
        what, size = 'Tolerance (RMS)', f'{1e3 * found.limit:g}'
        good, bad = 'PASS', 'FAIL'
        if found.tolerance is None:
            what = f'Limit, at most {ALIKE:g} times the expected error'
            size, good, bad = rounded(1e3 * found.limit), 'it holds', 'it no longer holds'
        text.append(
            f'{what}: {size} mm. If the whole interval is within it: '
            f'{good}; beyond it: {bad}; else UNDECIDED.'
        )
    text += map(sentence, caveats(found))
    state, steps = standing(found)
    pictured, others = sections.distribution(poses), [_by_configuration(found)] * bool(found.each)
    if found.by_program and found.each:  # the figures of the standard come first
        pictured, others = others[0], [pictured]
    gain = sections.gain(found.comparison, intervals=False)
    count = found.configurations
    different = 'Different poses', f'{count:,}' * (count < len(poses))
    return Report(
        kind='Verification of a calibrated arm',
        robot=chain.name,
        verdict=replace(state, text=tuple(text), gain=gain),
        accuracy=sections.accuracy_section(
            'Accuracy before and after the correction',
            found.comparison,
            poses.things,
            COMPUTED,
            NO_SCALE,
            intervals=False,
            error=sections.OF_THE_PROGRAM if found.by_program else sections.ERROR,
        ),
        picture=pictured,
        steps=steps,
        remarks=tuple(map(sentence, (*warnings, *not_steps(hints(found) + causes(found), steps)))),
        identity=sections.identity_of(chain, origin, poses, [different], table_hash(chain)),
        explorer=explorer(chain, poses),
        sections=(*others, sections.coverage(chain, poses.joints, 'How far each joint was moved')),
        origin=origin,
    )


def _by_configuration(found: Verification) -> Section:
    """Return the figures of the standard, or of errors at the joint values that were reported."""
    title, names = 'Pose by pose (ISO 9283) [mm]', ('AP before', 'AP after', 'RP')
    text = (
        'AP: position accuracy of the mean over all cycles. RP: repeatability, mean + 3 std. '
        'The standard asks for 30 cycles.'
    )
    if not found.by_program:
        title, names = 'Pose by pose', ('before [mm]', 'after [mm]', 'scatter [mm]')
        text = (
            'Errors at the joint values reported: of the mean over all cycles, and their scatter, '
            'mean + 3 std. AP and RP of ISO 9283 need the program (--commanded).'
        )
    shown = 2 + any(each.repeatability is not None for each in found.each)
    return section(
        'configurations',
        title,
        text,
        head=('pose', 'cycles', *names[:shown]),
        rows=tuple(
            (f'P{k}', str(cycles), *('' if x is None else rounded(x) for x in values[:shown]))
            for k, (cycles, *values) in enumerate(found.each, 1)
        ),
    )
