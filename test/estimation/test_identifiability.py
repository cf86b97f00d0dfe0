# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, SCARA, SIGMAS, UR10E, measured_arm
from scipy import stats
from scipy.spatial.transform import Rotation

from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.estimation.gauges import best_imitation, identifiable_and_held
from calib_ros.estimation.identifiability import independent, structurally_independent
from calib_ros.estimation.observability import correlated, observability, trades
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.uncertainty import covariance
from calib_ros.identification.identification import identify
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Frame, Joint
from calib_ros.kinematics.inverse import solve
from calib_ros.kinematics.jacobian import ErrorModel

ALIGNED = ('shoulder_lift_joint', 'elbow_joint', 'wrist_1_joint')


def assert_trades_hold(result, q, oriented=True):
    """What is left out must be the sum of its partners alone, at the joint values given."""
    rows = 6 if oriented else 3
    for name, partners in result.gauges.items():
        columns = ErrorModel(result.chain, [name, *partners]).jacobian(q)[:, :rows]
        columns = columns.reshape(-1, 1 + len(partners))
        shares = np.linalg.lstsq(columns[:, 1:], columns[:, 0], rcond=None)[0]
        left = columns[:, 0] - columns[:, 1:] @ shares
        assert np.linalg.norm(left) <= 5e-3 * np.linalg.norm(columns[:, 0])
        assert np.abs(shares).min(initial=1.0) > 1e-6


@pytest.mark.parametrize('oriented', [True, False])
def test_trades_of_a_six_axis_arm_with_its_frames(oriented, rng):
    *_, seen = measured_arm(rng, 60, oriented=oriented)
    result = identify(Problem(UR10E, seen, **SIGMAS))
    gauges = {name: set(partners) for name, partners in result.gauges.items()}
    assert gauges['wrist_3_joint.d'] == {'tool.z'}
    assert gauges['wrist_3_joint.a'] == {'tool.x'}
    assert gauges['shoulder_pan_joint.d'] == {'base.x', 'base.y', 'base.z'}  # the base is turned
    assert gauges['shoulder_pan_joint.theta'] == {'base.rx', 'base.ry', 'base.rz'}
    ends = [*UR10E.joints[-1].parameters[:4], *UR10E.joints[0].parameters[2:4]]
    turns = [] if oriented else ['tool.rx', 'tool.ry', 'tool.rz']
    assert set(result.gauges) == set(result.unidentifiable) == {*ends, *turns}
    assert result.rank == (30 if oriented else 27)
    assert not result.not_excited
    if not oriented:
        assert gauges['tool.rx'] == gauges['tool.ry'] == gauges['tool.rz'] == set()
    assert_trades_hold(result, UR10E.random_joints(100, rng), oriented)


def test_an_upright_base_trades_along_one_axis_alone(rng):
    true = replace(faulty(UR10E, Cell(), rng), base=None)
    seen = measure(true, UR10E.random_joints(60, rng), rng)
    gauges = identify(Problem(UR10E, seen)).gauges
    assert gauges['shoulder_pan_joint.d'] == ['base.z']
    assert gauges['shoulder_pan_joint.theta'] == ['base.rz']


@pytest.mark.parametrize('exact', [True, False])
def test_lengths_along_parallel_axes_trade_where_no_tilt_is_modelled(exact, rng):
    nominal = replace(UR10E, parallel=())
    true = faulty(nominal, Cell(), rng)
    if exact:
        true = replace(nominal, base=true.base, tool=true.tool)
    seen = measure(true, UR10E.random_joints(60, rng), rng, *NOISE)
    result = identify(Problem(nominal, seen, **SIGMAS))
    assert result.rank == 28
    for joint in ALIGNED[1:]:
        partners = result.gauges[f'{joint}.d']
        assert 'shoulder_lift_joint.d' in partners
        if exact:
            assert partners == ['shoulder_lift_joint.d']
    assert f'{ALIGNED[0]}.d' in result.names
    assert_trades_hold(result, UR10E.random_joints(100, rng))
    assert result.gauges['wrist_3_joint.d'] == ['tool.z']
    assert result.gauges['elbow_joint.d']


@pytest.mark.parametrize('pi', [3.14159, 3.1416, 3.141])
def test_a_pi_of_few_digits_hides_the_height_of_a_tool_as_well(pi):
    joints = [replace(each, alpha=pi) if each.alpha else each for each in SCARA.joints]
    found, expected = (
        structurally_independent(chain, chain.parameter_names)
        for chain in (replace(SCARA, joints=tuple(joints)), SCARA)
    )
    assert found == expected
    assert 'tool.z' not in found


def test_a_joint_that_stands_still_trades_on_the_poses_measured(rng):
    true = faulty(UR10E, Cell(), rng)
    q = UR10E.random_joints(60, rng)
    q[:, 2] = 0.7
    result = identify(Problem(UR10E, measure(true, q, rng, *NOISE), **SIGMAS))
    assert 'elbow_joint.theta' in result.not_excited
    assert set(result.not_excited) < set(result.gauges)
    first = 'elbow_joint stood still (or was not recorded): the poses do not determine '
    (told,) = [text for text in result.refusals if text.startswith(first)]
    named = {}
    for name in result.not_excited:
        named.setdefault(name.owner, []).append(name.kind)
    every = [f'{owner} ({", ".join(kinds)})' for owner, kinds in named.items()]
    assert told == first + ', '.join(every)
    assert max(map(len, named.values())) > 1
    kept = {p.name: p.offset for p in result.parameters}
    assert all(kept[name] == 0.0 for name in result.not_excited)
    assert_trades_hold(result, q)


def test_a_tool_that_always_points_down_is_named(rng):
    """As at a drill: along its own axis it moves whatever the joints do, as if the base did."""
    places = UR10E.forward(UR10E.random_joints(400, rng))
    turned = rng.uniform([-3.0, np.pi], [3.0, np.pi], (400, 2))
    places[:, :3, :3] = Rotation.from_euler('ZX', turned).as_matrix()
    found = solve(UR10E, places, UR10E.random_joints(400, rng), 'base', 'tool')
    q = found.joints[found.converged][:60]
    seen = measure(faulty(UR10E, Cell(), rng), q, rng, *NOISE)
    seen = Observations.from_arrays(seen.joints, seen.positions)
    result = identify(Problem(UR10E, seen, **SIGMAS))
    told = 'the tool points one way in all poses (tilt it): the poses do not determine tool (z)'
    assert told in result.refusals


def test_a_fixed_partner_makes_its_trade_identifiable(rng):
    tool = replace(random_frame(rng, 0.2), fixed=True)
    nominal = replace(UR10E, tool=tool)
    true = replace(faulty(UR10E, Cell(), rng), tool=tool)
    result = identify(Problem(nominal, measure(true, UR10E.random_joints(60, rng), rng)))
    assert 'wrist_3_joint.d' in result.names
    assert not {name for name in result.gauges if name.startswith('wrist_3')}


def test_a_known_target_near_the_last_axis_leaves_its_length_free(rng):
    """Else a turn and a tilt imitate it by a lever of 2 mm."""
    tool = Frame(se3.transform(np.eye(3), np.array([0.08, 0.002, 0.165])), fixed=True)
    nominal = replace(UR10E, tool=tool)
    true = replace(faulty(UR10E, Cell(), rng), tool=tool).with_offsets({'wrist_3_joint.d': 2e-3})
    q = nominal.random_joints(60, rng)
    result = identify(Problem(nominal, measure(true, q, rng, *NOISE, False), **SIGMAS))
    assert result.accepted
    offset = result.chain.offset('wrist_3_joint.d', nominal)
    assert abs(offset - 2e-3) < 2e-4
    assert 'wrist_3_joint.theta' in result.unidentifiable


@pytest.mark.parametrize('rounded', [0.0, 1e-16])
def test_dependent_columns_by_hand(rounded):
    """Columns of a, b, a + 2 b, nothing, c: the third trades against the first two.

    A weight on the joint's own axis moves nothing, in a URDF by rounding only.
    """
    a, b, c = np.eye(3)
    matrix = np.stack([a, b, a + 2.0 * b, rounded * c, c], axis=1)
    factor = np.zeros((5, 5))
    factor[:3] = matrix
    names = ('a', 'b', 'sum', 'nothing', 'c')
    assert independent(factor, names) == ('a', 'b', 'c')
    assert trades(factor.T @ factor, names, ('a', 'b', 'c')) == {'sum': ['a', 'b'], 'nothing': []}
    swapped = factor[:, [2, 1, 0, 3, 4]]
    others = ('sum', 'b', 'a', 'nothing', 'c')
    assert independent(swapped, others) == ('sum', 'b', 'c')
    assert trades(swapped.T @ swapped, others, ('sum', 'b', 'c'))['a'] == ['sum', 'b']


def test_a_trade_is_named_though_a_fitted_parameter_shows_nowhere():
    """A prior keeps a parameter that no pose depends on; its column is zero."""
    a, b, _ = np.eye(3)
    factor = np.stack([a, np.zeros(3), 2.0 * a], axis=1)
    assert trades(factor.T @ factor, ('a', 'hidden', 'twice'), ('a', 'hidden')) == {'twice': ['a']}
    factor = np.stack([b, np.zeros(3), 2.0 * a], axis=1)
    assert independent(factor, ('b', 'hidden', 'a')) == ('b', 'a')


def test_a_trade_is_named_beside_one_of_far_larger_amounts():
    """Of two fitted axes nearly parallel a small difference takes thousandfold turns."""
    a, b, c = np.eye(3)
    factor = np.stack([a, a + 1e-4 * b, c, b, 2.0 * c], axis=1)
    names = ('one', 'near', 'other', 'across', 'twice')
    assert trades(factor.T @ factor, names, names[:3]) == {
        'across': ['one', 'near'],
        'twice': ['other'],
    }


@pytest.mark.parametrize(
    ('diagonal', 'poses', 'o1', 'o2', 'o3', 'o4', 'o5'),
    [
        ((2.0, 8.0), 4, 4.0 / 2.0, 0.25, 2.0, 0.5, 1.6),
        ((1.0, 1.0, 1.0), 1, 1.0, 1.0, 1.0, 1.0, 1.0 / 3.0),
        ((10.0, 0.1, 1.0), 9, 1.0 / 3.0, 0.01, 0.1, 0.001, 1.0 / 11.1),
    ],
)
def test_observability_indices_by_hand(diagonal, poses, o1, o2, o3, o4, o5, rng):
    turned = np.linalg.qr(rng.normal(size=(len(diagonal),) * 2))[0]
    for matrix in (np.diag(diagonal), turned @ np.diag(diagonal)):
        expected = {'o1': o1, 'o2': o2, 'o3': o3, 'o4': o4, 'o5': o5}
        assert observability(matrix, poses) == pytest.approx(expected)


def test_indices_of_a_problem_are_those_of_its_jacobian(rng):
    *_, seen = measured_arm(rng, 30)
    result = identify(Problem(UR10E, seen, loss='none', **SIGMAS))
    jacobian = ErrorModel(result.chain, result.names).jacobian(seen.joints)
    jacobian = jacobian / np.repeat(NOISE, 3)[:, np.newaxis]
    singular = np.linalg.svd(jacobian.reshape(-1, result.rank), compute_uv=False)
    assert result.observability == pytest.approx(observability(np.diag(singular), 30), rel=1e-3)


def test_correlated_pairs_by_hand():
    matrix = np.array([[4.0, 1.9, 0.0], [1.9, 1.0, -0.95], [0.0, -0.95, 1.0]])
    names = ('a', 'b', 'c')
    assert correlated(matrix, names, 0.9) == (
        ('a', 'b', pytest.approx(0.95)),
        ('b', 'c', pytest.approx(-0.95)),
    )
    assert correlated(matrix, names, 0.96) == ()


def test_the_covariance_of_a_factor_by_hand():
    factor = np.array([[2.0, 1.0], [0.0, 0.5]])
    normal = factor.T @ factor
    np.testing.assert_allclose(covariance(factor), np.linalg.inv(normal), rtol=1e-12)
    # noise of double size has the middle 4 H, and four times the covariance
    np.testing.assert_allclose(
        covariance(factor, 4.0 * normal), 4.0 * np.linalg.inv(normal), rtol=1e-12
    )
    some = factor[1:].T @ factor[1:]  # as of a part that shows some parameters only
    inverse = np.linalg.inv(normal)
    np.testing.assert_allclose(covariance(factor, some), inverse @ some @ inverse, rtol=1e-12)
    # an estimate from a part of all pairs may have directions below zero
    axes = np.linalg.qr(np.random.default_rng(1).normal(size=normal.shape))[0]
    sizes = np.linspace(-0.5, 9.0, len(normal))
    middle = factor.T @ (axes * sizes) @ axes.T @ factor
    root = np.linalg.solve(factor, axes * np.sqrt(np.maximum(sizes, 0.0)))
    np.testing.assert_allclose(covariance(factor, middle), root @ root.T, rtol=1e-9)
    with pytest.raises(np.linalg.LinAlgError):  # not the certainty of zeros
        covariance(factor, np.full_like(normal, np.nan))


@pytest.mark.parametrize(('size', 'level'), [(0.9, 0.5), (0.9, 0.95), (5.0, 0.95)])
def test_the_ellipsoid_is_that_of_the_covariance_of_a_position(size, level, rng):
    """By chi-squared where the sigmas given are right, by F where the noise is estimated.

    The mean error by considered effects counts alike in all directions.
    """
    *_, seen = measured_arm(0, 40, (size * NOISE[0], size * NOISE[1]))
    result = identify(Problem(UR10E, seen, loss='none', **SIGMAS))
    assert result.noise.consistent == (size < 1.0)
    q = UR10E.random_joints(5, rng)
    axes = result.confidence_ellipsoid(q, level)
    found = np.swapaxes(axes, 1, 2) @ axes
    squares = [stats.chi2.ppf(level, 3)] * 2
    if size > 1.0:
        squares = [3.0 * stats.f.ppf(level, 3, each) for each in (240.0, 60.0)]  # numbers in all
    posterior, expected = result.posterior, result.pose_covariance(q)[:, :3, :3]
    mean = ErrorModel(posterior.chain, posterior.names).jacobian(q)[:, :3] @ posterior.shift
    expected -= mean[:, :, None] * mean[:, None] - (mean**2).mean(axis=1)[:, None, None] * np.eye(
        3
    )
    square = np.trace(found, axis1=1, axis2=2) / np.trace(expected, axis1=1, axis2=2)
    assert (square >= squares[0] - 1e-6).all()
    assert (square <= squares[1] + 1e-6).all()
    np.testing.assert_allclose(found / square[:, None, None], expected, rtol=1e-6, atol=1e-15)
    products = axes @ np.swapaxes(axes, 1, 2) / found.max()
    lengths = np.einsum('nii->ni', products)
    np.testing.assert_allclose(
        products - lengths[:, None] * np.eye(3), 0.0, atol=1e-6 * lengths.max()
    )


@pytest.mark.parametrize('lever', [0.5, 2.0])
def test_frames_imitate_a_zero_of_the_first_joint_and_nothing_else_as_well(lever, rng):
    names, others = ['base.rz', 'base.x'], ['shoulder_pan_joint.theta', 'elbow_joint.a']
    q = UR10E.random_joints(50, rng)
    found, wanted, left = best_imitation(UR10E, names, others, q, lever)
    np.testing.assert_allclose(found[:, 0], [1.0, 0.0], atol=1e-9)
    rows = ErrorModel(UR10E, [*names, *others]).jacobian(q)
    rows[:, 3:] *= lever
    own, by_others = np.split(rows.reshape(-1, 4), 2, axis=1)
    np.testing.assert_allclose(wanted, by_others)
    np.testing.assert_allclose(left, by_others - own @ found, atol=1e-12)
    np.testing.assert_allclose(own.T @ left, 0.0, atol=1e-9)
    assert np.linalg.norm(left[:, 1]) > 0.5 * np.linalg.norm(by_others[:, 1])


def test_what_shows_nowhere_imitates_nothing(rng):
    still = np.tile(UR10E.random_joints(1, rng), (5, 1))
    backlash = ['elbow_joint.backlash']
    arm = UR10E.with_effects(backlash)
    for approach, imitated in ((np.zeros((5, 6)), 0.0), (np.ones((5, 6)), 1.0)):
        found, *_ = best_imitation(arm, backlash, ['elbow_joint.theta'], still, 1.0, approach)
        np.testing.assert_allclose(found, [[imitated]], atol=1e-9)


def test_sockets_and_planes_alone_leave_the_size_to_the_longest_length(rng):
    arm, names = UR10E, UR10E.parameter_names
    points = Observations.from_arrays(arm.random_joints(5, rng), np.zeros((5, 3)))
    socket = points.changed(socket=True)
    plane = points.changed(plane=True, distances=np.zeros(5))
    wire = points.changed(distances=np.ones(5))
    for sets in ([points], [wire], [socket, points], [socket, wire]):
        assert identifiable_and_held(arm, names, sets)[1] == ()
    elbow = replace(arm.joints[2], a=-0.7)  # longer than the upper arm
    other = replace(arm, joints=(*arm.joints[:2], elbow, *arm.joints[3:]))
    for sets in ([socket], [plane]):
        for chain, longest in ((arm, 'shoulder_lift_joint.a'), (other, 'elbow_joint.a')):
            found, held = identifiable_and_held(chain, names, sets)
            assert held == (longest,)
            assert longest not in found
            assert len(found) == 23
    without = [name for name in names if name != 'shoulder_lift_joint.a']
    assert identifiable_and_held(arm, without, [socket])[1] == ()


@pytest.mark.parametrize('plane', [False, True])
def test_a_place_touched_in_two_sets_tells_no_more_than_in_one(plane, rng):
    """Neither the size of the arm, with one ball or two."""
    q, places = UR10E.random_joints(3, rng), np.zeros((3, 3))
    seen = Observations.from_arrays(q, places)
    kind = {'plane': True, 'distances': np.zeros(3)} if plane else {'socket': True}
    one = replace(seen, base='base_a', **kind)
    other = replace(one, tool='tool_b')
    sets = (one,), (one, one), (one, other), (other, one, other)
    problems = [Problem(UR10E, first, more=more) for first, *more in sets]
    found = [identifiable_and_held(p.model, p.free, p.sets) for p in problems]
    assert len({held for _, held in found}) == 1
    counts = [len(names) for names, _ in found]
    assert counts == [counts[0]] * 2 + [counts[0] + 3] * 2


def test_planes_hide_the_size_of_a_head_of_two_axes():
    """Touches met to 1e-9 m told it, and the target shrank into a point: all planes meet there."""
    head = Chain(
        'head', 'standard', (Joint('a', a=0.02, alpha=np.pi / 2, d=0.1), Joint('b', a=0.08))
    )
    sets = [Observations.touching(np.zeros((9, 2)), f'base_{k}') for k in range(4)]
    problem = Problem(head, sets[0], more=sets[1:])
    assert identifiable_and_held(problem.model, problem.free, problem.sets)[1] == ('a.a',)
