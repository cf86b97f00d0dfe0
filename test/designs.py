# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Designs of measurements that nobody has made yet, and their worth by the plain formulas."""

from dataclasses import replace

import numpy as np

from calib_ros.apply import simulation
from calib_ros.apply.design import Design
from calib_ros.estimation.problem import Problem
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.se3 import transform

SIGMAS = (1e-4, 1e-4 / 0.3)
TOOL = Frame(transform(np.eye(3), np.array([0.05, 0.05, 0.1])))
POSTURE = np.array([0.3, -1.2, 1.4, -0.5, 0.9, 0.2])


def arm(name='ur10e'):
    return replace(load_chain(name), tool=TOOL)


def design_of(chain, oriented=True, **settings):
    rng = np.random.default_rng(0)
    imagined = simulation.measure(chain, np.zeros((1, len(chain.joints))), rng, oriented=oriented)
    return Design.of(Problem(chain, imagined, **settings))


def some(chain, count, seed=1):
    return chain.random_joints(count, np.random.default_rng(seed))


def information(design, q):
    rows = design.rows(q).reshape(-1, len(design.names))
    return design.known.T @ design.known + rows.T @ rows


def log_det(design, q):
    return np.linalg.slogdet(information(design, q))[1]


def predicted_square(design, q, task):
    """Return the mean squared error at a task by the plain formula."""
    jacobian = ErrorModel(design.chain, design.names).jacobian(task)[:, :3]
    covariance = np.linalg.inv(information(design, q))
    return np.einsum('tip,pq,tiq->t', jacobian, covariance, jacobian).mean()
