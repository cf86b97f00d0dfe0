# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How many digits of a step does the normal matrix lose, bare and scaled, and how many does QR?

    python benchmarks/digits.py [--json]

The Gauss-Newton step from 200 simulated poses of a UR10e (noise 0.05 mm, 0.2 mrad), from one row
to the next less favourable ones. The truth is the same step in exact integers. Digits are those
of the whole step x, -log10(|D (x - truth)| / |D truth|), with D the lengths of the columns of the
Jacobian; a double holds 15.7.

    bare     Cholesky factor of the normal matrix as it is
    scaled   what the fit does: columns of unit length first
    QR       triangular factor of the Jacobian itself
"""

from dataclasses import replace
from fractions import Fraction

import bench
import numpy as np
from scipy import linalg

from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.estimation.identifiability import independent
from calib_ros.estimation.normal import triangular_factor
from calib_ros.estimation.samples import Samples
from calib_ros.estimation.system import System, stacked
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import load_chain

NOISE = (5e-5, 2e-4)


def exact_step(columns, residual):
    """Return the least squares solution (P,) by integers; nothing is rounded before the end."""
    mantissa, exponent = np.frexp(np.column_stack([columns, residual]))
    whole = np.ldexp(mantissa, 53).astype(np.int64).astype(object)
    whole = whole << (exponent - exponent.min()).astype(object)
    rows = (whole.T @ whole)[:-1].tolist()
    before = 1  # elimination that divides without remainder (Bareiss 1968)
    for k, pivot in enumerate(rows):
        for i, row in enumerate(rows):
            if i != k:
                rows[i] = [
                    (a * pivot[k] - row[k] * b) // before for a, b in zip(row, pivot, strict=True)
                ]
        before = pivot[k]
    return np.array([float(Fraction(row[-1], row[k])) for k, row in enumerate(rows)])


def by_normal_matrix(columns, residual):
    """Return the step by the normal matrix; NaN where it is not positive definite any more."""
    try:
        factor = linalg.cho_factor(columns.T @ columns)
    except linalg.LinAlgError:
        return np.full(columns.shape[1], np.nan)
    return linalg.cho_solve(factor, columns.T @ residual)


def by_qr(columns, residual):
    """Return the step by a triangular factor."""
    basis, factor = linalg.qr(columns, mode='economic')
    return linalg.solve_triangular(factor, basis.T @ residual)


def digits(chain, joints, rng):
    """Return condition numbers, and the digits of each way."""
    seen = measure(chain, joints, rng, *NOISE)
    samples = Samples(seen, *NOISE)
    system = System((samples,))
    names = chain.parameter_names
    names = independent(triangular_factor(chain, names, system), names)
    rows = stacked(system.rows_of(chain, names))
    columns, residual = rows[:, :-1], rows[:, -1]
    truth = exact_step(columns, residual)
    scale = np.linalg.norm(columns, axis=0)
    steps = {
        'bare': by_normal_matrix(columns, residual),
        'scaled': by_normal_matrix(columns / scale, residual) / scale,
        'QR': by_qr(columns, residual),
    }
    wrong = {
        name: np.linalg.norm(scale * (step - truth)) / np.linalg.norm(scale * truth)
        for name, step in steps.items()
    }
    return {
        'parameters': len(names),
        'condition': float(np.linalg.cond(columns)),
        'condition, scaled': float(np.linalg.cond(columns / scale)),
        'digits': {
            name: max(0.0, -float(np.log10(np.maximum(error, 1e-17)))) if error < 1.0 else 0.0
            for name, error in wrong.items()
        },
    }


def main():
    """Measure and print."""
    options = bench.options(__doc__, json=False)
    rng = np.random.default_rng(0)
    nominal = load_chain('ur10e')
    nominal = replace(nominal, base=Frame(), tool=Frame())
    arm = faulty(nominal, Cell(), rng)
    posture = np.array([0.3, -1.2, 1.5, -0.8, -1.1, 0.4])
    tilted = replace(arm, parallel=())

    def near(reach):
        return posture + rng.uniform(-reach, reach, (200, 6))

    figures = {
        'the whole joint range': digits(arm, nominal.random_joints(200, rng), rng),
        'within 0.3 rad': digits(arm, near(0.3), rng),
        'within 0.05 rad': digits(arm, near(0.05), rng),
        'd instead of beta': digits(tilted, nominal.random_joints(200, rng), rng),
        'd instead of beta, 0.3 rad': digits(tilted, near(0.3), rng),
    }
    bench.tell(figures, options.json)


if __name__ == '__main__':
    main()
