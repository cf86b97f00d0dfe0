# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros compensate`: a program, corrected."""

from __future__ import annotations

import argparse
from pathlib import Path

from calib_ros.apply.compensation import POSITIVE, Compensator, in_words
from calib_ros.apply.program import compensate_program
from calib_ros.atomic import write_file
from calib_ros.cli import options as common
from calib_ros.cli.command import Command
from calib_ros.cli.kinds import refuse_others
from calib_ros.cli.screen import Screen
from calib_ros.errors import InputError
from calib_ros.files.trajectories import read_program
from calib_ros.identification.calibration import load_calibration
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.shown import NAMED


def _add(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to correct')
    text = '.csv with q1 ... qn, or .yaml with a JointTrajectory'
    group.add_argument('program', type=Path, metavar='PROGRAM', help=text)
    common.add_chain(group)
    common.add_calibration(group)
    common.add_out(group, 'the corrected program', 'FILE', needed=True)
    add = parser.add_argument_group('limits').add_argument
    text, axes = 'point in the flange frame whose position counts [m]', ('X', 'Y', 'Z')
    add('--tool', nargs=3, type=float, default=Compensator.tool, metavar=axes, help=text)
    for name, text in (
        ('largest_turn', 'largest correction of a revolute joint [rad]'),
        ('largest_shift', 'largest correction of a prismatic joint [m]'),
        ('largest_position_error', 'position error that may remain [m]'),
        (
            'largest_orientation_error',
            'orientation error that may remain [rad]; if not given 1e-6, or 0.02 for arms that '
            'cannot reach every orientation',
        ),
        (
            'orientation_weight',
            'position error that counts as much as one radian, where both cannot vanish '
            '[m/rad]; if not given 0.3, or 0.001 for arms that cannot reach every orientation',
        ),
        ('largest_change', 'largest change of the correction relative to the move'),
    ):
        default = getattr(Compensator, name)
        add(f'--{name.replace("_", "-")}', type=float, default=default, metavar='X', help=text)


def _run(options: argparse.Namespace, screen: Screen) -> int:
    refuse_others(options.program, 'compensate', 'program', 'chain', 'table')
    common.refuse_existing(options, options.out)
    if options.out.exists() and options.out.samefile(options.program):
        raise InputError(
            '--out is the program itself: keep it, a program compensated twice is wrong'
        )
    nominal = load_chain(options.chain)
    arm = load_calibration(options.calibration, nominal)
    limits = {name: getattr(options, name) for name in POSITIVE}
    compensator = Compensator(nominal, arm.chain, tuple(options.tool), **limits, region=arm.region)
    with screen.work(f'correcting {options.program.name}') as work:
        source = read_program(options.program, nominal.joint_names)
        corrected, result = compensate_program(
            compensator, source.program, lambda share: work(share=share)
        )
    if result.refusals:
        screen.warn(f'nothing is written, {in_words(compensator, result)}', 'calib_ros')
        for refusal in result.refusals[:NAMED]:
            screen.warn(refusal.reason, source.places[refusal.sample])
        if more := result.refusals[NAMED:]:
            screen.warn(f'and {len(more)} more, up to {source.places[more[-1].sample]}', 'refused')
        return common.NOT_ACCEPTED
    write_file(options.out, source.text_with(corrected), overwrite=options.force)
    screen.say(f'wrote {options.out}: {in_words(compensator, result)}')
    words, warning = arm.knowledge(result.joints, result.orientation_before)
    if words:
        screen.say(words)
    if warning:
        screen.warn(warning)
    return 0


COMMANDS = {
    'compensate': Command(
        _add,
        _run,
        (
            'compensate program.csv --chain ur10e --calibration result/ --out corrected.csv',
            'compensate path.yaml --chain ur10e --calibration result/ --out corrected.yaml',
        ),
    ),
}
