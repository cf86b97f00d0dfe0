# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The commands around an identification: `compensate`.

They are added to those of `cli.py`, which holds what exit status means.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from calib_ros.errors import InputError

NOT_ACCEPTED = 3
"""Exit status when the input was used, but what came out does not do."""

Command: TypeAlias = Callable[[str, Callable[[Any], int], str], argparse.ArgumentParser]


def add_chain(parser: argparse.ArgumentParser) -> None:
    """Add the option that names the nominal robot."""
    parser.add_argument(
        '--chain', required=True, help='chain file, URDF, or a robot by its name (ur10e, ...)'
    )


def add_commands(command: Command) -> None:
    """Add all commands of this module by a function of name, what to run, and help."""
    _add_compensate(
        command(
            'compensate', _compensate, 'correct the joint values of a program by a calibration'
        )
    )


def _add_compensate(parser: argparse.ArgumentParser) -> None:
    from calib_ros.compensation import Compensator

    parser.add_argument(
        'program', type=Path, help='.csv with q1 ... qn, or .yaml with a JointTrajectory'
    )
    add_chain(parser)
    parser.add_argument(
        '--calibration', required=True, help='calibration.yaml of calib_ros identify'
    )
    parser.add_argument('--out', type=Path, required=True, help='the corrected program')
    parser.add_argument('--force', action='store_true', help='overwrite --out')
    parser.add_argument(
        '--tool',
        nargs=3,
        type=float,
        default=Compensator.tool,
        metavar=('X', 'Y', 'Z'),
        help='point in the flange frame whose position counts [m]',
    )
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
        parser.add_argument(f'--{name.replace("_", "-")}', type=float, default=default, help=text)


def _compensate(options: argparse.Namespace) -> int:
    from calib_ros.compensation import POSITIVE, Compensator, compensate_program, in_words
    from calib_ros.config import load_chain
    from calib_ros.files import write_file
    from calib_ros.programs import read_program

    if options.out.exists() and not options.force:
        raise InputError(f'{options.out} exists already: choose another name or --force')
    if options.out.exists() and options.out.samefile(options.program):
        raise InputError(
            '--out is the program itself: keep it, a program compensated twice is wrong'
        )
    nominal, calibrated = load_chain(options.chain), load_chain(options.calibration)
    limits = {name: getattr(options, name) for name in POSITIVE}
    compensator = Compensator(nominal, calibrated, tuple(options.tool), **limits)
    source = read_program(options.program, nominal.joint_names)
    corrected, result = compensate_program(compensator, source.program)
    if result.refusals:
        print(f'calib_ros: nothing is written, {in_words(compensator, result)}', file=sys.stderr)
        for refusal in result.refusals:
            print(f'{source.places[refusal.sample]}: {refusal.reason}', file=sys.stderr)
        return NOT_ACCEPTED
    write_file(options.out, source.text_with(corrected), overwrite=options.force)
    print(f'wrote {options.out}: {in_words(compensator, result)}')
    return 0
