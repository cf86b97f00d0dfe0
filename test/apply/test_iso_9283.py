# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from designs import design_of

from calib_ros.apply import simulation
from calib_ros.apply.iso_9283 import iso_9283_poses
from calib_ros.errors import InputError
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.joint import Joint
from calib_ros.kinematics.se3 import invert


@pytest.mark.parametrize(('name', 'seed'), [('denso_hsr065', 0), ('abb_irb120', 2)])
def test_the_test_poses_are_those_of_the_standard(name, seed, rng, hurried):
    chain = replace(load_chain(name), base=simulation.random_frame(rng, 2.0))
    design = design_of(chain)
    found = iso_9283_poses(design, np.random.default_rng(seed))
    poses = invert(chain.base.matrix) @ design.targets(found.joints)
    np.testing.assert_allclose(poses[:, :3, :3], poses[:1, :3, :3].repeat(5, 0), atol=1e-6)
    away = (poses[1:, :3, 3] - poses[0, :3, 3]) / found.edge
    np.testing.assert_allclose(np.abs(away), 0.4, atol=1e-6)  # a tenth of the diagonal from it
    np.testing.assert_allclose(away[:, 0], away[:, 2], atol=1e-6)  # in one plane through P1
    assert len(np.unique(away.round(3), axis=0)) == 4
    assert np.abs(poses[0, :2, 3]).max() > 0.5 * found.edge  # the arm does not stand in it
    assert found.edge > 0.25
    limits = np.array([[joint.lower, joint.upper] for joint in chain.joints])
    assert ((limits[:, 0] <= found.joints) & (found.joints <= limits[:, 1])).all()


def test_an_arm_that_cannot_keep_its_orientation_reaches_the_places(hurried):
    design = design_of(load_chain('kuka_youbot'))
    found = iso_9283_poses(design, np.random.default_rng(1))
    places = design.targets(found.joints)[:, :3, 3]
    assert not found.oriented
    assert 2.0 * np.abs(places[0, :2]).max() > found.edge > 0.1  # beside the arm
    np.testing.assert_allclose(np.abs(places[1:] - places[0]), 0.4 * found.edge, atol=1e-6)


def test_an_arm_that_moves_in_a_plane_reaches_no_cube(rng):
    rows = tuple(Joint(f'j{k}', a=0.3) for k in range(3))
    with pytest.raises(InputError, match='of any cube'):
        iso_9283_poses(design_of(Chain('planar', 'standard', rows)), rng)
