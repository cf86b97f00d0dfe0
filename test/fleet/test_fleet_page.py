# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How robots stand, from the worst to the best."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import plants

from calib_ros.apply.chart import drift
from calib_ros.decision.changes import Explanation
from calib_ros.files.rows import Row
from calib_ros.fleet.change import Change
from calib_ros.fleet.page import fleet_page
from calib_ros.fleet.plant import Pattern, Robot
from calib_ros.fleet.robot_status import RobotStatus
from calib_ros.fleet.run import Run
from calib_ros.fleet.status import STATES, counts
from calib_ros.fleet.watch import Night, Watched
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.parameter import Parameter

REASON = Explanation(
    '<b>', (Parameter('<b>', 'd'),), 100.0, 1e-20, 1.0, np.array([1e-4]), np.array([1e-5])
)
CHANGE = Change(plants.when(1), plants.when(1), [(REASON,)])


def status(serial, errors=None, changes=(), errors_mm=(0.1, 0.1, 0.1), **more):
    about = {'kind': 'identify', 'verdict': 'accepted'} | more
    rows = [Row(serial, plants.when(k), '', '', rms_mm=0.1 + 0.01 * k, **about) for k in range(3)]
    nights = [Night(row, {'a': 0.5, '<b>': 6.0}) for row in rows]
    robot = Robot(serial, load_chain('ur10e'), (Pattern('*'),), tolerance=0.11)
    watched = Watched(tuple(nights), changes)
    verified = tuple(replace(row, rms_mm=rms) for row, rms in zip(rows, errors_mm, strict=True))
    return RobotStatus(
        robot, rows[-1], watched, errors or {}, verified, drift(errors_mm, [30.0] * 3, 100.0)
    )


def test_states_from_the_worst_to_the_best():
    fleet = [
        status('1', changes=(CHANGE,), verdict='refused'),
        status('7', errors_mm=(0.1, 0.1, 0.5)),
        status('2', {'x.csv': 'damaged'}, verdict='refused'),
        status('4', verdict='refused'),
        status('8', {'x.csv': 'damaged'}),
        status('5'),
        replace(status('3'), last=None),
        status('6', lower_mm=0.1, upper_mm=0.2),
    ]
    wide = replace(fleet[-1].robot, tolerance=None)
    fleet = [replace(each, robot=wide) if each.robot.serial in '126' else each for each in fleet]
    states = [
        ('changed', 'refused'),
        ('worse', 'beyond tolerance'),
        ('refused', 'unreadable'),
        ('refused', 'beyond tolerance'),
        ('beyond tolerance', 'unreadable'),
        ('beyond tolerance',),
        ('unreadable',),
        ('fine',),
    ]
    assert [each.states for each in fleet] == states
    order = list(STATES)
    assert all(sorted(each, key=order.index) == list(each) for each in states)
    assert [counts(fleet)[state] for state in order] == [1, 1, 2, 2, 1, 1]
    assert fleet[1].alarms == ('2025-10-11: the errors of its verifications have grown',)
    assert str(CHANGE) == 'changed: <b>.d by +0.100 ± 0.020 mm (95 %): was it bumped?'


def test_the_page_tells_all_that_is_to_be_said_of_a_robot():
    refused = {'verdict': 'refused', 'reasons': ('the arm is another one',)}
    fleet = [status('2', {'x.csv': 'damaged'}, **refused)]
    page = fleet_page(Path('report'), fleet, Run()).replace('\xa0', ' ')
    assert 'refused, beyond tolerance, unreadable</span>' in page
    for action in fleet[0].actions:
        assert f'<li>{action}</li>' in page
    assert len(fleet[0].actions) == 2


def test_a_night_that_does_not_determine_a_joint_leaves_a_gap_in_its_chart():
    each = status('1')
    few = Watched((*each.watched.nights[:2], Night(each.watched.nights[2].row, {'a': 0.5})))
    told = replace(each, watched=few, remarks=('a <remark>',))
    page = fleet_page(Path('report'), [told], Run())
    assert '"joints": {"\\u003cb\\u003e": [6.0, 6.0, null], "a": [0.5, 0.5, 0.5]}' in page
    assert '<li>a &lt;remark&gt;</li>' in page
