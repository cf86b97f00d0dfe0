# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Changes between nights, on results drawn from the covariance of a real identification."""

from dataclasses import replace
from datetime import timedelta

import numpy as np
import plants
import pytest

from calib_ros.apply import simulation
from calib_ros.files.history import Filing, identified
from calib_ros.fleet.watch import watch
from calib_ros.identification.identification import identify
from calib_ros.identification.problem import Problem
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.parameter import Parameter

SIZES = {'m': 1e-4, 'rad': 2e-4}
BUMPS = ('elbow_joint.theta', 'wrist_1_joint.d', 'wrist_2_joint.alpha', 'shoulder_lift_joint.a')


@pytest.fixture(scope='module')
def first():
    true, rng = plants.robot(0)
    poses = simulation.measure(true, true.random_joints(60, rng), rng, *plants.SIGMAS)
    sigmas = dict(zip(('sigma_position', 'sigma_orientation'), plants.SIGMAS, strict=True))
    result = identify(Problem(load_chain('ur10e'), poses, **sigmas))
    return identified(result, Filing('A', plants.when(0), '', ''))


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
        assert change.joint == name.partition('.')[0]
        best = change.reasons[0]
        assert best.names == (name,)
        assert abs(best.change[0] - SIZES[best.names[0].unit]) < 4 * best.sigma[0]
        assert change.seen - first.time <= timedelta(days=number + 1)
        assert abs(change.time - first.time - timedelta(days=number)) <= timedelta(days=1)
        assert name in str(change)


def test_an_unchanged_arm_raises_no_alarm(first, rng):
    """1,000 nights at one false alarm in 100 years; 365 at ten a year, chance alone."""
    for scatter in (1.0, 2.0):
        found = watch(list(nights(first, rng, 500, scatter=scatter)), 100.0)
        assert found.changes == ()
        assert len(found.nights) == 500
    assert 2 <= len(watch(list(nights(first, rng, 365)), years=0.1).changes) <= 20


def test_a_drift_that_no_night_shows_is_found(first, rng):
    rows = list(nights(first, rng, 60))
    which = np.array(first.names) == 'wrist_1_joint.d'
    rows = [replace(row, offsets=row.offsets + 2e-6 * k * which) for k, row in enumerate(rows)]
    changes = watch(rows, 100.0).changes
    assert changes
    for change in changes:
        assert 'wrist_1_joint' in {reason.owner for reason in change.reasons}


def test_several_changes_and_those_before_a_date(first, rng):
    rows = list(nights(first, rng, 20, (5, BUMPS[0])))
    again = np.array(first.names) == BUMPS[1]
    rows = [replace(r, offsets=r.offsets + 1e-4 * again * (k >= 12)) for k, r in enumerate(rows)]
    changes = watch(rows, 100.0).changes
    assert [change.joint for change in changes] == ['elbow_joint', 'wrist_1_joint']
    assert [
        c.joint for c in watch([r for r in rows if r.time >= changes[0].time], 100.0).changes
    ] == ['wrist_1_joint']
    assert watch([r for r in rows if r.time >= changes[1].time], 100.0).changes == ()


def test_the_night_of_another_arm_is_no_bump_of_one_joint(first, rng):
    rows = list(nights(first, rng, 8))
    mine, other = plants.robot(0)[0], plants.robot(1)[0]
    names = list(map(Parameter, first.names))
    moved = [0.0 if mine.owns_frame(name) else other.offset(name, mine) for name in names]
    rows[6] = replace(rows[6], offsets=rows[6].offsets + np.array(moved))
    changes = watch(rows, 100.0).changes
    assert [change.time for change in changes] == [rows[6].time, rows[7].time]
    assert {change.joint for change in changes} == {''}
    assert 'another robot' in str(changes[0])


def test_what_cannot_be_compared_is_left_out(first, rng):
    rows = list(nights(first, rng, 6))
    few = [k for k, name in enumerate(first.names) if name != BUMPS[0]]
    rows[2] = replace(
        rows[2],
        names=tuple(first.names[k] for k in few),
        offsets=rows[2].offsets[few],
        covariance=rows[2].covariance[np.ix_(few, few)],
    )
    rows[3] = replace(rows[3], verdict='refused', offsets=rows[3].offsets + 1.0)
    found = watch(rows, 100.0)
    assert [night.row for night in found.nights] == [rows[k] for k in (0, 1, 4, 5)]
    assert found.changes == ()
    assert watch((), 100.0).nights == watch(rows[:1], 100.0).changes == ()
