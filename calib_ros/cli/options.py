# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What commands share: options, settings from them, and the folder of their results."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib_ros.atomic import whole_folder

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


def results(options: argparse.Namespace, names: Sequence[str]) -> AbstractContextManager[Path]:
    """Return the folder --out to be made in a `with` block; see `whole_folder`.

    Files of these names (glob patterns) are refused before any work is done, or replaced by
    --force. Other files stay in the folder.
    """
    return whole_folder(options.out, names, overwrite=options.force)
