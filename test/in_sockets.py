# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A simulated arm with a ball on its flange that sits in sockets, two at each place."""

from dataclasses import replace
from functools import cache

import numpy as np

from calib_ros import Observations, Problem, load_chain
from calib_ros.apply.simulation import Cell, faulty
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.jacobian import ErrorModel

DISTANCE = 0.05
PLACES = 4
IIWA = replace(load_chain('kuka_iiwa14'), base=None, tool=None)


def led_to(chain, q, points):
    """Return joint values near q (N, n) that bring the target to points (N, 3)."""
    model = ErrorModel(chain, [joint.driven for joint in chain.joints])
    signs, q = np.array([joint.sign for joint in chain.joints]), q.copy()
    for _ in range(200):
        left = points - chain.forward(q)[:, :3, 3]
        far = np.abs(left).max(axis=1) > 1e-13
        if not far.any():
            break
        columns = model.jacobian(q[far])[:, :3] * signs
        square = columns @ columns.transpose(0, 2, 1) + 1e-5 * np.eye(3)
        steps = np.linalg.solve(square, left[far, :, None])
        q[far] += (columns.transpose(0, 2, 1) @ steps)[:, :, 0]
    assert np.abs(chain.forward(q)[:, :3, 3] - points).max() < 1e-12
    return q


@cache
def cell(seed, offset=0.03, noise=0.0, count=30):
    """Return a true arm with the ball some offset [m] from its last axis, and the problem."""
    rng = np.random.default_rng(seed)
    tool = np.eye(4)
    tool[:3, 3] = [offset, 0.0, 0.14]
    true = replace(faulty(IIWA, Cell(), rng), base=Frame(), tool=Frame(tool))
    sets, separations = [], []
    for place in range(PLACES):
        reach = true.forward(true.random_joints(5, rng))[:, :3, 3]
        middle = reach[np.argsort(np.linalg.norm(reach, axis=1))[1]]
        angle = rng.uniform(0.0, np.pi)
        half = 0.5 * DISTANCE * np.array([np.cos(angle), np.sin(angle), 0.0])
        bases = [f'base_{place}_{socket}' for socket in range(2)]
        for base, centre in zip(bases, (middle - half, middle + half), strict=True):
            points = centre + rng.normal(scale=noise, size=(count, 3))
            q = led_to(true, true.random_joints(count, rng), points)
            seen = Observations.from_arrays(q, np.zeros((count, 3)))
            sets.append(replace(seen, base=base, socket=True))
        separations.append((*bases, DISTANCE))
    return true, Problem(
        IIWA, sets[0], more=sets[1:], separations=separations, sigma_position=max(noise, 1e-5)
    )


def difference(found, true, seed=0):
    """Return the RMS distance [m] of positions by two chains, one body laid upon the other."""
    q = IIWA.random_joints(300, np.random.default_rng(seed))
    first, second = (chain.forward(q)[:, :3, 3] for chain in (found, true))
    first, second = first - first.mean(axis=0), second - second.mean(axis=0)
    turn = se3.nearest_rotation(second.T @ first)
    return float(np.sqrt(((first @ turn.T - second) ** 2).sum(axis=1).mean()))
