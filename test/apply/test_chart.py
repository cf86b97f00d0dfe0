# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The chart of verification errors: run lengths, false alarms, and what it finds; intervals."""

from dataclasses import replace

import numpy as np
import pytest
from verified import with_errors

from calib_ros.apply import simulation
from calib_ros.apply.chart import drift, run_length
from calib_ros.apply.confidence import rms_interval
from calib_ros.apply.judgement import judge
from calib_ros.apply.verification import verify
from calib_ros.errors import ConfigError, InputError
from calib_ros.kinematics.se3 import invert


@pytest.mark.parametrize(
    ('slope', 'height', 'nights'),
    [(0.5, 4.0, 336.0), (0.5, 5.0, 930.0), (0.75, 3.34, 740.0), (1.0, 2.52, 740.0)],
)
def test_the_average_run_length_is_that_of_the_tables(slope, height, nights):
    """Twice those of two-sided charts (Montgomery, Statistical Quality Control)."""
    assert run_length(slope, height) == pytest.approx(nights, rel=0.03)


def test_false_alarms_are_as_rare_as_said():
    """Of 150 robots with 200 nights each, one false alarm a year: 82 in all, give or take."""
    rng = np.random.default_rng(1)
    squares = rng.chisquare(30.0, (150, 200)) / 30.0
    found = [drift(np.sqrt(row), np.full(200, 30.0), 1.0) for row in squares]
    count = sum(len(each.alarms) for each in found)
    assert 45 < count < 100  # dependent charts are on the safe side, restarts cost a night each


@pytest.mark.parametrize(('growth', 'within'), [(2.0, 1), (1.5, 2), (1.25, 6)])
def test_an_arm_that_gets_worse_is_found(growth, within):
    late = []
    for seed in range(40):
        rms = np.sqrt(np.random.default_rng(seed).chisquare(60.0, 60) / 60.0)
        rms[30:] *= growth
        found = drift(0.1 * rms, np.full(60, 60.0), 100.0)
        assert found.alarms
        assert found.alarms[0] >= 30
        late.append(found.alarms[0] - 29)
    assert np.mean(late) <= within


def test_errors_that_grow_after_a_better_calibration_are_found():
    """They were compared with those of the worse calibration before it, too."""
    rng = np.random.default_rng(3)
    rms = np.repeat([1.0, 0.2, 0.5], [20, 10, 5]) * np.sqrt(rng.chisquare(30.0, 35) / 30.0)
    found = drift(rms, np.full(35, 30.0), 100.0)
    assert (found.alarms, found.since) == ((30,), (30,))
    assert drift(rms[:30], np.full(30, 30.0), 100.0).alarms == ()


def test_a_lucky_night_does_not_make_the_next_ones_bad():
    rms = np.ones(30)
    rms[20] = 0.2
    assert drift(rms, np.full(30, 30.0), 100.0).alarms == ()


def test_what_are_no_errors_is_refused():
    for rms, freedom in (([0.1, -0.1], [3.0, 3.0]), ([0.1], [3.0, 3.0]), ([0.1], [0.0])):
        with pytest.raises(InputError, match='degrees of freedom of nights'):
            drift(rms, freedom, 100.0)
    assert drift([], [], 100.0).alarms == ()


@pytest.mark.parametrize('most', [1, 30, 500])
def test_a_pose_measured_again_and_again_tells_no_more(most):
    """Of 30 poses, one of them measured 30 times, the interval held the truth in 63 %."""
    rng, group = np.random.default_rng(2), np.repeat(np.arange(30), [most, *[1] * 29])
    truth, held = np.sqrt(3.0), []
    for errors in rng.normal(size=(400, 30, 3)):
        lower, upper = rms_interval(errors[group], group)
        held.append(lower <= truth <= upper)
    assert np.mean(held) > 0.93
    assert rms_interval(np.ones((2, 3)), np.zeros(2, dtype=int)) == (0.0, np.inf)  # of one pose


def test_node_and_command_judge_by_one_rule(arm):
    """Of 25 arms ~/validate left 12 undecided that `verify` failed: it counted repeats."""
    frame = simulation.random_frame(np.random.default_rng(9), 2.0)  # of a second device
    arms = {each: getattr(arm, each).with_frame('base_2', frame) for each in ('chain', 'before')}
    arm = replace(arm, **arms, region=None, covariance=None)
    errors = np.random.default_rng(0).normal(scale=1e-4, size=(8, 3)) * [1.0, 0.5, 0.1]
    seen = with_errors(arm, errors)
    there = (frame.matrix @ invert(arm.chain.base.matrix))[:3]
    other = replace(
        seen,
        base='base_2',
        positions=seen.positions @ there[:, :3].T + there[:, 3],
        rotations=there[:, :3] @ seen.rotations,
    )
    again = seen.select(np.repeat(np.arange(4), [30, 1, 1, 1]))
    for sets in ([seen.select(np.repeat(np.arange(8), [30, *7 * [1]]))], [again, other]):
        for residual in np.geomspace(1e-5, 1e-3, 5):
            of = replace(arm, residual=residual)
            node, command = judge(of, sets), verify(of, sets, None)
            for name in ('verdict', 'limit', 'rms', 'lower', 'upper', 'freedom', 'needed'):
                assert getattr(node, name) == getattr(command, name)
        once = verify(of, [seen] if len(sets) == 1 else [seen.select(np.arange(4)), other], None)
        assert (node.rms, node.upper) == pytest.approx((once.rms, once.upper))
    with pytest.raises(ConfigError, match='at least one set of Observations'):
        verify(arm, [], None)
