# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Columns whose names tell measured from nominal values, and which rotations they hold."""

import re
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from test_foreign import JOINTS, NAMES, PLACES, PLAIN, TURNED, assert_same, text_of

from calib_ros import Chain, Settings, read_table
from calib_ros.errors import ColumnsError, InputError
from calib_ros.files import loading
from calib_ros.files.foreign import Foreign
from calib_ros.files.layouts import Layout, layout_of
from calib_ros.files.names import matrix_in, turns_in
from calib_ros.files.vocabulary import TURNS
from calib_ros.kinematics.chain import Joint

ARM = Chain('arm', 'standard', (Joint('shoulder'), Joint('elbow')))
NOMINAL = PLACES + 0.25
QUATERNIONS = TURNED.as_quat()


def read(path, **given):
    return loading.table(path, ARM, Settings(), foreign=Foreign(layout_of(**given), ARM))


def test_columns_of_a_table_without_a_header_are_proposed_by_their_numbers(tmp_path):
    """Beside the names of its poses, as trackers and controllers export; it was x=NAME."""
    path, log = tmp_path / 'points.txt', tmp_path / 'log.txt'
    lines = text_of(PLACES, names='xyz').split()[1:]
    path.write_text(''.join(f'A::T::p{k}, {line}\n' for k, line in enumerate(lines)))
    log.write_text(''.join(f'p{k}\t{a}\t{b}\n' for k, (a, b) in enumerate(JOINTS.tolist())))
    layouts = [layout_of('', ['q1=#2,q2=#3'], {}), layout_of('', ['x=#2,y=#3,z=#4'], {})]
    for ours, theirs, said in (
        (layouts[1], Layout(), 'give --columns "q1=#2,q2=#3" or --joints-preset'),
        (Layout(), layouts[0], 'numbers, not names: --columns "x=#2,y=#3,z=#4", in its order'),
    ):
        with pytest.raises(InputError, match=said):
            read_table(path, 2, foreign=Foreign(ours, ARM, log, theirs))
    log.write_text(''.join(sorted(log.read_text().splitlines(True), reverse=True)))
    table = read_table(path, 2, foreign=Foreign(layouts[1], ARM, log, layouts[0]))
    np.testing.assert_array_equal(table.fitted[0].joints, JOINTS)
    path.write_text(''.join(f'{k}, {line}\n' for k, line in enumerate(lines)))
    with pytest.raises(InputError, match='names: --columns "x=#2,y=#3,z=#4", in its order'):
        read_table(path, 2, foreign=Foreign(Layout(), ARM, log, layouts[0]))
    log.write_text(3 * 'p={0.1,-0.2,0.5,9}\n')  # #2 and #3 are not q1 and q2
    with pytest.raises(InputError, match=r'give --columns "q\*=NAME\*" \(program: write its'):
        read_table(path, 2, foreign=Foreign(layouts[1], ARM, log))


@pytest.mark.parametrize('header', ['Q1,Q2,X,Y,Z', 'Shoulder [rad],elbow,X [m],Y [m],z [m]'])
def test_options_may_use_our_names_for_columns_that_need_none(path, header):
    """As messages about mistakes propose them: the table was said to have no column q1 or y."""
    path.write_text('a title\n' + header + PLAIN[PLAIN.index('\n') :])
    found, *_ = read(path, preset='', columns=['q1=q2,q2=-q1,y=2*y'], given={}).fitted
    np.testing.assert_allclose(found.joints, JOINTS[:, ::-1] * [1, -1])
    np.testing.assert_allclose(found.positions, PLACES * [1, 2, 1])
    with pytest.raises(InputError, match='no column q3'):
        read(path, preset='', columns=['q1=q3'], given={})


def names(form):
    return [form.format(axis) for axis in 'XYZ']


def proposed(path, said='.*'):
    """Return the table with the first option that the message proposes."""
    given, foreign = [], None
    for _ in range(2):
        with pytest.raises(InputError, match=said) as err:
            loading.table(path, ARM, Settings(), foreign=foreign)
        given.append(re.search('--columns "([^"]*)"', str(err.value))[1])
        assert 'NAME' not in given[-1], err.value
        foreign, said = Foreign(layout_of('', given, {}), ARM), '.*'
        with suppress(ColumnsError):
            return loading.table(path, ARM, Settings(), foreign=foreign)
    raise AssertionError(given)


PAIRS = [
    ('{}_nom', '{}_meas'),
    ('Nominal {}', 'Actual {}'),
    ('{} Soll', '{} Ist'),
    ('{} Nom', '{} Act'),
    ('{} (nominal)', '{} (measured)'),
    ('tcp.{}', 'leica.point.{}'),
    ('{}', '{}_meas'),
    ('{}', 'Actual {}'),
    ('{}', 'Tracker {}'),
    ('{} théorique', '{} mesuré'),
    ('{} nominale', '{} misurata'),
    ('{} teórico', '{} medido'),
    ('{}', '{}_true'),
    ('{}_corr', '{}_true'),
    ('{}', '{}meas'),
    ('{}', '{}M'),
    ('{}', '{}測定値'),
    ('{}nom', '{}act'),
]
JOINT_NAMES = (['q1', 'q2'], ['J1', 'J2'])


@pytest.mark.parametrize(
    ('first', 'second', 'joints'),
    [(*pair, JOINT_NAMES[k % 2]) for k, pair in enumerate(PAIRS)],
)
def test_nominal_coordinates_are_never_taken_for_measured_ones(path, first, second, joints):
    """Plain names beside measured ones were, without a word."""
    header = [*joints, *names(first), *names(second)]
    path.write_text(text_of(JOINTS, NOMINAL, PLACES, names=header))
    assert_same(proposed(path), None)
    path.write_text(text_of(JOINTS, PLACES, NOMINAL, names=[*joints, *header[5:], *header[2:5]]))
    assert_same(proposed(path), None)


@pytest.mark.parametrize('form', ['{}_nom', '{} (nominal)', 'Commanded {}', 'd{}'])
def test_nominal_coordinates_alone_are_not_proposed(guessed, form):
    with pytest.raises(InputError, match='--columns "x=NAME,y=NAME,z=NAME"'):
        guessed(text_of(JOINTS, NOMINAL, names=['q1', 'q2', *names(form)]))


def test_deviations_tell_that_plain_coordinates_may_be_nominal(path):
    columns = JOINTS, NOMINAL, PLACES - NOMINAL
    path.write_text(text_of(*columns, names=[*NAMES, 'dx', 'dy', 'dz']))
    assert_same(proposed(path, '"x=x,y=y,z=z" if they were measured'), None)
    path.write_text(text_of(*columns, names=['J1', 'J2', *names('{}'), *names('d{}')]))
    assert_same(proposed(path, '"x=X,y=Y,z=Z" if they were measured'), None)
    measured = JOINTS, PLACES, NOMINAL, PLACES - NOMINAL
    given = [*NAMES, *names('{}_nom'), 'dx', 'dy', 'dz']
    path.write_text(text_of(*measured, names=given))
    assert_same(read_table(path, 2), None)
    for apart in ('{}_std', '{}_vel', '{}min', 'residual{}'):  # others
        path.write_text(text_of(*columns, names=[*NAMES, *(apart.format(a) for a in 'xyz')]))
        assert len(loading.table(path, ARM, Settings()).fitted[0]) == 3


@pytest.mark.parametrize('form', ['{}_corr', '{}_t', '{}_flange', '{} (2)', 'Corrected {}'])
@pytest.mark.parametrize('ours', [NAMES[2:], ['X', 'Y', 'Z']])
def test_plain_coordinates_may_be_nominal_beside_any_others(guessed, path, form, ours):
    """They were read, with a note that the others were not."""
    given = [*NAMES[:2], *ours, *names(form)]
    path.write_text(text_of(JOINTS, NOMINAL, PLACES, names=given))
    assert_same(proposed(path, 'if they were measured'), None)
    for other in (
        '{}_nom',
        'Ziel {}',
        'n{}',
        'e{}',
    ):  # others tell what the plain ones are, or are no places
        given = [*NAMES[:2], *ours, *names(other)]
        assert_same(guessed(text_of(JOINTS, PLACES, NOMINAL, names=given)), None)


@pytest.mark.parametrize(
    ('first', 'second'),
    [
        ('q{}_cmd', 'q{}_act'),
        ('q{}', 'q{}_meas'),
        ('q{}', 'q{}.1'),
        ('q{}', 'q{}_fb'),
        ('q{}', 'encoder_{}'),
        ('q{}', 'q{}实际'),
        ('qdes{}', 'qact{}'),
        ('q{}', 'q{} (2)'),
        ('target_q_{}', 'actual_q_{}'),
        ('tau{}', 'A{}'),
        ('qd{}', 'th{}'),
        ('T{}', 'J{}'),
        ('current_{}', 'joint_{}'),
        ('joint_current_{}', 'joint_{}'),
        ('q{}_target', 'q{}_current'),
        ('velocity_{}', 'position_{}'),
        ('actual_qd_{}', 'actual_q_{}'),
        ('q{}_act_current', 'J{}'),
        ('actual_joint_voltage_{}', 'J{}'),
        ('q{}_act_speed', 'J{}'),
        ('q{}_meas_std', 'A{}'),
        ('Strom{}', 'Winkel{}'),
        ('Schleppfehler A{}', 'A{}'),
        ('Consigne axe {}', 'Position axe {}'),
        ('corriente{}', 'eje{}'),
        ('coppia{}', 'asse{}'),
    ],
)
def test_other_values_are_not_taken_for_measured_joints(path, first, second):
    given = [form.format(k) for form in (first, second) for k in (1, 2)]
    path.write_text(text_of(JOINTS + 0.01, JOINTS, PLACES, names=[*given, *NAMES[2:]]))
    assert_same(proposed(path), None)


@pytest.mark.parametrize('names', [('q1', 'q2'), ('x', 'y', 'z')])
def test_names_in_capitals_beside_small_ones_are_in_doubt(path, names):
    """The small ones were read, with a note that the others were not."""
    right = JOINTS if names[0] == 'q1' else PLACES
    given = [*NAMES, *map(str.upper, names)]
    wrong = [each + 0.01 if each is right else each for each in (JOINTS, PLACES)]
    path.write_text(text_of(*wrong, right, names=given))
    assert_same(proposed(path), None)


def test_joints_by_their_names_are_not_mixed_with_ours(guessed):
    """q1 to q4 of a quaternion, as ABB names them, were the first four joints."""
    table = guessed(text_of(JOINTS, PLACES, PLACES[:, :1], names=[*ARM.joint_names, *'xyz', 'q1']))
    assert_same(table, None)
    assert 'columns not read: q1 (' in str(table.warnings)


def test_joints_of_a_second_arm_are_not_taken_for_measured_ones(guessed):
    """They were asked for in place of q1 and q2."""
    assert_same(guessed(text_of(JOINTS, PLACES, JOINTS, names=[*NAMES, 'q2_1', 'q2_2'])), None)


@pytest.mark.parametrize('form', ['joint{}_speed', 'J{}_torque', 'A{}_power', 'q{}_act_current'])
def test_other_values_are_never_proposed_for_joints(guessed, form):
    given = [form.format(1), form.format(2), *NAMES[2:]]
    assert_same(guessed(text_of(JOINTS, JOINTS + 0.1, PLACES, names=[*NAMES[:2], *given])), None)
    with pytest.raises(InputError, match=r'--columns "q\*=NAME\*"; .*: --joints FILE'):
        guessed(text_of(JOINTS, PLACES, names=given))


@pytest.mark.parametrize('form', ['quat_{}', 'Quat {}', 'q_{}', 'orientation.{}', 'rot_{}'])
def test_quaternions_are_read_by_their_names(path, form):
    """They were left out with a note."""
    given = [*NAMES, *(form.format(axis) for axis in 'xyzw')]
    path.write_text(text_of(JOINTS, PLACES, QUATERNIONS, names=given))
    for foreign in (None, Foreign(Layout(), ARM)):
        table = read_table(path, 2, foreign=foreign)
        assert_same(table)
        assert any('qx' in note for note in table.warnings)
    for other in ('nominal_', 'tool2_'):
        given = [*NAMES, *(other + form.format(axis) for axis in 'xyzw')]
        path.write_text(text_of(JOINTS, PLACES, QUATERNIONS, names=given))
        assert not read_table(path, 2).fitted[0].oriented.any()


@pytest.mark.parametrize('prefix', ['pose.', '/leica/long/name/of/the/topic/pose/'])
def test_a_pose_of_ros_is_proposed(path, prefix):
    given = [f'/joint_states/{joint}/position' for joint in ARM.joint_names]
    given += [f'{prefix}position.{axis}' for axis in 'xyz']
    given += [f'{prefix}orientation.{axis}' for axis in 'xyzw']
    path.write_text(text_of(JOINTS, PLACES, QUATERNIONS, names=given))
    assert_same(proposed(path))
    given[:2] = '/joint_states/position[0]', '/joint_states/position[1]'
    path.write_text(text_of(JOINTS, PLACES, QUATERNIONS, names=given))
    assert_same(proposed(path))


@pytest.mark.parametrize('form', ['m_{}{}', 'T[{},{}]', 'pose{}_{}.measured'])
@pytest.mark.parametrize('first', [0, 1])
def test_a_homogeneous_matrix_is_proposed(tmp_path, form, first):
    path, poses = tmp_path / 'cell.csv', np.tile(np.eye(4), (len(PLACES), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = TURNED.as_matrix(), PLACES
    numbers = poses.reshape(-1, 16)
    places = [(i + first, j + first) for i in range(4) for j in range(4)]
    nominal = [f'nominal_{i}{j}' for i, j in places]
    given = ['theta_1', 'theta_2', *nominal, *(form.format(*each) for each in places)]
    path.write_text(text_of(JOINTS, numbers + 0.1, numbers, names=given, separator=';'))
    assert_same(proposed(path))
    measured = [form.format(*each) for each in places]
    assert len(matrix_in(measured)) == 12
    assert matrix_in([name for name in measured if name != measured[6]]) == {}


@pytest.mark.parametrize(
    ('angles', 'option'),
    [
        ('Roll,Pitch,Yaw', 'rx=Roll,ry=Pitch,rz=Yaw" --euler xyz'),
        ('A [deg],B [deg],C [deg]', 'r1=A,r2=B,r3=C" --euler ZYX'),
        ('W,P,R', 'rx=W,ry=P,rz=R" --euler xyz'),
    ],
)
def test_the_option_for_angles_is_told(path, angles, option):
    given = [*NAMES, *angles.split(',')]
    unit = 180 / np.pi if 'deg' in angles else 1.0
    turned = TURNED.as_euler(option[-3:]) * unit
    path.write_text(text_of(JOINTS, PLACES, turned, names=given))
    (note,) = (note for note in loading.table(path, ARM, Settings()).warnings if option in note)
    columns, euler = re.search('--columns "(.*)" --euler (.*)', note).groups()
    assert_same(
        read(path, preset='', columns=[columns], given={'euler': euler, 'joint_angle': 'rad'})
    )


def test_angles_named_by_their_axes_may_be_in_the_order_of_the_letters(path):
    """As a message about mistakes proposes; with rx, ry, rz beside them it could not be done."""
    path.write_text(text_of(JOINTS, PLACES, TURNED.as_euler('ZYX'), names=[*NAMES, *TURNS]))
    assert_same(
        read(path, preset='', columns=['r1=rx,r2=ry,r3=rz'], given={'euler': 'ZYX'}), TURNED
    )


def test_the_option_for_the_quaternion_of_a_leica_tracker_is_told(tmp_path):
    """Its first number is the scalar; beside others, the column was not even named."""
    path, log = tmp_path / 'points.csv', tmp_path / 'joints.csv'
    numbers = TURNED.as_quat()[:, [3, 0, 1, 2]]
    names = ['X  [m]', 'Y  [m]', 'Z  [m]', 'Q0 ', 'Q1 ', 'Q2 ', 'Q3 ']
    path.write_text(text_of(PLACES, numbers, names=names))
    log.write_text(text_of(JOINTS, names=['q1', 'q2']))
    foreign = Foreign(Layout(), ARM, log)
    found = loading.table(path, ARM, Settings(), foreign=foreign)
    (note,) = (each for each in found.warnings if 'to use' in each)
    assert note == f'{path}: to use Q0, Q1, Q2, Q3, give --columns "qw=Q0,qx=Q1,qy=Q2,qz=Q3"'
    layout = layout_of('', re.search('--columns "(.*)"', note).groups(), {})
    assert_same(loading.table(path, ARM, Settings(), foreign=replace(foreign, layout=layout)))


def test_five_numbered_columns_are_no_quaternion(tmp_path):
    numbered = [f'Q{k}' for k in range(5)]
    assert not [*turns_in(tmp_path, numbered)]
    assert [*turns_in(tmp_path, numbered[:4])]


def test_numbers_as_names_of_columns_are_no_values(path):
    """The proposal q*=* gave the joints 1, 2 ... as constants."""
    path.write_text(text_of(JOINTS, PLACES, names=['1', '2', 'x', 'y', 'z']))
    assert_same(proposed(path), None)


def test_another_form_of_rotations_replaces_the_columns_of_a_preset(path):
    """`--preset vicon --rotation-vector` missed the column RW."""
    given = ['A1', 'A2', 'RX', 'RY', 'RZ', 'TX', 'TY', 'TZ']
    path.write_text(text_of(JOINTS, TURNED.as_rotvec(), PLACES, names=given))
    units = {'length': 'm', 'rotation_vector': True}
    assert_same(read(path, preset='vicon', columns=['q*=A*'], given=units))


@pytest.mark.parametrize(
    'text',
    [
        'q1,q2,plane\n0.1,0.2,table\n0.2,0.3,table\n0.4,0.3,table\n',
        'q1,q2,location,socket\n0.1,0.2,a,1\n0.2,0.3,a,1\n0.4,0.3,a,2\n',
    ],
)
def test_touched_places_are_read_as_other_tables_are(tmp_path, text):
    path, other = tmp_path / 'cell.csv', tmp_path / 'other.csv'
    path.write_text(text)
    other.write_text(text.replace(',', ';').replace('q1', 'Q1'))
    known = read_table(path, 2).fitted
    for found in (
        read_table(path, 2, foreign=Foreign(Layout())).fitted,
        loading.table(other, ARM, Settings()).fitted,
    ):
        assert [str(each) for each in found] == [str(each) for each in known]
        for one, same in zip(known, found, strict=True):
            np.testing.assert_array_equal(one.joints, same.joints)


def test_a_location_may_be_anything(path):
    lines = PLAIN.splitlines()
    path.write_text('\n'.join([f'{lines[0]},Location', *(f'{each},hall 2' for each in lines[1:])]))
    assert_same(read_table(path, 2, foreign=Foreign(Layout())), None)


@pytest.mark.parametrize('name', ['Length [m]', 'Distance to anchor', 'wire (m)'])
def test_a_distance_is_proposed(guessed, path, name):
    path.write_text(text_of(JOINTS, PLACES[:, 0], names=['J1', 'J2', name]))
    (found,) = proposed(path).fitted
    np.testing.assert_allclose(found.distances, PLACES[:, 0])
    with pytest.raises(InputError, match='x=NAME,y=NAME,z=NAME'):
        guessed(text_of(JOINTS, PLACES[:, 0], names=['J1', 'J2', f'nominal {name}']))


def test_numbered_columns_of_a_preset_are_of_its_own_form(tmp_path):
    """Angles of Motive are three columns, and the position comes one earlier."""
    layout = layout_of('optitrack', [], {'euler': 'XYZ'})
    assert layout.columns['qx'] == '#3'


@pytest.mark.parametrize(('unit', 'size'), [('in', 0.0254), ('ft', 0.3048)])
def test_a_unit_that_may_be_a_word_is_proposed(path, unit, size):
    """X_in was proposed as metres."""
    path.write_text(text_of(JOINTS, PLACES / size, names=['q1', 'q2', *names(f'{{}}_{unit}')]))
    option = f'x=X_{unit},y=Y_{unit},z=Z_{unit}'
    with pytest.raises(InputError, match=f'--columns "{option}" --length {unit}'):
        loading.table(path, ARM, Settings())
    assert_same(read(path, preset='', columns=[option], given={'length': unit}), None)
