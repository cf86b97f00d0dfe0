# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from commanded import (
    CELL,
    ROBOTS,
    UR,
    UR_TRUE,
    at_limit,
    bare,
    missed,
    numeric_jacobian,
    only_refusal,
    regular,
)
from hypothesis import given, strategies as st

from calib_ros.apply.compensation import compensate, in_words
from calib_ros.apply.compensator import Compensator
from calib_ros.apply.simulation import faulty
from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.visits import approaches
from calib_ros.kinematics import effects, follower
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.follower import mobility
from calib_ros.settings import EXACT

SIX = ['puma560', 'staubli_tx90l', 'ur10e']
REDUNDANT = ['kuka_iiwa14', 'ur10e_on_linear_axis']


def with_effects(chain, seed=0):
    groups = ('ratio', 'coupling', 'eccentricity', 'gravity')
    names = [name for group in groups for name in effects.members(chain, group)]
    last = chain.joints[-1].name
    names += [f'{last}.sin_100', f'{last}.cos_100']
    values = np.random.default_rng(seed).normal(scale=2e-4, size=len(names))
    return chain.with_effect_values(dict(zip(names, values, strict=True)))


@pytest.mark.parametrize('name', [*SIX, *REDUNDANT])
def test_arms_of_six_joints_and_more_reach_the_pose_by_the_least_change(name):
    """Of geometric errors, and of others besides."""
    nominal = ROBOTS[name]
    geometric, other = (faulty(nominal, CELL, np.random.default_rng(k)) for k in (1, 2))
    q = regular(nominal, 100)
    for true in (geometric, with_effects(other)):
        compensator = Compensator(nominal, true)
        result = compensate(compensator, q)
        assert result.refusals == ()
        assert missed(compensator, q, result.joints).max() < (1e-9 if name in SIX else 1e-8)
        before = missed(compensator, q, q)
        assert before[0].max() > 5e-4
        found = [result.position_before, result.orientation_before]
        np.testing.assert_allclose(found, before, atol=1e-12)
        assert result.converged.all()
        assert not result.limited.any()
        assert not result.damped.any()
        scaled = numeric_jacobian(true, result.joints) * compensator.largest
        idle = np.linalg.svd(scaled)[2][:, 6:]
        change = result.correction / compensator.largest
        share = np.einsum('nki,ni->nk', idle, change) / np.linalg.norm(change, axis=1)[:, None]
        assert np.abs(share).max(initial=0.0) < 1e-5


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
    for share in (np.all, np.any):
        np.testing.assert_array_equal(share(np.isnan(result.joints), axis=1), refused)
    assert (np.abs(result.correction[~refused]) <= compensator.largest).all()
    assert (np.abs(result.joints[~refused]) <= 2.0).all()
    position, turn = missed(compensator, q[~refused], result.joints[~refused])
    freedoms, places, _ = mobility(bare(nominal))
    if places == 3:
        assert (position <= 1e-6).all()
    else:
        before, _ = missed(compensator, q[~refused], q[~refused])
        assert (position <= before + 1e-5).all()
    assert (result.reachable[~refused] <= 1e-6).all()
    assert (turn <= (1e-6 if freedoms == 6 else 0.02)).all()


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


@pytest.mark.parametrize('side', [1.0, -1.0])
def test_a_command_beyond_a_limit_is_refused(side):
    q = regular(UR, 3)
    q[1, 2] = side * 3.2
    compensator, shares = Compensator(UR, UR_TRUE), []
    refusal = only_refusal(compensate(compensator, q, progress=shares.append))
    assert shares
    assert refusal.sample == 1
    assert f'{side * 3.2} of elbow_joint is beyond its limits -3.14159 to 3.14' in refusal.reason
    within = side * (3.2 - 2.0 * np.pi)
    assert refusal.reason.endswith(f'a full turn away, {within:.6g} is within them: give that')
    tolerant = replace(compensator, largest_position_error=1.0, largest_orientation_error=1.0)
    assert 'the command' in only_refusal(compensate(tolerant, q)).reason
    for beyond, said in ((0.5, False), (2.0, True)):  # of what a command may lie beyond a limit
        q[1, 2] = side * (np.pi + beyond * EXACT)
        reasons = ' '.join(each.reason for each in compensate(compensator, q).refusals)
        assert ('the command' in reasons) is said


def test_a_pose_that_the_shorter_arm_does_not_reach_says_so():
    shorter = UR.with_offsets({'elbow_joint.a': 1e-3})  # a is negative
    q = np.array([[0.0, -1.0, elbow, 0.5, 1.0, 0.0] for elbow in (0.06, 0.12)])
    refusal = only_refusal(compensate(Compensator(UR, shorter), q))
    assert refusal.sample == 0
    assert refusal.reason == (
        'at the end of the reach, or near a singularity: 0.3360 mm and 0.6822 mrad remain'
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


@pytest.mark.parametrize('name', ['franka_panda', 'ur10e_on_linear_axis'])
def test_what_a_redundant_arm_reaches_within_its_limits_is_not_refused(name):
    chain, rng = ROBOTS[name], np.random.default_rng(0)
    compensator = Compensator(chain, faulty(chain, CELL, rng))
    found = compensate(compensator, chain.random_joints(2000, rng))
    reached = (found.position < EXACT) & (found.orientation < EXACT)
    reached &= (np.abs(found.correction) <= compensator.largest).all(axis=1)
    assert not reached[[each.sample for each in found.refusals]].any()
    too_far = [each.reason for each in found.refusals if 'would need' in each.reason]
    assert too_far
    assert all('more than 0.1 rad' in each for each in too_far)
    assert not any('0.0000 mm and 0.0000 mrad' in each.reason for each in found.refusals)


def test_a_sample_that_does_not_converge_is_refused(monkeypatch):
    once = partial(follower.minimise_batch, rounds=1)
    monkeypatch.setattr(follower, 'minimise_batch', once)
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
        UR, UR_TRUE, largest_turn=0.02, largest_orientation_error=5e-3, orientation_weight=1e-3
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
    ur5e = ROBOTS['ur5e']
    other = replace(ur5e, joints=tuple(replace(j, mass=0.0) for j in ur5e.joints))
    result = compensate(Compensator(UR, other), regular(UR, 20))
    assert len(result.refusals) == 20
    assert in_words(Compensator(UR, other), result) == '0 of 20 points corrected'


def test_a_calibration_is_used_within_the_limits_for_which_it_was_identified(arm):
    """Those of a controller may be wider; the whole joint range was that of the calibration."""
    q = regular(arm.chain, 4)
    ends = [(float(low), float(high)) for low, high in zip(q[0] - 0.1, q[0] + 0.1, strict=True)]
    rows = zip(arm.chain.joints, ends, strict=True)
    inner = tuple(replace(joint, lower=low, upper=high) for joint, (low, high) in rows)
    known = replace(arm.region.chain, joints=inner)
    region = replace(arm.region, chain=known, limit=np.inf)
    result = compensate(Compensator(bare(UR), arm.chain, region=region), q)
    assert [each.sample for each in result.refusals] == [1, 2, 3]
    low, high = ends[0]
    told = f'not valid in 75 % of the program, as here: {q[1, 0]:.6g} of shoulder_pan_joint is '
    told += f'beyond the limits for which it was identified, {low:.6g} to {high:.6g}; identify'
    assert told in result.refusals[0].reason


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


def test_approaches_are_the_last_moves():
    q = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.5], [0.5, 0.5], [0.5, 0.6]])
    expected = [[0, 0], [1, 0], [1, -1], [-1, -1], [-1, 1]]
    np.testing.assert_array_equal(approaches(q), expected)
    with pytest.raises(InputError, match=r'approach must have the shape \(5, 6\)'):
        compensate(Compensator(UR, UR_TRUE), np.zeros((5, 6)), np.array(expected))


@pytest.mark.parametrize(
    ('setting', 'complaint'),
    [
        ({'largest_turn': 0.0}, 'largest_turn must be a positive number, not 0.0'),
        ({'largest_shift': np.inf}, 'largest_shift must be a positive number, not inf'),
        ({'largest_change': np.nan}, 'largest_change must be of type float, not nan'),
        ({'orientation_weight': -1.0}, 'orientation_weight must be a positive number'),
        ({'largest_turn': 5.0}, r'must be at most 3.2, not 5 .*\[rad\]'),
        ({'largest_position_error': 50.0}, r'at most 1, not 50 .*\[m\]'),
        ({'tool': (0.0, 0.0)}, r'tool must be of type .* not \(0.0, 0.0\)'),
        ({'tool': (0.0, np.inf, 0.0)}, 'tool must be within 5 m'),
        ({'tool': (0.0, -5.1, 0.0)}, 'tool must be within 5 m'),
        ({'tool': (0.0, 0.0, 150.0)}, 'tool must be within 5 m, not .*: 150 mm is 0.15'),
    ],
)
def test_settings_out_of_range_are_refused(setting, complaint):
    with pytest.raises(ConfigError, match=complaint):
        Compensator(UR, UR_TRUE, **setting)


def test_chains_of_other_joints_are_refused():
    with pytest.raises(ConfigError, match='are they the same arm'):
        Compensator(UR, ROBOTS['puma560'])


@pytest.mark.parametrize(
    ('joints', 'complaint'),
    [
        (np.zeros((2, 5)), r'shape \(N, 6\) .* not \(2, 5\)'),
        (np.zeros((0, 6)), 'no joint values'),
        (np.full((2, 6), np.nan), r'NaN or infinite .* \[0, 0\]'),
        (np.repeat([[0.0], [0.0], [np.inf]], 6, axis=1), r'NaN or infinite .* \[2, 0\]'),
    ],
)
def test_wrong_joint_values_are_refused(joints, complaint):
    with pytest.raises(InputError, match=complaint):
        compensate(Compensator(UR, UR_TRUE), joints)
