# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Is the estimator at the statistical limit, and are its uncertainties honest?

    python benchmarks/monte_carlo.py [--runs 1000] [--quick] [--json]

Simulated UR10e with errors of 0.5 mm and 1 mrad, 40 full poses or 60 positions a run, default
settings. `mse_over_crlb` is the mean squared error of the fitted parameters over the Cramer-Rao
bound at the true chain, averaged over parameters; `coverage_95` the share of 95 % intervals that
hold the truth: of all parameters, of the worst and the best of them (`least`, `most`), and of
predicted positions at poses that were not measured.
`few` has 12 poses, 72 equations for 30 parameters, and sigmas that are half the true ones, so that
the noise is found from the residuals.

`chosen`: 60 full poses with the signs of the last moves, by `--model auto`, of arms with an effect
of up to 0.3 mrad; or with waves that no model has, of half the device's sigma in each coordinate
(`below_noise`). Positions are those of poses from an unknown side, `sided` from a known one; those
`added` with half the sigma added to their covariance.

`incomplete`: arms with an effect that the model lacks, 60 full poses, default sigmas; the coverage
of parameters and of positions, and the median ratio of actual to stated RMS error of positions
over the joint range. `claimed`: share of these arms of which `compare` claims a change after a
second session at other poses; `apart`: after two sessions within 0.6 rad of two postures.
"""

from dataclasses import replace

import bench
import numpy as np
from scipy import special

from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.estimation import uncertainty
from calib_ros.estimation.normal import triangular_factor
from calib_ros.estimation.problem import Problem
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.difference import difference
from calib_ros.identification.identification import identify
from calib_ros.identification.model_choice import identify_model
from calib_ros.kinematics import effects, se3
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.jacobian import ErrorModel

SIGMA_POSITION, SIGMA_ORIENTATION = 5e-5, 2e-4
KINDS = {'pose': (True, 40, 1.0), 'position': (False, 60, 1.0), 'few': (True, 12, 0.5)}
COUNTED = ('parameters', 'sided', 'positions', 'added')
CHOSEN = ('none', 'eccentricity', 'gravity', 'backlash', 'below_noise')
LACKING = ('wobble', 'backlash', 'rocking', 'gear', 'gravity')
SIZE = 3e-4
"""Largest turn [rad] by an effect: position errors of 0.1 to 0.25 mm (RMS)."""


def one_run(nominal, seed, oriented, poses, told):
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
    bound = uncertainty.covariance(triangular_factor(true, result.names, problem.system([seen])))
    deviation, hits = off(result, true)
    unseen = nominal.random_joints(50, rng)
    error = (result.chain.forward(unseen) - true.forward(unseen))[:, :3, 3]
    return deviation**2 / np.diag(bound), hits, bench.within(result, unseen, error)


def off(result, true):
    """Return how far (P,) parameters are from the true ones, and whether within their limits."""
    true = true.with_effects([name for name, _ in result.chain.effects])
    deviation = np.array([result.chain.offset(name, true) for name in result.names])
    width = {p.name: p.half_width() / p.std for p in result.parameters if p.std is not None}
    limit = np.array([width[name] for name in result.names])
    return deviation, np.abs(deviation) <= limit * np.sqrt(np.diag(result.covariance))


def chosen(nominal, kind, seed, poses=60):
    """Return hits of parameters (P,) and of positions (M,): `sided`, from any side, `added`."""
    rng = np.random.default_rng([seed, CHOSEN.index(kind)])
    arm = faulty(nominal, Cell(), rng)
    names = effects.members(arm, kind) if kind in effects.GROUPS else ()
    sizes = SIZE * rng.uniform(-1.0, 1.0, len(names))
    true = arm.with_effect_values(dict(zip(names, sizes.tolist(), strict=True)))
    waves = rng.normal(size=(3, len(true.joints))), rng.uniform(0.0, 6.28, (3, 1))
    half = SIGMA_POSITION * np.sqrt(0.5) * (kind == 'below_noise')

    def unknown(q):
        return half * np.sin(waves[0] @ q.T + waves[1]).T

    q = nominal.random_joints(poses + 1, rng)
    sides = np.sign(np.diff(q, axis=0))
    seen = measure(true, q[1:], rng, SIGMA_POSITION, SIGMA_ORIENTATION, approach=sides)
    seen = replace(seen, positions=seen.positions + unknown(q[1:]), approach=sides)
    result = identify_model(Problem(nominal, seen, held_out=seen.select(np.arange(2))), 'auto')
    places = nominal.random_joints(50, rng)
    sides = rng.choice([-1.0, 1.0], places.shape)
    reached = true.forward(places, sides)[:, :3, 3] + unknown(places)
    found = [off(result, true)[1]]
    for known in (sides, None):
        error = result.chain.forward(places, known)[:, :3, 3] - reached
        found.append(bench.within(result, places, error, known))
    squares = result.pose_covariance(places)[:, :3, :3] + (SIGMA_POSITION / 2) ** 2 * np.eye(3)
    far = np.einsum('nc,ncd,nd->n', error, np.linalg.inv(squares), error)
    return *found, far <= special.chdtri(3, 0.05)


def lacking(kind, true, rng):
    """Return a function of joint values (N, n) and approach: pose errors (N, 6) of an effect."""
    names = true.joint_names
    sizes, phases = SIZE * rng.uniform(0.3, 1.0, len(names)), rng.uniform(0.0, 6.28, len(names))
    if kind == 'gravity':
        torques = effects.members(true, kind)
        own = sizes[[names.index(name.owner) for name in torques]]
        values = dict(zip(torques, (0.3 * own).tolist(), strict=True))
        model = ErrorModel(true.with_effects(torques), torques)
        return lambda q, _: model.jacobian(q) @ [values[name] for name in torques]
    turned = {'wobble': 'alpha'}.get(kind, 'theta')
    model = ErrorModel(true, [f'{name}.{turned}' for name in names])
    if kind == 'rocking':
        model = ErrorModel(true, ['base.rx', 'base.ry', 'base.rz'])

    def errors(q, approach):
        if kind == 'rocking':  # by the moment of the load, with two soft directions
            base = true.base.matrix
            moments = np.cross(base[:3, 2], true.forward(q)[:, :3, 3] - base[:3, 3])
            turns = moments @ (base[:3, :3] * sizes[:3]) @ base[:3, :3].T
        elif kind == 'backlash':
            turns = sizes * approach
        else:
            turns = sizes * np.sin((2 if kind == 'wobble' else 50) * q + phases)
        return np.einsum('nij,nj->ni', model.jacobian(q), turns)

    return errors


def incomplete(nominal, kind, seed, poses=60):
    """Return hits of parameters (P,) and positions (M,), whether changes are claimed, and errors.

    Changes at other poses, and in two regions; RMS errors of positions [m], actual and stated.
    """
    rng = np.random.default_rng([seed, LACKING.index(kind)])
    true = faulty(nominal, Cell(), rng)
    moved = lacking(kind, true, rng)

    def session(middle=None):
        q = nominal.random_joints(poses + 1, rng)
        if middle is not None:
            q = middle + rng.uniform(-0.6, 0.6, q.shape)
        seen = measure(true, q[1:], rng, SIGMA_POSITION, SIGMA_ORIENTATION)
        more = moved(q[1:], np.sign(np.diff(q, axis=0)))
        turned = se3.exp_rotation(more[:, 3:]) @ seen.rotations
        seen = replace(seen, positions=seen.positions + more[:, :3], rotations=turned)
        return identify(Problem(nominal, seen, held_out=seen.select(np.arange(2))))

    result = session()
    claimed = not difference(Calibration.of(result), Calibration.of(session())).same
    unseen = nominal.random_joints(50, rng)
    error = (result.chain.forward(unseen) - true.forward(unseen))[:, :3, 3]
    error -= moved(unseen, rng.choice([-1.0, 1.0], unseen.shape))[:, :3]
    stated = np.trace(result.pose_covariance(unseen)[:, :3, :3], axis1=1, axis2=2).mean()
    actual = np.mean((error**2).sum(axis=1))
    hits = off(result, true)[1], bench.within(result, unseen, error)
    regions = [session(rng.uniform(-2.0, 2.0, len(true.joints))) for _ in range(2)]
    apart = not difference(*map(Calibration.of, regions)).same
    return *hits, claimed, apart, np.sqrt(actual), np.sqrt(stated)


def main():
    """Run both kinds of measurement and print the figures."""
    options = bench.options(__doc__, runs=1000, quick=(False, '500 runs'), json=False)
    runs = 500 if options.quick else options.runs
    nominal = load_chain('ur10e')
    found = {'runs': runs, 'coverage_95': {}, 'chosen': {}, 'incomplete': {}}
    for kind, setting in KINDS.items():
        rows = [one_run(nominal, seed, *setting) for seed in range(runs)]
        ratios, hits, positions = (np.array(column) for column in zip(*rows, strict=True))
        single = hits.mean(axis=0)
        found['coverage_95'][kind] = {
            'mse_over_crlb': float(ratios.mean()),
            'parameters': float(hits.mean()),
            'least': float(single.min()),
            'most': float(single.max()),
            'positions': float(positions.mean()),
        }
    for kind in CHOSEN:
        rows = [map(np.mean, chosen(nominal, kind, seed)) for seed in range(runs // 5)]
        means = np.array([[*row] for row in rows]).mean(axis=0).tolist()
        found['chosen'][kind] = dict(zip(COUNTED, means, strict=True))
    for kind in LACKING:
        rows = [incomplete(nominal, kind, seed) for seed in range(runs // 10)]
        hits, places, claimed, apart, actual, stated = map(np.array, zip(*rows, strict=True))
        found['incomplete'][kind] = {
            'parameters': float(hits.mean()),
            'positions': float(places.mean()),
            'claimed': float(claimed.mean()),
            'apart': float(apart.mean()),
            'ratio': float(np.median(actual / stated)),
        }
    bench.tell(found, options.json)


if __name__ == '__main__':
    main()
