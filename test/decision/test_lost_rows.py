# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rows lost, columns in another order: joints and measurements do not match."""

import re
from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, UR10E, arm, measured_arm
from scipy.spatial.transform import Rotation

from calib_ros import Problem, identify
from calib_ros.apply.simulation import measure
from calib_ros.decision import lost_rows, orders
from calib_ros.decision.lost_rows import _sides_differ, _where, row_loss
from calib_ros.decision.mistakes import diagnose
from calib_ros.estimation.levels import LEAST_ASIDE
from calib_ros.kinematics.chain_file import load_chain


@pytest.mark.parametrize(
    ('positions', 'joints', 'oriented', 'said'),
    [
        ([9], [-1], True, 'from line 11 on the joint values are 1 row below'),
        ([-2, -1], [21, 22], True, 'from line 22 on the joint values are 2 rows above'),
        ([35, 36], [0, 1], False, 'before line 38 the joint values are 2 rows above'),
    ],
)
def test_rows_lost_in_one_of_two_tables_are_named(positions, joints, oriented, said):
    """Joint values and measurements were put side by side, row by row."""
    *_, seen = measured_arm(1, 40, oriented=oriented)
    measured = seen.select(np.delete(np.arange(len(seen)), positions))
    kept = np.delete(seen.joints, joints, axis=0)
    told = str(diagnose(Problem(UR10E, replace(measured, joints=kept))))
    assert told.startswith(f'{said} their measurement')


@pytest.mark.parametrize(('row', 'told'), [(20, True), (30, False)])
def test_the_error_once_corrected_tells_nothing_where_most_rows_are_right(row, told):
    *_, seen = measured_arm(1, 40, oriented=False)
    kept = replace(seen.select(np.delete(np.arange(40), [row, 39])), joints=seen.joints[:-2])
    found = diagnose(Problem(UR10E, kept))
    assert f'from line {row + 2} on' in found.suspects[0].what
    assert (found.corrected < 1e-2) == told


@pytest.mark.parametrize(
    ('fewest', 'most', 'told'), [(38, 38, True), (39, 99, False), (1, 37, False)]
)
def test_a_loss_is_sought_in_tables_of_so_many_rows(fewest, most, told, monkeypatch):
    monkeypatch.setattr(lost_rows, 'FEWEST_ROWS', fewest)
    monkeypatch.setattr(lost_rows, 'MOST_SEARCHED', most)
    *_, seen = measured_arm(1, 40, oriented=False)
    kept = replace(seen.select(np.delete(np.arange(40), [20, 39])), joints=seen.joints[:-2])
    found = row_loss(Problem(UR10E, kept), UR10E, kept, 5e-3)
    assert (found is not None) == told


def test_rows_lost_before_the_first_and_again_later_are_not_told_as_one():
    """Corrected as told, the first half would still stand one row off."""
    *_, seen = measured_arm(1, 40, oriented=False)
    rows = np.delete(np.arange(40), [0, 20])
    shifted = replace(seen.select(rows), joints=seen.joints[:-2])
    assert row_loss(Problem(UR10E, shifted), UR10E, shifted, 5e-3) is None


@pytest.mark.parametrize(
    ('order', 'oriented', 'said'),
    [
        (np.arange(40)[::-1], True, 'are in the reverse order of the measurements'),
        (sorted(range(40), key=str), False, 'joint values are sorted as text (0, 1, 10 ...)'),
        ([int(k) - 1 for k in sorted(map(str, range(1, 41)))], True, 'as text (1, 10, 1'),
        (np.argsort(sorted(range(40), key=str)), False, 'measurements are sorted as text (0, 1, '),
        ('elbow_joint', True, 'other orders of the rows, and one way from row to row goes elbow_'),
        ('x', False, 'other orders of the rows, and one way from row to row goes x'),
    ],
)
def test_rows_of_joint_values_in_another_order_are_named(order, oriented, said):
    *_, seen = measured_arm(1, 40, oriented=oriented)
    if isinstance(order, str) and order == 'x':
        other = seen.select(np.argsort(seen.positions[:, 0]))
        mixed = replace(other, joints=seen.joints, stamps_ns=seen.stamps_ns)
    else:
        own = np.argsort(seen.joints[:, 2]) if isinstance(order, str) else order
        mixed = replace(seen, joints=seen.joints[own])
    found, error = orders.other_order(Problem(UR10E, mixed), UR10E, mixed, 0.01)
    assert said in found.what
    assert (error < 5e-3) != isinstance(order, str)


def test_no_several_mistakes_at_once_explain_another_order():
    *_, seen = measured_arm(1, 40, oriented=False)
    found = diagnose(Problem(UR10E, replace(seen, joints=seen.joints[::-1])))
    assert str(found).startswith('the joint values are in the reverse order')


@pytest.mark.parametrize('k', range(6))
def test_the_values_of_one_joint_sorted_alone_are_named(k):
    """Of a wrist they still fit three times better than in other orders of all rows."""
    *_, seen = measured_arm(1, 40)
    joints = seen.joints.copy()
    joints[:, k] = np.sort(joints[:, k])
    mixed = replace(seen, joints=joints)
    found, _ = orders.other_order(Problem(UR10E, mixed), UR10E, mixed, 0.01)
    assert f'goes {UR10E.joint_names[k]}' in found.what


def test_rows_that_fit_are_in_no_other_order_nor_are_those_of_messages():
    *_, seen = measured_arm(1, 40, oriented=False)
    assert orders.other_order(Problem(UR10E, seen), UR10E, seen, 5e-3) is None
    swept = seen.select(np.argsort(seen.joints[:, 2]))
    assert orders.other_order(Problem(UR10E, swept), UR10E, swept, 1e-6) is None  # a worse arm
    back = replace(seen, joints=seen.joints[::-1])
    assert orders.other_order(Problem(UR10E, back), UR10E, back, 5e-3)
    messages = Problem(UR10E, back, of_messages=True)
    assert orders.other_order(messages, UR10E, back, 5e-3) is None


@pytest.mark.parametrize(
    ('before', 'after', 'row'),
    [('11100', '00111', 2), ('11110', '00011', 3), ('00000', '11111', 0), ('11111', '00000', 5)],
)
def test_the_row_is_the_first_that_leaves_most_to_fit(before, after, row):
    assert _where(*(np.array([*map(int, each)], dtype=bool) for each in (before, after))) == row


@pytest.mark.parametrize(
    ('own', 'other', 'found'),
    [
        (20, 0, True),
        (17, 0, True),  # all but nearly a fifth
        (16, 0, False),
        (20, 9, True),
        (20, 10, False),  # the other shift fits as many
    ],
)
@pytest.mark.parametrize('first', [True, False])
def test_each_side_of_a_lost_row_fits_by_its_own_shift(own, other, found, first):
    far = np.full((2, 20 + LEAST_ASIDE), 1.0)
    side, rest = (np.s_[:20], np.s_[20:]) if first else (np.s_[-20:], np.s_[:-20])
    which = int(not first)  # before or after
    far[which, side][:own] = 0.0
    far[1 - which, side][:other] = 0.0
    far[1 - which, rest] = 0.0
    row = 20 if first else LEAST_ASIDE
    assert _sides_differ(*far, row, 0.5) == found
    assert not _sides_differ(*far[:, :-1] if first else far[:, 1:], row - (not first), 0.5)


@pytest.mark.parametrize(('name', 'oriented'), [('ur10e', True), ('kuka_iiwa14', False)])
def test_any_order_of_the_joints_is_named(name, oriented):
    chain = load_chain(name)
    rng, _, seen = measured_arm(3, 40, chain=chain, oriented=oriented)
    order = rng.permutation(len(chain.joints))
    found = diagnose(Problem(chain, replace(seen, joints=seen.joints[:, order])))
    back = np.argsort(order)
    columns = ','.join(f'q{k + 1}=q{place + 1}' for k, place in enumerate(back))
    assert found.suspects[0].remedy == f'--columns {columns}'
    assert len(found.suspects) == 1
    stand = ', '.join(chain.joint_names[k] for k in order)  # the remedy of messages has no columns
    assert found.suspects[0].what == f'the joint values are in the order {stand}'


@pytest.mark.parametrize('size', [1e3, 1e-3])
def test_one_coordinate_in_another_unit_is_named(size):
    *_, seen = measured_arm(1, 30, oriented=size > 1.0)
    positions = seen.positions * [1.0, size, 1.0]
    found = diagnose(Problem(UR10E, replace(seen, positions=positions)))
    assert found.suspects[0].remedy == f'--columns y=y*{1.0 / size:g}'


@pytest.mark.parametrize(
    ('axes', 'option'), [([1, 0, 2], 'x=y,y=x,z=z'), ([2, 1, 0], 'x=z,y=y,z=x')]
)
def test_coordinates_of_the_positions_alone_in_another_order_are_named(axes, option):
    *_, seen = measured_arm(1, 30)
    found = diagnose(Problem(UR10E, replace(seen, positions=seen.positions[:, axes])))
    assert f'--columns {option}' in [each.remedy for each in found.suspects]


def test_a_coordinate_of_the_positions_alone_that_counts_the_other_way_is_named():
    *_, seen = measured_arm(1, 30)
    found = diagnose(Problem(UR10E, replace(seen, positions=seen.positions * [1.0, 1.0, -1.0])))
    assert [each.remedy for each in found.suspects] == ['--columns x=x,y=y,z=-z']


def test_euler_angles_about_fixed_axes_in_the_order_of_their_columns_are_named():
    """Of a Fanuc, W P R, read as those of a KUKA, A B C."""
    *_, seen = measured_arm(1, 30)
    angles = Rotation.from_matrix(seen.rotations).as_euler('xyz')
    wrong = Rotation.from_euler('ZYX', angles).as_matrix()
    (found,) = diagnose(Problem(UR10E, replace(seen, rotations=wrong))).suspects
    assert 'reverse the letters of --euler' in found.remedy


@pytest.mark.parametrize(
    ('order', 'oriented'), [('below', True), ('above', False), ('beside', True)]
)
def test_nominal_poses_among_measured_ones_are_named(order, oriented):
    """Under one header without a title they were fitted: half of the errors stayed."""
    rng, rows = np.random.default_rng(3), np.arange(80)
    nominal = {'below': rows >= 40, 'above': rows < 40, 'beside': rows % 2 == 1}[order]
    true, q = arm(rng), np.zeros((80, 6))
    q[nominal] = q[~nominal] = UR10E.random_joints(40, rng)
    seen = measure(true, q, rng, *NOISE, oriented)
    ideal = replace(UR10E, base=true.base, tool=true.tool).forward(q[nominal])
    seen.positions[nominal] = ideal[:, :3, 3]
    if oriented:
        seen.rotations[nominal] = ideal[:, :3, :3]
    first = identify(Problem(UR10E, seen)).refusals[0]
    where = {'below': 'lines 41 to 80', 'above': 'lines 1 to 40', 'beside': 'lines 2, 4'}[order]
    assert re.match(rf'{where}.* fit the uncorrected arm to .*: are these nominal', str(first))
    assert identify(Problem(UR10E, seen.select(~nominal))).accepted


def test_rows_beside_others_that_no_arm_explains_are_not_nominal():
    """Their joint values are of other moments, say; the arm's errors are not seen beside these."""
    rng, _, seen = measured_arm(3, 60)
    seen.positions[20:] += rng.normal(scale=0.5, size=(40, 3))
    assert not lost_rows.computed_rows(Problem(UR10E, seen))


@pytest.mark.parametrize(('count', 'width'), [(1, 0.0), (1, 0.01), (3, 0.0)])
@pytest.mark.parametrize('again', [slice(None, None, 2), slice(0, 20)])
def test_poses_measured_again_and_again_are_not_nominal(again, count, width):
    """Base and tool alone explain them, however wrong the arm is."""
    rng = np.random.default_rng(0)
    true, q = arm(rng), UR10E.random_joints(60, rng)
    q[again] = q[np.arange(len(q[again])) % count] + rng.uniform(-width, width, q[again].shape)
    seen = measure(true, q, rng, 2e-6, oriented=False)
    assert not lost_rows.computed_rows(Problem(UR10E, seen, sigma_position=1e-6))
