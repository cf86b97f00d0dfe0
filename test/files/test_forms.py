# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Forms in which other systems write the same table."""

import re

import numpy as np
import pytest
from test_foreign import JOINTS, PLACES, PLAIN, TURNED, assert_same, text_of

from calib_ros import Chain, Settings, read_table
from calib_ros.errors import ConfigError, InputError
from calib_ros.files import loading
from calib_ros.files.foreign import Foreign
from calib_ros.files.layouts import Layout, layout_of
from calib_ros.files.programs import read_joints
from calib_ros.files.vocabulary import MATRIX, POSE_COLUMNS, SEPARATORS, SIGMAS
from calib_ros.kinematics.chain import Joint

ARM = Chain('arm', 'standard', (Joint('a'), Joint('b')))
FORMS = {
    'no values': PLAIN + '0.2,0.3,n/a,#N/A,-\n0,0,nan,null,\n0, 0, nan, -, \n',
    'a header of numpy': '# ' + PLAIN,
    'a header of numpy with blanks': '# two joints\n# ' + PLAIN.replace(',', ' '),
    'a header of numpy with tabs': '#\t' + PLAIN.replace(',', '\t'),
    'a count, and remarks cut off': '#\t'
    + PLAIN.replace(',', '\t').replace('\n', '\tnote\n', 1).replace('\n', '\n1\t', 3),
    'a header of SpatialAnalyzer': '//' + PLAIN,
    'whole lines in quotes': re.sub('(?m)^.+$', r'"\g<0>"', PLAIN),
    'quotes below a plain header': re.sub('(?m)^([0-9-].*?);', r'"\1";', PLAIN.replace(',', ';')),
    'decimal commas between blanks': PLAIN.replace(',', ' ').replace('.', ','),
    'bars': PLAIN.replace(',', '|'),
    'names between bars': re.sub('(?m)^.+$', r'|a|b|c|\g<0>|', PLAIN.replace(',', '|')),
    'a table of Markdown': re.sub('(?m)^.+$', r'| \g<0> |', PLAIN.replace(',', ' | ')).replace(
        'z |', 'z |\n|--|--|--|--|--|'
    ),
    'bars in names': re.sub('(?m)^(?=.)', 'left|top,', PLAIN),
    'bars in names at the end': re.sub('(?m)(?<=.)$', ',left|7', PLAIN),
    'a unit behind a dash': PLAIN.replace('q1,q2,x', 'q1-rad,q2-rad,x'),
    'a date': 'Time;' + PLAIN.replace('\n', '\n2026-11-24 10:00:00;', 3).replace(',', ';'),
    'empty rows of a workbook': PLAIN + ',,,,\n' * 3,
    'a typographic minus': PLAIN.replace('-', '\u2212'),
    'exponents of Fortran': PLAIN.replace('0.25', '2.5D-01'),
    'decimal commas in quotes': re.sub('[^,\n]+', r'"\g<0>"', PLAIN).replace('.', ','),
    'a header in quotes': PLAIN.replace('q1', '"q1"').replace(',', ';'),
    'a column called #': re.sub(
        '(?m)(?<=.)$', '\tok', '#\t' + PLAIN.replace('\n', '\n1\t', 3)
    ).replace(',', '\t'),
    'a mark and a tab before the header': '%\t' + PLAIN.replace(',', '\t'),
    'a remark in every row': re.sub('(?m)(?<=[0-9])$', ',ok', PLAIN),
    'other separators in quotes': 'note,' + PLAIN.replace('\n', '\n"a; b; c; d; e; f, g",', 3),
    'semicolons in a remark': 'note,' + PLAIN.replace('\n', '\nok; again,', 3),
    'blank cells between bars': re.sub('(?m)(?<=.)$', ' | | | | | | |', PLAIN.replace(',', '|')),
    'lines of an old Macintosh': ('# two joints\n# ' + PLAIN).replace('\n', '\r'),
    'whole lines in quotes on Windows': re.sub('(?m)^.+$', r'"\g<0>"\r', PLAIN),
}


@pytest.mark.parametrize('form', FORMS)
def test_a_table_in_another_form_is_the_same(read, path, form):
    assert_same(read(FORMS[form]), None)
    assert_same(loading.table(path, ARM, Settings()), None)


@pytest.mark.parametrize(
    'text',
    [
        'Name,Axis,Nom,Meas\n' + ''.join(f'P{k},{a},1,{k}\n' for k in '12' for a in 'XYZ'),
        'Pose;P1;P2\nq1 [deg];1;2\nq2;3;4\nx [mm];1,5;2\ny [mm];2;3\nz [mm];3;4\n',
        'q1,1,2\nq2,3,4\nx,1,2\ny,2,3\nz,3,4\n',
    ],
)
def test_coordinates_below_each_other_are_refused(guessed, text):
    """With a word on that; options for columns of these names were proposed."""
    with pytest.raises(InputError, match='has x, y, z below each other, expected a row for each'):
        guessed(text)


def test_rows_that_name_the_joints_are_no_header_of_numbered_columns(tmp_path):
    """As ros2 topic echo --csv writes joint states; the first row was lost."""
    path, log = tmp_path / 'p.csv', tmp_path / 'js.csv'
    path.write_text(''.join(f'8,0,leica,{x},{y},{z}\n' for x, y, z in PLACES.tolist()))
    log.write_text(''.join(f'8,0,,a,b,{q1},{q2}\n' for q1, q2 in JOINTS.tolist()))
    given = Layout(columns={'q1': '#6', 'q2': '#7', 'x': '#4', 'y': '#5', 'z': '#6'})
    assert_same(read_table(path, 2, foreign=Foreign(given, ARM, log, given)), None)
    for foreign, said in (
        (Foreign(Layout(), ARM, log, given), 'p.csv has no column x, y, z; it has 8, 0, leica'),
        (Foreign(given, ARM, log), 'line 2 has "a": numbers without units are expected'),
    ):
        with pytest.raises(InputError, match=said):
            foreign.convert(path)
    log.write_text(text_of(JOINTS, names=['actual_q_0', 'actual_q_1']))
    with pytest.raises(InputError, match='give --columns "q1=actual_q_0,q2=actual_q_1" or'):
        Foreign(given, ARM, log).convert(path)


@pytest.mark.parametrize(
    ('rows', 'said'),
    [
        ('1,2,3,4,"5\n1,2,3,4,6', '.* quotation marks paired'),
        ('1,2,3,4,5,"as above\n1,2,3,4,6', '.* quotation marks paired'),
        ('1,2,3,4,5,"\n1,2,3,4,6', '.* quotation marks paired'),
        ('1,2,3,4,5,"\n1,2,3,4,6,\n1,2,3,4,7,"', 'whole rows are within quotation marks'),
        ('1,2,3,4,5,"\n1,2,3,4,6,\n1,2,3,4,",', 'whole rows are within quotation marks'),
        (',,,,,\n"1,2,3,4,5,\n1,2,3,4,6,"', 'whole rows are within quotation marks'),
        ('\n"1,2,3,4,5,\n1,2,3,4,6,"', 'whole rows are within quotation marks'),
    ],
)
def test_a_quotation_mark_hides_no_rows(path, rows, said):
    """Those below an open one, or between two ditto marks, were one cell that nobody reads."""
    path.write_text(f'q1,q2,x,y,z,note\n1,2,3,4,5,a\n{rows}\n')
    line = 3 if rows.startswith('1') else 4
    for foreign in (None, Foreign(Layout())):
        with pytest.raises(InputError, match=f'from line {line}: {said}'):
            read_table(path, 2, foreign=foreign)


def test_a_note_of_several_lines_is_one_cell(path):
    path.write_text(
        PLAIN.replace('q1', 'note,q1', 1).replace('\n', '\n"hot, windy,\n12"" tool",', 3)
    )
    for foreign in (None, Foreign(Layout(separator='comma'))):
        assert_same(read_table(path, 2, foreign=foreign), None)


@pytest.mark.parametrize('note', ['a, b, c, d, e\nf', 'a, b\nc, d, e, f', 'a\n, b, c\nd', 'a\rb'])
def test_a_note_with_as_many_commas_as_a_row_hides_none(path, note):
    rows = f'q1,q2,x,y,z,note\n1,2,3,4,5,\n1,2,3,4,6,"{note}"\n1,2,3,4,7,\n'
    path.write_bytes(rows.encode())  # as they are
    (found,) = read_table(path, 2).fitted
    assert found.positions[:, 2].tolist() == [5.0, 6.0, 7.0]


def test_a_number_of_a_column_that_is_not_there_is_told(read):
    with pytest.raises(InputError, match='has no column #9 for session; it has q1, q2, x, y, z'):
        read(PLAIN, columns={'session': '#9'})


def test_points_between_thousands_are_no_decimals(read, path):
    """Beside decimal commas; where neither is told from the other, both are refused."""
    (found,) = read('q1;q2;x [mm];y [mm];z [mm];session\n0.642;0,5;999,5;356;1554;B 1,5\n').fitted
    np.testing.assert_allclose(found.joints, [[0.642, 0.5]])
    np.testing.assert_allclose(found.positions, [[0.9995, 0.356, 1.554]])
    text = path.read_text()
    for cell, said in (
        ('1.554', 'without the marks between thousands, or its decimal point as a comma'),
        ('\u22121.554', 'write it without the marks between thousands'),
        ('1.554,25', "not '1.554,25': write it without the marks between thousands"),
    ):
        with pytest.raises(InputError, match=said):
            read(text.replace('1554', cell))
    (found,) = read('q1;q2;x;y;z;note\n0.25;0.5;1.554;1;2;21,5\n').fitted
    np.testing.assert_allclose(found.positions, [[1.554, 1, 2]])
    (found,) = read('q1;q2;x;y;z\n\u22121,5;2,125;1;2;3\n').fitted
    np.testing.assert_allclose(found.joints, [[-1.5, 2.125]])
    with pytest.raises(InputError, match='give --decimal comma; if these are thousands, write it'):
        read('q1;q2;x;y;z\n1,554;2,125;1;2;3\n')
    (found,) = read_table(path, 2, foreign=Foreign(Layout(decimal=','))).fitted
    np.testing.assert_allclose(found.joints, [[1.554, 2.125]])


def test_joint_values_that_all_have_three_decimals_after_a_comma_are_read(tmp_path):
    """As KUKA and German spreadsheets write them; no option was heard for such a log."""
    path, log = tmp_path / 'cell.csv', tmp_path / 'log.csv'
    path.write_text('pose,x,y,z\np1,0.5,1,2\np2,0.25,1,2\n')
    log.write_text('pose;q1 [deg];q2 [deg]\np1;-94,962;12,500\np2;1,554;2,125\n')
    (found,) = read_table(path, 2, foreign=Foreign(Layout(), log=log)).fitted
    np.testing.assert_allclose(np.degrees(found.joints), [[-94.962, 12.5], [1.554, 2.125]])
    np.testing.assert_allclose(read_joints(log, ARM), found.joints)
    log.write_text(log.read_text().replace('12,500', '12'))  # 94,962 may be thousands
    with pytest.raises(InputError, match='give --decimal comma'):
        read_table(path, 2, foreign=Foreign(Layout(), log=log))


def test_stamps_in_seconds_are_told_what_to_give(path):
    path.write_text('stamp_ns,q1,q2,x,y,z\n1700000000.25,1,2,3,4,5\n')
    with pytest.raises(InputError, match='in seconds, give --columns time=stamp_ns'):
        read_table(path, 2)
    columns = {'time': 'stamp_ns'}
    (found,) = read_table(path, 2, foreign=Foreign(Layout(columns=columns))).fitted
    np.testing.assert_allclose(found.stamps_ns, 1_700_000_000_250_000_000, rtol=1e-15)
    path.write_text('stamp_ns,q1,q2,x,y,z\n1.7E+18,1,2,3,4,5\n')
    with pytest.raises(InputError, match='rounded the stamps: remove or rename that column'):
        read_table(path, 2)


def test_a_time_with_decimal_commas_is_no_date(guessed):
    (found,) = guessed('Time;q1;q2;x;y;z\n0,25;1;2;3;4;5\n0,5;1;2;3;4;5\n').fitted
    assert found.stamps_ns.tolist() == [250_000_000, 500_000_000]


def test_empty_stamps_are_lines_and_rows_without_any_measurement_are_told(path):
    path.write_text('stamp_ns,q1,q2,x,y,z\n-,1,2,3,4,5\n7,1,2,3,4,5\n')
    assert read_table(path, 2).fitted[0].stamps_ns.tolist() == [2_000_000_000, 7]
    path.write_text('q1,q2,x,y,z\n1,2,-,-,-\n1,2,nan,nan,nan\n')
    with pytest.raises(InputError, match='nothing measured in lines 2, 3: rows need x, y, z'):
        read_table(path, 2)


@pytest.mark.parametrize('names', [SIGMAS[:3], SIGMAS])
def test_standard_deviations_beside_our_own_columns(guessed, path, names):
    """They were left out with a warning, unless the table had a unit or another separator."""
    sizes, quat = np.full((3, len(names)), 2e-3), TURNED.as_quat()
    sizes[1] = np.nan  # not stated
    text = text_of(JOINTS, PLACES, quat, sizes, names=['q1', 'q2', *POSE_COLUMNS, *names])
    (found,) = guessed(text).fitted
    told = np.diag([4e-6] * len(names) + [0.0] * (6 - len(names)))
    expected = np.array([told, np.full((6, 6), np.nan), told])
    np.testing.assert_allclose(found.covariance, expected, atol=1e-18)
    with pytest.raises(InputError, match='has standard deviations: calib_ros import'):
        read_table(path, 2)
    for wrong in (-2e-3, np.nan):
        sizes[2, 1] = wrong
        text = text_of(JOINTS, PLACES, quat, sizes, names=['q1', 'q2', *POSE_COLUMNS, *names])
        with pytest.raises(
            InputError,
            match='line 4: standard deviations sx, sy, sz must be positive, or all blank',
        ):
            guessed(text)


def test_rotation_matrices(guessed, path):
    """In nine columns, or in a flattened homogeneous matrix."""
    turned = TURNED.as_matrix().reshape(-1, 9)
    assert_same(guessed(text_of(JOINTS, PLACES, turned, names=[*'abxyz', *MATRIX])))
    sizes = Layout(columns={f's{each}': '1e-3' for each in ('x', 'y', 'z', 'rx', 'ry', 'rz')})
    (found,) = loading.table(path, ARM, Settings(), foreign=Foreign(sizes, ARM)).fitted
    np.testing.assert_allclose(found.covariance, np.tile(1e-6 * np.eye(6), (3, 1, 1)))
    with pytest.raises(InputError, match='has rotation matrices: calib_ros import'):
        read_table(path, 2)
    whole = np.tile(np.eye(4), (3, 1, 1))
    whole[:, :3, :3], whole[:, :3, 3] = np.round(TURNED.as_matrix(), 4), PLACES
    names = [f't{i}{j}' for i in range(1, 5) for j in range(1, 5)]
    path.write_text(text_of(JOINTS, whole.reshape(3, 16), names=['q1', 'q2', *names]))
    of_four = 'r*=t*,x=t14,y=t24,z=t34'
    (found,) = read_table(path, 2, foreign=Foreign(layout_of('', [of_four], {}))).fitted
    np.testing.assert_allclose(found.positions, PLACES)
    np.testing.assert_allclose(found.rotations, TURNED.as_matrix(), atol=1e-4)
    for columns, said in (
        (f'{of_four},r11=t12', r'line 2: r11 \.\.\. r33 are no rotation: check the order'),
        (f'{of_four},r33=-t33', 'and that the axes are right-handed'),
        ('x=t14,y=t24,z=t34,r11=t11', 'nine columns, missing r12, r13'),
    ):
        with pytest.raises((InputError, ConfigError), match=said):
            read_table(path, 2, foreign=Foreign(layout_of('', [columns], {})))


def test_a_blank_in_a_log_of_joint_values_is_told_with_its_line(tmp_path):
    """It was told as one of the other table. Of columns P and p that of its name counts."""
    path, log = tmp_path / 'p.csv', tmp_path / 'js.csv'
    path.write_text('P,x,y,z\n' + ''.join(f'{k},{k},0,1\n' for k in (2, 1)))
    log.write_text('P,p,q1,q2\n1,2,0.1,0.2\n2,1,0.3,nan\n3,3,nan,0\n')
    foreign = Foreign(Layout(), None, log)
    with pytest.raises(InputError, match='line 3: q2 is blank: correct or leave out that row'):
        read_table(path, 2, foreign=foreign)
    log.write_text(log.read_text().replace('0.3,nan', '0.3,0.4'))
    (found,) = read_table(path, 2, foreign=foreign).fitted
    assert found.joints.tolist() == [[0.3, 0.4], [0.1, 0.2]]


def test_a_table_beside_a_log_is_not_asked_for_joint_values(tmp_path):
    """It was told to give the file that was given."""
    path, log = tmp_path / 'p.csv', tmp_path / 'js.csv'
    path.write_text('a,b\n1,2\n')
    log.write_text('q1,q2\n1,2\n')
    with pytest.raises(InputError) as told:
        read_table(path, 2, foreign=Foreign(Layout(), None, log))
    assert str(told.value).endswith('names: --columns "x=NAME,y=NAME,z=NAME"')


@pytest.mark.parametrize(
    ('rows', 'line'),
    [
        ('1,2,3,4,5\n1,2,3,4,1,234.5\n1,2,3,4,6\n', 3),
        ('1,1,2,3,4,5\n2,1,2,3,4,6\n', 2),  # numbered, as R writes them
        ('P1,1,2,3,4,5\nP2,1,2,3,4,6\n', 2),
        ('0,1,0,2,0,3,0,4,0,5\n0,2,0,2,0,3,0,4,0,5\n', 2),  # decimal commas
        ('1,2,3,4,5\n1,2,3,4,5,hot\n1,2,3,4,6\n', 0),
    ],
)
def test_rows_with_a_number_more_than_the_header_are_refused(path, rows, line):
    """Their numbers were read one column further, without a word; a remark is none."""
    path.write_text(f'q1,q2,x,y,z\n{rows}')
    if not line:
        assert len(read_table(path, 2, foreign=Foreign(Layout())).fitted[0]) == 3
        return
    with pytest.raises(InputError, match=f'line {line}: more cells than the 5 columns'):
        read_table(path, 2, foreign=Foreign(Layout()))


def test_an_offset_above_the_header_is_no_table_on_its_side(guessed):
    """Whose rows and columns were to be exchanged."""
    with pytest.raises(InputError, match='x=X_meas,y=Y_meas,z=Z_meas'):
        guessed('Tool,,\nx,1\ny,2\nz,3\nAxis 1,Axis 2,X_meas,Y_meas,Z_meas\n1,2,3,4,5\n')


def test_a_header_that_may_lack_the_name_of_a_column_is_refused(guessed):
    """The numbers of the poses were q1, and so on, behind a header like those of numpy."""
    for text in ('# q1 q2 x y z\n1 2 3 4 5 ok\n2 2 3 4 6 ok\n', 'q1,q2,x,y,z\n0,2,1,2,3,ok\n'):
        with pytest.raises(InputError, match='line 2: more cells than the 5 columns of its head'):
            guessed(text, 'cell.txt')


@pytest.mark.parametrize(
    'text', ['0,1,2,3,4,5\n,1,2,3,4,5\n', 'a log\n1,1,2,3,4,5\n2,1,2,3,4,5,7\n']
)
def test_rows_without_a_header_have_no_number_too_many(path, text):
    """A blank first cell was told as one beyond a header of no columns."""
    path.write_text(text)
    numbered = Layout(columns={'q1': '#2', 'q2': '#3', 'x': '#4', 'y': '#5', 'z': '#6'})
    (found,) = read_table(path, 2, foreign=Foreign(numbered)).fitted
    assert found.positions.tolist() == [[3.0, 4.0, 5.0]] * 2


def test_tabs_are_blanks_between_cells(read):
    assert read(PLAIN.replace(',', '\t'), separator='space').fitted


@pytest.mark.parametrize(('given', 'found'), [('space', 'comma'), ('comma', 'semicolon')])
def test_another_separator_than_the_one_given_is_named(read, given, found):
    with pytest.raises(InputError, match=f'separates its cells by {found}s: give --separator'):
        read(PLAIN.replace(',', SEPARATORS[found]), separator=given)


def test_decimal_commas_of_a_single_column_are_no_separators(tmp_path):
    path, log = tmp_path / 'cell.csv', tmp_path / 'log.csv'
    path.write_text('x,y,z\n1,2,3\n2,3,4\n')
    log.write_text('q1\n0,5\n0,7\n')
    one = Chain('rail', 'standard', (Joint('a', 'prismatic'),))
    given = Foreign(Layout(), one, log, Layout(separator='semicolon'))
    assert read_table(path, 1, foreign=given).fitted[0].joints.tolist() == [[0.5], [0.7]]


GANTRY = Chain('gantry', 'standard', tuple(Joint(name, 'prismatic') for name in 'xyz'))


@pytest.mark.parametrize(
    ('header', 'said'),
    [
        ('X,Y,Z,x,y,z', 'q1=X,q2=Y,q3=Z"'),
        ('X,Y,Z,mx,my,mz', 'q1=X,q2=Y,q3=Z,x=NAME,y=NAME,z=NAME"'),
        ('Axis_X,Axis_Y,Axis_Z,x,y,z', 'q1=Axis_X,q2=Axis_Y,q3=Axis_Z"'),
        ('x,y,z', 'q1=x,q2=y,q3=z,x=NAME,y=NAME,z=NAME"'),
    ],
)
def test_joints_called_as_the_positions_are_are_told_apart(path, header, said):
    numbers = ','.join(map(str, range(header.count(',') + 1)))
    path.write_text(f'{header}\n{numbers}\n{numbers}\n')
    with pytest.raises(InputError, match=f'--columns "{re.escape(said)}'):
        read_table(path, 3, foreign=Foreign(Layout(), GANTRY))


def test_axes_in_small_letters_are_no_accelerations(path):
    """They were joint values and accelerations."""
    path.write_text('a1 [deg],a2 [deg],x,y,z\n1,2,3,4,5\n2,3,4,5,6\n')
    arm = Chain('arm', 'standard', (Joint('A1'), Joint('A2')))
    (found,) = read_table(path, 2, foreign=Foreign(Layout(), arm)).fitted
    np.testing.assert_allclose(found.joints, np.radians([[1, 2], [2, 3]]))
    assert found.acceleration is None


@pytest.mark.parametrize('named', [{}, {'x': 'X', 'y': 'Y', 'z': 'Z'}])
def test_a_column_is_not_a_joint_value_and_a_position(path, named):
    path.write_text('A1,A2,A3,X,Y,Z\n1,2,3,4,5,6\n2,3,4,5,6,7\n')
    arm = Chain('gantry', 'standard', tuple(Joint(name, 'prismatic') for name in 'XYZ'))
    with pytest.raises(InputError, match=re.escape('--columns "q*=A*"')):
        read_table(path, 3, foreign=Foreign(Layout(columns=named), arm))


def test_the_joints_of_a_gantry_in_capitals_are_no_positions(path):
    path.write_text('X,Y,Z,x,y,z\n1,2,3,4,5,6\n2,3,4,5,6,7\n')
    arm = Chain('gantry', 'standard', tuple(Joint(name, 'prismatic') for name in 'XYZ'))
    for found in (
        read_table(path, 3, foreign=Foreign(Layout(), arm)),
        loading.table(path, arm, Settings()),
    ):
        assert found.fitted[0].joints.tolist() == [[1, 2, 3], [2, 3, 4]]
        assert found.fitted[0].positions.tolist() == [[4, 5, 6], [5, 6, 7]]


def test_the_joints_with_motors_of_an_arm_whose_hand_is_kept_level_are_told(path):
    joints = [
        Joint(f'j{k}', a=0.5, lower=0 if k == 2 else None, upper=0 if k == 2 else None)
        for k in (1, 2, 3)
    ]
    level = (('j2.coupling_joint_j1', -1.0),)
    arm = Chain('level', 'standard', tuple(joints), effects=level)
    path.write_text('q1,q2,x,y,z\n1,2,3,4,5\n2,2,3,4,6\n')
    with pytest.raises(InputError, match='joints with motors: --columns "q3=#2,q2=0"'):
        read_table(path, 3, foreign=Foreign(Layout(), arm))
