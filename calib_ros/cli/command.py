# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a command is. Each module of this folder with `COMMANDS` adds its own."""

from __future__ import annotations

import argparse
import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calib_ros.cli.screen import Screen

GROUPS = ('First steps', 'Before measuring', 'Calibrate', 'Use the calibration', 'Convert files')
"""Where commands stand in the overview."""


@dataclass(frozen=True)
class Command:
    """A command of the command line.

    Attributes
    ----------
    name, group, text : str
        Its name, one of `GROUPS`, and what it does.
    add : callable
        Adds its options to a parser; called for the command given only.
    run : callable
        Does it, with the options and the screen, and returns the exit status.
    examples : tuple of str
        Whole commands for the foot of its help, without "calib_ros".

    """

    name: str
    group: str
    text: str
    add: Callable[[argparse.ArgumentParser], None]
    run: Callable[[Any, Screen], int]
    examples: tuple[str, ...]


@cache
def commands() -> dict[str, Command]:
    """Return all commands by name, in the order of the overview."""
    package = importlib.import_module('calib_ros.cli')
    found: list[Command] = []
    for module in pkgutil.iter_modules(package.__path__):
        if module.name != 'main':
            loaded = importlib.import_module(f'calib_ros.cli.{module.name}')
            found += getattr(loaded, 'COMMANDS', ())
    found.sort(key=lambda each: (GROUPS.index(each.group), each.name))
    return {each.name: each for each in found}
