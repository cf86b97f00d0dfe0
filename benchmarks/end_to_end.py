# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How long it takes from a file to a result, beside the bare fit of the same rows.

    python benchmarks/end_to_end.py [--quick] [--json]

CPU time of this process, without imports. The bare fit is one damped Gauss-Newton of the
parameters that can be identified, from frames that are known; nothing is judged. The cases: a
table of positions (500,000 rows, --quick 50,000), a bag of stops (11,911, 1,000), `--model auto`
(9,528 poses, 1,000), `identify` of 500 poses in memory, and the demo.
"""

import contextlib
import io
import tempfile
from pathlib import Path

import bench
import numpy as np
from peers import cpu, machine

from calib_ros import Problem, identify, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.cli.main import main as calib_ros
from calib_ros.estimation.leastsquares import minimise
from calib_ros.files.programs import csv_of
from calib_ros.files.recording import Recording, write_bag
from calib_ros.kinematics.se3 import to_quat

CHAIN = load_chain('ur10')
NOISE = 1e-4


def measurements(count, oriented=True):
    """Return what a device measures of an arm with errors, the same for each count."""
    rng = np.random.default_rng(0)
    true = faulty(CHAIN, Cell(), rng)
    joints = CHAIN.random_joints(count, rng)
    return measure(true, joints, rng, NOISE, NOISE, oriented)


def bare_fit(observations):
    """Return a function that fits and does nothing else, from known frames and parameters."""
    known = identify(Problem(CHAIN, observations.select(np.arange(min(500, len(observations))))))
    problem = Problem(CHAIN, observations)
    system = problem.system(problem.sets)
    return lambda: minimise(known.before, known.names, system)


def table_of(observations, path):
    """Write a table."""
    columns = [f'q{k + 1}' for k in range(6)] + ['x', 'y', 'z']
    values = [observations.joints, observations.positions]
    if observations.oriented.all():
        columns += ['qx', 'qy', 'qz', 'qw']
        values.append(to_quat(observations.rotations))
    path.write_text(csv_of(columns, np.hstack(values)))


def command(*arguments):
    """Run the command line without its words."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        calib_ros([str(each) for each in arguments])


def cases(folder, quick):
    """Yield the name of each case, what to run, the rows that are fitted, and how often."""
    rows, stops, poses = (50_000, 1000, 1000) if quick else (500_000, 11_911, 9528)
    chain = ('--chain', 'ur10')
    found = measurements(rows, oriented=False)
    table_of(found, folder / 'table.csv')
    table = ('identify', folder / 'table.csv', *chain)
    yield f'table, {rows} rows', lambda: command(*table), found, 1
    found = measurements(stops)
    recording = Recording.of_dwells(CHAIN.joint_names, found, np.zeros(stops, bool))
    write_bag(folder / 'bag', recording)
    yield f'bag, {stops} stops', lambda: command('identify', folder / 'bag', *chain), found, 1
    found = measurements(poses)
    table_of(found, folder / 'auto.csv')
    auto = ('identify', folder / 'auto.csv', *chain, '--model', 'auto')
    yield f'auto, {poses} poses', lambda: command(*auto), found, 1
    found = measurements(500)
    yield 'identify, 500 poses', lambda: identify(Problem(CHAIN, found)), found, 5
    demo = ('demo', '--out', folder / 'demo', '--force')
    yield 'demo', lambda: command(*demo), measurements(60), 1


def main():
    """Measure all cases and print."""
    options = bench.options(__doc__, quick=False, json=False)
    figures = []
    with tempfile.TemporaryDirectory() as name:
        command('demo', '--out', Path(name) / 'imports', '--force')
        for what, run, observations, times in cases(Path(name), options.quick):
            ours, bare = cpu(run, times), cpu(bare_fit(observations), 3)
            figures.append({'case': what, 'cpu_s': ours, 'bare_fit_s': bare, 'ratio': ours / bare})
    bench.tell({'machine': machine(), 'figures': figures}, options.json)


if __name__ == '__main__':
    main()
