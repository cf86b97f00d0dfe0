# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A run over the fleet: workers identify new sources, and each result is filed at once.

Workers are local processes, or those of a dask cluster. If a worker, the scheduler or this process
is lost, only running tasks are lost; the next run repeats them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from urllib.parse import quote

import calib_ros
from calib_ros.atomic import write_file
from calib_ros.errors import CalibrationError, trouble
from calib_ros.files.history import History
from calib_ros.files.rows import Row
from calib_ros.fleet.cluster import Cluster, done_tasks, workers_of
from calib_ros.fleet.plant import Robot
from calib_ros.fleet.results import results
from calib_ros.fleet.source_files import sources
from calib_ros.fleet.tasks import Outcome, Task
from calib_ros.identification.age import NEVER
from calib_ros.progress import Notify, quiet


@dataclass
class Run:
    """Results filed, time spent on them [s], and errors by robot and source.

    `copies` are, by robot and source, sources with the content of another one.
    """

    filed: int = 0
    seconds: float = 0.0
    errors: dict[str, dict[str, str]] = field(default_factory=partial(defaultdict, dict))
    copies: dict[str, dict[str, str]] = field(default_factory=partial(defaultdict, dict))


def run(
    robots: Sequence[Robot],
    history: History,
    cluster: Cluster,
    out: Path | None = None,
    progress: Notify = quiet,
) -> Run:
    """Identify all new sources, file results, and write the page of each robot's newest one.

    The cluster is not used if there is nothing to do. `out` is the folder of the report, None for
    no pages. Raises LostError if the cluster can no longer be reached.
    """
    found = Run()
    history.serials()  # fail here if it cannot be read at all
    with ExitStack() as stack:
        client = None
        for plan in (_new, _without_page):
            tasks = [task for robot in robots for task in plan(robot, history, out, found)]
            if not tasks:
                continue
            if client is None:
                client = stack.enter_context(workers_of(cluster))
                progress(f'dashboard: {client.dashboard_link}')
            for number, (task, outcome) in enumerate(done_tasks(client, tasks), 1):
                _keep(task, outcome, history, out, found)
                progress(f'{number} of {len(tasks)}: {task.robot.serial}')
                progress(number / len(tasks))
    return found


def page_path(out: Path, row: Row) -> Path:
    """Return the path of a row's page."""
    return out / 'robots' / quote(row.serial, safe='') / f'{row.key}.html'


def _new(robot: Robot, history: History, out: Path | None, found: Run) -> list[Task]:
    try:
        rows = results(robot, history.rows(robot.serial))
    except CalibrationError as err:
        found.errors[robot.serial][''] = str(err)
        return []
    present, wrong = sources(robot)
    if wrong:
        found.errors[robot.serial] |= wrong
    if not present:
        return []
    rows = tuple(row for row in rows if row.software == calib_ros.__version__)
    done = {(row.source, row.fingerprint) for row in rows if row.fingerprint}
    names = {each.name for each in present}
    known = {row.inputs: row.source if row.source in names else '' for row in rows}
    last = max(present, key=lambda each: (each.modified or NEVER, each.name))
    tasks = []
    for source in present:
        if (source.name, source.fingerprint) not in done:
            own = {inputs: name for inputs, name in known.items() if name == source.name}
            page = out is not None and source == last
            tasks.append(Task(robot, source, own or known, page))  # touched or copied
    return tasks


def _without_page(robot: Robot, history: History, out: Path | None, found: Run) -> list[Task]:
    names = found.errors.get(robot.serial, {})
    if out is None or '' in names:
        return []
    rows = results(robot, history.rows(robot.serial))
    if not rows or rows[-1].source in names or page_path(out, rows[-1]).exists():
        return []
    present, _ = sources(robot)
    return [Task(robot, each, page=True) for each in present if each.name == rows[-1].source]


def _keep(task: Task, outcome: Outcome, history: History, out: Path | None, found: Run) -> None:
    found.seconds += outcome.seconds
    row, serial, source, first = outcome.row, task.robot.serial, task.source.name, outcome.known
    if outcome.error:
        found.errors[serial][source] = outcome.error
    if row is not None and history.file(row):
        found.filed += 1
    elif row is not None:  # filed meanwhile
        first = next(r.source for r in history.rows(serial) if r.key == row.key)
    if first not in ('', source):
        found.copies[serial][source] = first
    if row is not None and outcome.page and out is not None:
        try:
            path = page_path(out, row)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, outcome.page, overwrite=True)
            for earlier in path.parent.glob(f'{"[0-9a-f]" * 64}.html'):
                if earlier != path:
                    earlier.unlink(missing_ok=True)
        except OSError as err:
            found.errors[serial][source] = f'the page of its report: {trouble(err)}'
