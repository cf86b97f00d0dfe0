# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from fits import UR10E, arm

from calib_ros.apply.camera import Camera, before_camera, photograph
from calib_ros.apply.simulation import measure
from calib_ros.estimation import samples as samples_module
from calib_ros.estimation.pixels import seen_residuals
from calib_ros.estimation.samples import Samples, residual_arrays

SPREAD = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) + 0.5


def lengths(seen):
    distances = np.linalg.norm(seen.positions, axis=1)
    return replace(seen, distances=distances, oriented=np.zeros(len(seen), dtype=bool))


KINDS = pytest.mark.parametrize(
    'given',
    [
        lambda seen: seen,
        lengths,
        lambda seen: replace(seen, covariance=1e-8 * np.tile(SPREAD, (len(seen), 1, 1))),
    ],
    ids=['pose', 'distance', 'covariance'],
)


@KINDS
def test_weighted_rows_give_back_the_errors_in_metres(given):
    rng = np.random.default_rng(0)
    seen = given(measure(arm(0), UR10E.random_joints(20, rng), rng, 5e-5, 2e-4))
    samples = Samples(seen, 3e-4, 7e-4)
    rows = samples.rows_of(UR10E, UR10E.parameter_names[:4])
    expected, _ = residual_arrays(UR10E, seen)
    found = samples.position_errors(rows[-1].ravel())
    np.testing.assert_allclose(found[:, : expected.shape[1]], expected, rtol=1e-9)


@KINDS
def test_the_gradient_is_that_of_the_squares(given):
    """With covariances and turns of degrees, fits ended beside the minimum: not converged."""
    rng = np.random.default_rng(0)
    seen = measure(arm(0), UR10E.random_joints(20, rng), rng, 1e-2, 0.3)
    samples, names = Samples(given(seen), 3e-4, 7e-4), UR10E.parameter_names
    *rows, left = samples.rows_of(arm(0), names)
    for name, row in zip(names, rows, strict=True):
        ends = (arm(0).with_offsets({name: step}) for step in (1e-6, -1e-6))
        more, less = ((samples.rows_of(chain, ())[-1] ** 2).sum() for chain in ends)
        expected = -2.0 * (row * left).sum()
        assert (more - less) / 2e-6 == pytest.approx(expected, rel=1e-5, abs=1e-5 * more)


@pytest.mark.parametrize('weighted', [False, True])
@KINDS
def test_products_of_effects_are_those_of_their_rows(given, weighted, monkeypatch):
    """Effects of several joints, in any order of the names, over the ends of blocks."""
    monkeypatch.setattr(samples_module, 'BLOCK', 16)
    rng = np.random.default_rng(0)
    joint, other = UR10E.joint_names[1], UR10E.joint_names[4]
    effects = [f'{other}.sin_1', f'{joint}.cos_3', f'{other}.ratio', f'{joint}.sin_2']
    chain = UR10E.with_effects(effects)
    seen = given(measure(arm(0), UR10E.random_joints(40, rng), rng, 5e-5, 2e-4))
    samples = Samples(seen, 3e-4, 7e-4)
    if weighted:
        samples = samples.weighted(rng.random(len(seen)))
    names = [effects[0], *UR10E.parameter_names[:9], *effects[1:], 'tool.x']
    folds = rng.integers(0, 3, size=len(seen))
    found = samples.products(chain, names, 3, folds)
    rows = samples.rows_of(chain, names)
    for fold, products in enumerate(found.sum(axis=1)):
        own = rows[..., folds == fold].reshape(len(rows), -1)
        sizes = np.linalg.norm(own, axis=1) + 1e-12
        both = np.outer(sizes, sizes)
        np.testing.assert_allclose(products / both, own @ own.T / both, atol=1e-12)


def test_residuals_are_those_of_the_joint_values_at_the_delay():
    """An arm at 0.3 rad/s, 50 ms before the stamps, before a tracker and before a camera."""
    rng = np.random.default_rng(0)
    moving = np.full(6, 0.3)

    def late(chain, seen):
        chain = chain.with_frame('base', replace(chain.frame('base'), delay=0.05))
        velocity = np.tile(moving, (len(seen), 1))
        return chain, replace(seen, joints=seen.joints + 0.05 * moving, velocity=velocity)

    posed = late(UR10E, measure(UR10E, UR10E.random_joints(5, rng), rng))
    board = np.array([(0.04 * i, 0.04 * j, 0.0) for j in range(4) for i in range(6)])
    chain = before_camera(UR10E, Camera(), board, False, rng)
    pictured = late(chain, photograph(chain, Camera(), board, False, 2, rng))
    for left in (*residual_arrays(*posed), *seen_residuals(*pictured)):
        np.testing.assert_allclose(left, 0.0, atol=1e-8)
    assert np.abs(residual_arrays(UR10E, posed[1])[0]).max() > 1e-3
    stood = replace(posed[1], velocity=None)
    for chain, seen in ((UR10E, posed[1]), (posed[0], stood)):  # nothing is late, nothing moved
        joints, velocity = Samples(seen, 1.0, 1.0).moving(chain)
        np.testing.assert_array_equal(joints, seen.joints.T)
        assert velocity is None


@pytest.mark.parametrize('correlated', [False, True])
def test_rows_of_positions_among_poses_are_those_of_each_alone(correlated):
    rng = np.random.default_rng(0)
    seen = measure(arm(0), UR10E.random_joints(4, rng), rng, 5e-5, 2e-4)
    seen = replace(seen, oriented=np.array([True, False, False, True]))
    if correlated:
        seen = replace(seen, covariance=1e-8 * np.tile(SPREAD, (4, 1, 1)))
    names = UR10E.parameter_names[:4]
    samples = Samples(seen, 3e-4, 7e-4)
    found = samples.rows_of(UR10E, names)
    assert samples.rows == 4 * 3 + 2 * 3
    errors = np.concatenate(residual_arrays(UR10E, seen), axis=1)
    everything = residual_arrays(UR10E, replace(seen, oriented=np.ones(4, dtype=bool)))
    covariances = seen.covariances((3e-4, 7e-4))
    whitened = np.concatenate(samples.whitened_residuals(UR10E), axis=1)
    for k, oriented in enumerate(seen.oriented):
        alone = Samples(seen.select(np.array([k])), 3e-4, 7e-4).rows_of(UR10E, names)
        same = slice(0, 6 if oriented else 3)
        np.testing.assert_allclose(found[:, same, k], alone[:, same, 0], rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(found[:, same.stop :, k], 0.0)
        expected = np.concatenate([part[k] for part in everything])
        np.testing.assert_array_equal(errors[k, same], expected[same])
        assert np.isnan([errors[k, same.stop :], whitened[k, same.stop :]]).all()
        square = expected[same] @ np.linalg.solve(covariances[k, same, same], expected[same])
        assert whitened[k, same] @ whitened[k, same] == pytest.approx(square)
        assert found[-1, :, k] @ found[-1, :, k] == pytest.approx(square)


@pytest.mark.parametrize('block', [3, 4, 6, 7])
def test_rows_are_the_same_in_blocks_of_any_size(block, monkeypatch):
    """Three, two or one of them, the last one shorter; weights count by their roots."""
    rng = np.random.default_rng(0)
    seen = measure(arm(0), UR10E.random_joints(7, rng), rng, 5e-5, 2e-4)
    names, weights = UR10E.parameter_names[:9], rng.uniform(size=7)
    whole = Samples(seen, 3e-4, 7e-4).rows_of(UR10E, names)
    expected = np.concatenate(residual_arrays(UR10E, seen), axis=1).T
    monkeypatch.setattr(samples_module, 'BLOCK', block)
    found = Samples(seen, 3e-4, 7e-4).weighted(weights)
    np.testing.assert_allclose(found.rows_of(UR10E, names), np.sqrt(weights) * whole, atol=1e-9)
    wanted = expected / np.repeat([[3e-4], [7e-4]], 3, axis=0)
    np.testing.assert_allclose(whole[-1], wanted, rtol=1e-6, atol=1e-9)
    few = found.select(np.array([5, 1]))
    np.testing.assert_allclose(few.rows_of(UR10E, names), found.rows_of(UR10E, names)[..., [5, 1]])
