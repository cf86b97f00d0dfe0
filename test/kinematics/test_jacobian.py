# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from commanded import twist
from hypothesis import given, strategies as st

from calib_ros.apply.simulation import random_frame
from calib_ros.errors import UnknownNameError
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Frame, Joint
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.jacobian import ErrorModel, orientation_error
from calib_ros.kinematics.parameter import FRAME_KINDS, ROW_KINDS

NEAR_SINGULAR = (0.0, np.pi / 2, np.pi, 1e-9, np.pi / 2 + 1e-9)


@st.composite
def chains(draw):
    """Draw a chain of any convention; many angles and lengths are (nearly) degenerate."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    joints = []
    for k in range(draw(st.integers(1, 8))):
        degenerate = draw(st.booleans())
        angles = rng.choice(NEAR_SINGULAR, 3) if degenerate else rng.uniform(-np.pi, np.pi, 3)
        lengths = rng.choice([0.0, 0.3, 1e-9], 3) if degenerate else rng.normal(size=3)
        joints.append(
            Joint(
                f'joint_{k}',
                draw(st.sampled_from(['revolute', 'prismatic'])),
                a=lengths[0],
                alpha=angles[0],
                d=lengths[1],
                theta=angles[1],
                beta=angles[2],
                b=lengths[2],
                sign=draw(st.sampled_from([1, -1])),
            )
        )
    frames = [random_frame(rng, 1.0) for _ in range(2)]
    convention = draw(st.sampled_from(['standard', 'modified']))
    chain = Chain('random', convention, tuple(joints), base=frames[0], tool=frames[1])
    straight = draw(st.booleans())
    q = np.zeros((3, len(joints))) if straight else rng.normal(size=(3, len(joints)))
    return chain, q


@given(chains())
def test_every_column_is_the_central_difference(drawn):
    chain, q = drawn
    names = [f'{frame}.{kind}' for frame in ('base', 'tool') for kind in FRAME_KINDS]
    names += [f'{joint.name}.{kind}' for joint in chain.joints for kind in ROW_KINDS]
    jacobian = ErrorModel(chain, names).jacobian(q)
    step = 1e-6
    for k, name in enumerate(names):
        ahead, behind = (chain.with_offsets({name: size}).forward(q) for size in (step, -step))
        difference = twist(behind, ahead) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, k], difference, rtol=0, atol=1e-7)


def test_an_unknown_parameter_is_named():
    chain = Chain('one', 'standard', (Joint('joint_1', a=1.0),))
    with pytest.raises(UnknownNameError, match=r'did you mean "joint_1.alpha"'):
        ErrorModel(chain, ['joint_1.alpa'])


@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-12, 1e-6, 0.1, 3.0, np.pi - 1e-7, np.pi]))
def test_orientation_error_turns_the_model_onto_the_measurement(seed, angle):
    rng = np.random.default_rng(seed)
    model = se3.exp_rotation(rng.normal(size=(5, 3)))
    axis = rng.normal(size=(5, 3))
    vector = angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    measured = se3.exp_rotation(vector) @ model
    columns = np.ascontiguousarray(measured.transpose(2, 1, 0))
    found = orientation_error(columns, np.ascontiguousarray(model.transpose(2, 1, 0))).T
    np.testing.assert_allclose(se3.exp_rotation(found) @ model, measured, rtol=0, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), angle, rtol=1e-6, atol=1e-15)


@given(chains(), st.integers(0, 2**32 - 1))
def test_the_column_of_a_delay_is_the_central_difference(drawn, seed):
    """A later device saw the target where the joints had been before."""
    chain, q = drawn
    velocity = np.random.default_rng(seed).normal(size=q.shape)
    names = ['base.x', 'base.delay', f'{chain.joint_names[0]}.theta']
    model = ErrorModel(chain, names)
    column = model.jacobian(q, velocity=velocity)[:, :, 1]
    step = 1e-6
    ahead, behind = (chain.forward(q - sign * step * velocity) for sign in (1.0, -1.0))
    np.testing.assert_allclose(column, twist(behind, ahead) / (2 * step), rtol=0, atol=1e-7)
    np.testing.assert_array_equal(model.jacobian(q)[:, :, 1], 0.0)


def test_the_delay_is_that_of_its_own_device():
    chain = Chain('one', 'standard', (Joint('joint_1', a=1.0),))
    chain = chain.with_frame('base_B', Frame(delay=0.1))
    names = ['base.delay', 'base_B.delay']
    q, velocity = np.zeros((2, 1)), np.ones((2, 1))
    first = ErrorModel(chain, names).jacobian(q, velocity=velocity)
    second = ErrorModel(chain, names, 'base_B').jacobian(q, velocity=velocity)
    np.testing.assert_array_equal(first[:, :, 1], 0.0)
    np.testing.assert_array_equal(second[:, :, 0], 0.0)
    np.testing.assert_allclose(first[:, 1, 0], -1.0)
    np.testing.assert_allclose(second[:, 1, 1], -1.0)


def test_points_beside_the_target_are_targets_of_a_longer_tool(rng):
    arm, points = load_chain('ur10e'), rng.normal(size=(5, 3))
    tool, base = random_frame(rng, 0.2), random_frame(rng, 1.0)
    names = ['base.x', 'base.rz', 'elbow_joint.a', 'wrist_1_joint.theta']
    q = arm.random_joints(5, rng)
    model = ErrorModel(replace(arm, base=base, tool=tool), names)
    axes, origins, shift, turn, _ = model.linearise(q.T, points=points.T)
    for k, point in enumerate(points):
        longer = replace(tool, matrix=tool.matrix @ se3.transform(np.eye(3), point))
        one = ErrorModel(replace(arm, base=base, tool=longer), names).linearise(q[k : k + 1].T)
        found = axes[..., k], origins[:, k], shift[:-1, :, k], turn[:-1, :, k]
        expected = one[0], one[1], one[2][:-1], one[3][:-1]
        for ours, alone in zip(found, expected, strict=True):
            np.testing.assert_allclose(ours, alone.reshape(ours.shape), atol=1e-12)
