# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How often do the intervals of `calib_ros verify` hold the true RMS error?

    CALIB_ROS_DATA=FOLDER python benchmarks/verification.py [--quick] [--json]

Of an interval of 95 %, each limit may fail in one draw of forty: the share of draws in which the
upper (lower) limit is above (below) the truth should be 0.975 or a little more.

Drawn: errors of Gaussian noise alone, and those that a geometric calibration leaves of arms with
compliance or eccentricities, 5 to 100 at a time, against 20,000 of the same arm (six arms each);
`places`: noise times the size of a normal variable, another one at each place.

Measured robots: 5, 10 and 20 of the held-out poses, drawn at random, against all of them.

Simulated UR10e: an arm with errors is identified from 40 measured poses, corrected, and measured
at the five test poses of ISO 9283 (noise as in the identification), against the true RMS error
over 500 positions in the same cube with the same orientation (`cube`), and over the whole joint
range (`range`), of which five poses in one orientation tell less.
"""

import bench
import numpy as np

from calib_ros.apply.confidence import freedom_of, rms_limits
from calib_ros.apply.design import Design
from calib_ros.apply.iso_9283 import iso_9283_poses
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.apply.verification import verify
from calib_ros.decision.residuals import residuals
from calib_ros.estimation.problem import Problem
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.identification import identify
from calib_ros.kinematics import inverse
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.se3 import norms

SETS = (
    ('ur10_ipa_leica', 'B'),
    ('ur5_jacobi_lasertracker', 'grid'),
    ('wam7_jacobi_lasertracker', 'grid'),
    ('positioner_2axis_pose', 'all'),
    ('fr3_camera_eyeinhand', 'all'),
)
NOISE = (5e-5, 2e-4)


def shares(found, truth):
    """Return how often the limits of verifications hold."""
    upper = np.mean([each.upper >= truth for each, truth in zip(found, truth, strict=True)])
    lower = np.mean([each.lower <= truth for each, truth in zip(found, truth, strict=True)])
    return {'upper': float(upper), 'lower': float(lower)}


def left_behind(kind, seed):
    """Return errors (20000, 3) [m] of an arm after its geometric calibration."""
    nominal, rng = load_chain('ur10e'), np.random.default_rng(seed)
    joints = nominal.joint_names
    values = {}
    if kind == 'compliance':
        values = {f'{each}.gravity_{joints[-1]}': 1e-3 for each in joints[1:4]}
    elif kind == 'eccentricity':
        values = {
            f'{each}.{wave}': 2e-4 for each in joints for wave in ('sin_1', 'cos_1', 'sin_2')
        }
    values = {each: size * rng.normal() for each, size in values.items()}
    true = faulty(nominal, Cell(), rng).with_effects(list(values)).with_offsets(values)
    seen = measure(true, nominal.random_joints(60, rng), rng, *NOISE)
    result = identify(Problem(nominal, seen, held_out=seen.select(np.arange(1))))
    unseen = nominal.random_joints(20_000, rng)
    return measure(true, unseen, rng, *NOISE).positions - result.chain.forward(unseen)[:, :3, 3]


def drawn(kind, draws):
    """Return how often the limits hold for errors drawn of those that arms have left."""
    rows = {}
    rng = np.random.default_rng(2)
    arms = [left_behind(kind, seed) for seed in range(6)]
    if kind == 'places':
        arms = [rng.normal(size=(20_000, 1)) * each for each in arms]
    for count in (5, 10, 20, 40, 100):
        held = []
        for errors in arms:
            truth = bench.rms(norms(errors))
            for _ in range(draws // len(arms)):
                chosen = errors[rng.integers(0, len(errors), count)]
                moments = chosen[:, :, None] * chosen[:, None]
                freedom = np.array([count * freedom_of(moments)])
                lower, upper = rms_limits(bench.rms(norms(chosen)), freedom, 0.95)
                held.append((upper[0] >= truth, lower[0] <= truth))
        upper, lower = np.mean(held, axis=0).tolist()
        rows[f'{count} poses'] = {'upper': upper, 'lower': lower}
    return rows


def measured(name, session, draws):
    """Return how often the limits hold on a measured robot, by the number of poses."""
    problem = bench.problem_of(name, session)
    result = identify(problem)
    arm = Calibration.of(result)
    held_out = problem.judging[0].select(result.validation.deciding)
    _, first = np.unique(held_out.configurations, return_index=True)
    held_out = held_out.select(first)
    truth = bench.rms(norms(residuals(arm.chain, held_out).position))
    rng = np.random.default_rng(0)
    row = {}
    for count in (5, 10, 20):
        found = [
            verify(arm, [held_out.select(rng.permutation(len(held_out))[:count])], truth)
            for _ in range(draws)
        ]
        row[f'{count} poses'] = shares(found, [truth] * draws)
    return row


def simulated(draws):
    """Return how often the limits hold at the test poses of ISO 9283."""
    nominal = load_chain('ur10e')
    rng = np.random.default_rng(1)
    found, in_cube, in_range = [], [], []
    for seed in range(draws):
        true = faulty(nominal, Cell(), rng)
        seen = measure(true, nominal.random_joints(40, rng), rng, *NOISE)
        problem = Problem(nominal, seen, held_out=seen.select(np.arange(1)))
        result = identify(problem)
        design = Design.of(problem, result)
        tests = iso_9283_poses(design, np.random.default_rng(seed))
        found.append(
            verify(Calibration.of(result), [measure(true, tests.joints, rng, *NOISE)], 1e-4)
        )
        poses = np.repeat(design.targets(tests.joints[:1]), 500, axis=0)
        turn = result.chain.base.matrix[:3, :3]
        poses[:, :3, 3] += rng.uniform(-0.4, 0.4, (500, 3)) * tests.edge @ turn.T
        cube = inverse.solve(result.chain, poses, np.repeat(tests.joints[:1], 500, axis=0))
        for truths, joints in (
            (in_cube, cube.joints[cube.converged]),
            (in_range, nominal.random_joints(500, rng)),
        ):
            error = measure(true, joints, rng, *NOISE).positions
            error -= result.chain.forward(joints)[:, :3, 3]
            truths.append(bench.rms(norms(error)))
    return {'cube': shares(found, in_cube), 'range': shares(found, in_range)}


def main():
    """Run everything and print the table."""
    options = bench.options(__doc__, quick=(False, 'fewer draws'), json=False)
    table = {'UR10e, simulated, ISO 9283': simulated(10 if options.quick else 60)}
    for kind in ('noise', 'compliance', 'eccentricity', 'places'):
        table[f'drawn, {kind}'] = drawn(kind, 600 if options.quick else 12_000)
    for name, session in bench.measured(SETS):
        table[f'{name}/{session}'] = measured(name, session, 100 if options.quick else 1000)
    bench.tell(table, options.json)


if __name__ == '__main__':
    main()
