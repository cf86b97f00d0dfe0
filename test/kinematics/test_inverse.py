# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from commanded import twist

from calib_ros.apply import simulation
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.chain_file import load_chain, shipped_robots
from calib_ros.kinematics.inverse import solve
from calib_ros.kinematics.limits import a_turn_away, limits
from calib_ros.values import SAME


@pytest.mark.parametrize('robot', sorted(shipped_robots()))
def test_poses_are_reached_from_nearby(robot, rng):
    """Arms with faults, frames anywhere, standard and modified DH, prismatic, 4 to 7 joints."""
    chain = simulation.faulty(load_chain(robot), simulation.Cell(), rng)
    lower, upper = limits(chain)
    q = chain.random_joints(300, rng)
    start = np.clip(q + rng.normal(scale=0.05, size=q.shape), lower, upper)
    wanted = chain.forward(q)
    found = solve(chain, wanted, start)
    assert found.converged.mean() > 0.97
    away = twist(wanted, chain.forward(found.joints))
    distance, turn = (np.linalg.norm(each, axis=1) for each in (away[:, :3], away[:, 3:]))
    np.testing.assert_allclose(distance, found.position, atol=1e-12)
    np.testing.assert_allclose(turn, found.orientation, atol=1e-7)
    assert distance[found.converged].max() <= SAME
    assert ((lower <= found.joints) & (found.joints <= upper)).all()
    if len(chain.joints) < 7:
        near = np.abs(found.joints - q).max(axis=1)[found.converged]
        assert np.mean(near < 1e-4) > 0.9


def test_a_rail_is_not_turned():
    joint = replace(load_chain('ur10e').joints[0], lower=-1.0, upper=1.0)
    assert a_turn_away(joint, 7.0) == '; a full turn away, 0.716815 is within them: give that'
    assert a_turn_away(replace(joint, type='prismatic'), 7.0) == a_turn_away(joint, -5.0) == ''


def test_non_geometric_effects_are_taken_into_account(rng):
    chain = load_chain('ur10e').with_effect_values(
        {'elbow_joint.sin_1': 1e-3, 'shoulder_lift_joint.gravity_elbow_joint': 2e-3}
    )
    q = chain.random_joints(100, rng)
    wanted = chain.forward(q)
    found = solve(chain, wanted, q + 0.03)
    assert found.converged.mean() > 0.97
    np.testing.assert_allclose(
        chain.forward(found.joints)[found.converged], wanted[found.converged], atol=5e-9
    )


def test_it_ends_after_its_rounds(rng):
    chain = load_chain('ur10e')
    q = chain.random_joints(20, rng)
    wanted = chain.forward(q)
    once, often = (solve(chain, wanted, q + 0.03, iterations=count) for count in (1, 20))
    assert not once.converged.any()
    assert (once.position < 0.1 * np.linalg.norm(wanted[:, :3, 3], axis=1)).all()
    assert often.converged.mean() > 0.9


def test_joints_without_limits_have_none():
    joint = Joint('turntable', a=0.0, alpha=0.0, d=0.0, theta=0.0)
    assert [each.tolist() for each in limits(Chain('one', 'standard', (joint,)))] == [
        [-np.inf],
        [np.inf],
    ]


def test_limits_hold_and_full_turns_are_taken_back():
    chain = Chain(
        'stand',
        'standard',
        (
            Joint('turn', a=0.5, lower=-2.0, upper=2.0),
            Joint('lift', type='prismatic', lower=0.0, upper=0.3),
        ),
    )
    wanted = chain.forward(np.array([[1.9, 0.2], [1.0, 0.1]]))
    beyond = replace(chain, joints=(replace(chain.joints[0], upper=3.0), chain.joints[1]))
    unreachable = beyond.forward(np.array([[2.5, 0.2]]))
    found = solve(chain, np.concatenate([wanted, unreachable]), np.full((3, 2), 0.15))
    np.testing.assert_array_equal(found.converged, [True, True, False])
    np.testing.assert_allclose(found.joints[:2], [[1.9, 0.2], [1.0, 0.1]], atol=1e-8)
    assert found.joints[2, 0] == pytest.approx(2.0)
    whole = replace(chain, joints=(replace(chain.joints[0], lower=-3.14, upper=3.14),))
    round_ = solve(whole, whole.forward(np.array([[-3.0], [3.0]])), np.array([[3.1], [-3.1]]))
    np.testing.assert_allclose(round_.joints, [[-3.0], [3.0]])  # 3.28 is beyond the limit
    turned = solve(chain, wanted, np.array([[1.8 + 2.0 * np.pi, 0.1], [0.9 - 2.0 * np.pi, 0.2]]))
    np.testing.assert_allclose(turned.joints, [[1.9, 0.2], [1.0, 0.1]], atol=1e-8)
    whole_numbers = solve(chain, wanted, np.array([[1, 0], [1, 0]]))
    np.testing.assert_allclose(whole_numbers.joints, [[1.9, 0.2], [1.0, 0.1]], atol=1e-8)


def test_each_pose_is_solved_as_if_alone(rng):
    chain = load_chain('puma560')
    q = chain.random_joints(20, rng)
    wanted, start = chain.forward(q), chain.random_joints(20, rng)
    together = solve(chain, wanted, start)
    for k in range(6):
        alone = solve(chain, wanted[k : k + 1], start[k : k + 1])
        assert alone.converged[0] == together.converged[k]
        if alone.converged[0]:
            np.testing.assert_allclose(alone.joints[0], together.joints[k], atol=1e-6)
