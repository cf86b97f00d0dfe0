# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A camera on the flange: what it measures and how well, turned round."""

from dataclasses import replace

import numpy as np
from fits import UR10E

from calib_ros.apply.simulation import random_frame
from calib_ros.estimation.observations import Observations
from calib_ros.kinematics import se3


def random_poses(count, rng):
    rotations = np.stack([random_frame(rng, 1.0).matrix[:3, :3] for _ in range(count)])
    return Observations.from_arrays(
        UR10E.random_joints(count, rng), rng.uniform(-1.0, 1.0, (count, 3)), rotations
    )


def random_covariance(rng, size=1.0):
    root = size * rng.normal(size=(6, 6))
    return root @ root.T


def shaken(pose, errors):
    """Return (N, 4, 4): a pose with errors (N, 6) as in `Observations.covariance`."""
    turned = se3.exp_rotation(errors[:, 3:]) @ pose[:3, :3]
    return se3.transform(turned, pose[:3, 3] + errors[:, :3])


def errors_of(poses, pose):
    """Return (N, 6) what `shaken` adds to a pose to make these."""
    turn = se3.log_rotation(poses[:, :3, :3] @ pose[:3, :3].T)
    return np.concatenate([poses[:, :3, 3] - pose[:3, 3], turn], axis=1)


def test_covariances_are_inverted_by_the_numeric_jacobian(rng):
    for _ in range(10):
        seen = random_poses(1, rng)
        covariance = random_covariance(rng)
        pose = se3.transform(seen.rotations[0], seen.positions[0])
        inverse = se3.invert(pose[None])[0]
        step = 1e-6 * np.eye(6)
        ahead, behind = (
            errors_of(se3.invert(shaken(pose, sign * step)), inverse) for sign in (1.0, -1.0)
        )
        jacobian = (ahead - behind).T / 2e-6
        found = replace(seen, covariance=covariance[None]).inverted().covariance[0]
        np.testing.assert_allclose(found, jacobian @ covariance @ jacobian.T, rtol=0, atol=1e-6)
