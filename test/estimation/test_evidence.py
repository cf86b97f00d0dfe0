# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import UR10E, arm, rms

from calib_ros import Observations, Problem, identify, load_chain
from calib_ros.apply.simulation import measure
from calib_ros.estimation import evidence
from calib_ros.estimation.considered import considered
from calib_ros.estimation.evidence import Inference, _device
from calib_ros.estimation.fitting import fit
from calib_ros.estimation.joint_errors import Unmodelled
from calib_ros.estimation.posterior import Posterior, size_group
from calib_ros.estimation.sizes import SPREAD, TYPICAL, Evidence
from calib_ros.estimation.system import System
from calib_ros.kinematics import effects, se3
from calib_ros.kinematics.parameter import Parameter

pytestmark = pytest.mark.usefixtures('unsearched')
EFFECTS = [name for group in ('eccentricity', 'gravity') for name in effects.members(UR10E, group)]


def spread(seed, reach=2.5, count=60):
    return np.random.default_rng(seed + 50).uniform(-reach, reach, (count, 6))


def problem_of(true, q, seed=0, noise=1.0, **more):
    rng = np.random.default_rng(seed + 7)
    return Problem(UR10E, measure(true, q, rng, noise * 5e-5, noise * 2e-4), **more)


@pytest.mark.parametrize(('errors', 'seed'), [(0.1, 0), (1.0, 1), (10.0, 0)])
def test_the_size_of_the_errors_is_found(errors, seed):
    true = arm(seed, errors)
    found = identify(problem_of(true, spread(seed), seed))
    assert found.accepted
    for group, lengths in (('length', True), ('angle', False)):
        offsets = [
            true.offset(name, UR10E)
            for name in found.names
            if not UR10E.owns_frame(name) and Parameter(name).is_length == lengths
        ]
        ratio = found.posterior.sizes[group] / np.sqrt(np.mean(np.square(offsets)))
        assert 0.5 < ratio < 2.0


@pytest.mark.parametrize('seed', range(2))
def test_one_gross_offset_is_not_shrunk(seed):
    true = arm(seed).with_offsets({'elbow_joint.theta': 17e-3})
    found = identify(problem_of(true, spread(seed), seed))
    parameter = next(p for p in found.parameters if p.name == 'elbow_joint.theta')
    assert abs(parameter.offset - true.offset('elbow_joint.theta', UR10E)) < 4.0 * parameter.std
    assert found.posterior.sizes['angle'] < 2e-3


def test_one_gross_offset_is_not_shrunk_where_the_poses_hardly_determine_it():
    """The elbow moved by 0.1 rad: a normal prior of the others' size would hold its offset."""
    true = arm(0, 0.3).with_offsets({'shoulder_lift_joint.theta': 17e-3})
    q = spread(0)
    q[:, 1] = -1.0 + 0.04 * q[:, 1]
    found = identify(problem_of(true, q))
    parameter = next(p for p in found.parameters if p.name == 'shoulder_lift_joint.theta')
    assert abs(parameter.offset - true.offset(parameter.name, UR10E)) < 4.0 * parameter.std
    assert abs(parameter.offset) > 14e-3


@pytest.mark.parametrize(
    ('seed', 'reach', 'least', 'most'), [(0, 2.5, 0.0, 0.01), (1, 0.15, 0.2, 2.0)]
)
def test_effects_are_of_the_usual_size_where_the_data_cannot_refute_them(seed, reach, least, most):
    found = identify(problem_of(arm(seed), spread(seed, reach), seed))
    for group in ('drive', 'gravity'):
        assert least <= found.posterior.sizes[group] / TYPICAL[group] < most


def test_effects_that_an_arm_has_are_considered_with_their_size():
    values = np.random.default_rng(3).normal(scale=3e-4, size=len(EFFECTS)).tolist()
    true = arm(0).with_effects(EFFECTS)
    true = true.with_effect_values(dict(zip(EFFECTS, values, strict=True)))
    found = identify(problem_of(true, spread(0)))
    more = {str(name) for name in considered(found.chain, found.names)}
    assert {name for name in more if '.coupling_' not in name} == set(EFFECTS)
    assert set(EFFECTS) < set(found.posterior.names)
    told = found.posterior
    assert 1e-4 < told.sizes['drive'] < 1e-3
    nearer = told.chain.with_offsets(dict(zip(told.names, told.shift, strict=True)))
    q = UR10E.random_joints(200, np.random.default_rng(1))
    assert rms(nearer, true, q) < 0.5 * rms(found.chain, true, q)


@pytest.mark.parametrize('seed', range(2))
def test_an_arm_with_harmonics_may_have_the_next_ones_too(seed):
    """In a small region two follow any wave, and all over the range made the arm 8 times worse."""
    names = [wave for name in UR10E.joint_names for wave in effects.waves(name, 7)]
    values = np.random.default_rng(seed).normal(scale=3e-4, size=len(names)).tolist()
    true = arm(seed).with_effects(names).with_effect_values(dict(zip(names, values, strict=True)))
    near = spread(seed, 0.4)
    found = identify(problem_of(true, near, seed, effects=('eccentricity',)))
    q = np.concatenate([near, UR10E.random_joints(1000, np.random.default_rng(1))])
    q = q[found.region.covers(q)]
    assert len(q) >= len(near)
    assert rms(found.chain, true, q) < rms(found.before, true, q)


@pytest.mark.parametrize('seed', range(2))
def test_a_joint_that_moves_in_outliers_only_is_told_by_its_prior(seed):
    """Without them the fit to the rest would be singular, and the noise found nonsense."""
    rng = np.random.default_rng(seed)
    q = spread(seed)
    q[15:, 0] = q[15, 0]
    problem = problem_of(arm(seed), q, seed)
    positions = problem.observations.positions
    positions[:15] += rng.normal(scale=0.05, size=(15, 3))
    seen = Observations.from_arrays(q, positions)
    result = identify(replace(problem, observations=seen))
    assert {outlier.sample for outlier in result.outliers} == set(range(15))
    rest = identify(replace(problem, observations=seen.select(np.arange(15, 60))))
    assert result.noise.position == pytest.approx(rest.noise.position, rel=1e-3)
    assert not result.accepted


def test_sizes_beside_the_likely_ones_are_weighed_by_evidence_and_by_how_unusual_they_are():
    """One group up and down at a time; a group of no size and the device's scale stay."""
    found = object.__new__(Evidence)
    found._names = ('length', 'angle', 'drive', 'scale')
    found._typical = np.log([TYPICAL['length'], TYPICAL['angle'], TYPICAL['drive'], 1.0])
    found._log_evidence = lambda tried: 0.3 * (tried - found._typical)[:, 0]
    size = np.add(found._typical, [0.5, -0.3, -50.0, 0.0])
    told = found.sigma_points(size, np.array([2.0, 8.0, 1.0, 1.0]))
    assert sum(weight for weight, _ in told) == pytest.approx(1.0)
    for k, step in ((0, 1.0), (1, 0.5)):
        (more, up), (less, down) = told[2 * k : 2 * k + 2]
        for each, sign in ((up, 1.0), (down, -1.0)):
            np.testing.assert_allclose(each[:2], (size + sign * step * np.eye(4)[k])[:2])
        ends = [((each - found._typical) / np.log(SPREAD)) ** 2 for each in (up, down)]
        likely = 0.3 * (up - down)[0] - 0.5 * (ends[0] - ends[1]).sum()
        assert more / less == pytest.approx(np.exp(likely))
        assert more + less == pytest.approx(0.5)


@pytest.mark.parametrize('scale', [0.0, 0.25, 2.5])
def test_a_rival_is_of_the_size_that_the_data_tell(scale):
    matrix = np.diag([1.0, 1e2, 1e2, 1e2, 1e6])
    mean = np.array([0.3, 1.0, -1.5, 0.4, scale])
    groups = [None, 'length', 'length', 'angle', 'scale']
    typical = {'length': 1.0, 'angle': 0.5}
    usual, other = (
        Evidence(matrix, matrix @ mean, np.zeros(5), groups, typical | {'scale': size})
        for size in (1e-2, 0.25)
    )
    odds, _, covariance = other.odds_against(usual, usual.most_probable(set())[0], set())
    assert odds > 1.0 if scale > 1.0 else odds < 1.0
    assert covariance[0, 0] == pytest.approx(1.0)  # without a prior
    size = (1.0 / covariance[4, 4] - 1e6) ** -0.5
    assert (size < 0.1, 0.1 < size < 0.5, size > 0.5) == (scale == 0.0, scale == 0.25, scale > 1.0)


def test_a_rival_that_adds_nothing_is_not_likelier_however_the_usual_sizes_were_found():
    """A search that ended at worse sizes made a slip of 5 urad e^488 times as likely as none."""
    matrix, mean = np.diag([1e4, 2e4, 5e3]), np.array([1.0, -1.5, 0.4])
    wide, typical = np.diag([1e4, 2e4, 5e3, 1e-6]), {'angle': 0.5, 'frame': 1.0}
    usual = Evidence(matrix, matrix @ mean, np.zeros(3), ['angle'] * 3, typical)
    vector, groups = np.append(matrix @ mean, 0.0), ['angle'] * 3 + ['frame']
    other = Evidence(wide, vector, np.zeros(4), groups, typical)
    for off in (-2.0, 0.0, 2.0):
        size = usual.most_probable(set())[0] + off
        assert other.odds_against(usual, size, set())[0] < 1e-3


def test_a_prior_tells_a_rival_as_much_as_a_measurement_of_zero():
    root = np.array([[1.0, 0.5, 2.0], [0.0, 3.0, 1.0], [0.0, 0.0, 0.5]])
    matrix, vector, row = root.T @ root, np.array([2.0, -1.0, 4.0]), np.diag([7.0, 0.0, 0.0])
    odds = []
    for whole, given in ((matrix, row), (matrix + row, 0.0 * row)):
        usual, other = (
            Evidence(whole, vector, np.diag(given), [None, 'length', 'scale'], sizes)
            for sizes in ({'length': 1.0, 'scale': 0.1}, {'length': 1.0, 'scale': 4.0})
        )
        odds.append(other.odds_against(usual, usual.most_probable(set())[0], set())[0])
    assert odds[0] == pytest.approx(odds[1])


def told(rng, size=3):
    names = ('base.x', 'elbow_joint.a', 'elbow_joint.theta')[:size]
    root = rng.normal(size=(size, size))
    return Posterior(
        UR10E,
        names,
        rng.normal(size=size),
        rng.normal(size=size),
        root @ root.T,
        rng.normal(size=(size, 2)),
        {'elbow_joint.a': 2.0, 'elbow_joint.theta': 0.5},
        {'length': 3e-4, 'angle': 1e-3},
    )


def test_what_is_not_measured_is_as_uncertain_as_the_tails_of_the_prior():
    """Student's t with three degrees of freedom has three times the variance of a normal one."""
    usual = Evidence(np.zeros((1, 1)), np.zeros(1), np.zeros(1), ['angle'], {'angle': 1e-3})
    size = np.log([2e-3])
    assert usual.widened(size).precision(size) ** -0.5 == pytest.approx(3.0**0.5 * 2e-3, rel=0.01)


def test_what_is_held_nominal_is_as_uncertain_as_others_are(rng):
    """The fitted parameters, before considered ones, follow; of usual size if no size is known."""
    before, slopes = told(rng), np.array([[0.5, 1.0], [-2.0, 0.0]])
    before = replace(before, sizes={'length': 3e-4})
    after = before.held_at(('wrist_1_joint.d', 'wrist_1_joint.beta'), slopes)
    assert after.names == (*before.names, 'wrist_1_joint.d', 'wrist_1_joint.beta')
    along = np.array([[0.5, -2.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0, 1.0]])
    change = after.covariance - np.pad(before.covariance, (0, 2))
    wanted = along.T @ np.diag([3e-4**2, 1e-3**2]) @ along
    np.testing.assert_allclose(change, wanted, atol=1e-15)
    mean, covariance = np.arange(4.0), np.arange(16.0).reshape(4, 4)  # the last of a wave
    names = after.names[3:]
    weight, m, c = after.with_held((0.25, mean, covariance), names, slopes)
    assert weight == 0.25
    np.testing.assert_array_equal(m, [0.0, 1.0, 2.0, 0.0, 0.0, 3.0])
    wave = [0, 1, 2, 5]
    added = np.pad(change, (0, 1))
    np.testing.assert_allclose(c[np.ix_(wave, wave)], covariance + added[np.ix_(wave, wave)])
    np.testing.assert_allclose(c[3:5], added[3:5])
    for whole, part in ((after.offsets, before.offsets), (after.shift, before.shift)):
        np.testing.assert_array_equal(whole, [*part, 0.0, 0.0])
    np.testing.assert_array_equal(after.device, [*before.device, [0.0, 0.0], [0.0, 0.0]])


def test_wider_errors_are_larger_in_every_term(rng):
    """Waves count in units of a size that grows with them, and parameters follow them."""
    root, mean = rng.normal(size=(4, 4)), rng.normal(size=4)
    covariance, usual = root @ root.T, told(rng)
    term = 0.25, mean, covariance
    before = replace(usual, mixture=(term,), unmodelled=Unmodelled(1.0, 2.0, 3.0))
    after = before.widened(2.0)
    np.testing.assert_allclose(after.square, 4.0 * before.square)
    assert after.unmodelled.sizes == {'turns': 2.0, 'tilts': 4.0, 'waves': 6.0}
    more = np.zeros((4, 4))
    more[:3, 3] = more[3, :3] = followed = covariance[:3, 3]
    more[:3, :3] = 3.0 * (np.outer(followed, followed) / covariance[3, 3] + before.square)
    assert after.rival is None
    for weight, found, wider in (*after.mixture, replace(before, rival=term).widened(2.0).rival):
        assert weight == 0.25
        np.testing.assert_allclose(found, [*mean[:3], 0.5 * mean[3]])
        np.testing.assert_allclose(wider, covariance + more)


def test_the_expected_error_is_that_of_shift_and_covariance(rng):
    """By central differences; and what share of its variance a prior has is that of both."""
    found = told(rng)
    q = UR10E.random_joints(2, rng)
    columns = []
    for name in found.names:
        less, more = (UR10E.with_offsets({name: step}).forward(q) for step in (-1e-6, 1e-6))
        turn = se3.log_rotation(more[:, :3, :3] @ np.swapaxes(less[:, :3, :3], 1, 2))
        columns.append(np.concatenate([(more - less)[:, :3, 3], turn], axis=1) / 2e-6)
    rows = np.stack(columns, axis=2)
    square = found.covariance + np.outer(found.shift, found.shift)
    expected = np.einsum('nip,pq,njq->nij', rows, square, rows)
    np.testing.assert_allclose(found.expected(q), expected, rtol=0, atol=1e-6)
    assert found.prior_share('base.x') == 0.0
    assert found.prior_share('elbow_joint.theta') == pytest.approx(found.covariance[2, 2] / 0.25)


def test_a_fit_is_weighed_with_the_likeliest_sizes_alone():
    fitted = fit(problem_of(arm(0), spread(0, count=10)))
    found = Inference(fitted, 2.0).likeliest()
    stds = np.array([found.priors.get(name, np.inf) for name in found.names])
    whole = fitted.products[:-1, :-1] / 2.0**2 + np.diag(stds**-2.0)
    left = found.covariance @ whole - np.eye(len(whole))
    scale = np.sqrt(np.diag(whole))
    np.testing.assert_allclose(left / scale * scale[:, np.newaxis], 0.0, atol=1e-6)


def test_errors_are_of_one_size_by_group():
    for name, group in (
        ('base.x', None),
        ('elbow_joint.a', 'length'),
        ('elbow_joint.beta', 'angle'),
        ('elbow_joint.ratio', 'drive'),
        ('elbow_joint.sin_1', 'drive'),
        ('wrist_1_joint.coupling_elbow_joint', 'coupling'),
        ('elbow_joint.gravity_wrist_1_joint', 'gravity'),
    ):
        assert size_group(UR10E, name) == group


def test_what_another_device_adds_is_what_marginalising_leaves(rng):
    """With a scale of its own and smooth errors, against the inverse of the whole matrix."""
    count, size = 4, 7  # a scale, and two smooth errors after the arm's parameters
    rows = rng.normal(size=(40, size))
    whole = rows.T @ rows
    precision = rng.uniform(0.5, 2.0, count + 1)
    inner = count + 1
    cross, doubtful = whole[:inner, inner:], whole[inner:, inner:] + np.eye(2)
    matrix = whole[:inner, :inner]
    found = _device(matrix, cross, doubtful, precision, count)
    full = np.block([[matrix + np.diag(precision), cross], [cross.T, doubtful]])
    alone = np.linalg.inv(full[:count, :count])
    expected = np.linalg.inv(full)[:count, :count] - alone
    np.testing.assert_allclose(found @ found.T, expected, rtol=1e-9, atol=1e-12)


def test_only_what_is_fitted_is_doubted(monkeypatch):
    """Of joint values that were rounded, those whose parameters are not fitted tell nothing."""

    class AskedError(Exception):
        pass

    def some_products(chain, names, system, nuisances, noise):
        assert (noise, nuisances.sizes) == (2.0, {'elbow_joint.theta': 1e-3})
        raise AskedError

    monkeypatch.setattr(evidence, 'nuisance_products', some_products)
    rounding = {'elbow_joint.theta': 1e-3, 'wrist_1_joint.theta': 2e-3}
    problem = SimpleNamespace(model=UR10E, given={}, sigma_scale=0.0)
    names = ('base.x', 'elbow_joint.theta')
    fitted = SimpleNamespace(problem=problem, names=names, chain=UR10E, system=System(()))
    with pytest.raises(AskedError):
        evidence.Inference(fitted, 2.0, rounding=rounding).judging()


def test_positions_hold_where_the_travel_of_a_rail_is_off():
    """By 0.3 mm in a metre: gears without errors do not tell how good a rack is."""
    chain, inside = load_chain('ur10e_on_linear_axis'), []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        true = replace(arm(seed, 0.2, chain), effects=(('linear_axis_joint.ratio', 3e-4),))
        q = chain.random_joints(260, rng)
        found = identify(Problem(chain, measure(true, q[:60], rng, 5e-5, 2e-4)))
        error = (found.chain.forward(q[60:]) - true.forward(q[60:]))[:, :3, 3]
        axes = found.confidence_ellipsoid(q[60:])
        along = np.einsum('nij,nj->ni', axes, error) / (axes**2).sum(axis=2)
        inside.append((along**2).sum(axis=1) <= 1.0)
    assert np.mean(inside) > 0.95
