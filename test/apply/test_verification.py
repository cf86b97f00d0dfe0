# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation
from verified import NOISE, UR, in_words, measured, verification_page, with_errors

from calib_ros.apply import simulation
from calib_ros.apply.compensation import compensate
from calib_ros.apply.compensator import Compensator
from calib_ros.apply.confidence import rms_interval, rms_limits
from calib_ros.apply.verification import verify
from calib_ros.apply.verified import Attained
from calib_ros.decision.residuals import Residuals
from calib_ros.errors import ConfigError, InputError
from calib_ros.identification.fingerprint import Fingerprint
from calib_ros.report.standing import standing
from calib_ros.report.verdicts import _by_configuration
from calib_ros.report.words import verdict_in_words
from calib_ros.shown import rounded

_UNIT = ['(mean', '+', '3', 'std)']


@pytest.fixture(scope='module')
def program():
    """Return the joint values of five poses."""
    return 0.5 * UR.random_joints(5, np.random.default_rng(0))


@pytest.mark.parametrize('step', [5e-4, 2e-3, 5e-3])
def test_points_closer_than_their_corrections_keep_their_own(cell, arm, step):
    """Every tenth point of a path: the corrected arm passes, the uncorrected one does not."""
    true, result, _ = cell
    start = np.array([0.3, -1.2, 1.4, -0.5, 0.9, 0.2])
    path = start + step * np.arange(200)[:, np.newaxis] * [1.0, 0.8, -0.9, 0.7, -0.6, 1.0]
    moved = compensate(Compensator(UR, result.chain), path).joints
    wanted = replace(UR, base=result.chain.base, tool=result.chain.tool).forward(path[::10])
    for joints, verdict in ((moved, 'PASS'), (path, 'FAIL')):
        seen = measured(true, joints[::10], 1, (0.0, 0.0))
        found = verify(arm, [seen], 5e-4, commanded=path)
        assert found.verdict == verdict
        missed = np.linalg.norm(seen.positions - wanted[:, :3, 3], axis=1)
        figures = found.comparison.figures[1]
        assert figures.rms_mm == pytest.approx(1e3 * np.sqrt(np.mean(missed**2)), rel=1e-6)


def test_a_correction_that_did_not_arrive_shows(cell, arm, program):
    """Against what was commanded: corrected commands pass, uncorrected ones do not."""
    true, result, _ = cell
    meant = program
    moved = compensate(Compensator(UR, result.chain), meant).joints.copy()
    for joints, verdict in ((moved, 'PASS'), (meant, 'FAIL')):
        seen = [measured(true, joints[::-1])]
        found = verify(arm, seen, 5e-4, commanded=meant)
        assert found.verdict == verdict
        assert found.uncorrected is ('is the corrected program' in in_words(found))
        assert found.uncorrected is (verdict == 'FAIL')
        assert verify(arm, seen, 5e-4).verdict == 'PASS'  # the calibration itself is right
    corrected = verify(arm, [measured(true, moved)], 5e-4, commanded=meant)
    by_model = verify(arm, [measured(true, moved)], 5e-4)
    assert corrected.rms == pytest.approx(by_model.rms, rel=1e-6)
    assert found.rms == pytest.approx(1e-3 * found.comparison.figures[0].rms_mm, rel=0.1)
    moved[3, 5] += 0.3
    away = measured(true, moved)
    both = [away.select(np.s_[:5]), away.select(np.s_[5:])]
    with pytest.raises(InputError, match=r'^line 10 was taken 0\.[23]\d* rad or m .* full turn'):
        verify(arm, both, 1e-3, commanded=meant)
    with pytest.raises(InputError, match=r'must have the shape \(N, 6\)'):
        verify(arm, seen, 5e-4, commanded=meant[:, :5])
    with pytest.raises(InputError, match='NaN or infinite'):
        verify(arm, seen, 5e-4, commanded=meant * np.nan)
    again = verify(arm, seen, 5e-4, commanded=meant.tolist())
    assert again.verdict == verify(arm, seen, 5e-4, commanded=meant).verdict
    with pytest.raises(InputError, match=r'must have the shape \(N, 6\)'):
        verify(arm, [replace(seen[0], joints=seen[0].joints[:, :5])], 5e-4)


def test_pass_fail_and_undecided(cell, arm, program):
    true = cell[0]
    seen, shares = [measured(true, program)], []
    rms = verify(arm, seen, 0.1, progress=shares.append).rms
    assert all(0.0 < share < 1.0 for share in shares)
    assert shares
    found = {scale: verify(arm, seen, scale * rms) for scale in (0.4, 1.0, 3.0)}
    assert [each.verdict for each in found.values()] == ['FAIL', 'UNDECIDED', 'PASS']
    assert all(each.lower < rms < each.upper for each in found.values())
    assert found[1.0].needed is None  # exactly at the tolerance nothing decides
    assert standing(found[1.0])[1][0].startswith('More poses would hardly decide')
    near = verify(arm, seen, 1.2 * rms)
    assert near.verdict == 'UNDECIDED'
    assert 5 < near.needed < 500
    assert 'Measure more poses' in standing(near)[1][0]
    text = in_words(near)
    assert f'about {near.needed} poses' in text
    shown = near._repr_html_()
    assert '<strong>UNDECIDED</strong>' in shown
    for value in (near.rms, near.lower, near.upper, near.limit):
        assert rounded(1e3 * value) in shown
    assert (
        f'95 %: at least {rounded(1e3 * near.lower)})' in replace(near, upper=np.inf)._repr_html_()
    )
    errors = 1e3 * near.comparison.after.position[near.group == 2]
    assert near.each[2].after == pytest.approx(np.linalg.norm(errors.mean(axis=0)))
    heads = [line.split() for line in text.splitlines()]
    table = heads[heads.index(['pose', 'measured', 'before', 'after', 'scatter', *_UNIT]) :]
    for k, (pose, row) in enumerate(zip(near.each, table[1:6], strict=True), 1):
        figures = (pose.before, pose.after, pose.repeatability)
        assert row == [f'P{k}', '3', *map(rounded, figures)]


def test_poses_in_a_small_part_of_the_range_hold_only_there(cell, arm):
    """They said that the calibration holds, and not where."""
    joints = UR.random_joints(30, np.random.default_rng(4))
    elsewhere = 0.5 * joints
    elsewhere[:, [0, 2]] *= 0.2
    for each, near in ((joints, ()), (elsewhere, tuple(np.array(UR.joint_names)[[0, 2]]))):
        found = verify(arm, [measured(cell[0], each, 1)], None)
        assert found.verdict == 'holds'
        assert found.near == near
        assert (': shoulder_pan_joint, elbow_joint moved' in in_words(found)) == bool(near)
        told = verdict_in_words(found)
        assert ('only near these poses' in told) == bool(near)
        assert len(told) <= 200  # in a window of the node
        assert verify(arm, [measured(cell[0], each, 1)], 1e-3).near == ()  # of poses like these
    unknown = replace(arm, rows=None), replace(arm, rows=Fingerprint.of([]))
    seen = [measured(cell[0], elsewhere, 1)]
    assert [verify(each, seen, None).near for each in unknown] == [(), ()]


@pytest.mark.parametrize(
    ('count', 'shape'), [(5, (1.0, 1.0, 1.0)), (5, (1.0, 0.1, 0.1)), (12, (1.0, 0.5, 0.2))]
)
def test_the_limits_hold_as_often_as_they_say(count, shape):
    rng = np.random.default_rng(5)
    truth = np.linalg.norm(shape)
    errors = rng.normal(size=(2000, count, 3)) * shape
    lower, upper = np.transpose([rms_interval(each, np.arange(count)) for each in errors])
    held = np.array([lower <= truth, truth <= upper])
    assert (held.mean(axis=1) > stats.binom.ppf(1e-3, 2000, 0.97) / 2000).all()
    assert held.mean() < 0.999  # wide enough, and no wider
    assert rms_interval(0.0 * errors[0], np.arange(count)) == (0.0, 0.0)


def test_the_limits_of_a_verdict_are_those(arm, monkeypatch):
    monkeypatch.setattr('calib_ros.apply.judgement.DECIDING', 5)  # fewer than were measured
    errors = np.random.default_rng(0).normal(scale=1e-4, size=(7, 3))
    found = verify(arm, [with_errors(arm, errors)], 1e-4)
    wanted = rms_interval(errors, np.arange(7))
    assert (found.lower, found.upper) == pytest.approx(wanted, rel=1e-6)


def test_limits_are_those_of_the_chi_squared_distribution():
    rng = np.random.default_rng(0)
    lower, upper = rms_limits(1.0, np.array([15.0]), 0.9)
    squares = rng.chisquare(15.0, 100_000) / 15.0
    assert np.mean(squares < 1.0 / upper[0] ** 2) == pytest.approx(0.05, abs=0.005)
    assert np.mean(squares > 1.0 / lower[0] ** 2) == pytest.approx(0.05, abs=0.005)
    few = rms_limits(1.0, np.array([0.9, 1.0, 1.1]), 0.95)[1]
    assert list(np.isinf(few)) == [True, False, False]  # an upper limit of 1e52 mm was reported


def test_repeatability_is_that_of_the_standard():
    """Distances from their mean place, the mean of them and three standard deviations."""
    after = np.array([[2.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 3.0], [1.0, 0.0, -3.0]])
    found = Attained.of(after + np.array([0.0, 2.0, 0.0]), after)
    assert (found.cycles, found.after) == (4, 1.0)
    assert found.before == pytest.approx(np.sqrt(5.0))
    assert found.repeatability == pytest.approx(2.0 + 3.0 * np.sqrt(4.0 / 3.0))
    assert Attained.of(after[:1], after[:1]).repeatability is None
    everything = Residuals(
        1e-3 * after, np.full((4, 3), np.nan), np.arange(4), np.full((4, 2), np.nan)
    ).figures(np.ones(4, dtype=bool))
    lengths = np.array([2.0, 0.0, np.sqrt(10.0), np.sqrt(10.0)])
    assert everything.mean_mm == pytest.approx(lengths.mean())
    spread = lengths.std(ddof=1)  # as of the repeatability
    assert everything.mean_plus_3_sigma_mm == pytest.approx(lengths.mean() + 3.0 * spread)


def test_the_repeatability_of_the_standard_needs_the_program(cell, arm, program):
    """Joint values that report how the arm comes back leave only the noise of the errors."""
    rng = np.random.default_rng(0)
    moved = np.repeat(compensate(Compensator(UR, arm.chain), program).joints, 10, axis=0)
    moved += rng.normal(scale=2e-4, size=moved.shape)
    seen = simulation.measure(cell[0], moved, rng, 1e-5, 1e-4)
    found, alone = (verify(arm, [seen], 0.1, commanded=each) for each in (program, None))
    for k, (pose, other) in enumerate(zip(found.each, alone.each, strict=True)):
        places = seen.positions[found.group == k]
        apart = np.linalg.norm(places - places.mean(axis=0), axis=1)
        assert pose.repeatability == pytest.approx(1e3 * (apart.mean() + 3.0 * apart.std(ddof=1)))
        assert other.repeatability < 0.3 * pose.repeatability
    for each, word in ((found, 'repeatability'), (alone, 'scatter')):
        assert f'after   {word} (mean + 3 std)' in in_words(each)
        assert ('AP after' in _by_configuration(each).head) is each.by_program
        page = verification_page(arm.chain, [seen], each)
        assert ('its place in the program' in str(page.accuracy)) is each.by_program


@pytest.mark.parametrize(('seed', 'told'), [(0, False), (5, True)])
def test_a_robot_that_is_not_that_of_the_calibration_is_told(arm, seed, told):
    """With frames refitted, as in a plant; the nominal arm is nearer to any of them."""
    other = simulation.faulty(UR, simulation.Cell(), np.random.default_rng(seed))
    seen = measured(other, UR.random_joints(20, np.random.default_rng(3)))
    found = verify(arm, [seen], 3e-4, new_base=True, new_tool=True)
    assert (found.verdict == 'FAIL') is told
    assert ('is the calibration that of this robot?' in in_words(found)) is told


def test_poses_outside_the_region_are_told(arm):
    """A calibration of a small region, verified elsewhere, is not that of another robot."""
    other = simulation.faulty(UR, simulation.Cell(), np.random.default_rng(5))
    seen = measured(other, UR.random_joints(20, np.random.default_rng(3)), 1)
    expected = np.sort(arm.region.known(seen.joints))
    for limit, share in ((np.inf, ''), (expected[14:16].mean(), '25'), (expected[0] / 2, '100')):
        near = replace(arm, region=replace(arm.region, limit=limit))
        text = in_words(verify(near, [seen], 1e-3, new_base=True, new_tool=True))
        told = f'{share} % of the measurements are outside the region' if share else ''
        assert told in text
        assert ('outside the region' in text) is bool(share)
        assert ('is the calibration that of this robot?' in text) is (share != '100')


def test_units_are_named_though_a_common_motion_would_take_most_of_the_error(arm, single):
    far = with_errors(arm, 30.0 + np.random.default_rng(0).normal(scale=0.1, size=(9, 3)))
    text = in_words(found := verify(arm, [far], 1e-3))
    assert found.common < 0.1
    assert 'no arm is that far off' in text
    assert 'was the measuring device moved' not in text
    coarse = with_errors(arm, np.random.default_rng(0).normal(scale=7e-3, size=(9, 3)))
    assert 'no arm is that far off' not in in_words(verify(arm, [coarse], 1.5e-2))  # as wanted


@pytest.mark.parametrize(('known', 'told'), [(-0.04, False), (0.0, True)])
def test_an_arm_that_is_far_off_by_itself_has_no_wrong_units(arm, known, told, unsearched):
    """A robot 28 mm off, 17 mm with zeros set anew, was told that no arm is that far off."""
    far = replace(arm, before=arm.chain.with_offsets({'elbow_joint.theta': known}))
    moved = arm.chain.with_offsets({'elbow_joint.theta': 0.04})
    seen = measured(moved, UR.random_joints(20, np.random.default_rng(0)), 1)
    found = verify(far, [seen], None, new_base=True, new_tool=True)
    assert found.failed
    assert found.rms > 0.01
    assert ('no arm is that far off' in in_words(found)) is told


def test_one_pose_that_alone_exceeds_the_limit_is_named(arm):
    errors = np.random.default_rng(0).normal(scale=1e-5, size=(9, 3))
    errors[4] += [0.0, 0.01, 0.0]
    seen = with_errors(arm, errors)
    for sets in ([seen], [seen.select(np.s_[1::2]), seen.select(np.s_[::2])]):  # by turns
        text = in_words(found := verify(arm, sets, 1e-4))
        assert (found.verdict, found.odd) == ('FAIL', (4,))
        assert 'pose 5 alone is 9.99' in text
    for fine in (errors[:4], errors * 0.0):  # also without any error
        found = verify(arm, [with_errors(arm, np.tile(fine, (2, 1)))], 1e-4)
        assert (found.verdict, found.odd) == ('PASS', ())
    assert verify(arm, [with_errors(arm, errors[2:7])], 1e-4).odd == ()  # too few others


def test_orientations_that_are_far_off_are_told(arm):
    """Positions alone are judged; but a mistake in the table is none of the arm."""
    seen = with_errors(arm, np.random.default_rng(0).normal(scale=1e-5, size=(8, 3)))
    turned = replace(seen, rotations=seen.rotations @ np.diag([1.0, -1.0, -1.0]))  # the target
    none = replace(seen, rotations=np.tile(np.eye(3), (8, 1, 1)))  # as some drivers publish
    for each, told in ((seen, False), (turned, True), (none, True)):
        found = verify(arm, [each], None)
        assert found.verdict == 'holds'
        assert ('only positions are judged' in in_words(found)) is told
    order = Rotation.from_matrix(seen.rotations).as_quat()[:, [1, 2, 3, 0]]
    wxyz = replace(seen, rotations=Rotation.from_quat(order).as_matrix())
    for tolerance in (None, 1e-4):
        found = verify(arm, [wxyz], tolerance)
        assert found.verdict == 'no verdict'
        assert 'the quaternions are x y z w, not w x y z' in in_words(found)


def test_a_device_that_stands_elsewhere(cell, arm):
    true = cell[0]
    joints = UR.random_joints(30, np.random.default_rng(3))
    there = simulation.random_frame(np.random.default_rng(9), 3.0)
    moved = replace(true, base=replace(true.base, matrix=there.matrix @ true.base.matrix))
    seen = [measured(moved, joints)]
    lost = verify(arm, seen, 3e-4)
    assert lost.verdict == 'FAIL'
    assert 'was the measuring device moved (' in in_words(lost)
    found = verify(arm, seen, 3e-4, new_base=True)
    assert found.verdict == 'PASS'
    same = verify(arm, [measured(true, joints)], 3e-4)
    assert same.verdict == 'PASS'
    assert found.rms == pytest.approx(same.rms, rel=0.1)
    assert found.upper / found.rms > same.upper / same.rms
    assert 'moved' not in in_words(same)
    anew = 'base refitted, before and after alike'
    assert (anew in in_words(found), 'refitted' in in_words(same)) == (True, False)
    both = ((name, getattr(arm, name)) for name in ('chain', 'before'))
    known = replace(arm, **{name: each.with_frame('base_2', each.base) for name, each in both})
    one_of_two = verify(known, [measured(true, joints), replace(*seen, base='base_2')], 3e-4)
    assert one_of_two.common < 0.01


@pytest.mark.parametrize('oriented', [True, False])
def test_a_target_that_was_mounted_anew(cell, arm, oriented):
    """Its change counts as the arm's error unless its frame is fitted as well."""
    true = cell[0]
    there, tool = (simulation.random_frame(np.random.default_rng(k), 0.3) for k in (9, 10))
    moved = replace(true, base=there, tool=tool)
    joints = UR.random_joints(40, np.random.default_rng(3))
    seen = [simulation.measure(moved, joints, np.random.default_rng(1), *NOISE, oriented)]
    assert verify(arm, seen, 3e-4, new_base=True).verdict == 'FAIL'
    found = verify(arm, seen, 3e-4, new_base=True, new_tool=True)
    same = verify(arm, [measured(true, joints, 1)], 3e-4)
    assert found.verdict == 'PASS'
    assert found.rms == pytest.approx(same.rms, rel=0.15)
    assert found.fitted == ('base', 'tool')
    before, after = found.comparison.figures
    assert 0.5 < before.rms_mm < 5.0
    assert (after.rms_mrad < 0.5) if oriented else (after.rms_mrad is None)
    with pytest.raises(InputError, match='7 poses were measured; at least 8'):
        verify(arm, [seen[0].select(np.arange(7))], 3e-4, new_base=True, new_tool=True)


@pytest.mark.parametrize(('seed', 'count'), [(2, 8), (10, 10)])
def test_a_target_is_found_wherever_it_is_now(cell, arm, seed, count):
    """Metres from where it was; from there the fit ended in another valley."""
    rng = np.random.default_rng(seed)
    frames = {'base': simulation.random_frame(rng, 2.0), 'tool': simulation.random_frame(rng, 3.0)}
    seen = measured(replace(cell[0], **frames), UR.random_joints(count, rng))
    assert verify(arm, [seen], 3e-3, new_base=True, new_tool=True).verdict == 'PASS'


def test_limits_hold_where_some_places_are_worse_than_others():
    """As compliance leaves them: squares that scatter more than those of Gaussian noise."""
    rng = np.random.default_rng(0)
    errors = np.abs(rng.normal(size=(2000, 20, 1))) * rng.normal(size=(2000, 20, 3))
    lower, upper = np.transpose([rms_interval(each, np.arange(20)) for each in errors])
    held = np.array([lower <= np.sqrt(3.0), np.sqrt(3.0) <= upper])
    assert held.all(axis=0).mean() > stats.binom.ppf(1e-3, 2000, 0.95) / 2000


def test_a_session_is_judged_without_a_tolerance(arm, cell):
    seen = [measured(cell[0], UR.random_joints(10, np.random.default_rng(0)))]
    arm = replace(arm, region=None, covariance=None)  # it expects its former error everywhere
    rms = verify(arm, seen, None).rms
    for residual, verdict, needed in (
        (1e9, 'holds', 10),
        (1e-6, 'does not hold', 10),
        (None, 'no verdict', None),
        (rms / 1.5 * 1.05, 'UNDECIDED', None),
        (rms / 1.5 * 0.95, 'UNDECIDED', None),
    ):
        found = verify(replace(arm, residual=residual), seen, None)
        assert (found.verdict, found.tolerance) == (verdict, None)
        if verdict == 'UNDECIDED':  # as the tolerance of the same size is
            assert found.needed > 10
            same = verify(arm, seen, 1.5 * residual)
            assert (same.verdict, same.needed) == (verdict, found.needed)
            told = f'would be {"within" if rms < found.limit else "beyond"} the limit'
            assert f'about {found.needed} poses with the same RMS error {told}' in in_words(found)
            said = f'1.5 times the expected error: {rounded(1.5e3 * residual)} mm. If the whole'
            assert any(said in text for text in verification_page(UR, seen, found).verdict.text)
        else:
            assert found.needed == needed
        assert f'poses like these is {rounded(1e3 * found.rms)} mm (' in in_words(found)


def test_fitted_frames_cost_their_freedom(arm, unsearched):
    """Errors that are noise alone: their size is found, though frames were fitted to them."""
    rng, squares = np.random.default_rng(3), []
    both = ((name, getattr(arm, name)) for name in ('chain', 'before'))
    known = replace(arm, **{name: each.with_frame('base_2', each.base) for name, each in both})
    for _ in range(25):  # the figure is known by 2.6 %
        seen = with_errors(arm, rng.normal(scale=1e-4, size=(14, 3)))
        sets = [seen.select(np.arange(7)), replace(seen.select(np.arange(7, 14)), base='base_2')]
        squares.append(verify(known, sets, 0.1, new_base=True).rms ** 2)
    assert np.sqrt(np.mean(squares)) == pytest.approx(1e-4 * np.sqrt(3.0), rel=0.06)


def test_what_cannot_be_verified_is_refused(cell, arm):
    true = cell[0]
    joints = UR.random_joints(6, np.random.default_rng(0))
    seen = measured(true, joints)
    for tolerance in (0.0, np.nan, np.inf, 0.3):  # the last one meant in mm
        with pytest.raises(ConfigError, match=f'tolerance must be .* not {tolerance}'):
            verify(arm, [seen], tolerance, 0.95)
    for confidence in (0.4, 1.0, 95.0):
        with pytest.raises(ConfigError, match=f'must be .* 0.5 and 1, not {confidence}'):
            verify(arm, [seen], None, confidence)
    with pytest.raises(InputError, match='4 poses were measured; at least 5'):
        verify(arm, [measured(true, joints[:4])], 1e-3)
    with pytest.raises(InputError, match='6 poses were measured; at least 7'):
        verify(arm, [seen], 1e-3, new_base=True)
    with pytest.raises(InputError, match='not base_other: name devices'):
        verify(arm, [replace(seen, base='base_other')], 1e-3)
    with pytest.raises(InputError, match='leave out rows of distances, planes and sockets'):
        verify(arm, [seen, replace(seen, socket=True, base='base_elsewhere')], 1e-3)
    images = replace(seen, pixels=np.zeros((len(seen), 2)), points=np.zeros((len(seen), 3)))
    with pytest.raises(InputError, match='images cannot locate a new'):
        verify(arm, [images], 1e-3, new_base=True)
