# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Arms that cannot move their target in every direction: of few joints, or parallel ones."""

from dataclasses import replace

import numpy as np
import pytest
from commanded import (
    CELL,
    ROBOTS,
    UR,
    UR_TRUE,
    bare,
    missed,
    numeric_jacobian,
    only_refusal,
    pose_errors,
    regular,
)
from scipy.optimize import least_squares

from calib_ros.apply.compensation import compensate, in_words
from calib_ros.apply.compensator import Compensator
from calib_ros.apply.simulation import faulty
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.follower import mobility
from calib_ros.settings import EXACT

ENDS = {'lower': -2.5, 'upper': 2.5}
PLANAR = [
    Chain('planar', 'standard', tuple(Joint(f'j{k}', a=a, **ENDS) for k, a in enumerate(lengths)))
    for lengths in ((0.4, 0.3), (0.4, 0.3, 0.2), (0.4, 0.3, 0.2, 0.2))
]
TURNED_SCARA = Chain(
    'scara',
    'modified',
    (
        Joint('one', d=0.3, lower=-2.5, upper=2.5),
        Joint('two', a=0.35, sign=-1, lower=-2.5, upper=2.5),
        Joint('three', 'prismatic', a=0.25, alpha=np.pi, sign=-1, lower=-0.3, upper=0.0),
        Joint('four', d=0.1, lower=-6.0, upper=6.0),
    ),
)


def best_compromise(compensator, command, weight):
    """Return what scipy finds to be the best joint values for one command."""

    def residual(joints):
        position, turn = pose_errors(compensator, command[None], joints[None])
        return np.concatenate([position[0], weight * turn[0]])

    options = {'xtol': 1e-15, 'ftol': 1e-15, 'gtol': 1e-15, 'x_scale': 'jac'}
    return least_squares(residual, command, **options).x


@pytest.mark.parametrize(
    'nominal', [ROBOTS['kuka_youbot'], ROBOTS['denso_hsr065'], TURNED_SCARA], ids=lambda c: c.name
)
def test_arms_of_fewer_joints_meet_the_position_and_then_the_orientation(nominal):
    assert mobility(nominal)[:2] == (len(nominal.joints), 3)
    true = faulty(nominal, CELL, np.random.default_rng(3))
    compensator = Compensator(nominal, true, tool=(0.05, -0.02, 0.1))
    q = regular(nominal, 100)
    result = compensate(compensator, q)
    kept = ~np.isnan(result.joints).any(axis=1)
    assert kept.mean() > 0.95
    position, turn = missed(compensator, q[kept], result.joints[kept])
    assert position.max() < 1e-6
    np.testing.assert_allclose(result.position[kept], position, atol=1e-12)
    np.testing.assert_allclose(result.orientation[kept], turn, atol=1e-12)
    assert turn.max() > 1e-4
    for k in np.flatnonzero(kept)[:3]:
        best = best_compromise(compensator, q[k], 1e-3)
        np.testing.assert_allclose(result.joints[k], best, atol=1e-6)


@pytest.mark.parametrize('nominal', PLANAR, ids=lambda chain: len(chain.joints))
def test_a_planar_arm_is_corrected_in_its_plane_and_the_rest_is_told(nominal):
    assert mobility(nominal)[1:] == (2, 1)
    true = faulty(nominal, CELL, np.random.default_rng(3))
    q = 0.95 * nominal.random_joints(200, np.random.default_rng(0))
    q = q[np.abs(np.sin(q[:, 1])) > 0.3]  # the first two links are not in one line
    compensator = Compensator(nominal, true, largest_orientation_error=0.1)
    result = compensate(compensator, q)
    assert result.refusals == ()
    before, after = (pose_errors(compensator, q, each)[0] for each in (q, result.joints))
    assert np.abs(before[:, :2]).max() > 1e-3
    assert np.abs(after[:, :2]).max() < EXACT
    np.testing.assert_allclose(result.position, np.abs(after[:, 2]), atol=1e-9)
    np.testing.assert_allclose(result.reachable, 0.0, atol=EXACT)
    turned = pose_errors(compensator, q, result.joints)[1][:, 2]
    if len(nominal.joints) > 2:
        assert np.abs(turned).max() < 1e-4
        moved = numeric_jacobian(true, result.joints)[:, [0, 1, 5]]
        idle = np.linalg.svd(moved)[2][:, 3:]
        share = np.einsum('nki,ni->nk', idle, result.correction)
        assert np.abs(share).max(initial=0.0) < 1e-4
    told = f'{1e3 * np.abs(after[:, 2]).max():.3f} mm are left that no joint can correct'
    assert told in in_words(compensator, result)
    strict = compensate(replace(compensator, largest_position_error=1e-5), q)
    assert 'this arm cannot reach every pose' in strict.refusals[0].reason
    assert 'more than 0.01 mm or 100 mrad' in strict.refusals[0].reason


def test_of_errors_in_the_plane_nothing_is_left_across_it():
    nominal = PLANAR[1]
    errors = {f'{joint.name}.{kind}': 1e-3 for joint in nominal.joints for kind in ('a', 'theta')}
    compensator = Compensator(nominal, nominal.with_offsets(errors))
    q = 0.95 * nominal.random_joints(200, np.random.default_rng(0))
    result = compensate(compensator, q[np.abs(np.sin(q[:, 1])) > 0.3])
    assert 0.0 < result.position.max() < EXACT
    assert ' 0.000 mm are left that no joint can correct' in in_words(compensator, result)


def test_a_planar_arm_stretched_out_is_singular():
    nominal = PLANAR[0]
    true = faulty(nominal, CELL, np.random.default_rng(3))
    result = compensate(Compensator(nominal, true), np.array([[0.3, 1e-4]]))
    assert 'near a singularity' in only_refusal(result).reason


def test_a_scara_on_a_rail_spends_no_idle_motion_on_tilts_of_thousandths():
    rail = Joint('rail', 'prismatic', alpha=np.pi / 2, lower=0.0, upper=2.0)
    first = replace(TURNED_SCARA.joints[0], alpha=-np.pi / 2)
    nominal = Chain('rail', 'modified', (rail, first, *TURNED_SCARA.joints[1:]))
    assert mobility(nominal) == (4, 3, 1)
    true = faulty(nominal, CELL, np.random.default_rng(3))
    q = 0.9 * nominal.random_joints(100, np.random.default_rng(0))
    compensator = Compensator(nominal, true)
    result = compensate(compensator, q)
    kept = ~np.isnan(result.joints).any(axis=1)
    assert kept.mean() > 0.95
    q, joints = q[kept], result.joints[kept]
    position, turn = pose_errors(compensator, q, joints)
    assert np.abs(position).max() < 1e-8
    axis = bare(nominal).forward(q)[:, :3, 2]
    assert np.abs(np.einsum('ni,ni->n', axis, turn)).max() < 2e-5
    assert np.linalg.norm(turn, axis=1).max() > 1e-3


def test_the_weight_of_orientation_is_the_users():
    nominal = ROBOTS['kuka_youbot']
    true = faulty(nominal, CELL, np.random.default_rng(3))
    q = regular(nominal, 5)
    compensator = Compensator(nominal, true, orientation_weight=0.3, largest_position_error=1e-2)
    result = compensate(compensator, q)
    for command, joints in zip(q, result.joints, strict=True):
        best = best_compromise(compensator, command, 0.3)
        np.testing.assert_allclose(joints, best, atol=1e-6)
    first = compensate(replace(compensator, orientation_weight=None), q)
    assert (result.orientation < first.orientation).all()
    assert (result.position > first.position).all()


def test_an_arm_of_five_joints_says_what_its_tool_loses():
    """The flange keeps its place by turning: what sits beside it is off by more than before."""
    nominal = ROBOTS['kuka_youbot']
    true = faulty(nominal, CELL, np.random.default_rng(3))
    q = nominal.random_joints(60, np.random.default_rng(4))
    compensator = Compensator(nominal, true, largest_orientation_error=0.1)
    result = compensate(compensator, q)
    kept = ~np.isnan(result.joints).any(axis=1)
    turn, turned = result.orientation[kept].max(), result.orientation_before[kept].max()
    assert turn > turned
    words = in_words(compensator, result)
    assert 'at the point 0 0 0 m in the flange (--tool)' in words
    assert f'{100.0 * turn:.3f} mm off, {100.0 * turned:.3f} mm before' in words
    compensator = Compensator(UR, UR_TRUE)
    assert '--tool' not in in_words(compensator, compensate(compensator, regular(UR, 10)))


def test_a_position_met_is_not_refused_for_an_orientation_that_hardly_converges():
    """Of arms that cannot keep it: it is as near as it gets, and within what is tolerated."""
    nominal = ROBOTS['kuka_youbot']
    rng = np.random.default_rng(1)
    true = faulty(nominal, CELL, rng)
    command = nominal.random_joints(300, rng)
    compensator = Compensator(nominal, true, (0.0, 0.0, 0.1), largest_change=1e9)
    result = compensate(compensator, command)
    slow = ~result.converged & (result.orientation < 0.02)
    assert slow.any()
    assert np.isfinite(result.joints[slow]).all()
    assert result.position[slow].max() < EXACT
    for k in np.flatnonzero(slow).tolist():
        best = best_compromise(compensator, command[k], 1e-3)
        _, turn = pose_errors(compensator, command[k : k + 1], best[None])
        assert result.orientation[k] < 1.05 * np.linalg.norm(turn)
