# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Objects made from options: tables, bags, calibrations, the origin and the page of a result."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime, timezone
from pathlib import Path

from calib_ros.cli.common import LAYOUT_OPTIONS, OF_REPORTS, OF_TABLES, Contents, settings_of
from calib_ros.cli.file_types import refuse_others
from calib_ros.cli.screen import Screen
from calib_ros.errors import InputError
from calib_ros.estimation.observations import Observations
from calib_ros.files import hashes, loading
from calib_ros.files.bags import Replayed, replay
from calib_ros.files.foreign import Foreign
from calib_ros.files.history import History
from calib_ros.files.layouts import Layout, layout_of
from calib_ros.files.rows import Filing, Row
from calib_ros.identification.age import measured_at
from calib_ros.identification.calibration import Calibration, load_calibration
from calib_ros.kinematics.chain import Chain
from calib_ros.report import page
from calib_ros.report.content import Origin, Report
from calib_ros.sampling.dataset import Dataset
from calib_ros.sampling.session import CalibrationSession


def _files(paths: Iterable[Path]) -> dict[Path, list[tuple[str, int, int]]]:
    """Return the files at some paths, sizes [bytes] and times of change [ns]; of a pipe none."""
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


def filer_of(options: argparse.Namespace) -> Callable[..., object]:
    """Return a function that files a result in --history; without it, it does nothing.

    The result is known by the files that it is of, or by the samples if these change from now on.
    """
    if options.history is None:
        return lambda *result: None
    if not options.serial:
        raise InputError('--history files results by serial number: add --serial')
    values = map(vars(options).get, ('csv', 'detections', 'measured', *OF_TABLES))
    paths = dict.fromkeys(value for value in values if isinstance(value, Path))
    history, unread = History(options.history), _files(paths)

    def file(
        row: Callable[[Filing], Row], nominal: Chain, sets: Sequence[Observations], *judged: object
    ) -> None:
        settings = hashes.settings_hash(nominal, settings_of(options), *judged)
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
        about = options.serial, measured_at(sets, changed), content, settings, source
        history.file(row(Filing(*about)))

    return file


def calibration_of(path: Path, command: str, nominal: Chain | None = None) -> Calibration:
    """Return the calibration in a file, or in the folder of an identification."""
    refuse_others(path, command, 'chain', 'result')
    return load_calibration(path, nominal)


def origin_of(options: argparse.Namespace, inputs: Sequence[Path | None], **more: str) -> Origin:
    """Return the origin of a result: the options, what `more` is known, and the files read."""
    chain = Path(options.chain)
    beside = (vars(options).get(name) for name in ('joints', 'places', 'board', 'intrinsics'))
    read = hashes.inputs_of(*inputs, *beside, chain if chain.is_file() else None)
    people = {name: getattr(options, name, '') for name in OF_REPORTS}
    return Origin(read, command=options.typed, **people | more)


def page_of(
    options: argparse.Namespace, report: Report, screen: Screen, name: str = 'report.html'
) -> Contents:
    """Return a report as HTML and --pdf by name; warn of those that lack a package."""
    made: list[tuple[str, str | bytes | None, str]]
    made = [(name, page.render(report), page.NEEDS_JINJA)]
    if vars(options).get('pdf'):
        made.append(('report.pdf', page.on_paper(report), page.MISSING_PDF))
    for _, content, missing in made:
        if content is None:
            screen.warn(missing, 'note')
    return {each: content for each, content, _ in made if content is not None}


def replayed_bag(
    options: argparse.Namespace, path: Path, chain: Chain, screen: Screen
) -> tuple[CalibrationSession, Replayed]:
    """Return a session that has replayed a bag."""
    session = CalibrationSession(chain, settings_of(options))
    with screen.work(f'reading {path.name}') as work:
        return session, replay(path, session, work)


def table_of(options: argparse.Namespace, path: Path, chain: Chain, screen: Screen) -> Dataset:
    """Return a table of measurements with the layout of the options."""
    given, foreign = vars(options), foreign_of(options, chain)
    sessions = options.session.split(',') if options.session else ()
    in_hand = given.get('eye_in_hand', False) and not given.get('detections')  # else of these
    with screen.work(f'reading {path.name}') as work:
        settings = settings_of(options)
        return loading.table(path, chain, settings, sessions, in_hand, foreign, work)
