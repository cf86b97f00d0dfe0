# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sources that stand still while the rest moves."""

from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, SCARA, SIGMAS, UR10E, arm, measured_arm

from calib_ros import Problem, identify
from calib_ros.apply.simulation import measure
from calib_ros.decision.frozen import frozen_sources
from calib_ros.decision.mistakes import diagnose
from calib_ros.estimation import fitting
from calib_ros.kinematics.se3 import exp_rotation


@pytest.mark.parametrize(
    ('part', 'rows_of'),
    [
        ('joint values are', 'lines 9 to 30'),
        ('measurement is', 'poses of 9.000 s to 30.000 s'),
    ],
)
def test_a_source_that_repeats_its_last_value_is_named(part, rows_of):
    """If the other rows do not suffice; a fixed point touched again and again is measured so."""
    (*_, seen), rows = measured_arm(1, 40), slice(8, 30)
    held = {'joints': seen.joints.copy()}
    if part != 'joint values are':
        held = {'positions': seen.positions.copy(), 'rotations': seen.rotations.copy()}
    for values in held.values():
        values[rows] = values[7]
    of_messages = rows_of.startswith('poses')  # of a simulation, stamps in whole seconds
    found = diagnose(Problem(UR10E, replace(seen, **held), of_messages=of_messages))
    assert f'the {part} repeated in {rows_of} while the rest moved' in str(found)
    assert not found.alone


@pytest.mark.parametrize('part', ['the measurement is', 'the joint values are'])
def test_a_source_that_repeats_its_last_value_did_not_move(part, unsearched):
    """The rows looked as if the device had moved by a metre and back."""
    *_, seen = measured_arm(0, 40)
    rows = np.arange(40)
    rows[20:23] = 19
    old = seen.select(rows)
    changed = {'positions': old.positions, 'rotations': old.rotations}
    changed = {'joints': old.joints} if 'joint' in part else changed
    found = identify(Problem(UR10E, replace(seen, **changed), **SIGMAS))
    assert found.accepted
    assert found.remarks[0].startswith(f'{part} repeated in lines 21 to 23 while the rest moved')
    assert found.step is None


def test_a_device_that_stands_still_while_the_arm_moves_slowly_is_named(rng, unsearched):
    """From row to row the arm moved by less than it may be off."""
    slowly = np.full(6, 4e-3) * np.arange(12)[:, np.newaxis]
    joints = UR10E.random_joints(40, rng)
    seen = measure(arm(0), np.concatenate([joints, joints[-1] + slowly]), rng, *NOISE)
    old = seen.select(np.minimum(np.arange(52), 41))
    problem = Problem(UR10E, replace(old, joints=seen.joints, stamps_ns=seen.stamps_ns), **SIGMAS)
    found = identify(problem)
    assert found.remarks[0].startswith('the measurement is repeated in lines 45 to 52 while')
    assert found.step is None


@pytest.mark.parametrize(
    ('chain', 'joint', 'oriented', 'of_messages'),
    [(UR10E, 2, True, False), (UR10E, 2, False, True), (SCARA, 2, True, False)],
)
def test_a_joint_that_repeats_its_value_while_others_move_is_named(
    chain, joint, oriented, of_messages, unsearched
):
    """Its rows were gross errors without a cause, or a device that moved."""
    *_, seen = measured_arm(1, 40, chain=chain, oriented=oriented)
    joints = seen.joints.copy()
    joints[12:18, joint] = joints[12, joint]
    problem = Problem(chain, replace(seen, joints=joints), of_messages=of_messages, **SIGMAS)
    (told,), _ = frozen_sources(fitting.fit(problem))
    where = 'poses of 14.000 s to 18.000 s' if of_messages else 'lines 14 to 18'
    assert told.startswith(f'{chain.joint_names[joint]} moved in {where}, but its values repeat')
    bumped = np.pad([[1e-3]], ((0, 0), (0, 2))) * (np.arange(40) >= 20)[:, np.newaxis]
    moved = replace(seen, joints=joints, positions=seen.positions + bumped)
    found = identify(replace(problem, observations=moved))
    assert found.remarks[0] == told
    assert found.step.sample == 20  # and it is not hidden


@pytest.mark.parametrize('part', ['target', 'base', 'slip', 'gross errors'])
def test_joints_that_rest_are_not_frozen_whatever_else_is_wrong(part):
    """Of the second half, of the wrist alone; a base that turns moves it as the first joint."""
    rng, true = np.random.default_rng(5), arm(5)
    q = UR10E.random_joints(80, rng)
    q[50:, :3] = q[50, :3]
    moved = np.zeros(6)
    moved[1] = 0.05 * (part == 'slip')
    seen = measure(true, q + moved * (np.arange(80) >= 60)[:, np.newaxis], rng, *NOISE, False)
    if part == 'target':
        seen.positions[60:] += 0.02 * true.forward(q[60:])[:, :3, 0]
    if part == 'base':
        seen.positions[60:] = seen.positions[60:] @ exp_rotation(np.array([[0.0, 0.0, 0.1]]))[0]
    if part == 'gross errors':
        seen.positions[55::3] += rng.normal(scale=0.05, size=(9, 3))
    fitted = fitting.fit(Problem(UR10E, replace(seen, joints=q), **SIGMAS))
    assert fitted.robust.outliers.sum() > 5
    assert frozen_sources(fitted)[0] == ()


def test_gross_errors_at_poses_measured_again_and_again_are_no_repeated_joint_values():
    rng = np.random.default_rng(2)
    q = np.repeat(UR10E.random_joints(25, rng), 4, axis=0)
    seen = measure(arm(rng), q, rng, *NOISE, False)
    seen.positions[rng.random(100) < 0.15] += 0.08
    result = identify(Problem(UR10E, seen))
    assert result.accepted
    assert 'repeated' not in ' '.join(map(str, result.remarks))
