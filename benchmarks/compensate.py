# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How near to the wanted poses does a compensated program come, and how fast is it compensated?

    python benchmarks/compensate.py [--poses 10000] [--quick] [--json]

Simulated UR10e with errors of 1 mm and 1 mrad, and a program of poses at least 0.1 rad from the
limits of the joints and away from singularities (smallest singular value of the flange's Jacobian
[m, rad] above 0.05; both leave 65 % of random configurations, of all of which `refused_of_random`
tells). Judged with the true arm by forward kinematics alone.

- true model: the calibrated chain is the true one; what remains is the solver's.
- identified model: the calibration comes from 60 poses measured with noise of 0.05 mm and
  0.2 mrad; wanted are poses in the measured world, in the calibration's base and tool frames. The
  floor is what that calibration predicts wrongly at these poses. `before` is the nominal arm with
  its own fitted frames.
- speed: scipy's `root` and `least_squares` solve pose by pose for a part of the program, from the
  same start, with the same forward kinematics and an analytic Jacobian, alternating with ours.
"""

import statistics
import time
from dataclasses import replace

import bench
import numpy as np
from scipy.optimize import least_squares, root

from calib_ros.apply.compensation import compensate
from calib_ros.apply.compensator import Compensator
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.estimation.problem import Problem
from calib_ros.identification.identification import identify
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.jacobian import ErrorModel

NOISE = (5e-5, 2e-4)
MARGIN, LEAST_SINGULAR_VALUE = 0.1, 0.05


def bare(chain):
    """Return the arm without its base and tool frames."""
    return replace(chain, base=Frame(), tool=Frame())


def jacobian_of(chain):
    """Return a function of joint values (N, 6) that gives the Jacobian (N, 6, 6)."""
    model = ErrorModel(bare(chain), [f'{joint.name}.theta' for joint in chain.joints])
    signs = np.array([joint.sign for joint in chain.joints])
    return lambda q: model.jacobian(q) * signs


def program(chain, count, rng):
    """Return configurations (count, 6) as described above."""
    kept = np.zeros((0, len(chain.joints)))
    limits = np.array([[joint.lower, joint.upper] for joint in chain.joints])
    while len(kept) < count:
        q = chain.random_joints(count, rng)
        inside = ((q > limits[:, 0] + MARGIN) & (q < limits[:, 1] - MARGIN)).all(axis=1)
        values = np.linalg.svd(jacobian_of(chain)(q), compute_uv=False)[:, -1]
        kept = np.concatenate([kept, q[inside & (values > LEAST_SINGULAR_VALUE)]])
    return kept[:count]


def figures(reached, wanted):
    """Return the largest and the RMS error of poses (N, 4, 4) in um and urad."""
    position = 1e6 * np.linalg.norm((reached - wanted)[:, :3, 3], axis=1)
    turn = se3.log_rotation(reached[:, :3, :3] @ np.swapaxes(wanted[:, :3, :3], 1, 2))
    angle = 1e6 * np.linalg.norm(turn, axis=1)
    return {
        'max_um': float(position.max()),
        'rms_um': float(np.sqrt(np.mean(position**2))),
        'max_urad': float(angle.max()),
        'rms_urad': float(np.sqrt(np.mean(angle**2))),
    }


def pose_by_pose(solver, nominal, true, commands):
    """Return joint values (N, 6) that scipy finds, one pose after the other."""
    arm, jacobian = bare(true), jacobian_of(true)
    wanted = bare(nominal).forward(commands)

    def solve(command, pose):
        def residual(q):
            reached = arm.forward(q[None])[0]
            turn = se3.log_rotation(reached[:3, :3] @ pose[:3, :3].T)
            return np.concatenate([reached[:3, 3] - pose[:3, 3], turn])

        def slope(q):
            return jacobian(q[None])[0]

        return solver(residual, command, jac=slope).x

    return np.array([solve(*each) for each in zip(commands, wanted, strict=True)])


def timed(function, *arguments):
    """Return seconds and result."""
    begin = time.perf_counter()
    result = function(*arguments)
    return time.perf_counter() - begin, result


def main():
    """Run everything and print the figures."""
    options = bench.options(
        __doc__, poses=10_000, quick=(False, '3 repetitions instead of 7'), json=False
    )

    rng = np.random.default_rng(0)
    nominal = load_chain('ur10e')
    true = faulty(nominal, Cell(length_error=1e-3, angle_error=1e-3), rng)
    commands = program(nominal, options.poses, rng)
    compensator = Compensator(nominal, true)
    wanted = bare(nominal).forward(commands)

    part = commands[:: max(1, len(commands) // 100)]
    scipy = {'root': root, 'least_squares': least_squares}
    rates = {name: [] for name in ('calib_ros', *scipy)}
    for _ in range(3 if options.quick else 7):
        seconds, result = timed(compensate, compensator, commands)
        rates['calib_ros'].append(len(commands) / seconds)
        for name, solver in scipy.items():
            seconds, found = timed(pose_by_pose, solver, nominal, true, part)
            rates[name].append(len(part) / seconds)
            apart = np.abs(found - compensate(compensator, part).joints).max()
            if apart > 1e-6:
                raise SystemExit(f'scipy {name} and calib_ros differ by {apart} rad')
    rate = {name: statistics.median(values) for name, values in rates.items()}

    seen = measure(true, nominal.random_joints(60, rng), rng, *NOISE)
    calibration = identify(Problem(nominal, seen))
    by_data = compensate(Compensator(nominal, calibration.chain), commands)
    frames = {'base': calibration.chain.base, 'tool': calibration.chain.tool}
    in_world = replace(nominal, **frames).forward(commands)
    reached = true.forward(by_data.joints)
    anywhere = compensate(compensator, nominal.random_joints(len(commands), rng))
    document = {
        'poses': len(commands),
        'refused': {
            'true_model': len(result.refusals),
            'identified_model': len(by_data.refusals),
        },
        'refused_of_random': len(anywhere.refusals) / len(commands),
        'before': figures(bare(true).forward(commands), wanted),
        'true_model': figures(bare(true).forward(result.joints), wanted),
        'identified': {
            'before': figures(true.forward(commands), calibration.before.forward(commands)),
            'after': figures(reached, in_world),
            'floor': figures(reached, calibration.chain.forward(by_data.joints)),
        },
        'poses_per_second': rate,
        'ratio': {name: rate['calib_ros'] / rate[name] for name in scipy},
    }
    document['true_model_max_um'] = document['true_model']['max_um']
    bench.tell(document, options.json)


if __name__ == '__main__':
    main()
