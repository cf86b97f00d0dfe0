# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Weights, distances and second fits of a robust fit, one by one."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E, measured_arm, rms, spoiled
from scipy import special, stats

from calib_ros.apply.simulation import measure
from calib_ros.estimation import gross_errors, robust
from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.samples import Samples
from calib_ros.estimation.system import System
from calib_ros.estimation.weights import INNER, OUTER, distances_of, weights_of
from calib_ros.kinematics import se3


@pytest.mark.parametrize(('least', 'steep'), [(0.0, 2.0), (0.0, 20.0), (1.976, -1.94)])
def test_weights_that_swing_or_creep_come_to_rest(least, steep, monkeypatch):
    """A pose that comes near without weight, and goes far with it, has no rest at either end.

    Steep, it is far with any weight that halves leave: they go round and round. A pose that comes
    a little nearer the more it weighs moves 3 % of its way at a time.
    """
    _, true, seen = measured_arm(0, 40)
    system = Problem(UR10E, seen, **SIGMAS).system([seen])
    weight = 1.0

    def minimised(chain, names, weighted, *_):
        nonlocal weight
        weight = float(weighted.sets[0].weights[0]) ** 2
        return minimise(chain, names, weighted)

    def far(*_):
        distances = np.ones(40)
        distances[0] = INNER + least + steep * weight
        return (distances,)

    monkeypatch.setattr(robust, 'minimise', minimised)
    monkeypatch.setattr(robust, 'distances_of', far)
    found = robust.reweighted(true, ['tool.x'], system, 'redescending')
    assert found.settled
    rest = (OUTER - INNER - least) / (OUTER - INNER + steep)
    assert weight == pytest.approx(rest, abs=1e-3)


def test_the_weights_are_those_of_the_losses():
    distance = np.array([0.0, 1.0, INNER, 0.25 * INNER + 0.75 * OUTER, OUTER, 2.0 * OUTER])
    np.testing.assert_array_equal(weights_of(distance, 'none'), 1.0)
    np.testing.assert_allclose(weights_of(distance, 'redescending'), [1, 1, 1, 0.25, 0, 0])
    bounded = weights_of(distance, 'huber')
    np.testing.assert_allclose(bounded * np.maximum(distance, INNER), INNER)


@pytest.mark.parametrize('dimensions', [3, 1])
def test_distances_are_lengths_in_standard_deviations(dimensions):
    """Of Gaussian errors half are below their median; one is 20 standard deviations long."""
    rng = np.random.default_rng(0)
    seen = measure(UR10E, UR10E.random_joints(2001, rng), rng)
    away, turns = 1e-3 * rng.normal(size=(2, 2001, 3))
    away[0], turns[0], away[1], turns[1] = [0.0, 0.02, 0.0], 0.0, 0.0, [0.0, 0.0, 0.03]
    part = np.arange(2001) < 1500
    seen = replace(
        seen,
        positions=seen.positions + away,
        rotations=se3.exp_rotation(turns) @ seen.rotations,
        oriented=part,
    )
    if dimensions == 1:
        along = away[:, 0] + np.linalg.norm(seen.positions - away, axis=1)
        along[0] += 0.02
        seen = replace(seen, distances=along, oriented=np.zeros(2001, dtype=bool))
    (found,) = distances_of(UR10E, ['tool.x'], System((Samples(seen, 1e-4, 7e-4),)))
    assert found[0] == pytest.approx(20.0, rel=0.05)
    if dimensions == 1:
        expected = np.abs(away[2:, 0]) / 1e-3
    else:
        assert found[1] == pytest.approx(30.0, rel=0.05)
        position, turn = (np.linalg.norm(each[2:], axis=1) / 1e-3 for each in (away, turns))
        expected = np.maximum(position, np.where(part[2:], turn, 0.0))
    np.testing.assert_allclose(found[2:], expected, rtol=0.05, atol=1e-6)


@pytest.mark.parametrize(('out', 'share'), [(2, 0.3), (5, 0.05), (5, 0.6), (0, 0.3), (1, 0.999)])
def test_the_chance_of_leaving_so_many_out_is_that_of_the_f_test(out, share, monkeypatch):
    """Chernoff's bound is above the tail of the beta distribution, and not by far."""
    system = SimpleNamespace(rows=90, count=30)
    normal = SimpleNamespace(cost=200.0 * share)
    second = SimpleNamespace(outliers=np.arange(30) < out, fit=SimpleNamespace(normal=normal))
    least = SimpleNamespace(normal=SimpleNamespace(cost=200.0))
    monkeypatch.setattr(gross_errors, 'minimise', lambda *_, **__: least)
    names = ['a', 'b', 'c', 'd']
    found = gross_errors.chance_of_outliers(second, None, names, system, 90 - 3)
    spare, shifts = 0.5 * (90 - 3 - 3 * out), 0.5 * 3 * out
    if not out or share > 0.99:  # all of them, or more than left out by chance
        assert found == (1.0 if out else 0.0)
        return
    ways = special.comb(30, out) * stats.beta.cdf(share, spare, shifts)
    assert min(ways, 1.0) <= found <= min(60.0 * ways, 1.0)
    mean = spare / (spare + shifts)
    tail = (share / mean) ** spare * ((1.0 - share) / (1.0 - mean)) ** shifts
    assert found == pytest.approx(min(special.comb(30, out) * tail, 1.0), rel=1e-9, abs=0.0)
    second.fit.normal.cost = 0.0  # too small for a float
    assert 0.0 <= gross_errors.chance_of_outliers(second, None, names, system, 90 - 3) < 1e-200


def test_a_good_start_is_not_left_for_a_fit_that_gross_errors_mislead():
    """By errors of 5 to 50 m least squares led 0.2 to 1.6 m away, in 6 of 6 sessions."""
    rng, true, clean = measured_arm(0, 20)
    seen, _ = spoiled(clean, rng, 0.1, shift=(5.0, 50.0), turn=(0.1, 3.0))
    system = System((Samples(seen, *NOISE),))
    names = [n for n in UR10E.parameter_names if n.kind == 'theta' or UR10E.owns_frame(n)]
    names = [n for n in names if not n.owner.startswith(('shoulder_pan', 'wrist_3'))]
    start = true.with_offsets(dict.fromkeys(names, 1e-3))
    found = robust.robust_fit(start, names, system, 'huber')
    assert rms(found.fit.chain, true, UR10E.random_joints(50, rng)) < 2e-4


@pytest.mark.parametrize('loss', ['redescending', 'huber'])
def test_a_robust_fit_starts_from_least_absolute_lengths(loss, monkeypatch):
    """One more reweighting by 1 / distance hardly moves the start of the last phase."""
    rng, true, clean = measured_arm(1, 80)
    seen, _ = spoiled(clean, rng, 0.45, shift=(0.1, 1.5), turn=(0.1, 2.0))
    system = System((Samples(seen, *NOISE),))
    names = [name for name in UR10E.parameter_names if UR10E.owns_frame(name)]
    starts, reweighted = [], robust.reweighted

    def kept(chain, *arguments):
        starts.append(chain)
        return reweighted(chain, *arguments)

    monkeypatch.setattr(robust, 'reweighted', kept)
    far = true.with_offsets({'base.x': 0.5, 'base.rz': 0.5, 'tool.y': 0.3})
    found = robust.robust_fit(far, names, system, loss)
    assert found.settled
    size = max(1.0, found.fit.normal.rms(found.system))
    assert found.fit.next_step_rms < robust.STEP_TOLERANCE * size
    (last,) = distances_of(starts[0], names, system)
    bounded = system.weighted([1.0 / np.maximum(last, 1.0)])
    (again,) = distances_of(minimise(starts[0], names, bounded).chain, names, system)
    np.testing.assert_allclose(again, last, rtol=0.1, atol=0.1)
    weights = weights_of(distances_of(found.fit.chain, names, system)[0], loss)
    np.testing.assert_allclose(found.system.sets[0].weights ** 2, weights, rtol=0, atol=1e-3)
