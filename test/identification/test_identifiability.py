# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E, fitted, measured_arm, rms
from scipy import stats

from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.identification.identifiability import (
    correlated,
    covariance,
    independent,
    observability,
    trades,
)
from calib_ros.identification.identification import identify
from calib_ros.identification.problem import Problem
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.se3 import log_rotation
from calib_ros.report.words import weakly_determined

ALIGNED = ('shoulder_lift_joint', 'elbow_joint', 'wrist_1_joint')


def assert_trades_hold(result, q, oriented=True):
    """What is left out must be the sum of its partners alone, at the joint values given."""
    rows = 6 if oriented else 3
    for name, partners in result.gauges.items():
        columns = ErrorModel(result.chain, [name, *partners]).jacobian(q)[:, :rows]
        columns = columns.reshape(-1, 1 + len(partners))
        shares = np.linalg.lstsq(columns[:, 1:], columns[:, 0], rcond=None)[0]
        left = columns[:, 0] - columns[:, 1:] @ shares
        assert np.linalg.norm(left) <= 5e-3 * np.linalg.norm(columns[:, 0])
        assert np.abs(shares).min(initial=1.0) > 1e-6


@pytest.mark.parametrize('oriented', [True, False])
def test_trades_of_a_six_axis_arm_with_its_frames(oriented, rng):
    *_, seen = measured_arm(rng, 60, oriented=oriented)
    result = identify(Problem(UR10E, seen, **SIGMAS))
    gauges = {name: set(partners) for name, partners in result.gauges.items()}
    assert gauges['wrist_3_joint.d'] == {'tool.z'}
    assert gauges['wrist_3_joint.a'] == {'tool.x'}
    assert gauges['shoulder_pan_joint.d'] == {'base.x', 'base.y', 'base.z'}  # the base is turned
    assert gauges['shoulder_pan_joint.theta'] == {'base.rx', 'base.ry', 'base.rz'}
    ends = [*UR10E.joints[-1].parameters[:4], *UR10E.joints[0].parameters[2:4]]
    turns = [] if oriented else ['tool.rx', 'tool.ry', 'tool.rz']
    assert set(result.gauges) == set(result.unidentifiable) == {*ends, *turns}
    assert result.rank == (30 if oriented else 27)
    assert not result.not_excited
    if not oriented:
        assert gauges['tool.rx'] == gauges['tool.ry'] == gauges['tool.rz'] == set()
    assert_trades_hold(result, UR10E.random_joints(100, rng), oriented)


def test_an_upright_base_trades_along_one_axis_alone(rng):
    true = replace(faulty(UR10E, Cell(), rng), base=None)
    seen = measure(true, UR10E.random_joints(60, rng), rng)
    gauges = identify(Problem(UR10E, seen)).gauges
    assert gauges['shoulder_pan_joint.d'] == ['base.z']
    assert gauges['shoulder_pan_joint.theta'] == ['base.rz']


@pytest.mark.parametrize('exact', [True, False])
def test_lengths_along_parallel_axes_trade_where_no_tilt_is_modelled(exact, rng):
    nominal = replace(UR10E, parallel=())
    true = faulty(nominal, Cell(), rng)
    if exact:
        true = replace(nominal, base=true.base, tool=true.tool)
    seen = measure(true, UR10E.random_joints(60, rng), rng, *NOISE)
    result = identify(Problem(nominal, seen, **SIGMAS))
    assert result.rank == 28
    for joint in ALIGNED[1:]:
        partners = result.gauges[f'{joint}.d']
        assert 'shoulder_lift_joint.d' in partners
        if exact:
            assert partners == ['shoulder_lift_joint.d']
    assert f'{ALIGNED[0]}.d' in result.names
    assert_trades_hold(result, UR10E.random_joints(100, rng))
    assert result.gauges['wrist_3_joint.d'] == ['tool.z']
    assert result.gauges['elbow_joint.d']


def test_a_joint_that_stands_still_trades_on_the_poses_measured(rng):
    true = faulty(UR10E, Cell(), rng)
    q = UR10E.random_joints(60, rng)
    q[:, 2] = 0.7
    result = identify(Problem(UR10E, measure(true, q, rng, *NOISE), **SIGMAS))
    assert 'elbow_joint.theta' in result.not_excited
    assert set(result.not_excited) < set(result.gauges)
    assert any('do not determine' in text for text in result.refusals)
    kept = {p.name: p.offset for p in result.parameters}
    assert all(kept[name] == 0.0 for name in result.not_excited)
    assert_trades_hold(result, q)


def test_a_fixed_partner_makes_its_trade_identifiable(rng):
    tool = replace(random_frame(rng, 0.2), fixed=True)
    nominal = replace(UR10E, tool=tool)
    true = replace(faulty(UR10E, Cell(), rng), tool=tool)
    result = identify(Problem(nominal, measure(true, UR10E.random_joints(60, rng), rng)))
    assert 'wrist_3_joint.d' in result.names
    assert not {name for name in result.gauges if name.startswith('wrist_3')}


def test_dependent_columns_by_hand():
    """Columns of a, b, a + 2 b, nothing, c: the third trades against the first two."""
    a, b, c = np.eye(3)
    matrix = np.stack([a, b, a + 2.0 * b, np.zeros(3), c], axis=1)
    factor = np.zeros((5, 5))
    factor[:3] = matrix
    names = ('a', 'b', 'sum', 'nothing', 'c')
    assert independent(factor, names) == ('a', 'b', 'c')
    assert trades(factor.T @ factor, names, ('a', 'b', 'c')) == {'sum': ['a', 'b'], 'nothing': []}
    swapped = factor[:, [2, 1, 0, 3, 4]]
    others = ('sum', 'b', 'a', 'nothing', 'c')
    assert independent(swapped, others) == ('sum', 'b', 'c')
    assert trades(swapped.T @ swapped, others, ('sum', 'b', 'c'))['a'] == ['sum', 'b']


def test_a_trade_is_named_though_a_fitted_parameter_shows_nowhere():
    """A prior keeps a parameter that no pose depends on; its column is zero."""
    a, b, _ = np.eye(3)
    factor = np.stack([a, np.zeros(3), 2.0 * a], axis=1)
    assert trades(factor.T @ factor, ('a', 'hidden', 'twice'), ('a', 'hidden')) == {'twice': ['a']}
    factor = np.stack([b, np.zeros(3), 2.0 * a], axis=1)
    assert independent(factor, ('b', 'hidden', 'a')) == ('b', 'a')


@pytest.mark.parametrize(
    ('diagonal', 'poses', 'o1', 'o2', 'o3', 'o4', 'o5'),
    [
        ((2.0, 8.0), 4, 4.0 / 2.0, 0.25, 2.0, 0.5, 1.6),
        ((1.0, 1.0, 1.0), 1, 1.0, 1.0, 1.0, 1.0, 1.0 / 3.0),
        ((10.0, 0.1, 1.0), 9, 1.0 / 3.0, 0.01, 0.1, 0.001, 1.0 / 11.1),
    ],
)
def test_observability_indices_by_hand(diagonal, poses, o1, o2, o3, o4, o5, rng):
    turned = np.linalg.qr(rng.normal(size=(len(diagonal),) * 2))[0]
    for matrix in (np.diag(diagonal), turned @ np.diag(diagonal)):
        found = observability(matrix, poses)
        assert (found.o1, found.o2, found.o3, found.o4, found.o5) == pytest.approx(
            (o1, o2, o3, o4, o5)
        )


def test_indices_of_a_problem_are_those_of_its_jacobian(rng):
    true = faulty(UR10E, Cell(), rng)
    q = UR10E.random_joints(30, rng)
    seen = measure(true, q, rng, *NOISE)
    result = identify(Problem(UR10E, seen, loss='none', **SIGMAS))
    jacobian = ErrorModel(result.chain, result.names).jacobian(q)
    jacobian = jacobian / np.repeat(NOISE, 3)[:, np.newaxis]
    singular = np.linalg.svd(jacobian.reshape(-1, result.rank), compute_uv=False)
    found = result.observability
    assert found.o1 == pytest.approx(np.exp(np.log(singular).mean()) / np.sqrt(30), rel=1e-3)
    assert found.o2 == pytest.approx(singular[-1] / singular[0], rel=1e-3)
    assert found.o3 == pytest.approx(singular[-1], rel=1e-3)
    assert found.o4 == pytest.approx(singular[-1] ** 2 / singular[0], rel=1e-3)
    assert found.o5 == pytest.approx(1.0 / (1.0 / singular).sum(), rel=1e-3)


def test_poses_in_a_corner_are_worse_by_every_index(rng):
    true = faulty(UR10E, Cell(), rng)
    wide = UR10E.random_joints(60, rng)
    narrow = 0.5 + 0.05 * wide
    first, second = (
        identify(Problem(UR10E, measure(true, q, rng, *NOISE), **SIGMAS)) for q in (wide, narrow)
    )
    for index in ('o1', 'o2', 'o3', 'o4', 'o5'):
        assert getattr(second.observability, index) < getattr(first.observability, index)
    # and so they are worse on poses elsewhere, which the names of weak parameters warn of
    unseen = UR10E.random_joints(200, rng)
    assert rms(second.chain, true, unseen) > 3.0 * rms(first.chain, true, unseen)
    assert len(second.correlated(0.9)) > len(first.correlated(0.9))
    assert not weakly_determined(first)


def test_correlated_pairs_by_hand():
    matrix = np.array([[4.0, 1.9, 0.0], [1.9, 1.0, -0.95], [0.0, -0.95, 1.0]])
    names = ('a', 'b', 'c')
    assert correlated(matrix, names, 0.9) == (
        ('a', 'b', pytest.approx(0.95)),
        ('b', 'c', pytest.approx(-0.95)),
    )
    assert correlated(matrix, names, 0.96) == ()


def test_the_covariance_of_a_factor_by_hand():
    factor = np.array([[2.0, 1.0], [0.0, 0.5]])
    normal = factor.T @ factor
    np.testing.assert_allclose(covariance(factor), np.linalg.inv(normal), rtol=1e-12)
    # noise of double size has the middle 4 H, and four times the covariance
    np.testing.assert_allclose(
        covariance(factor, 4.0 * normal), 4.0 * np.linalg.inv(normal), rtol=1e-12
    )


@pytest.fixture(scope='module')
def problems():
    """Measure the same 40 poses of one arm 80 times."""
    rng = np.random.default_rng(7)
    true = faulty(UR10E, Cell(), rng)
    q = UR10E.random_joints(40, rng)
    seen = [measure(true, q, rng, *NOISE) for _ in range(80)]
    return true, [Problem(UR10E, s, held_out=s.select([0, 1]), **SIGMAS) for s in seen]


@pytest.fixture(scope='module')
def fits(problems):
    return [fitted(problem) for problem in problems[1]]


@pytest.fixture(scope='module')
def results(problems):
    return [identify(problem) for problem in problems[1][:40]]


def test_correlations_are_those_of_repeated_measurements(fits):
    """Of estimates from 80 runs, with the joints' parameters in units of their deviations."""
    names = [name for name in fits[0].names if not name.startswith(('base', 'tool'))]
    index = [fits[0].names.index(name) for name in names]
    wanted = fits[0].covariance[np.ix_(index, index)]
    std = np.sqrt(np.diag(wanted))
    estimates = np.array([[r.chain.value(name) for name in names] for r in fits]) / std
    sampled = np.corrcoef(estimates.T)
    strongest = correlated(wanted, names, 0.5)
    assert strongest
    for first, second, value in strongest:
        # a correlation r of 80 runs spreads by (1 - r^2) / sqrt(80) = 0.08 at 0.5; 4 of that
        assert sampled[names.index(first), names.index(second)] == pytest.approx(value, abs=0.33)


def test_predicted_uncertainty_holds_the_truth(problems, results):
    """Squared distances in units of the covariance of pose and position follow chi-squared.

    Errors of one run are correlated over poses, so the tolerance is from the spread over runs.
    """
    true, _ = problems
    unseen = UR10E.random_joints(60, np.random.default_rng(8))
    truth = true.forward(unseen)
    pose, position = [], []
    for result in results:
        predicted = result.chain.forward(unseen)
        turn = log_rotation(predicted[:, :3, :3] @ np.swapaxes(truth[:, :3, :3], 1, 2))
        error = np.concatenate([predicted[:, :3, 3] - truth[:, :3, 3], turn], axis=1)
        matrix = result.pose_covariance(unseen)
        pose.append(np.einsum('ni,nij,nj->n', error, np.linalg.inv(matrix), error))
        axes = result.confidence_ellipsoid(unseen)
        along = np.einsum('nij,nj->ni', axes, error[:, :3]) / (axes**2).sum(axis=2)
        position.append((along**2).sum(axis=1))
    mean = np.mean(pose, axis=1)
    assert np.mean(mean) == pytest.approx(6.0, abs=4.0 * mean.std() / np.sqrt(len(results)))
    assert mean.std() / np.sqrt(len(results)) < 0.3
    inside = np.mean(np.array(position) <= 1.0, axis=1)
    spread = inside.std() / np.sqrt(len(results))
    assert spread < 0.015
    assert inside.mean() == pytest.approx(0.95, abs=4.0 * spread)


def test_the_ellipsoid_grows_with_its_level_and_is_orthogonal(results):
    q = UR10E.random_joints(5, np.random.default_rng(9))
    small, large = (results[0].confidence_ellipsoid(q, level) for level in (0.5, 0.99))
    ratio = np.sqrt(stats.chi2.ppf(0.99, 3) / stats.chi2.ppf(0.5, 3))
    np.testing.assert_allclose(
        np.linalg.norm(large, axis=2), ratio * np.linalg.norm(small, axis=2), rtol=1e-9
    )
    products = large @ np.swapaxes(large, 1, 2)
    lengths = np.einsum('nii->ni', products)
    np.testing.assert_allclose(
        products - lengths[:, :, None] * np.eye(3), 0.0, atol=1e-6 * lengths.max()
    )
