# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The solver: its minimum, its path, its sums over blocks."""

from dataclasses import replace

import numpy as np
import pytest
from fits import NO_PRIOR, UR10E, measured_arm
from scipy.optimize import least_squares

from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.identification import leastsquares
from calib_ros.identification.identifiability import structurally_independent
from calib_ros.identification.identification import Problem, identify, residuals
from calib_ros.identification.leastsquares import (
    System,
    minimise,
    normal_equations,
    triangular_factor,
)
from calib_ros.identification.samples import BLOCK, Samples
from calib_ros.identification.start import start_frames
from calib_ros.kinematics.chain_file import load_chain


def test_the_minimum_is_that_of_an_independent_solver():
    """Hold the cost against scipy on the residual written out, with outsize errors and noise."""
    *_, seen = measured_arm(4, 50, (2e-3, 2e-2))
    result = identify(
        Problem(
            UR10E,
            seen,
            sigma_position=1e-3,
            sigma_orientation=2e-2,
            loss='none',
            priors=NO_PRIOR,
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
    start = start_frames(problem.model, problem.sets, 1e-4, 1e-4, 'none')
    names = structurally_independent(problem.model, problem.free, problem.kinds)
    return start, names, problem.system(problem.sets)


def test_a_long_curved_valley_is_followed_to_its_end():
    """Condition 3e4: the best parameters are far away, and steps must be short."""
    start, names, system = still_joint('kuka_iiwa14', 1)
    fit = minimise(start, names, system)
    assert fit.converged
    assert 50 < fit.iterations < 400
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
    monkeypatch.setattr(leastsquares, 'normal_equations', lambda *_: stuck)
    fit = minimise(start, names, system)
    assert not fit.converged
    assert fit.iterations < 200
    worse = replace(stuck, cost=2.0 * stuck.cost)
    costs = iter([stuck])
    monkeypatch.setattr(leastsquares, 'normal_equations', lambda *_: next(costs, worse))
    fit = minimise(start, names, system)
    assert not fit.converged
    assert fit.iterations < 200
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
