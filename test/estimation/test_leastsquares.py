# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The solver: its minimum, its path, its sums over blocks."""

from dataclasses import replace

import numpy as np
import pytest
from fits import NO_PRIOR, UR10E, measured_arm
from scipy.optimize import least_squares

from calib_ros import Problem, identify, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.decision.residuals import residuals
from calib_ros.estimation import leastsquares
from calib_ros.estimation.identifiability import structurally_independent
from calib_ros.estimation.leastsquares import leave_fold_out, minimise
from calib_ros.estimation.normal import Normal, normal_equations, triangular_factor
from calib_ros.estimation.samples import BLOCK, Samples
from calib_ros.estimation.start import start_frames
from calib_ros.estimation.system import Prior, System
from calib_ros.kinematics.se3 import HALF_THE_DIGITS


def test_the_minimum_is_that_of_an_independent_solver():
    """Hold the cost against scipy on the residual written out, with outsize errors and noise."""
    *_, seen = measured_arm(4, 50, (2e-3, 2e-2))
    result = identify(
        Problem(
            UR10E, seen, sigma_position=1e-3, sigma_orientation=2e-2, loss='none', priors=NO_PRIOR
        )
    )

    def weighted(x):
        left = residuals(result.before.with_offsets(dict(zip(result.names, x, strict=True))), seen)
        return np.concatenate([left.position.ravel() / 1e-3, left.orientation.ravel() / 2e-2])

    other = least_squares(weighted, np.zeros(result.rank), x_scale='jac', xtol=1e-14, gtol=1e-14)
    left = weighted([result.chain.offset(name, result.before) for name in result.names])
    assert left @ left == pytest.approx(2.0 * other.cost, rel=1e-10)


def still_joint(name, seed):
    """Return a start and its system: a joint within 0.3 mrad, positions of 0.5 mm noise."""
    nominal, rng = load_chain(name), np.random.default_rng(seed)
    q = rng.uniform(-2.5, 2.5, (60, len(nominal.joints)))
    q[:, 1] = 1.0 + rng.uniform(-3e-4, 3e-4, 60)
    seen = measure(faulty(nominal, Cell(), rng), q, rng, 5e-4, oriented=False)
    problem = Problem(nominal, seen)
    start = start_frames(replace(problem, loss='none'))
    names = structurally_independent(problem.model, problem.free, problem.sets)
    return start, names, problem.system(problem.sets)


def test_a_long_curved_valley_is_followed_to_its_end():
    """Condition 3e4: the best parameters are far away, and steps must be short."""
    start, names, system = still_joint('kuka_iiwa14', 1)
    fit = minimise(start, names, system, iterations=400)
    assert fit.converged
    early = minimise(start, names, system, iterations=50)
    assert not early.converged
    assert fit.normal.cost < (1.0 - 1e-3) * early.normal.cost
    again = normal_equations(fit.chain, names, system)
    left = np.linalg.solve(again.matrix, again.gradient)
    assert left @ again.gradient < 1e-9 * again.cost


def test_steps_that_go_to_and_fro_are_damped(monkeypatch):
    """Undamped steps on x^2 + (1 + 0.6 x^2)^2 end in going from x to -x and back."""
    start, names, system = still_joint('ur10e', 0)
    real = normal_equations(start, names[:1], system)

    def equations(chain, *_):
        x = chain.offset(names[0], start) + 0.5
        left, slope = 1.0 + 0.6 * x**2, 1.2 * x
        matrix, gradient = np.array([[1.0 + slope**2]]), np.array([-x - left * slope])
        return replace(real, matrix=matrix, gradient=gradient, cost=x**2 + left**2)

    monkeypatch.setattr(leastsquares, 'normal_equations', equations)
    fit = minimise(start, names[:1], system)
    assert fit.converged
    assert fit.chain.offset(names[0], start) == pytest.approx(-0.5, abs=1e-4)


def test_a_fit_without_progress_ends_and_says_so(monkeypatch):
    start, names, system = still_joint('ur10e', 0)
    stuck = normal_equations(start, names, system)
    costs = iter(200 * [stuck])
    monkeypatch.setattr(leastsquares, 'normal_equations', lambda *_: next(costs))
    assert not minimise(start, names, system).converged
    worse = replace(stuck, cost=2.0 * stuck.cost)
    costs = iter([stuck, *199 * [worse]])
    monkeypatch.setattr(leastsquares, 'normal_equations', lambda *_: next(costs))
    fit = minimise(start, names, system)
    assert not fit.converged
    assert fit.chain is start


@pytest.mark.parametrize('value', [np.nan, np.inf])
def test_a_fit_whose_numbers_end_stays_where_it_is(value, monkeypatch):
    start, names, system = still_joint('ur10e', 0)
    ended = normal_equations(start, names, system)
    ended = replace(ended, matrix=value * ended.matrix)
    monkeypatch.setattr(leastsquares, 'normal_equations', lambda *_: ended)
    fit = minimise(start, names, system)
    assert not fit.converged
    assert fit.chain is start


def test_normal_equations_and_triangular_factor_agree_over_blocks():
    _, true, seen = measured_arm(12, 2 * BLOCK + 7, (1e-4, 1e-4))
    names = UR10E.parameter_names
    system = System((Samples(seen, 1e-4, 3e-4),))
    normal = normal_equations(true, names, system)
    factor = triangular_factor(true, names, system)
    scale = np.sqrt(np.diag(normal.matrix))
    difference = (factor.T @ factor - normal.matrix) / np.outer(scale, scale)
    assert np.abs(difference).max() < 1e-12
    left = residuals(true, seen)
    cost = ((left.position / 1e-4) ** 2).sum() + ((left.orientation / 3e-4) ** 2).sum()
    assert normal.cost == pytest.approx(cost, rel=1e-10)
    few = System((Samples(seen.select(np.arange(2)), 1e-4, 3e-4),))  # fewer rows than parameters
    factor, matrix = triangular_factor(true, names, few), normal_equations(true, names, few).matrix
    assert factor.shape == matrix.shape
    np.testing.assert_allclose(factor.T @ factor, matrix, atol=1e-12 * scale.max() ** 2)


def test_the_factor_of_no_poses_is_zero_without_complaints_of_lapack(capfd):
    """Of a new target with one pose, left out in turn, an operator read 'illegal value'."""
    _, true, seen = measured_arm(12, 3)
    none = System((Samples(seen.select(np.s_[:0]), 1e-4, 3e-4),))
    assert not triangular_factor(true, UR10E.parameter_names, none).any()
    assert capfd.readouterr() == ('', '')


def dampings(monkeypatch, gains):
    """Return the dampings of steps, with costs lowered by these gains, in units foreseen."""
    start, names, system = still_joint('ur10e', 0)
    real, solve = normal_equations(start, names[:1], system), leastsquares.solved_step
    used, left, cost, foreseen = [], [*gains], 1e8, 0.0
    best = cost

    def equations(*_):
        nonlocal cost, best
        cost = best - left.pop(0) * foreseen if used else cost
        best = min(best, cost)
        return replace(real, matrix=np.eye(1), gradient=np.full(1, 500.0), cost=cost)

    def solved(matrix, gradient, damping=0.0):
        nonlocal foreseen
        step = solve(matrix, gradient, damping)
        foreseen = float(step @ (2.0 * gradient - matrix @ step))
        if damping:
            used[-1] = damping
        else:
            used.append(damping)
        return step

    monkeypatch.setattr(leastsquares, 'normal_equations', equations)
    monkeypatch.setattr(leastsquares, 'solved_step', solved)
    minimise(start, names[:1], system, iterations=len(gains))
    return np.array(used) / HALF_THE_DIGITS


def test_steps_are_damped_as_nielsen_does(monkeypatch):
    """Twice, four times, ... as much where they fail, else by the gain over the one foreseen."""
    found = dampings(monkeypatch, [*[-1.0] * 7, 0.75, -1.0, 1.0, 0.5, 0.0, 1.0])
    assert found[:4].tolist() == [0.0] * 4
    expected = np.cumprod([1.0, 4.0, 8.0, 16.0, 1.0 - 0.5**3, 2.0, 1.0 / 3.0, 1.0, 2.0])
    np.testing.assert_allclose(found[4:], expected, rtol=1e-6)


@pytest.mark.parametrize(
    ('gains', 'first'),
    [('llllll', 4), ('ssssss', 6), ('mmmmmm', 6), ('llslllll', 7), ('fffff', 4), ('ffmfffff', 7)],
)
def test_steps_that_gain_less_than_armijo_asks_for_are_damped(gains, first, monkeypatch):
    """Once patience has ended, which a step that gains enough renews."""
    sizes = {'f': -1.0, 'l': 0.5e-4, 's': 2e-4, 'm': 0.9}
    found = dampings(monkeypatch, [sizes[each] for each in gains])
    assert np.flatnonzero(np.append(found, 1.0))[0] == first


@pytest.mark.parametrize(('checked', 'sigma'), [(0.0, 1e-4), (2e-5, 3e-5)])
def test_rows_of_priors_and_separations_are_central_differences(checked, sigma):
    rng = np.random.default_rng(0)
    nominal = UR10E
    for name in ('base_A', 'base_B'):
        nominal = nominal.with_frame(name, random_frame(rng, 1.0))
    names = ['base_A.z', 'elbow_joint.theta', 'base_B.x', 'base_B.y', 'base_A.rx', 'elbow_joint.a']
    prior = Prior(nominal, {'elbow_joint.theta': 2e-3, 'elbow_joint.a': 1e-3}, noise=3.0)
    system = System((), prior, (('base_A', 'base_B', 1.5),), checked)
    chain = nominal.with_offsets({'elbow_joint.theta': 4e-3, 'elbow_joint.a': -2e-3})
    rows, left = system.extra_rows(chain, names)
    ends = [chain.frame(name).matrix[:3, 3] for name in ('base_A', 'base_B')]
    apart = (1.5 - np.linalg.norm(ends[1] - ends[0])) / sigma
    np.testing.assert_allclose(left, [0.0, -6.0, 0.0, 0.0, 0.0, 6.0, apart])
    for k, name in enumerate(names):
        less, more = (
            system.extra_rows(chain.with_offsets({name: step}), names)[1] for step in (-1e-6, 1e-6)
        )
        np.testing.assert_allclose(rows[:, k], (less - more) / 2e-6, rtol=1e-6, atol=1e-3)


def test_a_fold_left_out_is_a_fit_to_the_others():
    """Near the fit to all by one step of it, else on the samples themselves."""
    _, true, seen = measured_arm(3, 24)
    names = [name for name in UR10E.parameter_names if UR10E.owns_frame(name)]
    prior = Prior(true, {'base.x': 1e-4})
    folds = [np.arange(14) % 3, np.arange(10) % 2]
    for wrong in (0.0, 0.5):  # [m] by which one sample is off
        seen.positions[23, 0] += wrong
        parts = [seen.select(np.arange(14)), seen.select(np.arange(14, 24))]
        system = System(tuple(Samples(each, 1e-4, 3e-4) for each in parts), prior)
        start = minimise(true, names, system).chain
        found = list(leave_fold_out(start, names, system, folds))
        assert len(found) == 3
        for k, chain in enumerate(found):
            alone = minimise(start, names, system.select([each != k for each in folds])).chain
            away = [chain.offset(name, alone) for name in names]
            assert np.abs(away).max() < (6e-6 if wrong else 1e-8)  # steps are small, or refined


@pytest.mark.parametrize('scale', [1.0, 1e-6])
def test_the_factor_is_refused_where_the_normal_matrix_has_lost_its_digits(scale):
    start, _, system = still_joint('ur10e', 0)
    normal = normal_equations(start, ['base.x', 'base.y', 'base.z'], system)
    skewed = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, scale]])
    matrix = skewed.T @ normal.matrix @ skewed
    factor = replace(normal, matrix=matrix).factor()
    assert (factor is None) is (scale < 1.0)
    if factor is not None:
        np.testing.assert_allclose(factor.T @ factor, matrix, rtol=1e-9)
    for value in (np.nan, np.inf, 0.0):
        assert replace(normal, matrix=value * np.eye(3)).factor() is None


def test_equations_after_a_step_are_those_of_the_moved_chain():
    start, _, system = still_joint('ur10e', 0)
    start = start.with_offsets({'base.y': 1e-3})  # where the gradient is not zero
    step = {'base.x': 1e-3, 'base.y': -2e-3, 'base.z': 5e-4}
    system = replace(system, prior=Prior(start, {'base.x': 1e-3}, 2.0))
    after = normal_equations(start, [*step], system).after(np.array([*step.values()]))
    found = normal_equations(start.with_offsets(step), [*step], system)
    for name in ('matrix', 'gradient', 'cost', 'products'):
        np.testing.assert_allclose(getattr(after, name), getattr(found, name), rtol=1e-9)


def test_a_step_that_explains_all_leaves_no_negative_cost():
    """By rounding, as of a device that was moved by metres; its root was not a number."""
    nearly = np.nextafter(1.0, 0.0)
    assert Normal(np.eye(1), np.ones(1), nearly, np.zeros((2, 2, 2))).after(np.ones(1)).cost == 0.0


@pytest.mark.parametrize('seed', range(6))
def test_a_fit_knows_how_long_its_next_step_would_be(seed):
    """At most: a fit that is started again has no steps to conclude from."""
    *_, seen = measured_arm(seed, 40)
    problem = Problem(UR10E, seen)
    names = structurally_independent(problem.model, problem.free, problem.sets)
    system = problem.system(problem.sets)
    found = minimise(start_frames(problem), names, system, tolerance=1e-2)
    assert found.next_step_rms < 0.1 * 1e-2
    assert (
        minimise(found.chain, names, system, tolerance=np.inf).next_step_rms < found.next_step_rms
    )
