# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A ball on the flange that sits in sockets of unknown place (MUKCa; Franzese et al. 2025)."""

from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest
from fits import NOISE, SIGMAS, fitted
from in_sockets import DISTANCE, IIWA, cell, difference, led_to

from calib_ros import Chain, Observations, Problem, identify
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.decision.reasons import Rule
from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.estimation.identifiability import structurally_independent
from calib_ros.estimation.nuisances import Nuisances, nuisance_products
from calib_ros.estimation.start import start_frames
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Frame, Joint
from calib_ros.report.words import summary


def gauges(result):
    return {parameter.name for parameter in result.parameters if parameter.status == 'gauge'}


@cache
def found(seed, offset=0.03, noise=0.0):
    return identify(cell(seed, offset, noise)[1])


def test_sockets_find_the_arm_but_not_where_it_stands():
    result = found(0)
    assert result.accepted
    assert difference(result.chain, cell(0)[0]) < 1e-8
    # turning or lifting the arm with all its sockets shows nowhere
    assert {'joint_1.theta', 'joint_1.d'} <= gauges(result)
    assert not result.not_excited
    assert not result.weak
    assert result.validated_by == 'leaving out one of 4 locations at a time'


def test_noise_makes_no_gauge_freedom_look_determined():
    """A turn of everything turns the residuals as well, by which it looked like a parameter."""
    result = found(0, noise=5e-4)
    assert result.converged
    assert gauges(result) == gauges(found(0))
    std = [p.std for p in result.parameters if p.std and not result.chain.owns_frame(p.name)]
    assert max(std) < 30.0 * 5e-4
    for side in (result.validation.before, result.validation.after):
        for place in range(4):  # which is fitted to its own pairs, so that they err about nothing
            away = side.position[side.configurations == place].mean(axis=0)
            assert np.abs(away).max() < 1e-3 * 5e-4
    errors = np.linalg.norm(result.validation.after.position, axis=1)
    assert np.sqrt(np.mean(errors**2)) > 3.0**0.5 * 5e-4  # of places left out


@pytest.mark.parametrize('offset', [0.0, 3e-4])
def test_a_ball_on_the_last_axis_leaves_it_near_nominal(offset):
    result = found(0, offset, noise=5e-4)
    assert result.accepted
    angle = result.posterior.sizes['angle']
    for name in ('joint_6.alpha', 'joint_6.theta'):  # sigma by the poses alone: some mrad
        assert result.posterior.prior_share(name) > 0.5
        assert abs(result.chain.offset(name, IIWA)) < 3.0 * angle
    assert {'joint_6.alpha', 'joint_6.theta'} <= set(result.weak)
    assert ', '.join(result.weak) in summary(result)
    # where the ball is taken it does not matter: as well as a ball that tells all
    (true, _), (other, _) = cell(0, offset, noise=5e-4), cell(0, noise=5e-4)
    far = found(0, noise=5e-4)
    assert difference(result.chain, true) < 1.5 * difference(far.chain, other) + 1e-4


@pytest.mark.parametrize(('seed', 'agree'), [(0, False), (1, True)])
def test_poses_outside_the_socket_are_named_and_do_no_harm(unsearched, seed, agree):
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
    result = identify(problem.with_sets(sets))
    assert result.accepted
    assert {(outlier.set, outlier.sample) for outlier in result.outliers} == wrong
    best = fitted(problem.with_sets(good, loss='none'))
    assert difference(result.chain, true) < 1.1 * difference(best.chain, true)


def test_a_place_is_left_out_of_an_arm_whose_axes_are_all_parallel():
    """Ball and sockets may be higher together: the place left out must not be what holds them."""
    rows = ({'a': 0.35, 'd': 0.3}, {'a': 0.25, 'alpha': np.pi}, {'type': 'prismatic'}, {})
    scara = Chain('scara', 'standard', tuple(Joint(f'j{k}', **r) for k, r in enumerate(rows)))
    rng = np.random.default_rng(1)
    ball = Frame(se3.transform(np.eye(3), np.array([0.03, 0.02, 0.05])))
    true = replace(faulty(scara, Cell(), rng), base=Frame(), tool=ball)
    sets = []
    for place in range(4):
        q = np.tile(rng.uniform([-1.4, -2.3, 0.05, 0.0], [1.4, -0.3, 0.1, 0.0]), (12, 1))
        points = true.forward(q)[:, :3, 3] + rng.normal(scale=2e-5, size=(12, 3))
        q[:, 3] += np.linspace(-2.5, 2.5, 12)
        seen = Observations.from_arrays(led_to(true, q, points), np.zeros((12, 3)))
        sets.append(replace(seen, base=f'base_{place}', socket=True))
    result = identify(Problem(scara, sets[0], more=sets[1:], sigma_position=2e-5))
    before, after = result.validation.figures
    assert after.rms_mm < min(before.rms_mm, 0.05)
    assert 'something that fixes the size and shape of the arm' in result.refusals[-1]


def test_the_frames_that_places_determine_are_the_same_with_and_without_the_arm():
    _, problem = cell(0)
    frames = tuple(name for name in problem.free if problem.model.owns_frame(name))
    assert problem.free[: len(frames)] == frames
    alone, found = (
        structurally_independent(problem.model, names, problem.sets[1:])
        for names in (frames, problem.free)
    )
    assert alone == tuple(name for name in found if name in frames)
    assert len(alone) < len(frames) < len(found)


def test_well_determined_parameters_are_not_named():
    result = found(0, noise=1e-4)
    assert not result.weak
    assert not result.priors


@pytest.mark.parametrize('slip', [0.0, 5e-3])
def test_known_distances_that_the_arm_does_not_keep_are_no_step(slip):
    """Eccentric joints bend space, so that the sockets seem to be elsewhere from the start."""
    true, problem = cell(2, noise=5e-5)
    places = {each.base: true.forward(each.joints[:1])[0, :3, 3] for each in problem.sets}
    apart = [
        (first, second, float(np.linalg.norm(places[first] - places[second])))
        for first, second in combinations(places, 2)
    ]
    late = np.arange(30)[:, np.newaxis] >= 15
    sets = []
    for each in problem.sets:
        q = each.joints - 1e-3 * np.sin(each.joints)
        sets.append(replace(each, joints=q + slip * late * (np.arange(7) == 3)))
    problem = problem.with_sets(sets, separations=apart)
    step = identify(problem).step
    assert (step and (step.what, step.sample)) == (('joint_4', 15) if slip else None)


def test_known_distances_count_once_however_the_touches_are_thinned():
    _, problem = cell(0)
    sets = [each.select(np.repeat(np.arange(30), 4)) for each in problem.sets]
    system = problem.system(sets)
    chain = start_frames(problem)
    every, few = (
        nuisance_products(
            chain, problem.free, system, Nuisances(), most=system.count // share
        ).plain
        for share in (1, 4)
    )
    np.testing.assert_allclose(few, every, rtol=1e-9, atol=1e-9 * np.abs(every).max())


@pytest.mark.parametrize('error', [0.0, 0.01])
def test_sockets_at_another_distance_than_stated_are_refused(error):
    """A bar 1 % longer than stated made an arm worse, 2.6 mm -> 9.5 mm, and was accepted."""
    problem = cell(0, noise=2e-5)[1]
    stated = [(*pair, (1.0 - error) * distance) for *pair, distance in problem.separations]
    result = identify(replace(problem, separations=stated))
    assert result.accepted == (not error)
    assert any(each.rule is Rule.SCALE for each in result.refusals) == bool(error)


@pytest.mark.parametrize('seed', range(2))
def test_an_arm_does_not_bend_to_a_distance_that_is_wrong(seed):
    """Of six between four sockets one is 1 mm off; arms without errors were corrected by it."""
    true, problem = cell(seed, noise=5e-5)
    sets = problem.sets[::2]
    places = [true.forward(each.joints)[:, :3, 3].mean(axis=0) for each in sets]
    pairs = combinations(range(4), 2)
    apart = [(i, j, float(np.linalg.norm(places[i] - places[j]))) for i, j in pairs]
    apart[0] = (0, 1, apart[0][2] + 1e-3)
    right = replace(true, base=None, tool=None)
    known = [(sets[i].base, sets[j].base, distance) for i, j, distance in apart]
    result = identify(
        Problem(right, sets[0], more=sets[1:], separations=known, sigma_position=5e-5)
    )
    assert not result.accepted
    assert difference(result.chain, true) < 0.1e-3


def test_only_sockets_are_a_known_distance_apart():
    _, problem = cell(0)
    with pytest.raises(UnknownNameError, match=r'"base_9".*base_0_0'):
        replace(problem, separations=(('base_0_0', 'base_9', DISTANCE),))
    for distance in (0.0, np.nan):
        with pytest.raises(ConfigError, match='must be'):
            replace(problem, separations=(('base_0_0', 'base_1_1', distance),))
    poses = replace(problem.sets[0], socket=False)
    with pytest.raises(UnknownNameError, match='base_0_0'):
        replace(problem, observations=poses)


def test_a_socket_without_any_pair_is_named():
    _, problem = cell(0)
    nothing = problem.sets[3].select(np.zeros(0, dtype=int))
    with pytest.raises(InputError, match='base_1_1'):
        identify(problem.with_sets((*problem.sets[:3], nothing, *problem.sets[4:])))


@pytest.mark.parametrize('scale', [1.0, 1.003])
def test_a_tracker_beside_a_socket_is_as_much_out_of_scale_as_alone(scale):
    true, problem = cell(0)
    rng = np.random.default_rng(0)
    seen = measure(true, true.random_joints(40, rng), rng, *NOISE)
    seen = replace(seen, positions=scale * seen.positions)
    first, _, third = sets = problem.sets[:3]
    places = [true.forward(each.joints)[:, :3, 3].mean(axis=0) for each in (first, third)]
    bar = ((first.base, third.base, float(np.linalg.norm(places[1] - places[0]))),)
    alone, beside, barred = (
        identify(Problem(IIWA, seen, more=more, separations=apart, **SIGMAS)).posterior
        for more, apart in (((), ()), (sets[:1], ()), (sets, bar))
    )
    assert beside.scale == pytest.approx(alone.scale, abs=1e-4)
    assert beside.rival[0] == pytest.approx(alone.rival[0], abs=1.0)
    assert barred.scale == pytest.approx(scale - 1.0, abs=2e-4)  # not scaled with the tracker
