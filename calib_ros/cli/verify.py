# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros verify`: the verdict on a calibrated arm."""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial

from calib_ros.apply.verification import verify
from calib_ros.apply.verified import Verification
from calib_ros.cli import checks, common, inputs
from calib_ros.cli.file_types import refuse_others
from calib_ros.cli.screen import GOOD_OR_BAD, Screen
from calib_ros.decision.reasons import Rule
from calib_ros.errors import InputError
from calib_ros.estimation.levels import ALIKE
from calib_ros.files.programs import read_joints
from calib_ros.files.result_rows import verification_row
from calib_ros.identification.calibration import calibration_file
from calib_ros.identification.orientations import turns_left_out
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import load_chain, table_hash
from calib_ros.progress import share_of
from calib_ros.report.documents import verification_document
from calib_ros.report.gathered import poses_to_verify
from calib_ros.report.markdown import markdown
from calib_ros.report.remarks import each_in_words, likely_rms, not_steps, remarks
from calib_ros.report.standing import standing
from calib_ros.report.verdicts import verification_report
from calib_ros.report.words import rms_change
from calib_ros.sampling.dataset import Dataset, dataset_of
from calib_ros.shown import rounded
from calib_ros.texts import dump_json

VERIFICATION_FILES = ('report.html', 'report.pdf', 'residuals.csv', 'report.md')


def _run(options: argparse.Namespace, screen: Screen) -> int:
    screen.quiet = screen.quiet or options.json
    checks.check_acceptance(options)
    with common.output_files(options, VERIFICATION_FILES) as contents:
        file = inputs.filer_of(options)
        nominal = load_chain(options.chain)
        arm = inputs.calibration_of(options.calibration, 'verify --calibration', nominal)
        serial = arm.serial_of(str(options.calibration), options.serial)
        read = _read(options, nominal, screen)
        names = arm.frames_of(read.owners)
        sets = [each.between(names) for each in (*read.fitted, *read.held_out)]
        commanded = read_joints(options.commanded, nominal) if options.commanded else None
        tolerance = None if options.tolerance is None else 1e-3 * options.tolerance
        confidence, moved = options.confidence, (options.new_base, options.new_tool)
        sigma = vars(options).get('sigma_position')
        with screen.work('judging') as work:
            given = confidence, moved[0], commanded, moved[1], work, sigma
            found = verify(arm, sets, tolerance, *given)
        warnings = (*read.warnings, *turns_left_out(arm, sets, found.fitted))
        for warning in warnings:
            screen.warn(warning)
        if options.json:
            screen.data(dump_json(verification_document(found)))
        else:
            show(found, screen)
        if options.out is not None:
            files = (options.measured, options.commanded, calibration_file(options.calibration))
            with screen.work('writing the report') as work:
                poses = poses_to_verify(found.chain, sets, found.comparison, read.by_line)
                origin = inputs.origin_of(options, files, serial=serial)
                report = verification_report(arm.chain, found, poses, origin, warnings)
                contents['residuals.csv'] = poses.table(share_of(work, 0.0, 2 / 3))
                contents['report.md'] = markdown(report, {})
                contents |= inputs.page_of(options, report, screen)
    if options.out is not None:
        screen.say(common.written(options.out, contents))
    wanted = None if commanded is None else commanded.tolist()
    judged_by = (table_hash(arm.chain), options.tolerance, confidence, *moved, wanted)
    stated = [] if sigma is None else [sigma]  # the settings have its default, too
    # last: a full disk there must not hide the verdict
    file(partial(verification_row, arm.chain, found), nominal, sets, *judged_by, *stated)
    passed = standing(found)[0].state not in ('bad', 'open')
    return 0 if passed else common.Status.NOT_ACCEPTED


def show(found: Verification, screen: Screen) -> None:
    """Print a verdict, six rows, the poses if few, and what to do."""
    before, after = found.comparison.figures
    tolerance = limit = ''
    if found.tolerance is not None:
        tolerance = f'RMS {1e3 * found.tolerance:g} mm'
    elif found.limit is None:
        tolerance = 'none given (--tolerance MM)'
    else:
        limit = f'RMS {rounded(1e3 * found.limit)} mm: at most {ALIKE:g} times the expected error'
        limit += ' (--tolerance MM: your own)'
    state, steps = standing(found)
    screen.title(state.heading, GOOD_OR_BAD.get(state.state))
    screen.table(
        {
            'measured': f'{after.count:,} times at {found.configurations:,} poses',
            'position error': rms_change((before, after)),
            'largest': f'{rounded(before.max_mm)} -> {rounded(after.max_mm)} mm',
            'orientation error': rms_change((before, after), 'mrad') or 'not measured',
            'poses like these': f'RMS {likely_rms(found)}',
            'tolerance': tolerance,
            'limit': limit,
        }
    )
    if found.each:
        screen.say('\n'.join(['position error [mm] by pose', *each_in_words(found)]))
    said = not_steps(remarks(found), steps)
    screen.reasons += said
    for remark in said:
        screen.bullet(remark)
    if state.state in ('bad', 'open'):
        screen.bullet('what to do:', steps)


def _read(options: argparse.Namespace, nominal: Chain, screen: Screen) -> Dataset:
    """Return the measurements of a table or bag; refuse a bag of which much is lost."""
    kind = refuse_others(options.measured, 'verify', 'table', 'bag')
    checks.refuse_ignored(options, kind)
    if kind == 'table':
        return inputs.table_of(options, options.measured, nominal, screen)
    session, read = inputs.replayed_bag(options, options.measured, nominal, screen)
    screen.say(f'{read}; {session.account()}')
    if not session.usable:
        raise InputError(f'{options.measured} gives no poses: {session.account()}')
    if lost := read.refusals(session.account(), options.largest_loss):
        told = '; '.join((*read.warnings, *lost))
        if lost[0].rule is not Rule.DROPPED:
            told += '. First copy the bag again from the computer that made it'
        raise InputError(told)
    found = dataset_of(session.usable, session.settings.sigmas)
    return replace(found, warnings=read.warnings)
