# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E, fitted

from calib_ros import Observations, Problem, identify, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.decision.residuals import residuals
from calib_ros.errors import InputError
from calib_ros.kinematics import se3

EXACT = 1e-9


def wire(chain, count, rng, base='base', tool='tool', noise=0.0):
    """Return distances from the origin of a world to the target, and no positions at all."""
    joints = chain.random_joints(count, rng)
    poses = chain.forward(joints, base=base, tool=tool)
    lengths = np.linalg.norm(poses[:, :3, 3], axis=1) + rng.normal(scale=noise, size=count)
    seen = Observations.from_arrays(joints, np.zeros((count, 3)))
    return replace(seen, distances=lengths, base=base, tool=tool)


def between(chain, count, rng, base='base', tool='tool', noise=(0.0, 0.0), oriented=True):
    """Return measured poses between two frames of a chain."""
    view = replace(chain, base=chain.frame(base), tool=chain.frame(tool), frames=())
    seen = measure(view, chain.random_joints(count, rng), rng, *noise, oriented=oriented)
    return replace(seen, base=base, tool=tool)


def framed(rng, **reach):
    """Return an arm with errors and more frames, each anywhere within its reach [m]."""
    true = faulty(UR10E, Cell(), rng)
    for name, size in reach.items():
        true = true.with_frame(name, random_frame(rng, size))
    return true


def worst(found, unseen):
    """Return the largest error of position or distance [m], and of orientation [rad]."""
    left = residuals(found, unseen)
    turn = left.orientation[~np.isnan(left.orientation)]
    return np.abs(left.position).max(), np.abs(turn).max(initial=0.0)


def assert_exact(found, *unseen):
    for each in unseen:
        position, turn = worst(found, each)
        assert position < EXACT
        assert turn < EXACT


@pytest.mark.parametrize('seed', range(2))
def test_distances_alone_find_the_arm_up_to_a_turn_of_the_world(seed):
    """Neither base nor tool is known; turning the cell about the wire's exit changes nothing."""
    rng = np.random.default_rng(seed)
    true = faulty(UR10E, Cell(), rng)
    result = identify(Problem(UR10E, wire(true, 150, rng)))
    assert result.converged
    assert result.rank == 27 - 3
    assert {f'base.r{axis}' for axis in 'xyz'} <= set(result.unidentifiable)
    assert {f'tool.r{axis}' for axis in 'xyz'} <= set(result.unidentifiable)
    assert not result.not_excited
    q = UR10E.random_joints(200, rng)
    found, wanted = (chain.forward(q)[:, :3, 3] for chain in (result.chain, true))
    turn = se3.nearest_rotation(wanted.T @ found)
    np.testing.assert_allclose(found @ turn.T, wanted, rtol=0, atol=1e-8)


def test_distances_with_a_known_base_leave_no_gauge_of_the_world(rng):
    true = faulty(UR10E, Cell(), rng)
    known = replace(UR10E, base=replace(true.base, fixed=True))
    result = identify(Problem(known, wire(true, 200, rng)))
    # of the 27 by position without the 6 of the base, but with theta and d of the first joint
    assert not any(name.startswith('base') for name in result.names)
    assert result.rank == 27 - 6 + 2
    assert_exact(result.chain, wire(true, 200, rng))


@pytest.mark.parametrize('held', [True, False])
def test_a_known_place_of_a_device_does_not_tell_the_delay_of_its_stamps(held, rng):
    true = faulty(UR10E, Cell(), rng)
    seen, speed = between(true, 60, rng, noise=NOISE), rng.uniform(-0.5, 0.5, (60, 6))
    late = replace(seen, joints=seen.joints + 4e-3 * speed, velocity=speed)
    chain = replace(UR10E, base=replace(true.base, fixed=True)) if held else UR10E
    problem = Problem(chain, late, **SIGMAS)
    assert problem.model.base.delay == 0.0  # at first
    result = identify(problem)
    assert result.chain.base.delay == pytest.approx(4e-3, abs=2e-4)
    assert result.accepted
    assert result.noise.consistent


def test_noisy_distances_are_honest_about_their_size(rng):
    true = faulty(UR10E, Cell(), rng)
    seen = wire(true, 300, rng, noise=NOISE[0])
    result = identify(Problem(UR10E, seen, sigma_position=NOISE[0]))
    assert result.noise.position == pytest.approx(1.0, abs=0.15)
    assert result.noise.orientation is None
    assert result.noise.consistent
    assert result.accepted
    left = residuals(result.chain, wire(true, 500, rng)).position[:, 0]
    # 24 parameters from 300 distances: about sqrt(24 / 300) = 0.3 of the noise, wherever one looks
    assert np.sqrt(np.mean(left**2)) < 0.5 * NOISE[0]


def one_sided(count, rng):
    return rng.uniform(5e-3, 50e-3, count)


GROSS = {
    'scattered': lambda count, rng: rng.choice([-1.0, 1.0], count) * one_sided(count, rng),
    'one-sided': one_sided,
    'all alike': lambda count, rng: np.repeat(one_sided(1, rng), count),
    'a metre': lambda count, rng: rng.uniform(0.3, 1.5, count),
}


@pytest.mark.parametrize(
    ('count', 'share', 'errors', 'seed'),
    [(200, 0.1, 'all alike', 0), *((100, 0.3, each, k % 2) for k, each in enumerate(GROSS))],
)
def test_distances_of_gross_error_are_named_and_do_no_harm(count, share, errors, seed):
    """A wire that slipped from its hook, or another one measured."""
    rng = np.random.default_rng(seed)
    true = faulty(UR10E, Cell(), rng)
    seen = wire(true, count, rng, noise=NOISE[0])
    wrong = rng.choice(count, round(share * count), replace=False)
    lengths = seen.distances.copy()
    lengths[wrong] = np.abs(lengths[wrong] + GROSS[errors](len(wrong), rng))
    result = identify(Problem(UR10E, replace(seen, distances=lengths), sigma_position=5e-5))
    assert result.accepted
    assert {outlier.sample for outlier in result.outliers} == set(wrong.tolist())
    good = seen.select(np.setdiff1d(np.arange(count), wrong))
    best = fitted(Problem(UR10E, good, sigma_position=5e-5, loss='none'))
    unseen = wire(true, 300, rng)
    error, least = (
        np.sqrt(np.mean(residuals(each.chain, unseen).position[:, 0] ** 2))
        for each in (result, best)
    )
    assert error < 1.1 * least


def posed(base='base', tool='tool', oriented=True):
    return lambda chain, count, rng: between(chain, count, rng, base, tool, oriented=oriented)


def wired(base='base', tool='tool'):
    return lambda chain, count, rng: wire(chain, count, rng, base, tool)


TARGETS = ('tool', 'tool_2', 'tool_3')


@pytest.mark.parametrize(
    ('reach', 'kinds', 'rank'),
    [
        ({'tool_2': 0.3, 'tool_3': 0.3}, [posed(tool=each) for each in TARGETS], 30 + 2 * 6),
        (
            {'tool_2': 0.3, 'tool_3': 0.3},
            [posed(tool=each, oriented=False) for each in TARGETS],
            27 + 2 * 3,
        ),
        ({'base_B': 2.0}, [posed(), posed('base_B')], 30 + 6),
        ({'base_B': 2.0}, [posed(oriented=False), posed('base_B', oriented=False)], 27 + 6),
        # a wire from somewhere else than the tracker's origin, to another point
        (
            {'base_wire': 2.0, 'tool_hook': 0.2},
            [posed(), wired('base_wire', 'tool_hook')],
            30 + 3 + 3,
        ),
        # session A by pose, B by position of another target, B by a wire to the first one
        (
            {'base_B': 2.0, 'tool_2': 0.3},
            [posed(), posed('base_B', 'tool_2', oriented=False), wired('base_B')],
            30 + 6 + 3,
        ),
        # a set that knows nothing of the frames named base and tool
        ({'base_B': 2.0, 'tool_2': 0.3}, [posed('base_B', 'tool_2')], 30),
    ],
)
def test_targets_sessions_and_kinds_in_one_problem(reach, kinds, rank, rng):
    true = framed(rng, **reach)
    first, *more = (seen(true, 50, rng) for seen in kinds)
    result = identify(Problem(UR10E, first, more=more))
    assert result.converged
    assert result.rank == rank
    assert not result.not_excited
    assert len(result.fitted.judged) == 50 * len(kinds)
    assert_exact(result.chain, *(seen(true, 100, rng) for seen in kinds))


def test_a_known_frame_of_a_second_session_is_kept(rng):
    fixed = replace(random_frame(rng, 1.0), fixed=True)
    nominal = UR10E.with_frame('base_B', fixed)
    true = faulty(UR10E, Cell(), rng).with_frame('base_B', fixed)
    first, second = (between(true, 40, rng, base=base) for base in ('base', 'base_B'))
    result = identify(Problem(nominal, first, more=(second,)))
    np.testing.assert_array_equal(result.chain.frame('base_B').matrix, fixed.matrix)
    assert not any(name.startswith('base_B') for name in result.names)
    assert_exact(result.chain, *(between(true, 100, rng, base=b) for b in ('base', 'base_B')))


def test_held_out_poses_have_frames_too(rng):
    true = framed(rng, base_B=2.0)
    first, second = (between(true, 40, rng, base=base, noise=NOISE) for base in ('base', 'base_B'))
    unseen = between(true, 30, rng, base='base_B', noise=NOISE)
    result = identify(Problem(UR10E, first, more=(second,), held_out=unseen))
    assert result.accepted
    assert result.validation.figures[1].max_mm < 0.5


@pytest.mark.parametrize('unit', [1e3, 1e2, 1.0 / 0.0254])
def test_distances_that_no_arm_moves_by_are_no_metres(rng, unit):
    """Told before a fit that would not end: it took minutes, and named a moved device."""
    true = faulty(UR10E, Cell(), rng)
    seen = wire(true, 60, rng, noise=NOISE[0])
    wrong = replace(seen, distances=unit * seen.distances)
    with pytest.raises(InputError, match=r'distances vary by .* are they in metres \(--length\)'):
        Problem(UR10E, wrong, **SIGMAS)
    typo = seen.distances.copy()
    typo[::6] *= unit
    Problem(UR10E, replace(seen, distances=typo), **SIGMAS)  # gross errors are for the fit
    straight = load_chain('kuka_iiwa14')  # all of its lengths are along its axes
    Problem(straight, wire(straight, 60, rng), **SIGMAS)


def test_joint_values_in_degrees_are_told_beside_distances(rng):
    """The fit ended with 830 mm, and told to check the chain first."""
    seen = wire(faulty(UR10E, Cell(), rng), 60, rng, noise=NOISE[0])
    wrong = replace(seen, joints=np.degrees(seen.joints))
    with pytest.raises(InputError, match=r'^many joint values .* \(--joint-angle deg\)'):
        Problem(UR10E, wrong, **SIGMAS)
    with pytest.raises(InputError, match=r'\(--length\)\? Also, many .* \(--joint-angle deg\)'):
        Problem(UR10E, replace(wrong, distances=1e3 * seen.distances), **SIGMAS)
    endless = seen.joints.copy()
    endless[:, 4:] += 20 * np.pi  # a third of the joints, as the flange of a SCARA
    Problem(UR10E, replace(seen, joints=endless), **SIGMAS)
