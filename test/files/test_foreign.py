# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables that others have written."""

import numpy as np
import pytest
from robots import DATA, needs_data
from scipy.spatial.transform import Rotation

from calib_ros import load_chain, read_table
from calib_ros.errors import ConfigError, InputError
from calib_ros.files.foreign import Foreign
from calib_ros.files.layouts import Layout, layout_of, load_layout
from calib_ros.files.vocabulary import SIGMAS, TURNS

JOINTS = np.array([[0.1, -0.2], [0.3, 0.4], [-1.5, 2.0]])
PLACES = np.array([[1.0, 2.0, 3.0], [-0.5, 0.25, 0.125], [0.0, -1.0, 1e-3]])
TURNED = Rotation.from_rotvec([[0.1, 0.2, 0.3], [-1.0, 0.5, 2.0], [0.2, -0.1, 1.0]])


def text_of(*columns, names, separator=','):
    rows = np.column_stack(columns).tolist()
    lines = [separator.join(names), *(separator.join(map(repr, row)) for row in rows)]
    return '\n'.join(lines) + '\n'


NAMES = ['q1', 'q2', 'x', 'y', 'z']
DEGREES = 'q1,q2,x,y,z,rx,ry,rz\n1,2,3,4,5,90,0,0\n'
PLAIN = text_of(JOINTS, PLACES, names=NAMES)


def assert_same(table, rotations=TURNED):
    (found,) = table.fitted
    np.testing.assert_allclose(found.joints, JOINTS, atol=1e-12)
    np.testing.assert_allclose(found.positions, PLACES, atol=1e-12)
    if rotations is not None:
        np.testing.assert_allclose(found.rotations, rotations.as_matrix(), atol=1e-12)


def both_rows(table):
    sets = (*table.fitted, *table.held_out)
    order = np.argsort(np.concatenate([each.stamps_ns for each in sets]))
    names = ('joints', 'positions', 'rotations')
    return [np.concatenate([getattr(each, name) for each in sets])[order] for name in names]


@needs_data
def test_poses_of_a_leica_as_published(run, tmp_path):
    raw = DATA / 'ur10_ipa_leica/raw/measurements_joint_configurations.csv'
    given = ('import', raw, '--preset', 'ipa_leica', '--chain', 'ur10', '--out', 'out.csv')
    assert run(*given)[0] == 0
    table, known = (
        read_table(tmp_path / 'out.csv', 6),
        read_table(raw.parents[1] / 'uniform.csv', 6, ('B',)),
    )
    for found, expected in zip(both_rows(table), both_rows(known), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    covariance = table.fitted[0].covariance
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(covariance[0])[:3]), [3.1674e-5, 1.3252e-5, 3.7622e-6], rtol=1e-12
    )
    sigmas = np.radians([0.0011832, 0.0013871, 0.0041345])
    assert np.trace(covariance[0, 3:, 3:]) == pytest.approx((sigmas**2).sum(), rel=1e-9)
    foreign = Foreign(load_layout('ipa_leica'), load_chain('ur10'))
    direct = read_table(raw, 6, foreign=foreign)
    np.testing.assert_array_equal(direct.fitted[0].covariance, covariance)


EULER = [a + b + c for a in 'XYZ' for b in 'XYZ' for c in 'XYZ' if a != b and b != c]


@pytest.mark.parametrize('letters', [*EULER, *(each.lower() for each in EULER)])
def test_euler_angles_of_any_order(read, letters):
    angles = TURNED.as_euler(letters, degrees=True)
    text = text_of(JOINTS, 1e3 * PLACES, angles, names=[*NAMES, 'r1', 'r2', 'r3'])
    assert_same(read(text, euler=letters, angle='deg', joint_angle='rad', length='mm'))
    if len(set(letters.upper())) == 3:
        names = [*NAMES, *(f'r{each.lower()}' for each in letters)]
        assert_same(read(text_of(JOINTS, PLACES, np.radians(angles), names=names), euler=letters))


@pytest.mark.parametrize('letters', ['XYZ', 'zyx', 'ZYZ', 'zxy'])
def test_standard_deviations_of_euler_angles(read, letters):
    sigmas = np.array([1e-4, 2e-4, 3e-4])
    angles = TURNED.as_euler(letters)
    names = [*NAMES, 'r1', 'r2', 'r3']
    columns = {'sx': '0.1e-3', 'sy': '0.1e-3', 'sz': '0.2e-3'}
    columns |= {'srx': '1e-4', 'sry': '2e-4', 'srz': '3e-4'}
    table = read(text_of(JOINTS, PLACES, angles, names=names), euler=letters, columns=columns)
    for k, covariance in enumerate(table.fitted[0].covariance):
        jacobian = np.zeros((3, 3))
        for i, step in enumerate(1e-6 * np.eye(3)):
            more = Rotation.from_euler(letters, angles[k] + step)
            jacobian[:, i] = (more * TURNED[k].inv()).as_rotvec() / 1e-6
        expected = jacobian @ np.diag(sigmas**2) @ jacobian.T
        np.testing.assert_allclose(covariance[3:, 3:], expected, rtol=0, atol=1e-12)


def test_rotation_vectors_and_quaternions(read):
    text = text_of(JOINTS, PLACES, TURNED.as_rotvec(), names=[*NAMES, 'rx', 'ry', 'rz'])
    assert_same(read(text, rotation_vector=True))
    quat = TURNED.as_quat()[:, [3, 0, 1, 2]]
    names = [*NAMES, 'qx', 'qy', 'qz', 'qw']
    assert_same(read(text_of(JOINTS, PLACES, quat, names=names), quaternion='wxyz'))
    inverse = TURNED.inv()
    text = text_of(JOINTS, -inverse.apply(PLACES), inverse.as_quat(), names=names)
    assert_same(read(text, inverse=True))


@pytest.mark.parametrize(
    ('separator', 'decimal'), [(';', ','), (';', '.'), ('\t', ','), (' ', '.')]
)
def test_separators_and_decimal_commas_are_guessed_and_said(read, separator, decimal):
    text = text_of(JOINTS, PLACES, names=NAMES, separator=separator)
    table = read(text.replace('.', decimal))
    assert_same(table, None)
    assert_same(read(text.replace('0.25', '"0.25"').replace('.', decimal)), None)
    said = ' '.join(table.warnings)
    assert '--separator' in said
    assert ('--decimal' in said) == (decimal == ',')
    assert 'm (--length)' in said
    assert 'rad (--joint-angle)' in said


def test_cells_in_quotes_windows_text_and_a_byte_order(read):
    assert_same(read(PLAIN.replace('0.25', '"0.25"').replace('\n', '\r\n')), None)
    assert_same(read(PLAIN.replace('z', 'z,frame_id', 1).replace('0.25', '"0.25"')), None)
    assert_same(read(PLAIN.encode('utf-16')), None)
    named = PLAIN.replace('q1', 'Gel\u00e4nk 1')
    table = read(named.encode('cp1252'), columns={'q1': '{Gel\u00e4nk 1}'})
    assert_same(table, None)
    assert 'Windows-1252' in ' '.join(table.warnings)
    named = PLAIN.replace('q1', '关节1')
    table = read(named.encode('gbk'), columns={'q1': '关节1'})
    assert_same(table, None)
    assert 'GB18030' in ' '.join(table.warnings)
    upper = PLAIN.replace('q1', 'POSIÇÃO').replace('q2', 'GRÖßE')  # both are pairs of bytes
    table = read(upper.encode('cp1252'), columns={'q1': 'POSIÇÃO', 'q2': 'GRÖßE'})
    assert_same(table, None)
    assert 'Windows-1252' in ' '.join(table.warnings)


MOTIVE = """Format Version,1.23,Take Name,take,Rotation Type,Quaternion,Length Units,Millimeters

,,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body
,,arm,arm,arm,arm,arm,arm,arm,arm
,,1,1,1,1,1,1,1,1
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,
"""


def rows_of(*columns):
    return ''.join(','.join(map(repr, row)) + '\n' for row in np.column_stack(columns).tolist())


def exports():
    """Return faithful copies of documented formats: text, and the log of joint values."""
    quat, number = TURNED.as_quat(), np.arange(3)
    log = text_of(np.degrees(JOINTS), names=['A1', 'A2'])
    motive = rows_of(number, number / 120, quat, 1e3 * PLACES, 0.1 + 0 * number)
    vicon = 'Objects\n100\n,,Global Angle (Quaternion) arm:arm\nFrame,Sub Frame,RX,RY,RZ,RW,TX,TY,'
    vicon += 'TZ\n,,,,,,mm,mm,mm\n' + rows_of(number, 0 * number, quat, 1e3 * PLACES)
    ndi = 'Frame#,PortHandle,TransformStatus,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,#Markers\n'
    ndi += ''.join(
        f'{k},0A,Enabled,' + ','.join(map(repr, [q[3], *q[:3], *p, 0.1])) + ',4\n'
        for k, (q, p) in enumerate(zip(quat.tolist(), (1e3 * PLACES).tolist(), strict=True))
    )
    sa = '// SpatialAnalyzer\n' + ''.join(
        f'A,tracker,p{k},' + ','.join(map(repr, (1e3 * p).tolist())) + '\n'
        for k, p in enumerate(PLACES)
    )
    kuka = text_of(
        *(np.degrees(JOINTS), 1e3 * PLACES, TURNED.as_euler('ZYX', degrees=True)),
        names=['A1', 'A2', 'X', 'Y', 'Z', 'A', 'B', 'C'],
    )
    coupled = np.column_stack([JOINTS, JOINTS[:, 0]])
    return {
        'optitrack': (MOTIVE + motive, log),
        'vicon': (vicon, log),
        'ndi': (ndi, log),
        'spatialanalyzer': (sa, log),
        'kuka_abc': (kuka, None),
        'abb_pose': (
            text_of(
                *(np.degrees(JOINTS), 1e3 * PLACES, quat[:, [3, 0, 1, 2]]),
                names=['rax_1', 'rax_2', 'x', 'y', 'z', 'q1', 'q2', 'q3', 'q4'],
            ),
            None,
        ),
        'fanuc_wpr': (
            text_of(
                np.degrees(coupled - [0, 0, 1] * JOINTS[:, 1:]),
                *(1e3 * PLACES, TURNED.as_euler('xyz', degrees=True)),
                names=['J1', 'J2', 'J3', 'X', 'Y', 'Z', 'W', 'P', 'R'],
            ),
            None,
        ),
    }


@pytest.mark.parametrize('preset', exports())
def test_exports_of_others(run, tmp_path, preset):
    text, log = exports()[preset]
    (tmp_path / 'table.csv').write_text(text)
    given = ['import', 'table.csv', '--preset', preset, '--out', 'out.csv']
    if log is not None:
        (tmp_path / 'log.csv').write_text(log)
        given += ['--joints', 'log.csv', '--joints-preset', 'kuka']
    assert run(*given)[0] == 0
    table = read_table(tmp_path / 'out.csv', 3 if preset == 'fanuc_wpr' else 2)
    (found,) = table.fitted
    np.testing.assert_allclose(found.joints[:, :2], JOINTS, atol=1e-12)
    np.testing.assert_allclose(found.positions, PLACES, atol=1e-12)
    if preset == 'fanuc_wpr':
        np.testing.assert_allclose(found.joints[:, 2], JOINTS[:, 0], atol=1e-12)
    if preset != 'spatialanalyzer':
        np.testing.assert_allclose(found.rotations, TURNED.as_matrix(), atol=1e-9)


@pytest.mark.parametrize(
    ('preset', 'old', 'new', 'factor'),
    [
        ('vicon', ',mm,mm,mm\n', ',m,m,m\n', 1.0),
        ('vicon', 'TX,TY,TZ\n,,,,,,mm,mm,mm\n', 'TX [m],TY [m],TZ [m]\n', 1.0),
        ('vicon', 'Objects\n', 'Units in meters\n', 1e-3),  # the header says mm
        ('spatialanalyzer', '// Spatial', '// Units: Inches\n// Spatial', 0.0254),
        ('spatialanalyzer', '// Spatial', '// Units: Feet\n// Spatial', 0.3048),
        ('spatialanalyzer', '// Spatial', '// Length Units = m, Angle: deg\n// Spatial', 1.0),
        ('spatialanalyzer', '// Spatial', '// Units are in cm\n// Spatial', 1e-2),
        ('spatialanalyzer', '// Spatial', '// Robot unit in cell 4, power unit M 12\n//', 1e-3),
        ('optitrack', 'Millimeters', 'Meters', 1.0),
    ],
)
def test_a_file_tells_its_units_better_than_a_preset(tmp_path, preset, old, new, factor):
    text, log = exports()[preset]
    (tmp_path / 'table.csv').write_text(text.replace(old, new))
    (tmp_path / 'log.csv').write_text(log)
    for given, unit in (({}, factor), ({'length': 'cm'}, 0.01)):  # an option is an order
        layout, of_log = layout_of(preset, [], given), layout_of('kuka', [], {})
        foreign = Foreign(layout, None, tmp_path / 'log.csv', of_log)
        (found,) = read_table(tmp_path / 'table.csv', 2, foreign=foreign).fitted
        np.testing.assert_allclose(found.positions, 1e3 * unit * PLACES, atol=1e-12)


def test_the_only_row_may_end_without_a_line_break(read):
    (found,) = read('q1;q2;x;y;z\n0.1;0.2;1;2;3').fitted
    assert found.joints.tolist() == [[0.1, 0.2]]


def test_a_log_of_universal_robots(tmp_path):
    names = [f'actual_q_{k}' for k in range(2)]
    (tmp_path / 'log.csv').write_text(text_of(JOINTS, names=names, separator=' '))
    text = text_of(PLACES, names=['x', 'y', 'z'])
    (tmp_path / 'table.csv').write_text(text)
    foreign = Foreign(Layout(length='m'), None, tmp_path / 'log.csv', load_layout('ur_rtde'))
    assert_same(read_table(tmp_path / 'table.csv', 2, foreign=foreign), None)
    (tmp_path / 'table.csv').write_text(text + '1,2,3\n')
    with pytest.raises(InputError, match=r'has 3 rows, .* has 4'):
        read_table(tmp_path / 'table.csv', 2, foreign=foreign)


def test_a_log_without_names_whose_cells_stand_apart_by_tabs_and_blanks(tmp_path):
    log = tmp_path / 'log.txt'
    log.write_text(''.join(f'7\t{q1!r}\t{q2!r} 1\n' for q1, q2 in JOINTS.tolist() * 4))
    (tmp_path / 'table.csv').write_text(text_of(np.tile(PLACES, (4, 1)), names=['x', 'y', 'z']))
    with pytest.raises(InputError, match=r'no column q1; .*: give --columns "q\*=#\*" or'):
        read_table(tmp_path / 'table.csv', 2, foreign=Foreign(Layout(), None, log))
    layout = Layout(columns={'q1': '#2', 'q2': '#3'})
    for header in ('', 't\tq1\tq2\tn\n'):
        log.write_text(header + log.read_text())
        found = read_table(tmp_path / 'table.csv', 2, foreign=Foreign(Layout(), None, log, layout))
        np.testing.assert_array_equal(found.fitted[0].joints, np.tile(JOINTS, (4, 1)))


def test_rows_in_which_nothing_was_measured_are_left_out_and_said(read):
    table = read(PLAIN + '0,0,,,\n', length='m', angle='rad')
    assert_same(table, None)
    assert 'line 5: skipped' in ' '.join(table.warnings)


@pytest.mark.parametrize('letter', 'asv')
def test_columns_read_as_joint_values_are_no_rates_nor_signs(read, letter):
    """The axes of KUKA are a1, a2 ... to some; they were taken for accelerations as well."""
    text = text_of(JOINTS, PLACES, names=[f'{letter}1', f'{letter}2', 'x', 'y', 'z'])
    table = read(text, columns={'q1': f'{letter}1', 'q2': f'{letter}2'})
    assert_same(table, None)
    (found,) = table.fitted
    assert (found.velocity, found.acceleration, found.approach) == (None, None, None)


def test_joint_values_in_the_unit_of_other_angles_are_told(read):
    text = text_of(JOINTS, PLACES, 0 * PLACES, names=[*NAMES, 'rx [deg]', 'ry', 'rz'])
    table = read(text, euler='XYZ')
    np.testing.assert_allclose(table.fitted[0].joints, np.radians(JOINTS))
    assert any('joint values are taken in deg, as its other' in each for each in table.warnings)


def test_angles_of_unknown_form_are_left_out_with_units_given_too(read):
    """The units that a message advises led to a refusal."""
    for more in ('', ',srx,sry,srz'):
        row = '57.29577951308232,2,4000,5000,6000,90,0,0' + ',1' * more.count(',')
        text = f'q1,q2,x,y,z,rx,ry,rz{more}\n{row}\n'
        table = read(text, length='mm', joint_angle='deg', insisted=('length', 'joint_angle'))
        assert table.fitted[0].positions.tolist() == [[4.0, 5.0, 6.0]]
        assert table.fitted[0].joints[0, 0] == pytest.approx(1.0)
        assert not table.fitted[0].oriented.any()
        assert any('rx, ry, rz are left out: give --euler' in each for each in table.warnings)


def test_joint_values_that_stand_a_row_below(read):
    joints = np.vstack([[[9.0, 9.0]], JOINTS])
    places = np.vstack([PLACES, [[9.0, 9.0, 9.0]]])
    assert_same(read(text_of(joints, places, names=NAMES), shift=1), None)


@pytest.mark.parametrize(
    ('text', 'layout', 'said'),
    [
        ('q1;q2;x;y;z\n1;2;3;4;five\n', {}, 'line 2: .* must be a finite number, not .five'),
        ('q1;q2;x;y;z\n1;2;3;4;1.234,5\n', {}, 'without the marks between thousands'),
        ('q1,q2,x,y,z\n1°,2°,3 m,4 m,5 m\n', {}, 'no rows of numbers .*; line 2 has "1°"'),
        ('note,q1,q2,x,y,z\nno\n', {}, 'no rows of numbers in the columns named'),
        ('q1,q2,x,y,z\n1,2,3,4,5\n1,,3,4,5\n', {}, 'line 3: q'),
        ('a,b,x,y,z\n1,2,3,4,5\n', {'columns': {'q1': 'c', 'q2': 'b'}}, 'no column c'),
        ('a,b,a,y,z\n1,2,3,4,5\n', {'columns': {'q1': 'a'}}, 'comes 2 times: name it by its'),
        ('q1,q2,x,y,z,split,split\n1,2,3,4,5,,test\n', {}, 'split" comes 2 times'),
        (PLAIN + 'q1,q2,y,x,z\n1,2,3,4,5\n', {}, 'line 5: .*: split the file above that line'),
        (PLAIN, {'columns': {'x': '#9'}}, 'has no column #9 for x'),
        (DEGREES, {'columns': dict(zip(TURNS, TURNS, strict=True))}, 'in degrees, .*--angle deg'),
        (DEGREES.replace('90', '1'), {'inverse': True}, 'say which, --euler'),
        ('q1,q2,x,y,z,qx,qy,qz,qw\n1,2,3,4,5,0,0,0,2\n', {}, 'line 2: quaternion'),
        ('q1,q2,x,y,z\n', {}, 'no rows'),
        ('', {}, 'no rows'),
        (',,,\n', {}, 'has no rows'),
        ('q1,q2,x,y,z\n1,2,3,4,5\n', {'columns': {'x': 'z/0'}}, 'line 2: x = z/0 is infinite'),
        ('q1,q2,x,y,z\n1,2,3,4,5\n', {'inverse': True}, '--inverse needs poses'),
        ('q1,q2,x,y,z\n1,2,3,4,5\n', {'shift': 1}, '--shift 1 leaves none of 1 rows'),
        (PLAIN, {'euler': 'XYZ', 'rotation_vector': True}, 'only one form of rotation'),
        (PLAIN, {'separator': ',', 'decimal': ','}, 'cannot separate both cells and decimals'),
        ('q1,q2,x,y,z\n1,2,3,4,5\n', {'length': 'um', 'columns': {'sx': '1'}}, 'sx, sy and sz'),
        *((PLAIN, {'columns': dict.fromkeys(SIGMAS[:count], '1')}, 'srx, sry, srz, and rotations')
          for count in (4, 6)),
        (PLAIN, {'columns': {'time': 'y*1e10'}}, 'line 2: time .s. must be a number of at most'),
        (PLAIN, {'euler': 'XYZ'}, 'euler is given, but no columns'),
        (PLAIN, {'columns': {'rx': 'x', 'ry': 'y'}}, 'have three columns, missing rz'),
        (PLAIN, {'columns': {'rx': 'x', 'r1': 'x'}}, 'give rx, ry, rz or r1, r2, r3, not both'),
        (DEGREES.replace('90', '1'), {'euler': 'ZXZ'}, 'an axis comes twice: give r1, r2, r3'),
        (PLAIN, {'columns': {'qx': 'x', 'qy': 'y'}}, 'four columns, missing qz, qw'),
        (DEGREES.replace('90', ''), {'euler': 'XYZ'}, 'line 2: rx.*, not blank'),
        *((DEGREES.replace('90', turn), each, r'line 2: rx, ry, rz .* in degrees, .*--angle deg')
          for turn, each in (('90', {'euler': 'XYZ'}), ('-90', {'rotation_vector': True}))),
        (b'\xff\xfe\0\xd8', {}, 'cannot read .*: unexpected end of data'),
        (b'PK\xff\0', {}, 'nor a workbook by its name: save it as CSV in UTF-8'),
        ('q1,x\n1,2\n1,2\0'.encode('utf-16'), {}, 'line 3 '),  # csv of Python 3.10 says it
    ],
)  # fmt: skip
def test_faults_are_named(read, text, layout, said):
    with pytest.raises((InputError, ConfigError), match=said):
        read(text, **layout)


@pytest.mark.parametrize(
    ('names', 'proposed'),
    [
        ('', 'q*=NAME*'),
        (',J1,J2,J3 [deg]', 'q*=J*'),
        (',A0,A1,A2', 'q1=A0,'),
        (',Axis 1,Axis 2,Axis 3', 'q*={Axis *}'),
    ],
)
def test_a_table_without_joint_values_is_refused(run, tmp_path, names, proposed):
    (tmp_path / 'cell.csv').write_text(f'x,y,z{names}\n1,2,3{",4" * names.count(",")}\n')
    status, _, err = run('import', 'cell.csv', '--out', 'out.csv')
    assert status == 1
    assert f'cell.csv has no joint values: name their columns (--columns "{proposed}' in err


def test_axes_called_like_accelerations_are_none(run, tmp_path):
    (tmp_path / 'cell.csv').write_text(PLAIN.replace('q', 'A'))
    assert run('import', 'cell.csv', '--columns', 'q*=A*', '--out', 'out.csv')[0] == 0
    assert (tmp_path / 'out.csv').read_text().splitlines()[0] == 'q1,q2,x,y,z'


def test_columns_of_joints_are_those_of_their_log(run, tmp_path):
    """They were ignored, and the other table was blamed."""
    (tmp_path / 'log.csv').write_text(text_of(JOINTS, names=['J1', 'J2']))
    (tmp_path / 'table.csv').write_text(text_of(PLACES, names=['x', 'y', 'z']))
    given = ('import', 'table.csv', '--joints', 'log.csv', '--out', 'out.csv')
    status, _, err = run(*given)
    assert status == 1
    assert 'log.csv has no column q1; it has J1, J2: give --columns "q*=J*"' in err
    assert run(*given, '--columns', 'q*=J*')[0] == 0
    assert_same(read_table(tmp_path / 'out.csv', 2), None)
