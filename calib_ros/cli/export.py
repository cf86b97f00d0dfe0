# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros export`: a calibration in the forms of controllers."""

from __future__ import annotations

import argparse
from pathlib import Path

from calib_ros.cli import options as common
from calib_ros.cli.command import Command
from calib_ros.cli.screen import Screen
from calib_ros.files.export import CORRECTED_URDF, FILES, Export, exports, urdf_foot
from calib_ros.files.vendors import VENDOR_FILES, vendor_files
from calib_ros.files.waypoints import read_joints
from calib_ros.identification.calibration import load_calibration
from calib_ros.kinematics.chain_file import URDF_SUFFIXES, load_chain, read_text
from calib_ros.kinematics.urdf import corrected_urdf


def _add(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to export')
    add = group.add_argument
    add('calibration', type=Path, metavar='CALIBRATION', help='calibration.yaml of identify --out')
    common.add_chain(group)
    common.add_out(group, 'all forms', needed=True)
    text = 'table with q1 ... qn where tables that cannot be exact are to be best; if not given, '
    add('--measured', type=Path, metavar='FILE', help=f'{text}the whole joint range')
    add = parser.add_argument_group('for URDF and drivers').add_argument
    add('--urdf', type=Path, metavar='FILE', help='nominal URDF of the robot, to correct as well')
    add('--base-link', metavar='LINK', help='of the URDF: where the arm starts')
    add('--tip-link', metavar='LINK', help='of the URDF: where the arm ends')
    text = 'checksum that the driver of Universal Robots prints at its start, for '
    add('--ur-hash', default='', metavar='calib_...', help=f'{text}ur_kinematics.yaml')


def _run(options: argparse.Namespace, screen: Screen) -> int:
    nominal = load_chain(options.chain)
    calibration = load_calibration(options.calibration, nominal)
    chain, origin = calibration.chain, calibration.record
    measured = None
    if options.measured is not None:
        measured = read_joints(options.measured, chain)
    found = exports(chain, nominal, measured, origin)
    links = {'base_link': options.base_link, 'tip_link': options.tip_link}
    urdf = ''
    if options.urdf is not None:
        urdf = read_text(options.urdf)
        text = corrected_urdf(urdf, chain, **links) + urdf_foot(chain)
        found = (*found, Export(f'{options.urdf.stem}{CORRECTED_URDF}', text, 0.0))
    elif Path(options.chain).suffix in URDF_SUFFIXES:
        urdf = read_text(Path(options.chain))
    found += vendor_files(chain, nominal, origin, urdf, links, options.ur_hash)
    with common.results(options, (*FILES, *VENDOR_FILES, f'*{CORRECTED_URDF}')) as contents:
        contents |= {each.name: each.content for each in found}
    for each in found:
        exact = 'exact' if each.error == 0.0 else f'up to {1e3 * each.error:.3f} mm off'
        screen.say(f'{options.out / each.name}: {exact}')
    return 0


COMMANDS = {
    'export': Command(
        _add,
        _run,
        (
            'export result/calibration.yaml --chain ur10e --out export/',
            'export result/calibration.yaml --chain ur10e --urdf robot.urdf --out export/',
        ),
    ),
}
