# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How robots stand, from the worst to the best."""

from dataclasses import replace

import numpy as np
import plants

from calib_ros.apply.confidence import drift
from calib_ros.files.history import Row
from calib_ros.fleet.plant import Measured, Robot
from calib_ros.fleet.standing import Standing, counts
from calib_ros.fleet.watch import Change, Night, Watched
from calib_ros.identification.changes import Explanation
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.parameter import Parameter

REASON = Explanation(
    '<b>', (Parameter('<b>', 'd'),), 100.0, 1e-20, 1.0, np.array([1e-4]), np.array([1e-5])
)
CHANGE = Change(plants.when(1), plants.when(1), (REASON,))


def standing(serial, errors=None, changes=(), errors_mm=(0.1, 0.1, 0.1), **more):
    rows = [Row(serial, 'identify', plants.when(k), 'accepted', '', '') for k in range(3)]
    rows = [replace(row, rms_mm=0.1 + 0.01 * k, **more) for k, row in enumerate(rows)]
    nights = [Night(row, {'a': 0.5, '<b>': 6.0}) for row in rows]
    robot = Robot(serial, load_chain('ur10e'), (Measured('*'),), tolerance=0.11)
    watched = Watched(tuple(nights), changes)
    verified = tuple(replace(row, rms_mm=rms) for row, rms in zip(rows, errors_mm, strict=True))
    return Standing(
        robot, rows[-1], watched, errors or {}, verified, drift(errors_mm, [30.0] * 3, 100.0)
    )


def test_states_from_the_worst_to_the_best():
    fleet = [
        standing('1', changes=(CHANGE,), verdict='refused'),
        standing('7', errors_mm=(0.1, 0.1, 0.5)),
        standing('2', {'x.csv': 'damaged'}, verdict='refused'),
        replace(standing('3'), last=None),
        standing('4', verdict='refused'),
        standing('5'),
        standing('6', lower_mm=0.1, upper_mm=0.2),
    ]
    fleet[-1] = replace(fleet[-1], robot=replace(fleet[-1].robot, tolerance=None))
    states = [
        'changed',
        'worse',
        'unreadable',
        'unreadable',
        'refused',
        'beyond tolerance',
        'fine',
    ]
    assert [each.state for each in fleet] == states
    assert counts(fleet)['unreadable'] == 2
    assert fleet[1].alarms == ('2025-10-11: the errors of its verifications have grown',)
    assert str(CHANGE) == 'changed: <b>.d by +0.100 ± 0.010 mm: was it bumped?'
