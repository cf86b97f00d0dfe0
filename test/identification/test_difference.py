# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What is said to be different between two calibrations of one robot."""

import re
from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, SCARA, SIGMAS, UR10E as UR, arm, problem
from measured import bent
from robots import DATA, needs_data
from scipy.linalg import block_diag
from scipy.stats import chi2

from calib_ros import Calibration, Observations, Problem, difference, identify, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.decision.changes import (
    ChangeColumns,
    Explanation,
    Information,
    gauge_map,
    reason_in_words,
    reasons_of,
)
from calib_ros.errors import InputError
from calib_ros.estimation.levels import SEVERAL
from calib_ros.identification.age import drift_of
from calib_ros.identification.difference import Difference, _chance, _change
from calib_ros.kinematics.parameter import Parameter, parameters_of

UR10 = DATA / 'ur10_ipa_leica'


def calibrated(true, seed, still=None, **more):
    rng = np.random.default_rng(seed)
    q = UR.random_joints(50, rng)
    if still is not None:
        q[:, still] = 1.0
    seen = measure(true, q, rng, *NOISE)
    return Calibration.of(identify(Problem(UR, seen, **SIGMAS, **more)))


@pytest.fixture(scope='module')
def nights():
    """Return an arm, and its calibration."""
    true = faulty(UR, Cell(), np.random.default_rng(3))
    return true, calibrated(true, 0)


def test_the_usual_drift_of_a_year_is_no_change_and_hides_no_bump(nights):
    true, first = nights
    first = replace(first, record={**first.record, 'measured': '2025-01-01T00:00:00+00:00'})
    names = [Parameter(n) for n in first.names if not UR.owns_frame(n)]
    size = np.sqrt(drift_of(names))
    for seed in range(3):
        drift = size * np.random.default_rng(seed).normal(size=len(names))
        later = true.with_offsets(dict(zip(names, drift, strict=True)))
        told = []
        for now in (later, later.with_offsets({'elbow_joint.theta': 5e-4})):
            second = calibrated(now, seed)
            record = {**second.record, 'measured': '2026-01-01T00:00:00+00:00'}
            told.append(difference(first, replace(second, record=record)))
        assert told[0].same
        assert [each[0].owner for each in told[1].changed] == ['elbow_joint']


def elsewhere(true):
    """Return the arm before a device that stands elsewhere, with another target."""
    rng = np.random.default_rng(8)
    return replace(true, base=random_frame(rng, 2.0), tool=random_frame(rng, 0.2))


def test_an_arm_that_has_not_changed_is_the_same_wherever_the_device_stands(nights):
    true, first = nights
    for there, seed in ((true, 1), (elsewhere(true), 2)):
        found = difference(first, calibrated(there, seed))
        assert found.same
        assert not found.changed
        assert found.chance > 0.01
        assert 0.5 < np.sqrt(np.mean((found.change / found.sigma) ** 2)) < 1.5
        assert found.limit < 1e-4
        assert found.left < 1e-7
        assert found.in_words().startswith('unchanged within 0.0')


def test_another_night_may_have_more_devices_and_targets(nights):
    true, first = nights
    second = calibrated(true, 1)
    chain = second.chain.with_frame('tool_2', second.chain.tool)
    names = (*second.names, *parameters_of('tool_2'))
    covariance = block_diag(second.covariance, 1e-8 * np.eye(6))
    more = replace(second, chain=chain, names=names, covariance=covariance)
    for pair in ((first, more), (more, first)):
        found = difference(*pair)
        assert found.same
        assert not any(name.owner.startswith('tool') for name in found.names)


@pytest.mark.parametrize('seed', [1, 2])
def test_what_was_held_nominal_is_no_change(nights, seed):
    """The elbow stood still, and its parameters are in others that were fitted."""
    true, first = nights
    fixed = ['elbow_joint.*', 'shoulder_lift_joint.*']
    found = difference(calibrated(true, seed, still=2, fixed=fixed), first)
    assert found.same
    assert found.rms > 2e-4
    slipped = true.with_offsets({'wrist_1_joint.theta': 0.02})
    assert not difference(calibrated(slipped, seed, still=2, fixed=fixed), first).same


@pytest.mark.parametrize(('name', 'seed'), [('ur10', 0), ('staubli_tx90l', 2)])
def test_a_device_that_bends_space_elsewhere_is_no_change_of_the_arm(name, seed):
    """Off by 0.1 mm, its sigma, and otherwise the second time."""
    rng = np.random.default_rng(seed)
    arm, found = load_chain(name), []
    true = faulty(arm, Cell(), rng)
    for _ in range(2):
        q = arm.random_joints(150, rng)
        places = bent(true.forward(q)[:, :3, 3], 1e-4, rng)
        places = places + rng.normal(scale=2e-5, size=places.shape)
        problem = Problem(arm, Observations.from_arrays(q, places), sigma_position=1e-4)
        found.append(Calibration.of(identify(problem)))
    assert 'measure the same poses from the same place' in difference(*found).in_words()


def test_a_joint_that_was_bumped_is_named(nights):
    true, first = nights
    bumped = elsewhere(true).with_offsets({'elbow_joint.theta': 3e-4})
    second = calibrated(bumped, 1)
    found = difference(first, second)
    assert not found.same
    ((reason, *others),) = found.changed
    assert reason.owner == 'elbow_joint'
    assert not others
    assert reason.change[0] == pytest.approx(3e-4, abs=4.0 * reason.sigma[0])
    assert found.unexplained > 0.01
    few = replace(first, freedom=5.0)  # of either night
    assert difference(few, second).chance == difference(first, replace(second, freedom=5.0)).chance
    words = found.in_words()
    assert words in found._repr_html_()
    assert 'elbow_joint.theta by +0.' in words
    assert 'nothing else: was it bumped?' in words
    names, (size, *_) = zip(*found.rows(), strict=True)  # the largest in sigmas
    order = np.argsort(-np.abs(found.change / found.sigma))[:6]
    assert names == tuple(found.names[k] for k in order)
    assert names[0] == 'elbow_joint.theta'
    assert re.fullmatch(r'\+0\.\d{3} ± 0\.0\d\d mrad \(95 %\)', size)
    told = found.document()
    sizes = [1e3 * each for each in (found.rms, found.limit, found.left)]
    assert [told[f'{each}_mm'] for each in ('rms', 'limit', 'left')] == sizes
    assert told['parameters']['elbow_joint.theta']['change'] == pytest.approx(3e-4, abs=1e-4)
    back = difference(calibrated(bumped, 1), first)
    assert back.changed[0][0].change[0] == pytest.approx(-reason.change[0], abs=5e-5)


@pytest.mark.parametrize('scale', [1.5e-4, -3e-4])
def test_a_warmer_arm_is_told_and_hides_no_bump(nights, scale):
    """The bump was told as one of the whole joint, its warmth as one of other joints."""
    true, first = nights
    lengths = [n for n in UR.parameter_names if Parameter(n).is_length and not UR.owns_frame(n)]
    warm = true.with_offsets({name: scale * UR.value(name) for name in lengths})
    found = difference(first, calibrated(warm, 1))
    assert [reasons[0].owner for reasons in found.changed] == ['device']
    assert found.changed[0][0].change == pytest.approx([scale], abs=4e-5)
    assert 'nothing else: is the arm warmer, or the device another?' in found.in_words()
    bumped = difference(first, calibrated(warm.with_offsets({'elbow_joint.theta': 5e-4}), 1))
    told = [[e.names for e in reasons] for reasons in bumped.changed]
    assert sorted(told) == [[('device.ratio',)], [('elbow_joint.theta',)]]
    assert 'was it bumped?' in bumped.in_words()


@pytest.mark.parametrize(
    ('zeros', 'mastered'),
    [('a.theta b.theta c.theta', True), ('axis.d a.theta b.theta', True), ('a.d b.a', False)],
)
def test_three_zeros_were_mastered_again_that_of_a_linear_joint_too(zeros, mastered):
    names, size = map(Parameter, zeros.split()), np.ones(1)
    changed = tuple((Explanation(n.owner, (n,), 9.0, 0.0, 1.0, size, size),) for n in names)
    found = Difference((), size[:0], size[:0], 0.0, 0.0, 1e-3, 2e-3, 1e-3, changed, 1.0)
    assert ('was it mastered again, or bumped?' in found.in_words()) == mastered


@pytest.mark.parametrize('fixed', [(), UR.parameter_names[12:]])
def test_a_change_of_a_pure_number_has_a_unit_that_exists(fixed):
    """It was "m1". Alone it is no change of a joint, a frame or the load."""
    arm, pair = UR.with_effects([ratio := 'elbow_joint.ratio']), []
    for seed, size in enumerate((1e-3, 2e-3)):
        rng = np.random.default_rng(seed)
        true = arm.with_effect_values({ratio: size})
        seen = measure(true, UR.random_joints(60, rng), rng, *NOISE)
        pair.append(Calibration.of(identify(Problem(arm, seen, fixed=fixed))))
    (name, size), *_ = difference(*pair).rows()
    assert name == ratio
    assert re.fullmatch(r'\+[01]\.\d{3} ± 0\.\d{3} ‰ \(95 %\)', size)


def test_gauges_are_taken_out(nights):
    """What one calls d of the elbow, the other calls d of the wrist: predictions agree.

    Axes that are parallel to a milliradian only: 2 mm of one are 2 um off 2 mm of the other.
    """
    _, first = nights
    for offsets, most in (
        ({'wrist_1_joint.d': -2e-3, 'elbow_joint.d': 2e-3}, 1e-5),
        ({'shoulder_pan_joint.theta': 1e-2, 'wrist_3_joint.d': 1e-3}, 1e-8),
    ):
        found = difference(first, replace(first, chain=first.chain.with_offsets(offsets)))
        assert found.same
        assert found.rms < most


def test_an_arm_with_other_links_is_another_one(nights):
    _, first = nights
    rng = np.random.default_rng(5)
    other = replace(faulty(UR, Cell(), rng), base=first.chain.base)
    found = difference(first, calibrated(other, 1))
    assert not found.same
    assert found.unexplained < 1e-6
    assert 'many parameters differ' in found.in_words()


def test_small_errors_of_another_robot_are_no_three_bumps():
    """So it was told of 3 of 26 pairs of robots with errors of 0.1 mm and 0.2 mrad."""
    pair = arm(0, errors=0.2), arm(10, errors=0.2)
    first, second = (
        Calibration.of(identify(problem(true, count, number, oriented=False)))
        for true, count, number in zip(pair, (50, 30), (0, 1), strict=True)
    )
    found = difference(first, second)
    assert len(found.changed) == SEVERAL
    assert 'many parameters differ' in found.in_words()


def test_what_a_parameter_shares_with_others_is_a_share():
    """Axes of shoulder and elbow are parallel: the one's d is as good as the other's."""
    names = [Parameter('elbow_joint.d'), Parameter('elbow_joint.theta')]
    others = [Parameter('shoulder_lift_joint.d'), *names, Parameter('wrist_1_joint.a')]
    taken, left = gauge_map(UR, names, others, free=False)
    for shares in (taken[:, :3], _change(UR, names, others[:3])):
        np.testing.assert_allclose(shares, [[1, 1, 0], [0, 0, 1]], atol=1e-9)
    np.testing.assert_allclose(left[:3], 0.0, atol=1e-9)
    assert 0.1 < left[3] < 1.0


def test_what_is_left_has_the_fewer_directions_the_more_is_explained():
    names = tuple(map(Parameter, ('elbow_joint.theta', 'elbow_joint.a', 'elbow_joint.alpha')))
    information = Information(names, np.eye(3), np.array([1.0, 2.0, 2.0]))
    found = [_chance(information, np.inf, explained) for explained in (0, 1, 2, 3)]
    assert found == pytest.approx(chi2.sf(9.0, [3, 2, 1, 1]), rel=1e-4)


def test_reasons_of_one_effect_are_told_together():
    names = (Parameter('elbow_joint.theta'), Parameter('wrist_1_joint.theta'))
    matrix = np.full((2, 2), 1e10)
    information = Information(names, matrix, matrix @ (1e-3, 0.0))
    told = reason_in_words(reasons_of(information, ChangeColumns(UR, names), 100.0))
    alike = [f'{name} by +1.000 ± 0.020 mrad (95 %)' for name in names]
    assert told == f'changed: {", indistinguishable from ".join(alike)}'


def test_what_moves_nothing_takes_no_share(nights):
    """A weight at the end of the last link, on its axis, turns no joint but by rounding."""
    _, first = nights
    still = Parameter('wrist_3_joint.gravity_wrist_3_joint')
    chain = first.chain.with_effects([still])
    others = [Parameter('wrist_1_joint.theta'), Parameter('wrist_1_joint.beta')]
    taken, _ = gauge_map(chain, [*map(Parameter, first.names), still], others, free=False)
    np.testing.assert_allclose(taken[-1], 0.0, atol=1e-9)


def test_what_cannot_be_compared_is_refused(nights):
    _, first = nights
    with pytest.raises(InputError, match=r'calibration 2 has no .* again with this version$'):
        difference(first, replace(first, covariance=None))
    panda = load_chain('franka_panda')
    with pytest.raises(InputError, match='belong to different robots'):
        difference(first, replace(first, chain=panda, before=panda))
    for change in ({'type': 'prismatic'}, {'sign': -1}):
        other = replace(UR, joints=(replace(UR.joints[0], **change), *UR.joints[1:]))
        with pytest.raises(InputError, match='belong to different robots'):
            difference(first, replace(first, chain=other, before=other))


def test_the_command_ends_according_to_what_it_says(nights, run, tmp_path):
    (tmp_path / 'first.yaml').write_text(nights[1].dump())
    status, said, _ = run('compare', 'first.yaml', 'first.yaml')
    assert (status, said[:16]) == (0, 'unchanged within')


@needs_data
def test_two_nights_of_a_measured_robot_are_not_known_well_enough_to_differ():
    """Session A is a grid, B scattered configurations; neighbours share what the model lacks.

    The predictions differ by most of a millimetre over the joint range, and neither session knows
    them better: nothing is claimed.
    """
    from calib_ros.files.tables import read_table

    chain = load_chain(UR10 / 'chain.yaml')
    pair = []
    for session in ('A', 'B'):
        (fitted,) = read_table(UR10 / 'uniform.csv', 6, (session,)).fitted
        few = fitted.select(np.arange(0, len(fitted), max(1, len(fitted) // 300)))
        pair.append(Calibration.of(identify(Problem(chain, few))))
    found = difference(*pair)
    assert found.rms > 2e-4
    assert found.limit > found.rms
    assert not found.changed
    assert 'bumped' not in found.in_words()


def test_axes_that_are_all_nearly_parallel_are_the_same_on_another_night():
    """Their tool's length trades against the base's height; once corrected, hardly any longer."""
    true = faulty(SCARA, Cell(), np.random.default_rng(3))
    nights = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        seen = measure(true, SCARA.random_joints(60, rng), rng, *NOISE)
        nights.append(Calibration.of(identify(Problem(SCARA, seen))))
    found = difference(*nights)
    assert found.same
    assert found.limit < 1e-4
