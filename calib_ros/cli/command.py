# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The commands, by the groups of the overview; what a command needs is imported when it runs."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from calib_ros.cli.screen import Screen


class Command(NamedTuple):
    """How to `add` the options of a command to a parser, and its `home`: MODULE.FUNCTION.

    Neither options nor help need what the command works with.
    """

    add: Callable[[argparse.ArgumentParser], None]
    home: str

    def run(self, options: Any, screen: Screen) -> int:
        """Run the command and return the exit status."""
        module, _, function = self.home.partition('.')
        loaded = importlib.import_module(f'calib_ros.cli.{module}')
        status: int = getattr(loaded, function)(options, screen)
        return status


GROUPS = {
    'First steps': {
        'chain': 'print the chain file of a robot, to read and to edit',
        'demo': 'simulate an arm, identify it, and compare the result with the truth',
        'robots': 'list the arms that come with calib_ros',
        'simulate': 'write the bag of a simulated robot cell, with the true chain',
    },
    'Before measuring': {
        'board': 'print a board for cameras, as PDF in its true size',
        'images': 'find the corners of a board in photographs',
        'plan': 'choose the poses to measure, and say how accurate they make',
    },
    'Calibrate': {
        'fleet': 'identify what is new of all robots of a plant, and tell which ones changed',
        'history': 'list results over time',
        'identify': 'identify the errors of an arm from a bag or a table of measured poses',
        'verify': 'judge a calibrated arm on new measurements: its errors, PASS or FAIL',
    },
    'Use the calibration': {
        'compare': 'test what has changed between two calibrations of one robot',
        'compensate': 'correct the joint values of a program by a calibration',
        'export': 'write a calibration in the forms that controllers and others read',
        'workspace': 'map errors over the workspace, and place a task where they are least',
    },
    'Convert files': {
        'bag2csv': 'write the poses of a bag as a table',
        'csv2bag': 'write a table of measured poses as a bag',
        'import': 'write a table of others as one of ours',
    },
}
"""Commands by the groups of the overview, and what they do."""
TEXTS = {name: text for group in GROUPS.values() for name, text in group.items()}
