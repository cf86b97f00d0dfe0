# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Several or all joint zeros have changed at once, frames, load or scale; few poses tell."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fits import NOISE, SCARA, SIGMAS, UR10E, problem, rms

from calib_ros import Calibration, Problem, difference, identify, recalibrate
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.decision.changes import reason_in_words
from calib_ros.decision.mistakes import diagnose
from calib_ros.errors import InputError
from calib_ros.identification.recalibrated import ANEW
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.parameter import Parameter

ALL = np.radians([0.1, -0.15, 0.08, 0.2, -0.12, 0.05])


@cache
def calibrated(oriented):
    true = faulty(UR10E, Cell(), np.random.default_rng(4))
    return true, Calibration.of(identify(problem(true, 60, 0, oriented))), oriented


@pytest.fixture(params=[True, False])
def earlier(request):
    """Return an arm, its calibration from poses or positions, and which of these."""
    return calibrated(request.param)


def slipped(true, zeros):
    return true.with_offsets({str(j.driven): x for j, x in zip(true.joints, zeros, strict=True)})


def owners(changed):
    return [{each.owner for each in reasons} for reasons in changed]


def test_new_zeros_of_all_joints_are_one_change(earlier):
    """Mastered again: with at most three changes, one by one, two of three were refused."""
    true, previous, oriented = earlier
    now = slipped(true, ALL)
    found = recalibrate(previous, problem(now, 8, int(oriented), oriented), 0.1)
    assert found.accepted
    assert owners(found.changed) == [{'all joints'}]
    assert found.changed[0][0].in_words() == 'all joints (theta)'
    q = UR10E.random_joints(300, np.random.default_rng(99))
    assert rms(found.calibration.chain, now, q) < 0.1 * rms(previous.chain, now, q)


@pytest.mark.parametrize(
    ('earlier', 'joints'), [(True, (0, 5)), (False, (3, 4))], indirect=['earlier']
)
def test_two_changed_zeros_are_told_by_name(earlier, joints):
    """Single explanations of both were a moved base, and the wrong joint."""
    true, previous, oriented = earlier
    zeros = np.zeros(6)
    zeros[list(joints)] = 2e-3, -1e-3
    found = recalibrate(previous, problem(slipped(true, zeros), 8, 1, oriented), 0.1)
    assert found.accepted
    told = owners(found.changed)
    assert set().union(*told) >= {UR10E.joint_names[k] for k in joints}
    assert all('all joints' not in each for each in told)


@pytest.mark.parametrize(('earlier', 'k'), [(True, 0), (False, 1)], indirect=['earlier'])
def test_a_zero_that_is_off_by_a_turn_of_the_motor_is_the_only_change(earlier, k, unsearched):
    """It is far larger than usual changes: other joints, or the whole link, shared it."""
    true, previous, oriented = earlier
    joint, turn = UR10E.joint_names[k], (-3.6, 7.2)[k % 2]
    now = true.with_offsets({f'{joint}.theta': np.radians(turn)})
    found = recalibrate(previous, problem(now, 8, 1, oriented), 0.1)
    assert found.accepted
    ((reason,),) = found.changed
    assert reason.names == (f'{joint}.theta',)
    assert reason.change[0] == pytest.approx(np.radians(turn), abs=4.0 * reason.sigma[0])
    assert reason.sigma[0] < 2e-4


def test_a_turn_of_the_motor_is_no_mistake_of_the_table(earlier):
    true, _, oriented = earlier
    now = true.with_offsets({'shoulder_lift_joint.theta': np.radians(7.2)})
    assert diagnose(problem(now, 8, 1, oriented), far=True) is None


def test_a_slipped_zero_of_the_last_joint_is_told_by_positions(earlier):
    """There it moves the target only: a turn of it does not show."""
    true, previous, oriented = earlier
    now = slipped(true, [0.0] * 5 + [4e-3])
    found = recalibrate(previous, problem(now, 8, 1, oriented), 0.1)
    assert 'wrist_3_joint' in owners(found.changed)[0]


def test_a_link_that_is_bent_any_way_is_one_change(earlier):
    """Six numbers place the axis after it: theta and d of its row as well."""
    true, previous, oriented = earlier
    seed = int(oriented)
    kinds = [f'wrist_1_joint.{kind}' for kind in ('a', 'alpha', 'd', 'theta')]
    kinds += ['wrist_2_joint.d', 'wrist_2_joint.theta']
    offsets = dict(zip(kinds, np.random.default_rng(seed).normal(scale=2e-3, size=6), strict=True))
    found = recalibrate(previous, problem(true.with_offsets(offsets), 12, seed, oriented), 0.1)
    assert found.accepted
    assert owners(found.changed) == [{'wrist_1_joint'}]
    words = reason_in_words(found.changed[0])
    assert 'wrist_1_joint (theta, d, a, alpha) with wrist_2_joint (theta, d)' in words
    assert words.count('wrist_1_joint (') == 1


@pytest.mark.parametrize(
    ('earlier', 'frame'), [(True, 'base'), (False, 'tool')], indirect=['earlier']
)
def test_a_frame_far_from_where_it_was_is_the_only_change(earlier, frame):
    """Moved by metres and turned at will: no linear model of it holds."""
    true, previous, oriented = earlier
    rng = np.random.default_rng(3)
    now = replace(true, **{frame: random_frame(rng, 2.0 if frame == 'base' else 0.2)})
    found = recalibrate(previous, problem(now, 8, 1, oriented), 0.1)
    assert found.accepted
    (reasons,) = found.changed
    assert reasons[0].owner == frame
    assert {Parameter(name).owner for name in reasons[0].names} == {frame}
    assert found.calibration.record['changed'] == [reason_in_words(reasons)]
    moved = true.frame(frame).matrix[:3, 3] - now.frame(frame).matrix[:3, 3]
    assert found.before.rms_mm > 100.0 * np.linalg.norm(moved)
    assert rms(found.calibration.chain, now, UR10E.random_joints(300, rng)) < 1e-4


@pytest.mark.parametrize('earlier', [False], indirect=True)
def test_a_device_far_away_is_told_if_links_seem_to_have_changed_instead(earlier):
    """In a narrow region bent links explained more of it than a base that moved a little."""
    true, previous, oriented = earlier
    rng = np.random.default_rng(24)
    there = replace(true, base=random_frame(rng, 2.0))
    joints = UR10E.random_joints(1, rng) + rng.uniform(-0.2, 0.2, (10, 6))
    poses = Problem(UR10E, measure(there, joints, rng, *NOISE, oriented), **SIGMAS)
    found = recalibrate(previous, poses, 0.1)
    assert found.accepted
    assert owners(found.changed) == [{'base'}]
    assert rms(found.calibration.chain, there, joints) < 1e-4


@pytest.mark.parametrize(
    ('earlier', 'frame', 'seed'),
    [(True, 'tool', 2), (False, 'base', 37), (True, 'base', 41)],
    indirect=['earlier'],
)
def test_a_frame_that_was_hit_is_not_blamed_on_a_link(earlier, frame, seed):
    """In a narrow region a length imitates it: accepted, it made the arm worse elsewhere."""
    true, previous, oriented = earlier
    rng = np.random.default_rng(seed)
    now = true.with_offsets({f'{frame}.{kind}': rng.normal(scale=3e-4) for kind in 'xyz'})
    joints = UR10E.random_joints(1, rng) + rng.uniform(-0.3, 0.3, (12, 6))
    poses = Problem(UR10E, measure(now, joints, rng, *NOISE, oriented), **SIGMAS)
    found = recalibrate(previous, poses, 0.1)
    links = replace(found.calibration.chain, base=previous.chain.base, tool=previous.chain.tool)
    q = UR10E.random_joints(300, np.random.default_rng(99))
    worse = rms(links, true, q) > 1.5 * rms(previous.chain, true, q)
    assert not (found.accepted and worse)
    assert any(frame in each for each in owners(found.changed))


def test_another_load_is_no_change_of_the_arm(earlier, none_odd):
    """Zeros imitated its bending near some poses, and made the arm worse elsewhere."""
    true, previous, oriented = earlier
    last = UR10E.joint_names[-1]
    bent = {f'{joint}.gravity_{last}': 3e-4 for joint in UR10E.joint_names[1:4]}
    now = true.with_effects(list(bent)).with_offsets(bent)
    found = recalibrate(previous, problem(now, 12, 0, oriented), 0.1)
    assert not found.accepted
    assert owners(found.changed)[0] >= {'load'}
    assert found.outside is found.changed[0][0]
    assert 'as under another load' in found.refusal()[0]
    assert 'the load of the arm' in found.outside.in_words()
    assert found.document()['refusal'].endswith(f'or, with this one, {ANEW}')


TWO = Chain('two', 'standard', (Joint('j1', a=0.4, alpha=1.5, d=0.2), Joint('j2', a=0.3)))
ONE_TURN = np.radians([0.0, 0.0, 7.2, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ('chain', 'change', 'owner', 'said'),
    [
        (UR10E, lambda true: slipped(true, ALL), 'all joints', ' (theta); nothing else: was it m'),
        (UR10E, lambda true: slipped(true, ONE_TURN), 'elbow_joint', '.theta by +125.'),
        # Beside free frames only its elbow has a zero; an arm of two joints has none.
        (SCARA, lambda true: slipped(true, [1e-3, 2e-3, 1e-3, -2e-3]), 'elbow', '.theta by +'),
        (TWO, lambda true: true.with_offsets({'j1.a': 2e-3}), 'j1', '.a by +'),
    ],
)
def test_two_calibrations_differ_by_all_zeros_only_if_more_than_three_show(
    chain, change, owner, said, unsearched
):
    true = faulty(chain, Cell(), np.random.default_rng(4))
    pair = enumerate((true, change(true)))
    first, second = (Calibration.of(identify(problem(arm, 50, k, chain=chain))) for k, arm in pair)
    found = difference(first, second)
    assert owners(found.changed) == [{owner}]
    assert f'changed: {owner}{said}' in found.in_words()


def test_two_calibrations_with_gravity_differ_by_the_load():
    true = faulty(UR10E, Cell(), np.random.default_rng(4))
    bent = {f'{joint}.gravity_{UR10E.joint_names[-1]}': 5e-4 for joint in UR10E.joint_names[1:3]}
    both = (problem(arm, 50, k) for k, arm in enumerate((true, true.with_effect_values(bent))))
    first, second = (Calibration.of(identify(replace(p, effects=('gravity',)))) for p in both)
    said = difference(first, second).in_words()
    assert said.startswith('changed: the load of the arm; nothing else: does it carry another')


@pytest.mark.parametrize(
    ('earlier', 'new', 'count'), [(False, (), 20), (True, ('base',), 8)], indirect=['earlier']
)
def test_a_device_of_ten_times_the_noise_shows_where_frames_are(earlier, new, count):
    """The others predict a pose as well as it fits, if not as well as earlier ones did."""
    true, previous, oriented = earlier
    found = recalibrate(previous, problem(true, count, 7, oriented, worse=10.0), 0.1, new=new)
    assert found.after.rms_mm > 5e3 * previous.residual
    assert found.accepted
    assert not found.changed


@pytest.mark.parametrize(
    ('earlier', 'seed', 'count'), [(True, 0, 6), (False, 1, 8)], indirect=['earlier']
)
def test_an_unchanged_arm_between_new_frames_is_accepted(earlier, seed, count):
    """Frames that lie anywhere, judged by the other poses for both arms."""
    true, previous, oriented = earlier
    rng = np.random.default_rng(seed)
    there = replace(true, base=random_frame(rng, 2.0), tool=random_frame(rng, 0.2))
    found = recalibrate(previous, problem(there, count, seed, oriented), 0.1, new=('base', 'tool'))
    assert found.accepted
    assert not found.changed
    assert found.after.rms_mm < 1.2 * found.before.rms_mm


def test_too_few_poses_for_a_new_frame_are_refused(earlier):
    """Two positions leave a turn of the base open; a calibration with that was accepted."""
    true, previous, oriented = earlier
    there = replace(true, base=random_frame(np.random.default_rng(1), 2.0))
    few = problem(there, 1 if oriented else 2, 1, oriented)
    new = ('base', 'tool') if oriented else ('base',)
    with pytest.raises(InputError, match=rf'{len(few.observations)} poses? cannot place the new '):
        recalibrate(previous, few, 0.1, new=new)


@pytest.mark.parametrize(('seed', 'oriented'), [(0, True), (3, False)])
def test_another_target_of_a_scara_leaves_its_device_where_it_stands(seed, oriented):
    """Its height shows as another height of the device, which was free to go sideways too."""
    true = faulty(SCARA, Cell(), np.random.default_rng(0))
    previous = Calibration.of(identify(problem(true, 60, 0, oriented, SCARA)))
    rng = np.random.default_rng(seed)
    now = replace(true, tool=random_frame(rng, 0.2))
    joints = SCARA.random_joints(1, rng) + rng.uniform(-0.2, 0.2, (8, 4))
    few = Problem(SCARA, measure(now, joints, rng, *NOISE, oriented), **SIGMAS)
    found = recalibrate(previous, few, 0.1, new=('tool',))
    assert found.accepted
    q = SCARA.random_joints(300, rng)
    assert rms(found.calibration.chain, now, q) < 2.0 * rms(previous.chain, true, q)


@pytest.mark.parametrize('earlier', [True], indirect=True)
def test_a_slip_between_a_device_and_a_target_far_away_is_named_beside_both(earlier, none_odd):
    """Another arm there asks for new frames: the remedy was to identify again."""
    true, previous, oriented = earlier
    rng = np.random.default_rng(1)
    away = {'base': random_frame(rng, 2.0), 'tool': random_frame(rng, 0.2)}
    there = replace(slipped(true, [0.0, 0.0, 3e-3, 0.0, 0.0, 0.0]), **away)
    found = recalibrate(previous, problem(there, 8, 1, oriented), 0.1)
    assert found.accepted
    assert owners(found.changed) == [{'base'}, {'tool'}, {'elbow_joint'}]
    q = true.random_joints(300, rng)
    assert rms(found.calibration.chain, there, q) < 2.0 * rms(previous.chain, true, q)
    other = replace(faulty(UR10E, Cell(), np.random.default_rng(9)), **away)
    why, step = recalibrate(previous, problem(other, 8, 1, oriented), 0.1).refusal()
    assert why == 'no change of a few parameters explains the new poses'
    assert step.startswith('if the device or the target was moved, give --new-base or --new-tool')


@pytest.mark.parametrize(
    ('earlier', 'new'),
    [(False, ('base',)), (False, ('tool',)), (True, ('base', 'tool'))],
    indirect=['earlier'],
)
def test_new_frames_that_fit_their_poses_exactly_confirm_nothing(earlier, new):
    """One pose places a frame, three positions both, whatever the arm: none is left to judge."""
    true, previous, oriented = earlier
    rng = np.random.default_rng(1)
    there = {name: random_frame(rng, 1.0) for name in new}
    now = replace(slipped(true, [0.0, 0.0, 3e-3, 0.0, 0.0, 0.0]), **there)
    count = {1: 1 if oriented or new == ('tool',) else 2, 2: 3}[len(new)]
    with pytest.raises(InputError, match=rf'{count} poses? cannot place the new '):
        recalibrate(previous, problem(now, count, 1, oriented), 0.1, new=new)
    few = problem(now, 8, 1, oriented)
    assert 'elbow_joint' in owners(recalibrate(previous, few, 0.1, new=new).changed)[0]


def test_heights_on_a_scara_are_told_from_each_other():
    """Corrected axes are not quite parallel, and the height of its target is that of its base."""
    rng = np.random.default_rng(0)
    true = faulty(SCARA, Cell(angle_error=3e-4), rng)

    def seen(now, count):
        measured = measure(now, SCARA.random_joints(count, rng), rng, *NOISE)
        return Problem(SCARA, measured, **SIGMAS)

    previous = Calibration.of(identify(seen(true, 60)))
    slipped = seen(true.with_offsets({'quill.d': 5e-4}), 8)
    ((*reasons,),) = recalibrate(previous, slipped, 0.1).changed
    assert 'quill.d' in {name for each in reasons for name in each.names}
    elsewhere = {'tool': random_frame(rng, 0.2), 'base': random_frame(rng, 2.0)}
    for new in (('tool',), ('tool', 'base')):
        now = replace(true, **{name: elsewhere[name] for name in new})
        found = recalibrate(previous, seen(now, 8), 0.1, new=new)
        assert (found.accepted, found.changed) == (True, ())


def test_the_travel_of_a_linear_joint_grows_with_the_scale():
    """All lengths of a SCARA grow alike, seen by the device from another place."""
    rng = np.random.default_rng(4)
    true = faulty(SCARA, Cell(), rng)
    nominal = replace(SCARA, base=None, tool=None)
    first = measure(true, SCARA.random_joints(60, rng), rng, *NOISE)
    previous = Calibration.of(identify(Problem(nominal, first, **SIGMAS)))
    now = replace(true, base=random_frame(rng, 2.0))
    again = measure(now, SCARA.random_joints(20, rng), rng, *NOISE)
    for scale in (1.0, 1.0006):
        seen = replace(again, positions=scale * again.positions)
        found = recalibrate(previous, Problem(nominal, seen, **SIGMAS), 0.1, new=('base',))
        assert found.accepted is (scale == 1.0)
        assert found.out_of_scale is (scale != 1.0)
