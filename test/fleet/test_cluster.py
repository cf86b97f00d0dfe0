# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A cluster as the commands of dask start it, from which a worker and a client are killed."""

import json
import os
import signal
import subprocess
import sys
import time
import zipfile
from contextlib import contextmanager
from pathlib import Path

import pandas
import plants
import psutil
import pytest
from distributed import LocalCluster

from calib_ros.cli.main import main
from calib_ros.files.history import History
from calib_ros.fleet.cluster import Cluster, LostError, done_tasks, workers_of
from calib_ros.fleet.plant import read_plant
from calib_ros.fleet.source_files import SourceFile
from calib_ros.fleet.tasks import Task

DASK = Path(sys.executable).with_name('dask')
ONE = ('--nworkers', '1', '--nthreads', '1')
ALONE = ('--host', '127.0.0.1', '--no-dashboard')


@contextmanager
def started(*command):
    process = subprocess.Popen(list(map(str, command)), start_new_session=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def until(predicate):
    """Wait for what other processes do."""
    end = time.monotonic() + 120
    while not predicate():
        assert time.monotonic() < end, 'waited for two minutes'
        time.sleep(0.02)


@pytest.fixture
def served(tmp_path):
    """Return a plant whose bag is at a URL, and whose tables are in an archive."""
    place = tmp_path / 'elsewhere'
    place.mkdir()
    plant = json.loads(plants.write_plant(place, ['B', 'C'], 4).read_text())
    with zipfile.ZipFile(place / 'nights.zip', 'w') as archive:
        for path in (place / 'nights').rglob('*.csv'):
            archive.write(path, path.relative_to(place))
    for each in plant['robots']:
        pattern = each['measured']
        each['measured'] = f'zip://{pattern}::file://{place}/nights.zip'
    assert main(['simulate', str(place / 'bags/A'), '--chain', 'ur10e', '--poses', '25']) == 0
    bags = {'serial': 'A', 'group': 'line', 'measured': f'file://{place}/bags/*[!l]'}
    plant['robots'].append(bags)
    (tmp_path / 'plant.yaml').write_text(json.dumps(plant))
    return tmp_path


def test_whatever_is_killed_each_result_is_filed_once_and_no_copy_is_left(served, monkeypatch):
    history, known, copies = served / 'history', served / 'scheduler.json', served / 'tmp'
    copies.mkdir()
    monkeypatch.setenv('TMPDIR', str(copies))
    with (
        started(DASK, 'scheduler', *ALONE, '--port', '0', '--scheduler-file', known),
        started(DASK, 'worker', '--scheduler-file', known, *ONE, *ALONE) as nannies,
    ):
        until(lambda: known.exists() and known.read_text().endswith('}'))
        address = json.loads(known.read_text())['address']
        command = ['fleet', str(served / 'plant.yaml'), '--history', str(history)]
        command += ['--scheduler', address]

        def filed():
            return len(list(history.glob('robot=*/*.parquet')))

        with started(sys.executable, '-m', 'calib_ros.cli.main', *command) as client:
            until(lambda: filed() >= 2)
            workers = psutil.Process(nannies.pid).children()
            next(each for each in workers if 'spawn_main' in ' '.join(each.cmdline())).kill()
            until(lambda: filed() >= 4)
            assert client.poll() is None
            client.kill()
            client.wait()
        left = filed()
        assert left < 9
        assert main(command) == 0
        assert filed() == 9
    assert not list(copies.rglob('*.csv'))
    rows = [row for serial in 'ABC' for row in History(history).rows(serial)]
    assert len({row.key for row in rows}) == len({row.source for row in rows}) == 9
    assert all(row.accepted for row in rows)
    frame = pandas.read_parquet(history)
    assert sorted(frame.key) == sorted(row.key for row in rows)
    assert rows[0].source.endswith('bags/A')
    assert rows[1].source.startswith('zip://nights/B/000.csv::file://')


def test_a_worker_near_its_limit_does_not_pause_for_ever():
    """It keeps freed memory: of a table too large for it a run waited without an end."""

    def paused(dask_worker):
        return dask_worker.memory_manager.memory_pause_fraction

    with workers_of(Cluster(workers=1)) as client:
        assert {*client.run(paused).values()} == {False}


def test_a_run_whose_workers_are_all_gone_ends(tmp_path, monkeypatch):
    """It waited without an end."""
    (robot,) = read_plant(plants.write_plant(tmp_path, ['A'], 0))
    local = LocalCluster(1, threads_per_worker=1, processes=False, dashboard_address=None)
    with local, workers_of(Cluster(local.scheduler_address)) as client:
        local.scale(0)
        until(lambda: not client.nthreads())
        monkeypatch.setattr('calib_ros.fleet.cluster.ANSWER_S', 1.0)  # not before: a busy machine
        with pytest.raises(LostError, match='no workers are left'):
            next(done_tasks(client, [Task(robot, SourceFile('a'))]))
