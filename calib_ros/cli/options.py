# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What commands share: options, settings from them, and the folder of their results."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import Field, fields
from pathlib import Path
from typing import Any, TypeAlias

from calib_ros.atomic import whole_folder, write_files
from calib_ros.errors import InputError
from calib_ros.settings import STORAGES, Settings

NOT_ACCEPTED, INCOMPLETE = 3, 4
"""Exit status when the input was used but what came out does not do; of a fleet, when measurements
of some robots could not be used and no robot needs a look."""

Group: TypeAlias = 'argparse.ArgumentParser | argparse._ArgumentGroup'
Contents: TypeAlias = dict[str, str | bytes]
"""Of files by name."""
SETTINGS = {
    'the fit': ('model', 'fixed', 'priors', 'loss', 'folds', 'socket_distance'),
    'how the device measures': ('sigma_position', 'sigma_orientation', 'sigma_pixel', 'frame_id'),
    'what is not accepted': ('largest_length', 'largest_angle', 'largest_error'),
    'bags: what is read': ('joint_topics', 'sources', 'joint_names', 'delay'),
    'bags: how poses are taken': (
        *('mode', 'still', 'settle', 'shortest_stop', 'longest_stop', 'max_gap', 'lateness'),
        *('joint_buffer', 'pose_buffer', 'wanted_accuracy'),
    ),
}
"""Settings by the groups in which a help shows them."""
OF_BAGS = (
    *SETTINGS['how the device measures'],
    *SETTINGS['bags: what is read'],
    *SETTINGS['bags: how poses are taken'],
)
"""Settings by which poses are made of a bag."""
LAYOUT = (
    *('length', 'angle', 'joint_angle', 'euler', 'quaternion', 'rotation_vector'),
    *('inverse', 'shift', 'separator', 'decimal', 'sheet'),
)
"""Options of tables of others."""


def add_each(parser: Group, kind: Callable[[str], Any], *rows: tuple[str, str, Any, str]) -> None:
    """Add options of one type: name, placeholder, default and help of each."""
    for name, metavar, default, text in rows:
        parser.add_argument(name, type=kind, metavar=metavar, default=default, help=text)


def add_chain(parser: Group, default: str | None = None, needed: bool = True) -> None:
    """Add the option that names the nominal robot."""
    action = parser.add_argument(
        '--chain',
        default=default,
        required=needed and default is None,
        metavar='ROBOT',
        help='its name (calib_ros robots), a chain file, or a URDF',
    )
    action.completer = _robots  # type: ignore[attr-defined]


def _robots(prefix: str, **_: Any) -> list[str]:
    """Return what may be meant by the beginning of the name of a robot or file."""
    from glob import glob

    from calib_ros.kinematics.chain_file import shipped_robots  # loads numpy, no `--help` needs it

    return [*shipped_robots(), *glob(f'{prefix}*')]


def add_settings(parser: argparse.ArgumentParser, names: Sequence[str] = ()) -> None:
    """Add options for the settings of some names, or for all, in their groups."""
    known = {item.name: item for item in fields(Settings)}
    for title, members in SETTINGS.items():
        wanted = [known[name] for name in members if not names or name in names]
        group = parser.add_argument_group(title) if wanted else parser
        add_fields(group, wanted)


def add_fields(group: Group, items: Iterable[Field[Any]]) -> None:
    """Add an option for each field of a dataclass that has a text; None stands for a number."""
    for item in items:
        many = isinstance(item.default, tuple)
        kind = str if many else float if item.default is None else type(item.default)
        group.add_argument(
            f'--{item.name.replace("_", "-")}',
            type=kind,
            action='append' if many else 'store',
            default=[] if many else item.default,
            metavar='NAME,...' if many else {float: 'X', int: 'N'}.get(kind, 'NAME'),
            help=item.metadata['text'],
        )


def add_calibration(parser: Group) -> None:
    """Add the option that names a calibration."""
    text = 'folder of identify --out, or calibration.yaml alone'
    parser.add_argument('--calibration', type=Path, required=True, metavar='RESULT', help=text)


def add_out(
    parser: Group,
    text: str,
    what: str = 'FOLDER',
    needed: bool = False,
    default: Path | None = None,
) -> None:
    """Add the options that say where results go."""
    add = parser.add_argument
    add('--out', type=Path, default=default, required=needed, metavar=what, help=text)
    add('--force', action='store_true', help='replace what is there already')


def add_storage(parser: Group) -> None:
    """Add the option that says how a bag is stored."""
    parser.add_argument('--storage', choices=STORAGES, default='mcap', help='of the bag')


def at_least(options: argparse.Namespace, **lowest: float) -> None:
    """Refuse options that are less than they may be; one that is not given is none."""
    for name, least in lowest.items():
        value = getattr(options, name)
        if value is not None and not value >= least:
            raise InputError(f'--{name} must be at least {least}, not {value}')


def refuse_existing(options: argparse.Namespace, *paths: Path) -> None:
    """Refuse to write what is there already, before any work is done."""
    for path in paths:
        if path.exists() and not options.force:
            raise InputError(f'{path} exists already: choose another name or --force')


def add_layout(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how a table of others is laid out."""
    add = parser.add_argument_group(
        'tables of others (docs/tables.md); what is not given is guessed'
    ).add_argument
    for name, metavar, text in (
        ('preset', 'NAME', 'a layout by name, or your own .yaml'),
        ('length', 'UNIT', 'of lengths: m, cm, mm, um, in'),
        ('angle', 'UNIT', 'unit of angles, joint values included: rad, deg'),
        ('joint-angle', 'UNIT', 'unit of joint values where it is another one'),
        ('euler', 'ZYX', 'rx ry rz are Euler angles; zyx: fixed axes'),
        ('quaternion', 'wxyz', 'order of qx qy qz qw, else xyzw'),
        ('separator', 'NAME', 'comma, semicolon, tab or space; guessed if not given'),
        ('decimal', 'NAME', 'point or comma'),
        ('sheet', 'NAME', 'of a workbook (.xlsx), else its first'),
        ('joints-preset', 'NAME', 'layout of the log --joints'),
    ):
        add(f'--{name}', default='', metavar=metavar, help=text)
    text = 'q1=A1,x={Pos X},y=-#3 ...: columns, or expressions of them; q*=A* for all joints'
    add('--columns', action='append', default=[], metavar='OURS=THEIRS,...', help=text)
    add('--rotation-vector', action='store_true', help='rx ry rz are a rotation vector')
    add('--inverse', action='store_true', help='the poses are those of the device in the target')
    add('--shift', type=int, default=0, metavar='ROWS', help='joint values stand so much below')
    add('--joints', type=Path, metavar='FILE', help='log of the joint values, row by row')


def settings_of(options: argparse.Namespace) -> Settings:
    """Return the settings that are among the options, the others by default."""
    given: dict[str, Any] = {
        f.name: getattr(options, f.name) for f in fields(Settings) if hasattr(options, f.name)
    }
    for name, value in given.items():
        if isinstance(value, list):
            given[name] = tuple(part for text in value for part in text.split(','))
    return Settings(**given)


def sessions_of(options: argparse.Namespace) -> tuple[str, ...]:
    """Return the sessions of a table that are asked for."""
    return tuple(options.session.split(',')) if options.session else ()


@contextmanager
def results(options: argparse.Namespace, names: Sequence[str]) -> Iterator[Contents]:
    """Yield the files of --out, to be filled in; they are written at the end, all or none.

    Files of these names (glob patterns) are refused before any work is done, or replaced by
    --force. Other files stay in the folder. Without --out nothing is written.
    """
    contents: Contents = {}
    if options.out is None:
        yield contents
        return
    with whole_folder(options.out, names, overwrite=options.force) as folder:
        yield contents
        write_files(folder, contents)


def written(out: Path, contents: Contents) -> str:
    """Return where the files are that were written, and which of them to open."""
    page = 'report.html'
    return f'wrote {out}' + (f': open {out / page}' if page in contents else '')


def add_identity(parser: argparse.ArgumentParser, pdf: bool = False) -> None:
    """Add the options by which a report says what it is of; `pdf` adds that for paper."""
    add = parser.add_argument_group('for the report').add_argument
    for name, text in (
        ('operator', 'who measured'),
        ('serial', 'serial number of the robot'),
        ('device', 'measuring device and its serial number'),
    ):
        add(f'--{name}', default='', metavar='NAME', help=text)
    if pdf:
        add('--pdf', action='store_true', help='report.pdf as well, with a certificate first')


def add_moved(parser: Group) -> None:
    """Add the options that say what of the cell is another one now."""
    add = parser.add_argument
    add('--new-base', action='store_true', help='the measuring device stands elsewhere now')
    add('--new-tool', action='store_true', help='the target is another one, or mounted anew')


def add_history(parser: Group) -> None:
    """Add the option that says where a result is filed besides."""
    text = 'file the result there as well, by --serial'
    parser.add_argument('--history', metavar='DIR', help=text)
