# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures, intervals and folds against what is known of them exactly."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import UR10E, measured_arm
from in_sockets import PLACES, cell
from scipy import stats

from calib_ros.decision import cross_validation, places, validation
from calib_ros.decision.acceptance import refusals
from calib_ros.decision.comparison import Comparison, compare, log_gain
from calib_ros.decision.cross_validation import fold_residuals
from calib_ros.decision.reasons import Rule
from calib_ros.decision.residuals import Residuals, residuals
from calib_ros.estimation.fitted import ParameterRow
from calib_ros.estimation.fitting import fit
from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.kinematics.parameter import Parameter

NOWHERE = np.full((4, 2), np.nan)


def errors_of(position, orientation=None, pixels=NOWHERE):
    turns = np.full((4, 3), np.nan) if orientation is None else orientation
    return Residuals(position, turns, np.arange(4), pixels)


def test_figures_are_of_lengths_in_millimetres_milliradians_and_pixels():
    position = 1e-3 * np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 1.0], [2.0, 2.0, 1.0], [9.0, 0, 0]])
    turns = np.full((4, 3), np.nan)
    turns[:2] = [[3e-3, 0.0, 4e-3], [0.0, 1e-3, 0.0]]
    pixels = NOWHERE.copy()
    pixels[2] = [3.0, -4.0]
    which = np.array([True, True, True, False])
    found = errors_of(position, turns, pixels).figures(which)
    lengths = np.array([5.0, 1.0, 3.0])
    assert (found.count, found.max_mm) == (3, pytest.approx(5.0))
    assert found.rms_mm == pytest.approx(np.sqrt(35.0 / 3.0))
    assert found.mean_mm == pytest.approx(3.0)
    assert found.mean_plus_3_sigma_mm == pytest.approx(3.0 + 3.0 * lengths.std(ddof=1))
    assert found.rms_mrad == pytest.approx(np.sqrt(13.0))
    assert found.rms_px == pytest.approx(5.0)
    bare = errors_of(position).figures(~which)
    assert (bare.rms_mm, bare.rms_mrad, bare.rms_px) == (pytest.approx(9.0), None, None)
    comparison = Comparison(errors_of(2.0 * position), errors_of(position), which)
    assert comparison.outliers == 1
    assert [each.count for each in comparison.figures] == [3, 3]
    assert [each.max_mm for each in comparison.figures_of_all] == pytest.approx([18.0, 9.0])
    assert comparison.deciding.tolist() == which.tolist()
    repeated = np.array([False, True, False, False])
    again = replace(comparison, repeated=repeated)
    assert again.deciding.tolist() == [True, False, True, False]
    assert (again.figures[0].count, again.figures_of_all[0].count) == (2, 3)
    pair = np.array([10.0, 6.0])
    assert again.figures[0].mean_plus_3_sigma_mm == pytest.approx(8.0 + 3.0 * pair.std(ddof=1))
    assert again.share_of_outliers == pytest.approx(1 / 3)
    assert replace(comparison, repeated=~which).outliers == 0


@pytest.mark.parametrize(
    ('before', 'after', 'rules'),
    [
        (3e-4, 0.4, {Rule.GAIN}),  # folds that diverge
        (0.3, 0.4, {Rule.GAIN, Rule.LARGEST_ERROR}),
        (0.4, 0.3, {Rule.LARGEST_ERROR, Rule.GAIN_WITH_OUTLIERS}),
    ],
)
def test_an_arm_that_fits_is_not_called_wrong_for_a_bad_correction(rng, before, after, rules):
    away = rng.normal(size=(40, 3))
    worse = np.where(np.arange(40)[:, np.newaxis] < 2, 100.0, 1.0)
    assert rules_of(before * away, after * worse * away, worse[:, 0] == 1.0) == rules


def rules_of(before, after, judged):
    return {each.rule for each in refused(before, after, judged)}


def refused(before, after, judged, largest_error=0.01, sets=(), **change):
    """Return the refusals by position errors (N, 3) [m] on pairs that were left out."""
    numbers, none = change.pop('numbers', np.arange(len(judged))), np.full_like(before, np.nan)
    parts = [Residuals(x, none, numbers, none[:, :2]) for x in (before, after)]
    problem = SimpleNamespace(largest_length=1.0, largest_angle=1.0, sets=sets, of_messages=False)
    problem.all_sets, problem.largest_error = sets, largest_error
    given = {'converged': True, 'parameters': (), 'chance': None, 'region': 1, 'surprise': 0.0}
    judging = Comparison(*parts, judged)
    known = {'step': None, 'not_excited': (), 'outliers': (), 'validation': judging}
    known['noise'] = SimpleNamespace(position=1.0)
    result = SimpleNamespace(**known | given | change)
    return [*refusals(problem, result, None, False, True)]


def test_a_pose_that_alone_hides_the_gain_is_named(rng):
    """More poses were asked for, although a single one, at the end of a joint, was wrong."""
    away = rng.normal(scale=1e-3, size=(40, 3))
    left, lines = 0.4 * away, 10**9 * np.arange(2, 42)
    left[27] = 8e-3, 0.0, 0.0
    seen = Observations.from_arrays(np.zeros((40, 6)), np.zeros((40, 3)))
    seen = replace(seen, stamps_ns=lines, distances=np.zeros(40))  # these tell no size of an arm
    sets = seen.select(np.s_[:20]), seen.select(np.s_[20:])
    told = refused(away, left, np.ones(40, bool), sets=sets)
    assert [each.rule for each in told] == [Rule.GAIN]
    assert told[0].endswith('; without line 29, 8.000 mm off, there is one: measure it again)')
    (told,) = refused(away, left, np.ones(40, bool), sets=[each.at(lines[:20]) for each in sets])
    assert '; without pose 8 of set 2, 8.000 mm off' in told  # of arrays
    left[26] = -0.9 * left[27]  # at the same station, where it hides the gain as well
    (told,) = refused(away, left, np.ones(40, bool), sets=sets, numbers=np.arange(40) // 2)
    assert 'without' not in told
    assert 'without' not in refused(away, away[::-1], np.ones(40, bool))[0]


@pytest.mark.parametrize(('before', 'rules'), [(2.9e-3, [Rule.REGION]), (3.1e-3, [])])
def test_a_correction_that_new_poses_contradict_is_half_as_good_again_or_refused(before, rules):
    away, change = np.full((40, 3), 2e-3), {'surprise': 3.0, 'contradiction': 'far off'}
    found = refused(0.5e3 * before * away, away, np.ones(40, dtype=bool), 1.0, **change)
    assert [each.rule for each in found] == rules
    assert all(each.startswith('far off, and the correction lowers') for each in found)


def test_a_gain_by_chance_is_told_with_what_chance_can_do(rng):
    before, after = 1e-3 * rng.normal(size=(2, 20, 3))
    gain, limit = log_gain(before, after, np.arange(20))
    assert 0.0 < gain < limit
    (told,) = refused(before, after, np.ones(20, dtype=bool))
    least = 1e3 * np.sqrt((before**2).sum(axis=1).mean()) * np.exp(-limit)
    assert told.endswith(f'; with 20 poses, chance alone can lower it to {least:.3f} mm)')


@pytest.mark.parametrize(('left', 'limit', 'said'), [(2e-5, 1e-5, '0.020'), (2.0, 0.01, '2000')])
def test_what_remains_is_told_as_in_the_table(left, limit, said):
    """It said: RMS 0.0 mm remains, more than 0.01 mm."""
    away = np.full((40, 3), left / np.sqrt(3.0))
    told = refused(2.0 * away, away, np.ones(40, dtype=bool), limit)
    assert any(f'RMS {said} mm remains on held-out poses, more than' in each for each in told)


@pytest.mark.parametrize(
    ('before', 'after', 'rules'),
    [
        (3e-3, 1e-3, [Rule.CONVERGENCE, Rule.COMMON_SENSE]),
        (3e-3, 3e-3, [Rule.CONVERGENCE, Rule.COMMON_SENSE, Rule.GAIN]),
        (0.016, 0.016, [Rule.CONVERGENCE, Rule.LARGEST_ERROR, Rule.GAIN]),
        (0.04, 0.02, [Rule.CONVERGENCE, Rule.COMMON_SENSE, Rule.LARGEST_ERROR]),
    ],
)
def test_parameters_of_a_fit_that_explains_nothing_are_not_told(rng, before, after, rules):
    away = rng.normal(size=(40, 3)) / np.sqrt(3.0)
    given = {'converged': False, 'parameters': [row('a', 1.5, 0.01)]}
    found = refused(before * away, after * away, np.ones(40, dtype=bool), **given)
    assert [each.rule for each in found] == rules
    far = [each for each in found if each.rule is Rule.COMMON_SENSE]
    assert all(each.endswith('kind: elbow_joint.a by 1500 mm') for each in far)


@pytest.mark.parametrize(
    ('offset', 'text'), [(-7.670, '-79.5°'), (1.385, '79.4°'), (6.283, '360°')]
)
def test_angles_far_off_are_told_without_whole_turns(rng, offset, text):
    """A zero left out of a DH table was told as -7670 mrad."""
    away = rng.normal(size=(40, 3))
    given = {'parameters': [row('theta', offset, 0.01)]}
    found = refused(3e-3 * away, 1e-3 * away, np.ones(40, dtype=bool), **given)
    assert str(found[0]).endswith(f'elbow_joint.theta by {text}')


@pytest.mark.parametrize('size', [2e-3, 5e-3, 5e-2])
def test_outliers_that_the_correction_causes_are_no_gross_errors(rng, size):
    judged = np.arange(40) >= 10
    for _ in range(20):
        change = 1e-3 * rng.normal(size=(40, 3))
        after = 1e-4 * rng.normal(size=(40, 3))
        gross = rng.normal(size=(10, 3))
        after[:10] += size * gross / np.linalg.norm(gross, axis=1, keepdims=True)
        assert rules_of(after + change, after, judged) == set()
        after[:10] = -3.0 * change[:10]  # two thirds as large before
        assert rules_of(after + change, after, judged) == {Rule.GAIN_WITH_OUTLIERS}


def test_gross_errors_that_grow_a_little_are_not_caused(rng):
    """Of twice the size of the correction, and by chance rather against it."""
    change = np.full((40, 3), 2e-4)
    after = 1e-4 * rng.normal(size=(40, 3))
    change[:10], after[:10] = 1e-3, [2e-3, -2e-3, -1.8e-3]
    assert rules_of(after + change, after, np.arange(40) >= 10) == set()


@pytest.mark.parametrize(('grown', 'rules'), [(8e-3, set()), (1e-2, {Rule.GAIN_WITH_OUTLIERS})])
def test_a_pose_that_was_set_aside_may_not_lose_more_than_all_others_gain(grown, rules):
    """Its squares may grow as much by chance: 39 poses gain 0.1 mm each."""
    before, after = np.full((2, 40, 1), 1e-3) * [[[1.0]], [[0.9]]]
    before[7], after[7] = 5e-3, grown
    assert rules_of(before * [1.0, 0.0, 0.0], after * [1.0, 0.0, 0.0], np.arange(40) != 7) == rules


def row(name, offset, std, freedom=np.inf):
    return ParameterRow(Parameter(f'elbow_joint.{name}'), 1.0, offset, std, 'fitted', freedom)


def test_intervals_are_students_and_limits_are_those_of_their_kind():
    assert row('a', 0.0, 2.0).half_width() == pytest.approx(2.0 * stats.norm.ppf(0.975), rel=1e-6)
    few = row('a', 0.0, 2.0, 5.0)
    assert few.half_width() == pytest.approx(2.0 * stats.t.ppf(0.975, 5), rel=1e-9)
    assert few.half_width(0.5) == pytest.approx(2.0 * stats.t.ppf(0.75, 5), rel=1e-9)
    assert row('a', 0.0, None).half_width() is None
    for name, far in (('a', (True, False)), ('theta', (False, True)), ('ratio', (False, False))):
        limits = ((0.4, 0.6), (0.6, 0.4))
        assert tuple(row(name, -0.5, 0.01).beyond(*each) for each in limits) == far
    assert row('a', 0.5, 0.09).beyond(0.2, 1.0)
    assert not row('a', 0.5, 0.11).beyond(0.2, 1.0)  # three deviations reach it
    assert not row('a', 0.5, None).beyond(0.2, 1.0)


def test_a_gain_is_that_of_configurations_and_chance_by_students_t():
    """Pairs of one configuration count as one; what was not measured does not count."""
    rng = np.random.default_rng(0)
    before, after = rng.normal(size=(2, 9, 3)) * [[[2.0]], [[1.0]]]
    numbers = np.array([3, 3, 0, 0, 0, 5, 6, 7, 7])
    before[8, 1] = np.nan
    means = np.array(
        [
            [(each[[k]] ** 2).sum() / len(k) for each in (before, after)]
            for k in ([2, 3, 4], [0, 1], [5], [6], [7])
        ]
    )
    gain, limit = log_gain(before, after, numbers, 0.9)
    total = means.mean(axis=0)
    assert gain == pytest.approx(0.5 * np.log(total[0] / total[1]))
    deviation = (means[:, 1] / total[1] - means[:, 0] / total[0]).std(ddof=1)
    expected = 0.5 * stats.t.ppf(0.9, 4) * deviation / np.sqrt(5.0)
    assert limit == pytest.approx(expected)
    assert log_gain(before, after, numbers)[1] == pytest.approx(
        expected * stats.t.ppf(0.95, 4) / stats.t.ppf(0.9, 4)
    )
    assert log_gain(before[:2], after[:2], numbers[:2]) == (0.0, np.inf)
    assert log_gain(before[1:3], after[1:3], numbers[1:3])[1] < np.inf


def test_every_pair_is_judged_by_the_chains_of_its_fold():
    """In the order of the pairs, set by set, whatever that of the folds."""
    rng, _, seen = measured_arm(0, 11)
    sets = [seen.select(np.arange(7)), replace(seen.select(np.arange(7, 11)), base='base_B')]
    folds = [rng.permutation(np.arange(7) % 3), np.array([2, 0, 0, 2])]
    groups = [np.arange(7), np.arange(20, 24)]
    base = UR10E.with_frame('base_B', UR10E.frame('base'))
    chains = [
        tuple(base.with_offsets({'elbow_joint.a': 1e-3 * (2 * k + side)}) for side in range(2))
        for k in range(3)
    ]
    before, after = fold_residuals(chains, sets, groups, folds)
    for side, found in enumerate((before, after)):
        expected = []
        for each, numbers in zip(sets, folds, strict=True):
            for k, fold in enumerate(numbers):
                expected.append(residuals(chains[fold][side], each.select(np.array([k]))))
        np.testing.assert_allclose(
            found.position, np.concatenate([each.position for each in expected]), atol=1e-15
        )
        np.testing.assert_allclose(
            found.orientation, np.concatenate([each.orientation for each in expected]), atol=1e-12
        )
        np.testing.assert_array_equal(found.configurations, np.concatenate(groups))


def test_a_distance_is_an_error_along_one_axis():
    *_, seen = measured_arm(0, 5)
    longer = np.linalg.norm(UR10E.forward(seen.joints)[:, :3, 3], axis=1) + 1e-3
    wire = replace(seen, distances=longer, oriented=np.zeros(5, dtype=bool))
    both = compare(UR10E, UR10E, [seen, wire])
    assert both.judged.all()
    np.testing.assert_array_equal(both.before.position, both.after.position)
    np.testing.assert_allclose(both.after.position[5:], np.tile([1e-3, 0, 0], (5, 1)), atol=1e-12)
    assert np.isnan(both.after.orientation[5:]).all()
    np.testing.assert_array_equal(both.after.configurations, np.tile(np.arange(5), 2))


@pytest.mark.parametrize(
    ('count', 'rows', 'names', 'known', 'wanted'),
    [
        (40, 240, 30, 0, 5),  # as many as asked for
        (4, 24, 3, 0, 4),  # no more than configurations
        (10, 60, 40, 0, 5),  # 48 equations of four parts for 40, and eight to spare
        (10, 60, 41, 0, 0),
        (10, 60, 41, 1, 10),  # priors tell one: each configuration by itself
        (10, 60, 47, 1, 10),  # 54 of nine for 46, and eight
        (10, 60, 48, 1, 0),
        (1, 60, 2, 1, 0),
    ],
)
def test_folds_leave_enough_to_fit_and_some_to_spare(count, rows, names, known, wanted):
    """Parameters of effects have priors and count for nothing."""
    problem = SimpleNamespace(
        model=SimpleNamespace(effects=(('elbow_joint.ratio', 0.0),)),
        folds=5,
        given={f'p{k}': 0.5 for k in range(known)},
        common_sense=lambda name: 1.0,
    )
    every = [*(f'p{k}' for k in range(names)), 'elbow_joint.ratio']
    assert cross_validation._fold_count(problem, every, count, rows) == wanted


def test_held_out_pairs_at_fitted_configurations_are_repeated():
    *_, seen = measured_arm(0, 12)
    first, second = seen.select(np.arange(5)), seen.select(np.arange(5, 8))
    held_out = [seen.select(np.array([9, 3, 10])), seen.select(np.array([6, 11]))]
    problem = Problem(UR10E, first, more=(replace(second, base='base_B'),), held_out=held_out)
    assert validation._repeated(problem).tolist() == [False, True, False, True, False]
    assert not len(validation._repeated(replace(problem, held_out=None)))
    fitted = SimpleNamespace(problem=replace(problem, loss='none'), chain=problem.model)
    judged, text = validation.validate(fitted, problem.model)
    said = '3 held-out poses; not counted because they repeat fitted poses: 2'
    assert text == said
    assert judged.deciding.tolist() == [True, False, True, False, True]


def test_places_a_known_distance_apart_are_one():
    problem = SimpleNamespace(
        sets=[SimpleNamespace(base=base) for base in 'abcabde'],
        separations=[('a', 'c', 1.0), ('c', 'a', 1.0), ('e', 'd', 2.0), ('d', 'a', 1.0)],
    )
    assert places.places_of(problem) == [{'b'}, {'a', 'c', 'd', 'e'}]


def test_known_distances_count_in_the_places_that_are_fitted(monkeypatch):
    problem = cell(0, noise=1e-4)[1]
    fitted, systems = fit(problem), []
    monkeypatch.setattr(
        places, 'minimise', lambda *given: systems.append(given[2]) or minimise(*given)
    )
    validation.validate(fitted, fitted.chain)
    assert [len(each.separations) for each in systems] == [PLACES - 1, 1] * 2 * PLACES
    for each in systems:
        seen = {samples.observations.base for samples in each.sets}
        assert {base for *pair, _ in each.separations for base in pair} == seen
