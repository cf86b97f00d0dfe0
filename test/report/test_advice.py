# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a page says of a refusal: the reason, what it means, and what to do."""

from dataclasses import replace

import numpy as np
import pytest
from measured import TRAIN, TRUE, UR, measured
from pages import page_of, report_of

from calib_ros import Problem, identify, load_chain
from calib_ros.apply import simulation
from calib_ros.decision.diagnosis import Diagnosis
from calib_ros.decision.reasons import Reason, Rule
from calib_ros.decision.undoing import Suspect
from calib_ros.report import advice, refusals
from calib_ros.report.advised import advice_of
from calib_ros.report.markdown import markdown

pytestmark = pytest.mark.usefixtures('single')


@pytest.mark.parametrize('auto', [False, True])
@pytest.mark.parametrize('rule', Rule)
def test_every_refusal_is_told_in_plain_words(rule, auto):
    """And sends nobody to the model just used."""
    (told,) = advice.advice(
        [Reason(rule, 'something new')], advice.Situation(needless=('auto',) * auto)
    )
    assert told.heading
    assert told.steps
    assert told.meaning
    assert told.refusal == 'something new'
    assert not auto or 'auto' not in ''.join(told.steps)


def test_a_verdict_names_each_of_several_mistakes():
    both = Suspect('several mistakes at once', 'a, b are swapped (--columns a); c counts (sign)')
    found = Diagnosis((both,), 1.0, 2e-3)
    (told,) = advice.advice([found.reason])
    assert told.in_short.endswith(f': {both.what}: {both.remedy}')


@pytest.mark.parametrize('rule', [Rule.GAIN, Rule.REGION])
def test_far_too_coarse_measurements_are_to_be_checked_first(rule):
    (usual,) = advice.advice([Reason(rule, 'little gain')], advice.Situation(left=2.0))
    (coarse,) = advice.advice([Reason(rule, 'little gain')], advice.Situation(left=47.6))
    assert '48 times' in coarse.steps[0]
    assert coarse.steps[1:] == tuple(each for each in usual.steps if 'stood still' not in each)


def test_no_gain_is_told_by_how_much_was_measured_and_what_is_left():
    refused = [Reason(Rule.GAIN, 'little gain')]
    (few,) = advice.advice(refused, advice.Situation(poses=14, left=2.5, sigma=1e-4))
    assert few.meaning.startswith('Only 14 different poses')
    (enough,) = advice.advice(refused, advice.Situation(poses=50, left=4.62, sigma=1e-4))
    assert 'noise of 0.46 mm in each direction; 0.1 mm is assumed' in enough.meaning


@pytest.mark.parametrize('rule', [Rule.GAIN, Rule.REGION])
def test_of_few_poses_the_model_that_bends_is_tried_before_more_are_measured(rule):
    refused = [Reason(rule, 'little gain')]
    (geometric,) = advice.advice(refused, advice.Situation(poses=14))
    (auto,) = advice.advice(refused, advice.Situation(poses=14, needless=('auto',)))
    assert '--model auto' in geometric.steps[0]
    assert geometric.steps[1:] == auto.steps == refusals.rules()[Rule.CONFIGURATIONS].steps


def test_outliers_are_to_be_looked_at_if_much_is_left():
    refused = [Reason(Rule.LARGEST_ERROR, 'RMS 12.3 mm remains')]
    (told,) = advice.advice(refused, advice.Situation(outliers=12))
    assert '(12 poses; in the report' in told.steps[0]
    assert told.steps[1:] == refusals.rules()[Rule.LARGEST_ERROR].steps


def test_no_rule_is_told_before_its_cause():
    """A stretched board was told first, but on the page as a consequence of a wrong arm."""
    brings = advice.BRINGS
    pairs = [(rule, cause) for cause in brings for rule in brings[cause] if rule is not cause]
    early = [pair for pair in pairs if pair[0].value < pair[1].value]
    assert all(cause in brings.get(rule, ()) for rule, cause in early)


@pytest.mark.parametrize('shift', [0.003, 0.02])
def test_held_out_poses_further_off_ask_first_what_was_moved(shift):
    """The chain was to be checked, or more poses to be measured."""
    rows = measured()
    train, test = rows.select(np.arange(TRAIN)), rows.select(np.arange(TRAIN, len(rows)))
    test = replace(test, positions=test.positions + np.array([shift, 0.0, 0.0]))
    problem = Problem(UR, train, held_out=test)
    told = advice_of(problem, identify(problem))[0]
    assert told.steps[0] == advice.IN_BETWEEN
    assert advice.IN_BETWEEN not in told.steps[1:]


def test_errors_shared_in_succession_ask_for_random_order_first():
    """A good arm seen by a device that drifts was told to look for errors of its gears."""
    here = advice.Situation(poses=40, drifts=True)
    (told,) = advice.advice([Reason(Rule.GAIN, 'little gain')], here)
    assert told.steps == (advice.DRIFTS, *refusals.rules()[Rule.GAIN].steps)
    assert told.again == refusals.rules()[Rule.DRIFT].again
    rows, share = measured(chain=UR, count=40), np.linspace(0.0, 1.0, 40)[:, np.newaxis]
    moved = replace(rows, positions=rows.positions + share * np.array([1.5e-3, 1e-3, -8e-4]))
    problem = Problem(UR, moved)
    report = report_of(problem, identify(problem))
    assert report.advice[0].steps[0] == advice.DRIFTS
    assert report.steps == (told.again,)


@pytest.mark.parametrize('cause', [Rule.ENCODER, Rule.MOVED])
def test_what_moved_explains_the_large_error_left(cause):
    """Chain, units and order were to be checked besides, of an arm whose base moved by 62 mm."""
    found = [Reason(cause, 'moved'), Reason(Rule.LARGEST_ERROR, 'RMS 32 mm remains')]
    moved, others = advice.advice(found)
    assert moved.steps == refusals.rules()[cause].steps
    assert (others.steps, others.refusal) == ((), 'RMS 32 mm remains')


def test_a_joint_that_stood_still_is_told_before_the_scale():
    """Its step is to move the joint; the scale is judged again then."""
    assert Rule.EXCITATION.value < Rule.SCALE.value


def test_a_remedy_is_told_once():
    """On the page the sentence of the rule and the last step told the same."""
    reason = Reason.with_remedy(Rule.SCALE, 'lengths shrink. If that is right, set sigma_scale')
    (told,) = advice.advice([reason], advice.Situation(needless=('no_device', 'no_linear')))
    assert (str(reason)[-11:], told.refusal) == ('sigma_scale', 'lengths shrink')
    assert not any(word in ' '.join(told.steps) for word in ('linear joint', 'temperature'))


@pytest.mark.parametrize('sockets', [False, True])
def test_sockets_have_neither_temperature_nor_pressure(solved, sockets):
    problem, result = solved
    seen = replace(problem.observations, socket=sockets)
    refused = replace(result, refusals=(Reason(Rule.SCALE, 'lengths shrink'),))
    for images in (0, 8):  # beside them
        found = replace(refused, images=images)
        (told,) = advice_of(replace(problem, observations=seen, held_out=None), found)
        steps = ' '.join(told.steps)
        assert ('temperature' not in steps) == ('measure their distance' in steps) == sockets
        assert ('A printed board' in steps) == bool(images)


@pytest.mark.parametrize('rule', [rule for rule in Rule if rule not in advice.TOLD_TWICE])
def test_what_no_step_tells_is_told_of_the_reason(rule):
    """Several targets to be named, distances to be corrected, the loss to be allowed were not."""
    (told,) = advice.advice([Reason(rule, 'moved by 4 mm', '; subtract 3 mm')])
    assert told.refusal == 'moved by 4 mm; subtract 3 mm'


def test_rounding_hides_no_other_cause():
    """It may be half of what is left: a drift of 3 mm was neither named nor looked for."""
    found = advice.Situation(left=advice.FAR, drifts=True, rounding=2.7)
    (told,) = advice.advice([Reason(Rule.GAIN, 'no gain')], found)
    assert told.steps[:2] == (advice.DIGITS.format(2.7), advice.DRIFTS)
    assert any('device to the floor' in step for step in told.steps)


@pytest.mark.parametrize(
    ('digits', 'first'), [(2, 'Record the joint values'), (3, 'The remaining')]
)
def test_rounded_joint_values_are_named_only_if_they_explain_the_error(digits, first):
    """Device and target were to be fastened, of values with two digits."""
    rows = measured(count=60)
    noise = np.random.default_rng(1).normal(0.0, 4e-3 * (digits == 3), rows.positions.shape)
    coarse = replace(rows, joints=rows.joints.round(digits), positions=rows.positions + noise)
    problem = Problem(UR, coarse)
    (told,) = advice_of(problem, identify(problem))
    assert told.steps[0].startswith(first)


@pytest.mark.parametrize(
    ('offsets', 'first'),
    [({'elbow_joint.theta': 0.15}, 'If only zeros'), ({'elbow_joint.a': 0.07}, 'Check that the')],
)
def test_mastering_is_the_first_step_if_only_zeros_are_off(offsets, first):
    problem = Problem(UR, measured(TRUE.with_offsets(offsets)))
    (told,) = advice_of(problem, identify(problem))
    assert told.steps[0].startswith(first)
    assert ('largest_length' in ' '.join(told.steps)) == ('elbow_joint.a' in offsets)


@pytest.mark.parametrize(('needless', 'count'), [(('table',), 2), ((), 3)])
def test_publishers_are_told_of_only_if_there_are_some(needless, count):
    """The words of the refusal tell nothing: a joint may be named publisher."""
    reason = Reason(Rule.MISTAKE, 'publisher_joint counts the other way')
    (told,) = advice.advice([reason], advice.Situation(needless=needless))
    assert len(told.steps) == count


def test_what_moved_is_told_with_the_steps_of_what_was_measured():
    """Of a table of poses the second step spoke of images and draw-wires, too."""
    rows = measured(chain=UR, count=40)
    moved = replace(rows, positions=rows.positions + 2e-3 * (np.arange(40) > 20)[:, np.newaxis])
    problem = Problem(UR, moved)
    (told, *_) = report_of(problem, identify(problem)).advice
    assert told.heading == refusals.rules()[Rule.MOVED].heading
    assert len(told.steps) == 2
    assert not any('images' in each or 'wire' in each for each in told.steps)


@pytest.mark.parametrize(
    ('needless', 'told', 'silent'),
    [
        (('no_images', 'no_wires'), 'the column session', ('--places', 'draw-wire')),
        (('images', 'no_wires'), 'the --places table', ('session', 'draw-wire')),
        (('no_images',), 'draw-wire', ('--places',)),
    ],
)
def test_what_to_do_after_a_move_suits_the_measurements(needless, told, silent):
    reason = Reason(Rule.MOVED, 'the target moved')
    (one,) = advice.advice([reason], advice.Situation(needless=needless))
    assert told in ' '.join(one.steps)
    assert not any(word in ' '.join(one.steps) for word in silent)


@pytest.mark.parametrize('poses', [14, 50])
def test_a_device_finer_than_stated_is_to_be_stated_first(poses):
    """The stated sigma may alone make a correction uncertain that held-out poses confirm."""
    refused = [Reason(Rule.REGION, 'uncertain')]
    here = advice.Situation(poses, sigma=1e-4)
    (finer,) = advice.advice(refused, replace(here, left=0.22))
    (usual,) = advice.advice(refused, replace(here, left=0.8))
    assert 'less than 0.1 mm' in finer.steps[0]
    assert 'only 0.022 mm' in finer.steps[0]
    assert finer.steps[1:] == usual.steps


@pytest.mark.parametrize(
    ('rules', 'steps', 'last'),
    [
        (
            (Rule.MISTAKE, Rule.LARGEST_ERROR, Rule.GAIN, Rule.OUTLIERS),
            (True, True, False),
            'LARGEST_ERROR; GAIN',
        ),
        ((Rule.MISTAKE, Rule.ENCODER), (True, False), 'ENCODER'),
        ((Rule.MISTAKE, Rule.OWN_BEHAVIOUR), (True, False), 'OWN_BEHAVIOUR'),
        ((Rule.MOVED, Rule.OUTLIERS), (True, False), 'OUTLIERS'),
        ((Rule.ENCODER, Rule.OUTLIERS), (True, False), 'OUTLIERS'),
        ((Rule.EXCITATION, Rule.GAIN), (True, False), 'GAIN'),
        ((Rule.OUTLIERS,), (True,), 'OUTLIERS: do this'),
        ((Rule.MOVED, Rule.CONFIGURATIONS), (True, False), 'MOVED'),
    ],
)
def test_what_follows_from_another_reason_sends_nobody_elsewhere(rules, steps, last):
    """From a wrong setting, a bump, a joint that hardly moved, or too few poses."""
    here = advice.Situation(left=1000.0)
    told = advice.advice([Reason(rule, rule.name, ': do this') for rule in rules], here)
    assert tuple(bool(each.steps) for each in told) == steps
    assert told[-1].refusal == last
    assert told[0].heading in told[-1].heading


def test_what_two_rules_ask_for_is_told_once():
    both = (Rule.LARGEST_ERROR, Rule.OUTLIERS)
    first, second = advice.advice([Reason(rule, rule.name) for rule in both])
    assert first.steps == refusals.rules()[Rule.LARGEST_ERROR].steps
    assert second.steps == refusals.rules()[Rule.OUTLIERS].steps[:3]


def test_a_refused_page_says_why_and_what_to_do():
    rng = np.random.default_rng(3)
    rows = measured(chain=UR, count=40)
    problem = Problem(UR, replace(rows, positions=rows.positions + rng.normal(0, 1e-3, (40, 3))))
    result = identify(problem)
    assert not result.accepted
    report = report_of(problem, result)
    page = page_of(report)
    order = ('Not accepted', 'Why it was refused', 'What to do:', 'Accuracy of the')
    where = [page.text.index(words) for words in order]
    assert where == sorted(where)
    for each in advice.advice(result.refusals):
        assert each.heading in page.text
        assert f'{each.refusal}.' in page.text
        told = f'{each.found}\n\n**What to do:**\n\n1. ' if each.steps else each.found
        assert told in markdown(report, {})
    assert 'none: not accepted' in page.text
    assert 'map' not in page.data['figures']


def test_a_mistake_is_the_first_reason_and_what_follows_has_no_steps():
    problem = Problem(load_chain('ur10'), measured(chain=UR, count=40))
    report = report_of(problem, identify(problem))
    first, *others = report.advice
    assert '--chain ur5e' in first.refusal
    assert report.verdict.text[0].startswith(f'Why: {first.heading}: the arm is a ur5e')
    assert [each.steps for each in others] == [()]


def test_poses_in_one_spot_do_not_show_a_good_arm():
    rng = np.random.default_rng(4)
    joints = np.array([0.3, -1.2, 1.4, -0.8, 1.1, 0.5]) + rng.normal(0.0, 0.01, (40, 6))
    rows = simulation.measure(UR, joints, rng, 5e-5, 2e-4)
    problem = Problem(UR, rows, sigma_position=1e-4, sigma_orientation=4e-4)
    (told,) = report_of(problem, identify(problem)).advice
    assert told == replace(refusals.GOOD_HERE, refusal=told.refusal)


def test_of_a_far_larger_arm_the_setting_of_its_lengths_is_named():
    """An arm of 20 m, right but for 6 cm, was only taken for another."""
    assert '--largest-length' in refusals.rules()[Rule.COMMON_SENSE].steps[-1]
