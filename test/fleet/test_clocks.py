# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Clocks that are wrong, and robots that are not measured."""

import json
from dataclasses import replace
from datetime import datetime, timedelta, timezone

import plants
import pytest

from calib_ros.files.history import History
from calib_ros.files.rows import Row
from calib_ros.fleet.plant import Pattern, Robot
from calib_ros.fleet.run import Run
from calib_ros.fleet.status import statuses
from calib_ros.kinematics.chain_file import chain_document, load_chain

ARM = load_chain('ur10e')
PLANT = [Robot(serial, ARM, (Pattern('*'),)) for serial in 'ABC']
ABOUT = {'kind': 'identify', 'verdict': 'accepted', 'chain': json.dumps(chain_document(ARM))}
DAY = timedelta(days=1)
SETTINGS = PLANT[0].settings_hash


@pytest.fixture
def history(tmp_path):
    return History(tmp_path / 'history')


def told(history, robots=PLANT):
    return {each.robot.serial: each for each in statuses(robots, history, Run(), 100.0)}


def remarks(history, robots=PLANT):
    return {serial: each.remarks for serial, each in told(history, robots).items()}


def test_a_clock_that_is_wrong_hides_no_newer_night(history):
    row = Row('A', plants.when(0), '0', SETTINGS, 'a.csv', **ABOUT)
    rows = [
        replace(row, time=plants.when(k), filed=plants.when(k) + DAY / 4, inputs=str(k))
        for k in range(4)
    ]
    ahead = replace(rows[2], time=plants.when(2000), source='b.csv')
    for each in (*rows[:2], ahead, replace(rows[3], verdict='refused')):
        history.file(each)
    status = told(history)['A']
    assert status.state == 'refused'
    assert status.remarks == (
        '1 result with stamps later than the filing, on 2025-10-11 of 2031-04-01 (b.csv): set the '
        'clock of the recorder, or of the computer that filed them',
    )
    back = {'time': plants.when(-900), 'filed': plants.when(4), 'source': 'c.csv'}
    history.file(replace(row, verdict='refused', inputs='4', **back))
    assert told(history)['A'].remarks[1] == (
        'c.csv was filed last, and its stamps are of 2023-04-23, before other nights: '
        'unless it is an old one, a clock was set back'
    )
    reset = {'time': plants.when(5), 'filed': plants.when(-8500), 'source': 'd.csv'}  # to 2002
    history.file(replace(row, inputs='5', **reset))
    status = told(history)['A']
    assert (status.state, status.last.source) == ('fine', 'd.csv')
    assert status.remarks[0].startswith('2 results with stamps later than the filing')


def test_a_result_filed_by_a_clock_ahead_is_told_and_hides_nothing(history):
    """It was the newest for a year, and all other robots had not been measured since."""
    now = datetime.now(timezone.utc)
    for robot in PLANT:
        for k in range(4):
            time = now - k * DAY
            at = (time, f'{robot.serial}{k}', SETTINGS, f'{k}.csv')
            history.file(Row(robot.serial, *at, filed=time, **ABOUT))
    ahead = replace(history.rows('A')[-1], inputs='ahead', source='ahead.csv', verdict='refused')
    ahead = replace(ahead, time=now + 365 * DAY, filed=now + 365 * DAY)
    history.file(ahead)
    found = told(history)
    assert not any(remarks(history).values())
    assert found['A'].states == ('unreadable',)
    (error,) = found['A'].unread
    assert 'in the future, so it does not count: set the clock, there or here' in error
    assert f'{ahead.key}.parquet' in error
    assert 'ahead.csv' in error


def test_a_robot_without_the_nights_of_the_others_is_told_of(history):
    """Of nights that one robot alone has its own clock may be the reason."""
    for robot, last in zip(PLANT, (3, 7, 7), strict=True):
        for k in range(last + 1):
            at = (plants.when(k), f'{robot.serial}{k}', SETTINGS)
            history.file(Row(robot.serial, *at, filed=plants.when(400), **ABOUT))
        if robot is PLANT[0]:
            assert not any(remarks(history).values())  # the only one
    silent = ('nothing measured since 2025-10-12; other robots were',)
    assert remarks(history) == {'A': silent, 'B': (), 'C': ()}
    alone = (
        'no other robot was measured since 2025-10-12: did they stop, or is its clock ahead?',
    )
    assert remarks(history, PLANT[:2]) == {'A': (), 'B': alone}
    history.file(replace(history.rows('A')[-1], time=plants.when(4), inputs='late'))
    assert not any(remarks(history).values())
    history.file(replace(history.rows('C')[-1], time=plants.when(380), inputs='ahead'))
    alone = (
        'no other robot was measured since 2025-10-16: did they stop, or is its clock ahead?',
    )
    assert remarks(history) == {'A': (), 'B': (), 'C': alone}


def test_a_first_run_over_midnight_tells_of_no_clock(history):
    """Workers end in any order: the oldest night may be the last one filed, on another date."""
    for k, minutes in enumerate((20, 0, 5)):
        filed = datetime(2026, 10, 24, 23, 50, tzinfo=timezone.utc) + timedelta(minutes=minutes)
        history.file(Row('A', plants.when(k), str(k), SETTINGS, f'{k}', filed=filed, **ABOUT))
    assert not any(remarks(history).values())
