# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from commanded import CELL, ROBOTS, UR, UR_TRUE, at_limit, missed, only_refusal, regular

from calib_ros.apply.compensation import compensate
from calib_ros.apply.compensator import Compensator
from calib_ros.apply.program import Program, compensate_program
from calib_ros.apply.simulation import faulty
from calib_ros.errors import InputError, UnknownNameError
from calib_ros.estimation.visits import approaches


@pytest.mark.parametrize('name', ['ur10e', 'kuka_iiwa14', 'kuka_youbot', 'ur10e_on_linear_axis'])
def test_velocities_and_accelerations_are_those_of_the_corrected_path(name):
    nominal = ROBOTS[name]
    true = faulty(nominal, CELL, np.random.default_rng(5))
    true = true.with_effect_values({f'{nominal.joint_names[1]}.sin_2': 1e-3})
    compensator = Compensator(nominal, true)
    start, goal = regular(nominal, 2, seed=3, least=0.1 if len(nominal.joints) > 5 else 0.04)
    goal = start + 0.2 * (goal - start)
    time = np.linspace(0.0, 1.0, 2001)[:, None]
    rate = np.pi * np.arange(1, len(start) + 1) / len(start)
    move = goal - start
    program = Program(
        nominal.joint_names,
        start + move * np.sin(rate * time),
        move * rate * np.cos(rate * time),
        -move * rate**2 * np.sin(rate * time),
    )
    corrected, result = compensate_program(compensator, program)
    assert result.refusals == ()
    step = time[1, 0] - time[0, 0]
    q = corrected.positions
    speed = (q[2:] - q[:-2]) / (2 * step)
    np.testing.assert_allclose(corrected.velocities[1:-1], speed, atol=2e-6)
    assert np.abs(program.velocities[1:-1] - speed).max() > 1e-3
    v = corrected.velocities
    bend = (v[2:] - v[:-2]) / (2 * step)
    np.testing.assert_allclose(corrected.accelerations[1:-1], bend, atol=3e-4)
    assert np.abs(program.accelerations[1:-1] - bend).max() > 2e-3


def test_a_correction_that_swings_between_sparse_samples_is_refused():
    """Near the wrist's singularity; two samples alone do not show a jump."""
    q = np.array([[0.3, -1.0, 1.2, -1.0, 0.05, 0.2], [0.9, -1.4, 0.8, -1.6, 1.0, 0.6]])
    speeds = np.tile([0.0, 0.0, 0.0, 0.0, -0.5, 0.0], (2, 1))
    true = UR.with_offsets({'wrist_1_joint.alpha': 2e-3, 'shoulder_lift_joint.alpha': 2e-3})
    compensator = Compensator(UR, true)
    assert compensate(compensator, q).refusals == ()
    corrected, result = compensate_program(compensator, Program(UR.joint_names, q, speeds))
    assert only_refusal(result).sample == 0
    assert 'moves at' in only_refusal(result).reason
    assert np.isnan(corrected.velocities[0]).all()
    assert np.isnan(corrected.positions[0]).all()
    assert np.isfinite(corrected.velocities[1]).all()
    lenient = replace(compensator, largest_change=5.0)
    allowed, result = compensate_program(lenient, Program(UR.joint_names, q, speeds))
    assert result.refusals == ()
    assert np.abs(allowed.velocities - speeds)[0].max() > 0.25


def test_an_arm_at_rest_keeps_its_rest():
    q = np.repeat(regular(UR, 1), 3, axis=0)
    program = Program(UR.joint_names, q, np.zeros_like(q), np.zeros_like(q))
    corrected, _ = compensate_program(Compensator(UR, UR_TRUE), program)
    np.testing.assert_array_equal(corrected.velocities, 0.0)
    np.testing.assert_array_equal(corrected.accelerations, 0.0)


def test_velocity_is_not_defined_where_a_joint_is_held_at_its_limit():
    nominal = ROBOTS['kuka_iiwa14']
    true = faulty(nominal, CELL, np.random.default_rng(1))
    q = regular(nominal, 1, least=0.1)
    compensator = Compensator(at_limit(nominal, true, q[0]), true)
    assert compensate_program(compensator, Program(nominal.joint_names, q))[1].refusals == ()
    program = Program(nominal.joint_names, q, np.ones_like(q))
    corrected, result = compensate_program(compensator, program)
    assert 'held at its limit' in only_refusal(result).reason
    assert np.isnan(corrected.velocities).all()
    just_within = Compensator(at_limit(nominal, true, q[0], share=1.0 + 1e-6), true)
    corrected, result = compensate_program(just_within, program)
    assert result.refusals == ()
    free, _ = compensate_program(Compensator(nominal, true), program)
    np.testing.assert_allclose(corrected.velocities, free.velocities, rtol=1e-12)


def test_backlash_is_taken_up_by_the_sense_of_the_move():
    slack = UR_TRUE.with_effect_values({f'{joint.name}.backlash': 2e-4 for joint in UR.joints})
    compensator = Compensator(UR, slack)
    q = regular(UR, 40)
    names = (*UR.joint_names, 'gripper')
    program = Program(names, np.column_stack([q, np.zeros(len(q))]))
    corrected, result = compensate_program(compensator, program)
    assert result.refusals == ()
    came = np.sign(np.diff(q, axis=0))
    assert missed(compensator, q[1:], corrected.positions[1:, :6], came).max() < 1e-9
    against = replace(program, approach=-approaches(q))
    other, _ = compensate_program(compensator, against)
    gap = (other.positions - corrected.positions)[1:, :6]
    np.testing.assert_allclose(gap, 4e-4 * came, rtol=0.05)


def test_joints_are_found_by_name_and_others_are_left_alone():
    q = regular(UR, 10)
    expected = compensate(Compensator(UR, UR_TRUE), q).joints
    names = ('gripper', *reversed(UR.joint_names))
    mixed = np.column_stack([np.arange(10.0), q[:, ::-1]])
    program = Program(names, mixed, velocities=np.ones_like(mixed))
    corrected, _ = compensate_program(Compensator(UR, UR_TRUE), program)
    np.testing.assert_array_equal(corrected.positions[:, 0], np.arange(10.0))
    np.testing.assert_array_equal(corrected.velocities[:, 0], 1.0)
    np.testing.assert_allclose(corrected.positions[:, :0:-1], expected, atol=1e-12)
    assert corrected.accelerations is None
    np.testing.assert_array_equal(program.positions, mixed)


@pytest.mark.parametrize('named', ['elbow', 'a'])
def test_the_unknown_joint_is_that_of_the_program(named):
    """Not the one of the arm that it is without; an axis of something else is in no one's way."""
    names = tuple(named if name == 'elbow_joint' else name for name in UR.joint_names)
    with pytest.raises(UnknownNameError, match='unknown joint in the program') as caught:
        compensate_program(Compensator(UR, UR), Program(names, np.zeros((2, 6))))
    assert (caught.value.name, caught.value.alternatives) == (named, UR.joint_names)


@pytest.mark.parametrize(
    ('change', 'complaint'),
    [
        ({'names': UR.joint_names[:5], 'positions': np.zeros((2, 5))}, 'no values of wrist_3'),
        ({'names': UR.joint_names[:5]}, '5 joint names do not fit'),
        ({'velocities': np.zeros((3, 5))}, 'rates of shape'),
        ({'velocities': np.full((3, 6), np.inf)}, 'finite'),
        ({'accelerations': np.zeros((3, 6))}, 'needs velocities as well'),
    ],
)
def test_programs_that_do_not_fit_are_refused(change, complaint):
    program = replace(Program(UR.joint_names, regular(UR, 3)), **change)
    with pytest.raises(InputError, match=complaint):
        compensate_program(Compensator(UR, UR_TRUE), program)
