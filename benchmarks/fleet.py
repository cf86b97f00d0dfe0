# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A plant of simulated robots, night by night: what is found, what it costs, what survives.

    python benchmarks/fleet.py [--quick] [--json] [--part PART] [--robots N]

nights: 200 robots x 30 nights x 60 poses (0.05 mm, 0.2 mrad). Five robots are bumped in some night
but the first three: one parameter of the arm moves by 0.1 mm or 0.2 mrad. Five others: parameters
of two joints move by twice as much. Found: the joint, or both or one of two, named within two
nights. A second run has nothing to do. workers: throughput of one and two workers on
tables of 25,000 poses, over a second each, beside that of one and two processes without dask: what
the machine can do. scheduler: its time and the client's for each task. kills: ten runs in which a
worker, then the client is killed with SIGKILL; the history must hold each result once.
"""

import json
import subprocess
import sys
import tempfile
import time
import zipfile
from concurrent.futures import ProcessPoolExecutor
from datetime import timedelta
from itertools import product
from multiprocessing import get_context
from pathlib import Path

import bench
import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / 'test')]

import plants
import psutil

from calib_ros.estimation.identifiability import structurally_independent
from calib_ros.files.history import History
from calib_ros.fleet.cluster import Cluster, done_tasks, workers_of
from calib_ros.fleet.page import write_report
from calib_ros.fleet.plant import read_plant
from calib_ros.fleet.run import run
from calib_ros.fleet.source_files import sources
from calib_ros.fleet.status import statuses
from calib_ros.fleet.tasks import Outcome, Task, work
from calib_ros.kinematics.chain_file import load_chain

POSES, BEFORE = 60, 3
LENGTHS = ('.a', '.d')
PEERS = ('processes', 'workers')


def bumps_of(serials, nights, number, rng):
    """Return night and offsets of some robots: one parameter each, then those of two joints."""
    chain = load_chain('ur10e')
    names = structurally_independent(chain, chain.parameter_names)
    own = [name for name in map(str, names) if name.partition('.')[0] in chain.joint_names]
    found = {}
    for k, serial in enumerate(rng.choice(serials, 2 * number, replace=False).tolist()):
        bumped = 1 + k // number
        by_joint = {str(name).partition('.')[0]: str(name) for name in rng.permutation(own)}
        offsets = {
            name: float(rng.choice((-1, 1)) * bumped * (1e-4 if name.endswith(LENGTHS) else 2e-4))
            for name in list(by_joint.values())[:bumped]
        }
        found[serial] = (int(rng.integers(BEFORE, nights - 1)), offsets)
    return found


def archived(plant):
    """Put the tables of a plant into an archive, from which workers fetch them by its URL."""
    place = plant.parent / 'nights.zip'
    with zipfile.ZipFile(place, 'w') as archive:
        for path in (plant.parent / 'nights').rglob('*.csv'):
            archive.write(path, path.relative_to(plant.parent))
    content = json.loads(plant.read_text())
    for robot in content['robots']:
        robot['measured'] = f'zip://{robot["measured"]}::file://{place}'
    plant.write_text(json.dumps(content))


def row_ms(history, copy):
    """Return the time [ms] to file a row, to read it, and to read it from the cache."""
    serials = history.serials()
    rows = [row for serial in serials for row in history.rows(serial)]
    clock = [time.monotonic()]
    for row in rows:
        copy.file(row)
    clock.append(time.monotonic())
    for _ in ('files', 'cache'):
        for serial in serials:
            copy.rows(serial)
        clock.append(time.monotonic())
    return dict(zip(('filed', 'read', 'cached'), 1e3 * np.diff(clock) / len(rows), strict=True))


def nights_part(folder, robots, nights, number, cluster):
    """Return what two runs over a plant find and take."""
    serials = [f'R{k:03}' for k in range(robots)]
    bumps = bumps_of(serials, nights, number, np.random.default_rng(1))
    written = plants.write_plant(folder, serials, nights, POSES, bumps)
    if cluster.address:
        archived(written)
    plant = read_plant(written)
    history, out = History(folder / 'history'), folder / 'report'
    spans, parts = [], {}
    for name in ('first', 'second'):
        begin = time.monotonic()
        done = run(plant, history, cluster, out)
        middle = time.monotonic()
        stood = statuses(plant, history, done, 100.0)
        later = time.monotonic()
        write_report(out, stood, done)
        end = time.monotonic()
        spans.append(end - begin)
        parts[name] = {
            'run_s': middle - begin,
            'alarms_s': later - middle,
            'report_s': end - later,
        }
        if name == 'first':
            parts['work_s'] = done.seconds / max(1, done.filed)
            parts['filed'] = done.filed
    found, false, said = dict.fromkeys((1, 2), frozenset()), 0, []
    for each in stood:
        serial = each.robot.serial
        for change in each.watched.changes:
            night, offsets = bumps.get(serial, (-9, {}))
            bumped = {name.partition('.')[0] for name in offsets}
            seen = (change.seen - plants.when(0)) / timedelta(days=1)
            named = {reason.owner for reason, *_ in change.changed} or {''}
            right = named <= bumped and night <= round(seen) <= night + 1
            said.append(f'{serial} night {round(seen)}: {change}; true: {night} {offsets}')
            if right:
                found[len(bumped)] |= {serial}
            false += not right
    files = [path.stat().st_size for path in (folder / 'history').rglob('*.parquet')]
    pages = [path.stat().st_size for path in out.glob('robots/*/*.html')]
    return {
        'found_share': len(found[1]) / number,
        'pairs_found_share': len(found[2]) / number,
        'false_alarms': false,
        'second_run_share': spans[1] / spans[0],
        'first_run_s': spans[0],
        'second_run_s': spans[1],
        'row_bytes': float(np.mean(files)),
        'row_ms': row_ms(history, History(folder / 'copy')),
        'page_bytes': float(np.mean(pages)),
        'input_bytes': (folder / 'nights/R000/000.csv').stat().st_size,
        'alarms': said,
        **parts,
    }


def cpu(task):
    """Do a task; its time is that of the processor."""
    begin = time.process_time()
    return work(task)._replace(seconds=time.process_time() - begin)


def by_processes(number, tasks):
    """Return what processes that know nothing of each other make of tasks, and the time."""
    with ProcessPoolExecutor(number, get_context('spawn')) as pool:
        list(pool.map(cpu, tasks[:number]))  # they import what they need
        begin = time.monotonic()
        return list(pool.map(cpu, tasks)), time.monotonic() - begin


def by_workers(number, tasks):
    """Return what workers of dask make of tasks, and the time."""
    with workers_of(Cluster('', number)) as client:
        list(done_tasks(client, tasks[:number], cpu))
        begin = time.monotonic()
        found = [outcome for _, outcome in done_tasks(client, tasks, cpu)]
        return found, time.monotonic() - begin


def workers_part(folder, tables, poses, rounds):
    """Return how many large tables one and two workers do in a second, and plain processes."""
    plant = read_plant(plants.write_plant(folder, ['R'], tables, poses))
    tasks = [Task(plant[0], source) for source in sources(plant[0])[0]]
    speed, cost = {}, {}
    for _ in range(rounds):
        for number, way in product((1, 2), (by_processes, by_workers)):
            outcomes, span = way(number, tasks)
            key = f'{way.__name__[3:]}_{number}'
            speed.setdefault(key, []).append(len(tasks) / span)
            cost.setdefault(key, []).append(np.mean([each.seconds for each in outcomes]))
    per_second = {key: float(np.median(values)) for key, values in speed.items()}
    gain = {key: per_second[f'{key}_2'] / per_second[f'{key}_1'] for key in PEERS}
    return {
        'per_second': per_second,
        'task_cpu_s': {key: float(np.median(values)) for key, values in cost.items()},
        'gain': gain['workers'],
        'gain_of_processes': gain['processes'],
        'of_ceiling': per_second['workers_2'] / per_second['processes_2'],
    }


def nothing(_):
    """Take as long as a small table, without a processor."""
    time.sleep(0.1)
    return Outcome(seconds=0.1)


def scheduler_part(folder, count):
    """Return the time of client and scheduler for each of many tasks of 0.1 s."""
    plant = read_plant(plants.write_plant(folder, ['R'], 1))
    tasks = [Task(plant[0], sources(plant[0])[0][0])] * count
    with workers_of(Cluster('', 2)) as client:
        list(done_tasks(client, tasks[:50], nothing))
        begin, spent = time.monotonic(), time.process_time()
        list(done_tasks(client, tasks, nothing))
        span, spent = time.monotonic() - begin, time.process_time() - spent
        return {'cpu_ms': 1e3 * spent / count, 'idle_share': 1.0 - 0.1 * count / 2 / span}


def kills_part(folder, times, robots, nights):
    """Return in how many of some runs with kills the history holds all results, each once."""
    serials = [f'R{k}' for k in range(robots)]
    plants.write_plant(folder, serials, nights, 30)
    whole = 0
    for number in range(times):
        history = folder / f'history{number}'
        command = [sys.executable, '-m', 'calib_ros.cli.main', 'fleet', str(folder / 'plant.yaml')]
        command += ['--history', str(history), '--workers', '2', '--quiet']
        killed = with_kills(command, history, robots * nights, number)
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        rows = [row for serial in serials for row in History(history).rows(serial)]
        once = len({row.key for row in rows}) == len({row.source for row in rows}) == len(rows)
        whole += killed and once and len(rows) == robots * nights
    return {'kills': times, 'whole': whole}


def with_kills(command, history, total, number):
    """Run a fleet, kill a worker and then the client; return whether work was left."""
    first, second = np.sort(np.random.default_rng(number).integers(1, total - 3, 2))

    def filed():
        return len(list(history.glob('robot=*/*.parquet')))

    client = subprocess.Popen(command, start_new_session=True)
    until(lambda: filed() >= first or client.poll() is not None)
    children = psutil.Process(client.pid).children(recursive=True)
    workers = [each for each in children if 'spawn_main' in ' '.join(each.cmdline())]
    workers[number % len(workers)].kill()
    until(lambda: filed() >= second or client.poll() is not None)
    client.kill()
    client.wait()
    return filed() < total


def until(predicate):
    """Wait for what other processes do."""
    while not predicate():
        time.sleep(0.02)


def main():
    """Print what was measured."""
    options = bench.options(
        __doc__,
        quick=(False, 'a few robots'),
        json=False,
        part={'choices': ('nights', 'workers', 'scheduler', 'kills')},
        robots=({'type': int}, 'for the nights'),
        workers=(0, 'for the nights'),
        scheduler=('', 'for the nights, from an archive by URL'),
    )
    quick = options.quick
    robots, nights, bumped = (10, 8, 2) if quick else (200, 30, 5)
    parts = {
        'nights': lambda folder: nights_part(
            folder,
            options.robots or robots,
            nights,
            bumped,
            Cluster(options.scheduler, options.workers),
        ),
        'workers': lambda folder: workers_part(
            folder, 4 if quick else 12, 25_000, 1 if quick else 3
        ),
        'scheduler': lambda folder: scheduler_part(folder, 200 if quick else 1000),
        'kills': lambda folder: kills_part(folder, 1 if quick else 10, 3, 6),
    }
    found = {}
    for name, part in parts.items():
        if options.part in (None, name):
            with tempfile.TemporaryDirectory() as folder:
                found[name] = part(Path(folder))
    found = {**found.pop('nights', {}), **found}
    bench.tell(found, options.json)


if __name__ == '__main__':
    main()
