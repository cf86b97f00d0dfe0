# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What moved while it was measured is named, and nothing is accepted that a step has spoilt."""

from dataclasses import replace
from types import SimpleNamespace

import fits
import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E, along_path, at_stations, measured_arm

from calib_ros import Observations, Problem, identify
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.decision.reasons import Rule
from calib_ros.decision.steps import find_step
from calib_ros.estimation import fitting
from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.robust import Robust
from calib_ros.kinematics import se3
from calib_ros.report.documents import as_document

COUNT, AT = 60, 26
DESIGNS = ('random', 'path', 'sweep')
ZEROS = [f'{name}.theta' for name in UR10E.joint_names]
pytestmark = pytest.mark.usefixtures('unsearched')


def poses(design, rng, count=COUNT):
    """Return joint values (count, 6): anywhere, along lines, or one joint after the other."""
    if design == 'random':
        return UR10E.random_joints(count, rng)
    if design == 'path':
        return along_path(count, rng)
    swept = np.tile(rng.uniform(-1.5, 1.5, 6), (6, count // 6, 1))
    for joint in range(6):
        swept[joint, :, joint] += np.linspace(-1.5, 1.5, count // 6)
    return swept.reshape(-1, 6)


def arm(rng, errors=1.0, unmodelled=False):
    """Return an arm; unmodelled ones bend under their weight and have eccentric gears."""
    true = fits.arm(rng, errors)
    if not unmodelled:
        return true
    names = [f'{joint.name}.{wave}_1' for joint in true.joints for wave in ('sin', 'cos')]
    sizes = dict(zip(names, rng.normal(scale=1e-4, size=len(names)), strict=True))
    for joint, other in ((1, 3), (2, 3)):
        name = f'{UR10E.joints[joint].name}.gravity_{UR10E.joints[other].name}'
        sizes[name] = abs(rng.normal(scale=2e-4))
    return true.with_effects(list(sizes)).with_offsets(sizes)


def moved(seen, true, what, size, at=AT, joint=2):
    """Return observations in which something has moved by `size` [m or rad] from `at` on."""
    rest = np.arange(len(seen)) >= at
    positions, rotations = seen.positions.copy(), seen.rotations.copy()
    shift = size * np.array([0.6, 0.0, 0.8])
    turn = se3.exp_rotation(size * np.array([[0.0, 0.8, 0.6]]))[0]
    if what == 'tool':
        positions[rest] += true.forward(seen.joints[rest])[:, :3, :3] @ shift
        rotations[rest] = rotations[rest] @ turn
    elif what == 'base':
        middle = positions.mean(axis=0)
        positions[rest] = (positions[rest] - middle) @ turn.T + middle + shift
        rotations[rest] = turn @ rotations[rest]
    else:
        slipped = seen.joints.copy()
        slipped[rest, joint] += size
        before, after = (true.forward(q) for q in (seen.joints, slipped))
        positions += (after - before)[:, :3, 3]
        rotations = after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2) @ rotations
    if not seen.oriented.all():
        rotations = seen.rotations
    return replace(seen, positions=positions, rotations=rotations)


def session(seed, design='random', oriented=True, errors=1.0, unmodelled=False, count=COUNT):
    rng = np.random.default_rng(seed)
    true = arm(rng, errors, unmodelled)
    q = poses(design, rng, count)
    return true, measure(true, q, rng, *NOISE, oriented=oriented)


def step_of(seen, **more):
    """Return what moved, without judging the arm."""
    return find_step(fitting.fit(Problem(UR10E, seen, **SIGMAS, **more)))


@pytest.mark.parametrize(
    ('design', 'unmodelled', 'what', 'size'),
    [
        ('random', True, 'tool', 1e-3),
        ('random', True, 'base', 1e-3),
        ('random', True, 'joint', 2e-3),
        ('random', True, 'joint', 9e-3),
        ('path', True, 'base', 1e-3),
        ('path', True, 'joint', 2e-3),
        ('sweep', False, 'tool', 1e-3),
        ('sweep', False, 'base', 1e-3),
        ('sweep', False, 'joint', 2e-3),
        ('sweep', True, 'tool', 1e-3),
        ('sweep', True, 'joint', 9e-3),
    ],
)
def test_a_step_is_named_and_refused(design, what, size, unmodelled):
    seed = int(unmodelled) ^ int(what == 'base') ^ int(size > 2e-3)
    true, seen = session(seed, design, bool(seed), unmodelled=unmodelled)
    result = identify(Problem(UR10E, moved(seen, true, what, size), **SIGMAS))
    step = result.step
    assert step is not None
    assert abs(step.sample - AT) <= 1
    assert step.stamp_ns == seen.stamps_ns[step.sample]
    assert not (result.accepted and step.harmful)
    if design == 'sweep' and unmodelled:
        return  # a slip and a bump look alike to one joint
    assert (step.kind, step.set) == (what, 0)
    assert step.what == (UR10E.joint_names[2] if what == 'joint' else what)
    assert step.size == pytest.approx(size, rel=0.4)
    assert step.unit == ('rad' if what == 'joint' else 'm')
    assert (step.thing == 'the joint') == (what == 'joint')


def test_a_step_of_simulated_measurements_without_noise_is_all_that_is_left():
    _, true, seen = measured_arm(0, COUNT, (0.0, 0.0))
    step = step_of(moved(seen, true, 'tool', 1e-3))
    assert (step.what, step.sample) == ('tool', AT)
    assert step.share == pytest.approx(1.0)
    assert str(step).startswith('the target moved by an unknown amount (tool)')  # said: 0 mm


@pytest.mark.parametrize(('seed', 'at'), [(3, 25), (6, 19), (3, 23), (6, 27)])
def test_a_move_that_the_arm_imitates_is_named(seed, at):
    """Between stations with only the wrist moving no residual was left; within one, gross errors.

    These were the poses between the move and the end of the station, up to one or two.
    """
    rng = np.random.default_rng(seed)
    true = arm(rng)
    q = at_stations(rng, 3)
    seen = measure(true, q, rng, *NOISE)
    assert identify(Problem(UR10E, seen, **SIGMAS)).accepted
    result = identify(Problem(UR10E, moved(seen, true, 'base', 1e-3, at=at), **SIGMAS))
    assert not result.accepted
    assert (result.step.kind, result.step.sample) == ('base', at)
    assert result.step.size == pytest.approx(1e-3, rel=0.1)


@pytest.mark.parametrize('seed', [6, 11])
def test_a_slip_that_the_arm_imitates_is_named(seed):
    """Between stations with only the wrist moving; positions alone, or poses."""
    rng = np.random.default_rng(seed)
    true = arm(rng, 0.3)
    q = np.repeat(UR10E.random_joints(5, rng), 8, axis=0)
    q[:, 3:] += rng.uniform(-0.3, 0.3, (40, 3))
    seen = measure(true, q, rng, *NOISE, oriented=bool(seed % 2))
    assert identify(Problem(UR10E, seen, **SIGMAS)).accepted
    result = identify(Problem(UR10E, moved(seen, true, 'joint', 7e-4, at=16), **SIGMAS))
    assert (result.step.what, result.step.sample) == (UR10E.joint_names[2], 16)
    assert result.step.size == pytest.approx(7e-4, rel=0.3)
    assert not result.accepted


def test_a_bumped_target_is_no_gain_of_a_healthy_arm():
    """Along sweeps a bump of 0.3 mm passes for an error of the arm on poses left out."""
    named = 0
    for seed in range(2):
        true, seen = session(seed, 'sweep', errors=0.0)
        result = identify(Problem(UR10E, moved(seen, true, 'tool', 3e-4), **SIGMAS))
        assert not result.accepted
        named += result.step is not None and result.step.kind == 'tool'
    assert named == 2


@pytest.mark.parametrize('design', DESIGNS)
@pytest.mark.parametrize('count', [12, 60])
def test_what_follows_the_joints_is_no_step(design, count):
    seed = int((count == 12) ^ (design == 'path'))
    _, seen = session(seed, design, bool(seed), unmodelled=True, count=count)
    assert step_of(seen) is None


def test_a_dozen_positions_show_a_bump_and_nothing_else():
    """A step of the base may spare priors more squares than nine degrees of freedom leave."""
    for seed in (2, 3, 16, 18, 24):
        _, true, seen = measured_arm(seed, 12, oriented=False)
        assert step_of(seen) is None
        assert abs(step_of(moved(seen, true, 'tool', 5e-3, at=6)).sample - 6) <= 1


@pytest.mark.parametrize(('slip', 'found'), [(0.0, None), (2e-3, UR10E.joint_names[2])])
def test_zeros_held_too_tightly_are_no_step_and_hide_none(slip, found):
    for seed in range(2):
        true, seen = session(seed)
        seen = moved(seen, true, 'joint', slip)
        for chain in (UR10E, replace(UR10E, base=replace(true.base, fixed=True))):
            given = Problem(chain, seen, **SIGMAS, priors={'*.theta': 3e-5})
            step = find_step(fitting.fit(given))
            assert (step and step.what) == found


def test_half_of_the_session_called_outliers_hides_no_step():
    true, seen = session(1, oriented=True)
    result = identify(Problem(UR10E, moved(seen, true, 'joint', 0.02, at=40), **SIGMAS))
    assert {outlier.sample for outlier in result.outliers} == set(range(40, 60))
    assert not result.accepted  # the arm as it is now is another one
    assert result.refusals[0].rule is Rule.ENCODER
    result = identify(Problem(UR10E, moved(seen, true, 'tool', 0.02, at=30), **SIGMAS))
    assert not result.accepted
    assert result.step.kind == 'tool'
    assert abs(result.step.sample - 30) <= 1


@pytest.mark.parametrize('seed', [14, 17])
def test_gross_errors_of_a_swept_arm_are_no_move(seed):
    _, seen = session(seed, 'sweep', oriented=False)
    rng = np.random.default_rng(seed)
    rows, positions = rng.choice(COUNT, 4, replace=False), seen.positions.copy()
    positions[rows] += rng.normal(scale=0.03, size=(4, 3))
    result = identify(Problem(UR10E, replace(seen, positions=positions), **SIGMAS))
    assert result.step is None
    assert result.accepted


def test_a_step_beside_the_fit_is_told_and_harms_nothing():
    true, seen = session(2)
    result = identify(Problem(UR10E, moved(seen, true, 'base', 0.02, at=45), **SIGMAS))
    assert result.accepted
    assert result.step.unused
    assert result.remarks == (str(result.step),)
    said = 'measurements from there on carry no weight: base is outdated, measure again'
    assert result.remarks[0].endswith(said)
    assert as_document(result, {})['remarks'] == list(result.remarks)
    refused = identify(Problem(UR10E, moved(seen, true, 'base', 0.02, at=36), **SIGMAS))
    assert str(refused.step) in refused.refusals
    assert not refused.remarks  # told once


def test_a_step_of_which_samples_are_fitted_is_not_beside_the_fit():
    true, seen = session(2)
    problem = Problem(UR10E, moved(seen, true, 'base', 0.02, at=45), **SIGMAS)
    result = identify(problem)
    distances = result.distances[0].copy()
    distances[50] = 1.0
    system = problem.system(problem.sets)
    fit = minimise(result.chain, result.names, system, iterations=0)
    robust = Robust(fit, system, (distances,), True, problem.loss)
    parts = {'problem': problem, 'names': result.names, 'noise': result.noise}
    step = find_step(SimpleNamespace(**parts, robust=robust))
    assert step.kind == 'base'
    assert not step.unused
    assert step.harmful


def test_the_order_is_that_of_the_stamps(rng):
    true, seen = session(3)
    seen = moved(seen, true, 'tool', 1e-3).at(seen.stamps_ns * 10 + 17)
    mixed = rng.permutation(COUNT)
    step = step_of(seen.select(mixed))
    assert mixed[step.sample] == AT
    assert step.stamp_ns == seen.stamps_ns[AT]
    assert f'before pose {step.sample + 1} (stamp 270.000 s)' in str(step)


def test_without_stamps_the_order_of_the_rows_is_said():
    true, seen = session(3)
    result = identify(Problem(UR10E, moved(seen, true, 'tool', 8e-4), **SIGMAS))
    assert result.refusals[0].startswith(
        'the target moved by 0.8 mm (tool) before line 27 (if rows are in the order of '
        'measurement)'
    )


@pytest.mark.parametrize(
    ('aside', 'size', 'said'), [(0.0, 2e-3, False), (1.5, 2e-3, True), (1.5, 0.3, False)]
)
def test_blocks_of_poses_in_different_places_are_said(rng, aside, size, said):
    """An arm on a column that bends looks as if its foot moved where it reaches out, a little."""
    q = 0.1 * UR10E.random_joints(COUNT, rng)
    q[AT:, 1:3] += aside
    true = faulty(UR10E, Cell(), rng)
    seen = moved(measure(true, q, rng, *NOISE), true, 'base', size)
    step = step_of(seen)
    assert step.sample == AT
    assert ('arm errors may look like this' in str(step)) == said


def test_poses_of_several_targets_are_told_by_their_lines():
    """Pose 14 of the first target would be line 27 of the table."""
    true, seen = session(3)
    seen = moved(seen, true, 'base', 2e-3)
    even, odd = (seen.select(np.arange(k, COUNT, 2)) for k in (0, 1))
    odd = replace(odd, tool='tool_1')
    told = str(step_of(even, more=(odd,)))
    assert f'before line {AT + 1} (if rows are in the order of' in told


def test_what_is_on_the_flange_is_named():
    true, seen = session(1)
    found = {}
    for what in ('tool', 'base'):
        spoilt = moved(seen, true, what, 5e-3)
        fixed, held = step_of(spoilt), step_of(replace(spoilt, inverse=True))
        found |= {fixed.kind: fixed.thing, f'{held.kind} of a device on it': held.thing}
    assert found == {
        'tool': 'the target',
        'base': "the measuring device or the robot's foot",
        'tool of a device on it': 'the measuring device',
        'base of a device on it': "the target or the robot's foot",
    }


def test_one_of_several_targets_and_sessions(rng):
    true, seen = session(4)
    true = true.with_frame('tool_B', random_frame(rng, 0.2))
    second = measure(replace(true, tool=true.frame('tool_B')), seen.joints, rng, *NOISE)
    second = replace(second.at(seen.stamps_ns + 1000), tool='tool_B')
    spoilt = moved(second, replace(true, tool=true.frame('tool_B')), 'tool', 1e-3)
    step = step_of(seen, more=(spoilt,))
    assert (step.what, step.kind, step.set, step.sample) == ('tool_B', 'tool', 1, AT)
    both = [moved(each, true, 'base', 1e-3) for each in (seen, second)]
    step = step_of(both[0], more=both[1:])
    assert (step.what, step.kind, step.set, step.sample) == ('base', 'base', 0, AT)


def test_distances_tell_a_step_as_well(rng):
    _, true, seen = measured_arm(rng, 160, oriented=False)
    seen = moved(seen, true, 'tool', 2e-3, at=70)
    far = np.linalg.norm(seen.positions, axis=1)
    only = replace(Observations.from_arrays(seen.joints, np.zeros((160, 3))), distances=far)
    step = identify(Problem(UR10E, only, **SIGMAS)).step
    assert step.kind == 'tool'
    assert abs(step.sample - 70) <= 1


@pytest.mark.parametrize(('stops', 'found'), [(5, False), (9, True)])
def test_nothing_moves_between_fewer_stops_than_a_step_has_on_both_sides(stops, found):
    rng = np.random.default_rng(5)
    true, few = arm(rng), np.repeat(UR10E.random_joints(stops, rng), 8, axis=0)
    seen = moved(measure(true, few, rng, *NOISE), true, 'tool', 0.02, at=32)
    problem = Problem(UR10E, seen, fixed=('*_joint.*',))
    step = find_step(fitting.fit(problem))
    assert (step is not None and (step.kind, step.sample) == ('tool', 32)) == found


@pytest.mark.parametrize(('seed', 'row'), [(8, -2), (11, 1)])
def test_a_gross_error_at_the_begin_or_end_is_no_step(seed, row):
    """The six freedoms of a base explain three positions, whatever is wrong with one of them."""
    _, seen = session(seed, oriented=False, count=40)
    positions = seen.positions.copy()
    positions[row] += [0.3, -0.2, 0.1]
    result = identify(Problem(UR10E, replace(seen, positions=positions), **SIGMAS))
    assert result.step is None
    assert [outlier.sample for outlier in result.outliers] == [row % 40]
    assert result.accepted


@pytest.mark.parametrize('what', ['load', 'joints', None])
def test_another_load_and_other_zeros_of_all_joints(what, rng):
    zeros = {name: 8e-4 * sign for name, sign in zip(ZEROS, (1, -1, 1, 1, -1, 1), strict=True)}
    load = {f'{joint}.gravity_wrist_3_joint': 6e-4 for joint in UR10E.joint_names[1:4]}
    true = arm(rng).with_effects(list(load)).with_offsets(load)  # a constant one is no step
    changed = {'load': load, 'joints': zeros, None: {}}[what]
    q, cell = poses('random', rng), Cell()
    parts = [
        measure(each, part, np.random.default_rng(k), *NOISE, cell)
        for k, (each, part) in enumerate(((true, q[:AT]), (true.with_offsets(changed), q[AT:])))
    ]
    seen = Observations.from_arrays(
        q, *(np.concatenate([getattr(e, k) for e in parts]) for k in ('positions', 'rotations'))
    )
    result = identify(Problem(UR10E, seen, **SIGMAS))
    if what is None:
        assert result.step is None
        assert result.accepted
    else:
        assert (result.step.kind, result.step.sample) == (what, AT)
        thing = 'the load of the arm' if what == 'load' else 'the zeros of several joints'
        assert result.refusals[0].startswith(f'{thing} changed before line {AT + 1} (')
        assert result.refusals[0].rule is (Rule.MOVED if what == 'load' else Rule.ENCODER)


@pytest.mark.parametrize('what', ['joint', 'tool', 'base'])
def test_a_soft_arm_hides_no_step(what, rng):
    """Beside its bending a slip would be that of several joints, and a bump none."""
    load = {f'{joint}.gravity_wrist_3_joint': 1e-3 for joint in UR10E.joint_names[1:4]}
    true = arm(rng).with_effects(list(load)).with_offsets(load)
    seen = measure(true, poses('random', rng), rng, *NOISE)
    step = step_of(moved(seen, true, what, 1e-3))
    assert (step.kind, step.sample) == (what, AT)


@pytest.mark.parametrize('what', ['joint', 'tool', None])
def test_a_wrong_zero_that_is_held_is_no_step(what):
    """Nearly all of its poses are after the third, so a slip there would explain most."""
    true, seen = session(17)
    seen = moved(seen, true, what, 2e-3) if what else seen
    held = ('shoulder_lift_joint.theta', 'elbow_joint.theta')
    step = step_of(seen, fixed=held)
    assert (step and (step.kind, step.sample)) == (what and (what, AT))
