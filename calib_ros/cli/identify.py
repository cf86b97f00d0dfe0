# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros identify`: a calibration from a bag, a table, or what a camera saw."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from calib_ros.cli import given, options as common
from calib_ros.cli.kinds import refuse_others
from calib_ros.cli.results import (
    RESULT_FILES,
    Identified,
    document,
    identified,
    result_files,
    set_aside,
    show,
)
from calib_ros.cli.screen import Screen
from calib_ros.errors import InputError
from calib_ros.files import boards
from calib_ros.files.history import identified as row_of
from calib_ros.files.loading import Loaded, of_bag, of_table
from calib_ros.identification.observations import Observations
from calib_ros.identification.problem import Problem
from calib_ros.identification.reasons import Reason, Rule
from calib_ros.identification.recalibration import recalibrate, years_since
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.report import words
from calib_ros.sampling.problems import with_lenses
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
        return _recalibrated(options, screen)
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


def _recalibrated(options: argparse.Namespace, screen: Screen) -> int:
    """Bring an earlier calibration up to date by a few poses; return the exit status."""
    with common.results(options, ('calibration.yaml', 'result.json')) as contents:
        loaded, _ = _loaded(options, screen)
        common.at_least(options, growth=0)
        previous = given.calibration_of(
            options.previous, 'identify --previous', loaded.problem.chain
        )
        for warning in loaded.warnings:
            screen.warn(warning)
        new = ('base',) * options.new_base + ('tool',) * options.new_tool
        years, growth = years_since(previous.record), 1e-3 * options.growth
        with screen.work('looking for what has changed'):
            found = recalibrate(previous, loaded.problem, years, growth, new)
        text = dump_json(found.document()) + '\n'
        contents['result.json'] = text
        if found.accepted:
            contents['calibration.yaml'] = found.calibration.dump()
        elif options.out is not None:
            contents |= set_aside(options.out)
    if options.json:
        screen.data(text)
    else:
        screen.title(found.in_words(), found.accepted)
        if options.out is not None:
            screen.say(common.written(options.out, contents))
    return 0 if found.accepted else common.NOT_ACCEPTED


def _identified(options: argparse.Namespace, screen: Screen) -> Identified:
    loaded, settings = _loaded(options, screen)
    configuration = words.configuration_yaml(options.chain, settings)
    read = (options.csv, options.detections, options.measured)
    return identified(loaded, settings, screen, given.origin_of(options, read, configuration))


def _loaded(options: argparse.Namespace, screen: Screen) -> tuple[Loaded, Settings]:
    """Return what there is to identify in a table or a bag, and the settings."""
    source = _source(options)
    posed = options.chain == boards.POSED
    chain = boards.posed_arm() if posed else load_chain(options.chain)
    settings = common.settings_of(options)
    touch = options.sigma_touch
    touched: dict[str, Any] = {} if touch is None else {'sigma_touch': touch}
    if options.detections is not None:
        return _detected(options, chain, settings, touched, screen), settings
    if source == 'table':
        found = given.table(options, options.csv, chain, settings, screen, options.eye_in_hand)
        return of_table(found, chain, settings, **touched), settings
    bag = given.replayed(options.measured, chain, settings, screen)
    return of_bag(*bag, options.largest_loss), settings


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


def _detected(
    options: argparse.Namespace,
    chain: Chain,
    settings: Settings,
    touched: dict[str, Any],
    screen: Screen,
) -> Loaded:
    """Return what is to be fitted of corners of a board, and of a table besides."""
    for name in ('board', 'places'):
        if getattr(options, name) is None:
            raise InputError(f'--detections need --{name} as well')
    board = boards.read_board(options.board)
    found = boards.read_detections(options.detections, board)
    places, posed = boards.read_places(options.places, len(chain.joints))
    if posed != (chain.name == boards.POSED):
        raise InputError(
            f'{options.places} holds {"poses of the flange" if posed else "joint values"}: '
            + (f'give --chain {boards.POSED}' if posed else 'give the chain of the arm')
        )
    seen, warnings = boards.observed(found, board, places, options.eye_in_hand)
    more: Sequence[Observations] = ()
    held_out: Sequence[Observations] = ()
    by_line = True
    if options.csv is not None:
        rows = given.table(options, options.csv, chain, settings, screen)
        more, held_out, by_line = rows.fitted, rows.held_out, rows.by_line
        warnings = (*warnings, *rows.warnings)
        names = ('base_board', 'tool_camera') if seen.on_flange else ('base_camera', 'tool_board')
        seen = replace(seen, base=names[0], tool=names[1])
    known = chain.frame(seen.camera).lens if seen.camera in chain.frame_names else None
    lens = known if options.intrinsics is None else boards.read_lens(options.intrinsics)
    if lens is not None:
        chain = with_lenses(chain, {seen.camera: replace(lens, fixed=options.lens != 'fitted')})
    chosen = settings.for_problem() | touched
    if posed:
        chosen['fixed'] = (*chosen['fixed'], *(f'{name}.*' for name in chain.joint_names))
    problem = Problem(chain, seen, held_out, more=more, **chosen)
    reason = 'joint values are not known, so nothing of the arm was fitted: only what follows'
    refusals = (Reason(Rule.POSED, reason),) if posed else ()
    count = sum(map(len, problem.sets))
    samples = {'samples': count, 'images': len(found.names), 'sets': len(problem.sets)}
    images = dict(zip(found.lines, found.names, strict=True)) if by_line else {}
    return Loaded(problem, samples, warnings, '', by_line, images, refusals, instead=posed)
