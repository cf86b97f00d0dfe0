# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How long a table of measurements takes to read, beside numpy.loadtxt of the same rows.

    python benchmarks/tables.py [--rows 500000] [--json]

CPU time of this process, the best of some runs. `loadtxt` makes one array of the columns of
numbers and looks at nothing else; `read_table` makes observations of it: sets by session, device,
target and split, rotations of quaternions, every number within its limits. `foreign` is the same
table in millimetres and degrees with decimal commas.
"""

import tempfile
from pathlib import Path

import bench
import numpy as np
from peers import cpu

from calib_ros.files.foreign import Foreign
from calib_ros.files.layouts import Layout
from calib_ros.files.tables import read_table

JOINTS = 6
RUNS = 3


def tables_of(folder, rows):
    """Write tables of so many rows; return their paths and columns of numbers by name."""
    rng = np.random.default_rng(0)
    joints, positions = rng.uniform(-3.0, 3.0, (rows, JOINTS)), rng.uniform(-2.0, 2.0, (rows, 3))
    quat = rng.normal(size=(rows, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    names = [f'q{k + 1}' for k in range(JOINTS)]
    kinds = {
        'position': ([*names, 'x', 'y', 'z'], np.hstack([joints, positions]), ',', '%.9f'),
        'pose': (
            [*names, 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'],
            np.hstack([joints, positions, quat]),
            ',',
            '%.9f',
        ),
        'foreign': (
            [*names, 'x', 'y', 'z'],
            np.hstack([np.degrees(joints), 1e3 * positions]),
            ';',
            '%.6f',
        ),
    }
    for kind, (header, values, separator, form) in kinds.items():
        path = folder / f'{kind}.csv'
        with path.open('w') as file:
            file.write(separator.join(['id', 'split', *header]) + '\n')
            for k in range(0, rows, 10_000):
                part = values[k : k + 10_000].tolist()
                line = separator.join(['%d', 'train', *[form] * len(header)])
                lines = [line % (k + i, *row) for i, row in enumerate(part)]
                text = '\n'.join(lines) + '\n'
                file.write(text.replace('.', ',') if separator == ';' else text)
        yield kind, path, range(2, 2 + len(header))


def main():
    """Print a line for each kind of table."""
    options = bench.options(__doc__, rows=500_000, json=False)
    foreign = Foreign(Layout(length='mm', angle='deg', separator='semicolon', decimal=','))
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for kind, path, use in tables_of(Path(folder), options.rows):
            how = foreign if kind == 'foreign' else None
            ours = cpu(lambda path=path, how=how: read_table(path, JOINTS, foreign=how), RUNS)
            plain = path
            if kind == 'foreign':
                plain = path.with_name('plain.csv')
                plain.write_text(path.read_text().replace(',', '.').replace(';', ','))
            theirs = cpu(
                lambda plain=plain, use=use: np.loadtxt(
                    plain, delimiter=',', skiprows=1, usecols=use
                ),
                RUNS,
            )
            row = {'table': kind, 'rows': options.rows, 'read_table_s': ours, 'loadtxt_s': theirs}
            found.append(row | {'ratio': ours / theirs})
    bench.tell(found if options.json else {'tables': found}, options.json)


if __name__ == '__main__':
    main()
