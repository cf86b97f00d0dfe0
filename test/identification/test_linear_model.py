# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The linear model against fits that are written out fold by fold."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import UR10E, measured_arm

from calib_ros.decision.comparison import GroupVerdict, log_gain
from calib_ros.decision.drift import Shifts
from calib_ros.estimation.problem import Learned, Problem
from calib_ros.estimation.system import row_samples, stacked
from calib_ros.identification import linear_model
from calib_ros.identification.linear_model import LinearModel
from calib_ros.kinematics import effects
from calib_ros.progress import quiet

NAMES = (
    *(name for name in UR10E.parameter_names if UR10E.owns_frame(name)),
    *('elbow_joint.a', 'elbow_joint.theta', 'wrist_1_joint.theta', 'shoulder_lift_joint.theta'),
)
FIRST, SECOND = ('elbow_joint.sin_1', 'elbow_joint.cos_1'), ('wrist_1_joint.coupling_elbow_joint',)
OUTLIERS = (3, 30)
SIZES = {'angle': 1e-3, 'coupling': 5e-4, 'drive': 2e-4}
NOISE = 2.0


@pytest.fixture(params=['plain', 'sessions', 'thinned'])
def model(request, monkeypatch):
    """Return a problem, as it is with what its fit has told, and the linear model."""
    _, true, seen = measured_arm(0, 46)
    true = true.with_effect_values({'elbow_joint.sin_1': 5e-4})
    shift = true.forward(seen.joints)[:, :3, 3] - UR10E.forward(seen.joints)[:, :3, 3]
    seen = replace(seen, positions=seen.positions + 0.3 * shift)
    more = ()
    if request.param == 'sessions':
        points = replace(seen.select(np.r_[:6, 26:46]), base='base_B')
        more = (replace(points, oriented=np.zeros(26, dtype=bool)),)
        seen = seen.select(np.arange(26))
    if request.param == 'thinned':
        monkeypatch.setattr(linear_model, 'COMPARED', 20)
    problem = Problem(UR10E, seen, more=more)
    judged = np.ones(46 + 6 * bool(more), dtype=bool)
    judged[list(OUTLIERS)] = False
    geometric = SimpleNamespace(
        chain=problem.model,
        names=NAMES,
        posterior=SimpleNamespace(
            priors={'elbow_joint.a': 3e-5, 'elbow_joint.sin_1': 1.0}, sizes=SIZES
        ),
        noise=SimpleNamespace(size=NOISE),
        fitted=SimpleNamespace(judged=judged),
    )
    share = {'plain': 1, 'sessions': 1, 'thinned': 3}[request.param]
    parts = np.split(np.arange(len(judged)), np.cumsum([len(each) for each in problem.sets])[:-1])
    chosen = [[k for k in part if k not in OUTLIERS][::share] for part in parts]
    triples = zip(problem.sets, chosen, parts, strict=True)
    sets = [each.select(np.array(which) - part[0]) for each, which, part in triples]
    told = replace(problem, learned=Learned({'elbow_joint.a': 3e-5}, NOISE))
    return told, sets, LinearModel(problem, geometric)


def groups_of(sets):
    """Return the number (N,) of the configuration of every pair, and its fold in two dealings."""
    joints = np.concatenate([each.joints for each in sets]).round(6)
    _, first, number = np.unique(joints, axis=0, return_index=True, return_inverse=True)
    number = np.argsort(np.argsort(first))[number.ravel()]
    block, known = {}, set()
    for each in np.split(number, np.cumsum([len(s) for s in sets])[:-1]):
        new = [k for k in sorted(set(each.tolist())) if k not in known]
        block |= {k: i * 5 // len(new) for i, k in enumerate(new)}
        known |= set(new)
    return number, (number % 5, np.array([block[k] for k in number.tolist()]))


def left_out(told, sets, dealing, names, sizes, noise=NOISE):
    """Return position errors (N, 3) [m] of fits to the samples of the other folds."""
    system = told.system(sets)
    chain = told.model.with_effects([n for n in names if n not in NAMES])
    rows = system.rows_of(chain, names)
    whole, owner = stacked(rows), row_samples(rows)
    fold = groups_of(sets)[1][dealing][owner]
    prior = np.diag([noise / sizes[n] if n in sizes else 0.0 for n in names])
    left = np.zeros(len(whole))
    for k in range(5):
        used = np.vstack([whole[fold != k, :-1], prior])
        wanted = np.append(whole[fold != k, -1], np.zeros(len(names)))
        scale = np.maximum(np.linalg.norm(used, axis=0), 1e-12)
        step = np.linalg.lstsq(used / scale, wanted, rcond=None)[0] / scale
        left[fold == k] = (whole[:, -1] - whole[:, :-1] @ step)[fold == k]
    pieces = np.split(left, np.cumsum([each[-1].size for each in rows])[:-1])
    pairs = zip(pieces, sets, strict=True)
    return np.concatenate([1e-4 * p.reshape(-1, len(each)).T[:, :3] for p, each in pairs])


def test_what_is_left_out_is_predicted_by_fits_to_the_rest(model):
    """Effects have priors as large as usual, or as the data show."""
    told, sets, linear = model
    prior = {'elbow_joint.a': 3e-5}
    usual = dict.fromkeys(FIRST, 5e-4) | {SECOND[0]: 5e-4}  # of a drive: what couplings may be
    for dealing in (0, 1):
        for chosen in ((), FIRST, (*FIRST, *SECOND), (*SECOND, *FIRST)):
            sizes = prior | {name: usual[name] for name in chosen}
            expected = left_out(told, sets, dealing, [*NAMES, *chosen], sizes)
            found = linear._held_out_errors(dealing, chosen)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_what_is_left_with_chosen_effects_is_the_noise_from_then_on(model):
    """Priors of the arm and of effects are weighed against it."""
    told, sets, linear = model
    linear._held_out_errors(0, FIRST)
    linear.shrink_noise(GroupVerdict('', 1.0, 0.25, True))
    sizes = {'elbow_joint.a': 3e-5, **dict.fromkeys(FIRST, 5e-4)}
    expected = left_out(told, sets, 0, [*NAMES, *FIRST], sizes, NOISE / 4.0)
    np.testing.assert_allclose(linear._held_out_errors(0, FIRST), expected, rtol=0, atol=1e-9)


def test_verdicts_are_of_the_errors_left_out(model, monkeypatch):
    """By both dealings, and by time shifts at the end; the figures are those of the first."""
    _, sets, linear = model
    verdict = linear.judge(['wrist_2_joint.sin_1'], [*FIRST, 'wrist_2_joint.sin_1'], 'waves')
    before, after = (
        [linear._held_out_errors(k, ['wrist_2_joint.sin_1', *new]) for k in (0, 1)]
        for new in ((), FIRST)
    )
    for found, errors in ((verdict.rms_mm_before, before), (verdict.rms_mm_after, after)):
        assert found == pytest.approx(1e3 * np.sqrt((errors[0] ** 2).sum() / len(errors[0])))
    for sure, counts, chance in itertools.product((0.999, 0.8), (0.09, 0.005), (0.02, 0.005, 0.0)):
        monkeypatch.setattr(linear_model, 'SURE', sure)
        monkeypatch.setattr(linear_model, 'COUNTS', counts)
        monkeypatch.setattr(linear_model, 'chance', lambda _, chance=chance: chance)
        again = linear.judge(['wrist_2_joint.sin_1'], FIRST, 'waves')
        pairs = zip(before, after, strict=True)
        gains = [log_gain(*pair, groups_of(sets)[0], sure) for pair in pairs]
        pays = all(gain > max(limit, counts) for gain, limit in gains) and chance < 0.01
        assert (again.what, again.pays) == ('waves', pays)
    assert pays
    monkeypatch.setattr(linear, '_shifts', None)  # nor is anything shifted at sockets
    assert linear.judge([], FIRST, 'waves').pays
    linear._errors.clear()
    assert not linear.judge([], SECOND, 'coupling').pays
    assert {dealing for dealing, *_ in linear._errors} == {0}  # one dealing is enough to refuse


def test_effects_that_depend_on_others_are_not_useful(model):
    """A constant is an offset; gravity turns nothing about a vertical axis; once is enough."""
    linear = model[-1]
    still = 'shoulder_pan_joint.gravity_elbow_joint'
    groups = {
        'waves': [*FIRST, 'elbow_joint.cos_0', 'elbow_joint.sin_1'],
        'gravity': [still, 'elbow_joint.gravity_elbow_joint'],
        'again': [*SECOND, *FIRST],
        'nothing': [still],
    }
    assert linear.useful(groups) == {
        'waves': [*FIRST],
        'gravity': ['elbow_joint.gravity_elbow_joint'],
        'again': [*SECOND, *FIRST],
        'nothing': [],
    }


def test_every_revolute_joint_has_harmonics_from_the_third_to_the_fortieth(model):
    expected = [n for j in UR10E.joint_names for k in range(3, 41) for n in effects.waves(j, k)]
    assert model[-1].harmonics == expected


def test_residuals_moved_in_time_are_explained_as_by_columns_made_at_once(model):
    """Columns of all harmonics are made joint by joint, of those chosen as well."""
    told, sets, linear = model
    waves, steps = ['wrist_3_joint.sin_7', 'wrist_3_joint.cos_7'], []
    linear._columns_of(FIRST)
    groups = [waves, [*SECOND, 'elbow_joint.ratio']]
    linear._columns_of(groups[1])
    for chosen in ((), FIRST):
        names = [*NAMES, *chosen, *waves, *groups[1]]
        chain = told.model.with_effects([n for n in names if n not in NAMES])
        rows = told.system(sets).rows_of(chain, names)
        shifts = Shifts(told.system(sets), [each[-1] for each in rows])
        usual = {'elbow_joint.a': 3e-5, **dict.fromkeys((*FIRST, *SECOND), 5e-4)}
        usual |= dict.fromkeys((*waves, 'elbow_joint.ratio'), 5e-4)
        inverse = np.array([NOISE / usual[n] if n in usual else 0.0 for n in names])
        columns = shifts.columns([[each[:-1] for each in rows]])
        count = len(NAMES) + len(chosen)
        expected = shifts.shares(
            columns, inverse, range(count), [[count, count + 1], [count + 2, count + 3]]
        )
        found = linear._shares(chosen, groups, steps.append)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-9)
    stages = [step for step in steps if isinstance(step, str)]
    assert stages == [f'harmonics of {joint}' for joint in UR10E.joint_names]
    shares = [step for step in steps if not isinstance(step, str)]
    assert shares == pytest.approx([k / 7.0 for k in range(1, 7)])


@pytest.mark.parametrize('few', [True, False])
@pytest.mark.parametrize('often', [0, 1, 2])
def test_the_strongest_harmonic_must_not_be_explained_by_chance(few, often, model, monkeypatch):
    """Of the shifts one in a hundred may explain as much, of all harmonics one in twenty."""
    linear = model[-1]
    pairs = [pair for pair in linear._pairs if 'elbow_joint.sin_5' not in pair]
    monkeypatch.setattr(linear, '_equations', 456 if few else 457)
    shares = np.full((len(pairs), 151), 1e-4)
    shares[:, 0] = 2e-4
    shares[9, 0] = 0.5
    shares[3, 10 : 10 + often] = 0.6  # the strongest one of another shift

    def moved(chosen, groups, progress):
        assert chosen == ['elbow_joint.sin_5']
        assert groups == pairs
        return shares

    monkeypatch.setattr(linear, '_shares', moved)
    found, several = linear.strongest_harmonic(['elbow_joint.sin_5'], quiet)
    assert found == (pairs[9] if often < 2 else ())
    assert several is not few
    shares[:, 20:28] = 0.1
    assert linear.strongest_harmonic(['elbow_joint.sin_5'], quiet)[1] is False
    monkeypatch.setattr(linear, '_shifts', None)
    assert linear.strongest_harmonic([], quiet) == ((), False)
