# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A fixed point, of which a camera on the flange gives the position alone."""

from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, UR10E, arm

from calib_ros import CalibrationSession, Settings
from calib_ros.apply.design import Design, accuracy
from calib_ros.apply.verification import verify
from calib_ros.decision.comparison import along_base, compare
from calib_ros.errors import InputError
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.samples import Samples, residual_arrays
from calib_ros.estimation.start import start_frames
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.identification import identify
from calib_ros.kinematics import se3
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import parameters_of
from calib_ros.sampling.sample import Sample

BALL = np.array([0.7, 0.2, 0.3])


def seen(true, joints, noise=0.0, ball=BALL):
    """Return what the camera at the tool of a true arm sees of a ball in the world (3,) [m]."""
    cameras = true.forward(joints)
    places = np.einsum('nji,nj->ni', cameras[:, :3, :3], ball - cameras[:, :3, 3])
    return Observations.from_arrays(joints, places + noise).inverted()


def test_the_arm_is_found(rng):
    true = arm(rng)
    joints = UR10E.random_joints(40, rng)
    result = identify(Problem(UR10E, seen(true, joints, NOISE[0] * rng.normal(size=(40, 3)))))
    assert result.accepted
    assert len(result.names) == 27
    assert {'base.rx', 'base.ry', 'base.rz'} <= set(result.unidentifiable)
    new = seen(true, UR10E.random_joints(500, rng))
    errors = [residual_arrays(chain, new)[0].std() for chain in (result.before, result.chain)]
    assert errors[0] > 1e-3
    assert errors[1] < 1e-4


def test_frames_that_are_known_stay(rng):
    true = arm(rng)
    base, tool = (replace(frame, fixed=True) for frame in (true.base, true.tool))
    moved = base.matrix.copy()
    moved[:3, 3] -= BALL  # the origin of the world is the ball
    known = replace(UR10E, base=replace(base, matrix=moved), tool=tool)
    result = identify(Problem(known, seen(true, UR10E.random_joints(40, rng))))
    assert result.accepted
    assert result.chain.frame('tool').matrix.tolist() == tool.matrix.tolist()


def test_a_few_poses_of_a_board_turn_the_base(rng):
    """Another camera sees its origin, more often."""
    true = arm(rng)
    others = UR10E.random_joints(8, rng)
    board = se3.transform(se3.exp_rotation(np.array([2.0, 1.0, 0.5])), BALL)
    poses = se3.invert(true.forward(others)) @ board
    given = Observations.from_arrays(others, poses[:, :3, 3], poses[:, :3, :3]).inverted()
    points = replace(seen(true, UR10E.random_joints(30, rng)), tool='tool_2')
    problem = Problem(UR10E, given, more=(points,))
    start = start_frames(problem)
    for each in problem.sets:
        assert np.abs(residual_arrays(start, each)[0]).max() < 0.05


def test_noise_has_the_axes_of_the_camera(rng):
    """It knows depth five times less well."""
    sigmas = NOISE[0] * np.array([1.0, 1.0, 5.0])
    covariance = np.zeros((100, 6, 6))
    covariance[:, range(3), range(3)] = sigmas**2
    measured = seen(arm(rng), UR10E.random_joints(100, rng), sigmas * rng.normal(size=(100, 3)))
    result = identify(Problem(UR10E, replace(measured, covariance=covariance)))
    assert result.noise.position == pytest.approx(1.0, abs=0.15)


def test_derivatives_are_those_of_the_residual(rng):
    true = arm(rng)
    measured = seen(true, UR10E.random_joints(20, rng))
    chain = identify(Problem(UR10E, measured)).chain
    samples = Samples(measured.at(measured.stamps_ns), *NOISE)
    names = [name for name in chain.parameter_names if name.kind != 'delay']
    rows = samples.rows_of(chain, names)
    assert np.abs(rows[-1]).max() < 1e-3  # else they turn with the camera
    for name, row in zip(names, rows[:-1], strict=True):
        ahead, behind = (
            samples.rows_of(chain.with_offsets({name: step}), [])[-1] for step in (1e-6, -1e-6)
        )
        np.testing.assert_allclose(row, (behind - ahead) / 2e-6, rtol=1e-4, atol=1.0)
    assert np.abs(rows[[names.index(n) for n in parameters_of('tool')]]).max(axis=(1, 2)).min() > 1


def test_residuals_are_shown_along_the_base(rng):
    """Of a ball that was moved all are alike, wherever the camera was."""
    true = arm(rng)
    joints = UR10E.random_joints(20, rng)
    chain = identify(Problem(UR10E, seen(true, joints))).chain
    moved = seen(true, joints, ball=BALL + np.array([0.0, 0.0, 0.01]))
    found = along_base(compare(chain, chain, [moved]), chain, [moved]).after.position
    np.testing.assert_allclose(found, np.tile(found[0], (20, 1)), atol=1e-5)
    assert np.linalg.norm(found[0]) == pytest.approx(0.01, rel=1e-3)


def test_a_ball_elsewhere_needs_a_new_base(rng):
    true = arm(rng)
    result = identify(Problem(UR10E, seen(true, UR10E.random_joints(40, rng))))
    other = [seen(true, UR10E.random_joints(30, rng), ball=BALL + 0.3)]
    moved, new = (
        verify(Calibration.of(result), other, 2e-4, new_base=new_base)
        for new_base in (False, True)
    )
    assert (moved.verdict, new.verdict) == ('FAIL', 'PASS')
    assert moved.common < 0.01


def test_a_new_camera_costs_two_poses_and_a_new_ball_one(rng):
    """The turn of a camera moves what it sees, that of a base does not."""
    true = arm(rng)
    known = Calibration.of(identify(Problem(UR10E, seen(true, UR10E.random_joints(40, rng)))))
    few = [seen(true, UR10E.random_joints(6, rng))]
    assert verify(known, few, 2e-4, new_base=True).verdict == 'PASS'
    with pytest.raises(InputError, match='at least 7 are needed, 2 of them'):
        verify(known, few, 2e-4, new_tool=True)


def test_planned_poses_determine_what_is_fitted(rng):
    """The camera's rotation too, before and after the first poses are measured."""
    problem = Problem(UR10E, seen(arm(rng), UR10E.random_joints(40, rng)))
    more, task = UR10E.random_joints(40, rng), UR10E.random_joints(100, rng)
    planned = Design.of(problem)
    assert np.isfinite(accuracy(planned, more, task)[-1])
    result = identify(problem)
    model, design = ErrorModel(result.chain, result.names), Design.of(problem, result)
    jacobian = model.jacobian(more, seen=True)[:, :3]
    rows = Samples(seen(result.chain, more, ball=np.zeros(3)), 1.0, 1.0)
    expected = rows.rows_of(result.chain, result.names)[:-1].transpose(2, 1, 0)
    turns = result.chain.forward(more)[:, :3, :3]
    np.testing.assert_allclose(np.swapaxes(turns, 1, 2) @ jacobian, expected, atol=1e-9)
    found = design.rows(more)[..., : len(result.names)] * design.sigma_position
    np.testing.assert_allclose(found, jacobian, atol=1e-9)


def test_positions_are_turned_round_and_back(rng):
    given = Observations.from_arrays(UR10E.random_joints(5, rng), rng.normal(size=(5, 3)))
    turned = given.inverted()
    assert turned.seen
    assert not turned.positions.any()
    assert turned.inverted().positions.tolist() == given.positions.tolist()
    assert not turned.inverted().seen
    some = replace(given, oriented=np.arange(5) > 2)
    far = replace(given, distances=np.ones(5))
    for each in (some, far, replace(given, socket=True)):
        with pytest.raises(InputError, match='all with an orientation'):
            each.inverted()


def test_a_session_estimates_and_identifies(rng):
    true = arm(rng)
    joints = UR10E.random_joints(40, rng)
    places = seen(true, joints, NOISE[0] * rng.normal(size=(40, 3))).given
    session = CalibrationSession(UR10E, Settings(sigma_position=NOISE[0]))
    pairs = enumerate(zip(joints, places, strict=True), 1)
    session.restore([Sample(k, q, position=p, eye_in_hand=True) for k, (q, p) in pairs])
    session.learning()()
    assert session.estimate.rms < 1e-4
    assert session.identify().accepted
