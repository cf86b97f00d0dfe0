# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The workers of a fleet run: local processes, or those of a dask cluster."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import calib_ros
from calib_ros.errors import CalibrationError, ConfigError, shortened
from calib_ros.fleet.tasks import Outcome, Task, work

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


@contextmanager
def workers_of(cluster: Cluster) -> Iterator[Any]:
    """Yield the client of a cluster; refuse one without workers, or with other versions."""
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


def done_tasks(
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
