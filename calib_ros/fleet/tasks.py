# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A task of a fleet run: a bag or a table is fetched and identified."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from calib_ros.errors import CalibrationError, shortened
from calib_ros.files import hashes, result_rows, rows
from calib_ros.files.bags import replay
from calib_ros.files.loading import TABLES, load_bag, load_table, table
from calib_ros.fleet.plant import Robot
from calib_ros.fleet.source_files import SourceFile, fetched
from calib_ros.identification.age import measured_at
from calib_ros.report.content import Origin
from calib_ros.report.documents import configuration_yaml
from calib_ros.report.page import render
from calib_ros.report.reports import identification_report
from calib_ros.sampling.session import CalibrationSession

PLOTLY = 'plotly.min.js'  # the script shared by all pages of a report


@dataclass(frozen=True, eq=False)
class Task:
    """A source to identify, with a `page` if wanted, unless its content is `known`.

    `known` maps hashes of contents to the source filed with them, if it still exists.
    """

    robot: Robot
    source: SourceFile
    known: Mapping[str, str] = field(default_factory=dict)
    page: bool = False


class Outcome(NamedTuple):
    """The outcome of a task: a row, an error, or the source with the same content."""

    row: rows.Row | None = None
    error: str = ''
    known: str = ''
    page: str = ''
    seconds: float = 0.0


def work(task: Task) -> Outcome:
    """Do a task; an error is that of its source and harms nothing else."""
    begin, path = time.monotonic(), None
    try:
        with fetched(task.source.url) as path:
            outcome = _outcome(task, path)
    except Exception as err:  # costs only this source
        kind = '' if isinstance(err, CalibrationError | OSError) else f'{type(err).__name__}: '
        (words,) = _named(task, path, (f'{kind}{err}',))
        outcome = Outcome(error=shortened(words))
    return outcome._replace(seconds=time.monotonic() - begin)


def _named(task: Task, path: Path | None, told: Sequence[str]) -> tuple[str, ...]:
    """Return what is told of a source with its name, not that of the copy."""
    return tuple(words.replace(str(path), task.source.url) if path else words for words in told)


def _outcome(task: Task, path: Path) -> Outcome:
    robot, source = task.robot, task.source
    inputs = hashes.inputs_of(path)
    content = hashes.content_hash([each.sha256 for each in inputs], source.session)
    if content in task.known:
        return Outcome(known=task.known[content])
    chain, settings = robot.chain, robot.settings
    if path.suffix.lower() in TABLES and path.is_file():  # anything else is a bag
        sessions = (source.session,) if source.session else ()
        loaded = load_table(table(path, chain, settings, sessions), chain, settings)
    else:
        session = CalibrationSession(chain, settings)
        loaded = load_bag(session, replay(path, session), robot.largest_loss)
    result = loaded.identified(settings.model)
    loaded = replace(loaded, warnings=_named(task, path, loaded.warnings))
    time_of = measured_at(loaded.problem.all_sets, source.modified)
    known = (content, robot.settings_hash, source.name, source.fingerprint)
    row = result_rows.result_row(
        result, rows.Filing(robot.serial, time_of, *known), loaded.warnings
    )
    if not task.page:
        return Outcome(row)
    configuration = configuration_yaml(chain.name, settings)
    origin = Origin(inputs, serial=robot.serial, settings=configuration)
    report = identification_report(loaded, result, origin, robot.tolerance)
    return Outcome(row, page=render(report, f'../../{PLOTLY}') or '')
