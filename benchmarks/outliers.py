# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How gross errors of the measurement harm the result, by default settings.

    python benchmarks/outliers.py [--seeds 20] [--json]

A UR10e with errors of 0.5 mm and 1 mrad, 60 full poses, noise of 0.05 mm and 0.2 mrad; mean
position error on 300 other poses (median over seeds), and for 10 % and 30 % gross errors of 5 to
50 mm the RMS error against that of the same poses without gross errors.
"""

import argparse
import json
import os
from dataclasses import replace

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np

from calib_ros.config import load_chain
from calib_ros.identification import Problem, identify
from calib_ros.simulation import Cell, faulty, measure

POSES, UNSEEN = 60, 300
CASES = {
    'clean': (0, 0.0, 0.0),
    '3 of 20 mm': (3, 20e-3, 20e-3),
    '6 of 2 mm': (6, 2e-3, 2e-3),
    '10 % of 5-50 mm': (6, 5e-3, 50e-3),
    '30 % of 5-50 mm': (18, 5e-3, 50e-3),
}


def spoiled(observations, rng, count, low, high):
    """Return the observations with gross errors, and which they are."""
    index = rng.choice(len(observations), count, replace=False)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    positions = observations.positions.copy()
    positions[index] += direction * rng.uniform(low, high, (count, 1))
    return replace(observations, positions=positions), set(index.tolist())


def main():
    """Run all cases and print them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seeds', type=int, default=20)
    parser.add_argument('--json', action='store_true')
    options = parser.parse_args()
    nominal = load_chain('ur10e')
    found = {name: {'mean': [], 'ratio': [], 'plain': []} for name in CASES}
    named = {name: [0, 0, 0, 0] for name in CASES}  # hits, gross errors, false alarms, good ones
    for seed in range(options.seeds):
        rng = np.random.default_rng(seed)
        true = faulty(nominal, Cell(), rng)
        clean = measure(true, nominal.random_joints(POSES, rng), rng, 5e-5, 2e-4)
        unseen = nominal.random_joints(UNSEEN, rng)
        truth = true.forward(unseen)[:, :3, 3]
        for name, (count, low, high) in CASES.items():
            poses, wrong = spoiled(clean, rng, count, low, high)
            result = identify(Problem(nominal, poses))
            error = np.linalg.norm(result.chain.forward(unseen)[:, :3, 3] - truth, axis=1)
            good = clean.select(np.array([k not in wrong for k in range(POSES)]))
            best = identify(Problem(nominal, good, loss='none')).chain.forward(unseen)[:, :3, 3]
            best = np.linalg.norm(best - truth, axis=1)
            plain = identify(Problem(nominal, poses, loss='none')).chain.forward(unseen)
            found[name]['mean'].append(1e3 * float(error.mean()))
            found[name]['ratio'].append(float(np.sqrt(np.mean(error**2) / np.mean(best**2))))
            plain = np.linalg.norm(plain[:, :3, 3] - truth, axis=1)
            found[name]['plain'].append(1e3 * float(plain.mean()))
            outliers = {outlier.sample for outlier in result.outliers}
            counts = [len(outliers & wrong), count, len(outliers - wrong), POSES - count]
            named[name] = [a + b for a, b in zip(named[name], counts, strict=True)]
    table = {
        name: {
            'mean_mm': float(np.median(found[name]['mean'])),
            'plain_least_squares_mean_mm': float(np.median(found[name]['plain'])),
            'rms_over_fit_without_outliers': float(np.median(found[name]['ratio'])),
            'named': hits / count if count else None,
            'false_alarms': false / rest,
        }
        for name, (hits, count, false, rest) in named.items()
    }
    if options.json:
        print(json.dumps(table, indent=2))
        return
    print('gross errors        mean [mm]   plain LSQ   RMS / without   named   false alarms')
    for name, row in table.items():
        share = '-' if row['named'] is None else f'{100 * row["named"]:.1f} %'
        print(
            f'{name:18} {row["mean_mm"]:10.4f} {row["plain_least_squares_mean_mm"]:11.3f}'
            f' {row["rms_over_fit_without_outliers"]:15.3f} {share:>7}'
            f' {100 * row["false_alarms"]:11.2f} %'
        )


if __name__ == '__main__':
    main()
