# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Is the estimator at the statistical limit, and are its uncertainties honest?

    python benchmarks/monte_carlo.py [--runs 1000] [--quick] [--json]

Simulated UR10e with errors of 0.5 mm and 1 mrad, 40 full poses or 60 positions a run, default
settings. `mse_over_crlb` is the mean squared error of the fitted parameters over the Cramer-Rao
bound at the true chain, averaged over parameters; `coverage_95` the share of 95 % intervals that
hold the truth: per parameter, and for predicted positions at poses that were not measured.
`few_unknown_noise` has 12 poses, 72 equations for 30 parameters, and sigmas that are half the true
ones, so that the noise is found from the residuals.
"""

import argparse
import json
import os

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np

from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.estimation import identifiability
from calib_ros.estimation.leastsquares import triangular_factor
from calib_ros.estimation.problem import Problem
from calib_ros.identification.identification import identify
from calib_ros.kinematics.chain_file import load_chain

SIGMA_POSITION, SIGMA_ORIENTATION = 5e-5, 2e-4
KINDS = {'pose': (True, 40), 'position': (False, 60)}
FEW = (True, 12, 0.5)


def one_run(nominal, seed, oriented, poses, told=1.0):
    """Return squared deviation / bound (P,), hits per parameter (P,), hits of positions (M,)."""
    rng = np.random.default_rng(seed)
    true = faulty(nominal, Cell(), rng)
    joints = nominal.random_joints(poses, rng)
    seen = measure(true, joints, rng, SIGMA_POSITION, SIGMA_ORIENTATION, oriented)
    problem = Problem(
        nominal,
        seen,
        held_out=seen.select(np.arange(2)),  # the verdict is not asked for
        sigma_position=told * SIGMA_POSITION,
        sigma_orientation=told * SIGMA_ORIENTATION,
    )
    result = identify(problem)
    bound = identifiability.covariance(
        triangular_factor(true, result.names, problem.system([seen]))
    )
    deviation = np.array([result.chain.offset(name, true) for name in result.names])
    width = {p.name: p.half_width() / p.std for p in result.parameters if p.std is not None}
    limit = np.array([width[name] for name in result.names])
    hits = np.abs(deviation) <= limit * np.sqrt(np.diag(result.covariance))
    unseen = nominal.random_joints(50, rng)
    error = (result.chain.forward(unseen) - true.forward(unseen))[:, :3, 3]
    axes = result.confidence_ellipsoid(unseen)
    along = np.einsum('nij,nj->ni', axes, error) / (axes**2).sum(axis=2)
    return deviation**2 / np.diag(bound), hits, (along**2).sum(axis=1) <= 1.0


def main():
    """Run both kinds of measurement and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--runs', type=int, default=1000)
    parser.add_argument('--quick', action='store_true', help='500 runs')
    parser.add_argument('--json', action='store_true')
    options = parser.parse_args()
    runs = 500 if options.quick else options.runs
    nominal = load_chain('ur10e')
    found = {'runs': runs, 'mse_over_crlb': {}, 'coverage_95': {}}
    found['coverage_of_single_parameters'] = {}
    for kind, (oriented, poses) in KINDS.items():
        rows = [one_run(nominal, seed, oriented, poses) for seed in range(runs)]
        ratios, hits, positions = (np.array(column) for column in zip(*rows, strict=True))
        found['mse_over_crlb'][kind] = float(ratios.mean())
        found['coverage_95'][kind] = {
            'parameters': float(hits.mean()),
            'positions': float(positions.mean()),
        }
        single = hits.mean(axis=0)
        found['coverage_of_single_parameters'][kind] = [float(single.min()), float(single.max())]
    rows = [one_run(nominal, seed, *FEW) for seed in range(runs // 2)]
    _, hits, positions = (np.array(column) for column in zip(*rows, strict=True))
    found['few_unknown_noise'] = {
        'runs': len(rows),
        'parameters': float(hits.mean()),
        'positions': float(positions.mean()),
    }
    if options.json:
        print(json.dumps(found, indent=2))
        return
    for kind in KINDS:
        coverage = ', '.join(f'{k} {100 * v:.1f} %' for k, v in found['coverage_95'][kind].items())
        print(f'{kind:9} MSE / CRLB {found["mse_over_crlb"][kind]:.3f}; 95 % coverage: {coverage}')
    few = found['few_unknown_noise']
    print(f'few, noise unknown: coverage {few["parameters"]:.3f}, {few["positions"]:.3f}')


if __name__ == '__main__':
    main()
