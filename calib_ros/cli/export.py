# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros export`: a calibration in the forms of controllers."""

from __future__ import annotations

import argparse
from pathlib import Path

from calib_ros.cli import options as common
from calib_ros.cli.given import calibration_of
from calib_ros.cli.screen import Screen
from calib_ros.files.export import CORRECTED_URDF, FILES, Export, exports, urdf_foot
from calib_ros.files.vendors import VENDOR_FILES, vendor_files
from calib_ros.files.waypoints import read_joints
from calib_ros.kinematics.chain_file import URDF_SUFFIXES, load_chain, read_text
from calib_ros.kinematics.urdf import corrected_urdf


def _run(options: argparse.Namespace, screen: Screen) -> int:
    nominal = load_chain(options.chain)
    calibration = calibration_of(options.calibration, 'export', nominal)
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
        beyond = f' with what its first line says, {each.beyond}' if each.beyond else ''
        screen.say(f'{options.out / each.name}: {exact}{beyond}')
    return 0
