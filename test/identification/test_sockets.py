# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A ball on the flange that sits in sockets of unknown place (MUKCa; Franzese et al. 2025)."""

from dataclasses import replace

import numpy as np
import pytest

from calib_ros.apply.simulation import Cell, faulty
from calib_ros.errors import InputError, UnknownNameError
from calib_ros.identification.identification import Problem, identify
from calib_ros.identification.observations import Observations
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.report.words import summary

DISTANCE = 0.05
PLACES = 4
IIWA = replace(load_chain('kuka_iiwa14'), base=None, tool=None)


def led_to(chain, q, points):
    """Return joint values near q (N, n) that bring the target to points (N, 3)."""
    model = ErrorModel(chain, [f'{name}.theta' for name in chain.joint_names])
    for _ in range(200):
        columns = model.jacobian(q)[:, :3] * np.array([joint.sign for joint in chain.joints])
        square = columns @ columns.transpose(0, 2, 1) + 1e-5 * np.eye(3)
        left = points - chain.forward(q)[:, :3, 3]
        steps = np.linalg.solve(square, left[:, :, None])
        q = q + (columns.transpose(0, 2, 1) @ steps)[:, :, 0]
    assert np.abs(chain.forward(q)[:, :3, 3] - points).max() < 1e-12
    return q


def cell(seed, offset=0.03, noise=0.0, count=30):
    """Return a true arm with the ball some offset [m] from its last axis, and the problem."""
    rng = np.random.default_rng(seed)
    tool = np.eye(4)
    tool[:3, 3] = [offset, 0.0, 0.14]
    true = replace(faulty(IIWA, Cell(), rng), base=Frame(), tool=Frame(tool))
    sets, separations = [], []
    for place in range(PLACES):
        reach = true.forward(true.random_joints(5, rng))[:, :3, 3]
        middle = reach[np.argsort(np.linalg.norm(reach, axis=1))[1]]
        angle = rng.uniform(0.0, np.pi)
        half = 0.5 * DISTANCE * np.array([np.cos(angle), np.sin(angle), 0.0])
        bases = [f'base_{place}_{socket}' for socket in range(2)]
        for base, centre in zip(bases, (middle - half, middle + half), strict=True):
            points = centre + rng.normal(scale=noise, size=(count, 3))
            q = led_to(true, true.random_joints(count, rng), points)
            seen = Observations.from_arrays(q, np.zeros((count, 3)))
            sets.append(replace(seen, base=base, socket=True))
        separations.append((*bases, DISTANCE))
    return true, Problem(
        IIWA,
        sets[0],
        more=sets[1:],
        separations=separations,
        sigma_position=max(noise, 1e-5),
    )


def difference(found, true, seed=0):
    """Return the RMS distance [m] of positions by two chains, one body laid upon the other."""
    q = IIWA.random_joints(300, np.random.default_rng(seed))
    first, second = (chain.forward(q)[:, :3, 3] for chain in (found, true))
    first, second = first - first.mean(axis=0), second - second.mean(axis=0)
    turn = se3.nearest_rotation(second.T @ first)
    return float(np.sqrt(((first @ turn.T - second) ** 2).sum(axis=1).mean()))


def gauges(result):
    return {parameter.name for parameter in result.parameters if parameter.status == 'gauge'}


@pytest.mark.parametrize('seed', range(2))
def test_sockets_find_the_arm_but_not_where_it_stands(seed):
    true, problem = cell(seed)
    result = identify(problem)
    assert result.accepted
    assert difference(result.chain, true) < 1e-8
    # turning or lifting the arm with all its sockets shows nowhere
    assert {'joint_1.theta', 'joint_1.d'} <= gauges(result)
    assert not result.not_excited
    assert not result.weak
    assert result.validated_by == 'leaving out one of 4 places at a time'


@pytest.mark.parametrize('noise', [1e-4, 5e-4])
def test_noise_makes_no_gauge_freedom_look_determined(noise):
    """A turn of everything turns the residuals as well, by which it looked like a parameter."""
    result = identify(cell(0, noise=noise)[1])
    assert result.converged
    assert gauges(result) == gauges(identify(cell(0)[1]))
    std = [p.std for p in result.parameters if p.std and not result.chain.owns_frame(p.name)]
    assert max(std) < 30.0 * noise


@pytest.mark.parametrize(('seed', 'offset'), [(0, 0.0), (1, 3e-4)])
def test_a_ball_on_the_last_axis_leaves_it_near_nominal(seed, offset):
    true, problem = cell(seed, offset, noise=5e-4)
    result = identify(problem)
    assert result.accepted
    angle = result.posterior.sizes['angle']
    for name in ('joint_6.alpha', 'joint_6.theta'):  # sigma by the poses alone: some mrad
        assert result.posterior.held(name) > 0.5
        assert abs(result.chain.offset(name, IIWA)) < 3.0 * angle
    assert {'joint_6.alpha', 'joint_6.theta'} <= set(result.weak)
    assert ', '.join(result.weak) in summary(result)
    # where the ball is taken it does not matter: as well as a ball that tells all
    other, telling = cell(seed, noise=5e-4)
    far = identify(telling)
    assert difference(result.chain, true) < 1.5 * difference(far.chain, other) + 1e-4


@pytest.mark.parametrize(('seed', 'agree'), [(0, False), (1, True)])
def test_poses_outside_the_socket_are_named_and_do_no_harm(seed, agree):
    """At 30 % of the poses of every socket the ball sat 5-50 mm beside it."""
    rng = np.random.default_rng(seed)
    true, problem = cell(seed, noise=1e-4)
    sets, good, wrong = [], [], set()
    for number, each in enumerate(problem.sets):
        beside = rng.choice(len(each), 9, replace=False)
        shift = rng.normal(size=(1 if agree else 9, 3))
        shift *= rng.uniform(5e-3, 50e-3, (len(shift), 1)) / np.linalg.norm(shift, axis=1)[:, None]
        q = each.joints.copy()
        q[beside] = led_to(true, q[beside], true.forward(q[beside])[:, :3, 3] + shift)
        sets.append(replace(each, joints=q))
        good.append(each.select(np.setdiff1d(np.arange(len(each)), beside)))
        wrong |= {(number, sample) for sample in beside.tolist()}
    result = identify(replace(problem, observations=sets[0], more=sets[1:]))
    assert result.accepted
    assert {(outlier.set, outlier.sample) for outlier in result.outliers} == wrong
    best = identify(replace(problem, observations=good[0], more=good[1:], loss='none'))
    assert difference(result.chain, true) < 1.1 * difference(best.chain, true)


def test_well_determined_parameters_are_not_named():
    result = identify(cell(0, noise=5e-5)[1])
    assert not result.weak
    assert not result.priors


def test_sockets_alone_and_in_rows_of_three_make_a_place_each():
    true, problem = cell(0)
    first, second = (true.forward(problem.sets[k].joints[:1])[0, :3, 3] for k in (3, 4))
    apart = float(np.linalg.norm(first - second))
    separations = (*problem.separations[1:], ('base_1_1', 'base_2_0', apart))
    result = identify(replace(problem, separations=separations))
    assert result.accepted
    assert difference(result.chain, true) < 1e-8
    # the two of place 0, places 1 and 2 together, and place 3
    assert result.validated_by == 'leaving out one of 4 places at a time'


def test_only_sockets_are_a_known_distance_apart():
    _, problem = cell(0)
    with pytest.raises(UnknownNameError, match=r'"base_9".*base_0_0'):
        replace(problem, separations=(('base_0_0', 'base_9', DISTANCE),))
    poses = replace(problem.sets[0], socket=False)
    with pytest.raises(UnknownNameError, match='base_0_0'):
        replace(problem, observations=poses)


def test_a_socket_without_any_pair_is_named():
    _, problem = cell(0)
    nothing = problem.sets[3].select(np.zeros(0, dtype=int))
    with pytest.raises(InputError, match='base_1_1'):
        identify(replace(problem, more=(*problem.sets[1:3], nothing, *problem.sets[4:])))
