# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Mistakes that are named. `benchmarks/mistakes.py` tries all of them on measured robots."""

from dataclasses import replace

import numpy as np
import pytest
from fits import UR10E as UR, measured_arm
from scipy.spatial.transform import Rotation

from calib_ros import Chain, Problem, identify, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.decision.mistakes import diagnose
from calib_ros.decision.orders import constant_axes
from calib_ros.decision.rotation_conventions import misread
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Frame, Joint


def seen_of(chain=UR, seed=1, count=24, oriented=True):
    return measured_arm(seed, count, chain=chain, oriented=oriented)[2]


def joints(change):
    return lambda each: replace(each, joints=change(each.joints))


def turned(order):
    return lambda e: replace(e, rotations=se3.from_quat(se3.to_quat(e.rotations)[:, order]))


def later(each):
    short = each.select(np.arange(len(each) - 1))
    return replace(short, joints=each.joints[1:])


def rewritten(read, written, size=1.0):
    """Angles about x, y and z, or a rotation vector (''), are written and read otherwise."""

    def change(each):
        turns = Rotation.from_matrix(each.rotations)
        angles = turns.as_rotvec()
        if written:
            angles = turns.as_euler(written)[:, [written.index(axis) for axis in 'XYZ']]
        made = Rotation.from_rotvec(size * angles)
        if read:
            in_turn = size * angles[:, ['XYZ'.index(axis) for axis in read]]
            made = Rotation.from_euler(read, in_turn)
        return replace(each, rotations=made.as_matrix())

    return change


def _in_turn(rotations):
    angles = Rotation.from_matrix(rotations).as_euler('ZYX')
    return Rotation.from_euler('XYZ', angles).as_matrix()


COUPLED = np.eye(6)
COUPLED[2, 1] = 1.0
SIGNS = np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])
QUARTER = np.array([0.0, 0.0, 0.0, 0.5 * np.pi, 0.0, 0.0])
SPOILT = {
    'mm': (lambda e: replace(e, positions=1e3 * e.positions), '--length mm'),
    'degrees': (joints(np.degrees), '--joint-angle deg'),
    'both': (
        lambda e: replace(e, positions=1e3 * e.positions, joints=np.degrees(e.joints)),
        '--length mm --joint-angle deg',
    ),
    'both, and a lost beam': (
        lambda e: replace(
            e,
            positions=1e3 * e.positions * (np.arange(len(e)) != 9)[:, np.newaxis],
            joints=np.degrees(e.joints),
        ),
        '--length mm --joint-angle deg',
    ),
    'wxyz': (turned([3, 0, 1, 2]), '--quaternion wxyz'),
    'transposed': (
        lambda e: replace(e, rotations=np.swapaxes(e.rotations, 1, 2)),
        '--columns qx=-qx,qy=-qy,qz=-qz',
    ),
    'Euler order': (
        rewritten('XYZ', 'ZYX'),
        'ZYX (xyz about fixed axes), not XYZ (zyx about fixed axes): --euler ZYX, ',
    ),
    'Euler columns': (
        lambda e: replace(e, rotations=_in_turn(e.rotations)),
        '--euler ZYX --columns r1=rx,r2=ry,r3=rz (if so named)',
    ),
    'vectors': (rewritten('XYZ', ''), '--rotation-vector'),
    'no vectors': (rewritten('', 'XYZ'), '--euler XYZ'),
    'Euler radians': (rewritten('ZXY', 'ZXY', np.radians(1.0)), '--angle rad'),
    'vectors in radians': (rewritten('', '', np.radians(1.0)), '--angle rad'),
    'orientations': (rewritten('', '', np.degrees(1.0)), 'the orientations do not: check'),
    'Euler order and mm': (
        lambda e: replace(rewritten('XYZ', 'ZYX')(e), positions=1e3 * e.positions),
        'in mm, not metres, and the orientations do not fit either: --length mm',
    ),
    'inverse': (lambda e: replace(e.inverted(), inverse=False), '--eye-in-hand (or --inverse'),
    'eye in hand': (lambda e: e.inverted(), 'leave out --eye-in-hand'),
    'left-handed': (
        lambda e: replace(
            e,
            positions=e.positions * [1, -1, 1],
            rotations=np.diag([1.0, -1, 1]) @ e.rotations @ np.diag([1.0, -1, 1]),
        ),
        'y=-y',
    ),
    'sign': (joints(lambda q: SIGNS * q), 'q3=-q3'),
    'zero': (joints(lambda q: q + QUARTER), 'q4=q4-1.57079632679489'),
    'swapped': (joints(lambda q: q[:, [0, 1, 2, 4, 3, 5]]), 'q4=q5,q5=q4'),
    'reversed': (joints(lambda q: q[:, ::-1]), '--columns q1=q6,q2=q5,q3=q4,q4=q3,q5=q2,q6=q1'),
    'coupled': (joints(lambda q: q @ COUPLED.T), 'q3=q3-q2'),
    'shift': (later, '--shift -1 (added to one given)'),
}


TWO = ('shoulder_lift_joint', 'wrist_2_joint')
TWO_SIGNS, TWO_UNITS = (np.array([1.0, each, 1.0, 1.0, each, 1.0]) for each in (-1, 180.0 / np.pi))
PUBLISHED = {
    'orientations': 'check the orientations where they are published',
    'both': 'correct the publisher and measure again',
    'inverse': 'set eye_in_hand=true in sources',
    'sign': 'sign: -1 in the chain file',
    'zero': 'theta -90 degrees in the chain file',
    'swapped': 'swap them in joint_names',
    'reversed': 'set the order of joint_names',
    'shift': 'check the stamps',
}
POSITIONS_TELL = ('mm', 'degrees', 'both, and a lost beam', 'left-handed', 'sign', 'coupled')


@pytest.mark.parametrize(
    ('mistake', 'oriented'),
    [(name, name not in POSITIONS_TELL) for name in SPOILT],
)
def test_mistakes_are_named_with_the_option_to_give(mistake, oriented):
    change, remedy = SPOILT[mistake]
    found = diagnose(Problem(UR, change(seen_of(oriented=oriented))))
    assert remedy in str(found)
    assert len(found.suspects) <= 2
    assert 5.0 * found.corrected < found.given
    published = ' -- '.join(each.published for each in found.suspects)
    assert PUBLISHED.get(mistake, '') in published  # what is said of messages
    assert '--' not in published.replace(' -- ', '')


@pytest.mark.parametrize('number', [0, 6])
def test_a_joint_that_comes_before_the_device_or_behind_the_target_is_named(number):
    arm, rng = load_chain('ur10e_on_linear_axis'), np.random.default_rng(1)
    q = arm.random_joints(40, rng)
    q[:, number] = 0.0
    seen = measure(faulty(arm, Cell(), rng), q, rng, 5e-5, 2e-4, bool(number))
    q[:, number] = rng.uniform(0.0, 2.0, 40)
    found = diagnose(Problem(arm, replace(seen, joints=q))).suspects[0]
    assert f'with {arm.joint_names[number]}' in found.what
    assert f'q{number + 1}=0' in found.remedy


@pytest.mark.parametrize('keys', [('base',), ('tool',), ('base', 'tool')])
def test_frames_held_in_the_wrong_place_are_named(keys):
    """The device or the robot was said to have moved, and sent for."""
    shifted = se3.transform(np.eye(3), np.array([0.1, 0.2, 0.3]))
    held = replace(UR, **dict.fromkeys(keys, Frame(shifted, fixed=True)))
    assert f'wrong {" and ".join(keys)} (fixed' in str(diagnose(Problem(held, seen_of())))


def test_a_wrong_order_of_angles_is_named_where_the_tool_hardly_turns():
    rng = np.random.default_rng(1)
    q = np.array([0.3, -1.4, 1.6, 0.0, -1.5, 0.2]) + 0.1 * rng.uniform(-1.0, 1.0, (40, 6))
    q[:, :3] += rng.uniform(-0.5, 0.5, (40, 3))
    q[:, 3] -= np.pi / 2 + q[:, 1] + q[:, 2]
    q[:, 5] += q[:, 0]
    seen = measure(faulty(UR, Cell(), rng), q, rng, 5e-5, 2e-4)
    turn = seen.rotations[0].T
    near_none = replace(seen, rotations=turn @ seen.rotations, positions=seen.positions @ turn.T)
    found = diagnose(Problem(UR, rewritten('ZYX', 'XYZ')(near_none)))
    assert '--euler XYZ, ' in str(found)


SEVERAL = {
    'two signs': (
        joints(lambda q: TWO_SIGNS * q),
        [f'{name} counts the other way round (sign: -1 in the chain file)' for name in TWO],
    ),
    'signs that hide each other': (
        joints(lambda q: q * [1.0, -1.0, -1.0, 1.0, -1.0, 1.0]),
        [f'{name} counts the other way round' for name in (*TWO, 'elbow_joint')],
    ),
    'a swap and a sign': (
        joints(lambda q: (SIGNS * q)[:, [4, 1, 2, 3, 0, 5]]),
        ('--columns q1=q5,q5=q1', 'elbow_joint counts the other way round'),
    ),
    'two units': (
        joints(lambda q: TWO_UNITS * q),
        [f'{name} is in degrees, the other joints in radians' for name in TWO],
    ),
    'sign and zero, in mm': (
        lambda e: replace(e, joints=SIGNS * e.joints + QUARTER, positions=1e3 * e.positions),
        (
            'the positions are in mm, not metres (--length mm)',
            'elbow_joint counts the other way round (sign: -1 in the chain file)',
            'wrist_1_joint has its zero 90 degrees away (theta -90 degrees in the chain file)',
        ),
    ),
}


@pytest.mark.parametrize(
    ('mistakes', 'oriented'),
    [
        ('two signs', True),
        ('signs that hide each other', True),
        ('a swap and a sign', True),
        ('two units', False),
        ('sign and zero, in mm', False),
    ],
)
def test_mistakes_made_at_once_are_named(mistakes, oriented):
    change, said = SEVERAL[mistakes]
    found = str(diagnose(Problem(UR, change(seen_of(oriented=oriented)))))
    assert found.startswith('several mistakes at once: ')
    for each in said:
        assert each in found


def test_a_joint_with_another_sign_and_zero_is_named():
    seen = seen_of(oriented=False)
    turned = replace(seen, joints=SIGNS * seen.joints + np.eye(6)[2] * np.pi / 2)
    found = str(diagnose(Problem(UR, turned)))
    assert 'elbow_joint counts the other way round and has its zero 90 degrees away' in found
    said = (
        'sign: -1 and theta +90 degrees in the chain file, or --columns q3=-q3+1.570796326794897'
    )
    assert f'{said} (+90 if in degrees)' in found


@pytest.mark.parametrize(
    ('travel', 'positions', 'remedy'),
    [
        (1e3, 1e3, '--length mm'),
        (1e3, 1.0, '--columns q1=q1*0.001'),
        (1.0, 1e3, '--columns x=x*0.001,y=y*0.001,z=z*0.001'),
    ],
)
def test_linear_joints_in_millimetres_are_named(travel, positions, remedy):
    rail = load_chain('ur10e_on_linear_axis')
    seen = seen_of(rail)
    sizes = [travel if joint.type == 'prismatic' else 1.0 for joint in rail.joints]
    spoilt = replace(seen, joints=seen.joints * sizes, positions=positions * seen.positions)
    assert remedy in str(diagnose(Problem(rail, spoilt)))


def test_another_robot_and_the_other_convention_are_named():
    seen = seen_of()
    sister = load_chain('ur5e')
    shifted = replace(sister, joints=(replace(sister.joints[0], b=1e-3), *sister.joints[1:]))
    for chain in (sister, shifted):
        assert '--chain ur10e' in str(diagnose(Problem(chain, seen)))
    other = replace(UR, convention='modified', parallel=None)
    assert 'convention: standard' in str(diagnose(Problem(other, seen)))


@pytest.mark.parametrize(('b', 'size'), [(0.0, 1.0), (0.3, 1.0), (0.0, 0.03)])
def test_a_chain_file_in_millimetres_is_named(b, size):
    """Of an arm of 40 mm the positions were told to be in metres, not mm."""
    first, *others = UR.joints
    rows, arms = (replace(first, b=b), *others), []
    for k in (size, 1e3 * size):
        joints = [replace(j, a=k * j.a, b=k * j.b, d=k * j.d) for j in rows]
        arms.append(replace(UR, joints=tuple(joints)))
    named = str(diagnose(Problem(arms[1], seen_of(arms[0]))))
    assert named.startswith('the lengths of the chain file are in mm, not metres: give metres')
    assert ('--length m if the arm is' in named) == (size < 1.0)


@pytest.mark.parametrize(('stated', 'remarks'), [(0.1, 0), (0.01, 1)])
def test_orientations_that_do_not_fit_are_a_remark_where_the_rest_is_accepted(
    stated, remarks, single
):
    """Of a small target, say: 0.1 rad; nothing is said if that is what was stated."""
    *_, seen = measured_arm(1, 40, (5e-5, 0.1))
    found = identify(Problem(UR, seen, sigma_position=5e-5, sigma_orientation=stated))
    assert found.accepted
    assert len([each for each in found.remarks if 'orientations do not' in each]) == remarks


def test_another_robot_in_messages_is_named_as_the_chain_to_set():
    problem = Problem(load_chain('ur5e'), seen_of(), of_messages=True)
    assert 'set chain (--chain) to ur10e (' in str(diagnose(problem))


@pytest.mark.parametrize('held', [False, True])
def test_a_mistake_of_one_of_two_devices_is_named_with_its_frame(held):
    base = faulty(UR, Cell(), np.random.default_rng(1)).base  # that of `seen_of`
    first, second = seen_of(), SPOILT['mm'][0](seen_of())
    chain = replace(UR, base=replace(base, fixed=held), frames=(('base_2', None),))
    found = diagnose(Problem(chain, first, more=[replace(second, base='base_2')]))
    assert str(found).startswith('in the measurements with base_2 alone, the positions are in mm')


def test_large_errors_of_an_arm_are_no_mistake():
    *_, seen = measured_arm(0, 40, errors=10.0, oriented=False)
    assert identify(Problem(UR, seen)).accepted


def test_where_nothing_is_wrong_nothing_is_said(rng):
    poses, places = (seen_of(oriented=oriented) for oriented in (True, False))
    mixed = replace(poses, joints=rng.permutation(poses.joints))
    noisy = replace(places, positions=places.positions + rng.normal(scale=0.2, size=(24, 3)))
    for seen in (poses, places, mixed, noisy):
        assert diagnose(Problem(UR, seen)) is None


def test_motor_angles_of_a_small_arm_are_refused_whatever_its_error():
    """Around one posture the fit halves the errors of a few millimetres, on poses left out too."""
    rows = (
        {'a': 0.045, 'alpha': 0.5 * np.pi, 'd': 0.12},
        {'a': 0.165, 'theta': 1.2},
        {'a': 0.18, 'alpha': 0.5 * np.pi, 'theta': -1.2},
        {'d': 0.045},
    )
    small = Chain('small', 'standard', tuple(Joint(f'j{k + 1}', **r) for k, r in enumerate(rows)))
    rng = np.random.default_rng(1)
    q = rng.uniform(-0.5, 0.5, 4) + rng.uniform(-0.06, 0.06, (30, 4))
    seen = measure(faulty(small, Cell(1e-4, 2e-4), rng), q, rng, 5e-5, 2e-4)
    seen.joints[:, 2] += seen.joints[:, 1]
    result = identify(Problem(small, seen))
    before, after = result.validation.figures
    assert after.rms_mm < 0.7 * before.rms_mm < 10.0
    assert '--columns q3=q3-q2' in result.refusals[0]


def test_mistakes_are_named_where_some_orientations_are_missing():
    seen = seen_of()
    some = np.arange(len(seen)) % 2 == 0
    partly = replace(seen, oriented=some, positions=1e3 * seen.positions)
    assert '--length mm' in str(diagnose(Problem(UR, partly)))


@pytest.mark.parametrize(('read', 'meant'), [('XYZ', 'ZYX'), ('ZXY', 'XYZ'), ('XYZ', 'YXZ')])
def test_angles_read_in_another_order_are_those_meant_in_every_pose(read, meant):
    seen = seen_of()
    start = f'the Euler angles are {meant} (', f'fixed axes), not {read} ('
    (turn,) = (turn for what, _, turn in misread() if all(each in what for each in start))
    wrong = rewritten(read, meant)(seen)
    np.testing.assert_allclose(turn(wrong.rotations), seen.rotations, atol=1e-7)


@pytest.mark.parametrize(
    ('joint', 'oriented', 'unit', 'other'),
    [(0, True, 'radians', 'degrees'), (2, False, 'degrees', 'radians')],
)
def test_one_joint_in_another_unit_than_the_others_is_named(joint, oriented, unit, other):
    seen = seen_of(seed=5, oriented=oriented)
    mixed = seen.joints.copy()
    mixed[:, joint] *= np.degrees(1.0) if unit == 'degrees' else np.radians(1.0)
    said = str(diagnose(Problem(UR, replace(seen, joints=mixed))))
    told = f'{UR.joint_names[joint]} is in {unit}, the other joints in {other}: --columns '
    assert said.startswith(f'{told}q{joint + 1}=')


@pytest.mark.parametrize('oriented', [True, False])
@pytest.mark.parametrize(('columns', 'words'), [([1], 'y'), ([0, 2], 'x, z')])
def test_columns_that_never_change_are_named(columns, words, oriented):
    seen = seen_of(seed=5, oriented=oriented)
    places = seen.positions.copy()
    places[:, columns] = places[0, columns]
    told = str(diagnose(Problem(UR, replace(seen, positions=places))))
    assert f'same {words}, though the arm moves in all directions: give the column {words}' in told
    if oriented:  # of a camera on the flange, after two poses of another one
        held = replace(seen, positions=places).inverted()
        assert f'the same {words}, though' in constant_axes(UR, (held.select([0, 1]), held)).what


def test_a_planar_arm_square_to_the_device_has_no_dead_column():
    ends = {'lower': -2.5, 'upper': 2.5}
    chain = Chain('flat', 'standard', tuple(Joint(f'j{k}', a=0.3, **ends) for k in range(3)))
    rng = np.random.default_rng(0)
    seen = measure(chain, chain.random_joints(40, rng), rng, 0.0, 0.0, oriented=False)
    assert np.ptp(seen.positions[:, 2]) == 0.0
    assert constant_axes(chain, (seen,)) is None


def test_the_advice_not_to_hold_a_wrong_tool_is_given_once():
    held = Frame(se3.transform(np.eye(3), np.array([0.0, 0.08, 0.1])), fixed=True)
    refusals = identify(Problem(replace(UR, tool=held), seen_of())).refusals
    (told,) = (each for each in refusals if 'fixed: true' in each)
    assert 'gives a wrong tool' in told
