# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros compare`: what is different between two calibrations of one robot."""

from __future__ import annotations

import argparse

from calib_ros.cli.given import calibration_of
from calib_ros.cli.options import NOT_ACCEPTED
from calib_ros.cli.screen import Screen
from calib_ros.identification.difference import difference
from calib_ros.texts import dump_json


def _run(options: argparse.Namespace, screen: Screen) -> int:
    pair = [calibration_of(path, 'compare') for path in (options.first, options.second)]
    with screen.work('comparing'):
        found = difference(*pair)
    if options.json:
        screen.data(dump_json(found.document()))
    else:
        screen.title(found.in_words(), found.same)
        if not found.same:
            screen.table(found.rows())
    return 0 if found.same else NOT_ACCEPTED
