# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of a fleet in a real Chromium."""

import os
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import plants
import pytest

from calib_ros.files.rows import Row
from calib_ros.fleet.page import write_report
from calib_ros.fleet.plant import Measured, Robot
from calib_ros.fleet.run import Run
from calib_ros.fleet.standing import Standing, counts
from calib_ros.fleet.watch import Change, Night, Watched
from calib_ros.identification.changes import Explanation
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.parameter import Parameter

REASON = Explanation(
    '<b>', (Parameter('<b>', 'd'),), 100.0, 1e-20, 1.0, np.array([1e-4]), np.array([1e-5])
)
CHANGE = Change(plants.when(1), plants.when(1), (REASON,))


def standing(serial, errors=None, changes=(), **more):
    rows = [Row(serial, 'identify', plants.when(k), 'accepted', '', '') for k in range(3)]
    rows = [replace(row, rms_mm=0.1 + 0.01 * k, **more) for k, row in enumerate(rows)]
    nights = [Night(row, {'a': 0.5, '<b>': 6.0}) for row in rows]
    robot = Robot(serial, load_chain('ur10e'), (Measured('*'),), tolerance=0.11)
    return Standing(robot, rows[-1], Watched(tuple(nights), changes), errors or {})


def test_states_from_the_worst_to_the_best():
    fleet = [
        standing('1', changes=(CHANGE,), verdict='refused'),
        standing('2', {'x.csv': 'damaged'}, verdict='refused'),
        replace(standing('3'), last=None),
        standing('4', verdict='refused'),
        standing('5'),
        standing('6', lower_mm=0.1, upper_mm=0.2),
    ]
    fleet[-1] = replace(fleet[-1], robot=replace(fleet[-1].robot, tolerance=None))
    states = ['changed', 'unreadable', 'unreadable', 'refused', 'beyond tolerance', 'fine']
    assert [each.state for each in fleet] == states
    assert counts(fleet)['unreadable'] == 2
    assert str(CHANGE) == 'changed: <b>.d by +0.100 ± 0.010 mm: was it bumped?'


def test_what_a_reader_sees(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / 'report')
    browsers = import_module('test_browser')
    if browsers.browser_path() is None and 'CI' not in os.environ:
        pytest.skip('no Chromium here')
    found = [standing('<i>7', changes=(CHANGE,)), standing('8', {'x.csv': 'x.csv is damaged'})]
    assert write_report(tmp_path, found, Run(filed=6)) == ''
    said = []
    with browsers.browser() as started:
        page = started.new_page()
        page.on('pageerror', lambda error: said.append(str(error)))
        page.on('requestfailed', lambda request: said.append(request.url))
        page.goto((tmp_path / 'index.html').as_uri())
        page.wait_for_selector('#joints .main-svg')
        assert '1 changed, 1 unreadable' in page.inner_text('.verdict')
        assert page.inner_text('#joints .legend') == 'a\n<b>'
        page.select_option('#robot', label='8')
        shown = page.evaluate('document.getElementById("nights").data[0].y')
        np.testing.assert_allclose(shown, [0.1, 0.11, 0.12])
        assert page.evaluate(browsers.CONTRAST) == []
    assert said == []
