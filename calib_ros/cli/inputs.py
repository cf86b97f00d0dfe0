# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Objects made from options: tables, bags, calibrations, the origin and the page of a result."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import TypeAlias

from calib_ros.cli.common import LAYOUT_OPTIONS, OF_REPORTS, OF_TABLES, Contents, settings_of
from calib_ros.cli.file_types import refuse_others
from calib_ros.cli.screen import Screen
from calib_ros.errors import InputError
from calib_ros.estimation.observations import Observations
from calib_ros.files import hashes, loading, rows
from calib_ros.files.bags import Replayed, replay
from calib_ros.files.foreign import Foreign
from calib_ros.files.history import History
from calib_ros.files.layouts import Layout, layout_of
from calib_ros.identification.age import measured_at
from calib_ros.identification.calibration import Calibration, load_calibration
from calib_ros.kinematics.chain import Chain
from calib_ros.report import page
from calib_ros.report.content import Origin, Report
from calib_ros.sampling.dataset import Dataset
from calib_ros.sampling.session import CalibrationSession
from calib_ros.settings import Settings

Unread: TypeAlias = dict[Path, list[tuple[str, int, int]]]
"""Paths to read, measurements first, with their files: sizes [bytes] and times of change [ns]."""


def _files(paths: Iterable[Path]) -> Unread:
    """Return the files at some paths as they are now; those of a pipe are none."""
    now = {path: [(str(file), file.stat()) for file in hashes.files_of(path)] for path in paths}
    return {path: [(f, s.st_size, s.st_mtime_ns) for f, s in each] for path, each in now.items()}


def foreign_of(options: argparse.Namespace, chain: Chain | None) -> Foreign | None:
    """Return how to read a table of another system, or None."""
    given = {name: getattr(options, name) for name in LAYOUT_OPTIONS}
    if not (any(given.values()) or options.preset or options.columns or options.joints):
        return None
    if options.joints:
        refuse_others(options.joints, '--joints', 'table')
    given['decimal'] = {'comma': ',', 'point': '.'}.get(given['decimal'], given['decimal'])
    units = {name: given[name] for name in ('length', 'angle', 'joint_angle')}
    log = layout_of(options.joints_preset, options.columns, {} if options.joints_preset else units)
    layout = layout_of(options.preset, options.columns, given)
    return Foreign(layout, chain, options.joints, log if options.joints else Layout())


def history_of(options: argparse.Namespace) -> tuple[History, Unread] | None:
    """Return the history for a result and what is to be read, or None without --history."""
    if options.history is None:
        return None
    if not options.serial:
        raise InputError('--history files results by serial number: add --serial')
    values = map(vars(options).get, ('csv', 'detections', 'measured', *OF_TABLES))
    paths = dict.fromkeys(value for value in values if isinstance(value, Path))
    return History(options.history), _files(paths)


def calibration_of(path: Path, command: str, nominal: Chain | None = None) -> Calibration:
    """Return the calibration in a file, or in the folder of an identification."""
    refuse_others(path, command, 'chain', 'result')
    return load_calibration(path, nominal)


def filing_of(
    options: argparse.Namespace,
    nominal: Chain,
    sets: Sequence[Observations],
    unread: Unread,
    *judged_by: object,
) -> rows.Filing:
    """Return what is filed with a result: by its files, or by the samples where these changed."""
    settings = hashes.settings_hash(nominal, settings_of(options), *judged_by)
    measured, *_ = unread
    read, changed = [hashes.samples_hash(sets)], None
    if all(unread.values()) and unread == _files(unread):
        read = [each.sha256 for each in hashes.inputs_of(*unread)]
        changed = datetime.fromtimestamp(measured.stat().st_mtime, timezone.utc)
    for name in OF_TABLES[1:]:  # a session is told apart anyway
        value = vars(options).get(name)  # the same table in other units is another result
        read += [f'{name} {value}'] if value and not isinstance(value, Path) else []
    session = options.session or ''
    source = f'{measured}#{session}' if session else str(measured)
    content = hashes.content_hash(read, session)
    return rows.Filing(options.serial, measured_at(sets, changed), content, settings, source)


def origin_of(options: argparse.Namespace, inputs: Sequence[Path | None], **more: str) -> Origin:
    """Return the origin of a result: the options, what `more` is known, and the files read."""
    chain = Path(options.chain)
    beside = (vars(options).get(name) for name in ('joints', 'places', 'board', 'intrinsics'))
    read = hashes.inputs_of(*inputs, *beside, chain if chain.is_file() else None)
    people = {name: getattr(options, name, '') for name in OF_REPORTS}
    return Origin(read, command=options.typed, **people | more)


def page_of(
    report: Report, screen: Screen, name: str = 'report.html', pdf: bool = False
) -> Contents:
    """Return a report as files by name; none if a package is missing, with one warning.

    `pdf` adds report.pdf.
    """
    made: list[tuple[str, str | bytes | None, str]]
    made = [(name, page.render(report), page.NEEDS_JINJA)]
    made += [('report.pdf', page.on_paper(report), page.MISSING_PDF)] if pdf else []
    for _, content, missing in made:
        if content is None:
            screen.warn(missing, 'note')
    return {each: content for each, content, _ in made if content is not None}


def replayed_bag(
    path: Path, chain: Chain, settings: Settings, screen: Screen
) -> tuple[CalibrationSession, Replayed]:
    """Return a session that has replayed a bag."""
    session = CalibrationSession(chain, settings)
    with screen.work(f'reading {path.name}') as work:
        return session, replay(path, session, work)


def table_of(
    options: argparse.Namespace,
    path: Path,
    chain: Chain,
    settings: Settings,
    screen: Screen,
    eye_in_hand: bool = False,
) -> Dataset:
    """Return a table of measurements with the layout of the options."""
    foreign = foreign_of(options, chain)
    sessions = options.session.split(',') if options.session else ()
    with screen.work(f'reading {path.name}') as work:
        return loading.table(path, chain, settings, sessions, eye_in_hand, foreign, work)
