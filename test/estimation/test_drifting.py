# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E, along_path
from scipy.linalg import block_diag

from calib_ros.apply.confidence import rms_interval
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.estimation.drifting import device_drift, likelihoods, together
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.quadratic_forms import QuadraticForms
from calib_ros.estimation.stops import Stops
from calib_ros.identification.identification import identify


def stops(errors, place, rng, width=5):
    """Return stops with columns of random numbers and errors (c, n), the second part white."""
    count = errors.shape[1]
    parts = [rng.normal(size=(width + 1, 3, count)) for _ in range(2)]
    parts[0][-1] = errors
    return Stops(parts, np.ones(count), place, np.arange(count, dtype=float), place)


def faded(distance, length, rng):
    """Return (3, n) errors of unit variance with the kernel of distances (n, n)."""
    root = np.linalg.cholesky(np.exp(-distance / length) + 1e-9 * np.eye(len(distance)))
    return (root @ rng.normal(size=(len(distance), 3))).T


def test_likelihoods_are_those_of_generalised_least_squares():
    """Of both parts, stops without orientation left out, and of a prior, whatever the columns."""
    rng, count = np.random.default_rng(0), 12
    units = stops(rng.normal(size=(3, count)), rng.normal(size=(count, 2)), rng)
    units.parts[1][:, :, ::3] = 0.0
    extra = rng.normal(size=(2, 5))
    part, kernel = QuadraticForms(units, extra).parts[1], units.kernel('successive', 4.0)
    seen = np.arange(count) % 3 > 0
    rows = [units.parts[1][:, :, seen].reshape(6, -1).T, units.parts[0].reshape(6, -1).T]
    rows = np.concatenate([*rows, np.pad(extra, ((0, 0), (0, 1)))])
    own, free = 3 * seen.sum(), 3 * seen.sum() - np.trace(part[3])
    variance = (part[1] ** 2).sum() / free

    def log_likelihood(covariance):
        weighed = np.linalg.solve(covariance, rows)
        matrix, vector = rows[:, :-1].T @ weighed[:, :-1], weighed[:, :-1].T @ rows[:, -1]
        squares = rows[:, -1] @ weighed[:, -1] - vector @ np.linalg.solve(matrix, vector)
        logs = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(matrix)[1]
        return -0.5 * (logs + squares)

    rest = variance * np.eye(len(rows) - own)
    alone = log_likelihood(variance * np.eye(len(rows)))
    found, sizes = likelihoods(part, kernel)
    inner = np.kron(np.eye(3), kernel[np.ix_(seen, seen)])
    for likely, (white, fading) in zip(found, sizes.T, strict=True):
        noise = white * np.eye(own) + fading * inner
        expected = log_likelihood(block_diag(noise, rest)) - alone
        assert likely == pytest.approx(expected, rel=1e-7, abs=1e-9)
        for other in (0.9, 1.1):  # the sizes are the most likely of their ratio, nearly
            less = log_likelihood(block_diag(other * noise, rest)) - alone
            assert less < expected + 0.1
    fewer, _ = likelihoods(part, kernel, rival=found.max() + 100.0)  # only up to the peak
    assert fewer.max() == found.max()
    assert 2 <= np.isfinite(fewer).sum() < len(found)


@pytest.mark.parametrize('order', ['path', 'random'])
def test_a_drift_of_the_device_is_told_from_errors_of_the_arm(order):
    """Errors of neighbours in joint space look like a drift to an arm that goes along a path."""
    for seed in range(2):
        rng, count = np.random.default_rng(seed), 96
        q = along_path(count, rng) if order == 'path' else UR10E.random_joints(count, rng)
        place = np.concatenate([np.cos(q), np.sin(q)], axis=1)
        noise, empty = 0.5 * rng.normal(size=(3, count)), stops(np.zeros((3, count)), place, rng)
        for kind, length in (('near', 1.0), ('successive', 20.0), ('successive', 5.0)):
            errors = noise + faded(empty._apart[kind], length, rng)
            units = stops(errors, place, rng)
            sizes = device_drift(QuadraticForms(units, np.zeros((0, 5))).parts[0], units)
            assert (sizes is not None) == (kind == 'successive')
            if sizes is not None:  # of 5 or 20 independent ones on each axis
                assert 0.1 < sizes[0] < 0.4
                assert 0.3 < sizes[1:].sum() < 5.0
        units = stops(noise, place, rng)
        assert device_drift(QuadraticForms(units, np.zeros((0, 5))).parts[0], units) is None


def test_an_error_of_all_poses_is_no_drift():
    """As of a wire whose zero is off, or of a soft arm by one: no frame takes it."""
    rng, count = np.random.default_rng(0), 96
    q = UR10E.random_joints(count, rng)
    errors = 1.0 + 0.5 * rng.normal(size=(3, count))
    units = stops(errors, np.concatenate([np.cos(q), np.sin(q)], axis=1), rng)
    part = QuadraticForms(units, np.zeros((0, 5))).parts[0]
    assert likelihoods(part, units.kernel('successive', 300.0))[0].max() > 20.0
    assert device_drift(part, units) is None


def test_ellipsoids_hold_the_truth_though_the_tracker_drifts():
    """The frames follow a slow drift, more than noise of the same median makes them expect."""
    covered = []
    for seed in range(1, 3):
        rng = np.random.default_rng(seed)
        true, q = faulty(UR10E, Cell(), rng), UR10E.random_joints(60, rng)
        seen = measure(true, q, rng, *NOISE)
        apart = np.abs(np.subtract.outer(np.arange(60.0), np.arange(60.0)))
        seen.positions[:] += 1e-4 * faded(apart, 20.0, rng).T
        result = identify(Problem(UR10E, seen, **SIGMAS))
        assert result.noise.shared == ('successive',)
        q = UR10E.random_joints(50, rng)
        error = (result.chain.forward(q) - true.forward(q))[:, :3, 3]
        axes = result.confidence_ellipsoid(q)
        along = np.einsum('nij,nj->ni', axes, error) / (axes**2).sum(axis=2)
        covered.append(np.mean((along**2).sum(axis=1) <= 1.0))
    assert np.mean(covered) > 0.8
    assert result.uncertainty.together == result.validation.together > 3.0


def test_the_interval_of_an_rms_holds_though_the_device_drifts():
    rng, count = np.random.default_rng(2), 96
    units = stops(np.zeros((3, count)), rng.normal(size=(count, 2)), rng)
    sizes = np.array([0.5, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0])  # over 30 stops
    alike = together(units, [count], sizes)
    assert together(units, [count], np.eye(7)[0]) == 1.0
    held = []
    for _ in range(60):
        drift = faded(units._apart['successive'], 30.0, rng).T
        errors = np.sqrt(0.5) * (rng.normal(size=(count, 3)) + drift)
        intervals = [rms_interval(errors, np.arange(count), each) for each in (alike, 1.0)]
        held.append([lower <= np.sqrt(3.0) <= upper for lower, upper in intervals])
    covered, alone = np.mean(held, axis=0)
    assert covered > 0.9
    assert alone < 0.75


def test_of_many_stops_as_many_tell_as_much_as_one_as_of_few():
    """Of some stops, in runs of twenty, most pairs would be missing."""
    rng, sizes = np.random.default_rng(0), np.array([1.0, 0.0, 0.0, 0.0, 0.3, 0.2, 0.0])
    units = stops(np.zeros((3, 20)), np.zeros((20, 1)), rng)
    units.count[:] = 2.0
    for lengths in ([100, 40], [1000, 1000]):
        apart = np.abs(np.subtract.outer(*[np.arange(max(lengths))] * 2))
        noise = 0.5 * np.eye(max(lengths)) + 0.3 * np.exp(-apart / 30.0)
        noise += 0.2 * np.exp(-apart / 100.0)
        squares = sum(np.sum(noise[:count, :count] ** 2) for count in lengths)
        assert together(units, lengths, sizes) == pytest.approx(squares / sum(lengths))
