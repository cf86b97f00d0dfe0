# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Many small problems at once, each as if it were alone."""

import numpy as np
import pytest

from calib_ros.kinematics.newton import NormalBatch, minimise_batch, solve_positive


def bent(points=None):
    """Return the normal equations of arctan(x - c) = 0, c = 0, 1, 2 ..., noting the points."""

    def linearise(x, which):
        if points is not None:
            points.append(x[0].copy())
        error = np.arctan(x - which)
        slope = 1.0 / (1.0 + (x - which) ** 2)
        return NormalBatch((slope**2)[np.newaxis], -slope * error, error[0] ** 2)

    return linearise


def by_hand(x, rounds, first, least, relative):
    """Return the points of damped steps towards arctan x = 0, and that reached."""
    damping, points = first, [x]
    for _ in range(rounds):
        error, slope = np.arctan(x), 1.0 / (1.0 + x**2)
        scale = slope**2 if relative else 1.0
        tried = x - slope * error / (slope**2 + damping * scale)
        points.append(tried)
        if abs(np.arctan(tried)) < abs(error):
            x, damping = tried, 0.1 * damping
        else:
            damping = max(10.0 * damping, least)
    return points, x


@pytest.mark.parametrize(
    ('enough', 'first', 'least'), [(None, 0.0, 1e-3), (1e-30, 1e-6, 1e-12)], ids=['all', 'some']
)
def test_steps_are_damped_tenfold_until_one_is_better(enough, first, least):
    points = []
    found = minimise_batch(bent(points), np.array([[9.0]]), enough=enough, rounds=9)
    wanted, x = by_hand(9.0, 9, first, least, enough is None)
    np.testing.assert_allclose(np.concatenate(points), wanted)
    assert found.x == pytest.approx(x)
    assert found.cost == pytest.approx(np.arctan(x) ** 2)
    assert not found.settled


def test_problems_settle_one_by_one():
    start = np.array([[0.5, 1.0, 1.5, 9.0]])
    found = minimise_batch(bent(), start)
    assert found.settled.all()
    np.testing.assert_allclose(found.x, [[0.0, 1.0, 2.0, 3.0]], atol=1e-12)
    np.testing.assert_allclose(found.cost, 0.0, atol=1e-12)
    found = minimise_batch(bent(), start, enough=0.05)
    assert found.settled.all()
    assert (found.cost <= 0.05).all()
    assert found.cost.max() > 1e-6
    found = minimise_batch(bent(), start, fall=0.999)
    assert found.settled.all()
    assert found.cost.max() > 1e-6


def test_what_is_too_long_is_given_up():
    start = np.array([[0.5, 1.5, 2.0, 3.5]])
    found = minimise_batch(bent(), start, longest=1.6)
    assert found.settled.tolist() == [True, True, False, False]  # the third has no step to take
    np.testing.assert_allclose(found.x[0, :3], [0.0, 1.0, 2.0], atol=1e-12)
    assert found.x[0, 3] < 3.5


def test_points_move_as_they_are_told():
    found = minimise_batch(bent(), np.array([[0.4]]), lambda x, step: np.maximum(x + step, 0.25))
    assert found.x == pytest.approx(0.25)


def test_systems_are_solved_as_one_by_one(rng):
    root = rng.normal(size=(5, 5, 7))
    matrix = np.einsum('ikb,jkb->ijb', root, root)
    right = rng.normal(size=(5, 7))
    wanted = [np.linalg.solve(matrix[..., k], right[:, k]) for k in range(7)]
    np.testing.assert_allclose(solve_positive(matrix, right), np.transpose(wanted), rtol=1e-6)
    matrix[..., 3] = 4.0
    with np.errstate(divide='ignore', invalid='ignore'):
        found = solve_positive(matrix, right)
    assert np.isfinite(found).all(axis=0).tolist() == [k != 3 for k in range(7)]
