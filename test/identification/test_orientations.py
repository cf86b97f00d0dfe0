# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Orientations of new measurements by a calibration that knows none."""

from dataclasses import replace

import pytest
from fits import NOISE, SIGMAS, UR10E, arm

from calib_ros import Calibration, Problem, identify, recalibrate, verify
from calib_ros.apply.simulation import measure
from calib_ros.identification.orientations import turns_left_out


@pytest.mark.parametrize('fixed', [False, True])
def test_orientations_say_nothing_where_only_positions_were_identified(fixed, rng):
    """All were thought to be off by radians: "another robot of this type fits better"."""
    true, q = arm(rng), UR10E.random_joints(48, rng)
    chain = replace(UR10E, tool=replace(true.frame('tool'), fixed=True)) if fixed else UR10E
    old = Problem(chain, measure(true, q[:40], rng, *NOISE, oriented=False), **SIGMAS)
    previous, seen = Calibration.of(identify(old)), measure(true, q[40:], rng, *NOISE)
    found = recalibrate(previous, Problem(chain, seen, **SIGMAS), 0.1)
    assert found.accepted
    assert not found.changed
    told = turns_left_out(previous, [seen])
    assert [each[:19] for each in told] == ([] if fixed else ['orientations (tool)'])
    assert turns_left_out(previous, [seen], new=['tool']) == []
    for figures in (found.after, verify(previous, [seen]).comparison.figures[1]):
        assert (figures.rms_mrad is not None) == fixed
    assert verify(previous, [seen], new_tool=True).comparison.figures[1].rms_mrad < 5.0
