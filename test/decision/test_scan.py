# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The search for a step: its places, its tests against chance and drift, and what it tells."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E, arm, at_stations, measured_arm
from in_sockets import cell, led_to

from calib_ros import Observations, Problem, identify
from calib_ros.apply.simulation import measure
from calib_ros.decision import moved, scan, steps
from calib_ros.decision.steps import find_step
from calib_ros.estimation import fitting
from calib_ros.estimation.leastsquares import STEP_TOLERANCE
from calib_ros.estimation.levels import LEAST_ASIDE, SURE
from calib_ros.settings import EXCEPTION

COUNT, AT = 60, 26


def bumped(errors=1.0, size=1e-3, noise=NOISE, seed=3, oriented=True, gross=0, **more):
    """Return the fit of an arm of which the target moved by a size [m].

    Some positions, anywhere in the session, are `gross`: off by centimetres.
    """
    rng = np.random.default_rng(seed)
    true = arm(rng, errors)
    seen = measure(true, UR10E.random_joints(COUNT, rng), rng, *noise, oriented=oriented)
    late = np.arange(COUNT)[:, np.newaxis] >= AT
    positions = seen.positions + size * late * true.forward(seen.joints)[:, :3, 0]
    positions[rng.choice(COUNT, gross, replace=False)] += rng.normal(scale=0.03, size=(gross, 3))
    return fitting.fit(Problem(UR10E, replace(seen, positions=positions), **SIGMAS, **more))


def test_of_a_late_slip_no_joint_is_told_to_be_outdated():
    """Only a frame that moved is."""
    *_, seen = measured_arm(2, COUNT)
    slipped = seen.joints + 0.05 * np.outer(np.arange(COUNT) >= 45, np.eye(6)[2])
    step = find_step(fitting.fit(Problem(UR10E, replace(seen, joints=slipped), **SIGMAS)))
    assert (step.kind, step.outdated) == ('joint', False)
    assert 'measurements from there on carry no weight' in str(step)


@pytest.mark.parametrize('seed', [0, 1])
def test_noisy_orientations_hide_no_step(seed):
    """Beside fifty times the noise stated, 3 mrad were taken for the arm's and accepted."""
    *_, seen = measured_arm(seed, COUNT, (NOISE[0], 50.0 * NOISE[1]))
    slipped = seen.joints + 3e-3 * np.outer(np.arange(COUNT) >= AT, np.eye(6)[2])
    step = find_step(fitting.fit(Problem(UR10E, replace(seen, joints=slipped), **SIGMAS)))
    assert step.kind == 'joint'


def test_gross_errors_larger_than_a_move_are_not_torn_off_by_it():
    """Of 30 good arms with a joint value that stood still for 12 to 18 poses 9 had moved."""
    rng = np.random.default_rng(2)
    joints = UR10E.random_joints(COUNT, rng)
    seen = measure(arm(rng, 0.1), joints, rng, *NOISE, oriented=False)
    joints[20:36, 2] = joints[20, 2]
    fitted = fitting.fit(Problem(UR10E, replace(seen, joints=joints), sigma_position=1e-4))
    assert find_step(fitted) is None


@pytest.mark.parametrize('seed', [0, 1])
def test_gross_errors_hide_no_step(seed):
    """By Huber weights they are most of the squares, of which a step would explain too few."""
    step = find_step(bumped(size=2e-3, seed=seed, oriented=False, gross=4))
    assert (step.kind, step.sample) == ('tool', AT)


@pytest.mark.parametrize('seed', [2, 5])
def test_gross_errors_here_and_there_are_no_move_of_a_healthy_arm(seed):
    assert find_step(bumped(0.0, 0.0, seed=seed, oriented=False, gross=4)) is None


@pytest.mark.parametrize(('seed', 'row'), [(1, 1), (2, 38)])
def test_a_gross_error_near_an_end_is_no_move_there(seed, row):
    """A frame of a few positions explains one of them, however far off it is."""
    rng = np.random.default_rng([seed, row])
    *_, seen = measured_arm(seed, 40, oriented=False)
    seen.positions[row] += 0.05 / 3.0**0.5 * rng.normal(size=3)
    assert find_step(fitting.fit(Problem(UR10E, seen, **SIGMAS))) is None


@pytest.mark.parametrize('seed', [5, 12])
def test_gross_errors_among_few_positions_leave_freedoms_of_the_others_only(seed):
    """Counted, they would make a move clear that takes most of the freedoms left."""
    rng = np.random.default_rng([seed, 15])
    *_, seen = measured_arm(seed, 15, oriented=False)
    rows = rng.choice(15, 3, replace=False)
    seen.positions[rows] += rng.normal(scale=0.005, size=(3, 3))
    fitted = fitting.fit(Problem(UR10E, seen, **SIGMAS))
    assert find_step(fitted) is None
    model = scan.Scan(fitted, loaded=False, gross=0)
    assert model.budget(model.groups[0])[0] == 3 * (15 - 3)


@pytest.mark.parametrize('count', [6, 30, 400])
def test_the_coarse_search_is_a_tenth_of_the_shorter_side_apart(count):
    some = scan._some_places(count)
    assert [some[0], some[-1]] == [LEAST_ASIDE, count - LEAST_ASIDE]
    aside = np.minimum(some, count - some)
    gaps = np.diff(some)
    np.testing.assert_array_equal(gaps[:-1], np.maximum(aside[:-2] // 10, 1))
    assert (gaps[-1:] <= np.maximum(aside[-2:-1] // 10, 1)).all()
    assert not len(scan._some_places(2 * LEAST_ASIDE - 1))


def test_poses_that_spare_no_more_than_a_step_takes_show_none():
    """It was a division by zero."""
    *_, seen = measured_arm(0, 7)
    fitted = fitting.fit(Problem(UR10E, seen, sigma_position=1e-5, sigma_orientation=5e-5))
    assert find_step(fitted) is None


def test_a_step_between_places_of_the_coarse_search_may_explain_just_enough(monkeypatch):
    fitted = bumped()
    monkeypatch.setattr(scan, '_some_places', lambda _: np.array([AT - 4, AT + 4]))
    monkeypatch.setattr(steps, 'EXPLAINED', find_step(fitted).share - 1e-6)
    assert find_step(fitted).sample == AT


def test_a_held_frame_that_does_not_explain_most_is_not_named(monkeypatch, rng):
    _, true, seen = measured_arm(rng, COUNT)
    matrix = true.base.matrix + 3e-3 * np.eye(4, k=3)
    chain = replace(UR10E, base=replace(true.base, matrix=matrix, fixed=True))
    fitted = fitting.fit(Problem(chain, seen, **SIGMAS))
    found = find_step(fitted)
    assert found.held
    monkeypatch.setattr(steps, 'EXPLAINED', found.share + 1e-6)
    assert find_step(fitted) is None


@pytest.mark.parametrize(('share', 'found'), [(0.3, False), (30.0, True)])
def test_residuals_below_the_tolerance_of_the_fit_show_no_step(share, found):
    step = find_step(bumped(size=share * STEP_TOLERANCE * NOISE[0], noise=(0.0, 0.0)))
    assert (step is not None) == found


@pytest.mark.parametrize(('share', 'found'), [(0.9, True), (1.1, False)])
def test_a_step_by_chance_is_one_of_all_groups_and_stops(share, found, monkeypatch):
    """By an F test, with the freedoms of the fit."""
    fitted, told, trials = bumped(), set(), COUNT * (2 + len(UR10E.joints))
    seldom = share * (1.0 - SURE) / trials
    monkeypatch.setattr(steps, 'chance_of', lambda *given: told.add(given[1:]) or seldom)
    assert (find_step(fitted) is not None) == found
    freedom = 6 * COUNT - len(fitted.names)  # zero: a side of gross errors
    alone = {(1, freedom - 1), (6, freedom - 6)}  # of several others, each with its place
    assert alone <= told - {(0, freedom)}
    assert not found or alone == told - {(0, freedom)}


def test_a_target_that_creeps_is_told():
    rng = np.random.default_rng(2)
    true, q = arm(rng), UR10E.random_joints(40, rng)
    seen = measure(true, q, rng, *NOISE, oriented=False)
    shift = np.linspace(0.0, 1e-3, 40)[:, np.newaxis] * [0.6, 0.0, 0.8]
    seen.positions[:] += np.einsum('nij,nj->ni', true.forward(q)[:, :3, :3], shift)
    result = identify(Problem(UR10E, seen, **SIGMAS))
    told = 'the target seems to have moved slowly, by '
    assert str(result.step).startswith(told)
    assert result.step.size == pytest.approx(1e-3, rel=0.3)
    assert result.accepted
    assert any(each.startswith(told) for each in result.remarks)


@pytest.mark.parametrize(
    ('joint', 'refused', 'fixed'),
    [(1, True, ()), (2, True, ()), (4, False, ()), (1, False, ('*_joint.*',))],
)
def test_a_zero_that_creeps_is_told_and_refused_if_the_correction_is_spoilt(joint, refused, fixed):
    """The arm was 2 mm off at the end of an accepted session; frames alone correct nothing."""
    rng = np.random.default_rng(joint)
    true, q, name = (
        arm(rng, 0.0 if fixed else 1.0),
        UR10E.random_joints(60, rng),
        UR10E.joint_names[joint],
    )
    crept = 5e-3 * np.linspace(0.0, 1.0, 60)[:, np.newaxis] * np.eye(6)[joint]
    seen = measure(true, q + crept, rng, *NOISE, oriented=joint != 2)
    result = identify(Problem(UR10E, replace(seen, joints=q), fixed=fixed, **SIGMAS))
    told = f'the zero of {name} seems to have moved slowly, by '
    assert abs(result.step.size) == pytest.approx(5e-3, rel=0.1)
    assert any(each.startswith(told) for each in result.refusals) == refused
    assert any(each.startswith(told) for each in result.remarks) != refused


def test_a_drift_is_compared_with_priors_as_they_are_known(monkeypatch):
    """Else it might use the freedom of parameters that are held."""
    name, products = 'elbow_joint.a', []
    fitted = bumped(0.0, priors={name: 1e-9})
    gain_of = steps.gain_of
    monkeypatch.setattr(steps, 'gain_of', lambda *given: products.append(given) or gain_of(*given))
    assert find_step(fitted).kind == 'tool'
    ((matrix, count),) = products
    assert count == len(fitted.names)
    assert matrix.diagonal()[fitted.names.index(name)] == pytest.approx(1e18, rel=0.2)


def test_a_slow_motion_by_metres_is_none():
    """Two columns of joint values were swapped: the robot seemed to have moved by 2 or 3 m."""
    rng = np.random.default_rng([1, 5])
    true, share = arm(rng), np.linspace(0.0, np.pi, 50)[:, np.newaxis]
    waves = [
        rng.normal(size=6) * np.cos(k * share + rng.uniform(0.0, 6.0, 6)) for k in range(1, 5)
    ]
    seen = measure(true, 0.6 * sum(waves), rng, *NOISE, oriented=False)
    swapped = replace(seen, joints=seen.joints[:, [1, 0, 2, 3, 4, 5]])
    assert find_step(fitting.fit(Problem(UR10E, swapped, **SIGMAS))) is None


@pytest.mark.parametrize('of_messages', [False, True])
def test_messages_of_whole_seconds_have_no_lines(of_messages):
    """In simulated time."""
    told = str(find_step(bumped(of_messages=of_messages)))
    assert f'before {"the pose of 27.000 s" if of_messages else f"line {AT + 1} ("}' in told


def test_sets_have_their_share_of_the_freedoms_of_the_fit():
    fitted = bumped()
    model = scan.Scan(fitted, loaded=False, gross=2)
    for group in model.groups:
        equations, freedom, _ = model.budget(group)
        assert (equations, freedom) == (6 * COUNT, pytest.approx(6 * COUNT - len(fitted.names)))


@pytest.mark.parametrize('seed', [1, 5])
def test_a_slip_that_one_of_several_sets_imitates_alone_is_that_of_the_joint(seed):
    """Another anchor of one draw-wire spares the others too: more than all that its own lack."""
    rng = np.random.default_rng(seed)
    true, q = arm(rng), 0.15 * UR10E.random_joints(COUNT, rng) + [0.0, -1.0, 1.3, 0.0, 1.0, 0.0]
    slipped = q.copy()
    slipped[AT:, 2] += 2e-3
    places = measure(true, slipped, rng, NOISE[0], oriented=False).positions
    sets = []
    for k, anchor in enumerate(rng.uniform(-2.0, 2.0, (3, 3))):
        one = Observations.from_arrays(q[k::3], np.zeros((COUNT // 3, 3)))
        far = np.linalg.norm(places[k::3] - anchor, axis=1)
        one = replace(one.at(np.arange(k, COUNT, 3) * 10**9), base=f'base_{k}', distances=far)
        sets.append(one)
    chain = replace(UR10E, base=None)
    step = find_step(fitting.fit(Problem(chain, sets[0], more=sets[1:], **SIGMAS)))
    assert (step.what, step.stamp_ns // 10**9, step.slow) == ('elbow_joint', AT, False)
    assert step.size == pytest.approx(2e-3, rel=0.1)


@pytest.mark.parametrize('jumping', [(0, 1, 2), (1,)])
def test_zeros_of_draw_wires_that_jump_are_named_one_or_all(jumping):
    """Anchors of one or two were named, by other sizes, or nothing: 8 of 30 were accepted."""
    rng = np.random.default_rng(3)
    true, q = arm(rng), UR10E.random_joints(COUNT, rng)
    places = measure(true, q, rng, NOISE[0], oriented=False).positions
    sets = []
    for k, anchor in enumerate(rng.uniform(-2.0, 2.0, (3, 3))):
        far = np.linalg.norm(places - anchor, axis=1)
        far[AT:] += 1e-3 * (k in jumping)
        one = Observations.from_arrays(q, np.zeros((COUNT, 3)))
        sets.append(replace(one, base=f'base_{k}', distances=far))
    chain = replace(UR10E, base=None)
    step = find_step(fitting.fit(Problem(chain, sets[0], more=sets[1:], **SIGMAS)))
    assert (step.kind, step.sample, step.slow) == ('zero', AT, False)
    assert step.what == ', '.join(f'base_{k}' for k in jumping)
    assert step.size == pytest.approx(1e-3, rel=0.1)
    for told in (str(step), step.told(AT + 1)):
        assert told.startswith(f'the zero of {step.what} moved by')
    assert not replace(step, unused=moved.FROM_THERE).outdated  # the device stands where it was


@pytest.mark.parametrize('seed', [3, 4])
@pytest.mark.parametrize('moving', [(0, 1), (1,)])
def test_a_foot_that_moves_is_no_jump_of_several_zeros(seed, moving):
    """It was told in 27 of 52 sessions with wires at each pose, with a wrong correction."""
    rng = np.random.default_rng(seed)
    true, q = arm(rng), UR10E.random_joints(COUNT, rng)
    places = measure(true, q, rng, NOISE[0], oriented=False).positions
    sets, shift = [], np.array([1e-3, 1e-3, -1e-3])
    for k, anchor in enumerate(rng.uniform(-2.0, 2.0, (2, 3))):
        away = places - anchor
        away[AT:] += shift * (k in moving)
        one = Observations.from_arrays(q, np.zeros((COUNT, 3)))
        sets.append(replace(one, base=f'base_{k}', distances=np.linalg.norm(away, axis=1)))
    chain = replace(UR10E, base=None)
    step = find_step(fitting.fit(Problem(chain, sets[0], more=sets[1:], **SIGMAS)))
    assert (step.kind, step.sample, step.slow) == ('base', AT, False)
    assert step.what == ', '.join(f'base_{k}' for k in moving)
    device = 'the measuring devices' if len(moving) > 1 else 'the measuring device, its zero'
    assert str(step).startswith(f"{device} or the robot's foot moved by")
    are = 'are' if len(moving) > 1 else 'is'
    assert f'{step.what} {are} outdated' in str(replace(step, unused=moved.FROM_THERE))


def test_of_moves_that_explain_the_same_one_place_is_named():
    """Sockets visited one after another: the later ones are where the ball is found."""
    true, problem = cell(1, noise=3e-5, count=12)
    sets = [e.at((12 * k + np.arange(12)) * 10**9) for k, e in enumerate(problem.sets)]
    points = np.broadcast_to(true.forward(sets[3].joints)[:, :3, 3].mean(axis=0), (12, 3)).copy()
    points[7:] += [1e-3, 0.0, 0.0]
    sets[3] = replace(sets[3], joints=led_to(true, sets[3].joints, points))
    step = find_step(fitting.fit(problem.with_sets(sets)))
    assert (step.what, step.sample) == (sets[3].base, 7)
    assert step.thing == "the socket or the robot's foot"


def test_another_load_from_the_first_pose_on_is_no_step_of_an_arm_that_is_held():
    """Measured in one place, then in another, where the weight bends it more."""
    load = {f'{joint}.gravity_wrist_3_joint': 1e-3 for joint in UR10E.joint_names[1:4]}
    rng = np.random.default_rng(0)
    true = arm(rng, 0.0).with_effects(list(load)).with_offsets(load)
    q = 0.1 * UR10E.random_joints(COUNT, rng)
    q[AT:, 1:3] += 1.5
    seen = measure(true, q, rng, *NOISE)
    fitted = fitting.fit(Problem(UR10E, seen, fixed=('*_joint.*',), **SIGMAS))
    assert find_step(fitted) is None


@pytest.mark.parametrize(('size', 'found'), [(0.0, None), (1e-3, ('base', 50))])
def test_a_load_that_explains_more_than_a_step_is_none(size, found):
    """Four stations, the first of which would explain 0.69 of what bends as a move."""
    load = {f'{joint}.gravity_wrist_3_joint': 2e-3 for joint in UR10E.joint_names[1:4]}
    rng = np.random.default_rng(2)
    true = arm(rng).with_effects(list(load)).with_offsets(load)
    q = np.repeat(UR10E.random_joints(4, rng), 20, axis=0)
    q[:, 3:] += rng.uniform(-0.3, 0.3, (80, 3))
    seen = measure(true, q, rng, *NOISE)
    positions = seen.positions + np.outer(np.arange(len(q)) >= 50, size * np.array([1, 0, 0]))
    step = find_step(fitting.fit(Problem(UR10E, replace(seen, positions=positions), **SIGMAS)))
    assert (step and (step.what, step.sample)) == found


@pytest.mark.parametrize(('seed', 'size', 'found'), [(10, 1e-3, ('base', 25)), (11, 0.0, None)])
def test_a_load_hides_no_move_that_the_arm_imitates_nor_looks_like_one(seed, size, found):
    load = {f'{joint}.gravity_wrist_3_joint': 5e-3 for joint in UR10E.joint_names[1:4]}
    rng = np.random.default_rng(seed)
    true = arm(rng).with_effects(list(load)).with_offsets(load)
    seen = measure(true, at_stations(rng, 3), rng, *NOISE, oriented=bool(seed % 2))
    positions = seen.positions + np.outer(np.arange(len(seen)) >= 25, size * np.array([1, 0, 0]))
    moved = replace(seen, positions=positions)
    step = find_step(fitting.fit(Problem(UR10E, moved, **SIGMAS)))
    assert (step and (step.what, step.sample)) == found


@pytest.mark.parametrize(('share', 'apart'), [(0.98, True), (1.02, False)])
def test_places_are_apart_where_a_plane_explains_nearly_all_of_it(share, apart):
    """Of eight poses of one joint: by the adjusted share of the squares, with six freedoms."""
    after = np.arange(8) >= 4
    beside = np.array([1.0, -1.0, -1.0, 1.0] * 2)
    rest = share * EXCEPTION * 6.0 / 7.0
    joints = np.sqrt(1.0 - rest) * (2.0 * after - 1.0) + np.sqrt(rest) * beside
    assert steps._separable(joints[:, np.newaxis], after) == apart


@pytest.mark.parametrize(('places', 'turned'), [([15], 'b'), ([15, 30], 'b'), ([15, 20], '')])
def test_a_joint_that_seldom_moves_is_told_if_it_moved_just_before_a_step(places, turned):
    """Of 96 rasters of arms whose first axis wobbles 18 were told a step, 16 where it turned."""
    rng = np.random.default_rng(0)
    joints = np.column_stack([rng.normal(size=45), np.repeat([0.0, 1.0, 2.0], 15)])
    chain = SimpleNamespace(joint_names=('a', 'b'))
    scanned = SimpleNamespace(
        sets=[None], numbers=[np.arange(45)], joints=lambda _: joints, chain=chain
    )
    assert steps._turned(scanned, places) == turned
