# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of a calibration brought up to date."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from calib_ros.decision.changes import reason_in_words
from calib_ros.identification.recalibrated import Recalibration
from calib_ros.kinematics.chain_file import table_hash
from calib_ros.report import sections
from calib_ros.report.content import Headline, Origin, Report
from calib_ros.report.explorer import explorer
from calib_ros.report.poses import Poses
from calib_ros.report.reports import NOT_YET, bring
from calib_ros.shown import rounded, sentence

STAYS = 'the arm is unchanged within the uncertainty: its correction stays valid'
PREDICTED = '"Before": by the earlier calibration; "after": predicted from the other new poses.'


def update_standing(found: Recalibration) -> tuple[Headline, tuple[str, ...], str]:
    """Return the verdict on an update and why, what has changed, and what to do."""
    why, step = found.refusal()
    if found.accepted:
        names = (name for reasons in found.changed for each in reasons for name in each.names)
        same = all(map(found.calibration.chain.owns_frame, names))
        step = STAYS if same else f'{NOT_YET}: {bring(found.calibration)}'
    heading = 'Accepted: the calibration is brought up to date'
    if not found.accepted:
        heading = 'Not accepted: the earlier calibration stays as it was'
    perhaps, told = 'perhaps ' * bool(why), found.accepted or not (found.determined or found.odd)
    changed = tuple(perhaps + reason_in_words(each) for each in found.changed if told)
    text = (why,) if why else ()
    return Headline('good' if found.accepted else 'bad', heading, text), changed, step


def known_to(found: Recalibration, arrow: str = '→') -> str:
    """Return how well the arm was and is known."""
    known = f'{rounded(1e3 * found.known_before)} {arrow} {rounded(1e3 * found.known_after)} mm'
    return f'{known} over the joint range (standard deviation)'


def update_report(
    found: Recalibration, poses: Poses, origin: Origin, warnings: Sequence[str] = ()
) -> Report:
    """Return the report of an earlier calibration and new poses."""
    (state, changed, step), arm = update_standing(found), found.calibration.chain
    known, corrected = ('Arm known to', known_to(found)), table_hash(arm) * found.accepted
    text = tuple(map(sentence, (*state.text, *changed)))
    return Report(
        kind='Update of a calibration with a few poses',
        robot=arm.name,
        verdict=replace(state, text=text, gain=sections.gain(found.comparison)),
        accuracy=sections.accuracy_section(
            'Accuracy before and after', found.comparison, poses.things, PREDICTED
        ),
        picture=sections.distribution(poses),
        steps=(sentence(step),),
        remarks=tuple(map(sentence, warnings)),
        identity=sections.identity_of(arm, origin, poses, [known], corrected),
        explorer=explorer(arm, poses),
        sections=(sections.coverage(arm, poses.joints, 'How far each joint was moved'),),
        origin=origin,
    )
