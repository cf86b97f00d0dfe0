# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The chart of verification errors: run lengths, false alarms, and what it finds."""

import numpy as np
import pytest

from calib_ros.apply import chart
from calib_ros.apply.chart import drift, limit, run_length
from calib_ros.errors import InputError


@pytest.mark.parametrize(
    ('slope', 'height', 'nights'), [(0.5, 4.0, 335.4), (0.5, 5.0, 930.9), (1.0, 2.5, 537.1)]
)
def test_the_average_run_length_is_that_of_the_tables(slope, height, nights):
    """Of one-sided charts without a head start."""
    assert run_length(slope, height) == pytest.approx(nights, rel=0.02)


def test_more_steps_change_nothing(monkeypatch):
    few = run_length(0.5, 5.0)
    monkeypatch.setattr(chart, 'STEPS', 600)
    assert run_length(0.5, 5.0) == pytest.approx(few, rel=0.01)


@pytest.mark.parametrize('slope', chart.SLOPES)
def test_a_simulation_runs_as_long(slope):
    """2,000 runs of 100 nights on average: the mean has a standard error of 2.2 %."""
    height = limit(slope, 100.0)
    z = np.random.default_rng(0).normal(size=(2000, 1500))
    sums, ended = np.zeros(2000), np.full(2000, 1500)
    for night in range(1500):
        sums = np.maximum(0.0, sums + z[:, night] - slope)
        ended = np.where((sums > height) & (ended == 1500), night + 1, ended)
    assert ended.mean() == pytest.approx(100.0, rel=0.07)


def test_false_alarms_are_as_rare_as_said():
    """Of 300 robots with 200 nights each, one false alarm a year: 164 in all, give or take."""
    rng = np.random.default_rng(1)
    squares = rng.chisquare(30.0, (300, 200)) / 30.0
    found = [drift(np.sqrt(row), np.full(200, 30.0), 1.0) for row in squares]
    count = sum(len(each.alarms) for each in found)
    assert 90 < count < 200  # dependent charts are on the safe side, restarts cost a night each


@pytest.mark.parametrize(('growth', 'within'), [(2.0, 1), (1.5, 2), (1.25, 6)])
def test_an_arm_that_gets_worse_is_found(growth, within):
    late = []
    for seed in range(40):
        rms = np.sqrt(np.random.default_rng(seed).chisquare(60.0, 60) / 60.0)
        rms[30:] *= growth
        found = drift(0.1 * rms, np.full(60, 60.0))
        assert found.alarms
        assert found.alarms[0] >= 30
        late.append(found.alarms[0] - 29)
    assert np.mean(late) <= within


def test_what_are_no_errors_is_refused():
    for rms, freedom in (([0.1, -0.1], [3.0, 3.0]), ([0.1], [3.0, 3.0]), ([0.1], [0.0])):
        with pytest.raises(InputError, match='degrees of freedom of nights'):
            drift(rms, freedom)
    assert drift([], []).alarms == ()
