# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import os
from pathlib import Path

import numpy as np
import pytest

from calib_ros.errors import InputError, UnknownNameError
from calib_ros.files import loading
from calib_ros.files.columns import read_columns
from calib_ros.files.foreign import Foreign
from calib_ros.files.layouts import Layout
from calib_ros.files.measurements import distinct_rows
from calib_ros.files.tables import read_table
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.settings import Settings

POINTS = """q1,q2,x,y,z
0.1,0.2,1,2,3
-0.3,4e-1,4.5,5.5,6.5
"""
POSES = """id,q1,q2,x,y,z,qx,qy,qz,qw,temperature
7,0.1,0.2,1,2,3,0,0,0,1,23.5
8,0.3,0.4,4,5,6,0.5,-0.5,0.5,0.5,
"""
SPLIT = """split,q1,q2,x,y,z
train,1,0,1,0,0
test,2,0,2,0,0
train,3,0,3,0,0
,4,0,4,0,0
test,5,0,5,0,0
"""
SESSIONS = """session,q1,q2,x,y,z
A,1,0,1,0,0
B,2,0,2,0,0
A,3,0,3,0,0
"""


@pytest.fixture
def read(tmp_path):
    def read(text, session=None):
        path = tmp_path / 'cell.csv'
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        table = read_table(path, 2, (session,) if session else ())
        (fitted,) = table.fitted
        (held_out,) = table.held_out or (fitted.select([]),)
        return fitted, held_out

    return read


def test_columns_in_any_order_with_byte_order_mark_and_windows_lines(read):
    text = '\ufeffz,y,x,q2,q1\r\n3,2,1,0.2,0.1\r\n\r\n'
    fitted, _ = read(text)
    np.testing.assert_array_equal(fitted.joints, [[0.1, 0.2]])
    np.testing.assert_array_equal(fitted.positions, [[1, 2, 3]])


OF_JOINTS = {f'q{k}': f'q{k}' for k in (1, 2, 3)}
LEFT_OUT = 'it has no q3 (q3): left out'


@pytest.mark.parametrize(
    ('text', 'layout', 'x', 'said'),
    [
        (POINTS, {'columns': OF_JOINTS}, 1.0, LEFT_OUT),
        (POINTS.replace('z\n', 'z\n// 9,9,9,9,9\n'), {'comment': '//'}, 1.0, 'no units are given'),
        (f'units: mm\n{POINTS}', {}, 1e-3, 'its lines of units say that lengths are in mm'),
        (POINTS.replace('x,', 'x [ticks],'), {'columns': {'x': 'x*2'}}, 2.0, 'no units are given'),
        (f'Cell,of,Anna,on,Monday,in,Hall\n{POINTS}', {'columns': {'x': 'x'}}, 1.0, 'no units'),
    ],
    ids=['too many joints', 'commented out', 'units above', 'converted', 'a long title'],
)
def test_what_stands_beside_the_numbers_of_others_is_told_or_ignored(path, text, layout, x, said):
    path.write_text(text)
    table = read_table(path, 2, foreign=Foreign(Layout(**layout)))
    assert table.fitted[0].positions[:, 0].tolist() == [x, 4.5 * x]
    assert any(said in each for each in table.warnings)


def test_a_session_that_is_not_there_lists_those_that_are(read):
    with pytest.raises(UnknownNameError) as caught:
        read(SESSIONS, 'C')
    assert caught.value.alternatives == ('A', 'B')
    with pytest.raises(InputError, match='no column "session" to choose "A" from'):
        read(POINTS, 'A')


def test_a_path_that_holds_no_file_is_refused(tmp_path):
    for path in (tmp_path, tmp_path / 'missing.csv'):
        with pytest.raises(InputError, match=f'cannot read {path}'):
            read_table(path, 2)


FRAMES = """session,device,frame_id,q1,q2,x,y,z,split
A,left,world,1,0,1,0,0,
A,left,,2,0,2,0,0,
A,right,cell,3,0,3,0,0,
A,left,map,4,0,4,0,0,
A,left,world,5,0,5,0,0,test
B,left,map,6,0,6,0,0,
"""


def test_each_device_and_session_has_a_frame_of_its_own(path):
    path.write_text(FRAMES.replace('A,left,map', 'A,other,map'))
    table = read_table(path, 2, ('A', 'B'))
    assert [each.base for each in table.fitted] == ['base', 'base_right', 'base_other', 'base_B']
    assert table.world_frame == 'world'


FRAMED = 'stamp_ns,q1,q2,x,y,z,frame_id,split\n1,1,0,1,0,0,world,\n2,2,0,2,0,0,map,\n'


@pytest.mark.parametrize(
    ('text', 'session', 'count'),
    [
        (SESSIONS.replace('B,', 'A,'), None, 3),  # a single one needs no choice
        (SESSIONS.replace('B,2', 'B,nan'), 'A', 2),
        (f'{FRAMED}2,2,0,2,0,0,map,removed\n', None, 1),
    ],
)
def test_rows_of_other_sessions_and_rows_taken_back_may_be_anything(read, text, session, count):
    assert len(read(text, session)[0]) == count


TURN, FLAG = '0.5,-0.5,0.5,0.5', 'q1,q2,x,y,z,qx,qy,qz,qw,eye_in_hand\n1,0,1,0,0,0,0,0,1,'
NAMED = ''.join(f'{k},0,1,0,0,{"map" if k else "world"}\n' for k in range(9))
FAULTS = [
    *((SPLIT.replace('train', each, 1), 'line 2: split must be train or test') for each in
      ('Test', ' test', 'validation')),
    (POINTS.replace(',q2,', ',other,'), 'no column q2; expected q1, q2, x, y, z .*other'),
    (POINTS.replace(',y,', ',other,'), 'no column y; expected q1, q2, x, y, z .*other'),
    (POINTS.replace('q', 'a').replace('x,y,z', 'u,v,w'), r'no column q1, q2, x, y, z \(or dist'),
    (POSES.replace('qw', 'w'), 'no column qw;'),
    (
        POINTS.replace('\n-0.3', '\n\n\n\n-0.3').replace('4.5', 'bad'),
        'line 6: x must be a finite number',
    ),
    (POINTS.replace('5.5', '1e7'), r'line 3: y must be at most 1e\+06, not 1e\+07'),
    (f'{POINTS}0.1,0.2,1,2\n', 'line 4: z must be a finite number'),
    (f'{POINTS}0.1,0.2,1,2,\n', 'line 4: z must be a finite number'),
    *((POINTS.replace('5.5', each), 'line 3: y .* without the marks between thousands')
      for each in ('1 554.25', '1\u202f554.25', '1\u2019554.25')),
    (f'{POINTS}0.1\n', 'line 4: q2 must be a finite number'),
    ('q1,q2,x,y,z,session\n1,0,1,0,0,A\n2,0,2,0,0\n', r'cell\.csv'),
    *((POSES.replace(TURN, each), r'cell\.csv, line 3: quaternion .* expected 1') for each in
      ('0,0,0,2', '0,0,0,0', '0.6,0,0,0.9', '0,0,0,1.01')),
    *((POSES.replace(TURN, each), r'line 3: q[xyzw] must be a finite number') for each in
      ('0.5,-0.5,0.5,', ',,,1', '0.5,,0.5,0.5')),
    *((each, r'cell\.csv has no') for each in
      ('', '\n', 'q1,q2,x,y,z\n', 'q1,q2,x,y,z\n\n\n')),
    (b'\xff\xfe\x00\x80', r'cell\.csv is not UTF-8 text'),
    *((f'{FLAG}{each}\n', f"line 2: eye_in_hand must be 0 or 1, not '{each}'") for each in
      ('yes', 'True', '2')),
    (SESSIONS, r'cell\.csv holds several sessions, .*A, B'),
    (
        '\n'.join(FRAMES.splitlines()[:-1]),
        r'different frames: world \(lines 2, 6\), map \(line 5\); only one is allowed',
    ),
    (f'q1,q2,x,y,z,frame_id\n{NAMED}', r'map \(lines 3, 4, 5, 6, 7, and 3 more\)'),
    *((POINTS.replace('5.5', f'"{each}"'), f"y must be a finite number, not '{each}': correct")
      for each in ('nan', 'inf', '-inf', ' ', 'twelve', '1;2', '1_0')),
    (POINTS.replace('5.5', '""'), 'y must be a finite number, not empty or NaN: correct'),
    (POINTS.replace('5.5', '5.5 mm'), r'y must be .*: write its unit into the header, y \[mm\]'),
    (POINTS.replace('5.5', '"0,5"'), "line 3: y must be .*, not '0,5': write a point"),
    ('q1,q2,x,y,z,distance\n0,0,,,,3\n0,0,1,2,3,4\n', 'line 3 has both x and distance: '),
    ('q1,q2,location,socket\n0,0,A,1\n0,0,B,1_2\n', 'line 3: socket must be LOCATION/SOCKET'),
    *((POINTS.replace('5.5', each), r'cell\.csv, line 3: y must be') for each in
      ('1e160', '-1e7', '²')),
    (POINTS.replace('-0.3', '1e300'), 'line 3: q1 must be'),
    *((f'stamp_ns,q1,q2,x,y,z\n{each},0,0,1,2,3\n', 'line 2: stamp_ns must be an integer')
      for each in ('²', '9223372036854775808', '9' * 5000, '1.5', '--1', '"1,000"')),
    ('q1,q2,q1,x,y,z\n0,0,0,1,2,3\n', 'several columns q1'),
    (f'{POINTS}0,0,1,2,3,,4\n', 'line 4: more values than the 5 columns'),
    (f'{POINTS}{"0," * 600_000}\n', 'a line of more than 1000000 bytes'),
    (','.join(f'c{k}' for k in range(100_000)) + '\n1' * 100_000, '100000 columns'),
    ('q1,q2,x,y,z,device\n' + ''.join(f'0,0,1,2,3,d{k % 199}\n' for k in range(200)),
     'line 102: more than 100 sessions'),
    (POINTS.encode('utf-16'), 'not UTF-8 text, line 1 has zero bytes'),
    ('q1,é\n0,1\n'.encode('latin-1'), 'not UTF-8 text: save it as UTF-8'),
    (POINTS.encode() + bytes(5000), 'line 4 has zero bytes: .* Save it as CSV in UTF-8$'),
    (f'{POINTS}"0,1,2,3,4\n0,1,2,3,4\n', 'from line 4: .* quotation marks paired'),
    *((f'q1;q2;x;y;z\n{each}\n', r'separated by semicolons: .*calib_ros import') for each in
      ('1;2;3;4;5', '0,1;0,2;1,3;1,4;1,5')),
]  # fmt: skip


@pytest.mark.parametrize(('text', 'said'), FAULTS, ids=range(len(FAULTS)))
def test_faults_are_named_with_their_lines(read, text, said):
    with pytest.raises(InputError, match=said):
        read(text)


MIXED = (
    "stamp_ns,device,target,q1,q2,x,y,z,qx,qy,qz,qw,distance,eye_in_hand,split,"
    + """v1,v2,s1,s2
5,left,,1,0,1,0,0,,,,,,,,,,1,-3
4,left,a,2,0,2,0,0,0.5,-0.5,0.5,0.5,,,test,0.1,0.2,,
5,,a,3,0,,,,,,,,7.5,,,,,,
5,cam,a,4,0,4,0,0,0,0,0,1,,1,train,,,,
3,left,,5,0,5,0,0,,,,,,,,,,,
"""
)  # fmt: skip


def test_rows_of_several_kinds_are_sets_between_frames_of_their_own(path):
    """Positions, a distance and a pose in a camera on the flange, and one pose held out."""
    path.write_text(MIXED)
    table = read_table(path, 2)
    points, wire, camera, judge = found = (*table.fitted, *table.held_out)
    assert [(each.base, each.tool, each.joints[:, 0].tolist()) for each in found] == [
        ('base', 'tool', [1, 5]),
        ('base_distance', 'tool_a', [3]),
        ('base_a', 'tool_cam', [4]),
        ('base', 'tool_a', [2]),
    ]
    assert (points.positions[:, 0].tolist(), points.oriented.any()) == ([1, 5], False)
    assert wire.distances.tolist() == [7.5]
    assert (camera.positions[:, 0].tolist(), camera.inverse) == ([-4], True)
    assert judge.oriented.all()
    assert [each.distances for each in (points, camera, judge)] == [None] * 3


def test_sessions_come_in_the_order_asked_for(path):
    path.write_text(SESSIONS)
    found = read_table(path, 2, ('B', 'A')).fitted
    assert [each.positions[:, 0].tolist() for each in found] == [[2.0], [1.0, 3.0]]
    assert [each.base for each in found] == ['base', 'base_A']
    with pytest.raises(InputError, match='session "A" is named twice'):
        read_table(path, 2, ('A', 'A'))


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('q1,q2,q3,x,y,z\n0,0,0,1,2,3\n', 'the column q3 is left out: the arm has 2 joints'),
        ('q1,q2,x,y,z,rx,ry,rz\n0,0,1,2,3,0,0,0\n', 'rx, ry, rz are left out: give --euler'),
        ('q1,q2,x,y,z,rx,qx,qy,qz,qw\n0,0,1,2,3,0,0,0,0,1\n', ''),
        (
            'q1,q2,x,y,z,qx,qy,qz,qw,roll,pitch,yaw\n0,0,1,2,3,0,0,0,1,0,0,0\n',
            'columns not read: roll, pitch, yaw (',
        ),
        ('q1,q2,x,y,z,QX,QY,QZ,QW\n0,0,1,2,3,0,0,0,1\n', ' is read as q'),
        ('q1,q2,x,y,z,q_w,,robot\n0,0,1,2,3,1,,left\n', 'columns not read: q_w, robot ('),
    ],
)
def test_columns_that_someone_may_have_wanted_are_told(path, text, said):
    path.write_text(text)
    warnings = read_table(path, 2).warnings
    assert len(warnings) == bool(said) * (4 if 'QX' in text else 1)
    assert all(said in each for each in warnings)


@pytest.mark.parametrize(
    ('names', 'separator', 'noted'),
    [
        ('shoulder,Elbow,x,y,z', ',', 'q1 = shoulder, q2 = elbow'),
        ('Q1,Q2,X,Y,Z', ',', 'no units are given'),
        ('q1,q2,x,y,z', ';', 'semicolon'),
        ('q1,q2,x,y,z,Prüfung', ',', 'Windows-1252: if its words are wrong, save it as UTF-8'),
        ('q1,q2,x,y,z,Prüfung', ',', 'columns not read: Prüfung ('),
        ('q1,q2,x,y,z,UTF-16', ',', 'no units are given'),
    ],
)
def test_without_options_a_table_of_others_is_read_as_far_as_it_can_be_guessed(
    path, names, separator, noted
):
    text = POINTS.replace('q1,q2,x,y,z', names).replace(',', separator)
    path.write_bytes(text.encode('utf-16' if 'UTF-16' in names else 'cp1252'))
    joints = tuple(Joint(name, a=0.3) for name in ('shoulder', 'elbow'))
    found = loading.table(path, Chain('arm', 'standard', joints), Settings())
    np.testing.assert_array_equal(found.fitted[0].joints, [[0.1, 0.2], [-0.3, 0.4]])
    assert noted in ' '.join(found.warnings)


def test_a_pipe_in_another_form_is_told_to_be_saved():
    """What was left in it after the first look had no rows."""
    end, begin = os.pipe()
    os.write(begin, b'q1;q2;x;y;z\n0;0;1;2;3\n')
    os.close(begin)
    arm = Chain('arm', 'standard', (Joint('a'), Joint('b')))
    with pytest.raises(InputError, match=r'by semicolons: .* a pipe is read once, .*: save it'):
        loading.table(Path(f'/dev/fd/{end}'), arm, Settings())
    os.close(end)


@pytest.mark.parametrize('name', ['Session', 'SESSION', 'session'])
def test_columns_of_names_are_read_in_any_case(path, name):
    path.write_text(SESSIONS.replace('session', name))
    with pytest.raises(InputError, match=r'several sessions, choose one of A, B .* together\)$'):
        read_table(path, 2)
    path.write_text('q1,q2,x,y,z,session\n0,0,1,2,3,A\n0,0,1,2,3,\n0,0,1,2,3,B\n')
    with pytest.raises(InputError, match=r'one of A, B .*without one are left out: name it'):
        read_table(path, 2)


def test_a_name_in_another_case_is_told_and_two_are_not_read(path):
    path.write_text('q1,q2,x,y,z,Target\n0,0,1,2,3,a\n')
    assert read_table(path, 2).warnings == (f'{path}: the column Target is read as target',)
    path.write_text('q1,q2,x,y,z,Target,TARGET\n0,0,1,2,3,a,b\n')
    assert 'columns not read: Target, TARGET (' in read_table(path, 2).warnings[0]


@pytest.mark.parametrize('column', ['distance', 'Distance [mm]', 'plane'])
def test_distances_beside_coordinates_are_no_measurements_of_their_own(path, column):
    """As trackers write them; the column had to be renamed."""
    path.write_text(f'q1;q2;x;y;z;{column}\n0,1;0;1;2;3;4\n0,2;0;1;2;3;\n')
    arm = Chain('arm', 'standard', (Joint('a'), Joint('b')))
    table = loading.table(path, arm, Settings())
    assert [len(each) for each in table.fitted] == [2]
    assert 'is left out: x, y, z are in all of its rows' in table.warnings[-1]
    path.write_text(f'q1,q2,X,Y,Z,{column}\n0,0,1,2,3,4\n')  # X, Y, Z were not read at all
    (found,) = loading.table(path, arm, Settings()).fitted
    assert found.distances is None
    assert found.positions[0, 0] == (1e-3 if 'mm' in column else 1.0)


@pytest.mark.parametrize('separator', [',', ';'])
def test_a_name_of_poses_is_no_target(path, separator):
    """SpatialAnalyzer calls a point so: each row had a frame of its own to be fitted."""
    rows = [f'{k}e-1,0,1,2,3,P{k}' for k in range(4)]
    path.write_text('\n'.join(['q1,q2,x,y,z,Target', *rows, '']).replace(',', separator))
    arm = Chain('arm', 'standard', (Joint('a'), Joint('b')))
    table = loading.table(path, arm, Settings())
    assert [len(each) for each in table.fitted] == [4]
    assert 'the column target has another name in each row' in table.warnings[-1]
    path.write_text(path.read_text().replace('P3', 'P2'))
    assert len(loading.table(path, arm, Settings()).fitted) == 3


def test_one_column_has_a_line_for_each_row(tmp_path):
    """Split at separators it had one more."""
    path = tmp_path / 'axis.csv'
    path.write_text('q1\n0.1\n0.2\n')
    found = read_columns(path, ['q1'])
    assert found.lines.tolist() == [2, 3]
    assert found.select(slice(1, None)).lines.tolist() == [3]


def test_a_column_of_any_length_is_read_to_the_last_bit(tmp_path):
    """Longer than the parts in which numpy reads it; each cell is read as Python reads it."""
    path = tmp_path / 'long.csv'
    cells = [
        f'{x!r}{"0" * 90}' for x in np.random.default_rng(0).uniform(0.1, 2.0, 12_000).tolist()
    ]
    cells[5000], cells[-3:] = '', ['+1E1', ' 2 ', '']
    path.write_text('\n'.join(['q1,x', *(f'{cell},1' for cell in cells), '']))
    found = read_columns(path, ['q1']).numbers(['q1', 'x'])
    np.testing.assert_array_equal(found[:, 0], [float(cell or 'nan') for cell in cells])
    cells[9000] = '1e400'
    path.write_text('\n'.join(['q1', *cells, '']))
    with pytest.raises(InputError, match=r'line 9002: q1 must be a finite number'):
        read_columns(path, ['q1']).numbers(['q1'])


@pytest.mark.parametrize('far', [3, 2**40])
def test_rows_alike_have_one_number(far):
    """Also where their codes do not fit into one integer."""
    different, number = distinct_rows(np.array([[far, far], [0, 1], [far, far]]))
    assert (different.tolist(), number.tolist()) == ([[far, far], [0, 1]], [0, 1, 0])
