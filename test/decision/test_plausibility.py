# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import NOISE, SCARA, SIGMAS, arm, rms

from calib_ros import Chain, Problem, identify, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.decision.misfits import coupling_share, explained_share
from calib_ros.decision.plausibility import _motion
from calib_ros.decision.reasons import Rule
from calib_ros.estimation.gross_errors import SUSPICIOUS
from calib_ros.estimation.system import stacked
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Frame, Joint
from calib_ros.kinematics.se3 import exp_rotation

UR = load_chain('ur10e')
NOT_OF_ONE_ARM = 'one arm does not fit all sessions'


def seen_of(true, seed=0, count=60, oriented=True, noise=5e-5):
    rng = np.random.default_rng(seed)
    return measure(true, true.random_joints(count, rng), rng, noise, 4.0 * noise, oriented)


def scaled(observations, ppm):
    return replace(observations, positions=observations.positions * (1.0 + 1e-6 * ppm))


@pytest.mark.parametrize(
    ('name', 'oriented'), [('ur10e', False), ('puma560', True), ('kuka_iiwa14', False)]
)
def test_a_device_out_of_scale_is_named(name, oriented):
    chain = load_chain(name)
    seen = seen_of(arm(0, 0.0, chain), oriented=oriented)
    result = identify(Problem(chain, scaled(seen, 3000.0)))
    assert any('alike, by 0.3 %' in each for each in result.refusals)


def test_a_joint_that_only_goes_one_way_is_named():
    seen = seen_of(arm(0), count=40)
    steady = seen.select(np.argsort(seen.joints[:, 2]))
    joints = steady.joints.copy()
    joints[:, 4] = np.sort(joints[:, 4])
    both = measure(arm(0), joints, np.random.default_rng(0), 5e-5, 2e-4)
    for one, named in ((seen, ''), (steady, 'elbow_joint'), (both, 'elbow_joint, wrist_2_joint')):
        said = [each for each in identify(Problem(UR, one)).remarks if 'mix' in each]
        assert len(said) == bool(named)
        assert all(f'an error of {named}, moved in one direction' in each for each in said)
    for few, told in ((np.arange(0, 40, 5), True), (np.arange(0, 40, 6), False)):  # 8 tell, not 7
        remarks = identify(Problem(UR, steady.select(few))).remarks
        assert any('mix the order' in each for each in remarks) == told


@pytest.mark.parametrize('errors', [0.1, 1.0, 3.0])
def test_healthy_and_faulty_arms_are_not_suspicious(errors):
    for seed in range(2):
        result = identify(Problem(UR, seen_of(arm(seed, errors), seed, oriented=seed % 2 == 0)))
        assert result.remarks == ()
        assert result.accepted


def test_a_sister_is_named():
    true = arm(0, 0.2, load_chain('ur10'))
    result = identify(Problem(UR, seen_of(true)))
    (remark,) = result.remarks
    assert 'the arm is a ur10, not a ur10e: --chain ur10' in remark


@pytest.mark.parametrize(('seed', 'alike'), [(0, True), (1, False)])
def test_two_robots_in_two_sessions_are_not_averaged(seed, alike):
    """The mean of two arms was accepted, 15 times as far off as each arm alone."""
    second = replace(seen_of(arm(seed), 2, 40), base='base_B', tool='tool_B')
    lever = replace(seen_of(arm(0), 3, 40), tool='tool_lever')
    result = identify(Problem(UR, seen_of(arm(0), 1, 40), more=(lever, second)))
    assert result.accepted == alike
    said = [each.rule for each in result.refusals if NOT_OF_ONE_ARM in each]
    assert said == ([] if alike else [Rule.MISTAKE])


def test_a_device_beside_another_that_is_out_of_scale_is_told_as_a_device():
    """It was told as a session, to be identified alone by --session, of a table without any."""
    other = replace(seen_of(arm(0), 1, 40, oriented=False), base='base_lab', tool='tool_ball')
    result = identify(Problem(UR, seen_of(arm(0), 1, 40), more=[scaled(other, 3000.0)]))
    (said,) = [each for each in result.refusals if NOT_OF_ONE_ARM in each]
    assert 'sessions or devices: alone each fits' in said
    assert '(base, base_lab)' in said


def test_the_share_explained_is_that_of_least_squares():
    added = effects.members(UR, 'coupling')
    true = arm(3).with_effect_values(dict.fromkeys(added, 2e-3))
    problem = Problem(UR, seen_of(true), **SIGMAS)
    chain = replace(UR, base=true.base, tool=true.tool).with_effects(added)
    names = [name for name in UR.parameter_names if UR.owns_frame(name)]
    rows = stacked(problem.system(problem.sets).rows_of(chain, [*names, *added]))
    fewer, more = (np.linalg.lstsq(rows[:, :k], rows[:, -1])[1][0] for k in (len(names), -1))
    found = explained_share(problem, chain, names, added)
    assert found == pytest.approx(1.0 - more / fewer, rel=1e-6)
    assert 0.5 < found < 0.9
    bare = replace(chain, effects=())
    for model, noise, wanted in ((bare, 1.0, found), (bare, 0.99, 0.0), (chain, 1.0, 0.0)):
        fitted = SimpleNamespace(problem=problem, chain=model, names=names)
        fitted.noise = SimpleNamespace(position=noise * SUSPICIOUS)
        assert coupling_share(fitted) == wanted  # of large errors, if they are not fitted
    for count, some in ((3, False), (4, True)):  # of 18 rows 3 would be left, of 24 rows 9
        few = replace(problem, observations=problem.observations.select(np.arange(count)))
        assert (explained_share(few, chain, names, added) > 0.0) == some


@pytest.mark.parametrize('oriented', [True, False])
def test_sigmas_in_millimetres_are_named(oriented):
    """They make the arm's errors smaller than any noise: nothing else may be blamed for it."""
    seen = seen_of(arm(3), count=40, oriented=oriented)
    for sigma in (0.05, 5e-3, 5e-4, 5e-5):
        sigmas = {'sigma_position': sigma, 'sigma_orientation': 4.0 * sigma}
        result = identify(Problem(UR, seen, **sigmas))
        if sigma < 1e-3:
            assert result.accepted
            assert not any('sigma' in each for each in result.remarks)
            continue
        said = result.remarks[-1] if result.accepted else result.refusals[0]
        assert f'sigma_position is {sigma:g} m, and only' in said
        assert said.count('meant?') == 1 + oriented
        assert result.accepted or result.refusals[0].rule is Rule.MISTAKE


def test_a_default_sigma_is_no_mistake_of_its_user():
    seen = seen_of(arm(3), count=40, noise=2e-6)
    assert identify(Problem(UR, seen)).remarks == ()
    assert 'meant?' in identify(Problem(UR, seen, sigma_position=2e-4)).remarks[0]


def test_poses_computed_by_a_controller_are_named():
    """Rounded to micrometres they look like those of a device a hundred times better than any."""
    rng = np.random.default_rng(0)
    calibrated = replace(arm(0), base=Frame())  # by its maker, and in its own base frame
    for true in (UR, calibrated):
        result = identify(Problem(UR, measure(true, UR.random_joints(25, rng), rng, 2e-6, 5e-6)))
        said = result.refusals[0] if true is UR else result.remarks[0]
        assert said.startswith('sigma_position is 0.0001 m, and only 0.00')
        assert said.count('no arm is as good: did its controller compute the poses?') == 2
    aligned = measure(calibrated, UR.random_joints(25, rng), rng, 5e-5, 2e-4)  # a device's
    said = identify(Problem(UR, aligned, sigma_position=5e-3)).refusals[0]
    assert str(said).endswith('mm are left: was mm meant?')


def test_a_mistake_is_told_before_the_sigmas_that_it_meets():
    seen = seen_of(arm(0), count=40)
    turned = replace(seen, joints=seen.joints * [1, 1, 1, 1, 1, -1])
    result = identify(Problem(UR, turned, sigma_position=0.1, sigma_orientation=0.4))
    first, second, *_ = result.refusals
    assert first.startswith('wrist_3_joint counts the other way round')
    assert second.startswith('sigma_position is 0.1 m, and only')


@pytest.mark.parametrize('turns', [5e-3, 1e-2])
def test_orientations_far_worse_than_their_sigma_are_named(turns):
    """Of a camera or a small rigid body of markers: by default they spoil the positions."""
    rng, true = np.random.default_rng(4), arm(4)
    seen = measure(true, UR.random_joints(40, rng), rng, 1e-4, turns)
    result = identify(Problem(UR, seen))
    said = result.remarks[-1] if result.accepted else result.refusals[0]
    assert 'the orientations outweigh the positions and spoil them' in said
    value = float(said.rpartition(' ')[2])
    assert value == pytest.approx(turns, rel=0.2)
    mended = identify(Problem(UR, seen, sigma_orientation=value))
    assert mended.accepted
    assert not any('sigma' in each for each in mended.remarks)
    q = UR.random_joints(300, rng)
    assert rms(mended.chain, true, q) < 0.4 * rms(result.chain, true, q)


def test_a_target_that_turned_is_not_told_as_a_large_sigma():
    """With the sigma told it was accepted."""
    seen = seen_of(arm(0), count=40)
    late, turn = np.arange(40) >= 20, exp_rotation(np.array([[0.0, 0.02, 0.0]]))[0]
    turned = np.where(late[:, np.newaxis, np.newaxis], seen.rotations @ turn, seen.rotations)
    result = identify(Problem(UR, replace(seen, rotations=turned), **SIGMAS))
    assert result.refusals[0].rule is Rule.MOVED
    assert 'sigma_orientation' not in ' '.join((*result.refusals, *result.remarks))


def test_covariances_in_square_millimetres_are_named():
    wrong = np.tile(np.diag([2.5e-3] * 3 + [4e-8] * 3), (60, 1, 1))
    result = identify(Problem(UR, replace(seen_of(arm(3)), covariance=wrong)))
    assert not result.accepted
    assert result.refusals[0].rule is Rule.MISTAKE
    assert 'by the covariances the position is known to 0.05 m, and only' in result.refusals[0]


def test_motor_angles_are_noticed():
    coupled = {'wrist_3_joint.coupling_wrist_2_joint': 2e-3}
    seen = seen_of(arm(0).with_effects(list(coupled)).with_offsets(coupled))
    (remark,) = identify(Problem(UR, seen)).remarks
    assert 'couplings of the last joints explain' in remark
    assert (
        identify(Problem(UR, seen, effects=('coupling',), priors={'*.coupling_*': 0.01})).remarks
        == ()
    )


def test_couplings_that_the_model_lacks_are_uncertainty_elsewhere(unsearched):
    wrist = ('wrist_3_joint.coupling_wrist_2_joint', 'wrist_2_joint.coupling_wrist_1_joint')
    coupled = dict(zip(wrist, (2e-3, 1e-3), strict=True))
    true = arm(0).with_effects(list(coupled)).with_offsets(coupled)
    rng = np.random.default_rng(0)
    near, far = 0.5 * UR.random_joints(60, rng), UR.random_joints(300, rng)
    result = identify(Problem(UR, measure(true, near, rng, 5e-5, 2e-4)))
    error = (true.forward(far) - result.chain.forward(far))[:, :3, 3]
    axes = result.confidence_ellipsoid(far)
    along = np.einsum('nki,ni->nk', axes, error) / (axes**2).sum(axis=2)
    assert ((along**2).sum(axis=1) < 1.0).mean() > 0.9


ROWS = ({'d': 0.5, 'a': 0.2, 'alpha': -np.pi / 2}, {'a': 0.7}, {'a': 0.6}, {'a': 0.1})
FOUR = Chain(
    'four',
    'standard',
    tuple(Joint(f'j{k}', lower=-2.5, upper=2.5, **row) for k, row in enumerate(ROWS)),
)


@pytest.mark.parametrize('seed', [1, 4])
def test_a_scale_that_few_lengths_imitate_is_refused_where_it_does_harm(seed):
    """By positions alone four joints hold so few lengths that no test is certain of the scale."""
    rng = np.random.default_rng(seed)
    true = faulty(FOUR, Cell(length_error=3e-4, angle_error=6e-4), rng)
    seen = measure(true, FOUR.random_joints(60, rng), rng, 5e-5, oriented=False)
    right = Problem(FOUR, seen, sigma_position=5e-5)
    assert identify(right).accepted
    assert identify(replace(right, sigma_scale=1e-5)).accepted
    wrong = replace(right, observations=scaled(seen, -3000.0))
    result = identify(wrong)
    (refusal,) = result.refusals
    assert refusal.rule is Rule.SCALE
    assert 'lengths of the arm shrink alike' in refusal
    assert 'set sigma_scale' in refusal
    q = FOUR.random_joints(300, rng)
    nominal = replace(FOUR, base=true.base, tool=true.tool)
    assert rms(result.chain, true, q) > rms(nominal, true, q)
    (refusal,) = identify(replace(wrong, sigma_scale=1e-5)).refusals
    assert refusal.rule is Rule.SCALE
    assert 'more than sigma_scale allows' in refusal


@pytest.mark.parametrize(
    ('scale', 'error', 'sigma', 'checked'),
    [(5e-4, 1e-4, 0.0, 1e-4), (2e-3, 1e-4, 0.0, 0.0), (2e-4, 5e-5, 1e-4, 1e-5)],
)
def test_a_scale_that_leaves_no_region_is_the_reason(scale, error, sigma, checked):
    """Where the device is checked the arm itself may be of another size, but hardly by 0.2 %."""
    rng = np.random.default_rng(0)
    true = faulty(UR, Cell(length_error=error, angle_error=2.0 * error), rng)
    lengths = [n for n in UR.parameter_names if n.is_length and not UR.owns_frame(n)]
    true = true.with_offsets({n: scale * UR.value(n) for n in lengths})
    problem = Problem(UR, measure(true, UR.random_joints(60, rng), rng, 5e-5, 2e-4), **SIGMAS)
    result = identify(replace(problem, sigma_scale=sigma))
    (refusal,) = result.refusals
    assert refusal.rule is Rule.SCALE
    assert 'may make the arm worse' in refusal  # of sound arms it mostly does not
    assert not any('alike' in each for each in result.remarks)
    assert identify(replace(problem, sigma_scale=checked or 1e-4)).accepted == bool(checked)


@pytest.mark.parametrize(('count', 'named'), [(30, 0), (200, 100)])
def test_few_samples_show_no_errors_of_time(count, named):
    """Of 30 the fastest third is 1.5 times worse by chance in some sessions."""
    rng = np.random.default_rng(0)
    found = 0
    for _ in range(100):
        speeds = rng.normal(size=(count, 6))
        seen = SimpleNamespace(velocity=speeds, acceleration=None)
        sizes = np.linalg.norm(rng.normal(size=(count, 3)), axis=1)
        sizes *= np.linalg.norm(speeds, axis=1) ** 3 if named else 1.0
        result = SimpleNamespace(distances=[sizes], noise=SimpleNamespace(position=1.1))
        found += 'speed' in _motion(SimpleNamespace(sets=[seen]), result)
        result.noise.position = 1.0  # as stated: nothing is left to explain
        assert not _motion(SimpleNamespace(sets=[seen]), result)
    assert found == named


@pytest.mark.parametrize('what', ['speed', 'acceleration'])
def test_most_of_the_fastest_third_is_compared_with_most_of_the_slowest(what):
    """Of the slowest and the fastest quarter or half the medians are others."""
    rank = np.arange(300) / 300.0
    rates = {'velocity': None, 'acceleration': None}
    rates['velocity' if what == 'speed' else what] = np.outer(rank, np.ones(6))
    small = (np.abs(rank - 0.245) < 0.09) | (np.abs(rank - 0.68) < 0.14)
    noise = SimpleNamespace(position=1.1)
    for calm, told in ((small, f'errors grow with the {what}'), (~small, '')):
        result = SimpleNamespace(distances=[np.where(calm, 1.0, 9.0)], noise=noise)
        found = _motion(SimpleNamespace(sets=[SimpleNamespace(**rates)]), result)
        assert found.partition(' of the arm')[0] == told


@pytest.mark.parametrize(
    ('share', 'oriented', 'straight'),
    [
        (0.0, True, False),
        (1e-4, True, False),
        (1e-4, False, True),
        (1e-3, True, False),
        (1e-3, False, True),
    ],
)
def test_poses_that_lie_towards_the_stop_before_are_told_and_refused_where_it_harms(
    share, oriented, straight
):
    """A device that smoothed over 0.8 s made an arm worse, 2.2 mm -> 3.3 mm, and was accepted.

    It smooths positions, straight to the stop before; arcs of the arm are twice as long.
    """
    rng, refused = np.random.default_rng(1), share == 1e-3
    joints = UR.random_joints(40, rng)
    behind = joints - share * np.diff(joints, axis=0, prepend=joints[:1]) * (not straight)
    seen = replace(measure(arm(0), behind, rng, 5e-5, 2e-4, oriented), joints=joints)
    before = np.concatenate([seen.positions[:1], seen.positions[:-1]])
    back = 2.0 * share * straight * (before - seen.positions)
    seen = replace(seen, positions=seen.positions + back)
    result = identify(Problem(UR, seen))
    assert result.accepted == (not refused)
    assert (Rule.LAG in [each.rule for each in result.refusals]) == refused
    assert any('towards the previous stop' in each for each in result.remarks) == (share == 1e-4)
    told = [each for each in (*result.refusals, *result.remarks) if 'previous stop' in each]
    most = '[89][0-9]|100' if straight else '9[89]|100'
    assert all(re.search(f'explains ({most}) % of the residuals', each) for each in told)


@pytest.mark.parametrize('size', [3e-4, 1e-3])
def test_backlash_is_not_taken_for_a_lag(size):
    true = arm(0).with_effects([f'{joint.name}.backlash' for joint in UR.joints])
    true = true.with_offsets({name: -size for name, _ in true.effects})
    rng = np.random.default_rng(1)
    joints = true.random_joints(60, rng)
    approach = np.sign(np.diff(joints, axis=0, prepend=joints[:1]))
    seen = measure(true, joints, rng, 5e-5, 2e-4)
    poses = true.forward(joints, approach)
    seen = replace(seen, positions=poses[:, :3, 3], rotations=poses[:, :3, :3])
    result = identify(Problem(UR, seen))
    assert result.accepted
    (told,) = result.remarks
    assert told.startswith('the joints have play, which explains 100 %')
    assert identify(Problem(UR, replace(seen, approach=approach), effects=('backlash',))).accepted


@pytest.mark.parametrize('chain', [SCARA, UR])
def test_two_lengths_may_grow_alike_but_not_all_of_many(chain):
    """A SCARA with links 0.6 % too long was refused, though the scale of the tracker was known."""
    rng = np.random.default_rng(2)
    true = faulty(chain, Cell(length_error=1e-4), rng)
    longer = {n: chain.value(n) for n in chain.parameter_names if n[-2:] in ('.a', '.d')}
    true = true.with_offsets({name: 6e-3 * chain.value(name) for name in longer})
    seen = measure(true, chain.random_joints(40, rng), rng, *NOISE)
    for sigma, refused in ((1e-5, chain is UR), (0.02, False)):
        refusals = identify(Problem(chain, seen, sigma_scale=sigma)).refusals
        assert any('more than sigma_scale allows' in each for each in refusals) == refused


@pytest.mark.parametrize(
    ('kind', 'refused'),
    [('late', True), ('walk', True), ('late', False), ('walk', False), ('play', False)],
)
def test_uneven_delays_in_motion_are_named_and_refused_where_they_harm(kind, refused):
    """A joint 4 ms late, or a delay of 0 to 8 ms, made a healthy arm 0.7 and 1.1 mm worse."""
    rng, turns = np.random.default_rng(1), np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    waves = rng.integers(1, 4, (1, 6)), rng.uniform(0.0, 6.0, (1, 6))
    phase = turns[:, np.newaxis] * waves[0] + waves[1]
    joints, speed = 0.8 * np.sin(phase), 0.8 * np.cos(phase) * waves[0] * 2.0 * np.pi / 30.0
    if not refused:  # the arm cannot imitate this
        joints, speed = UR.random_joints(100, rng), 0.3 * rng.normal(size=(100, 6))
    true = replace(UR, base=arm(0).base, tool=arm(0).tool) if refused else arm(0)
    delay = 4e-3 * (1.0 + np.sin(turns))[:, np.newaxis] * np.ones(6)
    second = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    back = {'late': 4e-3 * second * speed, 'walk': delay * speed, 'play': 5e-4 * np.sign(speed)}
    seen = measure(true, joints - back[kind], rng, *NOISE)
    result = identify(Problem(UR, replace(seen, joints=joints, velocity=speed), **SIGMAS))
    words = {'late': 'above all shoulder_lift_joint', 'walk': 'base.delay changes', 'play': 'play'}
    told = [str(x) for x in (*result.refusals, *result.remarks) if '(mode dwell)' in str(x)]
    assert result.accepted != refused
    assert any(e.rule is Rule.LAG for e in result.refusals) == (refused and kind == 'late')
    assert len(told) == 1
    assert words[kind] in told[0]


@pytest.mark.parametrize(('ppm', 'told'), [(0.0, False), (300.0, True)])
def test_held_out_poses_that_the_fit_does_not_let_expect_are_told(ppm, told):
    """By another tracker they were 0.6 mm off, and 0.05 mm was stated."""
    fitted, others = seen_of(arm(0)), seen_of(arm(0), seed=1, count=20)
    problem = Problem(UR, fitted, held_out=scaled(others, ppm), **SIGMAS)
    said = [each for each in identify(problem).remarks if 'times further' in each]
    assert len(said) == told
    assert all(re.search('poses are (4|5|6|7|8|9)', each) for each in said)
    bare = replace(problem, held_out=None)
    assert not any('times further' in each for each in identify(bare).remarks)
