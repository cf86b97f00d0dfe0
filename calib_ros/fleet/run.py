# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A run over the fleet: workers identify new sources, and each result is filed at once.

Workers are local processes, or those of a dask cluster. If a worker, the scheduler or this process
is lost, only running tasks are lost; the next run repeats them.
"""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import calib_ros
from calib_ros.atomic import write_file
from calib_ros.errors import CalibrationError, ConfigError, shortened, trouble
from calib_ros.files.history import History
from calib_ros.files.rows import Row
from calib_ros.fleet.plant import Robot
from calib_ros.fleet.source_files import sources
from calib_ros.fleet.tasks import Outcome, Task, work
from calib_ros.identification.age import A_DAY, NEVER
from calib_ros.progress import Notify, quiet

NEEDS_DASK = 'a fleet needs dask.distributed: pip install "calib_ros[fleet]"'
ANSWER_S = 60.0  # time [s] for a scheduler and its first worker to answer; a convention
DASK = {
    'distributed.worker.profile.enabled': False,
    'distributed.admin.tick.interval': '1s',
    'distributed.admin.system-monitor.interval': '2s',
    'distributed.worker.memory.monitor-interval': '500ms',
    'distributed.worker.memory.pause': False,
    'distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_': 2**28,
    'distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_': 2**25,
}
"""Settings of dask: less self-monitoring, which costs more than its work; workers keep freed
memory [bytes], because getting it back costs a third of a large task's time, so one near its limit
must not pause until it has less."""


class LostError(CalibrationError):
    """The scheduler or all workers are gone; filed results stay."""


@dataclass(frozen=True)
class Cluster:
    """Where the work is done."""

    address: str = ''  # of a scheduler; empty for local processes
    workers: int = 0  # local processes; 0: one per core
    memory: str = '2GiB'  # limit of each, in dask's format


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
                client = stack.enter_context(_client(cluster))
                progress(f'dashboard: {client.dashboard_link}')
            for number, (task, outcome) in enumerate(_done(client, tasks), 1):
                _keep(task, outcome, history, out, found)
                progress(f'{number} of {len(tasks)}: {task.robot.serial}')
                progress(number / len(tasks))
    return found


def page_path(out: Path, row: Row) -> Path:
    """Return the path of a row's page."""
    return out / 'robots' / quote(row.serial, safe='') / f'{row.key}.html'


def results(robot: Robot, rows: Sequence[Row]) -> tuple[Row, ...]:
    """Return the identifications of a robot with its present settings.

    One for each content, and for each source and time, which a corrected file shares with the
    wrong one: that of this version, or else the last filed.
    """
    hashed = robot.settings_hash
    own = [row for row in rows if row.kind == 'identify' and row.settings == hashed]
    return _unique(_unique(own, lambda row: row.inputs), lambda row: (row.source, row.time))


def verifications(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Return the comparable verifications.

    One for each set of poses and calibration, whatever the tolerance or version.
    """
    own = [row for row in rows if row.kind == 'verify' and row.rms_mm and row.rms_freedom]
    return _unique(own, lambda row: (row.inputs, row.chain))


def _unique(rows: Sequence[Row], key: Callable[[Row], object]) -> tuple[Row, ...]:
    """Return rows ordered by time, one for each key.

    Rows filed before their stamps count as measured when filed.
    """
    dated = [replace(row, time=row.filed) if too_late(row) else row for row in rows]
    newest = sorted(dated, key=lambda row: (row.software == calib_ros.__version__, row.filed))
    unique = {key(row): row for row in newest}
    return tuple(sorted(unique.values(), key=lambda row: (row.time, row.source, row.key)))


def too_late(row: Row) -> bool:
    """Tell whether a result was filed before its stamps, in any time zone: a wrong clock."""
    return row.time - row.filed > A_DAY


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


@contextmanager
def _client(cluster: Cluster) -> Iterator[Any]:
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError:
        raise ConfigError(NEEDS_DASK) from None
    logging.getLogger('distributed.client').setLevel(logging.CRITICAL)  # LostError says it
    with ExitStack() as stack:
        where: Any = cluster.address
        limited = '' if where else f' (--memory {cluster.memory})'
        try:
            if not where:
                if dask.utils.parse_bytes(cluster.memory) < 100e6:
                    raise ValueError('a worker needs 100 MB or more')
                stack.enter_context(dask.config.set(DASK))
                local = LocalCluster(
                    n_workers=cluster.workers or None,
                    threads_per_worker=1,
                    processes=True,
                    memory_limit=cluster.memory,
                    dashboard_address='127.0.0.1:0',
                    silence_logs=logging.ERROR,
                )
                where = stack.enter_context(local)
            client = stack.enter_context(Client(where, set_as_default=False, timeout=ANSWER_S))
            client.wait_for_workers(1, timeout=ANSWER_S)
            versions = set(client.run(_version).values())
        except (OSError, TimeoutError, ValueError, RuntimeError) as err:
            there = cluster.address or 'this machine'
            raise LostError(f'no workers at {there}{limited}: {err}') from err
        own = calib_ros.__version__
        if others := ', '.join(sorted(versions - {own})):
            raise ConfigError(f'workers have calib_ros {others}, this is {own}: install the same')
        yield client


def _version() -> str:
    return calib_ros.__version__


def _done(
    client: Any, tasks: Sequence[Task], work: Callable[[Task], Outcome] = work
) -> Iterator[tuple[Task, Outcome]]:
    """Yield tasks with their outcomes, as completed."""
    from distributed import as_completed

    futures = client.map(work, tasks, pure=False)
    of = dict(zip((future.key for future in futures), tasks, strict=True))
    completed = as_completed(futures, client.loop, with_results=True, raise_errors=False)
    for future, outcome in _each(client, completed):
        if future.status in ('cancelled', 'lost'):
            raise LostError('the scheduler is lost: results so far are saved; run again')
        if future.status == 'error':
            ended = 'its worker ended, perhaps beyond its memory (--memory)'
            outcome = Outcome(error=f'{ended}: {shortened(str(future.exception()))}')
        yield of[future.key], outcome


def _each(client: Any, completed: Any) -> Iterator[tuple[Any, Any]]:
    """Yield futures with their results as completed, unless all workers are gone meanwhile."""
    last = time.monotonic()
    while not completed.is_empty():
        batch = completed.next_batch(block=False)
        yield from batch
        if batch:
            last = time.monotonic()
        elif time.monotonic() - last > ANSWER_S:
            try:  # one that is restarted is back soon
                client.wait_for_workers(1, timeout=ANSWER_S)
            except (OSError, TimeoutError, RuntimeError) as err:
                told = f'no workers are left: results so far are saved; run again: {err}'
                raise LostError(told) from err
            last = time.monotonic()
        else:
            time.sleep(0.02)
