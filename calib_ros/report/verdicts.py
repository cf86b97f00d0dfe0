# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of a verification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from calib_ros.apply.verified import Verification
from calib_ros.estimation.levels import ALIKE
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import table_hash
from calib_ros.report import sections
from calib_ros.report.content import Origin, Report, Section, section
from calib_ros.report.explorer import explorer
from calib_ros.report.poses import Poses
from calib_ros.report.remarks import causes, caveats, hints, likely_rms, not_steps
from calib_ros.report.standing import standing
from calib_ros.shown import rounded, sentence

COMPUTED = (
    '"Before" is not measured but computed: the nominal arm in its best frames, at the same '
    'joint values.'
)
NO_SCALE = 'Intervals do not include a scale error of the device: check it with a known length.'


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
    noise = 'that of the calibration, or more if the errors show it'
    if not found.unstated:
        noise = 'as stated with each measurement'
        if found.sigma_position is not None:
            noise = f'{1e3 * found.sigma_position:g} mm where no measurement states its own'
    more = (
        ('Different poses', f'{count:,}' * (count < len(poses))),
        ('Assumed device noise', noise * (found.tolerance is None)),
    )
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
        identity=sections.identity_of(chain, origin, poses, more, table_hash(chain)),
        explorer=explorer(chain, poses),
        sections=(*others, sections.coverage(chain, poses.joints, 'How far each joint was moved')),
        origin=origin,
    )


def _by_configuration(found: Verification) -> Section:
    """Return the figures of the standard, or of errors at the joint values that were reported."""
    title, names = 'Pose by pose (ISO 9283) [mm]', ('AP before', 'AP after', 'RP')
    text = (
        'AP: position accuracy of the mean over all cycles. RP: repeatability, mean + 3 std. '
        'The standard asks for 30 cycles. Poses are numbered in the order of measurement.'
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
