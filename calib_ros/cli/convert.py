# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros import | csv2bag | bag2csv`: measurements in other files."""

from __future__ import annotations

import argparse

import numpy as np

from calib_ros.atomic import write_file
from calib_ros.cli import checks, inputs
from calib_ros.cli.file_types import refuse_others
from calib_ros.cli.screen import Screen
from calib_ros.errors import InputError
from calib_ros.estimation.observations import Observations
from calib_ros.files.columns import as_csv
from calib_ros.files.foreign import Foreign
from calib_ros.files.journal import table_text
from calib_ros.files.layouts import Layout
from calib_ros.files.recording import Recording, write_bag
from calib_ros.files.tables import check_table
from calib_ros.kinematics.chain_file import load_chain


def _convert(options: argparse.Namespace, screen: Screen) -> int:
    refuse_others(options.table, 'import', 'table')
    checks.refuse_existing(options, options.out)
    chain = None if options.chain is None else load_chain(options.chain)
    foreign = inputs.foreign_of(options, chain) or Foreign(Layout(), chain)
    with screen.work(f'converting {options.table.name}'):
        columns, notes = foreign.convert(options.table)
        check_table(columns)
        text = as_csv(columns)
    for note in notes:
        screen.warn(note, 'note')
    write_file(options.out, text, overwrite=options.force)
    header = text.partition('\n')[0].replace(',', ', ')
    screen.say(f'wrote {options.out}: {len(columns.lines)} rows of {header}')
    return 0


def _csv2bag(options: argparse.Namespace, screen: Screen) -> int:
    refuse_others(options.csv, 'csv2bag', 'table')
    chain = load_chain(options.chain)
    table = inputs.table_of(options, options.csv, chain, screen)
    for warning in table.warnings:
        screen.warn(warning)
    every = [*table.fitted, *table.held_out]
    oriented = any(each.oriented.any() for each in every)
    if (
        (len(table.fitted), len(table.held_out) > 1) != (1, False)
        or len({(x.base, x.tool, x.inverse) for x in every}) > 1
        or any(x.socket or x.distances is not None or x.points is not None for x in every)
        or not all((x.oriented == oriented).all() for x in every)
    ):
        raise InputError(
            'a bag can hold only poses or positions of one session, one fixed device and one '
            'target, all with an orientation or none, and at least one to fit'
        )
    lost = {
        'covariance': 'covariances',
        'velocity': 'motion of the arm',
        'approach': 'signs s1 ...',
    }
    lacking = [w for n, w in lost.items() if any(getattr(x, n) is not None for x in every)]
    if lacking:
        told = f'the bag has no {", ".join(lacking)} of the table: its result may differ'
        screen.warn(told, 'note')
    (fitted,) = table.fitted
    held_out = table.held_out[0] if table.held_out else fitted.select(np.zeros(0, int))
    both = [(fitted.joints, held_out.joints), (fitted.positions, held_out.positions)]
    both += [(fitted.rotations, held_out.rotations)] if oriented else []
    rows = Observations.from_arrays(*map(np.concatenate, both))
    judging = np.arange(len(rows)) >= len(fitted)
    recording = Recording.of_dwells(chain.joint_names, rows, judging)
    with screen.work(f'writing {options.bag.name}') as work:
        write_bag(options.bag, recording, options.storage, progress=work)
    screen.say(f'wrote {options.bag}: {len(fitted)} poses to fit, {len(held_out)} held out')
    return 0


def _bag2csv(options: argparse.Namespace, screen: Screen) -> int:
    refuse_others(options.bag, 'bag2csv', 'bag')
    checks.refuse_existing(options, options.csv)
    chain = load_chain(options.chain)
    session, read = inputs.replayed_bag(options, options.bag, chain, screen)
    screen.say(f'{read}; {session.account()}')
    samples = session.usable
    if not samples:
        raise InputError(f'{options.bag} gives no poses ({session.account()})')
    write_file(options.csv, table_text(samples, len(chain.joints)), overwrite=options.force)
    for warning in read.warnings:
        screen.warn(warning)
    screen.say(f'wrote {options.csv}: {len(samples)} rows')
    return 0
