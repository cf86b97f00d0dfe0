# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Shared options of commands, settings from them, and the folder of results."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import Field, fields
from enum import IntEnum
from pathlib import Path
from typing import Any, TypeAlias

from calib_ros.atomic import refuse_to_replace, whole_folder, write_files
from calib_ros.errors import InputError
from calib_ros.settings import Settings

Group: TypeAlias = 'argparse.ArgumentParser | argparse._ArgumentGroup'
Contents: TypeAlias = dict[str, str | bytes]  # content of files by name
SETTINGS = {
    'the fit': ('model', 'fixed', 'priors', 'loss', 'folds', 'socket_distance'),
    'how the device measures': (
        'sigma_position',
        'sigma_orientation',
        'sigma_pixel',
        'sigma_scale',
        'frame_id',
    ),
    'what is not accepted': ('largest_length', 'largest_angle', 'largest_error'),
    'bags: what is read': ('joint_topics', 'sources', 'joint_names', 'delay'),
    'bags: how poses are taken': (
        *('mode', 'still', 'settle', 'shortest_stop', 'longest_stop', 'max_gap', 'lateness'),
        *('joint_buffer', 'pose_buffer', 'wanted_accuracy'),
    ),
}
"""Settings by the groups of the help."""
OF_BAGS = tuple(
    name
    for title in ('how the device measures', 'bags: what is read', 'bags: how poses are taken')
    for name in SETTINGS[title]
    if name not in ('sigma_scale', 'wanted_accuracy')
)
"""Settings that affect the poses of a bag."""
OF_REPORTS = ('operator', 'serial', 'device', 'conditions')
"""Options for the report."""
LAYOUT_OPTIONS = (
    *('length', 'angle', 'joint_angle', 'euler', 'quaternion', 'rotation_vector'),
    *('inverse', 'shift', 'separator', 'decimal', 'sheet'),
)
"""Options of foreign tables."""
OF_TABLES = (
    *('session', 'eye_in_hand', 'sigma_touch', 'preset', 'columns', 'joints', *LAYOUT_OPTIONS),
    *('detections', 'board', 'places', 'intrinsics', 'lens', 'joints_preset'),
)

NEEDS = {
    '--previous': ('growth', 'new_base', 'new_tool'),
    '--detections': ('board', 'places', 'intrinsics', 'lens'),
    '--joints': ('joints_preset',),
    '--tracker': ('axis', 'cone'),
    '--urdf': ('base_link', 'tip_link'),
    '--out': ('pdf',),
}
"""Options that do nothing without another one."""


class Status(IntEnum):
    """Exit status if the input was used but the outcome is insufficient."""

    NOT_ACCEPTED = 3
    INCOMPLETE = 4
    """Of a fleet: some measurements or results could not be used, and no robot needs a look."""


def refuse(options: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Refuse options that are not at their default, and tell why."""
    for name in names:
        if vars(options).get(name) != options.parser.get_default(name):
            raise InputError(f'--{name.replace("_", "-")} {why}')


def refuse_alone(options: argparse.Namespace) -> None:
    """Refuse options without the one that they need."""
    for needed, names in NEEDS.items():
        if vars(options).get(needed[2:], '') is None:
            refuse(options, names, f'needs {needed}')


def refuse_ignored(options: argparse.Namespace, source: str) -> None:
    """Refuse options that a bag, or a table, would ignore."""
    if source == 'table':
        of_bags = (n for title in SETTINGS if title.startswith('bags') for n in SETTINGS[title])
        refuse(options, (*of_bags, 'frame_id', 'largest_loss'), 'does not apply to a table')
    else:
        instead = 'does not apply to a bag: add eye_in_hand=true to its --sources'
        refuse(options, ('eye_in_hand',), instead)
        refuse(options, OF_TABLES, 'does not apply to a bag')


def complete_robots(prefix: str, **_: Any) -> list[str]:
    """Return completions of a robot or file name."""
    from glob import glob

    from calib_ros.kinematics.chain_file import shipped_robots  # loads numpy, not needed by --help

    return [*shipped_robots(), *glob(f'{prefix}*')]


def add_settings(parser: argparse.ArgumentParser, names: Sequence[str] = ()) -> None:
    """Add options for some settings, or for all, in their groups."""
    known = {item.name: item for item in fields(Settings)}
    for title, members in SETTINGS.items():
        wanted = [known[name] for name in members if not names or name in names]
        group = parser.add_argument_group(title) if wanted else parser
        add_fields(group, wanted)


def add_fields(group: Group, items: Iterable[Field[Any]]) -> None:
    """Add an option for each field of a dataclass that has a text; None stands for a number."""
    for item in items:
        many, text = isinstance(item.default, tuple), item.metadata['text']
        if item.default not in ((), '', None):
            shown = f'{item.default:.4g}' if isinstance(item.default, float) else item.default
            text += f' (default: {shown})'
        kind = str if many else float if item.default is None else type(item.default)
        group.add_argument(
            f'--{item.name.replace("_", "-")}',
            type=kind,
            action='append' if many else 'store',
            default=[] if many else item.default,
            metavar='NAME,...' if many else {float: 'X', int: 'N'}.get(kind, 'NAME'),
            help=text,
        )


def at_least(options: argparse.Namespace, **lowest: float) -> None:
    """Refuse options below their lowest value; missing ones pass."""
    for name, least in lowest.items():
        value = getattr(options, name)
        if value is not None and not value >= least:
            raise InputError(f'--{name} must be at least {least}, not {value}')


def check_loss(options: argparse.Namespace) -> None:
    """Refuse a largest loss that is no share."""
    if not 0.0 <= options.largest_loss <= 1.0:
        raise InputError(f'--largest-loss must be from 0 to 1, not {options.largest_loss}')


def check_tolerance(options: argparse.Namespace) -> None:
    """Refuse a tolerance in another unit than mm."""
    if options.tolerance is not None and not 0.0 < options.tolerance <= 100.0:
        raise InputError(f'--tolerance must be between 0 and 100 mm, not {options.tolerance:g} mm')


def refuse_existing(options: argparse.Namespace, *paths: Path) -> None:
    """Refuse to overwrite files, or write to a missing folder, before any work."""
    for path in paths:
        if not path.parent.is_dir():
            raise InputError(f'there is no folder {path.parent} to write {path.name} into')
        refuse_to_replace(path, options.force, '--force')


def settings_of(options: argparse.Namespace) -> Settings:
    """Return the settings among the options, others by default."""
    given: dict[str, Any] = {
        f.name: getattr(options, f.name) for f in fields(Settings) if hasattr(options, f.name)
    }
    for name, value in given.items():
        if isinstance(value, list):
            given[name] = tuple(part for text in value for part in text.split(','))
    return Settings(**given)


def sessions_of(options: argparse.Namespace) -> tuple[str, ...]:
    """Return the wanted sessions of a table."""
    return tuple(options.session.split(',')) if options.session else ()


@contextmanager
def output_files(options: argparse.Namespace, names: Sequence[str]) -> Iterator[Contents]:
    """Yield the files of --out, to be filled in; they are written at the end, all or none.

    Existing files with these names (glob patterns) are refused before any work, or replaced by
    --force. Other files stay. Without --out nothing is written.
    """
    contents: Contents = {}
    if options.out is None:
        yield contents
        return
    with whole_folder(options.out, names, overwrite=options.force) as folder:
        yield contents
        write_files(folder, contents)


def written(out: Path, contents: Contents) -> str:
    """Return where the files were written, and which to open."""
    page = 'report.html'
    return f'wrote {out}' + (f': open {out / page}' if page in contents else '')
