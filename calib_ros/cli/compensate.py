# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros compensate`: a program, corrected."""

from __future__ import annotations

import argparse
from dataclasses import fields

from calib_ros.apply.compensation import Compensator, in_words
from calib_ros.apply.program import compensate_program
from calib_ros.atomic import write_file
from calib_ros.cli import options as common
from calib_ros.cli.given import calibration_of
from calib_ros.cli.kinds import refuse_others
from calib_ros.cli.screen import Screen
from calib_ros.errors import InputError
from calib_ros.files.trajectories import read_program
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.settings import Limits
from calib_ros.shown import NAMED


def _run(options: argparse.Namespace, screen: Screen) -> int:
    refuse_others(options.program, 'compensate', 'program', 'chain', 'table')
    common.refuse_existing(options, options.out)
    if options.out.exists() and options.out.samefile(options.program):
        raise InputError(
            '--out is the program itself: keep it, a program compensated twice is wrong'
        )
    nominal = load_chain(options.chain)
    arm = calibration_of(options.calibration, 'compensate', nominal)
    limits = {item.name: getattr(options, item.name) for item in fields(Limits)}
    compensator = Compensator(nominal, arm.chain, tuple(options.tool), **limits, region=arm.region)
    with screen.work(f'correcting {options.program.name}') as work:
        source = read_program(options.program, nominal.joint_names)
        corrected, result = compensate_program(compensator, source.program, work)
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
