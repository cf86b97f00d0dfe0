# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A camera on the flange: what it measures and how well, turned round."""

from dataclasses import replace

import numpy as np
import pytest
from fits import UR10E, fitted

from calib_ros.apply.simulation import Cell, faulty, random_frame
from calib_ros.errors import InputError
from calib_ros.identification.identification import identify
from calib_ros.identification.observations import Observations
from calib_ros.identification.problem import Problem
from calib_ros.identification.validation import residuals
from calib_ros.kinematics import se3


def test_the_camera_on_the_flange(rng):
    """A camera sees a fixed target: measured is the target in the camera's frame."""
    true = faulty(UR10E, Cell(), rng)  # from target to camera

    def pictures(count):
        q = UR10E.random_joints(count, rng)
        seen = se3.invert(true.forward(q))
        return Observations.from_arrays(q, seen[:, :3, 3], seen[:, :3, :3].copy())

    result = identify(Problem(UR10E, pictures(50).inverted()))
    assert result.rank == 30
    left = residuals(result.chain, pictures(100).inverted())
    assert np.abs(left.position).max() < 1e-9
    assert np.abs(left.orientation).max() < 1e-9
    # and back: where the target will be seen
    again = pictures(20)
    predicted = se3.invert(result.chain.forward(again.joints))
    np.testing.assert_allclose(predicted[:, :3, 3], again.positions, rtol=0, atol=1e-8)


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


def test_the_depth_of_a_camera_is_its_weak_side():
    """Samples weighted by their inverted covariances predict better than all alike."""
    ratios = []
    sigmas = np.array([5e-5, 5e-5, 2e-3, 1e-4, 1e-4, 1e-4])
    for seed in range(5):
        rng = np.random.default_rng(seed)
        true = faulty(UR10E, Cell(), rng)
        q = UR10E.random_joints(60, rng)
        errors = rng.normal(size=(60, 6)) * sigmas
        poses = np.stack(
            [
                shaken(pose, error[None])[0]
                for pose, error in zip(se3.invert(true.forward(q)), errors, strict=True)
            ]
        )
        plain = Observations.from_arrays(q, poses[:, :3, 3], poses[:, :3, :3].copy())
        own = replace(plain, covariance=np.tile(np.diag(sigmas**2), (60, 1, 1)))
        unseen = UR10E.random_joints(300, rng)
        result = []
        for each in (plain, own):
            found = fitted(Problem(UR10E, each.inverted(), loss='none'))
            error = (found.chain.forward(unseen) - true.forward(unseen))[:, :3, 3]
            result.append(np.sqrt((error**2).mean()))
        assert found.noise.position == pytest.approx(1.0, abs=0.2)
        ratios.append(result[1] / result[0])
    assert np.median(ratios) < 0.7


def test_positions_cannot_be_inverted(rng):
    """The camera's place in the target's frame needs the orientation."""
    seen = Observations.from_arrays(UR10E.random_joints(5, rng), rng.normal(size=(5, 3)))
    with pytest.raises(InputError, match='orientation'):
        seen.inverted()
