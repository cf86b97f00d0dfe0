# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Changes between nights, on results drawn from the covariance of a real identification."""

import json
import re
from dataclasses import replace
from datetime import timedelta

import numpy as np
import plants
import pytest

from calib_ros.apply import simulation
from calib_ros.errors import InputError
from calib_ros.estimation.problem import Problem
from calib_ros.files.result_rows import result_row
from calib_ros.files.rows import Filing
from calib_ros.fleet.change import alarms_of
from calib_ros.fleet.watch import watch
from calib_ros.identification.age import drift_of
from calib_ros.identification.identification import identify
from calib_ros.kinematics.chain_file import chain_document, load_chain
from calib_ros.kinematics.parameter import Parameter

SIZES = {'m': 1e-4, 'rad': 2e-4}
BUMPS = ('elbow_joint.theta', 'wrist_1_joint.d', 'wrist_2_joint.alpha', 'shoulder_lift_joint.a')


def joint_of(change):
    """Return the joint that changed; empty if two or more did."""
    return change.changed[0][0].owner if len(change.changed) == 1 else ''


def joints_of(change):
    """Return the joints of which one changed or two did."""
    return {reason.owner for reasons in change.changed for reason in reasons}


@pytest.fixture(scope='module')
def first():
    return first_of('ur10e')


def first_of(chain, *effects):
    true, rng = plants.robot(0, chain)
    poses = simulation.measure(true, true.random_joints(60, rng), rng, *plants.SIGMAS)
    sigmas = dict(zip(('sigma_position', 'sigma_orientation'), plants.SIGMAS, strict=True))
    result = identify(Problem(load_chain(chain), poses, **sigmas, effects=effects))
    return result_row(result, Filing('A', plants.when(0), '', ''))


def nights(first, rng, count, bump=(99, ''), scatter=1.0):
    """Return rows that scatter as their covariances tell, or more, with a change."""
    root = scatter * np.linalg.cholesky(first.covariance)
    number, name = bump
    for k in range(count):
        offsets = first.offsets + root @ rng.normal(size=len(first.names))
        if k >= number:
            offsets = offsets + SIZES[Parameter(name).unit] * (np.array(first.names) == name)
        yield replace(first, time=first.time + timedelta(days=k), offsets=offsets)


@pytest.mark.parametrize('name', BUMPS)
def test_a_bump_is_found_within_two_nights_and_its_joint_named(first, rng, name):
    for number in (4, 9):
        (change,) = watch(list(nights(first, rng, 12, (number, name))), 100.0).changes
        assert joint_of(change) == name.partition('.')[0]
        best = change.changed[0][0]
        assert best.names == (name,)
        assert abs(best.change[0] - SIZES[best.names[0].unit]) < 4 * best.sigma[0]
        assert change.seen - first.time <= timedelta(days=number + 1)
        assert abs(change.time - first.time - timedelta(days=number)) <= timedelta(days=1)
        assert name in str(change)


def test_a_large_bump_of_one_joint_is_none_of_two(first, rng):
    """The rest may just seem to scatter more beside one than beside two."""
    for name in 3 * BUMPS:
        rows = list(nights(first, rng, 6, (4, name)))
        bump = 9.0 * SIZES[Parameter(name).unit] * (np.array(first.names) == name)
        rows[4:] = (replace(row, offsets=row.offsets + bump) for row in rows[4:])
        (change,) = watch(rows, 100.0).changes
        assert len(change.changed) == 1


def wobbling(first, rng, rows, stay):
    """Yield the nights of an arm with axes that wobble, in another region after some."""
    sigma = 1e4 * np.sqrt(np.diag(first.covariance))[:, np.newaxis]  # 20 sigma in all, of 0.1 mrad
    followed = [3.0 * sigma * rng.normal(size=first.tilts.shape) for _ in range(2)]
    waves = 1e-4 * rng.normal(size=first.tilts.shape[1])
    for k, row in enumerate(rows):
        own = followed[k >= stay]
        covariance = row.covariance + 1e-8 * own @ own.T
        offsets = row.offsets + own @ waves
        yield replace(row, offsets=offsets, covariance=covariance, tilt=1e-4, tilts=own)


def test_what_axes_wobble_in_other_regions_is_no_change_and_hides_none_in_the_same(first, rng):
    alarms = 0
    for _ in range(5):
        rows = list(wobbling(first, rng, nights(first, rng, 20), 10))
        assert watch(rows, 100.0).changes == ()
        known = [row.covariance - 1e-8 * row.tilts @ row.tilts.T for row in rows]
        pairs = zip(rows, known, strict=True)
        certain = [replace(r, tilt=None, tilts=np.zeros(0), covariance=c) for r, c in pairs]
        assert watch(certain, 100.0).changes
        alarms += bool(watch([*certain[:10], *rows[10:]], 100.0).changes)
    assert alarms <= 2  # nights of an earlier version do not tell half of the wobble
    for name in BUMPS:
        rows = list(nights(first, rng, 12, (6, name)))
        steady = watch(rows, 100.0).changes
        found = watch(list(wobbling(first, rng, rows, 12)), 100.0).changes
        assert [(str(x), x.seen) for x in found] == [(str(x), x.seen) for x in steady] != []


def test_an_unchanged_arm_raises_no_alarm(first, rng):
    """1,000 nights at one false alarm in 100 years; 365 at ten a year, chance alone."""
    for scatter in (1.0, 2.0):
        found = watch(list(nights(first, rng, 500, scatter=scatter)), 100.0)
        assert found.changes == ()
        assert len(found.nights) == 500
    assert 2 <= len(watch(list(nights(first, rng, 365)), years=0.1).changes) <= 20


@pytest.mark.parametrize('scatter', [1.5, 2.0])
def test_first_nights_that_scatter_more_are_no_alarm(first, rng, scatter):
    """How much nights scatter is not known yet: of 40 robots one has an alarm in 100 years."""
    found = [watch(list(nights(first, rng, 6, scatter=scatter)), 100.0) for _ in range(20)]
    assert not any(each.changes for each in found)


@pytest.mark.parametrize(('per_year', 'count'), [(2e-4, 300), (4e-4, 90)])
def test_a_drift_that_no_night_shows_is_found(first, rng, per_year, count):
    rows = list(nights(first, rng, count))
    slope = per_year / 365.25 * (np.array(first.names) == 'wrist_1_joint.d')
    rows = [replace(row, offsets=row.offsets + slope * k) for k, row in enumerate(rows)]
    changes = watch(rows, 100.0).changes
    assert changes
    for change in changes:
        assert 'wrist_1_joint' in joints_of(change)


def test_changes_of_one_parameter_in_one_direction_are_told_as_creep(first, rng):
    """They were up to 25 bumps, one by one."""
    rows = nights(first, rng, 40, (10, BUMPS[2]))
    slope = 2e-5 * (np.array(first.names) == BUMPS[0])
    rows = [
        replace(row, offsets=row.offsets + slope * max(0, k - 12)) for k, row in enumerate(rows)
    ]
    changes = watch(rows, 100.0).changes
    told = list(alarms_of(changes))
    assert len(changes) > len(told) == 2
    assert 'wrist_2_joint.alpha by' in told[0]
    assert told[0].endswith('was it bumped, or does it creep?')  # seen after some nights
    assert re.fullmatch(
        r'2025-10-\d\d: elbow_joint.theta creeps: by \+0.[45]\d+ mrad in .*', told[1]
    )


def test_the_usual_drift_is_no_event_and_hides_none(first, rng):
    """A random walk that `recalibrate` expects too: 0.02 mm and 0.04 mrad in a year."""
    step = np.sqrt(drift_of([*map(Parameter, first.names)]) / 365.25)
    for _ in range(2):
        walk = np.cumsum(step * rng.normal(size=(210, len(step))), axis=0)
        still = nights(first, rng, 210, (200, BUMPS[0]))
        rows = [replace(r, offsets=r.offsets + w) for r, w in zip(still, walk, strict=True)]
        assert watch(rows[:200], 100.0).changes == ()
        (change,) = watch(rows, 100.0).changes
        assert 'elbow_joint' in joints_of(change)
        assert change.seen <= rows[201].time


@pytest.mark.parametrize('arm', ['ur10e', 'ur10e_on_linear_axis'])
def test_warmer_nights_are_no_change_and_hide_none(arm, rng):
    """By up to some 15 degrees of aluminium; they were bumps of two joints, night after night."""
    first = first_of(arm)
    names, chain = map(Parameter, first.names), first.corrected()
    grows = np.array([name.is_length and not chain.owns_frame(name) for name in names])
    lengths = [chain.value(n) if yes else 0.0 for n, yes in zip(first.names, grows, strict=True)]
    for scale in (1e-4, 3e-4):
        rows = list(nights(first, rng, 30, (24, BUMPS[0])))
        warmer = (scale * rng.normal(size=(30, 1))) * lengths
        rows = [replace(r, offsets=r.offsets + more) for r, more in zip(rows, warmer, strict=True)]
        assert watch(rows[:24], 100.0).changes == ()
        (change,) = watch(rows, 100.0).changes
        assert (change.time, joint_of(change)) == (rows[24].time, 'elbow_joint')


def test_several_changes_and_those_before_a_date(first, rng):
    rows = list(nights(first, rng, 20, (5, BUMPS[0])))
    again = np.array(first.names) == BUMPS[1]
    rows = [replace(r, offsets=r.offsets + 1e-4 * again * (k >= 12)) for k, r in enumerate(rows)]
    changes = watch(rows, 100.0).changes
    owners = [*map(joints_of, changes)]
    alike = {'wrist_1_joint', 'elbow_joint', 'shoulder_lift_joint'}  # d along parallel axes
    assert owners == [{'elbow_joint'}, alike]
    later = watch([r for r in rows if r.time >= changes[0].time], 100.0).changes
    assert [c.time for c in later] == [changes[1].time]
    assert watch([r for r in rows if r.time >= changes[1].time], 100.0).changes == ()


@pytest.mark.parametrize('size', [8, 12, 20, 80])
def test_two_joints_that_change_at_once_are_found(first, rng, size):
    """Each by so many standard deviations, 12 of which are some 0.1 mm or 0.2 mrad."""
    sigma = size * np.sqrt(np.diag(first.covariance))
    both = ('elbow_joint', 'wrist_2_joint')
    for one, other in (('theta', 'a'), ('a', 'theta')):
        names = f'elbow_joint.{one}', f'wrist_2_joint.{other}'
        rows = list(nights(first, rng, 10))
        moved = sigma * np.isin(first.names, names)
        rows = [replace(r, offsets=r.offsets + moved * (k >= 4)) for k, r in enumerate(rows)]
        changes = watch(rows, 100.0).changes
        assert changes[0].seen in (rows[4].time, rows[5].time)
        told = set().union(*map(joints_of, changes))
        assert told == set(both)
    assert str(changes[0]) == 'two joints changed: elbow_joint and wrist_2_joint: was it bumped?'


def test_the_night_of_another_arm_is_no_bump_of_one_joint(first, rng):
    rows = list(nights(first, rng, 8))
    mine, other = plants.robot(0)[0], plants.robot(1)[0]
    names = list(map(Parameter, first.names))
    moved = [0.0 if mine.owns_frame(name) else other.offset(name, mine) for name in names]
    rows[6] = replace(rows[6], offsets=rows[6].offsets + np.array(moved))
    changes = watch(rows, 100.0).changes
    assert [change.time for change in changes] == [rows[6].time, rows[7].time]
    assert {joint_of(change) for change in changes} == {''}
    assert 'another robot' in str(changes[0])


def without(row, *names):
    """Return the row of a night that did not determine some parameters."""
    few = [k for k, name in enumerate(row.names) if name not in names]
    return replace(
        row,
        names=tuple(row.names[k] for k in few),
        offsets=row.offsets[few],
        covariance=row.covariance[np.ix_(few, few)],
        tilts=row.tilts[few],
    )


def test_what_cannot_be_compared_is_told(first, rng):
    rows = list(nights(first, rng, 6))
    rows[2] = without(rows[2], BUMPS[0])
    rows[3] = replace(rows[3], verdict='refused', offsets=rows[3].offsets + 1.0)
    found = watch(rows, 100.0)
    assert [night.row for night in found.nights] == [rows[k] for k in (0, 1, 2, 4, 5)]
    assert found.changes == ()
    assert found.remarks == (
        '1 night, the last of 2025-10-11, cannot be compared with the newest: '
        f'it alone determines {BUMPS[0]}',
    )
    for share in (0.0, -1.0):
        rows[4] = replace(rows[4], covariance=share * first.covariance)
        with pytest.raises(InputError, match=f'covariance in {rows[4].key}.parquet .* move it'):
            watch(rows, 100.0)
    assert watch((), 100.0).nights == watch(rows[:1], 100.0).changes == ()


@pytest.mark.parametrize('odd', [(0,), range(6), (0, 3, 7, 11)])
def test_nights_that_determine_other_parameters_are_compared_among_themselves(first, rng, odd):
    """A first night with poses of its own sets no rule for all others."""
    rows = list(nights(first, rng, 14, (9, BUMPS[1])))
    rows = [without(r, BUMPS[0]) if k in odd else r for k, r in enumerate(rows)]
    found = watch(rows, 100.0)
    assert {joint_of(change) for change in found.changes} == {'wrist_1_joint'}
    assert [night.row for night in found.nights] == rows
    (remark,) = found.remarks
    assert remark.startswith(f'{len(odd)} night{"s" * (len(odd) > 1)}, the last of 2025-10-')


def test_a_night_of_positions_only_is_compared(first, rng):
    rows = list(nights(first, rng, 8, (5, BUMPS[0])))
    rows[0] = without(rows[0], 'tool.rx', 'tool.ry', 'tool.rz')
    found = watch(rows, 100.0)
    assert [joint_of(change) for change in found.changes] == ['elbow_joint']
    assert found.remarks == ()


JOINTS = ('shoulder_lift_joint', 'elbow_joint')
EFFECTS = ('elbow_joint.sin_1', 'elbow_joint.cos_1')


def fitted_with_effects(first, rng):
    """Return the row of a night whose model has effects of 20 sigmas, and what they do to others.

    The information of the others is that of `first`, whose model has none.
    """
    size = len(first.names)
    own = np.linalg.inv(first.covariance)
    root = np.linalg.cholesky(own)
    shared = 0.5 * root @ np.linalg.qr(rng.normal(size=(size, 2)))[0]  # half of what is known
    whole = np.block([[own, shared], [shared.T, np.eye(2)]])
    values = np.array([20.0, 20.0])
    known = dict(zip(EFFECTS, values.tolist(), strict=True))
    row = replace(
        first,
        names=(*first.names, *EFFECTS),
        offsets=np.concatenate([first.offsets, values]),
        covariance=np.linalg.inv(whole),
        tilts=np.pad(first.tilts, ((0, 2), (0, 0))),
        chain=json.dumps(chain_document(first.corrected().with_effect_values(known))),
    )
    return row, first.covariance @ shared @ values


@pytest.mark.parametrize('model', ['from 6 on', 'before 6', 'now and then'])
@pytest.mark.parametrize('bump', ['', BUMPS[0]])
def test_another_model_is_no_change_of_the_arm_and_hides_none(first, rng, model, bump):
    rich, taken_up = fitted_with_effects(first, rng)
    poor = replace(first, offsets=first.offsets + taken_up)
    rows = {
        of: list(nights(row, rng, 16, (6 if bump else 99, bump)))
        for of, row in (('rich', rich), ('poor', poor))
    }
    is_rich = {'from 6 on': range(6, 16), 'before 6': range(6), 'now and then': (0, 3, 4, 8, 13)}
    found = watch([rows['rich' if k in is_rich[model] else 'poor'][k] for k in range(16)], 100.0)
    assert [joint_of(change) for change in found.changes] == (['elbow_joint'] if bump else [])
    assert len(found.nights) == 16
    if not bump:
        (remark,) = found.remarks
        assert remark == (
            'since 2025-10-09, elbow_joint.cos_1, elbow_joint.sin_1 are not compared: only some '
            'nights fitted them'
        )


def test_no_alarm_goes_away_when_a_later_night_has_another_model(first, rng):
    """An effect changes, which only later nights do not fit."""
    rich, _ = fitted_with_effects(first, rng)
    rows = list(nights(rich, rng, 12))
    jump = 30.0 * (np.array(rich.names) == EFFECTS[0])
    rows = [replace(r, offsets=r.offsets + jump * (k >= 5)) for k, r in enumerate(rows)]
    (change,) = watch(rows, 100.0).changes
    rows[11] = without(rows[11], *EFFECTS)
    (again,) = watch(rows, 100.0).changes
    assert again.seen == change.seen == rows[5].time


def test_a_robot_that_was_mastered_again_is_none_of_two_bumped_joints(first, rng):
    """All zeros moved: the two that moved most were named, or a bent link."""
    driven = [name for name in first.names if name.endswith('joint.theta')]
    for size in (20.0, 400.0):
        sigma = size * np.sqrt(np.diag(first.covariance)) * np.isin(first.names, driven)
        moved = sigma * rng.choice([-1.0, 1.5], len(sigma))
        rows = list(nights(first, rng, 8))
        rows = [replace(r, offsets=r.offsets + moved * (k >= 4)) for k, r in enumerate(rows)]
        others = [name for name in first.names if 'joint' in name and name not in driven]
        for each in (rows, [without(row, *others) for row in rows]):  # nothing else was fitted
            (change,) = watch(each, 100.0).changes
            assert str(change) == 'changed: all joints (theta): was it mastered again, or bumped?'


def test_another_load_is_none_of_two_bumped_joints(rng):
    """It bends two joints; nights that do not fit gravity show it as other parameters."""
    first = first_of('ur10e', 'gravity')
    load = 1e-3 * np.isin(first.names, [f'{j}.gravity_wrist_3_joint' for j in JOINTS])
    rows = list(nights(first, rng, 8, (4, BUMPS[0])))
    (bump,) = watch(rows, 100.0).changes
    bent = [name for name in first.names if '.gravity_' in name]
    (other,) = watch([*(without(r, *bent) for r in rows[:4]), *rows[4:]], 100.0).changes
    assert str(bump).endswith('was it bumped?')
    assert str(other).endswith('was it bumped, or does it carry another load?')
    rows = [
        replace(r, offsets=r.offsets + load * (r.time >= bump.time)) for r in nights(first, rng, 8)
    ]
    (change,) = watch(rows, 100.0).changes
    assert str(change) == 'changed: the load of the arm: does it carry another one?'
