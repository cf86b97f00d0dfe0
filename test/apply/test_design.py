# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a design knows, and what a pose is worth by it."""

from dataclasses import replace

import numpy as np
import pytest
from designs import POSTURE, SIGMAS, arm, design_of, predicted_square, some

from calib_ros import Problem, identify, load_chain
from calib_ros.apply import planning, simulation
from calib_ros.apply.choice import Choice
from calib_ros.apply.design import (
    ASSUMED_TOOL,
    Candidates,
    Design,
    _root_of_inverse as root_of_inverse,
    accuracy,
    information_of,
    predicted,
)
from calib_ros.apply.worth import Worth
from calib_ros.errors import InputError
from calib_ros.estimation.observability import observability
from calib_ros.kinematics.jacobian import ErrorModel


@pytest.mark.parametrize(
    ('name', 'oriented', 'count'), [('ur10e', False, 27), ('puma560', True, 30)]
)
def test_gauge_freedoms_are_left_out_as_in_the_identification(name, oriented, count):
    chain = arm(name)
    design = design_of(chain, oriented)
    rng = np.random.default_rng(3)
    true = simulation.faulty(chain, simulation.Cell(), rng)
    q = some(chain, 40)
    result = identify(Problem(chain, simulation.measure(true, q, rng, *SIGMAS, oriented)))
    assert len(design.names) == count
    assert set(design.names) == set(result.names)


def test_priors_are_known_before_anything_is_measured(rng):
    chain = arm()
    seen = simulation.measure(chain, some(chain, 10), rng, *SIGMAS)
    design = Design.of(Problem(chain, seen, priors={'*_joint.a': 2e-3}))
    wanted = [500.0 if name.endswith('_joint.a') else 0.0 for name in design.names]
    np.testing.assert_allclose(design.known, np.diag(wanted), rtol=1e-12)


@pytest.mark.parametrize('oriented', [True, False])
def test_predicted_errors_are_those_of_the_identification(oriented):
    """Predicted before anything is measured, at the nominal chain, and after the fit."""
    chain = arm()
    rng = np.random.default_rng(4)
    true = simulation.faulty(chain, simulation.Cell(), rng)
    q, task = some(chain, 40), some(chain, 200, 2)
    observations = simulation.measure(true, q, rng, *SIGMAS, oriented)
    problem = Problem(chain, observations)
    result = identify(problem)
    assert result.noise.consistent
    found = by_parameters(result, task)
    known = Design.of(problem, result)
    assert predicted(known, task) == pytest.approx(found, rel=1e-6)
    assert accuracy(design_of(true, oriented), q, task)[-1] == pytest.approx(found, rel=0.02)
    more = some(chain, 10, 5)
    seen = simulation.measure(true, np.concatenate([q, more]), rng, *SIGMAS, oriented)
    both = identify(Problem(chain, seen))
    found = by_parameters(both, task) * result.noise.size / both.noise.size  # of its own noise
    assert predicted(known.after(more), task) == pytest.approx(found, rel=0.02)


def by_parameters(result, task):
    """Return the RMS error [m] at a task by the uncertainty of the fitted parameters alone."""
    rows = ErrorModel(result.chain, result.names).jacobian(task)[:, :3]
    return np.sqrt(np.einsum('ncp,pr,ncr->', rows, result.covariance, rows) / len(task))


def test_poses_to_come_have_the_noise_that_was_found():
    chain = arm()
    rng = np.random.default_rng(4)
    true = simulation.faulty(chain, simulation.Cell(), rng)
    noisy = simulation.measure(true, some(chain, 60), rng, 3e-4, 1e-3)
    problem = Problem(chain, noisy)
    design = Design.of(problem, identify(problem))
    assert design.sigma_position == pytest.approx(3e-4, rel=0.15)
    assert design.sigma_orientation == pytest.approx(1e-3, rel=0.15)


def test_the_base_frame_has_no_influence(rng):
    chain = arm()
    moved = replace(chain, base=simulation.random_frame(rng, 2.0))
    q, task = some(chain, 60), some(chain, 50, 2)
    np.testing.assert_array_equal(
        Choice(design_of(chain), q).best(20), Choice(design_of(moved), q).best(20)
    )
    found, again = (accuracy(design_of(each), q, task) for each in (chain, moved))
    np.testing.assert_allclose(found, again, rtol=1e-6)


def test_an_unknown_tool_is_taken_off_the_axis():
    """Else no position would show the last joint, and its error would be left out."""
    chain = load_chain('ur10e')
    design = design_of(chain, oriented=False)
    assert len(design.determined_by(some(chain, 50)).names) == 27
    np.testing.assert_allclose(design.chain.tool.matrix[:3, 3], ASSUMED_TOOL)


def test_parameters_that_no_candidate_shows_are_named():
    chain = arm()
    q = some(chain, 80)
    q[:, 3:] = POSTURE[3:]
    found = planning.plan(design_of(chain), q, some(chain, 50, 2), 20)
    rng = np.random.default_rng(0)
    result = identify(Problem(chain, simulation.measure(chain, q, rng, *SIGMAS)))
    assert found.lacking
    assert set(found.lacking) == set(result.not_excited)
    assert np.isfinite(found.accuracy[-1])


def test_a_covariance_that_rounding_made_singular_still_informs():
    known = np.array([[4.0, 1.0], [1.0, 2.0]])
    rows = root_of_inverse(known)
    assert rows.T @ rows == pytest.approx(np.linalg.inv(known))
    assert np.isfinite(root_of_inverse(np.ones((3, 3)))).all()


def test_priors_make_up_for_poses():
    chain = arm()
    task = some(chain, 50, 2)
    plain, helped = (design_of(chain, priors=priors) for priors in ({}, {'*_joint.*': 1e-3}))
    few = some(chain, 3)
    assert np.isinf(accuracy(plain, few, task)[-1])
    plain_formula = np.sqrt(predicted_square(helped, few, task))
    assert accuracy(helped, few, task)[-1] == pytest.approx(plain_formula, rel=1e-6)
    many = some(chain, 60)
    assert accuracy(helped, many, task)[-1] < accuracy(plain, many, task)[-1]
    assert len(Choice(helped, many).best(2)) == 2


def test_distances_are_refused():
    chain = arm()
    observations = simulation.measure(chain, some(chain, 40), np.random.default_rng(0))
    lengths = np.linalg.norm(observations.positions, axis=1)
    with pytest.raises(InputError, match='not distances'):
        Design.of(Problem(chain, replace(observations, distances=lengths)))


@pytest.mark.parametrize('criterion', ['o2', 'o3', 'o4', 'o5'])
def test_indices_are_those_of_the_report(criterion):
    design = design_of(arm())
    q = some(design.chain, 30)
    space = Candidates(design, q)
    so_far = space.known + information_of(space.rows[:12])
    worth = Worth(space, criterion, None).of(so_far, space.rows)
    rows = design.rows(np.concatenate([q[:12], q[20:21]])).reshape(-1, len(design.names))
    factor = np.linalg.qr(rows, mode='r')
    assert worth[20] == pytest.approx(observability(factor, 13)[criterion], rel=1e-5)


@pytest.mark.parametrize('oriented', [True, False])
def test_predicted_errors_equal_the_plain_formula(oriented):
    design = design_of(arm(), oriented)
    q, task = some(design.chain, 25), some(design.chain, 60, 2)
    found = accuracy(design, q, task)
    for count in (12, 25):
        plain = np.sqrt(predicted_square(design, q[:count], task))
        assert found[count - 1] == pytest.approx(plain, rel=1e-6)
    assert np.isinf(found[: 4 if oriented else 8]).all()
    assert predicted(design.after(q), task) == pytest.approx(found[-1], rel=1e-6)
    assert np.isinf(predicted(design.after(q[:3]), task))
