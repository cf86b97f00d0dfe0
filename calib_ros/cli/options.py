# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What commands share: options, settings from them, and the folder of their results."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib_ros.atomic import whole_folder
from calib_ros.errors import InputError

if TYPE_CHECKING:
    from calib_ros.files.foreign import Foreign
    from calib_ros.kinematics.chain import Chain
    from calib_ros.report.page import Origin, Report
    from calib_ros.settings import Settings

NOT_ACCEPTED = 3
"""Exit status when the input was used, but what came out does not do."""


def add_chain(parser: argparse.ArgumentParser) -> None:
    """Add the option that names the nominal robot."""
    parser.add_argument(
        '--chain', required=True, help='chain file, URDF, or a robot by its name (ur10e, ...)'
    )


def add_settings(parser: argparse.ArgumentParser, names: Sequence[str] = ()) -> None:
    """Add options for the settings of some names, or for all."""
    from calib_ros.settings import Settings

    for item in fields(Settings):
        if names and item.name not in names:
            continue
        many = isinstance(item.default, tuple)
        parser.add_argument(
            f'--{item.name.replace("_", "-")}',
            type=str if many else type(item.default),
            action='append' if many else 'store',
            default=[] if many else item.default,
            help=item.metadata['text'],
        )


def add_layout(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how a table of others is laid out (docs/tables.md)."""
    group = parser.add_argument_group('tables of others (docs/tables.md)')
    add = group.add_argument
    add('--preset', default='', metavar='NAME', help='a layout by name, or your own .yaml')
    add(
        '--columns',
        action='append',
        default=[],
        metavar='OURS=THEIRS,...',
        help='q1=A1,x={Pos X},y=-#3 ...: columns, or expressions of them; q*=A* for all joints',
    )
    add('--length', default='', help='unit of lengths: m, cm, mm, um, in')
    add('--angle', default='', help='unit of angles, joint values included: rad, deg')
    add('--joint-angle', default='', help='unit of joint values where it is another one')
    add('--euler', default='', metavar='ZYX', help='rx ry rz are Euler angles; zyx: fixed axes')
    add('--quaternion', default='', metavar='wxyz', help='order of qx qy qz qw, else xyzw')
    add('--rotation-vector', action='store_true', help='rx ry rz are a rotation vector')
    add('--inverse', action='store_true', help='the poses are those of the device in the target')
    add('--shift', type=int, default=0, metavar='ROWS', help='joint values stand so much below')
    add('--separator', default='', help='comma, semicolon, tab or space; guessed if not given')
    add('--decimal', default='', help='point or comma; guessed if not given')
    add('--sheet', default='', help='of a workbook (.xlsx), else its first')
    add('--joints', type=Path, metavar='FILE', help='log of the joint values, row by row')
    add('--joints-preset', default='', metavar='NAME', help='layout of that log')


def foreign_of(options: argparse.Namespace, chain: Chain | None) -> Foreign | None:
    """Return how to read a table of others, None where nothing says that it is one."""
    names = [*('length', 'angle', 'joint_angle', 'euler', 'quaternion', 'rotation_vector')]
    names += ['inverse', 'shift', 'separator', 'decimal', 'sheet']
    given = {name: getattr(options, name) for name in names}
    if not (any(given.values()) or options.preset or options.columns or options.joints):
        return None
    from calib_ros.files.foreign import Foreign
    from calib_ros.files.layouts import Layout, layout_of

    given['decimal'] = {'comma': ',', 'point': '.'}.get(given['decimal'], given['decimal'])
    if options.joints_preset and options.joints is None:
        raise InputError('--joints-preset is of use with --joints FILE only')
    units = {name: given[name] for name in ('length', 'angle', 'joint_angle')}
    log = layout_of(options.joints_preset, (), {} if options.joints_preset else units)
    layout = layout_of(options.preset, options.columns, given)
    return Foreign(layout, chain, options.joints, log if options.joints else Layout())


def settings_of(options: argparse.Namespace) -> Settings:
    """Return the settings that are among the options, the others by default."""
    from calib_ros.settings import Settings

    given: dict[str, Any] = {
        f.name: getattr(options, f.name) for f in fields(Settings) if hasattr(options, f.name)
    }
    for name, value in given.items():
        if isinstance(value, list):
            given[name] = tuple(part for text in value for part in text.split(','))
    return Settings(**given)


def results(options: argparse.Namespace, names: Sequence[str]) -> AbstractContextManager[Path]:
    """Return the folder --out to be made in a `with` block; see `whole_folder`.

    Files of these names (glob patterns) are refused before any work is done, or replaced by
    --force. Other files stay in the folder.
    """
    return whole_folder(options.out, names, overwrite=options.force)


def add_identity(parser: argparse.ArgumentParser) -> None:
    """Add the options by which a report says what it is of."""
    for name, text in (
        ('operator', 'who measured, for the report'),
        ('serial', 'serial number of the robot, for the report'),
        ('device', 'measuring device and its serial number, for the report'),
    ):
        parser.add_argument(f'--{name}', default='', metavar='NAME', help=text)


def origin_of(
    options: argparse.Namespace, inputs: Sequence[Path | None], settings: str = ''
) -> Origin:
    """Return whence a result comes: the options, and the files that were read."""
    from calib_ros.report.page import Origin, inputs_of

    chain = Path(options.chain)
    known = (*inputs, chain if chain.is_file() else None)
    told = (options.operator, options.serial, options.device)
    return Origin(inputs_of(known), *told, settings=settings)


def page_of(report: Report, name: str = 'report.html') -> dict[str, str]:
    """Return a report as the content of a file, by its name; nothing where its extra is missing.

    That is said once.
    """
    from calib_ros.report.page import MISSING, render

    text = render(report)
    if text is None:
        print(f'note: {MISSING}', file=sys.stderr)
        return {}
    return {name: text}


def add_pdf(parser: argparse.ArgumentParser) -> None:
    """Add the option for a report on paper."""
    text = 'write report.pdf as well: the report on paper, with a certificate first'
    parser.add_argument('--pdf', action='store_true', help=text)


def paper_of(report: Report, wanted: bool = True) -> dict[str, bytes]:
    """Return report.pdf by its name, as `page_of` does; nothing where it is not wanted."""
    from calib_ros.report.page import MISSING_PDF, on_paper

    found = on_paper(report) if wanted else None
    if wanted and found is None:
        print(f'note: {MISSING_PDF}', file=sys.stderr)
    return {} if found is None else {'report.pdf': found}
