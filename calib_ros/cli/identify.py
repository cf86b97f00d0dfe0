# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros identify`: a calibration from a bag, a table, or what a camera saw."""

from __future__ import annotations

import argparse
import math

from calib_ros.cli import given, options as common
from calib_ros.cli.detections import detected
from calib_ros.cli.kinds import refuse_others
from calib_ros.cli.recalibrate import recalibrated
from calib_ros.cli.results import (
    RESULT_FILES,
    Identified,
    document,
    identified,
    result_files,
    show,
)
from calib_ros.cli.screen import Screen
from calib_ros.errors import InputError
from calib_ros.files.boards import POSED, posed_arm
from calib_ros.files.loading import Loaded, of_bag, of_table
from calib_ros.files.rows import identified as row_of
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.report import words
from calib_ros.settings import Settings
from calib_ros.texts import dump_json

DETECTIONS = ('detections', 'board', 'places', 'intrinsics', 'lens')
"""Options for what a camera saw."""
OF_TABLES = (
    *('session', 'eye_in_hand', 'sigma_touch', 'preset', 'columns', 'joints'),
    *(*common.LAYOUT, *DETECTIONS),
)
OF_BAGS = ('joint_topics', 'sources', 'joint_names', 'frame_id')


def _run(options: argparse.Namespace, screen: Screen) -> int:
    if options.tolerance is not None and not 0.0 < options.tolerance < math.inf:
        raise InputError(f'--tolerance must be positive, not {options.tolerance}')
    if not 0.0 <= options.largest_loss <= 1.0:
        raise InputError(f'--largest-loss must be from 0 to 1, not {options.largest_loss}')
    if options.previous is not None:
        return recalibrated(options, lambda: _loaded(options, screen)[0], screen)
    history = given.history_of(options)
    with common.results(options, (*RESULT_FILES, 'report.pdf')) as contents:
        found = _identified(options, screen)
        if options.out is not None:
            contents |= result_files(found, screen, options.out, options.tolerance, options.pdf)
    if history is not None:
        problem, measured = found.loaded.problem, options.csv or options.detections
        sets, measured = (*problem.sets, *problem.judging), measured or options.measured
        about = given.filing_of(options, problem.chain, sets, measured, options.largest_loss)
        history.file(row_of(found.result, about, found.loaded.warnings))
    for warning in (*found.loaded.warnings, *words.remarks(found.result)):
        screen.warn(warning)
    if options.json:
        screen.data(dump_json(document(found, options.tolerance)))
    else:
        show(found, screen, options.tolerance)
        if options.out is None:
            screen.bullet('nothing is saved: --out FOLDER writes the calibration and its report')
        else:
            screen.say(common.written(options.out, contents))
    return 0 if found.result.accepted else common.NOT_ACCEPTED


def _source(options: argparse.Namespace) -> str:
    """Return 'bag' or 'table', with the table in `options.csv`, or the bag in `measured`."""
    if options.measured is not None and options.csv is None:
        bag = refuse_others(options.measured, 'identify', 'table', 'bag') == 'bag'
        if not bag:
            options.csv, options.measured = options.measured, None
    source = 'table' if options.csv or options.detections else 'bag'
    if (options.measured is None) == (source == 'bag'):
        raise InputError('give either a bag, or a table or --detections FILE, or both of these')
    for name in OF_BAGS if source == 'table' else OF_TABLES:
        if getattr(options, name):
            raise InputError(f'--{name.replace("_", "-")} is of no use with a {source}')
    return source


def _loaded(options: argparse.Namespace, screen: Screen) -> tuple[Loaded, Settings]:
    """Return what there is to identify in a table or a bag, and the settings."""
    source = _source(options)
    chain = posed_arm() if options.chain == POSED else load_chain(options.chain)
    settings = common.settings_of(options)
    if options.detections is not None:
        loaded = detected(options, chain, settings, screen)
    elif source == 'table':
        touch = options.sigma_touch
        touched = {} if touch is None else {'sigma_touch': touch}
        found = given.table(options, options.csv, chain, settings, screen, options.eye_in_hand)
        loaded = of_table(found, chain, settings, **touched)
    else:
        bag = given.replayed(options.measured, chain, settings, screen)
        loaded = of_bag(*bag, options.largest_loss)
    return loaded, settings


def _identified(options: argparse.Namespace, screen: Screen) -> Identified:
    """Return what is identified."""
    loaded, settings = _loaded(options, screen)
    configuration = words.configuration_yaml(options.chain, settings)
    read = (options.csv, options.detections, options.measured)
    return identified(loaded, settings, screen, given.origin_of(options, read, configuration))
