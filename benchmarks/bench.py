# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What benchmarks share. To be imported before numpy: on several threads figures vary."""

import argparse
import json
import os
import sys
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np

DATA = Path(os.environ.get('CALIB_ROS_DATA') or Path(__file__).parents[2] / 'shared' / 'data')
"""Folder of the measured robots."""


def options(words, **known):
    """Return what the command line says: of each `known` option its default, and help if any.

    False stands for a switch, a dict for arguments of `add_argument`.
    """
    parser = argparse.ArgumentParser(description=words.partition('\n')[0])
    for name, given in known.items():
        value, text = given if isinstance(given, tuple) else (given, None)
        how = {'action': 'store_true'} if value is False else {'type': type(value)}
        how = value if isinstance(value, dict) else how | {'default': value}
        parser.add_argument(f'--{name}', help=text, **how)
    return parser.parse_args()


def tell(found, as_json):
    """Print figures by name as JSON, or as lines and tables.

    A row for each name that has several, or for each of a list, by the first of them; rows
    without a common figure are in different tables.
    """
    if as_json:
        print(json.dumps(found, indent=1))
        return
    found = {name: by_first(each) for name, each in found.items()}
    rows = {name: each for name, each in found.items() if isinstance(each, dict)}
    for name, each in found.items():
        lines = each if isinstance(each, list) and each else [each]
        for line in lines if name not in rows else ():
            print(f'{name:40} {cell(line)}')
    inner = {n: row for n, row in rows.items() if any(map(listed, row.values()))}
    table = {}
    for name, row in rows.items():
        if name not in inner:
            if not any(row.keys() & other.keys() for other in table.values()):
                show(table)
                table = {}
            table[name] = row
    show(table)
    for name, row in inner.items():
        print(f'\n{name}')
        tell(row, as_json)


def show(rows):
    """Print rows of figures below the names of their columns."""
    columns = dict.fromkeys(key for row in rows.values() for key in row)
    widths = {each: max(len(each), 9) for each in columns}
    if columns:
        print(f'{"":40} ' + '  '.join(f'{each:>{width}}' for each, width in widths.items()))
    for name, row in rows.items():
        cells = (f'{cell(row.get(each)):>{width}}' for each, width in widths.items())
        print(f'{name:40} ' + '  '.join(cells))


def listed(value):
    """Tell whether a value takes lines of its own."""
    return isinstance(value, dict) or (
        isinstance(value, list) and any(isinstance(each, (tuple, dict)) for each in value)
    )


def problem_of(name, session, chain_name='chain.yaml'):
    """Return the problem of a measured robot, with its held-out rows."""
    from calib_ros.files.tables import read_table
    from calib_ros.kinematics.chain_file import load_chain

    chain = load_chain(DATA / name / chain_name)
    table = read_table(DATA / name / 'uniform.csv', len(chain.joints), (session,))
    return table.problem(chain)


def measured(sets):
    """Return the sets of measured robots that are there: all, or none."""
    if DATA.is_dir():
        return sets
    print(f'no measured robots at {DATA}; set CALIB_ROS_DATA', file=sys.stderr)
    return type(sets)()


def distances(chain, true, joints):
    """Return by how much (N,) [m] the positions of two chains differ at joint values (N, n)."""
    return np.linalg.norm((chain.forward(joints) - true.forward(joints))[:, :3, 3], axis=1)


def rms(values):
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def by_first(value):
    """Return a list of rows by the first figure of each; anything else as it is."""
    if not isinstance(value, list) or not all(isinstance(row, dict) for row in value):
        return value
    rows = ([*row.items()] for row in value)
    return {str(first): dict(rest) for (_, first), *rest in rows}


def within(result, q, error, approach=None):
    """Tell (N,) whether errors (N, 3) of positions are within the 95 % ellipsoids."""
    axes = result.confidence_ellipsoid(q, approach=approach)
    along = np.einsum('nij,nj->ni', axes, error) / (axes**2).sum(axis=2)
    return (along**2).sum(axis=1) <= 1.0


def cell(value):
    """Return a figure, or several, as text."""
    if isinstance(value, (list, tuple)):
        return ', '.join(map(cell, value)) or '-'
    return '-' if value is None else f'{value:.4g}' if isinstance(value, float) else str(value)
