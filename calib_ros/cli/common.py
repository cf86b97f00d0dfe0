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

from calib_ros.atomic import whole_folder, write_files
from calib_ros.settings import Settings

Group: TypeAlias = 'argparse.ArgumentParser | argparse._ArgumentGroup'
Contents: TypeAlias = dict[str, str | bytes]  # content of files by name
SETTINGS = {
    'the fit': ('model', 'fixed', 'priors', 'loss', 'folds', 'socket_distance'),
    'how the device measures': (
        *('sigma_position', 'sigma_orientation', 'sigma_pixel', 'sigma_scale'),
    ),
    'what is not accepted': ('largest_length', 'largest_angle', 'largest_error'),
    'bags: what is read': ('joint_topics', 'sources', 'frame_id', 'joint_names', 'delay'),
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


class Status(IntEnum):
    """Exit status if the input was used but the outcome is insufficient."""

    NOT_ACCEPTED = 3
    INCOMPLETE = 4
    """Of a fleet: some measurements or results could not be used, and no robot needs a look."""


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
    """Add an option for each field of a dataclass that has a text; None stands for a number.

    Those that are not given are missing: a given one may have the value of the default.
    """
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
            default=[] if many else argparse.SUPPRESS,
            metavar='NAME,...' if many else {float: 'X', int: 'N'}.get(kind, 'NAME'),
            help=text,
        )


def settings_of(options: argparse.Namespace) -> Settings:
    """Return the settings among the options, others by default."""
    given: dict[str, Any] = {
        f.name: getattr(options, f.name) for f in fields(Settings) if hasattr(options, f.name)
    }
    for name, value in given.items():
        if isinstance(value, list):
            given[name] = tuple(part for text in value for part in text.split(','))
    return Settings(**given)


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
