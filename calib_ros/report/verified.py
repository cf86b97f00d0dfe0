# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the page of a verification says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, replace

from calib_ros.apply.verification import Verification, remarks
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import table_hash
from calib_ros.report.advice import SPREAD
from calib_ros.report.explorer import explorer
from calib_ros.report.page import Origin, Report, Section, Verdict
from calib_ros.report.poses import Poses
from calib_ros.report.sections import (
    ISO_9283,
    accuracy_section,
    coverage,
    distribution,
    gain,
    identity_of,
)

MOVED = (
    'Check that the measuring device, the target and the robot stand as they did for the '
    'calibration; if not, use --new-base or --new-tool.'
)
TOLERANCE = 'Give --tolerance with the RMS error [mm] that your task allows: PASS or FAIL.'
STANDINGS: dict[str, tuple[Verdict, tuple[str, ...]]] = {
    'PASS': (
        Verdict('good', 'PASS: the arm is within the tolerance'),
        ('Keep this page with the calibration. Verify again after a collision or repair.',),
    ),
    'FAIL': (
        Verdict('bad', 'FAIL: the arm is beyond the tolerance'),
        (
            MOVED,
            'Check that the correction is active in the controller (--commanded tells).',
            'Calibrate again with new poses; try --model auto.',
        ),
    ),
    'UNDECIDED': (
        Verdict('open', 'UNDECIDED: too few measurements to tell'),
        (f'Measure more poses, {SPREAD}, and verify again with all of them.',),
    ),
    'does not hold': (
        Verdict('bad', 'The calibration does not hold any more'),
        (MOVED, 'Calibrate again with new poses, or with --previous by a few.'),
    ),
    'holds': (Verdict('good', 'The calibration holds: the error is as it was'), (TOLERANCE,)),
    'no verdict': (Verdict('info', 'No verdict without a tolerance'), (TOLERANCE,)),
}
"""Verdicts, and what to do next."""


def verification_report(
    chain: Chain, found: Verification, poses: Poses, origin: Origin, warnings: Sequence[str] = ()
) -> Report:
    """Return the report of a verification of a calibrated chain."""
    share = f'{100.0 * found.confidence:g} %'
    text = [
        f'The RMS position error over poses like these is between {1e3 * found.lower:.3f} mm and '
        f'{1e3 * found.upper:.3f} mm; each limit holds with {share} confidence.'
    ]
    if found.tolerance is not None:
        text.append(f'Tolerance: {1e3 * found.tolerance:g} mm.')
    state, steps = STANDINGS[found.verdict]
    return Report(
        kind='Verification of a calibrated arm',
        robot=chain.name,
        verdict=replace(state, text=tuple(text), gain=gain(found.comparison, intervals=False)),
        accuracy=accuracy_section(
            'Accuracy before and after the correction',
            (ISO_9283,),
            found.comparison,
            poses.things,
            intervals=False,
        ),
        picture=distribution(poses),
        steps=steps,
        remarks=(*warnings, *remarks(found)),
        identity=identity_of(
            chain, origin, poses, ('Different poses', str(found.configurations)), table_hash(chain)
        ),
        explorer=explorer(chain, poses),
        sections=(
            *_by_configuration(found),
            coverage(chain, poses.joints, 'How far each joint was moved'),
        ),
        origin=origin,
    )


def _by_configuration(found: Verification) -> list[Section]:
    """Return accuracy and repeatability of a few configurations, one by one."""
    if not found.each:
        return []
    return [
        Section(
            'configurations',
            'Pose by pose (ISO 9283)',
            (
                'AP: position accuracy, of the mean of all cycles. RP: repeatability, '
                'mean + 3 sigma.',
            ),
            head=('pose', 'cycles', 'AP before [mm]', 'AP after [mm]', 'RP [mm]'),
            rows=tuple(
                (f'P{k}', str(cycles), *('' if x is None else f'{x:.4f}' for x in figures))
                for k, (cycles, *figures) in enumerate(map(astuple, found.each), 1)
            ),
        )
    ]
