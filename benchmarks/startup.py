# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Time the command line from its start to its end, imports included.

    python benchmarks/startup.py [--repeat 7] [--quick] [--json]

`--help`, and the identification of a simulated bag of 60 poses (7,500 messages) with
cross-validation. The shortest times of several.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import bench
from peers import machine


def spent(times, *arguments):
    """Return the shortest wall and CPU time [s] of the command line."""
    found = []
    for _ in range(times):
        begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, '-m', 'calib_ros.cli.main', *map(str, arguments)]
        subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        found.append((time.perf_counter() - begin, cpu))
    return {'wall_s': min(wall for wall, _ in found), 'cpu_s': min(cpu for _, cpu in found)}


def main():
    """Measure and print."""
    options = bench.options(__doc__, repeat=7, quick=False, json=False)
    times = 2 if options.quick else options.repeat
    os.environ['PYTHONPATH'] = str(Path(__file__).parents[1])
    with tempfile.TemporaryDirectory() as name:
        bag = Path(name) / 'bag'
        spent(1, 'simulate', bag, '--chain', 'ur10e', '--poses', 60)
        figures = {
            '--help': spent(times, '--help'),
            'identify, 60 poses': spent(times, 'identify', bag, '--chain', 'ur10e'),
        }
    bench.tell({'machine': machine(), 'figures': figures}, options.json)


if __name__ == '__main__':
    main()
