# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Options that a command refuses, before any work."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

from calib_ros.atomic import refuse_to_replace
from calib_ros.cli.common import OF_TABLES, SETTINGS
from calib_ros.errors import InputError

NEEDS = {
    '--previous': ('growth', 'new_base', 'new_tool'),
    '--detections': ('board', 'places', 'intrinsics', 'lens'),
    '--joints': ('joints_preset',),
    '--tracker': ('axis', 'cone'),
    '--urdf': ('base_link', 'tip_link'),
    '--out': ('pdf',),
}
"""Options that do nothing without another one."""


def refuse(options: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Refuse options that are not at their default, and tell why."""
    for name in names:
        default = options.parser.get_default(name)
        if vars(options).get(name, default) != default:
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
        refuse(options, (*of_bags, 'largest_loss'), 'does not apply to a table')
    else:
        instead = 'does not apply to a bag: add eye_in_hand=true to its --sources'
        refuse(options, ('eye_in_hand',), instead)
        refuse(options, OF_TABLES, 'does not apply to a bag')


def at_least(options: argparse.Namespace, **lowest: float) -> None:
    """Refuse options below their lowest value; missing ones pass."""
    for name, least in lowest.items():
        value = getattr(options, name)
        if value is not None and not value >= least:
            raise InputError(f'--{name} must be at least {least}, not {value}')


def check_acceptance(options: argparse.Namespace) -> None:
    """Refuse a largest loss that is no share, and a tolerance in another unit than mm."""
    if not 0.0 <= options.largest_loss <= 1.0:
        raise InputError(f'--largest-loss must be from 0 to 1, not {options.largest_loss}')
    if options.tolerance is not None and not 0.0 < options.tolerance <= 100.0:
        raise InputError(f'--tolerance must be between 0 and 100 mm, not {options.tolerance:g} mm')


def refuse_existing(options: argparse.Namespace, *paths: Path) -> None:
    """Refuse to overwrite files, or write to a missing folder, before any work."""
    for path in paths:
        if not path.parent.is_dir():
            raise InputError(f'there is no folder {path.parent} to write {path.name} into')
        refuse_to_replace(path, options.force, '--force')
