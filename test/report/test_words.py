# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from datetime import datetime, timezone
from types import SimpleNamespace

import numpy as np
import pytest
from pages import problem_of, report_of
from verified import in_words, verification_page

from calib_ros.apply.judgement import judge
from calib_ros.apply.simulation import measure
from calib_ros.apply.verification import verify
from calib_ros.decision.changes import Explanation
from calib_ros.decision.comparison import Comparison
from calib_ros.decision.moved import Step
from calib_ros.decision.reasons import Reason, Rule
from calib_ros.decision.residuals import Residuals
from calib_ros.estimation.noise import Noise
from calib_ros.estimation.observations import Observations
from calib_ros.files.result_rows import verification_row
from calib_ros.files.rows import Filing
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.identification import identify
from calib_ros.identification.recalibrated import Recalibration
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.parameter import Parameter
from calib_ros.report import words
from calib_ros.report.advice import FAR, SPREAD_OUT
from calib_ros.report.reports import CLOSER, may_be_closer
from calib_ros.report.standing import standing
from calib_ros.report.words import rms_range_mm, still_holds, verdict_in_words
from calib_ros.shown import rounded, sentence

SEEN = Observations.from_arrays(np.zeros((1, 6)), np.zeros((1, 3)))


def off_by(*errors_mm, turn=np.nan):
    """Return residuals along x, at a configuration each."""
    away = 1e-3 * np.outer(errors_mm, [1.0, 0.0, 0.0])
    off = Residuals(away, np.full_like(away, turn), np.arange(len(away)), np.nan * away)
    return Comparison(off, off, np.ones(len(away), bool))


@pytest.mark.parametrize(
    ('rms_mm', 'says'),
    [(0.1, 'holds'), (0.14, 'UNDECIDED'), (0.16, 'UNDECIDED'), (0.3, 'does not hold')],
)
def test_a_calibration_holds_by_one_rule(rms_mm, says):
    """By ~/validate, and by ~/check where no change shows besides: by the interval."""
    arm = load_chain('ur10e')
    previous = Calibration(arm, arm, residual=1e-4)
    both = off_by(*[rms_mm] * 20)
    less = off_by(*[0.6 * rms_mm] * 20).before
    updates = [
        Recalibration(previous, (), 1.0, judged, 1e-4, 1e-4, 0.0)
        for judged in (both, replace(both, before=less))  # predicted worse by 1.7
    ]
    found = judge(previous, [SEEN], both)
    told = verdict_in_words(found)
    assert found.verdict == says
    assert '; the limit is 0.150 mm' in told
    assert told.startswith('too few poses to tell') == (says == 'UNDECIDED')
    turned = replace(found, comparison=off_by(*[rms_mm] * 20, turn=1.0))
    assert ('the orientations are 1732 mrad off' in verdict_in_words(turned)) == (says == 'holds')
    same = still_holds(updates[0], found)
    assert same[0] == (says != 'does not hold')
    for text in (told, same[1]):
        assert ('no longer holds: RMS 0.300 mm' in text) == (says == 'does not hold')
    fitted = SimpleNamespace(share=lambda sets: 0.3)
    for of, why in (
        (replace(previous, residual=None), 'no former error'),
        (replace(previous, rows=fitted), 'fitted to 30 % of these measurements'),
    ):
        kept = says == 'does not hold' and of.residual is not None
        found = judge(of, [SEEN], both)
        assert found.verdict == ('does not hold' if kept else 'no verdict')
        assert (why in verdict_in_words(found)) != kept
    assert [each.accepted for each in updates] == [True, False]


@pytest.mark.parametrize(
    ('rms_mm', 'says'), [(0.1, 'UNDECIDED'), (0.2, 'UNDECIDED'), (0.3, 'does not hold')]
)
def test_a_single_pose_proves_little(rms_mm, says):
    """One of 14 of a sound arm was enough for "no longer holds"."""
    arm = load_chain('ur10e')
    found = judge(Calibration(arm, arm, residual=1e-4), [SEEN], off_by(rms_mm))
    assert found.verdict == says
    assert 'on 1 pose measured since' in verdict_in_words(found)


def test_noise_that_no_number_of_poses_overcomes_asks_for_no_more_of_them():
    """~/validate asked for more poses, where `verify` named the noise of the device."""
    arm = load_chain('ur10e')
    found = judge(Calibration(arm, arm, residual=1e-4), [SEEN], off_by(*[0.16] * 20))
    assert verdict_in_words(replace(found, noise=1e-4)).endswith('; measure more')  # they decide
    told = verdict_in_words(replace(found, noise=1e-4, needed=None))
    assert told.startswith('the device has too much noise to tell')
    assert told.endswith('use a device as accurate as that of the calibration')
    few = judge(Calibration(arm, arm, residual=1e-4), [SEEN], off_by(*[0.16] * 3))
    told = verdict_in_words(replace(few, noise=1e-4, needed=None))  # of two, a bump is as likely
    assert told.startswith('too few poses to tell noise of the device from a change: RMS 0.160')
    assert told.endswith('measure more, or set sigma_position of another device')


def test_a_mistake_is_named_instead_of_a_verdict():
    """As by `verify`: ~/validate said that the calibration no longer holds."""
    arm, rng = load_chain('ur10e'), np.random.default_rng(0)
    seen = measure(arm, arm.random_joints(10, rng), rng, 5e-5, 2e-4)
    seen.positions[:] *= 1e3
    calibration = Calibration(arm, arm, residual=1e-4)
    found = judge(calibration, [seen], of_messages=True)
    told = verdict_in_words(found)
    assert found.verdict == 'no verdict'
    assert told.startswith('no verdict: the positions are in mm')
    assert 'correct the publisher' in told  # not by options of the command line
    update = Recalibration(calibration, (), 1.0, found.comparison, 1e-4, 1e-4, 0.0)
    assert still_holds(update, found) == (False, told)  # ~/check said that they agree


def test_a_bump_between_the_poses_checked_is_named_alone():
    """Poses before and after it look like changes of several joints."""
    arm, rng = load_chain('ur10e'), np.random.default_rng(0)
    calibration = Calibration(arm, arm, residual=1e-4)
    seen = measure(arm, arm.random_joints(10, rng), rng, 5e-5, 2e-4)
    found = replace(judge(calibration, [seen], of_messages=True), verdict='UNDECIDED')
    what, at = ('elbow_joint',), {'set': 0, 'sample': 5, 'stamp_ns': 6 * 10**9, 'unused': ''}
    step = Step(what, 'joint', 'the joint', size=1e-3, unit='rad', share=0.9, where='line 7', **at)
    names = (Parameter('wrist_1_joint.a'),)
    other = Explanation('wrist_1_joint', names, 9.0, 0.0, 1.0, np.ones(1), np.ones(1))
    update = Recalibration(calibration, ((other,),), 0.0, found.comparison, 1e-4, 1e-4, 0.0)
    assert 'wrist_1_joint' in still_holds(update, found)[1]
    _, told = still_holds(replace(update, step=step), found)
    assert 'no longer fits, the zero of elbow_joint moved by 1 mrad before line 7: was' in told
    assert 'wrist_1_joint' not in told
    assert '30 poses for ~/identify, 8 for calib_ros' in told  # 8 are too few for the former
    _, told = still_holds(replace(update, step=replace(step, slow=True)), found)
    assert ': does the robot, the target or the device give way? RMS' in told


@pytest.mark.parametrize(('bumped', 'verdict'), [(0.0, 'holds'), (5e-3, 'does not hold')])
def test_what_holds_no_more_is_filed_as_that(bumped, verdict):
    """Without a tolerance, too: a history tells no less than the screen."""
    arm, rng = load_chain('ur10e'), np.random.default_rng(0)
    seen = measure(arm, arm.random_joints(10, rng), rng, 5e-5, 2e-4)
    seen.positions[:] += bumped
    found = verify(Calibration(arm, arm, residual=1e-4), [seen], None)
    row = verification_row(arm, found, Filing('7', datetime.now(timezone.utc), 'i', 's'))
    assert (row.verdict, row.accepted) == (verdict, False)
    assert ('no longer holds' in standing(found)[0].heading) == (verdict == 'does not hold')


def test_a_held_out_gross_error_is_counted_where_the_figures_are(unsearched):
    problem = problem_of()
    (held_out,) = problem.judging
    held_out.positions[3] += 0.02
    result = identify(problem)
    count = result.validation.figures[1].count
    said = f'{count + 1} held-out poses, 1 of them an outlier not in the figures'
    assert result.validated_by == said
    assert '1 outlier, listed below' in str(report_of(problem, result).verdict.text)
    problem.sets[0].positions[3] += 0.02
    folded = identify(replace(problem, held_out=None))
    assert folded.validated_by.endswith(' poses, 1 of them an outlier not in the figures')


def test_a_refused_calibration_is_valid_nowhere(unsearched):
    result = identify(problem_of())
    assert 'valid over the whole joint range' in words.summary(result)
    refused = replace(result, refusals=(Reason(Rule.MOVED, 'the target moved'),))
    assert 'valid' not in words.summary(refused)


def test_the_error_told_is_the_one_within_its_limits():
    """Repeats count once, and a refitted base leaves less than it would elsewhere."""
    arm, rng = load_chain('ur10e'), np.random.default_rng(2)
    joints = arm.random_joints(8, rng).repeat([9, 1, 1, 1, 1, 1, 1, 1], axis=0)
    seen = measure(arm, joints, rng, 5e-5, 2e-4)
    found = verify(Calibration(arm, arm), [seen], 1e-3, new_base=True)
    assert found.rms > 1.02e-3 * found.comparison.figures[1].rms_mm
    said = 'over poses like these is '
    assert f'{said}{1e3 * found.rms:.3f} mm' in in_words(found)
    filing = Filing('7', datetime.now(timezone.utc), 'i', 's')
    row = verification_row(arm, found, filing)
    assert (row.rms_mm, row.rms_freedom) == pytest.approx((1e3 * found.rms, found.freedom))
    fitted = replace(found, reused=0.1)  # no night of a chart
    assert verification_row(arm, fitted, filing).rms_freedom is None
    report = verification_page(arm, [seen], found)
    assert f'each counted once: RMS {1e3 * found.rms:.3f} mm' in report.verdict.text[0]
    assert any('refitted' in each for each in report.verdict.text)


@pytest.mark.parametrize(
    ('size', 'consistent', 'said'),
    [
        (1.02, True, 'is 1.02 times the assumed device noise: consistent with pure noise'),
        (0.5, False, 'is 0.50 times the assumed device noise: the device is better than that.'),
        (1.7, False, 'the arm has errors that this model lacks. The intervals are widened'),
    ],
)
def test_what_is_left_is_told_by_the_noise_stated(size, consistent, said):
    assert said in words.scatter_in_words(Noise(size, None, consistent, 0.3, 0.2, ()))


@pytest.mark.parametrize(
    ('size', 'consistent', 'proposed'),
    [(4.6, False, True), (2.0, True, False), (1.2, False, False)],
)
def test_effects_are_proposed_where_more_than_noise_is_left_and_none_was_tried(
    solved, size, consistent, proposed
):
    """An arm that eccentricities left at 4.6 times the noise was told nothing."""
    problem, result = solved
    noise = replace(result.noise, position=size, consistent=consistent)
    left = replace(result, noise=noise)
    assert (sentence(CLOSER) in report_of(problem, left).steps) == proposed
    assert not may_be_closer(replace(left, verdicts=(None,)), beyond=True)
    steps = report_of(problem, left, tolerance=1e-6).steps
    assert (sentence(CLOSER) in steps) != any('measure more poses' in step for step in steps)


def test_far_more_than_noise_is_left_asks_what_was_loose_even_if_accepted(solved):
    problem, result = solved
    assert result.accepted
    coarse = replace(result, noise=replace(result.noise, position=9.0 * FAR, shared=()))
    said = f'{9.0 * FAR:.0f} times the assumed device noise: check that target and device sit'
    assert said in str(report_of(problem, coarse).remarks)
    assert said not in str(report_of(problem, result).remarks)
    assert report_of(problem, result, warnings=('it is old',)).remarks == ('It is old.',)


def test_poses_outside_the_region_do_not_lead_to_more_of_them():
    arm, rng = load_chain('ur10e'), np.random.default_rng(2)
    seen = measure(arm, arm.random_joints(8, rng), rng, 5e-5, 2e-4)
    found = replace(verify(Calibration(arm, arm), [seen], 1e-3), verdict='UNDECIDED', needed=50)
    assert SPREAD_OUT in standing(found)[1][0]
    assert 'about 50 poses' in in_words(found)
    partly = replace(found, outside=0.004)
    for each in (partly, replace(partly, needed=None)):
        state, steps = standing(each)
        assert 'within the region' in steps[0]
        assert 'as large as the limit' not in state.heading
    assert 'less than 1 % of the measurements are outside' in in_words(partly)
    assert 'about 50 poses' not in in_words(partly)
    page = verification_page(arm, [seen], partly)
    assert all(each[0].isupper() and each.endswith('.') for each in page.remarks)
    assert 'cycles' in page.sections[0].head
    assert not any('scatter' in each for each in page.sections[0].head)


@pytest.mark.parametrize(
    ('turns', 'tilts', 'consistent', 'said'),
    [
        (
            0.0,
            1.4e-5,
            True,
            'may come from the arm and is not in the model, as if joints were off '
            'by 0.014 mrad across their axes (standard',
        ),
        (
            2e-5,
            1.4e-5,
            False,
            'seems to come from the arm and is not in the model, as if joints '
            'were off by 0.020 mrad in their values and 0.014 mrad across their axes (standard',
        ),
        (1e-8, 0.0, False, ''),
    ],
)
def test_what_the_model_lacks_is_told_where_there_is_any(turns, tilts, consistent, said):
    lacking = SimpleNamespace(turns=turns, tilts=tilts, waves=1.0, shown=0.0)
    noise = Noise(1.03, None, consistent, 0.3, 0.2, ())
    known = {'posterior': SimpleNamespace(unmodelled=lacking), 'noise': noise}
    known |= {'chain': load_chain('ur10e')}
    told = words.unmodelled_in_words(SimpleNamespace(**known, surprise=0.0))
    assert bool(told) == bool(said)
    assert said in told
    assert not words.unmodelled_in_words(SimpleNamespace(**known, surprise=4.0))


def test_drift_is_errors_shared_in_succession_only():
    for shared in ((), ('near',), ('successive',), ('successive', 'near')):
        noise = Noise(1.0, None, True, 0.3, 0.2, shared, widened=1.5)
        assert bool(words.disturbed_in_words(noise)) == (shared == ('successive',))
    said = words.neighbours_in_words(noise)
    assert 'measured in succession (0.30) and near each other in joint space (0.20)' in said
    assert 'standard deviations 1.50 times as large' in said
    for widened in (1.0, 0.98):  # "0.98 times as large"
        assert 'as large' not in words.neighbours_in_words(replace(noise, widened=widened))
    for chance, share in ((0.053, '5.3 %'), (1e-4, 'less than 0.1 %')):
        assert f'well in {share} of cases: above 5 %' in words.chance_in_words(chance)


def test_no_figure_is_rounded_to_nothing():
    values = (0.00042, 0.0996, 0.31, 12.3456, 0.0, -0.00042)
    wanted = ['0.00042', '0.100', '0.310', '12.346', '0.000', '-0.00042']
    assert [rounded(value) for value in values] == wanted


@pytest.mark.parametrize(
    ('limits', 'said'),
    [
        ([0.00899, 0.0131], '0.009 to 0.013'),
        ([4e-4, 6e-4], '0.00040 to 0.00060'),
        ([0.43, 2791.488], '0.430 to 2791'),
        ([0.43, np.inf], 'at least 0.430'),
        (None, ''),
    ],
)
def test_the_limits_of_an_interval_have_the_same_decimals(monkeypatch, limits, said):
    monkeypatch.setattr(words, 'limits_mm', lambda *_: limits)
    assert rms_range_mm(None, 0) == said


@pytest.mark.parametrize(
    ('successive', 'near', 'drifting'),
    [(0.78, 0.16, True), (0.63, 0.72, False), (0.46, 0.5, False)],
)
def test_a_drift_is_named_though_it_shows_between_neighbours_too(successive, near, drifting):
    """A simulated drift; the measured positioner and Panda, whose arms have errors left."""
    noise = Noise(6.0, None, False, successive, near, ('successive', 'near'))
    assert ('warm up' in words.disturbed_in_words(noise)) == drifting
    assert words.drifts(replace(noise, shared=('near',))) is False


def test_errors_of_pure_numbers_have_a_unit_that_exists():
    """It was "m1"."""
    problem = problem_of(effects=('ratio',))
    report = report_of(problem, identify(problem))
    (table,) = (each for each in report.sections if each.name == 'parameters')
    (row,) = (row for row in table.rows if row[0] == 'elbow_joint.ratio')
    value, unit = float(row[1]), row[5]
    assert (unit, f'{1e3 * value:+.4f}') == ('‰', row[2])
    assert any(text.endswith(' ‰') for text in table.text)


def test_what_computing_leaves_of_poses_without_noise_is_no_distance():
    """One of 60 missed along x alone, by 1e-16 m, and distances were told of."""
    result = identify(problem_of())
    position = 1e-16 * np.ones((40, 3))
    position[0, 1:] = 0.0
    after = replace(result.fitted.after, position=position)
    fitted = replace(result.fitted, after=after)
    of_poses = replace(result, fitted=fitted, validation=None)
    assert words.error_meaning(of_poses) == ''
    position[0, 0] = 1e-4
    assert 'errors of distances' in words.error_meaning(of_poses)
    assert words.error_meaning(replace(of_poses, validation=result.fitted)) == ''  # by poses
