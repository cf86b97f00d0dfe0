# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What commands share: options, settings from them, and files that must not be overwritten."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from calib_ros.errors import InputError

if TYPE_CHECKING:
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


def refuse_overwriting(options: argparse.Namespace, names: Iterable[str]) -> None:
    """Refuse before any work is done, when files of these names are in the way."""
    if options.out is None or options.force:
        return
    there = [name for name in names if (options.out / name).exists()]
    if there:
        raise InputError(
            f'{options.out} holds {", ".join(there)} already: choose another folder or --force'
        )
