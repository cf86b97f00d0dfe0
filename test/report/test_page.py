# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Pages of reports, without a browser."""

import base64
import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from measured import TEST, TRAIN, TRUE, UR, measured
from pages import Page, page_of, problem_of, report_of
from plotly import graph_objects
from verified import verification_page

from calib_ros import Calibration, Problem, identify, verify
from calib_ros.apply import simulation
from calib_ros.apply.workspace import survey
from calib_ros.decision.reasons import Reason, Rule
from calib_ros.files.hashes import Input
from calib_ros.files.loading import Loaded
from calib_ros.kinematics.chain_file import table_hash
from calib_ros.report import advice, page, refusals
from calib_ros.report.content import Headline, Origin
from calib_ros.report.documents import as_document
from calib_ros.report.drawing import drawing
from calib_ros.report.explorer import BANDS, SINGLE, WORST, explorer
from calib_ros.report.gathered import poses_of
from calib_ros.report.markdown import markdown
from calib_ros.report.page import render
from calib_ros.report.plan import plan_report
from calib_ros.report.poses import JUDGED
from calib_ros.report.reports import identification_report
from calib_ros.report.sections import identity_of
from calib_ros.report.words import limits_mm, summary
from calib_ros.report.workspace import workspace_report

HOSTILE = '<script>alert(1)</script>"\'&</script><!--'


def rms_of(errors):
    """Return the RMS [1000] of vectors (N, 3) [1]."""
    return 1e3 * np.sqrt(np.mean(np.sum(errors**2, axis=1)))


def test_the_figures_are_those_of_the_result(solved):
    _, result = solved
    page = page_of(report_of(*solved))
    for figures in result.validation.figures:
        for name in ('rms_mm', 'mean_mm', 'max_mm', 'mean_plus_3_sigma_mm', 'rms_mrad'):
            assert f'{getattr(figures, name):.3f}' in page.text
    for name, partners in result.gauges.items():
        assert f'{name} {", ".join(partners)}' in page.text
    assert table_hash(result.chain) in page.text
    assert ('None is above 0.9.' in page.text) == (not result.correlated())
    assert page.text.index('Accepted') < page.text.index('Accuracy before and after')


@pytest.mark.parametrize('folded', [False, True])
def test_poses_are_those_judged_and_their_errors_make_the_figures(solved, folded):
    problem, result = solved
    if folded:
        problem = replace(problem, held_out=None)
        result = identify(problem)
    poses = poses_of(result)
    assert len(poses) == (TRAIN if folded else TRAIN + TEST)
    assert (poses.role == JUDGED).sum() == (TRAIN if folded else TEST)
    for errors, found in zip((poses.before, poses.after), result.validation.figures, strict=True):
        assert rms_of(errors[poses.judged]) == pytest.approx(found.rms_mm, rel=1e-12)
    turned = rms_of(poses.turned_after[poses.judged])
    assert turned == pytest.approx(result.validation.figures[1].rms_mrad, rel=1e-12)


def test_residuals_csv_holds_every_pose(solved):
    poses = poses_of(solved[1])
    rows = list(csv.DictReader(io.StringIO(poses.table())))
    assert len(rows) == len(poses)
    assert [int(row['stamp_ns']) for row in rows] == poses.stamps_ns.tolist()
    after = np.array([[float(row[f'after_{axis}']) for axis in 'xyz'] for row in rows])
    assert after == pytest.approx(poses.after, abs=1e-9)
    joints = np.array([[float(row[f'q{k}']) for k in range(1, 7)] for row in rows])
    assert joints == pytest.approx(poses.joints, abs=1e-9)


def test_positions_alone_leave_the_orientation_out():
    rows = measured(oriented=False, count=60)
    problem = Problem(UR, rows)
    result = identify(problem)
    poses = poses_of(result)
    assert 'after_rx' not in poses.table()
    page = page_of(report_of(problem, result))
    assert 'angle' not in [kind for kind, _ in page.data['explorer']['kinds']]


def test_the_page_says_whether_it_is_good_enough(solved):
    _, result = solved
    rms = 1e-3 * result.validation.figures[1].rms_mm
    lower, upper = limits_mm(result.validation, 1)
    for tolerance, state, words in (
        (3.0 * rms, 'good', 'within the tolerance'),
        (0.999e-3 * upper, 'open', 'perhaps not within the tolerance'),
        (rms, 'open', 'perhaps not within the tolerance'),
        (0.3 * rms, 'open', 'but not within the tolerance'),
    ):
        verdict = report_of(*solved, tolerance=tolerance).verdict
        assert verdict.state == state
        assert words in verdict.heading
    shown = f'{1e3 * rms:.3f} mm ({lower:.3f} to {upper:.3f})'
    assert shown in report_of(*solved).verdict.gain
    assert f'mm (95 %: {lower:.3f} to {upper:.3f} mm)' in summary(result)
    told = as_document(result, {})
    after = told['validation']['after']
    assert (after['rms_lower_mm'], after['rms_upper_mm']) == (lower, upper)
    assert 'rms_lower_mm' not in told['fitted']['after']


def test_a_noise_that_nobody_stated_is_marked(solved):
    problem = replace(solved[0], sigma_position=5e-5, sigma_orientation=Problem.sigma_orientation)
    identity = dict(report_of(problem, solved[1]).identity)
    stated = '0.05 mm, 0.333 mrad (default); one sigma; scale '
    assert identity['Assumed device noise'] == f'{stated}not checked'
    problem = replace(problem, sigma_scale=1e-5)
    identity = dict(report_of(problem, solved[1]).identity)
    assert identity['Assumed device noise'] == f'{stated}checked to 10 ppm'


def test_what_others_named_is_text(solved):
    problem, result = solved
    names = [f'<b onclick=x>{k}</b>{HOSTILE}'.replace('.', '') for k in range(6)]
    joints = tuple(replace(j, name=n) for j, n in zip(UR.joints, names, strict=True))
    chain = replace(UR, name=HOSTILE, joints=joints, parallel=None)
    problem = problem_of(chain=chain)
    result = identify(problem)
    origin = Origin((Input(HOSTILE, 1, HOSTILE),), HOSTILE, HOSTILE, HOSTILE, HOSTILE)
    text = render(identification_report(Loaded(problem, {}, (HOSTILE,)), result, origin))
    page = Page(text)
    assert [tag for tag, _ in page.tags if tag == 'script'] == ['script'] * 3
    assert not [1 for _, attributes in page.tags if 'onclick' in attributes]
    assert page.text.count('alert(1)') > 10
    told = Origin((Input('a', 1, 'b'),), 'c', 'd', 'e', 'f')
    plain = identification_report(Loaded(solved[0], {}, ('g',)), solved[1], told)
    plain = replace(plain, advice=advice.advice([Reason(Rule.GAIN, 'h'), Reason(Rule.DRIFT, 'i')]))
    assert {tag for tag, _ in page.tags} <= {tag for tag, _ in page_of(plain).tags}
    shown = json.dumps(page.data['figures'])
    assert '<b ' not in shown
    assert '<script' not in shown


def test_a_page_loads_nothing(solved):
    text = render(report_of(*solved))
    page = Page(text)
    for tag, attributes in page.tags:
        assert not {'src', 'srcset', 'action'} & attributes.keys(), tag
        assert attributes.get('href', 'data:,') == 'data:,'
    assert "default-src 'none'" in text
    assert len(text.encode()) < 8e6


def test_every_figure_is_one_that_plotly_knows_and_is_drawn_on_paper(solved):
    arm = Calibration.of(solved[1])
    found = survey(arm, 500, np.random.default_rng(0))
    report = workspace_report(arm, found, Origin())
    pages = [page_of(report_of(*solved)), page_of(report)]
    figures = [figure for page in pages for figure in page.data['figures'].values()]
    assert len(figures) >= 8
    for figure in figures:
        graph_objects.Figure(figure)
    for each in report.sections:
        assert (drawing(each.figure, each.height) is not None) == (each.figure is not None)
    assert drawing({'data': [{'type': 'scatter3d'}], 'layout': {}}, 100) is None
    for label, errors in found.parts.items():
        sizes = (f'{1e3 * size:.3f}' for size in (np.sqrt(np.mean(errors**2)), errors.mean()))
        assert ' '.join((label, *sizes)) in pages[1].text


def test_a_page_names_what_was_read_and_the_command_that_made_it(solved):
    problem, result = solved
    origin = Origin(
        (Input('cell/a.mcap', 1, 'a'), Input('cell/metadata.yaml', 1, 'b')), command='c <d>'
    )
    report = replace(report_of(problem, result), origin=origin)
    told = advice.advice([Reason(Rule.GAIN, 'h')])
    refused = replace(report, verdict=Headline('bad', 'no'), steps=('again',), advice=told)
    lines = markdown(refused, {}).splitlines()
    steps = [f'{k}. {step}' for k, step in enumerate(told[0].steps, 1)]
    assert lines.index('again') > max(map(lines.index, steps))
    assert report.of == 'cell'
    assert '<span>c</span> <span>&lt;d&gt;</span>' in render(refused)


@pytest.mark.parametrize(
    ('share', 'count', 'sigma', 'state'),
    [(0.0, 60, 3e-4, 'info'), (0.5, 8, 3e-4, 'bad'), (0.0, 60, 3e-5, 'bad')],
)
def test_an_arm_without_an_error_to_see_is_no_bad_one(share, count, sigma, state):
    """Few poses that do not show a gain do not show a good arm either, nor does bad noise."""
    rng = np.random.default_rng(1)
    true = simulation.faulty(UR, simulation.Cell(), rng)
    names = [name for joint in UR.joints for name in joint.parameters]
    arm = UR.with_offsets({name: share * true.offset(name, UR) for name in names})
    rows = simulation.measure(arm, UR.random_joints(count, rng), rng, 3e-4, 6e-4)
    problem = Problem(UR, rows, sigma_position=sigma, sigma_orientation=2.0 * sigma)
    result = identify(problem)
    assert {each.rule for each in result.refusals} == {Rule.GAIN}
    report = report_of(problem, result, tolerance=1e-3)
    told, good = report.verdict, state == 'info'
    assert (told.state, 'tolerance' in told.heading, '0.' in told.gain) == (state, good, good)
    assert (report.advice[0].meaning == refusals.GOOD_ARM.meaning) == good
    undecided = report_of(problem, result, tolerance=1e-3 * result.comparison.figures[0].rms_mm)
    assert undecided.steps[0].startswith('Measure more poses to decide') == good


def test_the_verdict_of_an_accepted_result_says_where_it_holds_and_what_is_doubtful(solved):
    """And that the robot is not changed yet."""
    problem, result = solved
    report = report_of(problem, result)
    assert result.accepted
    assert report.verdict.heading == 'Accepted'
    assert 'unchanged so far' in report.verdict.text[-1]
    assert 'calib_ros compensate' in ' '.join(report.steps)
    near = replace(result, region=replace(result.region, limit=1e-3, share=0.1))
    report = report_of(problem, near)
    assert report.verdict.heading == 'Accepted near the measured poses'
    assert 'would act everywhere' in report.steps[0]
    assert report.steps[-1].startswith('Then measure at least five new poses near these')
    assert '--iso9283' not in str(report.steps)
    region = {'whole': False, 'share': 0.1, 'limit_mm': 1.0}
    assert as_document(near, {})['region'] == region
    doubtful = replace(result, remarks=('the arm is a ur3, not a ur5e',))
    report = report_of(problem, doubtful)
    assert 'ur3' in report.verdict.text[1]
    assert (report.verdict.state, report.verdict.heading) == ('open', 'Accepted: check first')
    assert report.steps[0].startswith('First check what is named above')


@pytest.mark.parametrize(
    ('text', 'code'),
    [
        ('in the chain file, or --columns q3=-q3 (else', '--columns q3=-q3'),
        ('--quaternion wxyz.', '--quaternion wxyz'),
        ('set --largest-loss 0.25.', '--largest-loss 0.25'),
        ('the arm is a ur10e: --chain ur10e (the', '--chain ur10e'),
        ('--columns "q1=#1,x=#2": so', '--columns &quot;q1=#1,x=#2&quot;'),
        ('--force replaces files', '--force'),
        ('--new-base refits', '--new-base'),
        ('run calib_ros verify.', 'calib_ros verify'),
        ('calib_ros chain ROBOT --out FILE', 'calib_ros chain ROBOT'),
    ],
)
def test_options_are_code_with_their_values(text, code):
    assert f'<code>{code}</code>' in page.with_code(text)


def test_no_pose_is_called_judged_where_none_was_left_out():
    problem = Problem(UR, measured(count=5))
    result = identify(problem)
    assert result.validation is None
    poses = poses_of(result)
    assert set(poses.role) == {'fitted'}
    assert poses.judged.any()


def test_many_poses_are_shown_in_bins_and_cells(solved, monkeypatch):
    _, result = solved
    poses = poses_of(result)
    monkeypatch.setattr('calib_ros.report.explorer.SINGLE', 30)
    shown = explorer(result.chain, poses)
    good = ~poses.outlier
    assert sum(shown['cells']['count']) == good.sum()
    sums = np.square(shown['cells']['rms_after']) * shown['cells']['count']
    assert np.sqrt(sums.sum() / good.sum()) == pytest.approx(rms_of(poses.after[good]), rel=1e-3)
    assert shown['total'] == len(poses)
    errors = 1e3 * np.linalg.norm(poses.after, axis=1)
    largest = np.quantile(errors[poses.judged], 0.98)
    assert shown['largest']['after'] == pytest.approx(largest)
    few = poses.select(np.flatnonzero(good)[:: 1 + good.sum() // 30])
    values, errors = np.degrees(few.joints[:, 2]), 1e3 * np.linalg.norm(few.after, axis=1)
    bins = shown['bins']['joint2']['length']
    edges = np.linspace(values.min(), values.max(), BANDS + 1)
    assert bins['x'] == pytest.approx(0.5 * (edges[1:] + edges[:-1]), abs=1e-2)
    inside = np.digitize(values, edges[1:-1])
    for k, row in enumerate(zip(*bins['after'], strict=True)):
        own = np.sort(errors[inside == k])
        ranks = np.round((len(own) - 1) * np.array([0.05, 0.5, 0.95])).astype(int)
        assert row == pytest.approx(own[ranks], rel=1e-3) if len(own) else not any(row)


def test_half_a_million_poses_make_a_page_of_eight_megabytes(solved):
    _, result = solved
    count = 500_000
    rng = np.random.default_rng(0)
    one = poses_of(solved[1])
    many = one.select(rng.integers(0, len(one), count))
    many = replace(many, stamps_ns=np.arange(count), after=rng.normal(0, 1e-4, (count, 3)))
    shown = explorer(result.chain, many)
    assert len(shown['role']) <= 2 * WORST
    report = replace(report_of(*solved), explorer=shown)
    assert len(render(report).encode()) < 8e6
    most = one.select(rng.integers(0, len(one), SINGLE))
    report = replace(report, explorer=explorer(result.chain, most))
    assert len(render(report).encode()) < 8e6


def test_a_verification_has_its_verdict_first(solved):
    problem, result = solved
    sets = (problem.held_out,)
    found = verify(Calibration.of(result), sets, 1e-3)
    page = page_of(verification_page(result.chain, sets, found))
    order = ('PASS', 'not the corrected robot', 'Accuracy before')
    where = [page.text.index(words) for words in order]
    assert where == sorted(where)
    assert page.text.count('not the corrected robot') == 1
    assert 'Assumed device noise' not in page.text  # a tolerance is judged without
    assert f'{1e3 * found.upper:.3f} mm' in page.text
    assert len(page.data['explorer']['role']) == TEST
    sets = (problem.held_out.select(np.arange(TEST) // 2),)
    for sigma, noise in (
        (5e-5, '0.05 mm where no measurement states its own'),
        (None, 'that of the'),
    ):
        found = verify(Calibration.of(result), sets, sigma_position=sigma)
        page = page_of(verification_page(result.chain, sets, found))
        assert f'Measurements {TEST}  Different poses {TEST // 2}' in page.text
        assert f'Assumed device noise {noise}' in page.text


def packed(text):
    return np.frombuffer(base64.b64decode(text), '<f4')


def test_the_arrays_of_a_page_are_the_poses(solved):
    problem, result = solved
    poses = poses_of(result)
    arrays = page_of(report_of(problem, result)).data['explorer']['arrays']
    assert packed(arrays['after']).reshape(-1, 3) == pytest.approx(1e3 * poses.after, rel=1e-6)
    assert packed(arrays['joints']).reshape(-1, 6) == pytest.approx(poses.joints, rel=1e-6)
    true = TRUE.forward(poses.joints)[:, :3, 3]
    base = result.chain.frame('base').matrix
    there = poses.position @ base[:3, :3].T + base[:3, 3]
    assert np.linalg.norm(there - true, axis=1).max() < 2e-3


def test_poses_and_measurements_are_two_counts(solved):
    """A bag gives several measurements of each pose; what is empty is no fact."""
    counts = {'samples': TRAIN, 'poses': 3 * TRAIN, 'foreign_names': (), 'unused': {}}
    lines = markdown(report_of(*solved), counts).splitlines()
    assert [each for each in lines if each.startswith('- Poses')] == [f'- Poses: {TRAIN + TEST}']
    assert f'- poses fitted: {TRAIN}' in lines
    assert f'- measurements: {3 * TRAIN}' in lines
    poses = replace(poses_of(solved[1]), stamps_ns=10**18 * np.array([1, 8]))
    said = dict(identity_of(UR, Origin(), poses))['Measured, by the stamps']
    assert said.startswith('2001-09-09 01:46 to 2223-07-06 14:13 UTC (in the future')
    assert not any('foreign' in each or 'not used' in each for each in lines[-20:])


def test_held_out_poses_that_were_fitted_too_are_in_no_figure(solved):
    problem, result = solved
    validation = replace(result.validation, repeated=np.arange(TEST) < 3)
    poses = poses_of(replace(result, validation=validation))
    after = 1e3 * np.linalg.norm(poses.after[poses.judged], axis=1)
    assert validation.figures[1].rms_mm == pytest.approx(np.sqrt(np.mean(after**2)))
    assert validation.figures[1].count == len(after) < result.validation.figures[1].count
    assert 'one direction' not in page_of(report_of(problem, result)).text


def test_what_is_to_be_noted_comes_before_the_figures(solved):
    report = replace(report_of(*solved), remarks=('a pose was hit',))
    for text in (page_of(report).text, markdown(report, {})):
        assert text.index('What to do next') < text.index('a pose was hit')
        assert text.index('a pose was hit') < text.index('Accuracy before and after')


def test_remarks_of_a_plan_are_sentences():
    page = plan_report(UR, np.zeros((5, 6)), ['the tool is unknown'], Origin())
    assert page.remarks == ('The tool is unknown.',)
