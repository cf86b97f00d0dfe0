# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joint values as controllers give them: external axes behind those of the arm, coupled joints;
and rows that are not like the others.
"""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import SCARA, SIGMAS, UR10E, measured_arm

from calib_ros import identify, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.decision import mistakes, orders, trials
from calib_ros.decision.mistakes import diagnose, diagnose_alone
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.estimation.problem import Problem
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.settings import LEVER


@pytest.mark.parametrize('oriented', [True, False])
def test_external_axes_that_come_last_are_named(oriented):
    arm, rng = load_chain('ur10e_on_linear_axis'), np.random.default_rng(1)
    q = arm.random_joints(40, rng)
    seen = measure(faulty(arm, Cell(), rng), q, rng, 5e-5, 2e-4, oriented)
    found = diagnose(Problem(arm, replace(seen, joints=np.roll(q, -1, axis=1)))).suspects[0]
    assert f'in another order, {arm.joint_names[0]} last' in found.what
    assert found.remedy == '--columns q1=q7,q2=q1,q3=q2,q4=q3,q5=q4,q6=q5,q7=q6'


@pytest.mark.parametrize(
    ('length', 'angle', 'remedy'),
    [
        (1e3, 180.0 / np.pi, '--length mm --joint-angle deg'),
        (1.0, 180.0 / np.pi, '--joint-angle deg'),
    ],
)
def test_a_coupled_joint_in_a_table_without_units_is_named(length, angle, remedy):
    """As a Fanuc logs it: J3 against the horizontal, in degrees."""
    arm, rng = load_chain('fanuc_r2000ic_165f'), np.random.default_rng(1)
    q = arm.random_joints(25, rng)
    seen = measure(faulty(arm, Cell(), rng), q, rng, 5e-5, oriented=False)
    logged = angle * (q - q[:, [1]] * np.eye(6)[2])
    spoilt = replace(seen, joints=logged, positions=length * seen.positions)
    (found,) = diagnose(Problem(arm, spoilt)).suspects
    assert found.what == 'several mistakes at once'
    assert f'({remedy})' in found.remedy
    assert found.remedy.endswith('(--columns q3=q3+q2)')


def test_swapped_ends_of_a_short_arm_are_named_once():
    rows = ({'d': 0.5, 'a': 0.2, 'alpha': -np.pi / 2}, {'a': 0.7}, {'a': 0.6})
    arm = Chain('short', 'standard', tuple(Joint(f'j{k}', **row) for k, row in enumerate(rows)))
    rng = np.random.default_rng(1)
    seen = measure(faulty(arm, Cell(), rng), rng.uniform(-2.0, 2.0, (40, 3)), rng, 5e-5, 2e-4)
    (found,) = diagnose(Problem(arm, replace(seen, joints=seen.joints[:, ::-1]))).suspects
    assert found.what == 'j0 and j2 are swapped'


def test_messages_from_the_flange_in_millimetres_are_named_with_the_setting_and_the_rest():
    *_, seen = measured_arm(1, 40)
    turned = replace(seen.inverted(), inverse=False)
    wrong = replace(turned, positions=1e3 * turned.positions)
    said = str(diagnose(Problem(UR10E, wrong, of_messages=True)))
    assert 'set eye_in_hand=true in sources, correct the rest in the publisher' in said


def test_rows_that_are_not_like_the_others_are_named():
    """Of two arms in turn; of a second part in another unit."""
    arm, rng = load_chain('ur10e'), np.random.default_rng(1)
    q = arm.random_joints(50, rng)
    one, other = (measure(faulty(arm, Cell(), rng), q, rng, 5e-5, oriented=False) for _ in '12')
    rows = np.arange(50)[:, np.newaxis]
    mixed = replace(one, positions=np.where(rows % 2, one.positions, other.positions))
    assert diagnose(Problem(arm, one)) is None
    found = diagnose(Problem(arm, mixed))
    assert str(found).startswith('the rows are of 2 arms, devices or targets in turn: name them')
    for part, where in ((rows < 22, '1 to 22'), (rows >= 27, '28 to 50')):
        spoilt = replace(one, joints=np.where(part, np.rad2deg(q), q))
        found = diagnose(Problem(arm, spoilt))
        assert found.where == f'in lines {where} alone, '
        assert (
            found.suspects[0].remedy == 'write them as the others (--joint-angle deg reads them)'
        )
        assert found.corrected < 0.01


@pytest.mark.parametrize(
    ('kind', 'count', 'at_each'), [('target', 3, True), ('target', 2, False), ('device', 4, True)]
)
def test_targets_or_devices_measured_in_turn_without_names_are_named(kind, count, at_each):
    """All at each stop, which is no joint source that stood still, or one at each."""
    arm, rng = load_chain('ur10e'), np.random.default_rng(3)
    q, turns = arm.random_joints(60, rng), np.arange(60) % count
    if at_each:
        q = np.repeat(q[: 60 // count], count, axis=0)
    seen = measure(faulty(arm, Cell(), rng), q, rng, 5e-5, oriented=True)
    away = rng.uniform(-0.1, 0.1, (count, 3))[turns]
    if kind == 'target':
        away = np.einsum('nij,nj->ni', seen.rotations, away)
    unnamed = Observations.from_arrays(q, seen.positions + away)
    found = diagnose(Problem(arm, unnamed))
    what = f'the rows are of {count} {kind}s in turn: name them in a column {kind} '
    assert str(found).startswith(what)
    assert found.corrected < 5e-3 < found.given


@pytest.mark.parametrize('kind', ['target', 'device'])
def test_targets_in_turn_are_told_from_devices_where_base_and_tool_share_a_freedom(kind):
    """A height over the table is one on the spindle of a SCARA."""
    rng, true, seen = measured_arm(1, 60, chain=SCARA, oriented=False)
    away = rng.uniform(-0.1, 0.1, (2, 3))[np.arange(60) % 2]
    if kind == 'target':
        away = np.einsum('nij,nj->ni', true.forward(seen.joints)[:, :3, :3], away)
    found = diagnose(Problem(SCARA, replace(seen, positions=seen.positions + away)))
    assert str(found).startswith(f'the rows are of 2 {kind}s in turn: name them in a column')


def test_targets_one_after_the_other_are_moves_with_each_place(single):
    rng, _, seen = measured_arm(2, 60)
    away = np.concatenate([np.zeros((1, 3)), rng.uniform(-0.1, 0.1, (2, 3))]).repeat(20, axis=0)
    away = np.einsum('nij,nj->ni', seen.rotations, away)
    problem = Problem(UR10E, replace(seen, positions=seen.positions + away), **SIGMAS)
    told = identify(problem).refusals[0]
    assert told.startswith('the target moved by 62 mm (tool) before line 21, by 180 mm before')
    assert told.endswith('; if these are several targets, name each (column target, or sources)')


@pytest.mark.parametrize('name', ['base_left', 'tool_left'])
def test_a_frame_of_a_named_device_or_target_held_in_a_wrong_place_is_not_several(name):
    """Each half of the rows fits in frames of its own, but so do all of them."""
    _, true, seen = measured_arm(2, 36, chain=SCARA)
    frame, seen = true.frame(name[:4]), replace(seen, **{name[:4]: name})
    wrong = frame.matrix + np.pad(np.full((3, 1), 0.05), ((0, 1), (3, 0)))
    held = SCARA.with_frame(name, replace(frame, matrix=wrong, fixed=True))
    assert orders.in_turn(Problem(held, seen), held, seen, 5e-3) is None


@pytest.mark.parametrize('kind', ['a loop of six poses', 'three places in turn'])
def test_few_configurations_or_places_in_turn_are_not_several_arms(kind):
    """Frames explain three poses each, or those of one place, beside any error of a joint."""
    arm, rng = load_chain('ur10e'), np.random.default_rng(100)
    places = arm.random_joints(63, rng)
    q = np.tile(places[:6], (10, 1))
    wrong, oriented = 0.0, False
    if kind == 'three places in turn':
        q = places[60 + np.arange(60) % 3] + rng.normal(scale=0.1, size=(60, 6))
        wrong, oriented = 0.1, True
    true = faulty(arm, Cell(), np.random.default_rng(0))
    seen = measure(true, q, rng, 5e-5, oriented=oriented)
    seen = replace(seen, joints=q + wrong * np.eye(6)[1])
    assert 'in turn' not in str(diagnose(Problem(arm, seen)))


def test_a_few_rows_of_a_camera_on_the_flange_with_other_quaternions_are_named():
    """As they were measured, before they are inverted."""
    *_, seen = measured_arm(2, 40)
    given = replace(seen.inverted(), inverse=False)
    read = se3.from_quat(np.roll(se3.to_quat(given.rotations), 1, axis=1))
    some = np.isin(np.arange(40), [5, 6, 7])[:, np.newaxis, np.newaxis]
    spoilt = replace(given, rotations=np.where(some, read, given.rotations)).inverted()
    found = str(diagnose(Problem(UR10E, spoilt)))
    assert found.startswith('in lines 6 to 8 alone, the quaternions are w x y z, not x y z w')


@pytest.mark.parametrize(
    ('rows', 'where', 'oriented'),
    [([5, 6, 7], '6 to 8', False), ([3, 9, 20, 21], '4, 10, 21 to 22', True)],
)
def test_a_few_rows_in_another_unit_are_named(rows, where, oriented):
    """Too few to place base and tool, which the others do."""
    arm, rng = load_chain('ur10e'), np.random.default_rng(2)
    q = arm.random_joints(40, rng)
    true = faulty(arm, Cell(), rng)
    seen = measure(true, q, rng, 5e-5, 2e-4, oriented)
    some = np.isin(np.arange(40), rows)[:, np.newaxis]
    for positions, joints, words in (
        (np.where(some, 1e3 * seen.positions, seen.positions), q, 'positions are in mm'),
        (seen.positions, np.where(some, np.degrees(q), q), 'joint values are in degrees'),
    ):
        found = str(diagnose(Problem(arm, replace(seen, positions=positions, joints=joints))))
        assert found.startswith(f'in lines {where} alone, the {words}, not ')
        assert '; or ' not in found
    many = Problem(arm, replace(seen, joints=np.where(some, np.degrees(q), q)), of_messages=True)
    told = str(diagnose_alone(many, true))
    place = re.sub(r'(\d+)', r'\1.000 s', where)
    assert told.startswith(f'in poses of {place} alone, the joint values are in degrees, not ')
    assert ': correct the publisher and measure again' in told


@pytest.mark.parametrize(('rows', 'oriented'), [(slice(5, 6), False), (slice(5, 12), True)])
def test_rows_of_a_lost_target_are_gross_errors_only(rows, oriented, single):
    """Odd and even rows fit alone, but so do all but these: no two arms."""
    *_, seen = measured_arm(1, 60, oriented=oriented)
    positions = seen.positions.copy()
    positions[rows] = 0.0
    result = identify(Problem(UR10E, replace(seen, positions=positions), **SIGMAS))
    assert result.accepted
    assert len(result.outliers) == rows.stop - rows.start


def test_rows_of_one_of_several_sets_are_told_with_its_device():
    """Of two devices nobody knew which rows were meant."""
    arm, rng = load_chain('ur10e'), np.random.default_rng(2)
    true = faulty(arm, Cell(), rng).with_frame('base_2', random_frame(rng, 2.0))
    one, other = (arm.random_joints(40, rng) for _ in range(2))
    first = measure(true, one, rng, 5e-5, 2e-4)
    there = measure(replace(true, base=true.frame('base_2')), other, rng, 5e-5, 2e-4)
    mixed = np.where(np.arange(40)[:, np.newaxis] < 3, 1e3, 1.0) * there.positions
    second = replace(there, base='base_2', positions=mixed)
    problem = Problem(arm.with_frame('base_2', true.frame('base_2')), first, more=(second,))
    found = str(diagnose_alone(problem, true))
    assert found.startswith('in the measurements with base_2 alone, in lines 1 to 3 alone')


def test_lengths_of_a_wire_are_no_repeated_positions():
    """It measures none: those of its table are zeros."""
    arm, rng = load_chain('ur10e'), np.random.default_rng(2)
    true, q = faulty(arm, Cell(), rng), arm.random_joints(20, rng)
    zeros = Observations.from_arrays(q, np.zeros((20, 3)))
    wire = replace(zeros, distances=np.linalg.norm(true.forward(q)[:, :3, 3], axis=1))
    assert diagnose_alone(Problem(arm, wire), true) is None


def test_mistakes_of_many_rows_are_searched_in_some_of_them(monkeypatch):
    """Half a table of 60,000 rows in mm took 19 s."""
    arm, rng, tried = load_chain('ur10e'), np.random.default_rng(2), []

    def spy(each):
        each = [*each]
        tried.extend(len(one) for _, sets in each for one in sets)
        return trials.trials_of(each)

    monkeypatch.setattr(mistakes, 'trials_of', spy)
    true, q = faulty(arm, Cell(), rng), arm.random_joints(5 * SOME_POSES, rng)
    seen = measure(true, q, rng, 5e-5, 2e-4)
    late = np.arange(len(q))[:, np.newaxis] >= SOME_POSES
    seen = replace(seen, positions=np.where(late, 1e3, 1.0) * seen.positions)
    found = str(diagnose_alone(Problem(arm, seen), true))
    assert found.startswith(f'in lines {SOME_POSES + 1} to {len(q)} alone, the ')
    assert max(tried) <= SOME_POSES


@pytest.mark.parametrize('change', [{}, {'socket': True}, {'pixels': 1}])
def test_rows_are_not_told_apart_in_sockets_images_or_several_sets(change):
    seen = SimpleNamespace(**{'socket': False, 'pixels': None} | change)
    sets = (seen,) if change else (seen, seen)
    assert mistakes._in_some_rows(SimpleNamespace(sets=sets), None, sets, None) is None


@pytest.mark.parametrize('share', [0.99, 1.01])
def test_an_arm_is_far_off_by_its_largest_errors_of_position_and_angle(share):
    """A third of the angle counts, by the lever."""
    *_, seen = measured_arm(1, 20)
    problem = Problem(UR10E, replace(seen, joints=seen.joints * [1, 1, -1, 1, 1, 1]))
    half = 0.5 * share * trials.in_frames(problem, UR10E, problem.sets).error
    limits = {'largest_error': half, 'largest_angle': 3.0 * half / LEVER}
    assert (diagnose(replace(problem, **limits), far=True) is None) == (share > 1.0)


@pytest.mark.parametrize(('what', 'largest'), [('rms_mm', 10.0), ('rms_mrad', 20.0)])
@pytest.mark.parametrize('number', range(3))
def test_errors_larger_than_those_of_faulty_arms_are_suspicious(what, largest, number):
    limits = {'largest_error': 0.01, 'largest_angle': 0.02, 'largest_length': 0.1}
    for share in (0.99, 1.01):
        figures = [SimpleNamespace(rms_mm=0.0, rms_mrad=None) for _ in range(3)]
        setattr(figures[number], what, share * largest)
        before, after, fitted = figures
        judged = SimpleNamespace(figures_of_all=(before, after), share_of_outliers=0.0)
        result = SimpleNamespace(
            converged=True,
            refusals=(),
            coupled=0.0,
            comparison=judged,
            fitted=SimpleNamespace(figures_of_all=(fitted, None)),
            parameters=(),
        )
        problem = SimpleNamespace(**limits, sets=())
        assert mistakes._suspicious(problem, result) == (share > 1.0)


@pytest.mark.parametrize(('of_messages', 'unit'), [(False, ' (--length mm)'), (True, '')])
def test_another_unit_is_named_whatever_else_is_wrong(of_messages, unit):
    """Millimetres in reversed rows: "RMS 975,599 mm remains", or a move of 2.6e+06 mm."""
    _, _, seen = measured_arm(1, 30, oriented=False)
    wrong = replace(seen, positions=1e3 * seen.positions, joints=seen.joints[::-1].copy())
    found = diagnose(Problem(UR10E, wrong, of_messages=of_messages))
    assert f'more than an arm of 1.78 m can cause: are they in mm{unit}, with' in str(found)
