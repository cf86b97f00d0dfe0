# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros workspace`: errors over the workspace."""

from __future__ import annotations

import argparse

import numpy as np

from calib_ros.apply import placement, workspace
from calib_ros.apply.task import task_of
from calib_ros.apply.workspace import Survey, in_base, regions
from calib_ros.cli import checks, common, inputs
from calib_ros.cli.screen import Screen
from calib_ros.errors import InputError
from calib_ros.files.programs import csv_of, joints_csv, read_poses
from calib_ros.identification.calibration import Calibration, calibration_file
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.limits import check_limits
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.report.markdown import markdown
from calib_ros.report.workspace import placed_in_words, workspace_report
from calib_ros.shown import rounded

WORKSPACE_FILES = ('workspace.csv', 'workspace.md', 'workspace.png', 'report.html')
PLACEMENT_FILES = ('placements.csv', 'placements.png', 'placed_task.csv')
OF_PLACEMENT = ('region', 'aim', 'model', 'cells', 'turns')


def _run(options: argparse.Namespace, screen: Screen) -> int:
    from calib_ros.report import plots

    checks.at_least(options, poses=100, cells=1, turns=1, seed=0)
    if options.task is None and options.joint_box is None:
        checks.refuse(options, OF_PLACEMENT, 'needs --task or --joint-box')
    with common.output_files(options, WORKSPACE_FILES + PLACEMENT_FILES) as contents:
        arm = inputs.calibration_of(options.result, 'workspace', load_chain(options.chain))
        rng = np.random.default_rng(options.seed)
        task = _task(options, arm, rng)
        with screen.work('mapping errors over the workspace'):
            survey = workspace.survey(arm, options.poses, rng)
            table = csv_of(('x', 'y', 'z', 'error', 'sigma'), survey.cloud)
            contents |= {'workspace.csv': table, 'workspace.png': plots.workspace_png(survey)}
        _show(survey, screen)
        if arm.region is not None:
            screen.bullet(f'The calibration is {arm.region.in_words()}.')
        found = None
        if task is not None:
            region = None if options.region is None else np.reshape(options.region, (2, 3))
            aim, model, where = options.aim, options.model, (region, options.cells, options.turns)
            with screen.work('placing the task') as work:
                found = placement.place(arm, task, aim, model, *where, progress=work)
            screen.bullet(f'Expected {aim} error of the task, {model} model')
            screen.bullet(placed_in_words(found))
            rows = np.column_stack([found.positions, found.turns, found.errors])
            contents['placements.csv'] = csv_of(('x', 'y', 'z', 'turn', 'error'), rows)
            contents['placements.png'] = plots.placements_png(found)
            contents['placed_task.csv'] = joints_csv(found.joints[found.best])
        serial = arm.serial_of(str(options.result), options.serial)
        origin = inputs.origin_of(options, (calibration_file(options.result),), serial=serial)
        with screen.work('writing the report'):
            report = workspace_report(arm, survey, origin, found)
            contents['workspace.md'] = markdown(report, {})
            contents |= inputs.page_of(options, report, screen)
    screen.say(common.written(options.out, contents))
    return 0


def _show(survey: Survey, screen: Screen) -> None:
    rows = {'position error': f'at {len(survey.joints):,} random poses of the joint range'}
    for label, errors in survey.parts.items():
        rms, _, _, most, largest = map(rounded, workspace.spread(1e3 * errors).values())
        figures = f'RMS {rms}, 95 % below {most}, largest {largest} mm'
        rows[label.removesuffix(' by the calibration')] = figures
    found = regions(survey.positions, survey.removed)
    for label, sector in (('removes most', found[0]), ('removes least', found[-1])):
        rows[label] = f'{sector.words}: RMS {rounded(1e3 * sector.rms)} mm'
    screen.table(rows)


def _task(
    options: argparse.Namespace, arm: Calibration, rng: np.random.Generator
) -> FloatArray | None:
    if options.task is not None and options.joint_box is not None:
        raise InputError('give either --task or --joint-box')
    if options.task is not None:
        return read_poses(options.task)
    if options.joint_box is None:
        return None
    size, count = len(arm.chain.joints), len(options.joint_box)
    if count != 2 * size:
        raise InputError(f'--joint-box: give {size} lower and {size} upper values, not {count}')
    lower, upper = box = np.reshape(options.joint_box, (2, size))
    check_limits(box, arm.chain, lambda *_: '--joint-box: ')
    if not (lower <= upper).all():
        raise InputError('--joint-box: give all lower values first, then all upper ones')
    joints = rng.uniform(lower, upper, (30, size))
    return task_of(in_base(arm.commanded_by(options.model), joints))
