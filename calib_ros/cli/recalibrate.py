# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros identify --previous`: an earlier calibration brought up to date by a few poses."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from calib_ros.cli import options as common
from calib_ros.cli.given import calibration_of
from calib_ros.cli.results import set_aside
from calib_ros.cli.screen import Screen
from calib_ros.files.loading import Loaded
from calib_ros.identification.recalibration import Recalibration, recalibrate, years_since
from calib_ros.texts import dump_json

FILES = ('calibration.yaml', 'result.json')


def recalibrated(options: argparse.Namespace, loaded: Callable[[], Loaded], screen: Screen) -> int:
    """Bring the earlier calibration up to date; return the exit status."""
    with common.results(options, FILES) as contents:
        found = _found(options, loaded(), screen)
        contents['result.json'] = _document(found)
        if found.accepted:
            contents['calibration.yaml'] = found.calibration.dump()
        elif options.out is not None:
            contents |= set_aside(options.out)
    if options.json:
        screen.data(_document(found))
    else:
        screen.title(found.in_words(), found.accepted)
        if options.out is not None:
            screen.say(common.written(options.out, contents))
    return 0 if found.accepted else common.NOT_ACCEPTED


def _found(options: argparse.Namespace, loaded: Loaded, screen: Screen) -> Recalibration:
    common.at_least(options, growth=0)
    previous = calibration_of(options.previous, 'identify --previous', loaded.problem.chain)
    for warning in loaded.warnings:
        screen.warn(warning)
    new = ('base',) * options.new_base + ('tool',) * options.new_tool
    with screen.work('looking for what has changed'):
        return recalibrate(
            previous, loaded.problem, years_since(previous.record), 1e-3 * options.growth, new
        )


def _document(found: Recalibration) -> str:
    return dump_json(found.document()) + '\n'
