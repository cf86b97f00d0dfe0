# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How gross errors of the measurement harm the result, by default settings.

    python benchmarks/outliers.py [--seeds 20] [--json]

A UR10e with errors of 0.5 mm and 1 mrad, 60 full poses, noise of 0.05 mm and 0.2 mrad; mean
position error on 300 other poses (median over seeds), and the RMS error against that of the same
poses without gross errors (median and worst). Gross errors are scattered, or agree with each
other: all have one displacement (and, by full pose, one turn of up to 30 mrad about each axis) in
the world, as from a tracker that was moved, or in the tool's frame, as from a target that was
bumped.
"""

from dataclasses import replace

import bench
import numpy as np

from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.identification.identification import identify
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import load_chain

POSES, UNSEEN = 60, 300
SCATTERED, WORLD, TOOL = 'scattered', 'world', 'tool'
CASES = {
    'clean': (0, 0.0, 0.0, SCATTERED, True),
    '3 of 20 mm': (3, 20e-3, 20e-3, SCATTERED, True),
    '6 of 2 mm': (6, 2e-3, 2e-3, SCATTERED, True),
    '10 % of 5-50 mm': (6, 5e-3, 50e-3, SCATTERED, True),
    '30 % of 5-50 mm': (18, 5e-3, 50e-3, SCATTERED, True),
    '30 % agree, world': (18, 5e-3, 50e-3, WORLD, True),
    '30 % agree, tool': (18, 5e-3, 50e-3, TOOL, True),
    '40 % agree, tool': (24, 5e-3, 50e-3, TOOL, True),
    'positions only: clean': (0, 0.0, 0.0, SCATTERED, False),
    '  30 % of 5-50 mm': (18, 5e-3, 50e-3, SCATTERED, False),
    '  30 % agree, world': (18, 5e-3, 50e-3, WORLD, False),
    '  30 % agree, tool': (18, 5e-3, 50e-3, TOOL, False),
    '  40 % agree, tool': (24, 5e-3, 50e-3, TOOL, False),
}
"""Gross errors: number, smallest and largest [m], how they agree; whether the pose is full."""


def spoiled(observations, flanges, rng, count, low, high, kind):
    """Return the observations with gross errors, and which they are."""
    index = rng.choice(len(observations), count, replace=False)
    number = count if kind == SCATTERED else 1
    direction = rng.normal(size=(number, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    shift = direction * rng.uniform(low, high, (number, 1))
    positions, rotations = observations.positions.copy(), observations.rotations.copy()
    turn = np.eye(3)
    if kind != SCATTERED and observations.oriented.all():
        turn = se3.exp_rotation(rng.uniform(-0.03, 0.03, (1, 3)))[0]
    if kind == TOOL:
        positions[index] += flanges[index] @ shift[0]
        rotations[index] = rotations[index] @ turn
    else:
        positions[index] += shift
        rotations[index] = turn @ rotations[index]
    return replace(observations, positions=positions, rotations=rotations), set(index.tolist())


def main():
    """Run all cases and print them."""
    options = bench.options(__doc__, seeds=20, json=False)
    nominal = load_chain('ur10e')
    found = {name: {'mean': [], 'ratio': [], 'plain': []} for name in CASES}
    named = {name: [0, 0, 0, 0] for name in CASES}  # hits, gross errors, false alarms, good ones
    for seed in range(options.seeds):
        rng = np.random.default_rng(seed)
        true = faulty(nominal, Cell(), rng)
        q = nominal.random_joints(POSES, rng)
        poses = measure(true, q, rng, 5e-5, 2e-4)
        flanges = true.forward(q)[:, :3, :3]
        unseen = nominal.random_joints(UNSEEN, rng)
        for name, (count, low, high, kind, oriented) in CASES.items():
            clean = poses
            if not oriented:
                clean = Observations.from_arrays(q, poses.positions)
            seen, wrong = spoiled(clean, flanges, rng, count, low, high, kind)
            result = identify(Problem(nominal, seen))
            error = bench.distances(result.chain, true, unseen)
            good = clean.select(np.array([k not in wrong for k in range(POSES)]))
            best, plain = (
                bench.distances(identify(Problem(nominal, each, loss='none')).chain, true, unseen)
                for each in (good, seen)
            )
            found[name]['mean'].append(1e3 * float(error.mean()))
            found[name]['ratio'].append(bench.rms(error) / bench.rms(best))
            found[name]['plain'].append(1e3 * float(plain.mean()))
            outliers = {outlier.sample for outlier in result.outliers}
            counts = [len(outliers & wrong), count, len(outliers - wrong), POSES - count]
            named[name] = [a + b for a, b in zip(named[name], counts, strict=True)]
    table = {
        name: {
            'mean_mm': float(np.median(found[name]['mean'])),
            'plain_least_squares_mean_mm': float(np.median(found[name]['plain'])),
            'rms_over_fit_without_outliers': float(np.median(found[name]['ratio'])),
            'worst_of_seeds': float(np.max(found[name]['ratio'])),
            'named': hits / count if count else None,
            'false_alarms': false / rest,
        }
        for name, (hits, count, false, rest) in named.items()
    }
    bench.tell(table, options.json)


if __name__ == '__main__':
    main()
