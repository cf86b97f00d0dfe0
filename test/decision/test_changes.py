# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Effects of changes and their evidence. `test_recalibration.py` has the changes themselves."""

from collections import Counter

import numpy as np
import pytest
from fits import SCARA, UR10E

from calib_ros import load_chain
from calib_ros.decision import changes
from calib_ros.decision.changes import (
    SCALES,
    ChangeColumns,
    Explanation,
    Information,
    gauge_columns,
    mean_square_change,
    reasons_of,
    root_of,
)
from calib_ros.estimation.identifiability import structurally_independent
from calib_ros.estimation.levels import chance_of
from calib_ros.estimation.start import fit_to_arm
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter, parameters_of
from calib_ros.settings import LEVER


@pytest.mark.parametrize(('frames', 'owners'), [((), {'elbow'}), (('tool',), {'elbow', 'quill'})])
def test_frames_that_cannot_have_moved_take_what_they_can(frames, owners):
    """A tilted quill moves its tip as the elbow does, and as another tool would."""
    found = ChangeColumns(SCARA, [Parameter('elbow.theta')], frames)
    assert {owner for owner, _ in found.sets} == owners


@pytest.mark.parametrize(('arm', 'row'), [('ur10e', 0), ('franka_fr3', 1)])
def test_all_that_a_bent_link_moves_is_one_change(arm, row):
    """Of the joint whose row has the link: in the modified convention the one behind it."""
    chain = load_chain(arm)
    frames = [*parameters_of('base'), *parameters_of('tool')]
    every = structurally_independent(chain, [*frames, *chain.parameter_names[12:]])
    names = [name for name in every if name not in frames]
    q = chain.random_joints(50, np.random.default_rng(0))
    model, walked = ErrorModel(chain, [*frames, *names]), np.empty((len(q[0]) + 1, 4, 3, len(q)))
    rows, places = model.jacobian(q), chain.forward(q)[:, :3, 3].T
    chain.walk.frames(chain.effective(q.T), np.eye(4), walked)
    columns = ChangeColumns(chain, names)
    for k in range(1, len(chain.joints) - 2):
        axes, place = walked[k + 1, :3], walked[k + 1, 3]
        turned = [np.cross(axis, places - place, axis=0) for axis in axes]
        shifts, turns = np.concatenate([axes, 0.0 * axes], 1), np.concatenate([turned, axes], 1)
        moved = np.concatenate([shifts, turns]).T.reshape(-1, 6)
        owner = chain.joint_names[k + row]
        link = max((own for joint, own in columns.sets if joint == owner), key=len)
        known = np.concatenate([rows[..., :12], rows[..., 12:] @ columns.of(link)], 2)
        known = known.reshape(len(moved), -1)
        np.testing.assert_allclose(
            known @ np.linalg.lstsq(known, moved, rcond=None)[0], moved, atol=1e-9
        )


def test_another_height_of_the_target_shows_as_one_of_the_device():
    names = [Parameter('elbow.theta'), Parameter('base.z')]
    assert gauge_columns(SCARA, names, [Parameter('tool.z')])[0] == 0.0
    assert abs(gauge_columns(SCARA, names, [Parameter('tool.z')])[1]) == pytest.approx(1.0)
    assert gauge_columns(SCARA, names, [Parameter('tool.x')]).shape == (2, 0)
    assert gauge_columns(SCARA, names, names[1:]).T.tolist() == [[0.0, 1.0]]


@pytest.mark.parametrize(
    ('names', 'free', 'lever'),
    [
        (['base.rx'], False, 0.0),
        (['base.rx', 'tool.rx'], False, LEVER),
        (['base.rx'], True, LEVER),
    ],
)
def test_turns_count_where_those_of_the_target_are_known(names, free, lever, monkeypatch):
    told = []
    follow = changes.best_imitation
    monkeypatch.setattr(
        changes, 'best_imitation', lambda *x, **y: told.append(x[4]) or follow(*x, **y)
    )
    changes.gauge_map(SCARA, [*map(Parameter, names)], [Parameter('arm.theta')], free)
    assert told == [lever]


def test_play_shows_in_no_other_parameter():
    names = [Parameter(joint.name, 'theta') for joint in UR10E.joints]
    play = Parameter('elbow_joint', 'backlash')
    taken, left = changes.gauge_map(UR10E.with_effects([play]), names, [play], True)
    assert np.abs(taken).max() < 0.2  # equally often either way
    assert left == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ('kind', 'size', 'times'),
    [
        ('theta', 1.0, 1.0),
        ('theta', 5.0, 10.0),
        ('theta', 1e3, 100.0),
        ('alpha', 5.0, 10.0),
        ('alpha', 1e3, 10.0),  # no belt slips there
        ('a', 5.0, 10.0),
    ],
)
def test_a_change_is_as_large_as_its_evidence_tells(kind, size, times):
    """The evidence is that of one number, here known to a tenth of 1 mm or 2 mrad."""
    name, known = Parameter('elbow', kind), 10.0 / (1e-3 if kind == 'a' else 2e-3)
    found = np.array([[known**2]]), np.array([10.0 * known * size])
    evidence, told = ChangeColumns(SCARA, [name]).evidence(Information((name,), *found), [name])
    assert told == times
    spread = 1.0 + 100.0 * times**2
    gain = 100.0**2 * size**2 * times**2 / spread
    seldom = np.log10(times) ** 2
    assert evidence == pytest.approx(0.5 * (gain - np.log(spread) - seldom))


@pytest.mark.parametrize(
    ('owner', 'names', 'told'),
    [
        ('device', [SCALES[0]], 'the scale of the device by +100 ± 20 ppm (95 %)'),
        ('elbow', [Parameter('elbow.theta')], 'elbow.theta by +0.100 ± 0.020 mrad (95 %)'),
        ('elbow', [Parameter('elbow.a')], 'elbow.a by +0.100 ± 0.020 mm (95 %)'),
        ('elbow', [Parameter('elbow.a'), Parameter('elbow.d')], 'elbow (a, d)'),
        ('load', [Parameter('elbow.gravity_quill')], 'the load of the arm'),
    ],
)
def test_a_change_is_told_with_its_limits(owner, names, told):
    sizes = np.full(len(names), 1e-4), np.full(len(names), 0.2e-4 / 1.959964)
    assert Explanation(owner, tuple(names), 9.0, 0.0, 1.0, *sizes).in_words() == told


THREE = tuple(UR10E.joints[k].driven for k in (1, 2, 3))


def known(rng, change, sigma=1e-5, names=THREE):
    """Return information about changes, correlated, of about `sigma` [rad]."""
    root = rng.normal(size=(len(names), len(names))) + 2.0 * np.eye(len(names))
    matrix = root @ root.T / sigma**2
    return Information(tuple(names), matrix, matrix @ change)


def test_expected_changes_are_added_to_what_is_not_known(rng):
    information = known(rng, np.array([1e-3, -2e-3, 0.0]))
    spread = 1e-5 * rng.normal(size=(3, 2))
    found = information.marginalised(spread @ spread.T)
    alone = np.linalg.inv(information.matrix)
    np.testing.assert_allclose(np.linalg.inv(found.matrix), alone + spread @ spread.T, rtol=1e-6)
    np.testing.assert_allclose(found.vector, found.matrix @ [1e-3, -2e-3, 0.0], rtol=1e-6)
    mean, covariance = information.mean(root_of(spread @ spread.T))
    wanted = np.linalg.solve(spread.T @ information.matrix @ spread + np.eye(2), spread.T).T
    np.testing.assert_allclose(covariance, wanted @ spread.T, rtol=1e-5, atol=1e-18)
    np.testing.assert_allclose(mean, covariance @ information.vector, rtol=1e-6)


def test_an_explanation_gains_what_a_fit_along_its_columns_does(rng):
    information = known(rng, np.array([1e-3, -2e-3, 0.0]))
    columns = rng.normal(size=(3, 2))
    inner = columns.T @ information.matrix @ columns
    change = np.linalg.solve(inner, columns.T @ information.vector)
    found = information.explained(columns)
    assert found[0] == pytest.approx(change @ inner @ change)
    np.testing.assert_allclose(found[1], change)
    np.testing.assert_allclose(found[2], np.linalg.inv(inner))
    assert found[3] == 2
    twice = information.explained(columns[:, [0, 0]])
    assert twice[3] == 1
    assert twice[0] == pytest.approx(information.explained(columns[:, :1])[0])
    assert information.explained(np.zeros((3, 1)))[3] == 1  # of nothing


def test_of_parameters_with_one_effect_the_first_is_named_and_only_then():
    """Of any size and sign; 37 degrees away from it is another."""
    columns = ChangeColumns(UR10E, THREE)
    effects = ([1.0, 0.0, 0.0], [0.8, 0.6, 0.0], [-2.0, 0.0, 0.0])
    columns._columns = dict(zip(THREE, map(np.array, effects), strict=True))
    assert columns._distinct(THREE) == THREE[:2]


def test_the_scale_of_the_device_is_that_of_all_lengths():
    names = [*THREE, Parameter('elbow_joint.a'), Parameter('wrist_1_joint.d')]
    found = ChangeColumns(UR10E, names, scaled=True)
    assert found.sets[-1] == ('device', SCALES[:1])
    (grown,) = found.of(SCALES[:1]).T
    np.testing.assert_allclose(grown[3:], [UR10E.joints[2].a, UR10E.joints[3].d], rtol=1e-3)
    assert found.unscaled().sets == found.sets[:-1] == ChangeColumns(UR10E, names).sets
    assert not any(owner == 'device' for owner, _ in ChangeColumns(UR10E, THREE, scaled=True).sets)


@pytest.mark.parametrize('size', [1e-6, 2e-5, 3e-5])
def test_the_chance_of_an_explanation_is_that_of_all_that_are_tried(size, rng):
    information, columns = known(rng, np.array([0.0, size, 0.0])), ChangeColumns(UR10E, THREE)
    (best, *_) = reasons_of(information, columns, 50.0, most=1.0)
    gain, change, covariance, rank = information.explained(columns.of(best.names))
    assert best.chance == min(1.0, len(columns.sets) * chance_of(gain, rank, 50.0))
    assert (best.gain, best.change.tolist()) == (gain, change.tolist())
    assert best.sigma.tolist() == np.sqrt(np.diag(covariance)).tolist()


def test_a_change_far_beyond_any_usual_one_is_none(rng):
    """Of one SCARA of sixteen a load was named that bends it by a thousand times the usual."""
    information, columns = known(rng, np.array([0.0, 3.5e-5, 0.0])), ChangeColumns(UR10E, THREE)
    columns.sets = tuple(('elbow_joint', (name,)) for name in THREE)
    assert reasons_of(information, columns, 50.0, most=0.999)
    far = Information(THREE, 1e-12 * information.matrix, 1e-6 * information.vector)
    assert reasons_of(far, columns, 50.0, most=1.0)
    assert not reasons_of(far, columns, 50.0, most=0.999)


def test_what_is_outside_the_arm_is_tried_as_often_as_the_joint_that_is_tried_most(rng):
    names = [*THREE, Parameter('elbow_joint.a'), Parameter('wrist_1_joint.d')]
    information, columns = (
        known(rng, np.zeros(5), names=names),
        ChangeColumns(UR10E, names, scaled=True),
    )
    tried = Counter(owner for owner, _ in columns.sets)
    tried['device'] = max(tried.values())
    odds = [columns.evidence(information, each)[0] for _, each in columns.sets]
    odds = np.exp(odds) / [tried[owner] for owner, _ in columns.sets]
    found = reasons_of(information, columns, 50.0, most=1.0)
    wanted = np.sort(odds / odds.sum())[::-1][: len(found)]
    assert [each.share for each in found] == pytest.approx(wanted.tolist())
    assert 'device' in {each.owner for each in found}


def test_the_square_of_a_change_is_that_of_positions_in_the_best_frames():
    names = [Parameter('elbow_joint.a'), Parameter('elbow_joint.theta')]
    square, change = mean_square_change(UR10E, names), np.array([1e-4, 2e-4])
    other = UR10E.with_offsets(dict(zip(names, change, strict=True)))
    frames = [*parameters_of('base'), *parameters_of('tool')]
    q = UR10E.random_joints(1000, np.random.default_rng(0))
    far = fit_to_arm(UR10E, frames, other, q)[1]
    assert np.sqrt(change @ square @ change) == pytest.approx(far, rel=0.1)


def test_a_scale_is_told_in_ppm():
    ppm = np.array([2.5e-4])
    told = Explanation('device', SCALES[:1], 9.0, 0.0, 1.0, ppm, 0.1 * ppm)
    assert told.in_words() == 'the scale of the device by +250 ± 49 ppm (95 %)'


def test_explanations_as_plain_values():
    owner, names = 'elbow_joint', parameters_of('elbow_joint', ('a', 'd'))
    sizes = np.array([1e-3, -2e-3]), np.array([1e-4, 2e-4])
    assert changes.reasons_document([Explanation(owner, names, 9.0, 0.01, 0.7, *sizes)]) == [
        {
            'owner': 'elbow_joint',
            'parameters': ['elbow_joint.a', 'elbow_joint.d'],
            'change': [1e-3, -2e-3],
            'sigma': [1e-4, 2e-4],
            'chance': 0.01,
            'share': 0.7,
        }
    ]


def test_a_part_of_another_explanation_is_not_told():
    names = parameters_of('elbow_joint', ('a', 'd', 'b'))

    def of(*names):
        size = np.ones(len(names))
        return Explanation('elbow_joint', names, 9.0, 0.01, 0.7, 1e-3 * size, 1e-4 * size)

    both, more, one = of(*names[:2]), of(*names), of(names[0])
    told = changes.reason_in_words((more, both, one))
    assert told == f'changed: {more.in_words()}, indistinguishable from {one.in_words()}'
    assert changes.reason_in_words((both,)) == f'changed: {both.in_words()}'
    several = changes.changes_in_words(((one, more), (both,)))
    assert several == (
        f'changed: {one.in_words()}, indistinguishable from {more.in_words()}; changed: '
        f'{both.in_words()}'
    )
