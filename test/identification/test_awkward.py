# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whatever was measured, there is a result, or an error that says what was wrong.

Some of the designs are tried each time; 500 of them by

    AWKWARD=500 python -m pytest test/identification/test_awkward.py
"""

import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings, strategies as st

from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.errors import TooFewObservationsError
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.model_choice import identify_model
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.report.documents import as_document
from calib_ros.report.words import summary

EXAMPLES = int(os.environ.get('AWKWARD', '15'))
MOST = 40
"""Poses of a design."""
POSITIONER = Chain(
    'positioner',
    'standard',
    (
        Joint('tilt', alpha=np.pi / 2, d=0.5, lower=-1.5, upper=1.5),
        Joint('turn', d=0.2, lower=-3.0, upper=3.0),
    ),
)
SHIPPED = ('ur10e', 'puma560', 'franka_panda', 'denso_hsr065', 'ur10e_on_linear_axis')
ROBOTS = (POSITIONER, *map(load_chain, SHIPPED))
PLACES = ('random', 'sweeps', 'two joints', 'one home', 'path', 'local')
SEEN = ('pose', 'position', 'distance', 'constant orientation', 'some oriented')


@st.composite
def designs(draw):
    """Draw an arm and what was measured of it."""
    flag, number = st.booleans(), st.integers
    rng = np.random.default_rng(draw(number(0, 2**32 - 1)))
    chain = draw(st.sampled_from(ROBOTS))
    count = draw(st.one_of(number(1, 12), number(12, MOST)))
    q = joints_of(chain, draw(st.sampled_from(PLACES)), count, rng)
    home = chain.random_joints(1, rng)[0]
    still = draw(st.lists(number(0, len(chain.joints) - 1), max_size=3))
    q[:, still] = home[still]
    q += draw(st.sampled_from([0.0, 0.0, 1e-6, 3e-4])) * rng.normal(size=q.shape)
    step = draw(st.sampled_from([0.0, 0.0, 1e-3, 0.01]))
    commanded = np.round(q / step) * step if step else q
    if draw(flag):  # one stop, measured again and again
        q[count // 2 :], commanded[count // 2 :] = q[0], commanded[0]
    errors = draw(st.sampled_from([0.0, 1.0, 10.0]))
    true = faulty(chain, Cell(length_error=5e-4 * errors, angle_error=1e-3 * errors), rng)
    noise = draw(st.sampled_from([0.0, 1.0, 20.0]))
    seen = measured(true, q, draw(st.sampled_from(SEEN)), noise, rng)
    seen = replace(seen, joints=commanded)
    if draw(flag):
        seen = seen.select(np.sort(rng.integers(0, count, count)))  # duplicate rows
    sets = [replace(seen, stamps_ns=np.arange(1, count + 1) * 1_000_000_000)]
    for target in ('tool_2', 'tool_3')[: draw(st.sampled_from([0, 0, 1, 2]))]:
        other = replace(true, tool=random_frame(rng, 0.2))
        part = q[: draw(st.sampled_from([1, 1, 2, count]))]
        sets.append(replace(measured(other, part, 'pose', noise, rng), tool=target))
    return Problem(chain, sets[0], more=sets[1:], loss=draw(st.sampled_from(LOSSES)))


LOSSES = ('redescending', 'redescending', 'huber', 'none')


def joints_of(chain, places, count, rng):
    """Return joint values (count, n)."""
    q = chain.random_joints(count, rng)
    home = chain.random_joints(1, rng)
    if places in ('sweeps', 'one home'):
        turn = np.arange(count) % len(chain.joints)
        moves = turn[:, np.newaxis] == np.arange(len(chain.joints))
        q = np.where(moves & (places == 'sweeps'), q, home)
    elif places == 'two joints':
        q[:, 2:] = home[:, 2:]
    elif places == 'path':
        q = home + np.linspace(0.0, 1.0, count)[:, np.newaxis] * (q[0] - home)
    elif places == 'local':
        q = home + rng.uniform(-0.15, 0.15, q.shape)
    return q


def measured(true, q, seen, noise, rng):
    """Return the observations of an arm at joint values (N, n)."""
    sigmas = noise * 5e-5, noise * 2e-4
    found = measure(true, q, rng, *sigmas, oriented=seen not in ('position', 'distance'))
    if seen == 'distance':
        return replace(found, distances=np.linalg.norm(found.positions, axis=1))
    if seen == 'constant orientation':
        return Observations.from_arrays(
            q, found.positions, np.broadcast_to(found.rotations[0], (len(q), 3, 3))
        )
    if seen == 'some oriented':
        return replace(found, oriented=rng.random(len(q)) < 0.5)
    return found


@given(designs())
@settings(max_examples=EXAMPLES, phases=[Phase.generate])
def test_any_design_ends_with_a_result_or_an_error_that_explains(problem):
    try:
        result = identify_model(problem, 'auto')
    except TooFewObservationsError:  # all else has a result
        return
    assert np.isfinite(result.posterior.square).all()
    assert np.isfinite(result.predicted_sigma(10)).all()
    assert summary(result)
    assert as_document(result, {})
    assert Calibration.of(result).dump()


def test_a_design_that_determines_no_parameter_of_the_arm():
    """Nothing but frames is fitted, and nothing has a prior."""
    rng = np.random.default_rng(0)
    q = np.column_stack([np.full(3, 0.1), [-1.4, -2.9, 2.5]])
    result = identify_model(Problem(POSITIONER, measured(POSITIONER, q, 'pose', 1.0, rng)), 'auto')
    assert all(POSITIONER.owns_frame(name) for name in result.names)
    assert not result.accepted


def test_rounding_that_leaves_nothing_for_the_arm():
    """Half of the poses are one, and the rest of a path is rounded."""
    rng = np.random.default_rng(1)
    q = joints_of(ROBOTS[1], 'path', 31, rng)
    q[15:] = q[0]
    seen = replace(measured(ROBOTS[1], q, 'position', 1.0, rng), joints=np.round(q, 2))
    assert not identify_model(Problem(ROBOTS[1], seen), 'auto').accepted


@pytest.mark.parametrize(('robot', 'noise'), [*zip(ROBOTS[1:4], (0.0, 1.0, 0.0), strict=True)])
def test_a_target_seen_once_in_sweeps(robot, noise):
    """The fold with its only pose holds all that its frame knows."""
    rng = np.random.default_rng(0)
    true = faulty(robot, Cell(), rng)
    q = joints_of(robot, 'sweeps', 24, rng)
    other = replace(true, tool=random_frame(rng, 0.2))
    once = replace(measured(other, q[:1], 'pose', noise, rng), tool='tool_2')
    problem = Problem(robot, measured(true, q, 'pose', noise, rng), more=[once])
    assert identify_model(problem, 'auto').verdicts
