# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which of equivalent mistakes are named, and which may occur together."""

import re
from dataclasses import replace
from functools import reduce
from itertools import combinations, pairwise

import numpy as np
import pytest
from fits import SCARA, measured_arm

from calib_ros import Observations, Problem, identify, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.decision.mistakes import diagnose
from calib_ros.decision.printed_board import size_of
from calib_ros.decision.suspects import UNHOLD, hidden, suspects
from calib_ros.decision.undoing import Suspect, mirrored
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Frame

DEGREES = 'and the joint values in degrees'
BASE_ZERO = 'has its zero 90 degrees away'
IN_FILE = r'(?:sign: (\S+))?(?: and )?(?:theta (\S+) degrees)? in the chain file'
LAST = 'linear_axis_joint and shoulder_pan_joint last'
RANKS = {
    'the positions and linear joints are in mm, not metres': (1, 'measured'),
    f'the positions and linear joints are in mm, not metres {DEGREES}': (2, 'measured'),
    'the positions are in mm, not metres': (2, 'measured'),
    'the linear joints are in mm, not metres': (2, 'measured'),
    'the quaternions are w x y z, not x y z w': (1, 'measured'),
    f'the quaternions are w x y z, not x y z w, {DEGREES}': (2, 'measured'),
    'the axes of the measuring device are left-handed': (3, 'handed'),
    'the joint values are in degrees, not radians': (1, 'measured'),
    f'elbow_joint {BASE_ZERO}': (1, 'elbow_joint'),
    'elbow_joint counts the other way round': (1, 'elbow_joint'),
    f'elbow_joint counts the other way round and {BASE_ZERO}': (2, 'elbow_joint'),
    'elbow_joint and wrist_1_joint are swapped': (2, 'order'),
    'the joints are in the order from tool to base': (2, 'order'),
    f'the joints are in another order, {LAST}': (2, 'order'),
    'the device moves with linear_axis_joint': (1, ''),
    'elbow_joint did not move': (1, ''),
    'elbow_joint is not given against shoulder_lift_joint: they are coupled': (2, 'elbow_joint'),
    'elbow_joint is in degrees, the other joints in radians': (2, 'elbow_joint'),
    'the DH table is in the modified convention, not the standard one': (3, ''),
    'the chain file gives a wrong base (fixed: true)': (3, ''),
    'the chain file gives a wrong tool (fixed: true)': (3, ''),
    'the chain file gives a wrong base and tool (fixed: true)': (3, ''),
    'the coordinates x, y, z of the positions are -x, y, z': (3, 'measured'),
    'the coordinates x, y, z of the positions are y, z, x': (2, 'measured'),
    'the joint values are 2 rows above their measurement': (2, ''),
}


def test_simple_mistakes_are_named_before_double_and_far_fetched_ones(rng):
    """Mistakes of one part exclude each other; without one they are alone."""
    rail = load_chain('ur10e_on_linear_axis')
    held = replace(rail, base=Frame(fixed=True), tool=Frame(fixed=True))
    seen = measure(held, rail.random_joints(20, rng), rng)
    found = {each.what: (each.rank, each.part) for each in suspects(held, (seen,))}
    assert {what: found.get(what) for what in RANKS} == RANKS
    ends = [e.remedy for e in suspects(held, (seen,)) if e.remedy.startswith('leave ')]
    tails = [','.join(f'q{k}=0' for k in range(first, 8)) for first in range(7, 1, -1)]
    assert [each.split()[-1] for each in ends] == ['q1=0', *tails]  # of the seven columns
    assert 'the coordinates x, y, z of the positions are -x, -y, -z' not in found  # left-handed
    assert 'the lengths of the chain file are in mm, not metres' not in found  # shorter than 0.1 m
    assert (
        'shoulder_pan_joint is not given against linear_axis_joint: they are coupled' not in found
    )
    sister = replace(load_chain('ur5e'), base=None, tool=None)
    of_six = seen.changed(joints=seen.joints[:, 1:])
    others = [e for e in suspects(sister, (of_six,)) if 'arm is a' in e.what]
    assert {each.rank for each in others} == {2}
    assert 'ur10e' in {each.chain.name for each in others}


@pytest.mark.parametrize('oriented', [False, True])
def test_a_target_that_the_last_joints_do_not_move_is_named(rng, oriented):
    """It was said that joints 4, 5 and 6 were in degrees, or nothing but a large error."""
    nominal = load_chain('staubli_tx90l')
    true = faulty(nominal, Cell(), rng)
    joints = nominal.random_joints(40, rng)
    on_forearm = np.where(np.arange(6) < 3, joints, 0.0)
    seen = measure(true, on_forearm, rng, 5e-5, 2e-4, oriented).changed(joints=joints)
    last = ', '.join(nominal.joint_names[3:])
    named = f'does not move with {last}: leave {last} out of the chain file, or --columns q4=0,'
    assert named in str(diagnose(Problem(nominal, seen)))


@pytest.mark.parametrize(('joint', 'oriented'), [(1, False), (2, False), (2, True)])
def test_a_joint_that_stood_still_is_named(rng, joint, oriented):
    """It was said that linear joints were in mm, cm or inches, or the elbow in degrees."""
    true, joints = faulty(SCARA, Cell(), rng), SCARA.random_joints(40, rng)
    stood = np.where(np.arange(4) == joint, joints[0], joints)
    seen = measure(true, stood, rng, 5e-5, 2e-4, oriented).changed(joints=joints)
    told = str(diagnose(Problem(SCARA, seen)))
    assert told.startswith(f'{SCARA.joint_names[joint]} did not move: check its brake, ')


def test_positions_of_a_point_in_a_camera_on_the_flange_are_named(rng):
    """A ball before a 3D camera, taken for positions of the flange; and the reverse."""
    nominal = load_chain('franka_panda')
    true = faulty(nominal, Cell(), rng)
    joints = nominal.random_joints(40, rng)
    flange = np.linalg.inv(true.forward(joints))
    positions = flange[:, :3, 3] + flange[:, :3, :3] @ [1.0, 0.2, 0.5]
    seen = Observations.from_arrays(joints, positions)
    for given, named in (
        (seen, 'seen by a camera on the flange: --eye-in-hand'),
        (seen.changed(positions=1e3 * positions).inverted(), 'are in mm, not metres: --length mm'),
        (measure(true, joints, rng, oriented=False).inverted(), 'not on the flange: leave out'),
    ):
        assert named in str(diagnose(Problem(nominal, given)))


def test_mistakes_of_joints_hide_each_other_and_behind_another_hand(rng):
    """Of two joints by any sign and zero, of three by their signs."""
    arm = load_chain('ur10e')
    seen = measure(arm, arm.random_joints(5, rng), rng)
    options = [*suspects(arm, (seen,))]
    coupled = {each.what for each in options if each.what.endswith(': they are coupled')}
    pairs = pairwise(arm.joint_names)
    assert coupled == {f'{k} is not given against {j}: they are coupled' for j, k in pairs}
    found = hidden(arm, options)
    others = [each for each in options if each.part in ('handed', 'order')]
    two = 15 * 7 * 7
    assert len(found) == two + 6 * len(others) + 20
    assert {len(these) for these in found[:-20]} == {2}
    told = [{each.part for each in these} for these in found[:two]]
    assert {len(parts) for parts in told} == {2}
    turned, flipped = set(), set()
    for these in (*found[:two], *found[-20:]):
        (undone,) = reduce(lambda sets, each: each.undo_in(sets), these, (seen,))
        signs = np.diff(undone.joints, axis=0) / np.diff(seen.joints, axis=0)
        np.testing.assert_allclose(np.abs(signs), 1.0)
        zeros = undone.joints[0] - np.sign(signs[0]) * seen.joints[0]
        turned.add((*np.sign(signs[0]), *np.round(zeros, 6)))
        if not np.any(np.abs(zeros) > 1e-9):
            flipped.add(tuple(np.flatnonzero(signs[0] < 0.0)))
    assert len(turned) == two + 20
    assert flipped == {*combinations(range(6), 2), *combinations(range(6), 3)}


@pytest.mark.parametrize(('count', 'told'), [(3, False), (4, True)])
def test_three_joints_in_reverse_are_two_that_are_swapped(count, told, rng):
    arm = replace(SCARA, joints=SCARA.joints[:count])
    seen = measure(arm, arm.random_joints(5, rng), rng)
    found = {each.what for each in suspects(arm, (seen,))}
    assert ('the joints are in the order from tool to base' in found) == told
    assert 'arm and quill are swapped' in found


@pytest.mark.parametrize(
    ('remedy', 'sign', 'zero'),
    [('q3=-q3', -1.0, 0.0), ('q3=q3+1.57079', 1.0, 0.5), ('q3=-q3-1.57079', -1.0, -0.5)],
)
def test_sign_and_zero_of_a_joint_are_undone(remedy, sign, zero, rng):
    arm = load_chain('ur10e')
    seen = measure(arm, arm.random_joints(5, rng), rng)
    found = [each for each in suspects(arm, (seen,)) if f'--columns {remedy}' in each.remedy]
    (undone,) = found[0].undo_in((seen,))
    wanted = seen.joints.copy()
    wanted[:, 2] = sign * wanted[:, 2] + zero * np.pi
    np.testing.assert_allclose(undone.joints, wanted)


ALL = 'the positions and linear joints are in'
DEGREE = 180.0 / np.pi


@pytest.mark.parametrize(
    ('what', 'positions', 'travel', 'angles'),
    [
        (f'{ALL} mm, not metres', 1e3, 1e3, 1.0),
        (f'{ALL} metres, not cm', 1e-2, 1e-2, 1.0),
        (f'{ALL} mm, not metres {DEGREES}', 1e3, 1e3, DEGREE),
        (f'{ALL} metres, not inches {DEGREES}', 0.0254, 0.0254, DEGREE),
        ('the positions are in mm, not metres', 1e3, 1.0, 1.0),
        ('the positions are in metres, not inches', 0.0254, 1.0, 1.0),
        ('the positions are in feet, not metres', 1.0 / 0.3048, 1.0, 1.0),
        ('the linear joints are in cm, not metres', 1.0, 1e2, 1.0),
        ('the linear joints are in metres, not mm', 1.0, 1e-3, 1.0),
        ('the joint values are in degrees, not radians', 1.0, 1.0, DEGREE),
        ('the joint values are in radians, not degrees', 1.0, 1.0, 1.0 / DEGREE),
    ],
)
def test_units_are_undone(what, positions, travel, angles, rng):
    rail = load_chain('ur10e_on_linear_axis')
    seen = measure(rail, rail.random_joints(5, rng), rng)
    spoilt = replace(
        seen,
        positions=positions * seen.positions,
        joints=seen.joints * np.array([travel, *[angles] * 6]),
    )
    (found,) = (each for each in suspects(rail, (spoilt,)) if each.what == what)
    (undone,) = found.undo_in((spoilt,))
    np.testing.assert_allclose(undone.positions, seen.positions)
    np.testing.assert_allclose(undone.joints, seen.joints)


def test_lengths_and_convention_of_a_chain_are_undone(rng):
    arm = load_chain('ur10e')
    arm = replace(arm, joints=(replace(arm.joints[0], b=0.1), *arm.joints[1:]))
    large = [replace(j, a=1e3 * j.a, b=1e3 * j.b, d=1e3 * j.d) for j in arm.joints]
    seen = measure(arm, arm.random_joints(5, rng), rng)
    found = {e.what: e.chain for e in suspects(replace(arm, joints=tuple(large)), (seen,))}
    undone = found['the lengths of the chain file are in mm, not metres']
    np.testing.assert_allclose(undone.table, arm.table)
    modified = found['the DH table is in the modified convention, not the standard one']
    assert modified.convention == 'modified'
    back = {e.what: e.chain for e in suspects(modified, (seen,))}
    standard = back['the DH table is in the standard convention, not the modified one']
    assert (standard.convention, standard.parallel) == ('standard', arm.parallel)


def quaternions(order):
    return lambda turns: se3.from_quat(se3.to_quat(turns)[:, order])


@pytest.mark.parametrize('inverse', [False, True])
@pytest.mark.parametrize(
    ('what', 'written'),
    [
        ('the quaternions are w x y z, not x y z w', quaternions([3, 0, 1, 2])),
        ('the quaternions are x y z w, not w x y z', quaternions([1, 2, 3, 0])),
        (
            'the rotations are transposed: they are of the device in the target',
            lambda turns: np.swapaxes(turns, 1, 2),
        ),
    ],
)
def test_ways_to_write_a_pose_are_undone_in_the_poses_as_measured(what, written, inverse, rng):
    """Also with other units; those of a camera on the flange are inverted before and after."""
    arm = load_chain('ur10e')
    seen = measure(arm, arm.random_joints(9, rng), rng)
    for more, length, angle in (
        ('', 1.0, 1.0),
        (', and the positions in mm', 1e3, 1.0),
        (f', {DEGREES}', 1.0, 180.0 / np.pi),
        (f', the positions in mm {DEGREES}', 1e3, 180.0 / np.pi),
    ):
        spoilt = replace(
            seen,
            joints=angle * seen.joints,
            positions=length * seen.positions,
            rotations=written(seen.rotations),
        )
        spoilt, given = (each.inverted() if inverse else each for each in (spoilt, seen))
        (found,) = (each for each in suspects(arm, (spoilt,)) if each.what == what + more)
        (undone,) = found.undo_in((spoilt,))
        for name in ('joints', 'positions', 'rotations'):
            np.testing.assert_allclose(getattr(undone, name), getattr(given, name), atol=1e-9)


def test_another_robot_stands_where_the_given_one_is_said_to(rng):
    """And carries its target; nothing else is told of frames that are given."""
    base, tool = (Frame(random_frame(rng, 1.0).matrix, fixed=True) for _ in range(2))
    arm = replace(load_chain('ur10e'), base=base, tool=tool, frames=(('base_2', base),))
    seen = measure(arm, arm.random_joints(9, rng), rng)
    others = [each.chain for each in suspects(arm, (seen,)) if each.what.startswith('the arm is')]
    assert len(others) > 3
    assert all((each.base, each.tool) == (base, tool) for each in others)
    assert all(each.frame('base_2') == base for each in others)


def test_a_mirror_turns_one_axis_round_and_nothing_else(rng):
    arm = load_chain('ur10e')
    seen = measure(arm, arm.random_joints(9, rng), rng)
    signs = np.array([1.0, -1.0, 1.0])
    found = mirrored(seen)
    np.testing.assert_array_equal(found.positions, signs * seen.positions)
    turns = se3.log_rotation(seen.rotations) * -signs  # about y alone as before
    np.testing.assert_allclose(found.rotations, se3.exp_rotation(turns), atol=1e-9)


@pytest.mark.parametrize('inverse', [False, True])
@pytest.mark.parametrize(
    ('what', 'matrix'),
    [
        ('the x coordinates alone are in mm, not metres', np.diag([1e3, 1.0, 1.0])),
        ('the positions are in mm, not metres', 1e3 * np.eye(3)),
        ('the coordinates x, y, z of the positions are y, z, x', np.eye(3)[[2, 0, 1]]),
        ('the coordinates x, y, z of the positions are -x, y, z', np.diag([-1.0, 1.0, 1.0])),
    ],
)
def test_what_is_wrong_with_coordinates_is_undone_as_measured(what, matrix, inverse, rng):
    arm = load_chain('ur10e')
    seen = measure(arm, arm.random_joints(9, rng), rng)
    spoilt = replace(seen, positions=seen.positions @ matrix.T)
    spoilt, given = (each.inverted() if inverse else each for each in (spoilt, seen))
    (found,) = (each for each in suspects(arm, (spoilt,)) if each.what == what)
    (undone,) = found.undo_in((spoilt,))
    np.testing.assert_allclose(undone.positions, given.positions, atol=1e-9)


@pytest.mark.parametrize(('size', 'times'), [(0.5, '2'), (1.25, '0.8'), (0.3, '3.33')])
def test_the_size_of_a_board_is_told_as_it_is_stated(size, times, rng):
    arm = load_chain('ur10e')
    seen = measure(arm, arm.random_joints(20, rng), rng)
    stated = replace(seen, positions=seen.positions / size)
    found = list(suspects(arm, (stated,), of_images=True))
    (board,) = (each for each in found if each.what.startswith('the board is'))
    assert board.what == f'the board is stated {times} times as large as it is'
    np.testing.assert_allclose(board.undo_in((stated,))[0].positions, seen.positions)
    camera, *of_prints, joints = found[:4]
    assert camera.published == 'set eye_in_hand=true in sources'
    (back, *_) = suspects(arm, (stated.inverted(),), of_images=True)
    assert back.published == 'set eye_in_hand=false in sources'
    assert {each.part for each in found[:4]} == {'measured'}
    assert all(each.published == each.remedy for each in of_prints)
    assert (joints.remedy, joints.published) == ('correct it in --places', Suspect.published)
    assert {each.remedy for each in found if each.rows} == {'correct it in --places'}
    assert 'convention: modified in the chain file' in {each.remedy for each in found}


def test_what_is_wrong_in_the_chain_file_is_not_to_be_corrected_in_the_places(rng):
    """Of images, lengths in mm and a frame held wrongly were sent there."""
    arm = load_chain('ur10e')
    seen = measure(arm, arm.random_joints(20, rng), rng)
    long = [replace(j, a=1e3 * j.a, d=1e3 * j.d) for j in arm.joints]
    wrong = replace(arm, joints=tuple(long), base=Frame(fixed=True))
    remedies = {each.remedy for each in suspects(wrong, (seen,), of_images=True) if each.chain}
    assert {'give metres there', UNHOLD} <= remedies
    assert 'correct it in --places' not in remedies


@pytest.mark.parametrize('seed', range(4))
def test_a_board_that_is_seen_in_one_place_has_no_size(seed):
    rng, arm = np.random.default_rng(seed), load_chain('ur10e')
    seen = measure(arm, arm.random_joints(20, rng), rng)
    assert size_of(arm, seen) == pytest.approx(1.0)
    assert size_of(arm, replace(seen, positions=np.zeros_like(seen.positions))) == 1.0


@pytest.mark.parametrize(
    ('kind', 'which', 'accepted'),
    [
        ('d', ['joint_3'], False),
        ('alpha', ['joint_3'], False),
        ('a', ['joint_2', 'joint_3'], False),
        ('a', ['joint_3'], True),  # 20 mm, which the fit finds
    ],
)
def test_a_wrong_sign_in_the_dh_table_is_named(kind, which, accepted, rng, single):
    puma = load_chain('puma560')
    own = [replace(j, a=1.1 * j.a, d=1.1 * j.d) for j in puma.joints]  # no supplied arm
    arm = replace(puma, joints=tuple(own), name='own')
    rows = [replace(j, **{kind: -getattr(j, kind)}) if j.name in which else j for j in arm.joints]
    wrong = replace(arm, joints=tuple(rows), parallel=None)
    *_, seen = measured_arm(rng, 24, chain=arm)
    problem = Problem(wrong, seen)
    said = identify(problem).remarks[0] if accepted else str(diagnose(problem))
    of = which[0] if len(which) == 1 else 'all joints'
    assert f'{kind} of {of} has the other sign: correct {kind} in the chain file (in a U' in said


def test_signs_and_zeros_to_set_in_the_chain_file_do_what_the_columns_do(rng):
    """A joint that counts the other way round in the file turns the other way, too."""
    fanuc = load_chain('fanuc_r2000ic_165f')
    assert {joint.sign for joint in fanuc.joints} == {1, -1}
    seen = measure(fanuc, fanuc.random_joints(5, rng), rng)
    checked = 0
    for each in suspects(fanuc, (seen,)):
        if told := re.fullmatch(IN_FILE, each.published):
            sign, theta = told.groups()
            joints = [
                replace(
                    joint,
                    sign=int(sign or joint.sign),
                    theta=joint.theta + np.radians(float(theta or 0.0)),
                )
                if joint.name == each.part
                else joint
                for joint in fanuc.joints
            ]
            (undone,) = each.undo_in((seen,))
            found = replace(fanuc, joints=tuple(joints)).forward(seen.joints)
            np.testing.assert_allclose(found, fanuc.forward(undone.joints), atol=1e-9)
            checked += 1
    assert checked == 6 * 7


@pytest.mark.filterwarnings('error')
def test_one_orientation_among_positions_gives_no_warning_of_numpy():
    _, chain, seen = measured_arm(0, 10)
    some = [replace(seen, oriented=np.arange(10) < count) for count in (1, 2)]
    one, two = ({s.what for s in suspects(chain, [each])} for each in some)
    assert one <= two
