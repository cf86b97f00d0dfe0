# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Noise that differs by direction, against what was drawn."""

from dataclasses import replace

import numpy as np
import pytest

from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.identification.directions import by_direction
from calib_ros.identification.fitting import fit
from calib_ros.identification.problem import Problem
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import load_chain

SCARA = load_chain('denso_hsr065')
UR = load_chain('ur10e')


def noisy(chain, rng, along=None, size=10.0, count=60):
    """Return the true arm, and poses with noise of 0.01 mm, larger along an axis or the ray."""
    place = Frame(se3.transform(np.eye(3), np.array([0.3, 2.5, 0.2])))
    true = replace(faulty(chain, Cell(), rng), base=place)
    seen = measure(true, chain.random_joints(count, rng), rng, 0.0, 2e-4)
    noise = 1e-5 * rng.normal(size=(count, 3))
    if along == 'ray':
        axis = seen.positions / np.linalg.norm(seen.positions, axis=1, keepdims=True)
    else:
        axis = np.tile(np.eye(3)[2], (count, 1))
    if along is not None:
        noise += (size - 1.0) * np.einsum('ni,ni,nj->nj', noise, axis, axis)
    return true, replace(seen, positions=seen.positions + noise)


def told(chain, seen, part=0, sigma=1e-5):
    problem = Problem(chain, seen, sigma_position=sigma, sigma_orientation=2e-4, loss='none')
    found = fit(problem)[2]
    best = found.robust.fit
    return by_direction(best.chain, found.names, found.system, found.factor, part)


@pytest.mark.parametrize('chain', [SCARA, UR], ids=lambda chain: chain.name)
@pytest.mark.parametrize('along', ['axis', 'ray'])
def test_noise_ten_times_larger_in_one_direction_is_found(chain, along):
    found = []
    for seed in range(5):
        _, seen = noisy(chain, np.random.default_rng(seed), along)
        here = told(chain, seen, sigma=5.8e-5)
        found.append(np.sort(5.8 * np.sqrt(here.variances))[[0, -1]])
        assert told(chain, seen, part=1) is None
    least, most = np.mean(found, axis=0)
    assert 0.7 < least < 1.6  # what the fit spreads is taken back but for chance
    assert most == pytest.approx(10.0, rel=0.15)


@pytest.mark.parametrize('chain', [SCARA, UR], ids=lambda chain: chain.name)
def test_noise_that_is_alike_is_left_alone(chain):
    for seed in range(20):
        _, seen = noisy(chain, np.random.default_rng(seed))
        assert told(chain, seen) is None
        assert told(chain, seen, part=1) is None


def test_the_depth_of_a_camera_on_the_flange_is_found():
    """Its axes turn with the arm: what it measured was the other way round."""
    rng = np.random.default_rng(0)
    true = faulty(UR, Cell(), rng)
    seen = measure(true, UR.random_joints(60, rng), rng, 0.0, 2e-4)
    camera = seen.inverted()
    noise = rng.normal(size=(60, 3)) * [1e-5, 1e-5, 1e-4]
    again = replace(camera, positions=camera.positions + noise).inverted()
    flipped = replace(again, inverse=True)
    sizes = np.sort(5.8 * np.sqrt(told(UR, flipped, sigma=5.8e-5).variances))
    assert sizes[-1] == pytest.approx(10.0, rel=0.3)
    assert sizes[0] < 2.0


def test_deviations_follow_the_direction_in_which_a_parameter_shows():
    """Heights of a SCARA tell its tilts, the plane its lengths."""
    stds = {}
    for along in (None, 'axis'):
        _, seen = noisy(SCARA, np.random.default_rng(1), along)
        seen = replace(seen, oriented=np.zeros(len(seen), dtype=bool))
        sigma = 1e-5 if along is None else 5.8e-5
        problem = Problem(SCARA, seen, sigma_position=sigma, loss='none')
        found = fit(problem)[2]
        std = np.sqrt(np.diag(found.uncertainty.covariance))
        stds[along] = dict(zip(found.names, std.tolist(), strict=True))
    ratio = {name: stds['axis'][name] / stds[None][name] for name in ('joint_1.a', 'joint_2.a')}
    assert max(ratio.values()) < 3.5  # 5.8 by one sigma for all directions
    assert stds['axis']['joint_1.alpha'] > 7.0 * stds[None]['joint_1.alpha']
