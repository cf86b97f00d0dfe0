# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Presets and expressions of columns."""

from dataclasses import replace

import numpy as np
import pytest
from test_foreign import JOINTS, PLACES, text_of

from calib_ros import Chain, Settings, read_table
from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.files import loading
from calib_ros.files.expressions import Expression
from calib_ros.files.foreign import Foreign
from calib_ros.files.layouts import Layout, layout_of, load_layout
from calib_ros.kinematics.chain import Joint
from calib_ros.kinematics.chain_file import load_chain, shared_files

GAPS = 'No,x,y,z\n4,4,0,0\n5,5,0,0\n7,7,0,0\n8,8,0,0\n'  # 6 was not measured
FOUR = 'a,1,0,0\nb,2,0,0\nc,3,0,0\nd,4,0,0\n'


def read_beside(folder, points, log, **columns):
    """Return the measurements, by target, of a table of points beside a log of one joint."""
    (folder / 'points.csv').write_text(points)
    (folder / 'log.csv').write_text(log)
    given = Foreign(Layout(columns=columns), None, folder / 'log.csv')
    return read_table(folder / 'points.csv', 1, foreign=given).fitted


def test_later_columns_may_use_our_names_of_earlier_ones():
    """As messages about a wrong setting name them."""
    given = ['q*=J*', 'q1=q2,q2=q1', 'q2=q2-{q1},target=q1']
    columns = layout_of('', given, {}).columns
    assert (columns['q1'], columns['q2']) == ('(J2)', '((J1))-{q1}')
    assert columns['target'] == 'q1'
    columns = layout_of('', ['q*=J*,q3=q3+q2,q1=q2,q2=q1'], {}).columns
    assert [columns[f'q{k}'] for k in (1, 2, 3)] == ['(J2)', '(J1)', '(J3)+(J2)']
    coupled = layout_of('fanuc', ['q3=q3-q2'], {}).columns['q3']
    assert coupled == '(J3 + J2)-(J2)'
    with pytest.raises(ConfigError, match=r'OURS=THEIRS,.*, not "x="'):
        layout_of('', ['y=Y,x='], {})


def test_an_expression_has_its_signs_and_its_order():
    columns = {'a b': np.array([1.0, 2.0]), 'A': np.array([5.0, 9.0])}
    assert Expression.parse('-{a b}*2 + (A - 3)/4').of(columns).tolist() == [-1.5, -2.5]


def test_another_way_to_turn_replaces_that_of_a_preset():
    layout = layout_of('kuka_abc', [], {'rotation_vector': True, 'euler': ''})
    assert (layout.euler, layout.rotation_vector) == ('', True)


def test_every_preset_says_where_its_format_is_documented():
    assert len(shared_files('tables')) >= 11
    for name in shared_files('tables'):
        layout = load_layout(name)
        assert layout.description
        assert layout.source
        for each in layout.columns.values():
            Expression.parse(each)


def test_presets_of_users_and_their_faults(tmp_path):
    path = tmp_path / 'mine.yaml'
    path.write_text('length: mm\ncolumns: {x: 2*A, q6: 0}\n')
    assert load_layout(str(path)).columns == {'x': '2*A', 'q6': '0'}
    for text, error in (
        ('lenght: mm', UnknownNameError),
        ('length: ell', ConfigError),
        ('columns: {w: A}', ConfigError),
        ('columns: [1]', ConfigError),
        ('inverse: 3', ConfigError),
        ('euler: XXY', ConfigError),
        ('- 1', ConfigError),
    ):
        path.write_text(text)
        with pytest.raises(error):
            load_layout(str(path))
    with pytest.raises(UnknownNameError, match='optitrack'):
        load_layout('optitrak')


@pytest.mark.parametrize(
    'text', ['a**b', 'f(x)', 'a b', '1+', '__import__("os")', '{}', '', 'a;b', 'a;']
)
def test_what_is_no_expression(text):
    with pytest.raises(ConfigError, match='not an expression'):
        Expression.parse(text)


@pytest.mark.parametrize(
    ('names', 'proposed'),
    [
        (['A1_rad', 'A2_rad', 'x', 'y', 'z'], 'Columns of other names: --columns "q*=A*"'),
        (
            ['Joint 1 [rad]', 'Joint 2 [rad]', 'X [m]', 'y', 'z'],
            'Columns of other names: --columns "q*={Joint *}"',
        ),
        (
            ['x', 'y', 'z', 'a', 'b'],
            '--columns "q*=NAME*"; joint values in another file or sheet: --joints FILE',
        ),
        (
            ['q1', 'c11', 'c12', 'y', 'z'],
            'Is it another arm (--chain)? Columns of other names: --columns "q2=NAME"',
        ),
        (['q1', 'q2', 'X', 'X', 'y'], 'number: --columns "x=#3", or --columns "x=#4"'),
        (['q1', 'q2', 'X {mm}', 'y', 'z'], 'other names: --columns "x=#3"'),
        (['q1', 'J1', 'J2', 'y', 'z'], 'other names: --columns "q*=J*"'),
        (['J1 [°]', 'J2 [°]', 'x [mm]', 'y (mm)', 'z / mm'], 'other names: --columns "q*=J*"'),
        (['q0', 'q1', 'x', 'y', 'z'], '--columns "q1=q0,q2=q1"'),
        (['j_0', 'j_1', 'x', 'y', 'z'], '--columns "q1=j_0,q2=j_1"'),
        (
            ['a', 'a', 'x', 'y', 'z'],
            '--columns "q*=NAME*"; joint values in another file or sheet: --joints FILE',
        ),
        (
            ['q1', 'q2', 'Date', 'Load', 'Note'],
            'are they in another file or sheet? Give that one, and this as --joints',
        ),
        (
            ['q1', 'q2', *(f'{a}{k}' for k in (1, 2) for a in 'xyz')],
            'give one of several points, or a row for each, named in a column target',
        ),
        (['0.1', '-2', '3', '4e-5', '5'], '--columns "q1=#1,q2=#2,x=#3,y=#4,z=#5", in its order'),
    ],
)
def test_columns_of_other_names_are_proposed_as_they_can_be_given(path, names, proposed):
    path.write_text(text_of(JOINTS, *[PLACES] * ((len(names) - 2) // 3), names=names))
    joints = tuple(Joint(name, a=0.3) for name in ('shoulder', 'elbow'))
    with pytest.raises(InputError) as told:
        loading.table(path, Chain('arm', 'standard', joints), Settings())
    assert str(told.value).endswith(proposed)


@pytest.mark.parametrize(('given', 'told'), [(3, False), (4, True), (5, False)])
def test_a_quaternion_in_place_of_the_joints_is_told(tmp_path, given, told):
    """As ABB names it: q1 to q4 of six joints are hardly those of another arm."""
    path = tmp_path / 'abb.csv'
    header = [f'q{k}' for k in range(1, given + 1)] + ['x', 'y', 'z']
    path.write_text(','.join(header) + '\n' + ','.join(['0.5'] * len(header)) + '\n')
    with pytest.raises(InputError, match='Is it another arm') as refused:
        loading.table(path, load_chain('abb_irb120'), Settings())
    text = 'If q1 to q4 are a quaternion, give the joint values (--joints FILE)'
    assert (text in str(refused.value)) is told


def test_a_linear_axis_has_its_own_unit_in_the_header(path):
    path.write_text('rail [mm],turn [°],X [mm],Y [mm],Z [mm]\n1500,90,1,2,3\n')
    chain = Chain('arm', 'standard', (Joint('rail', type='prismatic'), Joint('turn', a=0.3)))
    (found,) = loading.table(path, chain, Settings()).fitted
    cm = loading.table(
        path, chain, Settings(), foreign=Foreign(layout_of('', [], {'length': 'cm'}), chain)
    )
    assert 'its header says mm, but cm is given: taking cm' in str(cm.warnings)
    np.testing.assert_allclose(found.joints, [[1.5, np.pi / 2]])
    np.testing.assert_allclose(found.positions, [[1e-3, 2e-3, 3e-3]])


@pytest.mark.parametrize(
    ('head', 'row'),
    [
        ('q1 [DEG],q2 (Deg),X [MM],Y / MM,Z [mm]', '90,180,1,2,3'),
        ('q1,q2,x,y,z\n[deg],,[ mm ],,', '90,180,1,2,3'),
        ('q1,q2,x,y,z\nDegrees,Degrees,inches,millimeter,Meters', '90,180,.03937007874,2,.003'),
        ('q1 [deg],q2 [rad],x [mm],y [m],z [cm]', '90,3.141592653589793,1,.002,.3'),
        ('q1 [rad],q2 [rad],x [mm],y,z,rx [deg],ry,rz', '1.5707963268,3.1415926536,1,2,3,90,0,0'),
        ('q1,q2,x [mm],y,z,rx [deg],ry,rz', '90,180,1,2,3,90,0,0'),
        ('q1_deg,"q2, deg",x mm,Y_MM,"z,mm"', '90,180,1,2,3'),
        ('q1 in deg,q2 in deg,x in mm,y in millimetres,z in mm', '90,180,1,2,3'),
        ('Joints [deg],,Position [mm],,\nq1,q2,x,y,z', '90,180,1,2,3'),
        ('Joints [deg],,Position [m],,,\nq1,q2,x [mm],y [mm],z [mm],', '90,180,1,2,3,'),
        ('deg,deg,mm,mm,mm\nq1,q2,x,y,z', '90,180,1,2,3'),
        ('Units,mm,deg\nq1,q2,x,y,z', '90,180,1,2,3'),
        ('Einheiten: mm, °\nq1,q2,x,y,z', '90,180,1,2,3'),
        ('Längeneinheit;mm\nq1 [º],q2,x,y,z', '90,180,1,2,3'),
        ('Unité : mm et degrés\nq1,q2,x,y,z', '90,180,1,2,3'),
        ('Unità di misura: mm\nq1 [gradi],q2,x,y,z', '90,180,1,2,3'),
        ('Unidad: mm\nq1 (grados),q2,x,y,z', '90,180,1,2,3'),
        ('Units: in mm, deg\nq1,q2,x,y,z', '90,180,1,2,3'),
        ('Units in: mm, deg\nq1,q2,x,y,z', '90,180,1,2,3'),
        ('Alle Angaben in mm\nq1 [deg],q2,x,y,z', '90,180,1,2,3'),
        ('All values are in [mm]\nq1 [deg],q2,x,y,z', '90,180,1,2,3'),
        ('(values in mm)\nq1 [deg],q2,x,y,z', '90,180,1,2,3'),
        ('Angles in deg; lengths in mm\nq1,q2,x,y,z', '90,180,1,2,3'),
        ('Tool [mm],120,Angle [deg],,\nq1 [deg],q2,x [mm],y,z', '90,180,1,2,3'),
        ('q1\uff08°\uff09,q2,x\uff08mm\uff09,y,z', '90,180,1,2,3'),
        ('q1 (度),q2,x (毫米),y,z', '90,180,1,2,3'),
        ('Cell\na [deg],b,c [mm],d,e', '90,180,1,2,3'),
        ('Cell\na,b,c,d,e\ndeg,deg,mm,mm,mm', '90,180,1,2,3'),
    ],
)
def test_each_column_has_its_own_unit(tmp_path, head, row):
    """Whether it is named, or told by its number."""
    (tmp_path / 'cell.csv').write_text(f'{head}\n{row}\n')
    numbers = zip(('q1', 'q2', 'x', 'y', 'z'), ('#1', '#2', '#3', '#4', '#5'), strict=True)
    columns = dict(numbers) if 'Cell' in head else {}
    foreign = Foreign(Layout(rotation_vector='rx' in head, columns=columns))
    table = read_table(tmp_path / 'cell.csv', 2, foreign=foreign)
    (found,) = table.fitted
    np.testing.assert_allclose(found.joints, [[np.pi / 2, np.pi]])
    np.testing.assert_allclose(found.positions, [[1e-3, 2e-3, 3e-3]])
    if 'rx' in head:
        np.testing.assert_allclose(found.rotations[0] @ [0, 1, 0], [0, 0, 1], atol=1e-9)
    told = ('no units', 'not read', 'is given', 'as its header says')
    assert not [each for each in told if each in str(table.warnings)]


@pytest.mark.parametrize(
    'words', ['Accuracy values in um', 'Sigma values are in mm', 'Unit: in Stuttgart']
)
def test_values_of_another_quantity_do_not_give_the_units(read, words):
    """The coordinates were read in these."""
    (found,) = read(f'{words}\nq1,q2,x,y,z\n0,1,2,3,4\n').fitted
    assert found.positions.tolist() == [[2.0, 3.0, 4.0]]


def test_between_blanks_words_above_the_header_are_no_units_of_columns(read):
    """The second joint was in inches."""
    (found,) = read('Values in mm\nq1 q2 x y z\n0 1 2 3 4\n', 'cell.txt').fitted
    assert found.positions.tolist() == [[2e-3, 3e-3, 4e-3]]


@pytest.mark.parametrize(
    ('head', 'told'),
    [
        (
            'q1 [mm],q2,x [mm],y,z',
            r'q1 = q1 \[mm\] cannot be in mm, .* --chain if it is prismatic',
        ),
        ('q1,q2,x [deg],y,z', r'x \[deg\] cannot .*, expected m, cm.* column \(--columns\)$'),
        ('q1,q2,x [yd],y,z', r'x = x \[yd\] cannot be in yd, .*: give --length, or convert it'),
        ('q1,q2,x,y,z\nrad,rad,yd,mm,mm', r'x = x \[yd\] cannot be in yd, .*: give --length, or'),
        ('q1,q2,x [mm],y [m],z', 'z has no unit, others are in m and mm'),
        ('q1,q2,x [mm],x,y', r'Several columns are called x: .*"x=#3", or --columns "x=#4"'),
        ('q1,Y [m],X [mm],y,z', r'x = X\+Y mixes m and mm'),
    ],
)
def test_contradictory_units_are_refused(tmp_path, head, told):
    (tmp_path / 'cell.csv').write_text(f'{head}\n1,2,3,4,5\n')
    layout = Layout(columns={'q2': 'q1', 'x': 'X+Y'} if 'X' in head else {})
    with pytest.raises(InputError, match=told):
        read_table(tmp_path / 'cell.csv', 2, foreign=Foreign(layout))
    if 'give --length' in told:
        known = Foreign(replace(layout, length='mm', insisted=('length',)))
        assert len(read_table(tmp_path / 'cell.csv', 2, foreign=known).fitted[0]) == 1


def test_a_line_of_units_below_our_own_columns_is_read(tmp_path):
    (tmp_path / 'cell.csv').write_text('q1,q2,x,y,z\ndeg,deg,mm,mm,mm\n90,180,1,2,3\n')
    chain = Chain('arm', 'standard', (Joint('a'), Joint('b')))
    (found,) = loading.table(tmp_path / 'cell.csv', chain, Settings()).fitted
    np.testing.assert_allclose(found.joints, [[np.pi / 2, np.pi]])
    np.testing.assert_allclose(found.positions, [[1e-3, 2e-3, 3e-3]])
    with pytest.raises(InputError, match="not 'mm': units belong into the header"):
        read_table(tmp_path / 'cell.csv', 2)


def test_units_of_standard_deviations_and_of_converted_columns(path):
    path.write_text('q1,q2,X [mm],y,z,sx [um],sy [um],sz [um]\n1,2,3,4,5,10,10,10\n')
    table = read_table(path, 2, foreign=Foreign(Layout(columns={'x': 'X/1000'})))
    np.testing.assert_allclose(np.diag(table.fitted[0].covariance[0])[:3], 1e-10)
    assert 'x = X/1000 is in mm, as its header says' in str(table.warnings)


def test_poses_are_matched_by_their_names_below_titles_and_in_the_units_of_the_header(tmp_path):
    """Of a tracker and a controller: other orders, a pose not measured, decimal commas."""
    log = 'Robot 7\n24.11.2026;noon\nPoint;Date;J1 [°];J2 [°]\n'
    log += ''.join(f'P{k};24.11.2026;{10 * k},0;{k},5\n' for k in range(1, 5))
    points = 'Points\n\nPOINT;X [mm];Y [mm];Z [mm]\n'
    points += ''.join(f'P{k};{100 * k},5;0,0;1,0\n' for k in (4, 1, 3))
    (tmp_path / 'log.csv').write_text(log)
    (tmp_path / 'points.csv').write_text(points)
    unnamed = Foreign(
        Layout(), Chain('arm', 'standard', (Joint('a'), Joint('b'))), tmp_path / 'log.csv'
    )
    with pytest.raises(InputError, match=r'"q\*=J\*"'):
        unnamed.convert(tmp_path / 'points.csv')
    layout = Layout(columns={'q1': '{J1 [°]}', 'q2': 'J2'})
    given = Foreign(layout, None, tmp_path / 'log.csv', layout)
    (found,) = (table := read_table(tmp_path / 'points.csv', 2, foreign=given)).fitted
    np.testing.assert_allclose(np.rad2deg(found.joints), [[40, 4.5], [10, 1.5], [30, 3.5]])
    np.testing.assert_allclose(found.positions[:, 0], [0.4005, 0.1005, 0.3005])
    assert 'matched by the column "POINT"' in ' '.join(table.warnings)
    separators = [each for each in table.warnings if 'semicolons' in each]
    assert [each.rpartition('/')[2].partition(':')[0] for each in separators] == [
        'points.csv',
        'log.csv',
    ]
    assert 'no units' not in ' '.join(table.warnings)
    (tmp_path / 'log.csv').write_text(log.replace('P4', 'P3'))
    with pytest.raises(InputError, match=r'has 4 rows, .* has 3: give both a column that'):
        read_table(tmp_path / 'points.csv', 2, foreign=given)


@pytest.mark.parametrize(
    ('points', 'log', 'odd'),
    [
        ('Point,x,y,z\nP10,1,0,0\nP2,2,0,0\nP1,3,0,0\n', 'Name,q1\np01,3\np10,1\np02,2\n', ''),
        ('No,x,y,z\n3,1,0,0\n2,2,0,0\n1,3,0,0\n', 'no,q1\n1.0,3\n3.0,1\n2.0,2\n', ''),
        ('Point,x,y,z\na,1,0,0\nb,2,0,0\nc,3,0,0\n', 'Point,q1\na,1\nb,2\nd,3\n', '"c"'),
        ('No,x,y,z\n1,1,0,0\n2,2,0,0\n3,3,0,0\n', 'No,q1\n0,1\n1,2\n2,3\n', '"3"'),
        ('No,x,y,z\n1,1,0,0\n2,2,0,0\n3,3,0,0\n', 'Row,q1\n0,1\n1,2\n2,3\n', ''),
        ('Point,x,y,z\nP_2,2,0,0\nP_1,1,0,0\n', 'Position,q1\nP[1],1\nP[2],2\n', ''),
        ('A,P2,2,0,0\nA,P10,10,0,0\n', 'Point,q1\nP[10],10\nP[2],2\n', ''),
        ('Point,x,y,z\nP1.1,2,0,0\nP11,1,0,0\n', 'Position,q1\nP1.1,2\nP11,1\n', ''),
        ('No,At,x,y,z\n1,a,1,0,0\n2,b,2,0,0\n', 'No,At,q1\n1,b,2\n2,a,1\n', ''),
        (GAPS, 'At,q1\nMotion4,4\nMotion6,6\nMotion5,5\nMotion8,8\nMotion07,7\n', ''),
        ('Target,x,y,z\na,1,0,0\nb,2,0,0\na,1,0,0\nb,2,0,0\n', 'At,q1\nb,2\na,1\n', ''),
        ('Point,x,y,z\na,1,0,0\na,1,0,0\nb,2,0,0\n', 'At,q1\nb,2\nc,9\na,1\n', ''),
        (f'Point,x,y,z\na,1,0,0\n{FOUR}', 'At,q1\na,1\nb,2\nc,3\nd,4\n', '"a"'),
        ('Point,x,y,z\n' + 'a,1,0,0\n' * 4, 'At,q1\nb,2\nc,9\na,1\nd,8\n', ''),
        (
            'No,At,x,y,z\n1,a,1,0,0\n2,b,2,0,0\n3,c,3,0,0\n',
            'No,At,q1\n1,a,1\n2,b,2\n3,d,3\n',
            '"c"',
        ),
    ],
)
def test_names_of_poses_need_no_column_of_the_same_name(tmp_path, points, log, odd):
    """Joint values of other poses were taken, row by row, without a word."""
    numbered = {'x': '#3', 'y': '#4', 'z': '#5'} if points.startswith('A') else {}
    if odd:
        with pytest.raises(InputError, match=f'{odd} of its column .* must be in one row'):
            read_beside(tmp_path, points, log, **numbered)
        return
    (found,) = read_beside(tmp_path, points, log, **numbered)
    assert found.joints[:, 0].tolist() == found.positions[:, 0].tolist()


@pytest.mark.parametrize(
    ('ours', 'theirs', 'count'),
    [('Nr', 'Pose', 1), ('Point', 'Pose', 1), ('Point', 'Pose', 2), ('Point', 'Point', 2)],
)
@pytest.mark.parametrize('order', [[1, 2, 3, 4], [3, 1, 4, 2]])
def test_numbers_of_poses_in_another_order_are_refused(tmp_path, ours, theirs, count, order):
    """Their rows were paired side by side."""
    named = f'{ours} 0' if ours == 'Point' else ''
    points = f'{ours},x,y,z\n' + count * ''.join(f'{named}{k},{k},0,0\n' for k in order)
    log = f'{theirs},q1\n' + count * ''.join(f'{k},{k}\n' for k in (1, 2, 3, 4))
    if order[0] != 1:
        with pytest.raises(InputError, match=f'the numbers in the column {ours} of .* come in an'):
            read_beside(tmp_path, points, log)
        return
    (found,) = read_beside(tmp_path, points, log)
    assert found.joints[:, 0].tolist() == found.positions[:, 0].tolist()


def test_joint_values_and_coordinates_name_no_poses(tmp_path):
    """Whole degrees in another order than the numbers of the poses were refused."""
    points = 'Nr,x,y,z\n1,2,9,0\n2,1,9,0\n3,4,9,0\n4,3,9,0\n'
    (found,) = read_beside(tmp_path, points, 'Celsius,q1\n20,4\n22,3\n23,2\n21,1\n')
    assert found.joints[:, 0].tolist() == [4.0, 3.0, 2.0, 1.0]


def test_a_column_of_targets_that_was_given_is_read_beside_one_of_poses(tmp_path):
    """Where poses were matched by a column Target, both targets were taken for one."""
    points = 'Target,My probe,x,y,z\nP1,a 1,1,0,0\nP2,b 2,2,0,0\n'
    points = points.replace(',', '\t')  # the blanks separate nothing
    found = read_beside(tmp_path, points, 'Target,q1\nP1,1\nP2,2\n', target='{My probe}')
    assert [len(each) for each in found] == [1, 1]


@pytest.mark.parametrize(('names', 'refused'), [('q1,q2,x,y,z', True), (None, False)])
def test_lines_of_several_units_are_refused_unless_each_column_has_its_own(path, names, refused):
    """Two files in one were read in the units of the first."""
    units = 'q1 [rad],q2 [rad],x [m],y [m],z [m]'
    path.write_text(f'Units: mm\n{names or units}\n0,0,1,2,3\n0,1,1,2,4\nUnits: m\n1,0,2,3,4\n')
    if refused:
        with pytest.raises(InputError, match=r'lengths are in mm and m, .* give --length if one'):
            read_table(path, 2, foreign=Foreign(Layout()))
    else:
        assert read_table(path, 2, foreign=Foreign(Layout())).fitted[0].positions[0, 2] == 3.0


@pytest.mark.parametrize('given', ['', ','])
def test_a_log_whose_commas_may_be_of_thousands_has_those_of_the_table_beside_it(tmp_path, given):
    """--decimal comma, which the message advised, changed nothing."""
    log, path = tmp_path / 'log.csv', tmp_path / 'points.csv'
    log.write_text('J1;J2\n-115,780;30\n90;1,500\n')
    path.write_text('x;y;z\n0,25;1,5;0\n0,5;1;2,5\n')
    layout = Layout(columns={'q1': 'J1', 'q2': 'J2'}, angle='deg')
    foreign = Foreign(replace(layout, decimal=given), None, log, layout)
    (found,) = read_table(path, 2, foreign=foreign).fitted
    np.testing.assert_allclose(np.degrees(found.joints), [[-115.78, 30], [90, 1.5]])
    path.write_text(path.read_text().replace(',', '.'))
    with pytest.raises(InputError, match=r"'1,500': write a point"):
        read_table(path, 2, foreign=replace(foreign, layout=layout))
