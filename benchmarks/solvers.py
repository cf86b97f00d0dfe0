# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One identification by one program, in a process and an environment of its own.

    python benchmarks/solvers.py NAME FOLDER TIMES

Started by `peers.py`, which wrote the problem to the folder; prints what it took as JSON and
writes the positions predicted for unseen joint values. It imports nothing but numpy and what it
measures. Times are those of the identification alone: imports and reading of files do not count.
"""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

WIDTH = 18
"""Numbers of a sample in the file: joints (6), position (3), rotation (9)."""
CHUNK = 8192
"""Samples that are in memory at once when they are streamed."""


class Given:
    """The problem in a folder."""

    def __init__(self, folder):
        self.folder = folder
        self.facts = json.loads((folder / 'facts.json').read_text())
        self.unseen = np.load(folder / 'unseen.npy')
        self.oriented = self.facts['oriented']

    @property
    def samples(self):
        """Return joints (N, 6), positions (N, 3) and rotations (N, 3, 3)."""
        return _split(np.fromfile(self.folder / 'samples.bin'))

    def chunks(self):
        """Yield the samples a few at a time."""
        with (self.folder / 'samples.bin').open('rb') as file:
            while len(numbers := np.fromfile(file, count=CHUNK * WIDTH)):
                yield _split(numbers)


def _split(numbers):
    rows = numbers.reshape(-1, WIDTH)
    return rows[:, :6], rows[:, 6:9], rows[:, 9:].reshape(-1, 3, 3)


# Ours. Each returns a function that identifies, and one that predicts by what came out.


def _observations(given, samples):
    from calib_ros.estimation.observations import Observations

    joints, positions, rotations = samples
    return Observations.from_arrays(joints, positions, rotations if given.oriented else None)


def _positions(given):
    return lambda chain: chain.forward(given.unseen)[:, :3, 3]


def ours(given):
    """Identify with everything: frames, rank, gross errors, covariance, residuals, judgement."""
    from calib_ros.estimation.problem import Problem
    from calib_ros.identification.identification import identify
    from calib_ros.kinematics.chain_file import load_chain

    judge = np.fromfile(given.folder / 'judge.bin')
    held_out = _observations(given, _split(judge))
    observations, nominal = _observations(given, given.samples), load_chain('ur10e')

    def solve():
        fresh = replace(observations)  # which remembers nothing of the time before
        return identify(Problem(nominal, fresh, held_out=held_out)).chain

    return solve, _positions(given)


def _start(given):
    """Return the nominal chain with frames, the parameters to fit, and the sigmas."""
    from calib_ros.kinematics.chain_file import load_chain

    return (
        load_chain(str(given.folder / 'start.yaml')),
        given.facts['names'],
        given.facts['sigmas'],
    )


def fit(given):
    """Only fit, from a start with frames: what the others below do, too."""
    from calib_ros.estimation.leastsquares import minimise
    from calib_ros.estimation.samples import Samples
    from calib_ros.estimation.system import System

    start, names, sigmas = _start(given)
    system = System((Samples(_observations(given, given.samples), *sigmas),))
    return lambda: minimise(start, names, system).chain, _positions(given)


class Streamed:
    """Samples that are read from their file whenever they are wanted, a few at a time."""

    def __init__(self, given, sigmas):
        self.given, self.sigmas = given, sigmas
        self.count = given.facts['poses']
        self.rows = self.count * (6 if given.oriented else 3)

    def products(self, *which):
        """Return the products of all rows; see `samples.Samples`."""
        from calib_ros.estimation.samples import Samples

        read = (_observations(self.given, chunk) for chunk in self.given.chunks())
        return sum(Samples(each, *self.sigmas).products(*which) for each in read)


def streamed(given):
    """Only fit, and read the samples from the disk in each iteration."""
    from calib_ros.estimation.leastsquares import minimise
    from calib_ros.estimation.system import System

    start, names, sigmas = _start(given)
    system = System((Streamed(given, sigmas),))
    return lambda: minimise(start, names, system).chain, _positions(given)


def one_by_one(given):
    """Only fit, with the same code, one sample at a time."""
    from calib_ros.estimation.leastsquares import minimise
    from calib_ros.estimation.samples import Samples
    from calib_ros.estimation.system import System

    start, names, sigmas = _start(given)
    joints, positions, rotations = given.samples
    rows = [slice(k, k + 1) for k in range(len(joints))]
    parts = [(joints[k], positions[k], rotations[k]) for k in rows]
    system = System(tuple(Samples(_observations(given, part), *sigmas) for part in parts))
    return lambda: minimise(start, names, system).chain, _positions(given)


def scipy(given):
    """Fit with scipy's least squares; the Jacobian is that of our error model, all at once."""
    from scipy.optimize import least_squares

    from calib_ros.decision.residuals import residuals
    from calib_ros.kinematics.jacobian import ErrorModel

    start, names, sigmas = _start(given)
    observations = _observations(given, given.samples)
    height = 6 if given.oriented else 3
    weights = 1.0 / np.repeat(sigmas, 3)[:height]

    def chain_at(x):
        return start.with_offsets(dict(zip(names, x, strict=True)))

    def residual(x):
        left = residuals(chain_at(x), observations)
        return (np.hstack([left.position, left.orientation])[:, :height] * weights).ravel()

    def jacobian(x):
        columns = ErrorModel(chain_at(x), names).jacobian(observations.joints)[:, :height]
        return (-columns * weights[:, np.newaxis]).reshape(-1, len(names))

    def solve():
        solution = least_squares(residual, np.zeros(len(names)), jac=jacobian, x_scale='jac')
        return chain_at(solution.x)

    return solve, _positions(given)


# The others, as their documentation shows.


def pybotics(given):
    """Fit positions as in its example `calibration.ipynb`, by Levenberg and Marquardt's method.

    The mask frees what is no gauge. Its residual is the length of the position error.
    """
    from pybotics.optimization import OptimizationHandler, optimize_accuracy
    from pybotics.robot import Robot
    from pybotics.tool import Tool
    from scipy.optimize import least_squares

    joints, positions, _ = given.samples
    robot = Robot.from_parameters(np.array(given.facts['modified_dh']))
    robot.world_frame = np.array(given.facts['base'])
    robot.tool = Tool(np.array(given.facts['modified_tool']))
    mask = np.ones((6, 4), dtype=bool)  # alpha, a, theta, d of each link
    mask[0] = mask[5, 2:] = False  # the world frame and the tool do the same
    handler = OptimizationHandler(
        robot,
        kinematic_chain_mask=mask.ravel(),
        tool_mask=[True] * 3 + [False] * 3,
        world_mask=True,
    )

    def solve():
        start = handler.generate_optimization_vector()
        data = (handler, joints, positions)
        solution = least_squares(optimize_accuracy, start, args=data, method='lm')
        handler.apply_optimization_vector(solution.x)
        return handler.robot

    return solve, lambda found: np.array([found.fk(q)[:3, 3] for q in given.unseen])


def robotkinecal(given):
    """Solve as in its README, from a URDF that holds the frames, too."""
    import roboticstoolbox
    from robotkinecal import SerialRobotKineCal
    from spatialmath import SE3

    joints, positions, rotations = given.samples
    robot = roboticstoolbox.ERobot.URDF(str(given.folder / 'start.urdf'))
    measured = list(positions)
    if given.oriented:
        measured = [SE3.Rt(r, p) for r, p in zip(rotations, positions, strict=True)]
    calibration = SerialRobotKineCal(robot, 'target')
    calibration.set_observations(list(joints), measured)

    def solve():
        calibration.solve()
        return calibration

    def predict(found):
        last = found.N_JOINTS + 1
        return np.array([found.forward_kinematics(last, q).t for q in given.unseen])

    return solve, predict


def figaroh(given):
    """Solve with its `BaseCalibration`; the cost is that of the example in its docstring."""
    import logging
    import warnings

    import yaml
    from figaroh.calibration.base_calibration import BaseCalibration
    from figaroh.calibration.calibration_tools import calc_updated_fkm
    from figaroh.tools.robot import Robot

    logging.disable(logging.CRITICAL)
    warnings.simplefilter('ignore')
    joints, positions, rotations = given.samples
    robot = Robot(str(given.folder / 'start.urdf'), str(given.folder))
    names = given.facts['joint_names']
    header = ['x1', 'y1', 'z1']
    columns = [positions]
    if given.oriented:
        from scipy.spatial.transform import Rotation

        header += ['phix1', 'phiy1', 'phiz1']
        columns.append(Rotation.from_matrix(rotations).as_euler('xyz'))
    table = np.hstack([*columns, joints])
    data, config = given.folder / 'figaroh.csv', given.folder / 'figaroh.yaml'
    np.savetxt(data, table, delimiter=',', header=','.join([*header, *names]), comments='')
    task = {
        'type': 'kinematic_calibration',
        'kinematics': {'base_frame': 'universe', 'tool_frame': 'target'},
        'measurements': {'markers': [{'measurable_dof': [True] * 3 + [given.oriented] * 3}]},
        'parameters': {'calibration_level': 'full_params', 'outlier_threshold': 1.0},
        'data': {'source_file': str(data), 'number_of_samples': len(joints)},
    }
    config.write_text(yaml.safe_dump({'robot': {'name': 'arm'}, 'tasks': {'calibration': task}}))
    sigma, turn = given.facts['sigmas']

    class Calibration(BaseCalibration):
        def cost_function(self, var):
            found = calc_updated_fkm(
                self.model, self.data, var, self.q_measured, self.calib_config
            )
            left = self._compute_logmap_residuals(self.PEE_measured, found)
            return self.apply_measurement_weighting(left, 1.0 / sigma, 1.0 / turn)

        def print_quality_report(self):
            """Print nothing: the output is JSON."""

    calibration = Calibration(robot, str(config))
    calibration.calib_config['known_baseframe'] = False
    calibration.calib_config['known_tipframe'] = False

    def solve():
        calibration.initialize()
        return calibration.solve(enable_logging=False).x

    def predict(found):
        settings = dict(calibration.calib_config, NbSample=len(given.unseen))
        flat = calc_updated_fkm(calibration.model, calibration.data, found, given.unseen, settings)
        return flat.reshape(-1, len(given.unseen))[:3].T

    return solve, predict


SOLVERS = {
    'calib_ros': ours,
    'fit': fit,
    'streamed': streamed,
    'one by one': one_by_one,
    'scipy': scipy,
    'pybotics': pybotics,
    'figaroh': figaroh,
    'robotkinecal': robotkinecal,
}


def main():
    """Solve the problem several times; print the shortest times."""
    name, folder, times = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
    given = Given(folder)
    solve, predict = SOLVERS[name](given)
    seconds, cpu = [], []
    for _ in range(times):
        begin = (time.perf_counter(), time.process_time())
        found = solve()
        seconds.append(time.perf_counter() - begin[0])
        cpu.append(time.process_time() - begin[1])
    status = Path('/proc/self/status').read_text()  # getrusage would count the parent's
    peak = int(status.partition('VmHWM:')[2].split()[0])
    np.save(folder / 'predicted.npy', predict(found))
    print(json.dumps({'seconds': min(seconds), 'cpu': min(cpu), 'peak_mb': peak / 1e3}))


if __name__ == '__main__':
    main()
