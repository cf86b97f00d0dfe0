# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From test poses to the verdict on the command line."""

from dataclasses import replace

import numpy as np
import pytest
from designs import design_of
from measured import rows_of, write_csv
from verified import NOISE, UR, in_words, measured, verification_page, with_errors

from calib_ros import Calibration, Problem, identify, load_calibration
from calib_ros.apply.candidates import Visibility
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.apply.verification import verify
from calib_ros.cli.common import Status
from calib_ros.files.programs import joints_csv, read_joints
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Frame
from calib_ros.report.remarks import remarks
from calib_ros.report.standing import standing


@pytest.fixture
def folder(arm, run, tmp_path):
    (tmp_path / 'result').mkdir()
    (tmp_path / 'result' / 'calibration.yaml').write_text(arm.dump())
    return tmp_path


KEPT = ('chain', 'before')
VERIFY = ('verify', 'measured.csv', '--chain', 'ur10e', '--calibration')


def test_the_whole_way_from_test_poses_to_the_verdict(cell, folder, run):
    """Plan test poses that are seen, correct them, measure the real arm there, and judge."""
    box = ('--box', 0.2, -0.5, 0.2, 1, 0.5, 1, '--tracker', 3, 0, 1)
    status, out, _ = run('plan', '--chain', 'ur10e', '--iso9283', '--out', 'tests.csv', *box)
    assert status == 0
    assert 'P1 to P5 of ISO 9283 in a cube of' in out
    joints = read_joints(folder / 'tests.csv', UR)
    sight = Visibility(np.array([[0.2, -0.5, 0.2], [1.0, 0.5, 1.0]]), np.array([3.0, 0.0, 1.0]))
    assert sight.sees(design_of(UR), joints).all()
    assert joints_csv(joints) == (folder / 'tests.csv').read_text()
    correct = ('compensate', 'tests.csv', '--chain', 'ur10e', '--out', 'corrected.csv')
    assert run(*correct, '--calibration', 'result/calibration.yaml')[0] == 0
    seen = measured(cell[0], read_joints(folder / 'corrected.csv', UR))
    write_csv(folder / 'measured.csv', rows_of(seen, 0))
    judge = (*VERIFY, 'result', '--commanded', 'tests.csv')
    status, _, err = run(*judge, '--new-tool', '--new-base')
    assert status == 1
    assert 'at least 8 are needed' in err
    by_file = (*VERIFY, 'result/calibration.yaml', *judge[-2:])
    for of, tolerance, wanted, word in (
        (by_file, '1', 0, 'PASS'),
        (judge, '0.01', Status.NOT_ACCEPTED, 'FAIL'),
    ):
        status, out, _ = run(*of, '--tolerance', tolerance)
        assert status == wanted
        assert out.startswith(f'{word}: ')
        assert 'poses like these   RMS 0.' in out
        assert 'judges the calibration' not in out
        assert '15 times at 5 poses' in out
        assert sum(line.startswith('    P') for line in out.splitlines()) == 5
    status, _, err = run(*judge, '--tolerance', 300)
    assert status == 1
    assert '--tolerance must be between 0 and 100 mm, not 300 mm' in err
    status, out, _ = run(*VERIFY, 'result', '--commanded', 'corrected.csv', '--tolerance', 1)
    assert status == Status.NOT_ACCEPTED
    assert 'give the program as it was before calib_ros compensate' in ' '.join(out.split())


def test_errors_are_along_the_axes_of_the_base_wherever_the_device_stands(cell, folder, run):
    """They were turned by the frame of the device where it had stood before."""
    worse = cell[0].with_offsets({'elbow_joint.a': 2e-3, 'wrist_1_joint.alpha': 2e-3})
    place = Frame(random_frame(np.random.default_rng(5), 1.0).matrix @ worse.base.matrix)
    tool = Frame(worse.tool.matrix @ random_frame(np.random.default_rng(6), 0.1).matrix)
    q, found = UR.random_joints(20, np.random.default_rng(4)), []
    for true in (replace(worse, tool=tool), replace(worse, base=place, tool=tool)):
        write_csv(folder / 'measured.csv', rows_of(measured(true, q, 1, (0, 0)), 0))
        run(*VERIFY, 'result', '--new-base', '--new-tool', '--out', 'out', '--force')
        text = (folder / 'out' / 'residuals.csv').read_text()
        rows = np.genfromtxt(text.splitlines(), delimiter=',', names=True)
        axes = [f'{what}{k}' for what in ('', 'before_', 'after_', 'after_r') for k in 'xyz']
        found.append(np.array([rows[name] for name in axes]))
    there = (se3.invert(worse.base.matrix) @ replace(worse, tool=tool).forward(q))[:, :3, 3].T
    assert np.abs(found[0][6:9]).max() > 1e-3
    assert np.abs(found[0][:3] + found[0][6:9] - there).max() < 3e-3
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-6)


def test_errors_by_pose_are_those_of_each_device(arm):
    """Errors seen by devices that stand otherwise were averaged along their own axes."""
    rng = np.random.default_rng(7)
    place, base = random_frame(rng, 1.0).matrix, arm.chain.frame('base').matrix
    other = Frame(place @ base)
    both = replace(arm, **{k: getattr(arm, k).with_frame('base_B', other) for k in KEPT})
    seen = measured(arm.chain, UR.random_joints(6, rng), 5, (5e-5, 0.0))
    seen = replace(seen, positions=seen.positions + base[:3, :3] @ [0.0, 0.0, 1e-3])
    turned = place[:3, :3] @ seen.rotations
    positions = seen.positions @ place[:3, :3].T + place[:3, 3]
    sets = [seen, replace(seen, positions=positions, rotations=turned, base='base_B')]
    found = verify(both, sets, 5e-3)
    assert [each.cycles for each in found.each] == [10] * 6
    for each in found.each:
        assert each.after == pytest.approx(1.0, abs=0.1)
        assert each.repeatability < 0.3


def test_rows_marked_test_are_judged_like_others(cell, folder, run):
    """A table kept for judging is what `verify` is for."""
    q = UR.random_joints(8, np.random.default_rng(3))
    found = []
    for held_out in (0, len(q)):
        write_csv(folder / 'measured.csv', rows_of(measured(cell[0], q, repeats=1), held_out))
        found.append(run(*VERIFY, 'result', '--tolerance', 1))
    assert found[0][0] == 0
    assert found[1] == found[0]


def test_a_table_of_a_camera_on_the_flange_is_read_as_by_identify(cell, folder, run):
    q = UR.random_joints(60, np.random.default_rng(3))
    for name, rows in (('fitted.csv', slice(40)), ('measured.csv', slice(40, None))):
        inverted = measured(cell[0], q[rows], repeats=1).inverted()
        write_csv(folder / name, rows_of(inverted, 0))
    eye = ('--chain', 'ur10e', '--eye-in-hand')
    assert run('identify', 'fitted.csv', *eye, '--out', 'seen')[0] == 0
    assert run(*VERIFY, 'seen', '--tolerance', 1, '--eye-in-hand')[0] == 0


def test_a_bag_of_which_much_is_lost_has_no_verdict_unless_asked_for(cell, folder, run):
    """The missing part could hold the poses that are off."""
    q = UR.random_joints(40, np.random.default_rng(3))
    write_csv(folder / 'measured.csv', rows_of(measured(cell[0], q), 0))
    assert run('csv2bag', 'measured.csv', 'bag', '--chain', 'ur10e')[0] == 0
    (file,) = (folder / 'bag').glob('*.mcap')
    file.write_bytes(file.read_bytes()[: int(0.5 * file.stat().st_size)])
    judge = ('verify', 'bag', *VERIFY[2:], 'result', '--tolerance', 1)
    status, out, told = run(*judge)
    assert (status, 'PASS' in out) == (1, False)
    assert 'First copy the bag again from the computer that made it' in told
    allowed = told.split('(--largest-loss) ')[1].split('. ')[0]
    status, out, told = run(*judge, '--largest-loss', allowed)
    assert (status, 'PASS' in out, 'messages are lost' in told) == (0, True, True)
    assert '--largest-loss must be from 0 to 1' in run(*judge, '--largest-loss', 2)[2]


def test_measurements_that_were_fitted_prove_nothing(cell, arm, folder, run):
    """They cannot pass, and the screen and the report say why."""
    true, _, fitted = cell
    new = measured(true, UR.random_joints(40, np.random.default_rng(5)), 1)
    half = verify(arm, [fitted, new], 5e-4)
    assert half.reused == 0.5
    assert '\nthe calibration was fitted to 50 % of these measurements' in in_words(half)
    assert verify(arm, [new], 5e-4).reused == 0.0
    for name, seen, warned in (('fitted', fitted, True), ('new', new, False)):
        write_csv(folder / 'measured.csv', rows_of(seen, 0))
        status, out, _ = run(*VERIFY, 'result', '--tolerance', 1, '--out', name)
        assert status == (3 if warned else 0)
        files = [folder / name / each for each in ('report.html', 'report.md')]
        for text in (out, *(file.read_text() for file in files)):
            assert ('calibration was fitted to' in ' '.join(text.split())) is warned
            assert ('PASS: the calibration' in text) is not warned
        assert '| mean + 3 std' in files[1].read_text()


def test_the_serial_number_comes_with_the_calibration(cell, folder, run):
    """The page did not say which robot was verified, and another's calibration was used."""
    seen = measured(cell[0], UR.random_joints(6, np.random.default_rng(3)))
    write_csv(folder / 'measured.csv', rows_of(seen, 0))
    arm = load_calibration(folder / 'result')
    named = replace(arm, record={**arm.record, 'robot_serial': '0007'})
    (folder / 'result' / 'calibration.yaml').write_text(named.dump())
    status, _, err = run(*VERIFY, 'result', '--serial', '0008')
    assert status == 1
    assert 'result is the calibration of the robot with serial "0007"; this one is "0008"' in err
    run(*VERIFY, 'result', '--out', 'verified')
    assert '- Serial number: 0007\n' in (folder / 'verified' / 'report.md').read_text()


def test_a_gross_error_is_named_although_the_others_leave_the_verdict_open(arm):
    errors = np.random.default_rng(0).normal(scale=5e-5, size=(12, 3))
    assert verify(arm, [with_errors(arm, errors)], 1e-4).verdict == 'UNDECIDED'
    errors[7] += [0.0, 0.01, 0.0]
    text = in_words(found := verify(arm, [with_errors(arm, errors)], 1e-4))
    assert (found.verdict, found.odd) == ('FAIL', (7,))
    assert 'pose 8 alone is ' in text


@pytest.mark.parametrize(
    ('bad', 'size', 'words'),
    [
        ([3, 17, 30], 1e-2, 'poses 4, 18, 31 alone are up to 1'),
        (np.s_[25:], 2e-4, 'poses 26 to 40 alone are up to'),
        (np.s_[:12], 2e-4, 'poses 1 to 12 alone are up to'),
        (np.s_[::2], 2e-4, ''),
    ],
)
def test_few_poses_or_a_moment_that_parts_those_beyond_the_limit_are_named(arm, bad, size, words):
    errors = np.random.default_rng(0).normal(scale=1e-5, size=(40, 3))
    errors[bad] += np.random.default_rng(1).normal(scale=size, size=errors[bad].shape)
    text = in_words(found := verify(arm, [with_errors(arm, errors)], 1e-4))
    assert found.verdict == 'FAIL'
    assert found.odd == (tuple(np.arange(40)[bad]) if words else ())
    assert words in text


@pytest.mark.parametrize(
    ('seed', 'moved', 'words'),
    [
        (0, {'shoulder_lift_joint.theta': 1e-3}, 'the zero of shoulder_lift_joint moved by '),
        (1, {'elbow_joint.theta': 2e-3}, 'the zero of elbow_joint moved by '),
        (0, {'base.x': 1e-3}, "the measuring device or the robot's foot moved by 1 mm (base)"),
        (1, {'tool.x': 1e-3}, 'the target moved by 1 mm (tool)'),
    ],
)
def test_what_moved_while_poses_were_measured_is_named(cell, arm, moved, words, seed):
    joints = UR.random_joints(24, np.random.default_rng(seed))
    first, then = (measured(true, joints, 1) for true in (cell[0], cell[0].with_offsets(moved)))
    places = np.concatenate([first.positions[:10], then.positions[10:]])
    seen = replace(first, positions=places, oriented=np.zeros(24, dtype=bool))
    text = in_words(found := verify(arm, [seen], 2e-4))
    assert found.verdict == 'FAIL'
    assert f'something moved while you measured: {words}' in text
    assert ' before line 11 ' in text
    assert 'poses 11 to 24 alone are up to ' in text
    text = in_words(verify(arm, [then], 2e-4))  # before the first pose
    assert 'something moved' not in text


def test_another_load_from_the_first_pose_on_is_no_move(cell, arm):
    """Of few poses it looks like a step here and there."""
    joints = UR.random_joints(12, np.random.default_rng(7))
    bent = {'shoulder_lift_joint': 1.5e-3, 'elbow_joint': 8e-4, 'wrist_1_joint': 5e-4}
    bent = {f'{joint}.gravity_wrist_3_joint': size for joint, size in bent.items()}
    true = cell[0].with_effects([*bent]).with_offsets(bent)
    found = verify(arm, [measured(true, joints, 1)], 2e-4)
    assert found.verdict == 'FAIL'
    assert found.step is None


def test_a_mistake_in_the_measurements_is_named_and_no_verdict_on_the_arm(cell, arm):
    seen = measured(cell[0], UR.random_joints(10, np.random.default_rng(3)), 1)
    late = np.arange(10)[:, np.newaxis] > 3
    in_mm = replace(seen, positions=1e3 * seen.positions)
    some = replace(seen, positions=seen.positions * np.where(late, 1e3, 1.0))
    for wrong, words, tolerance in (
        (in_mm, 'in mm, not metres: --length mm', None),
        (replace(seen, joints=np.degrees(seen.joints)), 'are in degrees, not radians', 1e-3),
        (some, 'n lines 5 to 10 alone, the positions are in mm, not metres', None),
    ):
        found = verify(arm, [wrong], tolerance)
        assert found.verdict == 'no verdict'
        (said,) = remarks(found)
        assert words in said
        assert standing(found)[0].state == 'open'
        _, told = verification_page(arm.chain, [wrong], found).verdict.text
        assert words in told


def test_a_named_cause_is_the_next_step_and_said_once(cell, arm):
    """A gross error or a moved device asks for no new calibration."""
    seen = measured(cell[0], UR.random_joints(20, np.random.default_rng(3)), 1)
    gross = seen.positions + 0.03 * (np.arange(20)[:, np.newaxis] == 7)
    turned = measured(cell[0].with_offsets({'elbow_joint.theta': 0.003}), seen.joints[::3], 3)
    for changed, first in (
        (replace(seen, positions=gross), 'Pose 8 alone is'),
        (replace(seen, positions=seen.positions + 0.003), 'One common shift and turn'),
        (turned, 'Check that measuring device'),
    ):
        found = verify(arm, [changed], 2e-4)
        state, steps = standing(found)
        assert (state.state, steps[0].startswith(first)) == ('bad', True), steps
        named = changed is not turned
        assert any('Calibrate again' in each for each in steps) is not named
        assert not any('active' in each for each in steps)  # it plays no part
        page = verification_page(arm.chain, [changed], found)
        assert (page.steps, page.remarks) == (steps, ())


def test_with_quiet_a_bad_verdict_tells_its_reasons(cell, folder, run):
    seen = measured(cell[0], UR.random_joints(10, np.random.default_rng(3)), 1)
    write_csv(folder / 'measured.csv', rows_of(seen, 0))
    status, out, err = run(*VERIFY, 'result', '--length', 'mm', '--quiet')
    assert (status, out) == (3, '')
    verdict, why, steps = [each for each in err.splitlines() if each.startswith('calib_ros: ')]
    assert verdict == 'calib_ros: No verdict: the measurements do not fit the arm'
    assert (
        'the positions are in metres, not mm (or in mm, not um: --length mm): --length m (' in why
    )
    assert steps.startswith('calib_ros: what to do -> Check what is named ')


@pytest.mark.parametrize('seed', [1, 2])
def test_a_calibration_holds_where_it_was_not_measured_if_no_worse_than_expected(seed):
    """Two joints stood nearly still; then they move, and nothing else has changed."""
    rng = np.random.default_rng(seed)
    true = faulty(UR, Cell(), rng)
    q = UR.random_joints(60, rng)
    q[:, 1:3] = q[0, 1:3] + 0.05 * rng.normal(size=(60, 2))
    seen = measure(true, q, rng, *NOISE)
    arm = Calibration.of(identify(Problem(UR, seen, sigma_position=5e-5, sigma_orientation=2e-4)))
    found = verify(arm, [measure(true, UR.random_joints(40, rng), rng, *NOISE)], None)
    assert found.lower > 1.5 * arm.residual
    assert found.verdict == 'holds'
    near = verify(arm, [measure(true, q[:30] + 0.01, rng, *NOISE)], None)
    assert near.verdict == 'holds'
    assert near.limit == 1.5 * arm.residual


def test_a_calibration_does_not_hold_only_because_nothing_was_known_there(arm):
    """It removes 1.6 mm, and leaves 2.1: less than 1.5 times as much, but more."""
    errors = np.random.default_rng(0).normal(scale=1.3e-3, size=(40, 3))
    vague = replace(arm, region=replace(arm.region, square=1e6 * arm.region.square))
    found = verify(vague, [with_errors(arm, errors)], None, sigma_position=NOISE[0])
    assert found.verdict == 'does not hold'


def test_a_calibration_does_not_hold_where_the_nominal_arm_is_nearer(arm):
    """However little is known there."""
    unsure = replace(arm, unmodelled=arm.unmodelled._replace(waves=1.0))
    sound = replace(UR, base=arm.chain.base, tool=arm.chain.tool)
    found = verify(unsure, [measured(sound, UR.random_joints(40, np.random.default_rng(3)))], None)
    before, after = (each.rms_mm for each in found.comparison.figures)
    assert before < 0.3 * after
    assert found.verdict == 'does not hold'
