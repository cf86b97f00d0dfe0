# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from calib_ros.apply.compensation import Compensator, compensate, in_words
from calib_ros.apply.program import Program, approaches, compensate_program
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.cli.main import main
from calib_ros.cli.options import NOT_ACCEPTED
from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.files.trajectories import read_program
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.identification import Problem, identify
from calib_ros.identification.records import nominal_document
from calib_ros.kinematics import effects, following, se3
from calib_ros.kinematics.chain import Chain, Frame, Joint
from calib_ros.kinematics.chain_file import dump_chain, load_chain, shipped_robots
from calib_ros.kinematics.following import POSITION_FIRST, mobility
from calib_ros.kinematics.inverse import solve_positive
from calib_ros.report.words import as_document

CELL = Cell(length_error=1e-3, angle_error=1e-3)
ROBOTS = {name: load_chain(name) for name in shipped_robots()}
SIX = ['puma560', 'staubli_tx90l', 'ur10e']
REDUNDANT = ['kuka_iiwa14', 'ur10e_on_linear_axis']
UR = ROBOTS['ur10e']
UR_TRUE = faulty(UR, CELL, np.random.default_rng(4))
TURNED_SCARA = Chain(
    'scara',
    'modified',
    (
        Joint('one', d=0.3, lower=-2.5, upper=2.5),
        Joint('two', a=0.35, sign=-1, lower=-2.5, upper=2.5),
        Joint('three', 'prismatic', a=0.25, alpha=np.pi, sign=-1, lower=-0.3, upper=0.0),
        Joint('four', d=0.1, lower=-6.0, upper=6.0),
    ),
)


def bare(chain, tool=(0.0, 0.0, 0.0)):
    """Return the arm alone, with a point of the flange as its target."""
    end = Frame(se3.transform(np.eye(3), np.array(tool, dtype=float)))
    return replace(chain, base=Frame(), tool=end)


def pose_errors(compensator, command, joints, approach=None):
    """Return position [m] and orientation error [rad] by forward kinematics alone, as vectors."""
    wanted = bare(compensator.nominal, compensator.tool).forward(command)
    reached = bare(compensator.calibrated, compensator.tool).forward(joints, approach)
    turn = wanted[:, :3, :3] @ np.swapaxes(reached[:, :3, :3], 1, 2)
    return wanted[:, :3, 3] - reached[:, :3, 3], se3.log_rotation(turn)


def lengths(errors):
    return np.linalg.norm(errors[0], axis=1), np.linalg.norm(errors[1], axis=1)


def numeric_jacobian(chain, q, weight=1.0, step=1e-6):
    """Return (N, 6, n) by central differences of the forward kinematics."""
    chain, columns = bare(chain), []
    for move in step * np.eye(q.shape[1]):
        ahead, behind = chain.forward(q + move), chain.forward(q - move)
        turn = se3.log_rotation(ahead[:, :3, :3] @ np.swapaxes(behind[:, :3, :3], 1, 2))
        shift = ahead[:, :3, 3] - behind[:, :3, 3]
        columns.append(np.concatenate([shift, weight * turn], axis=1) / (2 * step))
    return np.stack(columns, axis=2)


def regular(chain, count, seed=0, margin=0.05, least=None):
    """Draw configurations away from limits and singularities."""
    narrowed = replace(
        chain,
        joints=tuple(
            replace(joint, lower=joint.lower + margin, upper=joint.upper - margin)
            for joint in chain.joints
        ),
    )
    q = narrowed.random_joints(30 * count, np.random.default_rng(seed))
    rank = min(6, len(chain.joints))
    least = least or (0.05 if rank == 6 else 0.02)
    values = np.linalg.svd(numeric_jacobian(chain, q), compute_uv=False)[:, rank - 1]
    kept = q[values > least]
    assert len(kept) >= count
    return kept[:count]


def with_effects(chain, seed=0):
    groups = ('ratio', 'coupling', 'eccentricity', 'gravity')
    names = [name for group in groups for name in effects.members(chain, group)]
    last = chain.joints[-1].name
    names += [f'{last}.sin_100', f'{last}.cos_100']
    values = np.random.default_rng(seed).normal(scale=2e-4, size=len(names))
    return chain.with_effect_values(dict(zip(names, values, strict=True)))


def true_arms(nominal):
    """Return an arm with geometric errors, and one with other errors besides."""
    rngs = map(np.random.default_rng, (1, 2))
    geometric, other = (faulty(nominal, CELL, rng) for rng in rngs)
    return geometric, with_effects(other)


# Reaching the pose


@pytest.mark.parametrize('name', SIX)
def test_six_joints_reach_the_pose_exactly(name):
    nominal = ROBOTS[name]
    for true in true_arms(nominal):
        compensator = Compensator(nominal, true)
        q = regular(nominal, 300)
        result = compensate(compensator, q)
        assert result.refusals == ()
        position, turn = lengths(pose_errors(compensator, q, result.joints))
        assert position.max() < 1e-9
        assert turn.max() < 1e-9
        before = lengths(pose_errors(compensator, q, q))
        assert before[0].max() > 5e-4
        np.testing.assert_allclose(result.position_before, before[0], atol=1e-12)
        np.testing.assert_allclose(result.orientation_before, before[1], atol=1e-12)
        assert result.converged.all()
        assert not result.limited.any()
        assert not result.damped.any()


@pytest.mark.parametrize('name', REDUNDANT)
def test_redundant_arms_reach_the_pose_by_the_least_change(name):
    nominal = ROBOTS[name]
    for true in true_arms(nominal):
        compensator = Compensator(nominal, true)
        q = regular(nominal, 200)
        result = compensate(compensator, q)
        assert result.refusals == ()
        position, turn = lengths(pose_errors(compensator, q, result.joints))
        assert position.max() < 1e-8
        assert turn.max() < 1e-8
        scaled = numeric_jacobian(true, result.joints) * compensator.largest
        idle = np.linalg.svd(scaled)[2][:, 6:]
        share = np.einsum('nki,ni->nk', idle, result.correction / compensator.largest)
        size = np.linalg.norm(result.correction / compensator.largest, axis=1)
        assert (np.abs(share[:, 0]) / size).max() < 1e-5


def best_compromise(compensator, command, weight):
    """Return what scipy finds to be the best joint values for one command."""

    def residual(joints):
        position, turn = pose_errors(compensator, command[None], joints[None])
        return np.concatenate([position[0], weight * turn[0]])

    options = {'xtol': 1e-15, 'ftol': 1e-15, 'gtol': 1e-15, 'x_scale': 'jac'}
    return least_squares(residual, command, **options).x


@pytest.mark.parametrize('tool', [(0.0, 0.0, 0.0), (0.05, -0.02, 0.1)])
@pytest.mark.parametrize(
    'nominal', [ROBOTS['kuka_youbot'], ROBOTS['denso_hsr065'], TURNED_SCARA], ids=lambda c: c.name
)
def test_arms_of_fewer_joints_meet_the_position_and_then_the_orientation(nominal, tool):
    assert mobility(nominal) == len(nominal.joints)
    true = faulty(nominal, CELL, np.random.default_rng(3))
    compensator = Compensator(nominal, true, tool=tool)
    q = regular(nominal, 100)
    result = compensate(compensator, q)
    kept = ~np.isnan(result.joints).any(axis=1)
    assert kept.mean() > 0.95
    position, turn = lengths(pose_errors(compensator, q[kept], result.joints[kept]))
    assert position.max() < 1e-6
    np.testing.assert_allclose(result.position[kept], position, atol=1e-12)
    np.testing.assert_allclose(result.orientation[kept], turn, atol=1e-12)
    assert turn.max() > 1e-4
    for k in np.flatnonzero(kept)[:5]:
        best = best_compromise(compensator, q[k], POSITION_FIRST)
        np.testing.assert_allclose(result.joints[k], best, atol=1e-6)


def test_the_weight_of_orientation_is_the_users():
    nominal = ROBOTS['kuka_youbot']
    true = faulty(nominal, CELL, np.random.default_rng(3))
    q = regular(nominal, 5)
    compensator = Compensator(nominal, true, orientation_weight=0.3, largest_position_error=1e-2)
    result = compensate(compensator, q)
    for command, joints in zip(q, result.joints, strict=True):
        best = best_compromise(compensator, command, 0.3)
        np.testing.assert_allclose(joints, best, atol=1e-6)
    first = compensate(replace(compensator, orientation_weight=None), q)
    assert (result.orientation < first.orientation).all()
    assert (result.position > first.position).all()


def test_frames_of_the_measurement_do_not_matter(rng):
    q = regular(UR, 50)
    moved = replace(
        UR_TRUE, base=random_frame(rng, 3.0), tool=random_frame(rng, 1.0), gravity=UR.gravity
    )
    nominal = replace(UR, base=random_frame(rng, 3.0), tool=random_frame(rng, 1.0))
    effective = with_effects(UR_TRUE), with_effects(moved)
    first, second = (
        compensate(Compensator(*chains), q).joints
        for chains in ((UR, effective[0]), (nominal, effective[1]))
    )
    np.testing.assert_allclose(first, second, atol=1e-10)


def test_the_same_arm_needs_no_correction():
    result = compensate(Compensator(UR, UR), regular(UR, 50))
    np.testing.assert_allclose(result.correction, 0.0, atol=1e-14)
    assert result.refusals == ()


def test_an_identified_arm_reaches_the_pose_in_the_measured_world():
    """Compensate by 60 noisy poses; judge with the true arm, in the calibration's frames."""
    rng = np.random.default_rng(8)
    seen = measure(UR_TRUE, UR.random_joints(60, rng), rng, 5e-5, 2e-4)
    found = identify(Problem(UR, seen))
    q = regular(UR, 300, seed=9)
    result = compensate(Compensator(UR, found.chain), q)
    assert result.refusals == ()
    frames = found.chain.frame('base'), found.chain.frame('tool')
    wanted = replace(UR, base=frames[0], tool=frames[1]).forward(q)[:, :3, 3]
    reached = UR_TRUE.forward(result.joints)[:, :3, 3]
    before = found.before.forward(q)[:, :3, 3] - UR_TRUE.forward(q)[:, :3, 3]
    after = wanted - reached
    noise_floor = found.chain.forward(result.joints)[:, :3, 3] - reached
    np.testing.assert_allclose(after, noise_floor, atol=1e-9)
    assert np.linalg.norm(after, axis=1).max() < 2e-4
    assert np.linalg.norm(before, axis=1).max() > 1e-3


@st.composite
def arms(draw):
    """Draw a random arm, one with small errors, and commands."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    joints = tuple(
        Joint(
            f'joint_{k}',
            draw(st.sampled_from(['revolute', 'revolute', 'prismatic'])),
            a=rng.normal(scale=0.3),
            alpha=rng.choice([0.0, np.pi / 2, -np.pi / 2, 1.0]),
            d=rng.normal(scale=0.3),
            theta=rng.normal(),
            sign=draw(st.sampled_from([1, -1])),
            lower=-2.0,
            upper=2.0,
        )
        for k in range(draw(st.integers(1, 8)))
    )
    nominal = Chain('random', draw(st.sampled_from(['standard', 'modified'])), joints)
    true = nominal.with_offsets(
        {name: rng.normal(scale=1e-3) for name in nominal.parameter_names if name[0] == 'j'}
    )
    return nominal, true, nominal.random_joints(20, rng)


@given(arms())
def test_every_sample_is_reached_within_all_limits_or_refused(drawn):
    nominal, true, q = drawn
    compensator = Compensator(nominal, true)
    result = compensate(compensator, q)
    refused = np.zeros(len(q), dtype=bool)
    refused[[refusal.sample for refusal in result.refusals]] = True
    np.testing.assert_array_equal(np.isnan(result.joints).all(axis=1), refused)
    np.testing.assert_array_equal(np.isnan(result.joints).any(axis=1), refused)
    assert (np.abs(result.correction[~refused]) <= compensator.largest).all()
    assert (np.abs(result.joints[~refused]) <= 2.0).all()
    position, turn = lengths(pose_errors(compensator, q[~refused], result.joints[~refused]))
    assert (position <= 1e-6).all()
    assert (turn <= (1e-6 if mobility(nominal) == 6 else 0.02)).all()


@given(st.integers(1, 8), st.integers(0, 1000))
def test_elimination_solves(size, seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(size, size, 4))
    matrix = np.einsum('ikb,jkb->ijb', root, root) + 0.1 * np.eye(size)[:, :, None]
    right = rng.normal(size=(size, 4))
    before = matrix.copy(), right.copy()
    expected = [np.linalg.solve(matrix[..., k], right[:, k]) for k in range(4)]
    np.testing.assert_allclose(solve_positive(matrix, right).T, expected, rtol=1e-8, atol=1e-10)
    np.testing.assert_array_equal(matrix, before[0])
    np.testing.assert_array_equal(right, before[1])


# What is refused


def only_refusal(result):
    (refusal,) = result.refusals
    return refusal


def at_limit(nominal, true, q, joint=2):
    """Return commands with a limit that the correction would just exceed."""
    correction = compensate(Compensator(nominal, true), q[None]).correction[0, joint]
    lower, upper = nominal.joints[joint].lower, nominal.joints[joint].upper
    if correction > 0.0:
        upper = q[joint] + 0.5 * correction
    else:
        lower = q[joint] + 0.5 * correction
    joints = list(nominal.joints)
    joints[joint] = replace(joints[joint], lower=lower, upper=upper)
    return replace(nominal, joints=tuple(joints))


def test_a_joint_that_would_go_beyond_its_limit_is_refused():
    q = regular(UR, 20)
    narrow = at_limit(UR, UR_TRUE, q[7])
    result = compensate(Compensator(narrow, UR_TRUE), q[7:8])
    refusal = only_refusal(result)
    assert refusal.sample == 0
    assert 'elbow_joint would go beyond a limit; held there' in refusal.reason
    np.testing.assert_array_equal(result.limited, [[False, False, True, False, False, False]])
    assert np.isnan(result.joints).all()
    assert result.position[0] + result.orientation[0] > 1e-5


def test_what_remains_at_a_limit_may_be_tolerated():
    q = regular(UR, 20)[7:8]
    narrow = at_limit(UR, UR_TRUE, q[0])
    compensator = Compensator(
        narrow, UR_TRUE, largest_position_error=5e-3, largest_orientation_error=5e-3
    )
    result = compensate(compensator, q)
    assert result.refusals == ()
    elbow = narrow.joints[2]
    assert result.joints[0, 2] == pytest.approx(
        elbow.upper if result.correction[0, 2] > 0 else elbow.lower, abs=1e-14
    )
    position, turn = lengths(pose_errors(compensator, q, result.joints))
    np.testing.assert_allclose([position[0], turn[0]], [result.position[0], result.orientation[0]])
    before = lengths(pose_errors(compensator, q, q))
    assert position[0] + 0.3 * turn[0] < before[0][0] + 0.3 * before[1][0]
    first = compensate(replace(compensator, orientation_weight=1e-3), q)
    assert first.position[0] < 1e-6 < 1e-5 < result.position[0]
    assert first.orientation[0] > result.orientation[0]


@pytest.mark.parametrize('name', ['franka_fr3', 'kuka_iiwa14'])
def test_a_redundant_arm_does_without_the_joint_at_its_limit(name):
    nominal = ROBOTS[name]
    true = faulty(nominal, CELL, np.random.default_rng(1))
    for q in regular(nominal, 10, least=0.1):
        narrow = at_limit(nominal, true, q)
        compensator = Compensator(narrow, true)
        result = compensate(compensator, q[None])
        assert result.refusals == ()
        np.testing.assert_array_equal(np.flatnonzero(result.limited[0]), [2])
        assert narrow.joints[2].lower <= result.joints[0, 2] <= narrow.joints[2].upper
        position, turn = lengths(pose_errors(compensator, q[None], result.joints))
        assert position[0] < 1e-8
        assert turn[0] < 1e-8


def test_a_command_beyond_a_limit_is_refused():
    q = regular(UR, 3)
    q[1, 2] = 3.2
    refusal = only_refusal(compensate(Compensator(UR, UR_TRUE), q))
    assert refusal.sample == 1
    assert 'the command 3.2 of elbow_joint is beyond its limits -3.14159 to 3.14159' in (
        refusal.reason
    )


def test_a_singular_command_is_refused_and_not_jumped():
    q = regular(UR, 1)
    q[0, 4] = 0.0  # the axes of wrist_1 and wrist_3 are parallel
    compensator = Compensator(UR, UR_TRUE)
    result = compensate(compensator, q)
    refusal = only_refusal(result)
    assert 'near a singularity' in refusal.reason
    assert result.damped.all()
    assert np.isnan(result.joints).all()
    # What could be reached: the position, and orientation but about the axis that is lost.
    position_first = replace(compensator, orientation_weight=1e-3)
    assert len(compensate(position_first, q).refusals) == 1
    tolerant = replace(position_first, largest_orientation_error=5e-3)
    partly = compensate(tolerant, q)
    assert partly.refusals == ()
    assert np.abs(partly.correction).max() < 0.02
    assert partly.position[0] < 1e-6 < 1e-4 < partly.orientation[0]


@pytest.mark.parametrize('name', SIX)
def test_what_is_reached_near_a_singularity_is_never_worse_than_nothing(name):
    nominal = ROBOTS[name]
    true = faulty(nominal, CELL, np.random.default_rng(6))
    q = nominal.random_joints(3000, np.random.default_rng(7))
    result = compensate(Compensator(nominal, true), q)
    near = result.damped & ~result.limited.any(axis=1)
    assert np.count_nonzero(near) > 20
    after, before = (
        np.hypot(position, 0.3 * turn)
        for position, turn in (
            (result.position, result.orientation),
            (result.position_before, result.orientation_before),
        )
    )
    assert (after[near] <= before[near]).all()
    assert (after[near] < 0.99 * before[near]).mean() > 0.9
    assert result.converged[near].mean() > 0.9


def test_a_sample_that_does_not_converge_is_refused(monkeypatch):
    monkeypatch.setattr(following, 'ITERATIONS', 1)
    tolerant = Compensator(UR, UR_TRUE, largest_position_error=1.0, largest_orientation_error=1.0)
    result = compensate(tolerant, regular(UR, 3))
    assert not result.converged.any()
    assert len(result.refusals) == 3
    assert all('without convergence' in refusal.reason for refusal in result.refusals)


def test_a_path_through_a_singularity_stays_smooth():
    q = np.repeat(regular(UR, 4)[3:], 2001, axis=0)
    q[:, 4] = np.linspace(-0.5, 0.5, len(q))
    strict = compensate(Compensator(UR, UR_TRUE), q)
    refused = np.array([refusal.sample for refusal in strict.refusals])
    assert 0 < len(refused) < 500
    assert (np.abs(q[refused, 4]) < 0.2).all()
    gentle = Compensator(
        UR,
        UR_TRUE,
        largest_turn=0.02,
        largest_orientation_error=5e-3,
        orientation_weight=1e-3,
    )
    result = compensate(gentle, q)
    assert result.refusals == ()
    assert result.position.max() < 1e-6
    assert result.orientation.max() > 1e-3
    change = np.abs(np.diff(result.correction, axis=0)).max()
    assert change < 0.2 * (q[1, 4] - q[0, 4])
    far = np.abs(q[:, 4]) > 0.3
    assert result.orientation[far].max() < 1e-9


def test_a_correction_beyond_the_limit_is_refused():
    q = regular(UR, 20)
    free = compensate(Compensator(UR, UR_TRUE), q)
    size = np.abs(free.correction).max(axis=1)
    limit = float(np.median(size))
    result = compensate(Compensator(UR, UR_TRUE, largest_turn=limit), q)
    refused = {refusal.sample for refusal in result.refusals}
    assert refused >= set(np.flatnonzero(size > limit).tolist())
    assert len(refused) < len(q)
    assert (np.abs(result.correction[~np.isnan(result.correction)]) <= limit).all()


def test_the_calibration_of_another_robot_is_refused():
    other = replace(
        ROBOTS['ur5e'], joints=tuple(replace(j, mass=0.0) for j in ROBOTS['ur5e'].joints)
    )
    result = compensate(Compensator(UR, other), regular(UR, 20))
    assert len(result.refusals) == 20
    assert in_words(Compensator(UR, other), result) == '0 of 20 samples corrected'


def test_a_jump_of_the_correction_is_refused():
    q = regular(UR, 1) + np.linspace(0.0, 0.01, 101)[:, None]
    slack = UR_TRUE.with_effect_values({'elbow_joint.backlash': 5e-4})
    compensator = Compensator(UR, slack)
    back_and_forth = np.concatenate([q, q[::-1]])
    result = compensate(compensator, back_and_forth, approaches(back_and_forth))
    assert [refusal.sample for refusal in result.refusals] == [1, 102]  # the first moves
    assert 'elbow_joint jumps by 0.0009997 while' in result.refusals[1].reason
    smooth = compensate(compensator, q[1:], np.ones_like(q[1:]))
    assert smooth.refusals == ()


def test_backlash_is_taken_up_by_the_sense_of_the_move():
    slack = UR_TRUE.with_effect_values({f'{joint.name}.backlash': 2e-4 for joint in UR.joints})
    compensator = Compensator(UR, slack)
    q = regular(UR, 40)
    names = (*UR.joint_names, 'gripper')
    program = Program(names, np.column_stack([q, np.zeros(len(q))]))
    corrected, result = compensate_program(compensator, program)
    assert result.refusals == ()
    came = np.sign(np.diff(q, axis=0))
    errors = lengths(pose_errors(compensator, q[1:], corrected.positions[1:, :6], came))
    assert max(error.max() for error in errors) < 1e-9
    against = replace(program, approach=-approaches(q))
    other, _ = compensate_program(compensator, against)
    gap = (other.positions - corrected.positions)[1:, :6]
    np.testing.assert_allclose(gap, 4e-4 * came, rtol=0.05)


def test_approaches_are_the_last_moves():
    q = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.5], [0.5, 0.5], [0.5, 0.6]])
    expected = [[0, 0], [1, 0], [1, -1], [-1, -1], [-1, 1]]
    np.testing.assert_array_equal(approaches(q), expected)


@pytest.mark.parametrize(
    ('setting', 'complaint'),
    [
        ({'largest_turn': 0.0}, 'largest_turn must be a positive number, not 0.0'),
        ({'largest_change': np.nan}, 'largest_change must be a positive number, not nan'),
        ({'orientation_weight': -1.0}, 'orientation_weight must be a positive number'),
        ({'tool': (0.0, np.inf, 0.0)}, 'tool must be three finite numbers'),
    ],
)
def test_settings_out_of_range_are_refused(setting, complaint):
    with pytest.raises(ConfigError, match=complaint):
        Compensator(UR, UR_TRUE, **setting)


def test_chains_of_other_joints_are_refused():
    with pytest.raises(ConfigError, match='same joints in one order'):
        Compensator(UR, ROBOTS['puma560'])


@pytest.mark.parametrize(
    ('joints', 'complaint'),
    [
        (np.zeros((2, 5)), r'shape \(N, 6\), not \(2, 5\)'),
        (np.zeros((0, 6)), r'shape \(N, 6\)'),
        (np.full((2, 6), np.nan), 'joint values of sample 0'),
    ],
)
def test_wrong_joint_values_are_refused(joints, complaint):
    with pytest.raises(InputError, match=complaint):
        compensate(Compensator(UR, UR_TRUE), joints)


# Programs


@pytest.mark.parametrize('name', ['ur10e', 'kuka_iiwa14', 'kuka_youbot', 'ur10e_on_linear_axis'])
@pytest.mark.parametrize('geared', [False, True])
def test_velocities_and_accelerations_are_those_of_the_corrected_path(name, geared):
    nominal = ROBOTS[name]
    true = faulty(nominal, CELL, np.random.default_rng(5))
    if geared:
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


@pytest.mark.parametrize('joint', UR.joint_names)
@pytest.mark.parametrize('rename', [lambda name: name.removesuffix('_joint'), lambda name: 'a'])
def test_the_unknown_joint_is_that_of_the_program(joint, rename):
    """Not the one of the arm that it is without; an axis of something else is in no one's way."""
    names = [rename(name) if name == joint else name for name in UR.joint_names]
    values = np.zeros((2, 6))
    with pytest.raises(UnknownNameError, match='unknown joint in the program') as caught:
        compensate_program(Compensator(UR, UR), Program(tuple(names), values))
    assert caught.value.name == rename(joint)
    assert caught.value.alternatives == UR.joint_names


def test_a_joint_that_a_program_lacks_is_named():
    with pytest.raises(InputError, match='no values of wrist_3_joint'):
        compensate_program(Compensator(UR, UR), Program(UR.joint_names[:5], np.zeros((2, 5))))


@pytest.mark.parametrize(
    ('change', 'error', 'complaint'),
    [
        ({'names': ('a', *UR.joint_names[1:])}, UnknownNameError, 'unknown joint in the program'),
        ({'names': UR.joint_names[:5]}, InputError, '5 joint names do not fit'),
        ({'velocities': np.zeros((3, 5))}, InputError, 'rates of shape'),
        ({'velocities': np.full((3, 6), np.inf)}, InputError, 'finite'),
        ({'accelerations': np.zeros((3, 6))}, InputError, 'needs velocities as well'),
    ],
)
def test_programs_that_do_not_fit_are_refused(change, error, complaint):
    program = replace(Program(UR.joint_names, regular(UR, 3)), **change)
    with pytest.raises(error, match=complaint):
        compensate_program(Compensator(UR, UR_TRUE), program)


# Files and command line

TABLE = """label,q6,q5,q4,q3,q2,q1,speed
pick, 0.1,0.7,-1.2,1.1,-1.4,1e-1,"1,5"
place,0.2,0.8,-1.1,1.2,-1.3,0.3,
"""


def point(positions, seconds, **more):
    time = {'sec': seconds, 'nanosec': 0}
    empty = {'velocities': [], 'accelerations': [], 'effort': []}
    return {'positions': positions} | empty | more | {'time_from_start': time}


def trajectory(q, names=UR.joint_names, **more):
    """Return a message as `ros2 topic echo` prints it."""
    points = [point(row, k, **more) for k, row in enumerate(np.asarray(q).tolist())]
    header = {'stamp': {'sec': 7, 'nanosec': 3}, 'frame_id': ''}
    message = {'header': header, 'joint_names': list(names), 'points': points}
    return yaml.safe_dump(message, sort_keys=False) + '---\n'


@pytest.fixture
def run(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'calibration.yaml').write_text(dump_chain(UR_TRUE, {'source': 'simulation'}))

    def run(program, *arguments, chain='ur10e', out='out'):
        out = f'{out}{program.suffix}'
        capsys.readouterr()
        options = ['--chain', chain, '--calibration', 'calibration.yaml', '--out', out]
        status = main(['compensate', str(program), *options, *map(str, arguments)])
        said, err = capsys.readouterr()
        return status, said, err

    return run


def test_a_program_of_more_joints_than_the_arm_has_is_refused(run, tmp_path):
    """Its columns may begin with those of another axis."""
    path = tmp_path / 'program.csv'
    path.write_text('q1,q2,q3,q4,q5,q6,q7\n1.2,0.1,-1.4,1.1,-1.2,0.7,0.1\n')
    status, _, err = run(path)
    assert status == 1
    assert 'column q7, but the arm has 6 joints only' in err


@pytest.mark.parametrize('oriented', [True, False])
def test_the_command_line_says_how_well_the_orientation_is_known(run, tmp_path, capsys, oriented):
    """By positions of a target on the last axis alone it is not, and a long tool would be off."""
    rng = np.random.default_rng(1)
    true = UR_TRUE.with_frame('tool', Frame(se3.transform(np.eye(3), np.array([0, 0, 0.01]))))
    seen = measure(true, UR.random_joints(60, rng), rng, 1e-4, 3e-4, oriented=oriented)
    # what the data tell of the size of errors would do for the orientation, too
    priors = {} if oriented else {'*_joint.*': 0.1}
    found = identify(Problem(UR, seen, sigma_position=1e-4, priors=priors))
    folder = tmp_path / 'result'
    folder.mkdir()
    (folder / 'calibration.yaml').write_text(Calibration.of(found).dump())
    (folder / 'result.json').write_text(json.dumps(as_document(found, {})))
    (tmp_path / 'program.csv').write_text(TABLE)
    status, said, err = run(tmp_path / 'program.csv', '--calibration', 'result')
    assert status == 0
    assert 'sigma of the calibration at these poses: 0.0' in said
    assert ('does not know the orientation' in err) is not oriented


def test_chains_given_the_wrong_way_round_are_refused(run, tmp_path):
    """The correction would go the wrong way, and double the error."""
    path = tmp_path / 'program.csv'
    path.write_text(TABLE)
    (tmp_path / 'nominal.yaml').write_text(dump_chain(UR))
    swapped = ('--calibration', 'nominal.yaml')
    status, _, err = run(path, *swapped, chain='calibration.yaml')
    assert status == 1
    assert 'is a chain, but no calibration' in err
    assert not (tmp_path / 'out.csv').exists()


def test_the_calibration_of_a_cousin_is_refused(run, tmp_path):
    """A tenth of the poses could be corrected from one arm to the other, by centimetres."""
    path = tmp_path / 'program.csv'
    path.write_text(TABLE)
    record = {'accepted': True, 'nominal': nominal_document(ROBOTS['ur10'])}
    (tmp_path / 'calibration.yaml').write_text(dump_chain(ROBOTS['ur10'], record))
    status, _, err = run(path)
    assert status == 1
    assert 'identified from another nominal chain' in err


def test_a_table_is_corrected_and_its_other_columns_kept(run, tmp_path):
    path = tmp_path / 'program.csv'
    path.write_text(TABLE)
    status, said, err = run(path)
    assert (status, err) == (0, '')
    assert said.startswith('wrote out.csv: 2 of 2 samples corrected, by ')
    assert 'largest error' in said
    before, after = (
        list(csv.DictReader((tmp_path / name).read_text().splitlines()))
        for name in ('program.csv', 'out.csv')
    )
    assert [list(row) for row in after] == [list(row) for row in before]
    for key in ('label', 'speed'):
        assert [row[key] for row in after] == [row[key] for row in before]
    columns = [f'q{k + 1}' for k in range(6)]
    q, corrected = (
        np.array([[float(row[key]) for key in columns] for row in rows])
        for rows in (before, after)
    )
    expected = compensate(Compensator(UR, UR_TRUE), q).joints
    np.testing.assert_allclose(corrected, expected, rtol=0, atol=1e-15)


def test_a_trajectory_is_corrected_and_the_rest_kept(run, tmp_path):
    q = regular(UR, 1) + 0.02 * np.arange(4)[:, None]
    names = ['gripper', *UR.joint_names]
    path = tmp_path / 'program.yaml'
    rates = {'velocities': [0.02] * 7, 'effort': [1.0] * 7}
    path.write_text(trajectory(np.column_stack([np.ones(4), q]), names, **rates))
    status, _, err = run(path)
    assert (status, err) == (0, '')
    before = yaml.safe_load(path.read_text().removesuffix('---\n'))
    after = yaml.safe_load((tmp_path / 'out.yaml').read_text())
    result = compensate(Compensator(UR, UR_TRUE), q)
    for k, corrected in enumerate(after['points']):
        np.testing.assert_allclose(corrected['positions'], [1.0, *result.joints[k]], atol=1e-15)
        speeds = np.array(corrected['velocities'])
        assert speeds[0] == 0.02
        assert 0.0 < np.abs(speeds[1:] - 0.02).max() < 1e-3
        assert corrected['accelerations'] == []
        corrected.update(positions=[], velocities=[])
        before['points'][k].update(positions=[], velocities=[])
    assert after == before
    assert list(after) == list(before)


@pytest.mark.parametrize('suffix', ['.csv', '.yaml', '.yml'])
def test_a_program_is_written_as_it_was_read(tmp_path, suffix):
    q = np.random.default_rng(0).normal(size=(50, 6))
    path = tmp_path / f'program{suffix}'
    if suffix == '.csv':
        rows = ['q1,q2,note,q3,q4,q5,q6']
        rows += [','.join([*map(repr, row[:2]), 'ä', *map(repr, row[2:])]) for row in q.tolist()]
        path.write_text('\n'.join(rows) + '\n', encoding='utf-8')
    else:
        rates = {key: [0.1, 1e-05, 0, -2, 3, 4.5] for key in ('velocities', 'accelerations')}
        path.write_text(trajectory(q, **rates))
    source = read_program(path, UR.joint_names)
    np.testing.assert_array_equal(source.program.positions, q)
    assert len(source.places) == 50
    text = source.text_with(source.program)
    if suffix == '.csv':
        assert text == path.read_text(encoding='utf-8')
    else:
        given = yaml.safe_load(path.read_text().removesuffix('---\n'))
        assert yaml.safe_load(text) == given
    again = tmp_path / f'again{suffix}'
    again.write_text(text, encoding='utf-8')
    assert read_program(again, UR.joint_names).text_with(source.program) == text


def test_signs_in_a_table_are_the_approach(tmp_path):
    path = tmp_path / 'program.csv'
    path.write_text('q1,q2,s1,s2\n1,2,-0.5,0\n3,4,1,7\n')
    program = read_program(path, ['a', 'b']).program
    np.testing.assert_array_equal(program.approach, [[-1.0, 0.0], [1.0, 1.0]])


@pytest.mark.parametrize('suffix', ['.csv', '.yaml'])
@pytest.mark.parametrize('force', [False, True])
def test_nothing_is_written_when_a_sample_is_refused(run, tmp_path, suffix, force):
    q = regular(UR, 3)
    q[1, 4] = 0.0
    q[2, 2] = 4.0
    path = tmp_path / f'program{suffix}'
    if suffix == '.csv':
        rows = [','.join(map(repr, row)) for row in q.tolist()]
        path.write_text('\n'.join(['q1,q2,q3,q4,q5,q6', '', *rows]) + '\n')
    else:
        path.write_text(trajectory(q))
    out = tmp_path / f'out{suffix}'
    if force:
        out.write_text('precious')
    status, said, err = run(path, *(['--force'] if force else []))
    assert (status, said) == (NOT_ACCEPTED, '')
    first, second, third = err.splitlines()
    assert first.startswith('calib_ros: nothing is written, 1 of 3 samples corrected')
    places = ('line 4', 'line 5') if suffix == '.csv' else ('point 2', 'point 3')
    assert second.startswith(f'{places[0]}: near a singularity')
    assert third.startswith(f'{places[1]}: the command 4 of elbow_joint is beyond its limits')
    assert out.read_text() == 'precious' if force else not out.exists()


def test_options_reach_the_compensator(run, tmp_path):
    path = tmp_path / 'program.yaml'
    q = regular(UR, 1)
    q[0, 4] = 0.0
    path.write_text(trajectory(q))
    tolerant = ('--largest-orientation-error', 0.005, '--orientation-weight', 1e-3)
    assert run(path)[0] == NOT_ACCEPTED
    assert run(path, '--largest-turn', 1e-5, *tolerant)[0] == NOT_ACCEPTED
    status, said, err = run(path, '--tool', 0.1, 0.2, 0.3, *tolerant)
    assert (status, err) == (0, '')
    assert '1 corrected in part' in said


def test_an_existing_file_is_kept_unless_forced(run, tmp_path):
    path, out = tmp_path / 'program.csv', tmp_path / 'out.csv'
    path.write_text(TABLE)
    out.write_text('precious')
    status, said, err = run(path)
    assert (status, said) == (1, '')
    assert 'out.csv exists already: choose another name or --force' in err
    assert out.read_text() == 'precious'
    assert run(path, '--force')[0] == 0
    assert out.read_text().startswith('label,q6')


def test_a_program_is_not_compensated_in_place(run, tmp_path):
    path = tmp_path / 'program.csv'
    path.write_text(TABLE)
    status, _, err = run(path, '--force', out='program')
    assert status == 1
    assert 'compensated twice is wrong' in err
    assert path.read_text() == TABLE


WRONG = [
    ('p.txt', 'x', 'must be a table'),
    ('p.csv', '', 'has no column q1'),
    ('p.csv', 'q1,q2,q3,q4,q5,q6\n', 'has no rows'),
    ('p.csv', 'q1,q2,q3,q4,q5\n1,2,3,4,5\n', 'has no column q6'),
    ('p.csv', 'q1,q1,q2,q3,q4,q5,q6\n1,1,2,3,4,5,6\n', 'several columns q1'),
    ('p.csv', 'q1,q2,q3,q4,q5,q6\n1,2,3,4,5\n', "line 2: q6 must be a number, not ''"),
    ('p.csv', 'q1,q2,q3,q4,q5,q6\n1,2,3,4,5,x\n', "line 2: q6 must be a number, not 'x'"),
    ('p.csv', 'q1,q2,q3,q4,q5,q6\n1,2,3,4,5,nan\n', 'q6 must be a number'),
    ('p.yaml', '[', 'is not valid YAML'),
    ('p.yaml', '', 'must be a trajectory_msgs/JointTrajectory'),
    ('p.yaml', 2 * trajectory(np.zeros((2, 6))), 'must hold one YAML document, not 2'),
    ('p.yaml', 'a: 1', 'must be a trajectory_msgs/JointTrajectory'),
    ('p.yaml', 'joint_names: [a]\npoints: []', 'must be a trajectory_msgs/JointTrajectory'),
    ('p.yaml', "joint_names: [a]\npoints: ['...']", 'point 1 .*--full-length'),
    ('p.yaml', 'joint_names: [a]\npoints: [{positions: []}]', 'has no positions'),
    ('p.yaml', trajectory(np.zeros((2, 5))), 'positions must be a list of 6 numbers'),
    ('p.yaml', trajectory(np.zeros((2, 6)), 'abcdef'), 'unknown joint in the program'),
    ('p.yaml', trajectory(np.zeros((2, 6)), velocities=[True] * 6), 'finite number, not True'),
    (
        'p.yaml',
        trajectory(np.zeros((2, 6))).replace('velocities: []', 'velocities: [0,0,0,0,0,0]', 1),
        'point 2: velocities must be a list of 6 numbers',
    ),
    (
        'p.yaml',
        trajectory(np.zeros((2, 6)), accelerations=[0.0] * 6),
        'needs velocities as well',
    ),
]


@pytest.mark.parametrize(('name', 'text', 'complaint'), WRONG)
def test_files_that_are_no_programs_are_refused(run, tmp_path, name, text, complaint):
    path = tmp_path / name
    path.write_text(text)
    status, said, err = run(path)
    assert (status, said) == (1, '')
    assert err.startswith('calib_ros: ')
    import re

    assert re.search(complaint, err)
    assert not (tmp_path / f'out{path.suffix}').exists()


def test_the_whole_way_from_identification_to_program(run, tmp_path, capsys):
    rng = np.random.default_rng(3)
    seen = measure(UR_TRUE, UR.random_joints(40, rng), rng, 5e-5, 2e-4)
    header = [f'q{k + 1}' for k in range(6)] + ['x', 'y', 'z', 'qx', 'qy', 'qz', 'qw']
    rows = np.hstack([seen.joints, seen.positions, se3.to_quat(seen.rotations)])
    np.savetxt('cell.csv', rows, delimiter=',', header=','.join(header), comments='')
    assert main(['identify', '--csv', 'cell.csv', '--chain', 'ur10e', '--out', 'result']) == 0
    (tmp_path / 'calibration.yaml').write_bytes(
        (tmp_path / 'result' / 'calibration.yaml').read_bytes()
    )
    q = regular(UR, 30, seed=2)
    path = tmp_path / 'program.csv'
    np.savetxt(path, q, delimiter=',', header=','.join(header[:6]), comments='')
    status, _, err = run(path)
    assert (status, err) == (0, '')
    joints = np.loadtxt('out.csv', delimiter=',', skiprows=1)
    found = load_chain('calibration.yaml')
    wanted = replace(UR, base=found.base, tool=found.tool).forward(q)[:, :3, 3]
    after, before = (
        np.linalg.norm(UR_TRUE.forward(each)[:, :3, 3] - wanted, axis=1) for each in (joints, q)
    )
    assert after.max() < 2e-4 < 1e-3 < before.max()
