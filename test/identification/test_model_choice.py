# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E, rms

from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.decision.comparison import GroupVerdict
from calib_ros.errors import InputError, UnknownNameError
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.identification import model_choice
from calib_ros.identification.identification import identify
from calib_ros.identification.linear_model import LinearModel
from calib_ros.identification.model_choice import identify_model
from calib_ros.kinematics import effects, se3
from calib_ros.kinematics.effects import group_of
from calib_ros.kinematics.parameter import Parameter
from calib_ros.settings import Settings

GEAR = ('shoulder_lift_joint.sin_17', 'shoulder_lift_joint.cos_17')
LOADED = replace(
    UR10E,
    joints=tuple(
        replace(joint, mass=5.0, com=(0.05, 0.02, 0.05), gear_ratio=50.0) for joint in UR10E.joints
    ),
)


def arm_with(group, rng, nominal=UR10E):
    """Return a true arm whose effects are all of one group, of 0.1 to 0.5 mrad."""
    names = {'': (), 'gear': GEAR}.get(group) or (effects.members(nominal, group) if group else ())
    size = {'ratio': 1e-4, 'compliance': 5e-6}.get(group, 2e-4)
    signs = np.ones(len(names)) if group == 'compliance' else rng.choice([-1.0, 1.0], len(names))
    values = size * signs * rng.uniform(0.5, 1.5, len(names))
    true = faulty(nominal, Cell(), rng)
    return true.with_effect_values(dict(zip(names, values.tolist(), strict=True)))


def observed(true, q, rng, approach=None, oriented=True):
    poses = true.forward(q, approach)
    turns = se3.exp_rotation(rng.normal(scale=NOISE[1], size=(len(q), 3)))
    positions = poses[:, :3, 3] + rng.normal(scale=NOISE[0], size=(len(q), 3))
    seen = Observations.from_arrays(q, positions, turns @ poses[:, :3, :3] if oriented else None)
    return replace(seen, approach=approach)


@pytest.fixture
def both(monkeypatch):
    """Return a function that gives the results of the geometric model and of the one chosen."""
    found = []

    def kept(*given, **more):
        found.append(identify(*given, **more))
        return found[-1]

    monkeypatch.setattr(model_choice, 'identify', kept)
    return lambda problem: (identify_model(problem, 'auto'), found[0])[::-1]


def chosen(result):
    return {group_of(name) for name, _ in result.chain.effects}


@pytest.mark.parametrize(('group', 'size'), [('eccentricity', 7e-4), ('gravity', 1e-2)])
def test_effects_larger_than_usual_are_not_taken_for_noise(unsearched, group, size):
    """The first fit holds them at their usual size; what it leaves is no noise, then or later."""
    rng = np.random.default_rng(0)
    names = effects.members(UR10E, group)
    values = dict(zip(names, rng.normal(scale=size, size=len(names)).tolist(), strict=True))
    true = faulty(UR10E, Cell(), rng).with_effect_values(values)
    q, unseen = UR10E.random_joints(60, rng), UR10E.random_joints(300, rng)
    positions = true.forward(q)[:, :3, 3] + rng.normal(scale=1e-5, size=(60, 3))
    problem = Problem(UR10E, Observations.from_arrays(q, positions), sigma_position=1e-5)
    result = identify(replace(problem, effects=(group,)), identify(problem))
    assert result.accepted
    assert 0.8 < result.noise.position < 1.2
    error = rms(result.chain, true, unseen)
    assert error < 2e-5
    expected = result.posterior.expected(unseen)[:, :3, :3]
    assert 0.5 < np.sqrt(np.trace(expected, axis1=1, axis2=2).mean()) / error < 1.5


@pytest.mark.parametrize(
    ('group', 'oriented'),
    [
        *(('ratio', True), ('coupling', False), ('eccentricity', True), ('gear', False)),
        *(('gravity', False), ('compliance', False), ('backlash', True)),
    ],
)
def test_auto_finds_what_is_there_and_predicts_better(unsearched, both, group, oriented):
    rng = np.random.default_rng(3)
    nominal = LOADED if group == 'compliance' else UR10E
    true = arm_with(group, rng, nominal)
    q, unseen = nominal.random_joints(100, rng), nominal.random_joints(500, rng)
    came, comes = (rng.choice([-1.0, 1.0], each.shape) for each in (q, unseen))
    problem = Problem(nominal, observed(true, q, rng, came, oriented), **SIGMAS)
    plain, auto = both(problem)
    # torques of masses and of unit weights are nearly the same: either explains the other
    found = chosen(auto)
    assert found & ({'gravity', 'compliance'} if group in ('gravity', 'compliance') else {group})
    assert rms(auto.chain, true, unseen, comes) < 0.6 * rms(plain.chain, true, unseen, comes)
    paying = [verdict for verdict in auto.verdicts if verdict.pays]
    assert paying
    assert all(verdict.rms_mm_after < verdict.rms_mm_before for verdict in paying)
    assert auto.accepted


def test_harmonics_that_are_small_each_are_found_together(both):
    """As drives of measured robots have: none alone shows, together they are most of the error."""
    rng = np.random.default_rng(2)
    true = arm_with('', rng)
    names = [n for j in UR10E.joint_names for k in range(3, 41) for n in effects.waves(j, k)]
    true = true.with_effect_values({name: 3e-5 * rng.normal() for name in names})
    seen = observed(true, UR10E.random_joints(250, rng), rng)
    problem = Problem(UR10E, seen, **SIGMAS)
    plain, auto = both(problem)
    assert [verdict.what for verdict in auto.verdicts if verdict.pays] == [
        'all harmonics up to 40 per turn'
    ]
    unseen = UR10E.random_joints(500, rng)
    assert auto.accepted
    assert rms(auto.chain, true, unseen) < 0.8 * rms(plain.chain, true, unseen)


def test_all_harmonics_leave_nothing_behind(rng):
    """A single one is judged after them as before."""
    problem = Problem(UR10E, observed(arm_with('gear', rng), UR10E.random_joints(60, rng), rng))
    model = LinearModel(problem, identify(problem))
    before = model.judge([], GEAR, '')
    assert not model.judge([], model.harmonics, 'all').pays
    assert model.judge([], GEAR, '') == before


def test_nothing_is_chosen_on_a_purely_geometric_arm():
    """Three arms times a dozen trials each, at a confidence of 99.9 %: none, by these seeds."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        true = arm_with('', rng)
        q = LOADED.random_joints(100, rng)
        seen = observed(true, q, rng, rng.choice([-1.0, 1.0], q.shape), bool(seed % 2))
        auto = identify_model(Problem(LOADED, seen, **SIGMAS), 'auto')
        assert auto.chain.effects == ()
        assert not any(verdict.pays for verdict in auto.verdicts)
    plain = identify(Problem(LOADED, seen, **SIGMAS))
    np.testing.assert_array_equal(auto.chain.table, plain.chain.table)


@pytest.mark.parametrize('kind', ['sessions', 'distances', 'priors', 'covariances'])
def test_auto_takes_all_that_is_measured_and_known(kind, rng, both):
    """Priors make redundant parameters fitted ones: their columns are not independent."""
    true = arm_with('eccentricity', rng)
    count = 400 if kind == 'distances' else 120
    seen = observed(true, UR10E.random_joints(count, rng), rng)
    other = observed(replace(true, base=random_frame(rng, 1.0)), seen.joints, rng)
    far, own = np.linalg.norm(seen.positions, axis=1), np.diag(np.repeat(NOISE, 3) ** 2)
    given, options = {
        'sessions': (seen, {'more': (replace(other, base='base_B'),)}),
        'distances': (replace(seen, distances=far), {}),
        'priors': (seen, {'priors': {'*_joint.[ad]': 1e-3, '*_joint.theta': 2e-3}}),
        'covariances': (replace(seen, covariance=np.tile(own, (count, 1, 1))), {}),
    }[kind]
    problem = Problem(UR10E, given, **options, **SIGMAS)
    plain, auto = both(problem)
    assert 'eccentricity' in chosen(auto)
    unseen = UR10E.random_joints(300, rng)
    if kind == 'distances':
        length = np.linalg.norm(true.forward(unseen)[:, :3, 3], axis=1)
        before, after = (
            np.std(np.linalg.norm(each.chain.forward(unseen)[:, :3, 3], axis=1) - length)
            for each in (plain, auto)
        )
    else:
        before, after = (rms(each.chain, true, unseen) for each in (plain, auto))
    assert after < 0.6 * before


def test_a_model_is_named_in_the_settings(rng):
    true = arm_with('eccentricity', rng)
    true = true.with_effect_values(dict.fromkeys(effects.members(UR10E, 'ratio'), 1e-4))
    seen = observed(true, UR10E.random_joints(120, rng), rng)
    unseen = UR10E.random_joints(300, rng)
    errors = {}
    for model in ('geometric', 'ratio', 'ratio+eccentricity'):
        told = []
        result = identify_model(Problem(UR10E, seen), model, told.append)
        assert told == [f'model {model}', 1 / 2, 2 / 3]
        assert chosen(result) == (set() if model == 'geometric' else set(model.split('+')))
        assert result.verdicts == ()
        errors[model] = rms(result.chain, true, unseen)
    assert errors['ratio+eccentricity'] < 0.5 * errors['ratio']
    assert errors['ratio'] < errors['geometric']
    with pytest.raises(UnknownNameError, match='unknown model "foo"'):
        identify_model(Problem(UR10E, seen), 'foo')
    with pytest.raises(UnknownNameError, match='ratio') as caught:
        Problem(UR10E, seen, **Settings(model='ratio+excentricity').for_problem())
    assert caught.value.name == 'excentricity'


@pytest.mark.filterwarnings('error')
def test_no_poses_are_refused_in_words(rng):
    """A choice of models says the same of nothing to fit as one model does, without a warning."""
    nothing = measure(UR10E, UR10E.random_joints(1, rng), rng, *NOISE).select(np.zeros(1, bool))
    with pytest.raises(InputError, match='no pairs to fit'):
        identify_model(Problem(UR10E, nothing, **SIGMAS), 'auto')


def test_few_poses_leave_the_geometric_result(rng):
    """Fewer equations than effects: auto chooses little or nothing, and does not fail."""
    true = arm_with('', rng)
    seen = measure(true, UR10E.random_joints(12, rng), rng, *NOISE)
    auto = identify_model(Problem(UR10E, seen, **SIGMAS), 'auto')
    assert auto.chain.effects == ()


EVERY = 'all harmonics up to 40 per turn'


class Told:
    """A linear model that judges as it is told: by group or harmonic, whether it pays and how.

    Those of `hidden` pay only beside each other.
    """

    harmonics = ('a.sin_3', 'a.cos_3', 'a.sin_4', 'a.cos_4', 'a.sin_5', 'a.cos_5')

    def __init__(self, found=(), everything=False, gains=None, hidden=()):
        self._found, self._all, self._gains, self.tried = [*found], everything, gains or {}, []
        self._hidden, self.noise = {*hidden}, 1.0

    def useful(self, groups):
        names = {
            'ratio': ['a.ratio'],
            'gravity': ['a.gravity_a', 'a.gravity_b'],
            'coupling': ['x'],
        }
        return {group: names.get(group, []) for group in groups}

    def judge(self, chosen, names, what):
        what = 'all' if what == EVERY else what
        self.tried.append((tuple(chosen), what))
        if names == self.harmonics:
            return GroupVerdict(what, 1.0, 0.5, self._all)
        gain = self._gains.get(what, 0.0)
        if self._hidden and self._hidden <= {*chosen, *names} and self._hidden & {*names}:
            gain = 0.75
        return GroupVerdict(what, 1.0, 1.0 - gain, gain > 0.0)

    def shrink_noise(self, verdict):
        self.noise *= verdict.rms_mm_after

    def strongest_harmonic(self, chosen, progress):
        pair, several = self._found.pop(0) if self._found else ((), False)
        return tuple(Parameter(f'a.{wave}_{pair}') for wave in ('sin', 'cos')) if pair else (), (
            several
        )


WAVES = {f'a, {k} per turn': 1.0 for k in '345'}


@pytest.mark.parametrize(
    ('found', 'everything', 'gains', 'tried', 'chosen'),
    [
        ([], False, {}, '', ''),
        ([('3', False), ('4', False)], False, {'a, 3 per turn': 1.0}, '34', '3'),
        ([('3', False), ('4', False), ('5', False)], False, WAVES, '345', '345'),
        ([('3', True)], True, {}, '3*', '345'),
        ([('3', True)], False, {}, '3*', ''),
        ([('', True)], True, {}, '*', '345'),
        ([('', False)], True, {}, '', ''),
        ([('3', True), ('4', True), ('5', True)], True, WAVES, '345*', '345'),
        ([('3', True), ('4', True)], True, {'a, 3 per turn': 1.0}, '34*', '345'),
        # the third time all are tried though it pays, and if they do not, the search goes on
        ([('3', True), ('4', True), ('5', True), ('3', True)], False, WAVES, '345*3', '345'),
        ([('3', False)] * 4 + [('4', True)], True, {'a, 3 per turn': 1.0}, '33334', '3'),
    ],
)
def test_all_harmonics_are_tried_after_a_few_or_where_one_does_not_pay(
    found, everything, gains, tried, chosen
):
    model, verdicts, names = Told(found, everything, gains), {}, ['b.ratio']
    more = model_choice._choose_harmonics(model, names, verdicts, lambda _: None)
    assert more is bool(chosen)
    assert ''.join('*' if what == 'all' else what[3] for _, what in model.tried) == tried
    assert names == ['b.ratio', *(f'a.{wave}_{k}' for k in chosen for wave in ('sin', 'cos'))]
    told = ['all' if verdict == '*' else f'a, {verdict} per turn' for verdict in tried]
    assert [*verdicts] == [*dict.fromkeys(told)]
    assert model.noise == np.prod([v.rms_mm_after for v in verdicts.values() if v.pays])


@pytest.fixture
def choice(monkeypatch):
    """Return what is chosen with a linear model, and the verdicts."""

    def chosen(model):
        monkeypatch.setattr(model_choice, 'LinearModel', lambda *_: model)
        found = model_choice._choose_effects(SimpleNamespace(chain=UR10E), None, lambda _: None)
        return found[0], {verdict.what: verdict.pays for verdict in found[1]}

    return chosen


def test_groups_are_added_the_best_first(choice):
    """Each round tries the others again, and what is left of them together."""
    model = Told(gains={'ratio': 0.2, 'gravity': 0.5})
    names, pays = choice(model)
    assert names == ('a.gravity_a', 'a.gravity_b', 'a.ratio')
    assert pays == {'ratio': True, 'coupling': False, 'gravity': True}
    first, second = (), ('a.gravity_a', 'a.gravity_b')
    third = (*second, 'a.ratio')
    assert model.tried == [
        *((first, group) for group in ('ratio', 'coupling', 'gravity')),
        *((second, group) for group in ('ratio', 'coupling')),
        *((third, group) for group in ('coupling', 'all')),
    ]
    assert model.noise == 0.8 * 0.5


def test_groups_that_hide_each_other_are_chosen_together(choice):
    """Without what adds nothing to them."""
    model = Told(hidden=('a.ratio', 'x'))
    names, pays = choice(model)
    assert names == ('a.ratio', 'x')
    assert pays == {'ratio': True, 'coupling': True, 'gravity': False}
    assert model.noise == 0.25


def test_groups_are_tried_again_after_harmonics(choice):
    model = Told([('3', False)], gains={'a, 3 per turn': 0.5, 'gravity': 0.5})
    names, _ = choice(model)
    assert names == ('a.gravity_a', 'a.gravity_b', 'a.sin_3', 'a.cos_3')
    after = [what for chosen, what in model.tried if chosen == names]
    assert after == ['ratio', 'coupling', 'all']


@pytest.mark.parametrize('seed', [1, 145])
def test_effects_hidden_by_each_other_are_found(unsearched, seed):
    """Large gravity effects hide eccentricities, and few poses do not show these alone."""
    rng = np.random.default_rng(seed)
    names = [n for g in ('ratio', 'eccentricity', 'gravity') for n in effects.members(UR10E, g)]
    values = {n: 4.0 * effects.expected(n) * rng.normal() for n in names}
    true = faulty(UR10E, Cell(), rng).with_effect_values(values)
    q, unseen = UR10E.random_joints(40, rng), UR10E.random_joints(500, rng)
    auto = identify_model(Problem(UR10E, measure(true, q, rng, *NOISE), **SIGMAS), 'auto')
    assert chosen(auto) == {'ratio', 'eccentricity', 'gravity'}
    assert rms(auto.chain, true, unseen) < 1.5e-4


@dataclass(frozen=True)
class Result:
    accepted: bool = True
    converged: bool = True
    refusals: tuple = ()
    remarks: tuple = ()
    verdicts: tuple = ()
    richer: bool = False


@pytest.mark.parametrize(
    ('before', 'richer', 'reason'),
    [
        (Result(), Result(), None),
        (Result(), Result(converged=False, refusals=('no',)), 'its fit has not converged'),
        (Result(), Result(accepted=False, refusals=('no', 'never')), 'no; never'),
        (Result(accepted=False), Result(accepted=False, refusals=('no',)), None),
        (Result(accepted=False), Result(converged=False), 'its fit has not converged'),
    ],
)
def test_a_richer_model_is_used_unless_it_is_worse(before, richer, reason, monkeypatch, rng):
    """And its work is told in shares: by the entries of all columns that are made."""
    problem = Problem(UR10E, measure(UR10E, UR10E.random_joints(3, rng), rng, *NOISE))
    shares, verdicts = [], (GroupVerdict('ratio', 1.0, 0.5, True),)

    def identified(given, simpler=None, progress=None):
        assert (simpler is before) == bool(given.effects)
        progress(0.25)
        return replace(richer, richer=True) if simpler else before

    def chosen(given, result, progress):
        progress(0.25)
        return ('elbow_joint.ratio',), verdicts

    monkeypatch.setattr(model_choice, 'identify', identified)
    monkeypatch.setattr(model_choice, '_choose_effects', lambda *_: ((), verdicts))
    assert identify_model(problem, 'auto') == replace(before, verdicts=verdicts)
    monkeypatch.setattr(model_choice, '_choose_effects', chosen)
    found = identify_model(problem, 'auto', lambda told: shares.append(told))
    assert found.richer is (reason is None)
    assert found.verdicts == verdicts
    remark = f'the richer model is not used, because {reason}'
    assert found.remarks == ((remark,) if reason else ())
    fit, tried = len(problem.free) * 3, 2 * 38 * 6 * 3
    done = np.array([0.25 * fit, fit + 0.25 * tried, 1.25 * fit + tried]) / (2 * fit + tried)
    assert [share for share in shares if not isinstance(share, str)] == pytest.approx([*done])
