# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The size of the noise, and of the parameters' uncertainty, against whole matrices."""

from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E, measured_arm
from scipy import stats

from calib_ros import Observations, identify
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.estimation import noise as noise_module
from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.levels import chance_of
from calib_ros.estimation.noise import Noise, noise_of
from calib_ros.estimation.normal import normal_equations, triangular_factor
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.samples import Samples
from calib_ros.estimation.shared_errors import Shared
from calib_ros.estimation.system import Prior, System, stacked
from calib_ros.estimation.unmodelled import _variances

NAMES = [*(name for name in UR10E.parameter_names if UR10E.owns_frame(name)), 'elbow_joint.theta']


@pytest.fixture(autouse=True)
def nothing_shared(monkeypatch):
    nothing = Shared(0.1, 0.2, (), {})
    monkeypatch.setattr(noise_module, 'shared_errors', lambda *_: nothing)


def found(seen, sigmas=NOISE, weights=None, prior=None):
    """Return the noise, its uncertainty, and by hand: H, by part the squares and the freedom."""
    samples = Samples(seen, *sigmas).weighted(weights)
    system = System((samples,), prior)
    fit = minimise(UR10E, NAMES, system)
    factor = triangular_factor(fit.chain, NAMES, system)
    noise, uncertainty = noise_of(fit, NAMES, system, factor)
    rows = samples.rows_of(fit.chain, NAMES)
    parts = [stacked([each]) for each in (rows[:, :3], rows[:, 3:]) if each.size]
    matrix = factor.T @ factor
    shares = [part[:, :-1].T @ part[:, :-1] for part in parts]
    squares = np.array([part[:, -1] @ part[:, -1] for part in parts])
    number = 3.0 * (len(seen) if weights is None else weights.sum())
    freedom = np.array([number - np.trace(np.linalg.solve(matrix, each)) for each in shares])
    return noise, uncertainty, matrix, shares, squares, freedom


@pytest.mark.parametrize('part', [0, 1])
@pytest.mark.parametrize('level', [0.0005, 0.9995])
@pytest.mark.parametrize('inside', [True, False])
def test_sigmas_are_consistent_as_far_as_a_chi_squared_test_says(part, level, inside):
    """Both parts by themselves; beyond a limit the deviations are those of the noise found."""
    rng = np.random.default_rng(0)
    seen = measure(UR10E, UR10E.random_joints(30, rng), rng, *NOISE)
    sigmas = np.array(NOISE)
    for _ in range(3):  # weights of the parts change what each takes of the freedom
        *_, squares, freedom = found(seen, sigmas)
        wanted = 0.98 * freedom
        towards = 0.99 if inside == (level > 0.5) else 1.01
        wanted[part] = towards * stats.chi2.ppf(level, freedom[part])
        sigmas *= np.sqrt(squares / wanted)
    noise, uncertainty, matrix, shares, squares, freedom = found(seen, sigmas)
    assert noise.consistent is inside
    variances = squares / freedom
    sizes = np.maximum(variances, 1.0) if inside else variances
    middle = sum(size * share for size, share in zip(sizes, shares, strict=True))
    inverse = np.linalg.inv(matrix)
    expected = inverse @ middle @ inverse
    np.testing.assert_allclose(uncertainty.covariance, expected, rtol=1e-5, atol=1e-16)
    assert noise.size == pytest.approx(
        np.sqrt(np.median(np.diag(expected) / np.diag(inverse))), rel=1e-4
    )
    if inside and level < 0.5:  # the sigmas given are the larger ones: nothing was estimated
        assert uncertainty.freedom.tolist() == [np.inf]
        assert noise.size == 1.0
    else:
        estimated = np.where([not inside or size > 1.0 for size in sizes], freedom, np.inf)
        np.testing.assert_allclose(uncertainty.freedom, [*estimated, np.inf], rtol=1e-4)


def test_pairs_of_a_configuration_that_share_their_error_count_once():
    """Three of each: the sums of their residuals are three times as large as if independent."""
    rng = np.random.default_rng(1)
    once = measure(UR10E, UR10E.random_joints(40, rng), rng, *NOISE)
    first, plain, *_ = found(once)
    noise, uncertainty, _, _, squares, freedom = found(once.select(np.repeat(np.arange(40), 3)))
    np.testing.assert_allclose(squares / freedom, [noise.position**2, noise.orientation**2])
    ratio = np.diag(uncertainty.covariance) / np.diag(plain.covariance)
    # residuals of as many degrees of freedom as 120 pairs would leave are taken for the size
    np.testing.assert_allclose(np.sqrt(ratio), 1.0, atol=0.15)
    taken = 360.0 - freedom
    np.testing.assert_allclose(uncertainty.freedom[:2], 120.0 - taken, rtol=1e-6)
    assert first.size == pytest.approx(noise.size / np.sqrt(3.0), rel=0.2)


@pytest.mark.parametrize('tools', [('tool',), ('tool', 'tool_b')], ids=['visits', 'targets'])
def test_errors_of_stops_shared_by_targets_or_visits_are_no_wobble(tools):
    """Four seen at each stop: waves explained what the joints were off by there, five times."""
    shown = 0
    for seed in range(1, 4):
        rng = np.random.default_rng(seed)
        true = faulty(UR10E, Cell(), rng)
        q = rng.uniform(-2.0, 2.0, (50, 6))
        poses = true.forward(q + rng.normal(scale=1e-4, size=q.shape))
        sets = []
        for tool in tools:
            at = poses[:, :3, 3] + poses[:, :3, :3] @ rng.uniform(-0.1, 0.1, 3)
            at = np.repeat(at[np.newaxis], 4 // len(tools), axis=0).reshape(-1, 3)
            seen = np.tile(q, (4 // len(tools), 1)), at + rng.normal(scale=3e-5, size=at.shape)
            sets.append(replace(Observations.from_arrays(*seen), tool=tool))
        result = identify(Problem(UR10E, sets[0], more=sets[1:]))
        assert result.noise.size > 1.4
        assert 6e-5 < result.posterior.unmodelled.turns < 1.4e-4
        shown += result.posterior.unmodelled.shown
    assert shown <= 1


def test_a_prior_is_as_uncertain_as_it_says_whatever_the_noise():
    """Weighed by three times the noise given, its own variance is what it was."""
    rng = np.random.default_rng(3)
    seen = measure(UR10E, UR10E.random_joints(30, rng), rng, 4.0 * NOISE[0], 4.0 * NOISE[1])
    prior = Prior(UR10E, {'elbow_joint.theta': 1e-5}, noise=3.0)
    noise, uncertainty, matrix, shares, squares, freedom = found(seen, prior=prior)
    assert not noise.consistent
    middle = sum(s * v for s, v in zip(shares, squares / freedom, strict=True))
    middle[-1, -1] += (3.0 * 3.0 / 1e-5) ** 2
    inverse = np.linalg.inv(matrix)
    np.testing.assert_allclose(
        uncertainty.covariance, inverse @ middle @ inverse, rtol=1e-5, atol=1e-16
    )


def test_noise_of_covariances_is_that_of_all_components_together():
    """Whitened as a whole, position and orientation are one."""
    rng = np.random.default_rng(4)
    seen = measure(UR10E, UR10E.random_joints(30, rng), rng, NOISE[0], 2.0 * NOISE[1])
    own = np.diag(np.repeat(NOISE, 3) ** 2)
    own[3:, :3] = own[:3, 3:] = 0.3 * NOISE[0] * NOISE[1] * np.eye(3)
    seen = replace(seen, covariance=np.tile(own, (30, 1, 1)))
    noise, uncertainty, matrix, shares, squares, _ = found(seen)
    variance = squares.sum() / (180.0 - len(NAMES))
    assert noise.position == pytest.approx(np.sqrt(variance), rel=1e-6)
    assert noise.orientation is None
    np.testing.assert_allclose(sum(shares), matrix, rtol=1e-9, atol=1e-6 * matrix.max())
    expected = variance * np.linalg.inv(matrix)
    np.testing.assert_allclose(uncertainty.covariance, expected, rtol=1e-6, atol=1e-16)


def test_a_part_with_less_than_one_degree_of_freedom_tells_its_noise():
    """Weights that leave half an equation more than the parameters take of the positions."""
    *_, seen = measured_arm(5, 30)
    taken = 90.0 - found(seen)[-1]
    least = int(np.argmax(taken))
    weights = np.full(30, (taken[least] + 0.5) / 90.0)
    noise, _, _, _, squares, freedom = found(seen, weights=weights)
    assert freedom[least] == pytest.approx(0.5, abs=1e-3)
    expected = tuple(np.sqrt(squares / freedom))
    assert (noise.position, noise.orientation) == pytest.approx(expected, rel=1e-6)


def test_what_neighbours_share_is_finite_though_hardly_anything_tells_a_parameter(monkeypatch):
    """As of a joint whose only poses elsewhere are gross errors, before it has a prior."""
    rng = np.random.default_rng(0)
    seen = measure(UR10E, UR10E.random_joints(30, rng), rng, *NOISE)
    names, system = [*NAMES, 'shoulder_pan_joint.theta'], System((Samples(seen, *NOISE),))
    fit = minimise(UR10E, names[:-1], system)
    fit = replace(fit, normal=normal_equations(fit.chain, names, system))
    shared = Shared(0.5, 0.0, ('successive',), {}, {0: 4.0 * fit.normal.parts[0]}, 9.0)
    monkeypatch.setattr(noise_module, 'shared_errors', lambda *_: shared)
    factor = triangular_factor(fit.chain, names, system)  # with the base's rz it is singular
    noise, uncertainty = noise_of(fit, names, system, factor)
    assert np.isfinite(noise.widened)
    assert np.isfinite(uncertainty.shared).all()


def test_the_noise_of_either_part_is_told_from_the_products_of_rows(rng):
    """Whatever the parameters: what they explain is no noise."""
    products = []
    for size in (0.5, 3.0):
        columns = rng.normal(size=(2000, 4))
        rows = np.column_stack([columns, columns @ [9.0, -5.0, 2.0, 7.0]])
        rows[:, -1] += rng.normal(scale=size, size=2000)
        products.append(rows.T @ rows)
    found, _ = _variances(
        np.array(products), np.zeros(4), np.full(4, 1e-9), np.array([2000, 2000])
    )
    np.testing.assert_allclose(np.sqrt(found), [0.5, 3.0], rtol=0.05)


@pytest.mark.parametrize(
    ('noise', 'consistent', 'stated', 'expected'),
    [
        ((2.0, 0.5), False, {}, (2e-4, 5e-4)),
        ((2.0, None), False, {}, (2e-4, 2e-3)),
        ((2.0, 3.0), True, {}, (1e-4, 1e-3)),
        # of another device: what the arm lacks is added, but nothing taken off
        ((2.0, 0.5), False, dict(zip(SIGMAS, (3e-4, 5e-3), strict=True)), (12**0.5 * 1e-4, 5e-3)),
    ],
)
def test_new_poses_have_the_sigmas_of_the_device_and_what_the_arm_lacked(
    noise, consistent, stated, expected
):
    """Those stated then, 0.1 mm and 1 mrad, are also those of a device of which none are given."""
    *_, seen = measured_arm(0, 5)
    given = dict(zip(SIGMAS, (1e-4, 1e-3), strict=True))
    found = Noise(*noise, consistent, 0.0, 0.0, (), given=given)
    told = found.expected_in(Problem(UR10E, seen, **stated))
    assert (told.sigma_position, told.sigma_orientation) == pytest.approx(expected)


@pytest.mark.parametrize('rank', [1, 4])
@pytest.mark.parametrize('freedom', [3.0, 40.0])
def test_chance_is_that_of_f_or_of_its_limit(rank, freedom):
    assert chance_of(9.0, rank, freedom) == pytest.approx(stats.f.sf(9.0 / rank, rank, freedom))
    assert chance_of(9.0, rank, np.inf) == pytest.approx(stats.chi2.sf(9.0, rank), rel=1e-6)
    assert chance_of(-1e-9, 0, freedom) == 1.0  # by rounding
