# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A point at the tool that touches planes of unknown place."""

from dataclasses import replace

import numpy as np
import pytest
from measured import write_csv
from scipy import special

from calib_ros import Chain, Observations, Problem, identify, load_chain, read_table
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.decision.plausibility import _arm_distance
from calib_ros.decision.reasons import Rule
from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation import start
from calib_ros.estimation.considered import lengths_of
from calib_ros.estimation.evidence import Inference
from calib_ros.estimation.fitting import fit
from calib_ros.estimation.levels import LARGEST_SCALE, PRINTED, SCALE
from calib_ros.estimation.normal import triangular_factor
from calib_ros.estimation.pixels import samples_of
from calib_ros.estimation.samples import Samples, residual_arrays
from calib_ros.estimation.system import System
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Frame, Joint
from calib_ros.kinematics.jacobian import ErrorModel

UR = replace(load_chain('ur10e'), base=None, tool=None)
SIGMA = 5e-5
TIP = np.array([0.03, -0.02, 0.15])
GANTRY = Chain(
    'gantry',
    'standard',
    (
        Joint('x', 'prismatic', alpha=-np.pi / 2, lower=-0.8, upper=0.8),
        Joint('y', 'prismatic', alpha=np.pi / 2, theta=-np.pi / 2, lower=-1.0, upper=1.0),
        Joint('z', 'prismatic', lower=0.0, upper=1.5),
        Joint('turn', d=0.1),
    ),
)
PLANES = (
    se3.transform(np.eye(3), np.array([0.0, 0.0, -0.1])),
    se3.transform(se3.exp_rotation(np.array([0.0, 1.2, 0.3])), np.array([0.1, 0.0, 0.4])),
    se3.transform(se3.exp_rotation(np.array([1.4, 0.2, 0.0])), np.array([0.0, 0.2, 0.5])),
)


def touched(true, plane, count, rng, noise=0.0):
    """Return joint values (count, n) with the tip within the noise of a plane of the world."""
    placed = true.with_frame('base', Frame(plane))
    q = true.random_joints(count, rng)
    heights = rng.normal(scale=noise, size=count)
    model = ErrorModel(placed, [joint.driven for joint in true.joints])
    signs = np.array([joint.sign for joint in true.joints])
    for _ in range(100):
        left = heights - placed.forward(q)[:, 2, 3]
        column = model.jacobian(q)[:, 2] * signs
        q = q + column * (left / ((column**2).sum(axis=1) + 1e-6))[:, np.newaxis]
    met = np.abs(placed.forward(q)[:, 2, 3] - heights) < 1e-12
    assert met.mean() > 0.8
    return q[met]


def cell(seed, noise=SIGMA, count=40, planes=3, nominal=UR):
    """Return a true arm and what it touched, set by set."""
    rng = np.random.default_rng(seed)
    tool = Frame(se3.transform(np.eye(3), TIP))
    true = replace(faulty(nominal, Cell(), rng), base=Frame(), tool=tool)
    return true, [
        Observations.touching(touched(true, plane, count, rng, noise), f'base_{k}')
        for k, plane in enumerate(PLANES[:planes])
    ]


def test_the_jacobian_is_that_of_finite_differences():
    true, (seen, *_) = cell(0)
    chain = true.with_frame('base_0', Frame(PLANES[1])).with_effects(['shoulder_pan_joint.sin_1'])
    names = [n for n in chain.parameter_names if not n.startswith('base.')]
    rows = Samples(seen, SIGMA, 1.0).rows_of(chain, names)
    for k, name in enumerate(names):
        more, less = (
            residual_arrays(chain.with_offsets({name: s * 1e-6}), seen)[0] for s in (1.0, -1.0)
        )
        slope = (less - more)[:, 0] / 2e-6 / SIGMA
        np.testing.assert_allclose(rows[k, 0], slope, rtol=1e-6, atol=0.01)


def test_closed_forms_put_touches_on_their_plane():
    """With the tool as it is given, or as the heights tell."""
    true, sets = cell(0, noise=0.0)
    seen = replace(sets[1], base='base')
    given = replace(true, tool=replace(true.tool, fixed=True))
    for k, chain in enumerate((given, replace(true, base=None, tool=None))):
        found = [*start._on_plane(chain, start.flange(chain, seen), seen)][k]
        np.testing.assert_allclose(residual_arrays(found, seen)[0][:, 0], 0.0, atol=1e-9)


def test_planes_tell_the_arm_but_not_its_size():
    """Held out touches are met exactly, and one length is kept as it was."""
    true, sets = cell(1, noise=0.0)
    result = identify(Problem(UR, sets[0], more=sets[1:], sigma_touch=1e-6))
    assert result.accepted, result.refusals
    assert not result.not_excited
    assert result.validation.figures[1].rms_mm < 1e-6
    gauges = {p.name for p in result.parameters if p.status == 'gauge'}
    for k in range(3):
        assert {f'base_{k}.x', f'base_{k}.y', f'base_{k}.rz'} <= gauges
        assert not {f'base_{k}.z', f'base_{k}.rx', f'base_{k}.ry'} & gauges
    assert {'tool.rx', 'tool.ry', 'tool.rz'} <= gauges
    lengths = [n for n in result.names if not result.chain.owns_frame(n) and n.is_length]
    sizes = [result.chain.value(n) / true.value(n) for n in lengths if abs(true.value(n)) > 0.1]
    assert np.ptp(sizes) < 1e-8
    assert sizes[0] != pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize('seed', [0, 4])
def test_the_size_that_planes_do_not_tell_is_as_uncertain_as_lengths_are(seed):
    true, sets = cell(seed)
    result = identify(Problem(UR, sets[0], more=sets[1:], sigma_touch=SIGMA))
    assert result.accepted, result.refusals
    assert UR.joint_names[1] + '.a' in result.unidentifiable  # the longest of its lengths
    q = true.random_joints(200, np.random.default_rng(0))
    before, after = (_arm_distance(chain, true, q) for chain in (UR, result.chain))
    assert after < 0.6 * before
    assert after < 2.0 * np.median(result.region.known(q))


@pytest.mark.parametrize(
    ('nominal', 'held'),
    [(UR, ['shoulder_lift_joint.a']), (GANTRY, ['y.alpha', 'z.beta'])],
    ids=['size', 'axes askew'],
)
def test_what_planes_do_not_tell_is_held_and_uncertain(nominal, held):
    """Touches are met as well by other values of it, with what follows it."""
    _, sets = cell(2, nominal=nominal)
    fitted = fit(Problem(nominal, sets[0], more=sets[1:], sigma_touch=SIGMA))
    names, slopes = fitted.held
    assert list(names) == held
    assert not {*names} & {*fitted.names}
    bare = System(fitted.system.sets)
    factor = triangular_factor(fitted.chain, (*fitted.names, *names), bare)
    left = factor @ np.concatenate([slopes, np.eye(len(names))])
    alone = np.linalg.norm(factor[:, len(slopes) :], axis=0)
    assert (np.linalg.norm(left, axis=0) < 0.03 * alone).all()
    stds = Inference(fitted, fitted.size).likeliest().stds_of(names)
    shared = sum(std**2 * np.outer(s, s) for std, s in zip(stds, slopes.T, strict=True))
    np.testing.assert_allclose(fitted.uncertainty.parts[-1], shared, rtol=1e-9)
    assert fitted.uncertainty.freedom[-1] == np.inf


@pytest.mark.parametrize('seed', [2, 6])
def test_planes_alone_do_not_tell_a_gantry_whose_axes_are_askew(seed):
    _, sets = cell(seed, nominal=GANTRY)
    result = identify(Problem(GANTRY, sets[0], more=sets[1:], sigma_touch=SIGMA))
    assert not result.accepted


def test_an_arm_whose_only_length_is_held_is_judged():
    """Its size is the usual one."""
    planar = Chain('planar', 'standard', (Joint('a', a=0.4), Joint('b', a=0.3)))
    planes = [se3.exp_rotation(np.array([x, 1.2, 0.3])) for x in (1.4, 0.2, -0.7)]
    rng = np.random.default_rng(0)
    true = replace(faulty(planar, Cell(), rng), base=Frame(), tool=Frame())
    sets = [
        Observations.touching(
            touched(true, se3.transform(turn, np.full(3, 0.1)), 40, rng, SIGMA), f'base_{k}'
        )
        for k, turn in enumerate(planes)
    ]
    result = identify(Problem(planar, sets[0], more=sets[1:], sigma_touch=SIGMA))
    assert 'a.a' in result.unidentifiable


@pytest.mark.parametrize('seed', range(2))
def test_few_touches_do_not_look_as_if_something_had_moved(seed):
    _, sets = cell(seed, count=14)
    assert identify(Problem(UR, sets[0], more=sets[1:], sigma_touch=SIGMA)).step is None


def with_positions(seed):
    """Return a true arm, and touches with few positions of another target by a device."""
    true, sets = cell(seed)
    rng = np.random.default_rng(100 + seed)
    target = Frame(se3.transform(np.eye(3), np.array([0.0, 0.1, 0.05])))
    device = random_frame(rng, 2.0)
    seen_by = true.with_frame('base', device).with_frame('tool', target)
    seen = measure(seen_by, true.random_joints(12, rng), rng, SIGMA, SIGMA, oriented=False)
    true = true.with_frame('base', device).with_frame('tool_ball', target)
    for k, plane in enumerate(PLANES):
        true = true.with_frame(f'base_{k}', Frame(plane))
    return true, Problem(
        UR, replace(seen, tool='tool_ball'), more=sets, sigma_position=SIGMA, sigma_touch=SIGMA
    )


def test_with_positions_touches_tell_the_size_as_well():
    """Chi-squared over 4 arms: standard deviations are honest, and less than without touches."""
    squares, count = 0.0, 0
    for seed in range(4):
        true, problem = with_positions(seed)
        result = identify(problem)
        arm = [k for k, n in enumerate(result.names) if not result.chain.owns_frame(n)]
        off = np.array([result.chain.offset(result.names[k], true) for k in arm])
        squares += off @ np.linalg.solve(result.covariance[np.ix_(arm, arm)], off)
        count += len(arm)
    low, high = special.chdtri(count, [0.995, 0.005])
    assert low < squares < high
    alone = identify(replace(problem, more=()))
    std = {p.name: p.std for p in alone.parameters}
    better = [p.std < std[p.name] for p in result.parameters if p.std and std.get(p.name)]
    assert all(better)


def test_touches_show_no_lag():
    """Moves within a plane are the noise of both ends: of 8 sessions 4 lay 'towards the last'."""
    true, sets = cell(3, 2 * SIGMA, 24, 2)
    rng = np.random.default_rng(3)
    seen = measure(true, true.random_joints(40, rng), rng, 1e-4, oriented=False)
    lengths = np.linalg.norm(seen.positions - [1.2, 0.5, 0.3], axis=1)
    sets.append(replace(seen, distances=lengths, base='base_wire'))
    result = identify(Problem(UR, sets[0], more=sets[1:], sigma_touch=SIGMA))
    assert result.noise.position > 1.0
    assert not result.remarks


def test_touches_beside_a_plane_are_named():
    true, sets = cell(3)
    q = sets[0].joints.copy()
    rng = np.random.default_rng(0)
    wrong = [3, 11, 20, 33]
    lifted = true.with_frame('base', Frame(PLANES[0]))
    q[wrong] = touched(lifted, se3.transform(np.eye(3), np.array([0.0, 0.0, -0.11])), 6, rng)[:4]
    spoilt = replace(sets[0], joints=q)
    result = identify(Problem(UR, spoilt, more=sets[1:], sigma_touch=SIGMA))
    assert {(each.set, each.sample) for each in result.outliers} == {(0, k) for k in wrong}
    assert result.validation.figures[1].rms_mm < 3e3 * SIGMA


def test_a_fixed_tool_and_one_plane_are_enough_for_a_part():
    true, (seen, *_) = cell(4, planes=1, count=60)
    known = replace(UR, tool=replace(true.frame('tool'), fixed=True))
    result = identify(Problem(known, seen, sigma_touch=SIGMA))
    assert result.accepted, result.refusals
    assert not any(name.startswith('tool') for name in result.names)


def rows_of(sets, **more):
    """Return rows of a table with a label a plane."""
    return [
        {f'q{k + 1}': x for k, x in enumerate(row)} | {'plane': name} | more
        for name, each in zip('ABC', sets, strict=False)
        for row in each.joints.tolist()
    ]


def test_touches_in_a_table_are_as_given(tmp_path):
    """Another row of the table is a position."""
    _, sets = cell(5, count=6, planes=2)
    point = dict.fromkeys(('q1', 'q2', 'q3', 'q4', 'q5', 'q6'), 0.0)
    point |= {'x': 0.1, 'y': 0.2, 'z': 0.3, 'target': 'ball'}
    path = write_csv(tmp_path / 'touched.csv', [point, *rows_of(sets, target='tip')])
    table = read_table(path, 6)
    assert [(each.base, each.tool) for each in table.fitted] == [
        ('base', 'tool'),
        ('base_A', 'tool_tip'),
        ('base_B', 'tool_tip'),
    ]
    for each, given in zip(table.fitted[1:], sets, strict=True):
        assert each.plane
        np.testing.assert_array_equal(each.joints, given.joints)
        np.testing.assert_array_equal(each.distances, given.distances)


def test_a_plane_needs_heights_and_a_sigma():
    _, (seen, *_) = cell(0, count=3, planes=1)
    with pytest.raises(InputError, match='heights'):
        replace(seen, distances=None)
    with pytest.raises(ConfigError, match='sigma_touch'):
        Problem(UR, seen, sigma_touch=0.0)


def test_touches_beside_poses_do_not_vouch_for_the_scale_of_the_device():
    """A dozen had a device 0.3 % out of scale accepted, and arms of 0.8 mm became 2.6 mm wrong."""
    rng = np.random.default_rng(0)
    true = faulty(UR, Cell(2e-4, 3e-4), rng)
    seen = measure(true, UR.random_joints(60, rng), rng, SIGMA, 2e-4)
    seen = replace(seen, positions=1.003 * seen.positions)
    met = Observations.touching(touched(true, PLANES[0], 12, rng), base='base_plane')
    result = identify(Problem(UR, seen, more=(met,)))
    assert [each.rule for each in result.refusals] == [Rule.SCALE]


def test_the_scale_is_that_of_what_measures_lengths():
    """Not of planes and sockets beside it; of these alone it is that of the bar."""
    one = Observations.from_arrays(np.zeros((1, 6)), np.ones((1, 3)))
    board = replace(one, pixels=np.zeros((1, 2)), points=np.zeros((1, 3)))
    plane = replace(one, distances=np.zeros(1), plane=True)
    socket, wire = replace(one, socket=True), replace(one, distances=np.ones(1))
    bar = (('base', 'base_2', 0.05),)
    for sets, apart, expected in (
        ([one, board], (), SCALE),
        ([board, plane], (), PRINTED),
        ([wire, socket], (), LARGEST_SCALE),
        ([socket, plane], bar, 2e-3),
        ([socket, one], bar, SCALE),
    ):
        samples = tuple(samples_of(each, (1.0, 1.0), 1.0) for each in sets)
        _, lengths, scale = lengths_of(UR, System(samples, None, apart))
        assert (bool(lengths), scale) == (True, pytest.approx(expected))
        assert not lengths_of(UR, System((samples_of(plane, (1.0, 1.0), 1.0),)))[1]
    q = GANTRY.random_joints(9, np.random.default_rng(0))
    there = Observations.from_arrays(q, np.zeros((9, 3)))
    system = System((Samples(there, 1.0, 1.0),))
    chain, lengths, _ = lengths_of(GANTRY, system)  # of travels too: all of the position
    (rows,) = system.rows_of(chain, tuple(lengths))
    grown = np.tensordot([*lengths.values()], rows[:-1], 1).T
    np.testing.assert_allclose(grown, GANTRY.forward(q)[:, :3, 3], atol=1e-12)
