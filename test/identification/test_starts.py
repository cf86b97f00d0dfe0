# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Closed forms of the frames, and the search for the best half of the samples."""

from dataclasses import replace

import numpy as np
import pytest
from fits import UR10E, worst_prediction

from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.identification.identification import Problem, identify
from calib_ros.identification.leastsquares import System
from calib_ros.identification.samples import Samples
from calib_ros.identification.start import _shortest, closed_forms, start_frames
from calib_ros.identification.trimmed import _Linear
from calib_ros.kinematics import inverse, se3
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import load_chain


@pytest.mark.parametrize('fixed', [(), ('base',), ('tool',), ('base', 'tool')])
@pytest.mark.parametrize('oriented', [True, False])
def test_closed_forms_are_exact_and_keep_fixed_frames(fixed, oriented, rng):
    frames = {'base': random_frame(rng, 2.0), 'tool': random_frame(rng, 0.2)}
    seen = measure(replace(UR10E, **frames), UR10E.random_joints(30, rng), rng, oriented=oriented)
    given = {key: replace(frames[key], fixed=True) if key in fixed else None for key in frames}
    found = list(closed_forms(replace(UR10E, **given), seen))
    away = [np.abs(each.forward(seen.joints)[:, :3, 3] - seen.positions).max() for each in found]
    assert min(away) < 1e-9
    best = found[int(np.argmin(away))]
    for key, frame in frames.items():
        whole = oriented or key == 'base' or key in fixed
        part = (slice(None), slice(None) if whole else 3)  # positions do not turn the tool
        np.testing.assert_allclose(best.frame(key).matrix[part], frame.matrix[part], atol=1e-9)


def test_units_of_the_residuals_do_not_change_a_fit_to_a_half(rng):
    seen = measure(UR10E, UR10E.random_joints(40, rng), rng, 1e-4, 3e-4)
    names = [*UR10E.joints[1].parameters[:3], 'tool.x', 'tool.rx']
    masks = rng.random((3, 40)) < 0.5
    few, many = (
        _Linear(UR10E, names, System((Samples(seen, size, 3.0 * size),))).squares(masks)
        for size in (1e-4, 1e6)
    )
    np.testing.assert_allclose(1e20 * many, few, rtol=1e-5)


@pytest.mark.parametrize('oriented', [True, False])
@pytest.mark.parametrize('axis', [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)])
def test_frames_turned_by_half_a_turn_need_no_guess(axis, oriented):
    rng = np.random.default_rng(2)
    turn = np.array(axis) / np.linalg.norm(axis)
    matrix = np.eye(4)
    matrix[:3, :3] = 2.0 * np.outer(turn, turn) - np.eye(3)
    true = replace(faulty(UR10E, Cell(), rng), base=Frame(matrix), tool=Frame(matrix))
    seen = measure(true, UR10E.random_joints(40, rng), rng, oriented=oriented)
    assert worst_prediction(identify(Problem(UR10E, seen)).chain, true, rng)[0] < 1e-9


def test_a_wrong_initial_frame_does_no_harm():
    rng = np.random.default_rng(3)
    true = faulty(UR10E, Cell(), rng)
    misled = replace(UR10E, base=random_frame(rng, 5.0), tool=random_frame(rng, 1.0))
    for oriented in (True, False):
        seen = measure(true, UR10E.random_joints(40, rng), rng, oriented=oriented)
        assert worst_prediction(identify(Problem(misled, seen)).chain, true, rng)[0] < 1e-9


@pytest.mark.parametrize('shape', ['line', 'circle', 'volume'])
@pytest.mark.parametrize('oriented', [True, False])
@pytest.mark.parametrize('jitter', [0.0, 1e-4])
def test_one_orientation_leaves_the_tool_where_it_was(shape, oriented, jitter):
    """Base and tool trade without bounds there: the shortest tool is taken, and is named."""
    nominal, rng = load_chain('ur10e'), np.random.default_rng(0)
    bare, t = replace(nominal, base=Frame(), tool=Frame()), np.linspace(-1.0, 1.0, 60)
    q = np.array([0.3, -1.2, 1.5, -0.8, 1.2, 0.4])
    shift = {
        'line': np.outer(t, [1.0, 0.3, 0.2]),
        'circle': np.column_stack([np.cos(3.0 * t), np.sin(3.0 * t), 0.0 * t]),
        'volume': rng.uniform(-1.0, 1.0, (60, 3)),
    }[shape]
    poses = bare.forward(q[np.newaxis]).repeat(60, axis=0)
    poses[:, :3, 3] += 0.15 * shift
    found = inverse.solve(bare, poses, q[np.newaxis].repeat(60, axis=0))
    assert found.converged.all()
    joints = found.joints + rng.normal(scale=jitter, size=found.joints.shape)
    true = faulty(nominal, Cell(), rng)
    seen = measure(true, joints, rng, 5e-5, 2e-4, oriented=oriented)
    result = identify(Problem(nominal, seen))
    assert result.converged
    assert {'tool.x', 'tool.y', 'tool.z'} <= set(result.not_excited)
    assert any('tool: "fixed: true" in the chain file)' in text for text in result.refusals)
    assert not result.accepted
    for chain in (result.before, result.chain):
        assert np.linalg.norm(chain.frame('tool').matrix[:3, 3]) < 0.01
        assert np.linalg.norm(chain.frame('base').matrix[:3, 3]) < 5.0
    assert result.fitted.figures[0].rms_mm < 1.0
    assert result.fitted.figures[1].rms_mm < 0.1


def test_a_tool_that_is_given_stays_where_orientations_do_not_tell():
    rng = np.random.default_rng(0)
    turned = np.tile(np.eye(3), (20, 1, 1))
    assert not _shortest(turned, rng.normal(size=(20, 3)), True).any()
    axis = np.zeros((20, 3))
    axis[:, 2] = np.linspace(0.0, 1.0, 20)  # turns about z tell of x and y alone
    turned = se3.exp_rotation(axis)
    wanted = turned @ np.array([0.1, 0.2, 0.3]) + np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(_shortest(turned, wanted, True), [0.1, 0.2, 0.0], atol=1e-12)
    still = _shortest(turned, wanted - [1.0, 2.0, 3.0], False)
    np.testing.assert_allclose(still, [0.1, 0.2, 0.3], atol=1e-12)


def test_distances_start_right_among_gross_errors_that_agree():
    """A third of them is 0.3 m too long; the rest fits to the arm's own errors."""
    rng = np.random.default_rng(0)
    true = faulty(UR10E, Cell(), rng)
    q = UR10E.random_joints(120, rng)
    seen = measure(true, q, rng, 5e-5, 2e-4, oriented=False)
    distances = np.linalg.norm(seen.positions, axis=1)
    distances[::3] += 0.3
    wires = replace(seen, distances=distances)
    problem = Problem(UR10E, wires)
    found = start_frames(problem.model, problem.sets, 1e-4, 1e-4, problem.loss)
    left = np.linalg.norm(found.forward(q)[:, :3, 3], axis=1) - distances
    assert np.median(np.abs(left)) < 2e-3
    np.testing.assert_allclose(found.base.matrix[:3, :3], np.eye(3))  # no distance tells a turn
