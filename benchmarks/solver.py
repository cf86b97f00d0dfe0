# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Time one identification of full poses against scipy with the same analytic Jacobian.

    python benchmarks/solver.py [--poses 5000] [--repeat 7] [--json]

Both fit the 30 parameters of a 6R arm from the same start to convergence, in one process and
alternately. Ours is the whole of `identify`: starting values for the frames, rank, robust fit,
covariance, residuals; once with held-out poses to judge on, once with cross-validation (six fits).
scipy gets the frames and the independent parameters for free, and fits once.
"""

import argparse
import json
import os
import statistics
import time
from dataclasses import replace

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np
from scipy.optimize import least_squares

from calib_ros.config import load_chain
from calib_ros.differential import ErrorModel
from calib_ros.identification import Problem, identify, residuals
from calib_ros.simulation import Cell, faulty, measure


def with_scipy(start, names, observations, sigmas):
    """Fit with scipy's least squares; the Jacobian is that of our error model."""
    weights = 1.0 / np.repeat(sigmas, 3)

    def chain_at(x):
        return start.with_offsets(dict(zip(names, x, strict=True)))

    def residual(x):
        left = residuals(chain_at(x), observations)
        return (np.hstack([left.position, left.orientation]) * weights).ravel()

    def jacobian(x):
        columns = ErrorModel(chain_at(x), names).jacobian(observations.joints)
        return (-columns * weights[:, np.newaxis]).reshape(-1, len(names))

    solution = least_squares(residual, np.zeros(len(names)), jac=jacobian, x_scale='jac')
    return chain_at(solution.x)


def main():
    """Run the comparison and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--poses', type=int, default=5000)
    parser.add_argument('--repeat', type=int, default=7)
    parser.add_argument('--json', action='store_true')
    options = parser.parse_args()

    rng = np.random.default_rng(0)
    nominal = load_chain('ur10e')
    true = faulty(nominal, Cell(), rng)
    observations = measure(true, nominal.random_joints(options.poses, rng), rng, 5e-5, 2e-4)
    unseen = measure(true, nominal.random_joints(300, rng), rng)
    problem = Problem(nominal, observations, held_out=unseen)
    known = identify(problem)

    def ours():
        return identify(problem).chain

    def ours_validated():
        return identify(replace(problem, held_out=None)).chain

    def theirs():
        sigmas = [problem.sigma_position, problem.sigma_orientation]
        return with_scipy(known.before, known.names, observations, sigmas)

    solvers = {'calib_ros': ours, 'cross-validated': ours_validated, 'scipy': theirs}
    seconds = {name: [] for name in solvers}
    error_um = {}
    for _ in range(options.repeat):
        for name, solve in solvers.items():
            begin = time.perf_counter()
            chain = solve()
            seconds[name].append(time.perf_counter() - begin)
            error = np.linalg.norm(residuals(chain, unseen).position, axis=1)
            error_um[name] = 1e6 * float(np.sqrt(np.mean(error**2)))
    median = {name: statistics.median(times) for name, times in seconds.items()}
    found = {
        'poses': options.poses,
        'median_ms': {name: 1e3 * value for name, value in median.items()},
        'held_out_rms_um': error_um,
        'ratio': median['scipy'] / median['calib_ros'],
        'ratio_cross_validated': median['scipy'] / median['cross-validated'],
    }
    if options.json:
        print(json.dumps(found, indent=2))
        return
    for name, value in median.items():
        print(f'{name:15} {1e3 * value:8.1f} ms   held-out RMS {error_um[name]:.2f} um')
    print(
        f'{found["ratio"]:.1f} x faster than scipy at {options.poses} poses, '
        f'{found["ratio_cross_validated"]:.1f} x with cross-validation'
    )


if __name__ == '__main__':
    main()
