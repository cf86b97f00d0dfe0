# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What moved several times is named with each place."""

from dataclasses import replace

import fits
import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E

from calib_ros import Observations, Problem, identify
from calib_ros.apply.simulation import measure
from calib_ros.decision.reasons import Rule
from calib_ros.decision.steps import find_step
from calib_ros.estimation import fitting
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.report.documents import as_document

pytestmark = pytest.mark.usefixtures('unsearched')
COUNT = 60
BACK = ((30, 0.03), (45, -0.03))


def slipped(seed, joint, slips, oriented=False, chain=UR10E, swept=False):
    """Return the true arm and measurements of it, a joint having slipped [rad] at some rows."""
    rng = np.random.default_rng(seed)
    true, q = fits.arm(rng, chain=chain), chain.random_joints(COUNT, rng)
    q = q[np.argsort(q[:, 0])] if swept else q
    moved = q.copy()
    for row, size in slips:
        moved[row:, joint] += size
    return true, replace(measure(true, moved, rng, *NOISE, oriented=oriented), joints=q)


def places(step):
    """Return the samples and sizes of a step and of those after it."""
    return [each.sample for each in (step, *step.later)], [
        each.size for each in (step, *step.later)
    ]


@pytest.mark.parametrize(
    ('first', 'slip', 'count', 'error'), [(50, 0.012, 4, 0.05), (55, 0.1, 7, 0.002)]
)
def test_neither_few_large_gross_errors_nor_small_ones_hide_a_slip_near_the_end(
    first, slip, count, error
):
    """Poses after it were outliers too, and a calibration of the past arm was accepted."""
    _, seen = slipped(0, 2, [(first, slip)])
    rows = np.random.default_rng(0).choice(50, count, replace=False)
    seen.positions[rows] += [error, 0.0, 0.0]
    step = find_step(fitting.fit(Problem(UR10E, seen, **SIGMAS)))
    assert (step.what, step.sample) == (UR10E.joint_names[2], first)


@pytest.mark.parametrize(
    ('joint', 'slips'),
    [
        (3, ((22, -0.055), (44, -0.055))),
        (2, ((24, 0.01), (32, 0.01), (41, 0.01))),
        (1, ((12, 0.02), (25, -0.05), (48, 0.03))),
    ],
)
def test_a_joint_that_slips_several_times_is_named_and_refused(joint, slips):
    """The first was accepted with 7.6 of 11.5 mm left, and no word."""
    _, seen = slipped(4, joint, slips)
    result = identify(Problem(UR10E, seen, **SIGMAS))
    rows, sizes = zip(*slips, strict=True)
    found = places(result.step)
    assert result.step.what == UR10E.joint_names[joint]
    np.testing.assert_allclose(found[0], rows, atol=1)
    np.testing.assert_allclose(found[1], sizes, rtol=0.1)
    assert result.refusals[0].rule is Rule.ENCODER
    assert f'before line {found[0][0] + 1}, by ' in result.refusals[0]
    assert len(as_document(result, {})['step']['later']) == len(slips) - 1


@pytest.mark.parametrize(('oriented', 'swept'), [(False, False), (True, False), (False, True)])
def test_a_joint_that_slips_there_and_back_is_named(oriented, swept):
    """All between were outliers of an accepted result, also along a sweep."""
    _, seen = slipped(1, 3, BACK, oriented, swept=swept)
    result = identify(Problem(UR10E, seen, **SIGMAS))
    assert {each.sample for each in result.outliers} == {*range(30, 45)}
    assert places(result.step)[0] == [30, 45]
    assert result.step.unused
    assert not result.accepted


def test_a_device_that_moves_there_and_back_is_a_remark():
    """All between carry no weight, so the arm is not affected."""
    _, seen = slipped(2, 0, ())
    rows = (np.arange(COUNT) >= 30) & (np.arange(COUNT) < 42)
    shift = np.outer(rows, [8e-3, 0.0, -6e-3])
    result = identify(Problem(UR10E, replace(seen, positions=seen.positions + shift), **SIGMAS))
    assert result.accepted
    assert (result.step.kind, places(result.step)[0]) == ('base', [30, 42])
    assert result.remarks[0] == str(result.step)
    assert 'measurements with it elsewhere carry no weight' in result.remarks[0]


def test_draw_wires_tell_several_slips():
    chain = load_chain('kuka_iiwa14')
    true, seen = slipped(3, 3, ((20, 0.02), (38, 0.015)), chain=chain)
    sets = []
    for k, anchor in enumerate(([2.0, 0.3, -0.5], [-1.0, 1.8, 0.2], [-0.8, -1.9, 0.8])):
        far = np.linalg.norm(seen.positions - true.base.matrix[:3, 3] - anchor, axis=1)
        only = Observations.from_arrays(seen.joints, np.zeros((COUNT, 3)))
        sets.append(replace(only, distances=far, base=f'base_{k}'))
    step = find_step(fitting.fit(Problem(chain, sets[0], more=sets[1:], **SIGMAS)))
    assert (step.what, places(step)[0]) == (chain.joint_names[3], [20, 38])
