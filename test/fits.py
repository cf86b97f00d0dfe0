# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A UR10e with errors, what is measured of it, and fits that are not judged."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.decision.residuals import residuals
from calib_ros.estimation import fitting
from calib_ros.estimation.fitted import parameter_rows
from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.problem import Problem
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import load_chain, parse_chain

UR10E = load_chain('ur10e')
SCARA = parse_chain("""
name: scara
convention: standard
joints:
- {name: arm, type: revolute, a: 0.35, alpha: 0.0, d: 0.4, theta: 0.0, lower: -2.3, upper: 2.3}
- {name: elbow, type: revolute, a: 0.3, alpha: 3.141592653589793, d: 0.0, theta: 0.0,
   lower: -2.4, upper: 2.4}
- {name: quill, type: prismatic, a: 0.0, alpha: 0.0, d: 0.0, theta: 0.0, lower: 0.0, upper: 0.3}
- {name: spindle, type: revolute, a: 0.0, alpha: 0.0, d: 0.05, theta: 0.0, lower: -2.5, upper: 2.5}
""")
NOISE = (5e-5, 2e-4)
"""Of positions [m] and orientations [rad]."""
SIGMAS = {'sigma_position': NOISE[0], 'sigma_orientation': NOISE[1]}
NO_PRIOR = {'*_joint.*': 1e6}
"""As good as none, but given: so none is told by the data."""


def arm(rng, errors=1.0, chain=UR10E):
    """Return an arm, its errors so many times the usual; `rng` may be a seed."""
    cell = Cell(length_error=5e-4 * errors, angle_error=1e-3 * errors)
    return faulty(chain, cell, np.random.default_rng(rng))


def measured_arm(rng, count, noise=NOISE, chain=UR10E, errors=1.0, **more):
    """Return a generator, an arm with errors as `arm` and poses of it; `rng` may be a seed."""
    rng = np.random.default_rng(rng)
    true = arm(rng, errors, chain)
    return rng, true, measure(true, chain.random_joints(count, rng), rng, *noise, **more)


def problem(true, count, seed, oriented=True, chain=UR10E, worse=1.0):
    """Return a problem of poses of an arm, their noise so many times the usual and told."""
    rng = np.random.default_rng(seed)
    noise = (worse * sigma for sigma in NOISE)
    measured = measure(true, chain.random_joints(count, rng), rng, *noise, oriented)
    return Problem(chain, measured, **{name: worse * sigma for name, sigma in SIGMAS.items()})


def rms(chain, true, q, approach=None):
    """Return the RMS position error [m] against the true arm."""
    error = (chain.forward(q, approach) - true.forward(q, approach))[:, :3, 3]
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def worst_prediction(found, true, rng):
    """Return the largest position error [m] and turn [rad] on poses that were not fitted."""
    joints = true.random_joints(200, rng)
    left = residuals(found, measure(true, joints, rng))
    return np.abs(left.position).max(), np.abs(left.orientation).max()


def along_path(count, rng, width=None, ways=12):
    """Return joint values (count, 6) on the lines from one way-point to the next."""
    corners = UR10E.random_joints(ways, rng)
    if width is not None:
        corners = rng.uniform(-1.0, 1.0, 6) + rng.uniform(-width, width, (ways, 6))
    share = np.arange(count // ways)[:, np.newaxis] / (count // ways)
    lines = np.roll(corners, -1, axis=0) - corners
    return (corners[:, np.newaxis] + share * lines[:, np.newaxis]).reshape(-1, 6)


def fitted(problem):
    """Return chains, names, parameters, covariance and noise of a fit.

    This is all that `identify` does before it judges, in less than half of its time.
    """
    fit = fitting.fit(problem)
    start, names = fit.start, fit.names
    found = parameter_rows(fit, fit.uncertainty)
    frames = [name for name in names if start.owns_frame(name)]
    return SimpleNamespace(
        before=minimise(start, frames, fit.system).chain,
        chain=fit.chain,
        names=names,
        parameters=found,
        covariance=fit.uncertainty.covariance,
        noise=fit.noise,
    )


def directions(count, rng):
    direction = rng.normal(size=(count, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def spoiled(seen, rng, share, shift=(0.0, 0.0), turn=(0.0, 0.0)):
    """Return the observations with gross errors [m, rad] in a share, and which they are."""
    count = round(share * len(seen))
    index = rng.choice(len(seen), count, replace=False)
    positions, rotations = seen.positions.copy(), seen.rotations.copy()
    positions[index] += directions(count, rng) * rng.uniform(*shift, (count, 1))
    turns = se3.exp_rotation(directions(count, rng) * rng.uniform(*turn, (count, 1)))
    rotations[index] = turns @ rotations[index]
    return replace(seen, positions=positions, rotations=rotations), set(index.tolist())


def at_stations(rng, count):
    """Return joint values (25 count, 6): at each station the last two joints move on a grid."""
    stations = rng.uniform(-1.0, 1.0, 6) + np.cumsum(rng.uniform(-0.15, 0.15, (count, 6)), axis=0)
    q = np.repeat(stations, 25, axis=0)
    wrist = 0.17 * np.stack(np.meshgrid(np.arange(-2, 3), np.arange(-2, 3)), axis=-1)
    q[:, 4:] += np.tile(wrist.reshape(25, 2), (count, 1))
    return q + rng.normal(scale=3e-4, size=q.shape)
