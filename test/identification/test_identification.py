# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from fits import fitted
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.errors import ConfigError, InputError, TooFewObservationsError, UnknownNameError
from calib_ros.identification import leastsquares
from calib_ros.identification.identifiability import structurally_independent
from calib_ros.identification.identification import Problem, identify, residuals
from calib_ros.identification.leastsquares import (
    System,
    minimise,
    normal_equations,
    triangular_factor,
)
from calib_ros.identification.observations import Observations
from calib_ros.identification.samples import BLOCK, Samples
from calib_ros.identification.start import _shortest, start_frames
from calib_ros.kinematics import inverse, se3
from calib_ros.kinematics.chain import Chain, Frame, Joint
from calib_ros.kinematics.chain_file import load_chain

UR10E = load_chain('ur10e')


def random_arm(rng, joints):
    """Return a revolute arm with arbitrary lengths and twists, none nearly parallel."""
    rows = tuple(
        Joint(
            f'joint_{k + 1}',
            a=rng.uniform(-0.5, 0.5),
            alpha=rng.choice([-1, 1]) * rng.uniform(0.3, np.pi - 0.3),
            d=rng.uniform(-0.5, 0.5),
            theta=rng.uniform(-np.pi, np.pi),
            sign=int(rng.choice([-1, 1])),
        )
        for k in range(joints)
    )
    return Chain('random', str(rng.choice(['standard', 'modified'])), rows)


def worst_prediction(found, true, rng):
    """Return the largest position error [m] and turn [rad] on poses that were not fitted."""
    joints = true.random_joints(200, rng)
    left = residuals(found, measure(true, joints, rng))
    return np.abs(left.position).max(), np.abs(left.orientation).max()


@given(st.integers(0, 2**32 - 1), st.sampled_from([6, 7]))
@settings(max_examples=12)
def test_noise_free_poses_give_exact_predictions(seed, joints):
    rng = np.random.default_rng(seed)
    nominal = random_arm(rng, joints)
    true = faulty(nominal, Cell(), rng)
    seen = measure(true, nominal.random_joints(60, rng), rng)
    result = identify(Problem(nominal, seen))
    assert result.converged
    assert result.rank == 4 * joints + 6
    position, turn = worst_prediction(result.chain, true, rng)
    assert position < 1e-9
    assert turn < 1e-9


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=12)
def test_noise_free_positions_give_exact_predictions(seed):
    rng = np.random.default_rng(seed)
    nominal = random_arm(rng, 6)
    true = faulty(nominal, Cell(), rng)
    seen = measure(true, nominal.random_joints(80, rng), rng, oriented=False)
    result = identify(Problem(nominal, seen))
    assert result.converged
    assert result.rank == 27
    assert worst_prediction(result.chain, true, rng)[0] < 1e-9


def test_gauge_freedoms_of_a_six_axis_arm_are_named():
    rng = np.random.default_rng(0)
    true = faulty(UR10E, Cell(), rng)
    pan, wrist = 'shoulder_pan_joint', 'wrist_3_joint'
    last = {f'{wrist}.{kind}' for kind in ('a', 'alpha', 'd', 'theta')}
    gauges = {f'{pan}.d', f'{pan}.theta'} | last
    joints = UR10E.random_joints(60, rng)
    by_pose = identify(Problem(UR10E, measure(true, joints, rng)))
    assert by_pose.rank == 30
    assert set(by_pose.unidentifiable) == gauges
    by_position = identify(Problem(UR10E, measure(true, joints, rng, oriented=False)))
    assert by_position.rank == 27
    assert set(by_position.unidentifiable) == gauges | {'tool.rx', 'tool.ry', 'tool.rz'}
    assert not by_position.not_excited


@pytest.mark.parametrize('oriented', [True, False])
def test_known_frames_leave_the_first_and_last_link_identifiable(oriented):
    rng = np.random.default_rng(1)
    frames = {key: random_frame(rng, 0.5) for key in ('base', 'tool')}
    nominal = replace(UR10E, **{k: replace(frame, fixed=True) for k, frame in frames.items()})
    offsets = {'shoulder_pan_joint.theta': 2e-3, 'wrist_3_joint.a': 1e-3, 'elbow_joint.beta': 1e-3}
    true = nominal.with_offsets(offsets)
    seen = measure(true, UR10E.random_joints(60, rng), rng, oriented=oriented)
    result = identify(Problem(nominal, seen))
    assert {name for name in result.names if name.startswith(('base', 'tool'))} == set()
    found = {p.name: p.offset for p in result.parameters}
    for name in ('shoulder_pan_joint.theta', 'elbow_joint.beta'):
        assert found[name] == pytest.approx(offsets[name], abs=1e-9)
    np.testing.assert_array_equal(result.chain.base.matrix, frames['base'].matrix)
    assert worst_prediction(result.chain, true, rng)[0] < 1e-9


@pytest.mark.parametrize('oriented', [True, False])
@pytest.mark.parametrize('axis', [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)])
def test_frames_turned_by_half_a_turn_need_no_guess(axis, oriented):
    rng = np.random.default_rng(2)
    turn = np.array(axis) / np.linalg.norm(axis)
    matrix = np.eye(4)
    matrix[:3, :3] = 2.0 * np.outer(turn, turn) - np.eye(3)
    true = replace(faulty(UR10E, Cell(), rng), base=Frame(matrix), tool=Frame(matrix))
    seen = measure(true, UR10E.random_joints(40, rng), rng, oriented=oriented)
    assert worst_prediction(identify(Problem(UR10E, seen)).chain, true, rng)[0] < 1e-9


def test_a_wrong_initial_frame_does_no_harm():
    rng = np.random.default_rng(3)
    true = faulty(UR10E, Cell(), rng)
    misled = replace(UR10E, base=random_frame(rng, 5.0), tool=random_frame(rng, 1.0))
    for oriented in (True, False):
        seen = measure(true, UR10E.random_joints(40, rng), rng, oriented=oriented)
        assert worst_prediction(identify(Problem(misled, seen)).chain, true, rng)[0] < 1e-9


NO_PRIOR = {'*_joint.*': 1e6}
"""As good as none, but given: so none is told by the data."""


def test_the_minimum_is_that_of_an_independent_solver():
    """Hold the cost against scipy on the residual written out, with outsize errors and noise."""
    rng = np.random.default_rng(4)
    true = faulty(UR10E, Cell(), rng)
    seen = measure(true, UR10E.random_joints(50, rng), rng, 2e-3, 2e-2)
    result = identify(
        Problem(
            UR10E,
            seen,
            sigma_position=1e-3,
            sigma_orientation=2e-2,
            loss='none',
            priors=NO_PRIOR,
        )
    )

    def weighted(x):
        left = residuals(result.before.with_offsets(dict(zip(result.names, x, strict=True))), seen)
        return np.concatenate([left.position.ravel() / 1e-3, left.orientation.ravel() / 2e-2])

    other = least_squares(weighted, np.zeros(result.rank), x_scale='jac', xtol=1e-14, gtol=1e-14)
    left = weighted([result.chain.offset(name, result.before) for name in result.names])
    assert left @ left == pytest.approx(2.0 * other.cost, rel=1e-10)


def still_joint(name, seed):
    """Return a start and its system: a joint within 0.3 mrad, positions of 0.5 mm noise."""
    nominal, rng = load_chain(name), np.random.default_rng(seed)
    q = rng.uniform(-2.5, 2.5, (60, len(nominal.joints)))
    q[:, 1] = 1.0 + rng.uniform(-3e-4, 3e-4, 60)
    seen = measure(faulty(nominal, Cell(), rng), q, rng, 5e-4, oriented=False)
    problem = Problem(nominal, seen)
    start = start_frames(problem.model, problem.sets, 1e-4, 1e-4, 'none')
    names = structurally_independent(problem.model, problem.free, problem.kinds)
    return start, names, problem.system(problem.sets)


def test_a_long_curved_valley_is_followed_to_its_end():
    """Condition 3e4: the best parameters are far away, and steps must be short."""
    start, names, system = still_joint('kuka_iiwa14', 1)
    fit = minimise(start, names, system)
    assert fit.converged
    assert 50 < fit.iterations < 400
    early = minimise(start, names, system, iterations=50)
    assert not early.converged
    assert fit.normal.cost < (1.0 - 1e-3) * early.normal.cost
    again = normal_equations(fit.chain, names, system)
    left = np.linalg.solve(again.matrix, again.gradient)
    assert left @ again.gradient < 1e-9 * again.cost


def test_a_fit_without_progress_ends_and_says_so(monkeypatch):
    start, names, system = still_joint('ur10e', 0)
    stuck = normal_equations(start, names, system)
    monkeypatch.setattr(leastsquares, 'normal_equations', lambda *_: stuck)
    fit = minimise(start, names, system)
    assert not fit.converged
    assert fit.iterations < 200
    worse = replace(stuck, cost=2.0 * stuck.cost)
    costs = iter([stuck])
    monkeypatch.setattr(leastsquares, 'normal_equations', lambda *_: next(costs, worse))
    fit = minimise(start, names, system)
    assert not fit.converged
    assert fit.iterations < 200
    assert fit.chain is start


@pytest.mark.parametrize('shape', ['line', 'circle', 'volume'])
@pytest.mark.parametrize('oriented', [True, False])
@pytest.mark.parametrize('jitter', [0.0, 1e-4])
def test_one_orientation_leaves_the_tool_where_it_was(shape, oriented, jitter):
    """Base and tool trade without bounds there: the shortest tool is taken, and is named."""
    nominal, rng = load_chain('ur10e'), np.random.default_rng(0)
    bare, t = replace(nominal, base=Frame(), tool=Frame()), np.linspace(-1.0, 1.0, 60)
    q = np.array([0.3, -1.2, 1.5, -0.8, 1.2, 0.4])
    shift = {
        'line': np.outer(t, [1.0, 0.3, 0.2]),
        'circle': np.column_stack([np.cos(3.0 * t), np.sin(3.0 * t), 0.0 * t]),
        'volume': rng.uniform(-1.0, 1.0, (60, 3)),
    }[shape]
    poses = bare.forward(q[np.newaxis]).repeat(60, axis=0)
    poses[:, :3, 3] += 0.15 * shift
    found = inverse.solve(bare, poses, q[np.newaxis].repeat(60, axis=0))
    assert found.converged.all()
    joints = found.joints + rng.normal(scale=jitter, size=found.joints.shape)
    true = faulty(nominal, Cell(), rng)
    seen = measure(true, joints, rng, 5e-5, 2e-4, oriented=oriented)
    result = identify(Problem(nominal, seen))
    assert result.converged
    assert {'tool.x', 'tool.y', 'tool.z'} <= set(result.not_excited)
    assert not result.accepted
    for chain in (result.before, result.chain):
        assert np.linalg.norm(chain.frame('tool').matrix[:3, 3]) < 0.01
        assert np.linalg.norm(chain.frame('base').matrix[:3, 3]) < 5.0
    assert result.fitted.figures[0].rms_mm < 1.0
    assert result.fitted.figures[1].rms_mm < 0.1


def test_a_tool_that_is_given_stays_where_orientations_do_not_tell():
    rng = np.random.default_rng(0)
    turned = np.tile(np.eye(3), (20, 1, 1))
    assert not _shortest(turned, rng.normal(size=(20, 3)), True).any()
    axis = np.zeros((20, 3))
    axis[:, 2] = np.linspace(0.0, 1.0, 20)  # turns about z tell of x and y alone
    turned = se3.exp_rotation(axis)
    wanted = turned @ np.array([0.1, 0.2, 0.3]) + np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(_shortest(turned, wanted, True), [0.1, 0.2, 0.0], atol=1e-12)
    still = _shortest(turned, wanted - [1.0, 2.0, 3.0], False)
    np.testing.assert_allclose(still, [0.1, 0.2, 0.3], atol=1e-12)


def scores_of(result, true):
    """Return the errors of the parameters in their standard deviations."""
    return [(p.value - true.value(p.name)) / p.std for p in result.parameters if p.std is not None]


def test_standard_deviations_are_honest():
    """Deviations from the truth in units of the standard deviation given: spread 1, seeded."""
    scores = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        true = faulty(UR10E, Cell(), rng)
        seen = measure(true, UR10E.random_joints(40, rng), rng, 5e-5, 5e-5 / 0.3)
        scores += scores_of(fitted(Problem(UR10E, seen)), true)
    assert len(scores) == 40 * 30
    assert np.std(scores) == pytest.approx(1.0, abs=0.06)
    assert abs(np.mean(scores)) < 0.1
    assert np.mean(np.abs(scores) < 1.96) == pytest.approx(0.95, abs=0.015)


def test_each_sample_is_weighted_by_its_own_covariance():
    rng = np.random.default_rng(5)
    true = faulty(UR10E, Cell(), rng)
    joints = UR10E.random_joints(80, rng)
    bad = np.arange(80) % 2 == 0
    clean, noisy = (measure(true, joints, rng, s, 3 * s) for s in (2e-5, 2e-3))
    seen = replace(
        clean,
        positions=np.where(bad[:, None], noisy.positions, clean.positions),
        rotations=np.where(bad[:, None, None], noisy.rotations, clean.rotations),
    )
    sigmas = np.where(bad, 2e-3, 2e-5)[:, None] * [1, 1, 1, 3, 3, 3]
    weighted = replace(seen, covariance=np.einsum('ni,ij->nij', sigmas**2, np.eye(6)))

    def fit(observations):
        return identify(Problem(UR10E, observations, loss='none'))

    error = [
        worst_prediction(fit(each).chain, true, np.random.default_rng(9))[0]
        for each in (seen, weighted)
    ]
    assert error[1] < error[0] / 10
    assert identify(Problem(UR10E, weighted)).noise.position == pytest.approx(1.0, abs=0.15)


def test_a_covariance_equal_to_the_settings_changes_nothing():
    rng = np.random.default_rng(6)
    seen = measure(faulty(UR10E, Cell(), rng), UR10E.random_joints(40, rng), rng, 1e-4, 1e-4)
    sigmas = np.repeat([2e-4, 5e-4], 3)
    explicit = replace(seen, covariance=np.tile(np.diag(sigmas**2), (40, 1, 1)))
    first = identify(Problem(UR10E, seen, sigma_position=2e-4, sigma_orientation=5e-4))
    second = identify(Problem(UR10E, explicit))
    np.testing.assert_allclose(first.chain.table, second.chain.table, rtol=0, atol=1e-10)


def test_poses_and_positions_can_be_mixed():
    rng = np.random.default_rng(7)
    true = faulty(UR10E, Cell(), rng)
    seen = measure(true, UR10E.random_joints(60, rng), rng)
    mixed = replace(seen, oriented=np.arange(60) % 3 == 0)
    result = identify(Problem(UR10E, mixed))
    assert result.rank == 30
    assert worst_prediction(result.chain, true, rng)[0] < 1e-9


def test_held_out_pairs_never_influence_the_fit():
    rng = np.random.default_rng(8)
    true = faulty(UR10E, Cell(), rng)
    seen = measure(true, UR10E.random_joints(50, rng), rng, 1e-4, 1e-4)
    other = measure(true, UR10E.random_joints(50, rng), rng, 1.0, 1.0)
    first, second = (identify(Problem(UR10E, seen, held_out=each)) for each in (seen, other))
    np.testing.assert_array_equal(first.chain.table, second.chain.table)
    assert not second.accepted


def test_no_gain_is_claimed_where_there_is_none():
    for seed in range(12):
        rng = np.random.default_rng(seed)
        arm = replace(UR10E, base=random_frame(rng, 2.0), tool=random_frame(rng, 0.2))
        seen = measure(arm, UR10E.random_joints(40, rng), rng, 1e-4, 3e-4)
        result = identify(Problem(UR10E, seen))
        assert not result.accepted
        assert any('no gain' in text for text in result.refusals)


def test_a_joint_that_stands_still_is_named_and_the_result_not_accepted():
    rng = np.random.default_rng(9)
    true = faulty(UR10E, Cell(), rng)
    joints = UR10E.random_joints(60, rng)
    joints[:, 4] = 0.7
    result = identify(Problem(UR10E, measure(true, joints, rng, 2e-5, 5e-5)))
    assert not result.accepted
    assert any('do not determine' in text for text in result.refusals)
    assert result.not_excited
    kept = {p.name: p.offset for p in result.parameters}
    assert all(kept[name] == 0.0 for name in result.not_excited)


def test_fixed_parameters_stay_nominal():
    rng = np.random.default_rng(10)
    seen = measure(faulty(UR10E, Cell(), rng), UR10E.random_joints(50, rng), rng)
    result = identify(Problem(UR10E, seen, fixed=('*.alpha', 'elbow_joint.a')))
    assert result.rank == 30 - 5 - 1
    status = {p.name: (p.status, p.offset) for p in result.parameters}
    assert status['elbow_joint.a'] == ('fixed', 0.0)
    assert status['wrist_1_joint.alpha'] == ('fixed', 0.0)


def test_prismatic_joints_count_two_parameters():
    rng = np.random.default_rng(11)
    joints = tuple(
        Joint(f'joint_{k}', kind, a=0.3, alpha=alpha, d=0.2, theta=0.3 * k)
        for k, (kind, alpha) in enumerate(
            [('prismatic', 1.2), ('revolute', 1.1), ('revolute', -1.3), ('prismatic', 0.9)]
        )
    )
    nominal = Chain('gantry', 'standard', joints)
    true = faulty(nominal, Cell(), rng)
    result = identify(Problem(nominal, measure(true, nominal.random_joints(60, rng), rng)))
    assert result.rank == 4 * 2 + 2 * 2 + 6
    assert worst_prediction(result.chain, true, rng)[0] < 1e-9


def test_normal_equations_and_triangular_factor_agree_over_blocks():
    rng = np.random.default_rng(12)
    true = faulty(UR10E, Cell(), rng)
    seen = measure(true, UR10E.random_joints(2 * BLOCK + 7, rng), rng, 1e-4, 1e-4)
    names = UR10E.parameter_names
    system = System((Samples(seen, 1e-4, 3e-4),))
    normal = normal_equations(true, names, system)
    factor = triangular_factor(true, names, system)
    scale = np.sqrt(np.diag(normal.matrix))
    difference = (factor.T @ factor - normal.matrix) / np.outer(scale, scale)
    assert np.abs(difference).max() < 1e-12
    left = residuals(true, seen)
    cost = ((left.position / 1e-4) ** 2).sum() + ((left.orientation / 3e-4) ** 2).sum()
    assert normal.cost == pytest.approx(cost, rel=1e-10)


def test_too_few_pairs_say_how_many_are_needed():
    rng = np.random.default_rng(13)
    seen = measure(UR10E, UR10E.random_joints(4, rng), rng)
    with pytest.raises(TooFewObservationsError, match=r'4 measured configurations .* at least 5'):
        identify(Problem(UR10E, seen))
    same = seen.select(np.zeros(50, dtype=int))
    with pytest.raises(TooFewObservationsError, match='1 measured configurations'):
        identify(Problem(UR10E, same))


def test_problems_that_make_no_sense_are_refused():
    rng = np.random.default_rng(14)
    seen = measure(UR10E, UR10E.random_joints(20, rng), rng)
    with pytest.raises(UnknownNameError, match='elbow_joint'):
        Problem(UR10E, seen, fixed=('elbow.a',))
    with pytest.raises(ConfigError, match='fixed: true'):
        Problem(UR10E, seen, fixed=('base.x',))
    with pytest.raises(ConfigError, match='sigma_position'):
        Problem(UR10E, seen, sigma_position=0.0)
    with pytest.raises(InputError, match='6 joints'):
        Problem(UR10E, Observations.from_arrays(np.zeros((5, 7)), np.zeros((5, 3))))


def test_the_chain_file_of_another_robot_is_not_accepted():
    rng = np.random.default_rng(15)
    true = faulty(load_chain('ur5e'), Cell(), rng)
    seen = measure(true, UR10E.random_joints(60, rng), rng, 2e-5, 5e-5)
    result = identify(Problem(UR10E, seen))
    assert not result.accepted
    assert any('right chain file' in text for text in result.refusals)


def bent(chain, rng, length=5e-4, angle=1e-3):
    """Return the arm as a function q -> poses, every link bent and shifted in all six directions.

    Unlike `faulty`, it asks nothing of the model: what it cannot express, no fit will find.
    """
    shifts = rng.normal(scale=length, size=(len(chain.joints) + 1, 3))
    turns = se3.exp_rotation(rng.normal(scale=angle, size=(len(chain.joints) + 1, 3)))
    errors = se3.transform(turns, shifts)
    frames = [random_frame(rng, 1.0).matrix for _ in range(2)]

    def poses(q):
        pose = np.broadcast_to(frames[0] @ errors[-1], (len(q), 4, 4))
        for k, joint in enumerate(chain.joints):
            link = Chain('link', chain.convention, (joint,)).forward(q[:, k : k + 1])
            pose = (
                pose @ link @ errors[k]
                if chain.convention == 'standard'
                else pose @ (errors[k] @ link)
            )
        return pose @ frames[1]

    return poses


def architectures():
    straight = {'a': 0.3, 'd': 0.1}
    yield (
        'SCARA',
        'standard',
        [
            Joint('j1', a=0.375),
            Joint('j2', a=0.275),
            Joint('j3', 'prismatic', lower=-0.3, upper=0.0),
            Joint('j4'),
        ],
    )
    for convention, to_wrist in (('standard', 0.0), ('modified', np.pi / 2)):
        yield (
            'gantry',
            convention,
            [
                Joint('j1', 'prismatic', alpha=np.pi / 2),
                Joint('j2', 'prismatic', alpha=np.pi / 2, theta=np.pi / 2),
                Joint('j3', 'prismatic', alpha=to_wrist),
                Joint('j4', alpha=np.pi / 2, **straight),
                Joint('j5', alpha=-np.pi / 2, **straight),
                Joint('j6', **straight),
            ],
        )
        for tilt in (0.0, np.radians(1.0), np.radians(4.0)):
            yield (
                f'parallel but {tilt:.3f}',
                convention,
                [
                    Joint('j1', alpha=np.pi / 2, **straight),
                    Joint('j2', alpha=tilt, **straight),
                    Joint('j3', alpha=tilt, **straight),
                    Joint('j4', alpha=np.pi / 2, **straight),
                    Joint('j5', alpha=-np.pi / 2, **straight),
                    Joint('j6', alpha=tilt, **straight),
                ],
            )


@pytest.mark.parametrize(
    ('convention', 'joints'),
    [pytest.param(c, tuple(joints), id=f'{name}, {c}') for name, c, joints in architectures()],
)
def test_the_model_is_complete_for_every_architecture(convention, joints):
    rng = np.random.default_rng(16)
    nominal = Chain('arm', convention, joints)
    poses = bent(nominal, rng)
    q = nominal.random_joints(60, rng)
    true = poses(q)
    result = identify(
        Problem(nominal, Observations.from_arrays(q, true[:, :3, 3], true[:, :3, :3].copy()))
    )
    prismatic = sum(joint.type == 'prismatic' for joint in joints)
    assert result.rank == 4 * (len(joints) - prismatic) + 2 * prismatic + 6
    unseen = nominal.random_joints(100, rng)
    error = result.chain.forward(unseen)[:, :3, 3] - poses(unseen)[:, :3, 3]
    assert np.abs(error).max() < 1e-9
    lengths = [p.offset for p in result.parameters if p.name.kind in ('a', 'd')]
    assert np.abs(lengths).max() < 0.02  # nothing absurd


def test_a_program_that_runs_in_a_loop_is_judged_as_one_lap():
    rng = np.random.default_rng(17)
    true = faulty(UR10E, Cell(), rng)
    few = UR10E.random_joints(7, rng)
    laps = measure(true, np.tile(few, (10, 1)), rng, 2e-4, 2e-3)
    assert len(np.unique(laps.configurations)) == 7
    result = identify(Problem(UR10E, laps))
    assert not result.accepted
    assert any('too few configurations' in text for text in result.refusals)


def test_errors_shared_by_a_configuration_count_once():
    """Three pairs at each configuration with the same error tell no more than one."""
    scores = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        true = faulty(UR10E, Cell(), rng)
        once = measure(true, UR10E.random_joints(40, rng), rng, 1e-4, 1e-4 / 0.3)
        thrice = once.select(np.repeat(np.arange(40), 3))
        scores += scores_of(fitted(Problem(UR10E, thrice)), true)
    assert np.std(scores) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(('position', 'orientation'), [(1e-4, 3e-5), (1e-5, 1e-3)])
def test_standard_deviations_follow_the_noise_that_is_there(position, orientation):
    scores = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        true = faulty(UR10E, Cell(), rng)
        seen = measure(true, UR10E.random_joints(40, rng), rng, position, orientation)
        result = fitted(Problem(UR10E, seen))
        assert not result.noise.consistent
        scores += scores_of(result, true)
    assert np.std(scores) == pytest.approx(1.0, abs=0.1)


def test_what_another_robot_leaves_is_never_accepted():
    """Seeded arms of another kind with the same number of joints, some of which fit by chance."""
    other, nominal = load_chain('franka_panda'), load_chain('kuka_iiwa14')
    for seed in (3, 16):
        rng = np.random.default_rng(seed)
        true = faulty(other, Cell(), rng)
        seen = measure(true, other.random_joints(60, rng), rng, 5e-5, 2e-4)
        assert not identify(Problem(nominal, seen)).accepted


TOLERANCES = {'*.a': 5e-4, '*.d': 5e-4, '*.alpha': 1e-3, '*.theta': 1e-3, '*.beta': 1e-3}


@pytest.mark.parametrize(
    ('oriented', 'count', 'share'), [(True, 6, 0.4), (False, 8, 0.5), (False, 10, 0.2)]
)
def test_few_poses_and_manufacturing_tolerances_are_judged_by_leaving_out_one(
    oriented, count, share
):
    """Six poses hold as many equations as needed without priors and none to judge by."""
    nominal_errors, errors, estimates, sigmas = [], [], [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        true = faulty(UR10E, Cell(), rng)
        q, unseen = UR10E.random_joints(count, rng), UR10E.random_joints(300, rng)
        seen = measure(true, q, rng, 5e-5, 2e-4, oriented)
        sigmas_given = {'sigma_position': 5e-5, 'sigma_orientation': 2e-4}
        result = identify(Problem(UR10E, seen, priors=TOLERANCES, **sigmas_given))
        assert result.accepted
        assert not result.outliers
        assert result.validated_by.startswith(f'{count}-fold')
        wanted = true.forward(unseen)[:, :3, 3]
        for chain, found in ((result.before, nominal_errors), (result.chain, errors)):
            error = chain.forward(unseen)[:, :3, 3] - wanted
            found.append(1e3 * np.sqrt((error**2).sum(axis=1).mean()))
        estimates.append(result.validation.figures[1].rms_mm)
        sigmas.append(1e3 * np.sqrt((result.predicted_sigma() ** 2).mean()))
    assert np.max(np.divide(errors, nominal_errors)) < share
    # the estimate by fits to one pose less is cautious, the predicted sigma is right
    assert 1.0 < np.median(np.divide(estimates, errors)) < 2.5
    # of effects that so few poses cannot refute it takes account
    assert 0.4 < np.median(np.divide(errors, sigmas)) < 1.35


@pytest.mark.parametrize('priors', [{}, {'*.a': 0.05, '*.alpha': 0.1}])
def test_few_poses_without_priors_that_say_anything_stay_refused(priors):
    rng = np.random.default_rng(0)
    true = faulty(UR10E, Cell(), rng)
    for seen in (
        measure(true, UR10E.random_joints(6, rng), rng, 5e-5, 2e-4),
        measure(true, UR10E.random_joints(10, rng), rng, 5e-5, oriented=False),
    ):
        result = identify(Problem(UR10E, seen, priors=priors))
        assert not result.accepted
        assert result.validation is None


def test_few_poses_and_priors_of_an_arm_without_errors_gain_nothing():
    accepted = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        true = replace(UR10E, base=random_frame(rng, 2.0), tool=random_frame(rng, 0.2))
        seen = measure(true, UR10E.random_joints(8, rng), rng, 5e-5, 2e-4)
        accepted += identify(Problem(UR10E, seen, priors=TOLERANCES)).accepted
    assert accepted <= 2  # of 10 by a one-sided test of 95 %
