# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A device that bends space is told from an arm that does."""

from dataclasses import replace

import numpy as np
import pytest
from measured import bent

from calib_ros import Observations, Problem, identify, load_chain
from calib_ros.estimation.distortion import bends
from calib_ros.estimation.nuisances import Nuisances, nuisance_products
from calib_ros.estimation.samples import Samples
from calib_ros.estimation.system import System

ARM = load_chain('ur10')
SIGMA = 2e-4


def seen(count=50, **more):
    q = ARM.random_joints(count, np.random.default_rng(1))
    pose = ARM.forward(q)
    return replace(Observations.from_arrays(q, pose[:, :3, 3], pose[:, :3, :3]), **more)


def covariance():
    return np.diag([SIGMA**2] * 3 + [1e-6] * 3) * np.ones((50, 1, 1))


def samples(observations, weights=None):
    return Samples(observations, SIGMA, 1e-3).weighted(weights)


@pytest.mark.parametrize(('name', 'seed'), [('ur10', 7), ('puma560', 9), ('kuka_iiwa14', 5)])
def test_the_errors_of_a_device_are_not_taken_for_those_of_an_arm(name, seed):
    """Each joint alone moves far; the device is off by 1 mm, its sigma, the arm by none."""
    arm, rng = load_chain(name), np.random.default_rng(seed)
    joints = len(arm.joints)
    each = 60 // joints
    q = np.repeat(rng.uniform(-1.0, 1.0, (1, joints)), 60, axis=0)
    for k in range(joints):
        q[k * each : (k + 1) * each, k] = np.linspace(-2.0, 2.0, each)
    q = q + rng.normal(scale=0.2, size=q.shape)
    places = bent(arm.forward(q)[:, :3, 3], 1e-3, rng)
    places = places + rng.normal(scale=5e-5, size=places.shape)
    problem = Problem(arm, Observations.from_arrays(q, places), sigma_position=1e-3)
    assert not identify(problem).accepted


@pytest.mark.parametrize('weighted', [False, True])
@pytest.mark.parametrize('own', [None, covariance()])
def test_errors_of_a_device_are_as_large_as_its_sigma(weighted, own):
    weights = np.linspace(0.0, 1.0, 50) if weighted else np.ones(50)
    (rows,) = bends([samples(seen(covariance=own), weights)])
    assert len(rows) == 27
    size = (rows[:, :3] ** 2).sum(axis=(0, 2)) / weights.sum()
    assert size == pytest.approx(np.ones(3))
    assert not rows[:, 3:].any()


def test_it_bends_what_it_sees_and_leaves_alone_what_the_frames_take_up():
    (rows,) = bends([samples(seen())])
    flat = rows.reshape(27, -1).T
    x = seen().positions - seen().positions.mean(axis=0)
    for wave, share in ((np.ones(50), 0.0), (x[:, 0], 1.0), (x[:, 1] * x[:, 2], 1.0)):
        for axis in np.eye(3):
            field = np.outer(axis, wave - share * wave.mean()).ravel()
            left = field - flat @ np.linalg.lstsq(flat, field, rcond=None)[0]
            told = 1.0 - (left @ left) / (field @ field)
            assert told == pytest.approx(share, abs=1e-9)


def test_it_turns_nothing():
    """Rows of position and orientation apart tell what those of whole poses do."""
    names, found = ARM.parameter_names[::3], []
    for own in (None, covariance()):
        system = System((samples(seen(covariance=own)),))
        found.append(nuisance_products(ARM, names, system, Nuisances(by_device=True)))
    np.testing.assert_allclose(found[0].cross, found[1].cross, atol=1e-6)
    np.testing.assert_allclose(found[0].doubtful, found[1].doubtful, atol=1e-9)


def test_a_camera_on_the_flange_bends_what_it_sees_itself():
    plain = seen()
    (rows,) = bends([samples(plain)])
    (turned,) = bends([samples(plain.inverted())])
    there = np.einsum('nji,kjn->kin', plain.rotations, rows[:, :3])  # in the frame of the target
    flat, wanted = (each[:, :3].reshape(27, -1).T for each in (turned, there))
    left = wanted - flat @ np.linalg.lstsq(flat, wanted, rcond=None)[0]
    assert np.abs(left).max() < 1e-9


def test_devices_have_their_own_errors_and_targets_of_one_have_them_in_common():
    first, other = samples(seen(base='base')), samples(seen(base='base_2', tool='tool_2'))
    both = bends([first, samples(seen(30, tool='tool_2')), other])
    assert [each.shape for each in both] == [(54, 3, 50), (54, 3, 30), (54, 3, 50)]
    assert both[0][:27].any()
    assert both[1][:27].any()
    assert not both[0][27:].any()
    assert not both[2][:27].any()


def test_what_has_no_place_has_no_bend():
    touching = Observations.touching(seen().joints)
    far = replace(seen(), distances=np.ones(50))
    (rows,) = bends([samples(touching)])
    assert len(rows) == 0
    (rows,) = bends([samples(replace(seen(), socket=True))])
    assert len(rows) == 0
    one, two = bends([samples(far), samples(seen())])
    assert one.shape == (27, 1, 50)
    assert not one.any()
    assert two.shape == (27, 3, 50)


def test_places_in_a_plane_or_all_in_one_tell_less():
    flat = seen()
    (rows,) = bends([samples(replace(flat, positions=flat.positions * [1.0, 1.0, 0.0]))])
    assert len(rows) == 3 * 5
    (rows,) = bends([samples(replace(flat, positions=0.0 * flat.positions))])
    assert len(rows) == 0
    (rows,) = bends([samples(replace(flat, positions=flat.positions + 1e3))])  # no less from afar
    assert len(rows) == 27
