# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Closed forms of the frames, and the search for the best half of the samples."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import NOISE, SCARA, SIGMAS, UR10E, measured_arm, worst_prediction

from calib_ros import Problem, identify, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.estimation import start, trimmed
from calib_ros.estimation.samples import Samples
from calib_ros.estimation.start import _shortest, _starts, start_frames
from calib_ros.estimation.system import Prior, System
from calib_ros.estimation.trimmed import _Halves, _Linear, trimmed_sum
from calib_ros.kinematics import inverse, se3
from calib_ros.kinematics.chain import Chain, Frame, Joint
from calib_ros.kinematics.se3 import norms


@pytest.mark.parametrize('fixed', [(), ('base',), ('tool',), ('base', 'tool')])
@pytest.mark.parametrize('oriented', [True, False])
def test_closed_forms_are_exact_and_keep_fixed_frames(fixed, oriented, rng):
    frames = {'base': random_frame(rng, 2.0), 'tool': random_frame(rng, 0.2)}
    seen = measure(replace(UR10E, **frames), UR10E.random_joints(30, rng), rng, oriented=oriented)
    given = {key: replace(frames[key], fixed=True) if key in fixed else None for key in frames}
    found = list(next(_starts(replace(UR10E, **given), seen)))
    away = [np.abs(each.forward(seen.joints)[:, :3, 3] - seen.positions).max() for each in found]
    assert min(away) < 1e-9
    best = found[int(np.argmin(away))]
    for key, frame in frames.items():
        whole = oriented or key == 'base' or key in fixed
        part = (slice(None), slice(None) if whole else 3)  # positions do not turn the tool
        np.testing.assert_allclose(best.frame(key).matrix[part], frame.matrix[part], atol=1e-9)


def test_units_of_the_residuals_do_not_change_a_fit_to_a_half(rng):
    seen = measure(UR10E, UR10E.random_joints(40, rng), rng, 1e-4, 3e-4)
    names = [*UR10E.joints[1].parameters[:3], 'tool.x', 'tool.rx']
    masks = rng.random((3, 40)) < 0.5
    few, many = (
        _Linear(UR10E, names, System((Samples(seen, size, 3.0 * size),))).squares(masks)
        for size in (1e-4, 1e6)
    )
    np.testing.assert_allclose(1e20 * many, few, rtol=1e-5)


def two_sets(rng, counts=(40, 23)):
    """Return a system of poses and of positions at repeated joint values, with a prior."""
    first, second = (
        measure(UR10E, UR10E.random_joints(count, rng), rng, 1e-4, 3e-4, oriented=not k)
        for k, count in enumerate(counts)
    )
    second = second.select(np.repeat(np.arange(counts[1]), 3))
    sets = tuple(Samples(each, 1e-4, 3e-4) for each in (first, second))
    return System(sets, Prior(UR10E, {'elbow_joint.a': 1e-5}, noise=2.0))


def test_squares_after_fits_to_masks_are_those_of_least_squares(rng):
    """The prior pulls a parameter back from an offset; each mask is one fit."""
    system, names = two_sets(rng), [*UR10E.joints[2].parameters[:3], 'tool.x', 'tool.rx']
    chain = UR10E.with_offsets({'elbow_joint.a': 1e-3})
    masks = rng.random((4, 40 + 69)) < 0.5
    found = _Linear(chain, names, system).squares(masks)
    extra, offset = system.extra_rows(chain, names)
    rows = [np.pad(r, ((0, 0), (0, 6 - r.shape[1]), (0, 0))) for r in system.rows_of(chain, names)]
    every = np.concatenate(rows, axis=2)
    for mask, squares in zip(masks, found, strict=True):
        chosen = every[..., mask].reshape(len(every), -1).T
        left, right = np.vstack([chosen[:, :-1], extra]), np.append(chosen[:, -1], offset)
        step = np.linalg.lstsq(left, right, rcond=None)[0]
        away = every[-1] - np.einsum('p,pcn->cn', step, every[:-1])
        np.testing.assert_allclose(squares, (away**2).sum(axis=0), rtol=1e-4, atol=1e-4)


def test_halves_are_of_every_set_and_slightly_more(rng):
    """As many configurations are drawn as half of the parameters need, whole ones."""
    system = two_sets(rng)
    names = [*UR10E.joints[2].parameters[:3], 'tool.x', 'elbow_joint.a']
    need = trimmed._need(names, system)  # the prior's parameter needs no equations
    assert need == pytest.approx(3.0 / (6 * 40 + 3 * 23))
    halves = _Halves(system, 0.25)
    assert halves.parts == [slice(0, 40), slice(40, 109)]
    drawn = halves.draw(0.25)
    assert drawn.shape == (trimmed.STARTS, 109)
    np.testing.assert_array_equal(drawn[:, :40].sum(axis=1), 5)  # an eighth
    np.testing.assert_array_equal(drawn[:, 40:].sum(axis=1), 3 * 3)
    together = drawn[:, 40:].reshape(-1, 23, 3)
    np.testing.assert_array_equal(together.all(axis=2), together.any(axis=2))
    assert len(np.unique(drawn[:, :40], axis=0)) > 490  # of 658,008
    alone = system.sets[0].select(np.zeros(4, dtype=int))  # one configuration, always drawn
    assert _Halves(replace(system, sets=(alone,)), 0.25).draw(0.25).all()
    squares = rng.random((300, 109))
    masks, sums = halves.concentrate(squares)
    for part, size in ((slice(0, 40), 25), (slice(40, 109), 44)):
        np.testing.assert_array_equal(masks[:, part].sum(axis=1), size)
        limit = np.sort(squares[:, part], axis=1)[:, size - 1 : size]
        np.testing.assert_array_equal(masks[:, part], squares[:, part] <= limit)
    np.testing.assert_allclose(sums, (squares * masks).sum(axis=1))


@pytest.mark.parametrize(('counts', 'left'), [((40, 23), (40, 69)), ((601, 20), (86, 60))])
def test_of_many_samples_an_even_spread_of_each_set_is_searched(counts, left, rng):
    """Two hundred in all: a hundred of each of two sets."""
    system = two_sets(rng, counts)
    few = trimmed._thinned(system)
    assert tuple(samples.count for samples in few.sets) == left
    share = -(-counts[0] // left[0])
    np.testing.assert_array_equal(few.sets[0].joints, system.sets[0].joints[:, ::share])


def test_of_many_sets_each_keeps_a_tenth_of_the_poses(rng):
    seen = measure(UR10E, UR10E.random_joints(60, rng), rng)
    system = System((Samples(seen, 1e-4, 3e-4),) * 12)
    few = trimmed._thinned(system)
    assert [samples.count for samples in few.sets] == [20] * 12


def test_the_trimmed_sum_is_that_of_the_shorter_half_of_each_set(rng):
    system = two_sets(rng, (7, 2))  # six samples in the second set
    wanted = 0.0
    for rows, half in zip(system.rows_of(UR10E, ()), (4, 3), strict=True):
        wanted += np.sort((rows[-1] ** 2).sum(axis=0))[:half].sum()
    assert trimmed_sum(UR10E, system) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize(
    ('seed', 'oriented'), [(2, True), (3, True), (9, True), (27, True), (3, False)]
)
def test_frames_anywhere_need_no_guess_even_of_six_poses(seed, oriented):
    """From these a fit that starts at the nominal frames ends elsewhere."""
    rng = np.random.default_rng(seed)
    true = faulty(UR10E, Cell(), rng)
    true = replace(true, base=random_frame(rng, 3.0), tool=random_frame(rng, 0.3))
    seen = measure(true, UR10E.random_joints(6, rng), rng, 1e-4, 1e-3, oriented)
    found = start_frames(Problem(UR10E, seen, sigma_position=1e-4, sigma_orientation=1e-3))
    left = norms(found.forward(seen.joints)[:, :3, 3] - seen.positions)
    assert np.median(left) < 0.01  # what the errors of the arm leave


@pytest.mark.parametrize('order', ['near,far,near', 'far,near,alike', 'near,near,far'])
def test_the_start_that_brings_most_samples_near_is_the_best(order, monkeypatch, rng):
    """Gross errors do not count; what is as near for most of the samples is the same start."""
    residual = {'far': np.full((10, 3), 0.1), 'near': np.zeros((10, 3))}
    residual['near'][6:] = 3.0
    residual['alike'] = residual['near'] * [-1.0, 1.0, 1.0]
    seen = measure(UR10E, UR10E.random_joints(10, rng), rng)
    starts = [replace(UR10E, name=each) for each in order.split(',')]
    fitted = []

    def minimise(chain, *_, **__):
        fitted.append(chain.name)
        return SimpleNamespace(chain=chain)

    def robust_fit(chain, names, *_):
        assert len(names) == 12
        return SimpleNamespace(fit=minimise(chain))

    monkeypatch.setattr(start, '_starts', lambda *_: iter([iter(starts)]))
    monkeypatch.setattr(start, 'residual_arrays', lambda chain, _: (residual[chain.name],))
    monkeypatch.setattr(start, 'minimise', minimise)
    monkeypatch.setattr(start, 'robust_fit', robust_fit)
    found = start._start_one(UR10E, seen, (1e-4, 1e-3), 'none')
    assert found.name == 'near'
    assert fitted == [*dict.fromkeys(each for each in order.split(',') if each != 'alike'), 'near']


def test_a_wrong_initial_frame_does_no_harm():
    rng = np.random.default_rng(3)
    true = faulty(UR10E, Cell(), rng)
    misled = replace(UR10E, base=random_frame(rng, 5.0), tool=random_frame(rng, 1.0))
    for oriented in (True, False):
        seen = measure(true, UR10E.random_joints(40, rng), rng, oriented=oriented)
        assert worst_prediction(identify(Problem(misled, seen)).chain, true, rng)[0] < 1e-9


@pytest.mark.parametrize(('oriented', 'jitter'), [(True, 0.0), (False, 1e-4)])
@pytest.mark.parametrize('shape', ['line', 'circle', 'volume'])
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
    assert any('tool (x, y, z' in text for text in result.refusals)
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


@pytest.mark.parametrize('seed', [9, 34])
def test_axes_that_are_hardly_parallel_put_no_tool_metres_away(seed):
    """A calibrated SCARA in new frames was 5 to 16 mm off: a fit found that direction unknown."""
    rng = np.random.default_rng(seed)
    tilts = rng.normal(scale=9e-4, size=len(SCARA.joints))
    names = [f'{joint.name}.alpha' for joint in SCARA.joints]
    chain = SCARA.with_offsets(dict(zip(names, tilts, strict=True)))
    true = replace(chain, base=random_frame(rng, 2.0), tool=random_frame(rng, 0.15))
    seen = measure(true, chain.random_joints(30, rng), rng, *NOISE)
    found = start_frames(Problem(chain, seen, **SIGMAS))
    off = found.forward(seen.joints)[:, :3, 3] - seen.positions
    assert norms(off).max() < 5e-4


def test_distances_start_right_among_gross_errors_that_agree():
    """A third of them is 0.3 m too long; the rest fits to the arm's own errors."""
    *_, seen = measured_arm(0, 120, oriented=False)
    distances = np.linalg.norm(seen.positions, axis=1)
    distances[::3] += 0.3
    wires = replace(seen, distances=distances)
    found = start_frames(Problem(UR10E, wires))
    left = np.linalg.norm(found.forward(seen.joints)[:, :3, 3], axis=1) - distances
    assert np.median(np.abs(left)) < 2e-3
    np.testing.assert_allclose(found.base.matrix[:3, :3], np.eye(3))  # no distance tells a turn


def test_the_closed_form_of_distances_is_exact(rng):
    tool = random_frame(rng, 0.2)
    base = replace(Frame(), matrix=se3.transform(np.eye(3), np.array([0.6, -2.0, 0.4])))
    seen = measure(replace(UR10E, base=base, tool=tool), UR10E.random_joints(30, rng), rng)
    wires = replace(seen, distances=norms(seen.positions))
    placed = start._trilaterated(replace(UR10E, tool=tool), start.flange(UR10E, wires), wires)
    np.testing.assert_allclose(placed.frame('base').matrix, base.matrix, atol=1e-9)


@pytest.mark.parametrize('height', [0.05, 1.5])
def test_distances_place_an_arm_that_moves_in_a_plane(height, rng):
    """From its plane no small change shows: a start at height zero stayed there, 70 mm off."""
    joints = tuple(Joint(f'j{k}', a=a, lower=-2.5, upper=2.5) for k, a in enumerate((0.4, 0.3)))
    nominal = Chain('planar', 'standard', joints)
    base, tool = (
        se3.transform(np.eye(3), np.array(xyz)) for xyz in ((0.6, -2.0, 0.0), (0.1,) * 3)
    )
    base[2, 3] = height
    true = replace(nominal, base=Frame(base), tool=Frame(tool))
    seen = measure(true, nominal.random_joints(60, rng), rng)
    wires = replace(seen, distances=np.linalg.norm(seen.positions, axis=1))
    found = start_frames(Problem(nominal, wires))
    q = nominal.random_joints(50, rng)
    left = [np.linalg.norm(each.forward(q)[:, :3, 3], axis=1) for each in (found, true)]
    np.testing.assert_allclose(*left, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize('oriented', [True, False])
def test_a_tool_measured_once_or_twice_places_no_device(oriented):
    """It may come first: the start of all other tools relied on it, and arms were turned round."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        true = faulty(UR10E, Cell(), rng)
        sets = []
        for number, count in enumerate((1 + seed % 2, 2, 30)):
            tool = f'tool_{number}' if number else 'tool'
            arm = replace(true, tool=random_frame(rng, 0.2))
            seen = measure(arm, UR10E.random_joints(count, rng), rng, *NOISE, oriented=oriented)
            sets.append(replace(seen, tool=tool))
        found = start_frames(Problem(UR10E, sets[0], more=sets[1:], **SIGMAS))
        left = [found.forward(s.joints, tool=s.tool)[:, :3, 3] - s.positions for s in sets[2:]]
        assert np.abs(left).max() < 0.02
