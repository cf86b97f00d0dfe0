# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A UR10e, calibrated, and a task for it."""

import functools

import numpy as np

from calib_ros import Calibration, Problem, identify, load_chain
from calib_ros.apply import simulation
from calib_ros.kinematics.se3 import transform

UR = load_chain('ur10e')
DOWN = np.diag([1.0, -1.0, -1.0])
SIGMAS = (1e-4, 3e-4)
ANGLE = 2.0 * np.pi * np.arange(12) / 12
CIRCLE = np.column_stack([0.15 * np.cos(ANGLE), 0.15 * np.sin(ANGLE), np.zeros(12)])
TASK = transform(np.tile(DOWN, (12, 1, 1)), CIRCLE)
"""Twelve poses on a circle of 0.3 m, tool down."""


@functools.cache
def identified(seed=0):
    """Return the true arm and the result of its identification; the seed is that of the noise."""
    rng = np.random.default_rng(0)
    true = simulation.faulty(UR, simulation.Cell(), rng)
    joints = UR.random_joints(40, rng)
    observations = simulation.measure(true, joints, np.random.default_rng(seed), *SIGMAS)
    return true, identify(Problem(UR, observations))


def calibrated(seed=0):
    return Calibration.of(identified(seed)[1])
