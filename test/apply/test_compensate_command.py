# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import copy
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from commanded import UR, UR_TRUE, regular

from calib_ros.apply.compensation import compensate
from calib_ros.apply.compensator import Compensator
from calib_ros.apply.simulation import measure
from calib_ros.cli.common import Status
from calib_ros.errors import InputError
from calib_ros.estimation.problem import Problem
from calib_ros.files.programs import joints_csv, program_of, read_joints, read_program
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.identification import identify
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Frame, Joint
from calib_ros.kinematics.chain_file import dump_chain

TABLE = """label,q6,q5,q4,q3,q2,q1,speed
pick, 0.1,0.7,-1.2,1.1,-1.4,1e-1,"1,5"
place,0.2,0.8,-1.1,1.2,-1.3,0.3,
"""


def trajectory(q, names=UR.joint_names, **more):
    """Return a message as `ros2 topic echo` prints it."""
    rates = {'velocities': [], 'accelerations': [], 'effort': []} | more
    points = [
        {'positions': row, **copy.deepcopy(rates), 'time_from_start': {'sec': k, 'nanosec': 0}}
        for k, row in enumerate(np.asarray(q).tolist())
    ]
    header = {'stamp': {'sec': 7, 'nanosec': 3}, 'frame_id': ''}
    message = {'header': header, 'joint_names': list(names), 'points': points}
    return yaml.safe_dump(message, sort_keys=False) + '---\n'


@pytest.fixture
def run(run, tmp_path):
    (tmp_path / 'calibration.yaml').write_text(dump_chain(UR_TRUE, {'source': 'simulation'}))

    def compensated(text, *arguments, suffix='.csv', chain='ur10e', out='out'):
        (tmp_path / f'program{suffix}').write_text(text)
        options = f'--chain {chain} --calibration calibration.yaml --out {out}{suffix}'.split()
        return run('compensate', f'program{suffix}', *options, *arguments)

    return compensated


@pytest.mark.parametrize('suffix', ['.csv', '.yaml'])
def test_degrees_are_refused_also_of_joints_without_limits(run, tmp_path, suffix):
    """An angle of 30 is 279 degrees further on: the correction would be that of another pose."""
    free = replace(UR, joints=tuple(replace(j, lower=None, upper=None) for j in UR.joints))
    (tmp_path / 'free.yaml').write_text(dump_chain(free))
    q = regular(UR, 3, seed=2)
    write = joints_csv if suffix == '.csv' else trajectory
    status, _, _ = run(write(q), suffix=suffix, chain='free.yaml')
    assert status == 0
    (tmp_path / f'out{suffix}').unlink()
    status, _, err = run(write(np.degrees(q)), suffix=suffix, chain='free.yaml')
    assert status == 1
    assert 'must be in radians; if they are, give the joint limits' in err
    assert not (tmp_path / f'out{suffix}').exists()


def test_millimetres_of_a_rail_without_limits_are_refused(tmp_path):
    rail = Chain('rail', 'standard', (Joint('rail', 'prismatic'),))
    (tmp_path / 'program.csv').write_text('q1\n0.3\n300\n')
    with pytest.raises(InputError, match='line 3: 300 is more than'):
        program_of(tmp_path / 'program.csv', rail)


@pytest.mark.parametrize('oriented', [True, False])
def test_the_whole_way_from_identification_to_program(run, tmp_path, oriented):
    """By positions of a target on the last axis alone the orientation is not known, and told so.

    A long tool would be off.
    """
    rng = np.random.default_rng(1)
    true = UR_TRUE.with_frame('tool', Frame(se3.transform(np.eye(3), np.array([0, 0, 0.01]))))
    seen = measure(true, UR.random_joints(60, rng), rng, 5e-5, 2e-4, oriented=oriented)
    # what the data tell of the size of errors would do for the orientation, too
    priors = {} if oriented else {'*_joint.*': 0.1}
    found = identify(Problem(UR, seen, sigma_position=5e-5, priors=priors))
    (tmp_path / 'result').mkdir()
    (tmp_path / 'result' / 'calibration.yaml').write_text(Calibration.of(found).dump())
    q = regular(UR, 30, seed=2)
    status, said, err = run(joints_csv(q), '--calibration', 'result')
    assert status == 0
    assert 'standard deviation of these poses: at most 0.' in said
    assert ('does not know the orientation' in err) is not oriented
    joints = np.loadtxt('out.csv', delimiter=',', skiprows=1)
    frames = {'base': found.chain.base, 'tool': found.chain.tool}
    wanted = replace(UR, **frames).forward(q)[:, :3, 3]
    after, before = (
        np.linalg.norm(true.forward(each)[:, :3, 3] - wanted, axis=1) for each in (joints, q)
    )
    assert np.sqrt(np.mean(after**2)) < 2e-4 < 1e-3 < before.max()


def test_signs_in_the_words_of_a_program_separate_nothing(tmp_path):
    path, arm = tmp_path / 'program.csv', Chain('arm', 'standard', (Joint('a'), Joint('b')))
    for words in ('MOVE;fast', 'MOVE\tfast', 'MOVE fast', 'MOVE; fast;x'):
        given = 'word,q1,q2\n' + ''.join(f'{words},0.{k},0.5\n' for k in range(1, 10))
        path.write_text(given)
        source = read_program(path, arm)
        assert source.text_with(source.program) == given
    for mark in ';\t':
        path.write_text('q1;q2;speed\n1.25;0.5;1,5\n1.554;0.5;2,5\n'.replace(';', mark))
        source = read_program(path, arm)
        assert source.text_with(source.program) == path.read_text()
    path.write_text('q1; q2\n0,25; 1.554\n')
    with pytest.raises(InputError, match=r'q2 .* without the marks between thousands'):
        read_program(path, arm)
    path.write_text('q1   q2\n0.1  0.2\n 0.3\t0.4\n')
    source = read_program(path, arm)
    assert source.text_with(source.program) == 'q1 q2\n0.1 0.2\n0.3 0.4\n'


@pytest.mark.parametrize('names', [UR.joint_names, [f'Q{k}' for k in range(1, 7)]])
def test_columns_may_have_the_names_of_the_joints(run, tmp_path, names):
    """In any order, as drivers write them."""
    assert run(TABLE)[0] == 0
    expected = (tmp_path / 'out.csv').read_text().splitlines()[1:]
    named = TABLE
    for k, name in enumerate(names):
        named = named.replace(f'q{k + 1}', name)
    assert run(named, '--force')[0] == 0
    head, *found = (tmp_path / 'out.csv').read_text().splitlines()
    assert found == expected
    assert head == named.splitlines()[0]


def test_a_trajectory_is_corrected_and_the_rest_kept(run, tmp_path):
    q = regular(UR, 1) + 0.02 * np.arange(4)[:, None]
    names = ['gripper', *UR.joint_names]
    rates = {'velocities': [0.02] * 7, 'effort': [1.0] * 7}
    given = trajectory(np.column_stack([np.ones(4), q]), names, **rates)
    status, _, err = run(given, suffix='.yaml')
    assert (status, err) == (0, '')
    before = yaml.safe_load(given.removesuffix('---\n'))
    after = yaml.safe_load((tmp_path / 'out.yaml').read_text())
    result = compensate(Compensator(UR, UR_TRUE), q)
    for k, corrected in enumerate(after['points']):
        np.testing.assert_allclose(corrected['positions'], [1.0, *result.joints[k]], atol=1e-15)
        speeds = np.array(corrected['velocities'])
        assert speeds[0] == 0.02
        assert 0.0 < np.abs(speeds[1:] - 0.02).max() < 1e-3
        assert corrected['accelerations'] == []
        corrected.update(positions=[], velocities=[])
        before['points'][k].update(positions=[], velocities=[])
    assert after == before
    assert list(after) == list(before)


@pytest.mark.parametrize('suffix', ['.csv', '.yaml', '.yml'])
def test_a_program_is_written_as_it_was_read(tmp_path, suffix):
    q = np.random.default_rng(0).normal(size=(50, 6))
    rates = {key: [0.1, 1e-05, 0, -2, 3, 4.5] for key in ('velocities', 'accelerations')}
    given = trajectory(q, **rates)
    if suffix == '.csv':
        rows = [','.join([*map(repr, row[:2]), 'ä', *map(repr, row[2:])]) for row in q.tolist()]
        given = '\n'.join(['q1,q2,note, q3,q4,q5,q6', *rows]) + '\n'
    path, again = tmp_path / f'program{suffix}', tmp_path / f'again{suffix}'
    path.write_text(given, encoding='utf-8')
    source = read_program(path, UR)
    np.testing.assert_array_equal(source.program.positions, q)
    assert len(source.places) == 50
    text = source.text_with(source.program)
    if suffix == '.csv':
        assert text == given
    else:
        assert yaml.safe_load(text) == yaml.safe_load(given.removesuffix('---\n'))
    again.write_text(text, encoding='utf-8')
    assert read_program(again, UR).text_with(source.program) == text


def test_columns_without_names_move_no_joint_value(tmp_path):
    """Two empty columns had counted as one: each joint got the value of the next."""
    path, arm = tmp_path / 'program.csv', Chain('arm', 'standard', (Joint('a'), Joint('b')))
    given = 'label,,note,,q1,, q2,\nP1,x,,y,0.25,,-1.5,\n'
    path.write_text(given)
    source = read_program(path, arm)
    np.testing.assert_array_equal(source.program.positions, [[0.25, -1.5]])
    assert source.text_with(source.program) == given


@pytest.mark.parametrize('between', ['  ', '\n'])
def test_a_program_may_have_any_blanks_in_its_header(tmp_path, between):
    """Its columns were not found again when it was written."""
    path = tmp_path / 'program.csv'
    arm = Chain('arm', 'standard', (Joint('a'), Joint('b')))
    path.write_text(given := f'"q1{between}[rad]","q2{between}[rad]"\n0.25,-1.5\n')
    source = read_program(path, arm)
    assert source.text_with(source.program).replace('"', '') == given.replace('"', '')


@pytest.mark.parametrize('coding', ['utf-8-sig', 'utf-16', 'cp1252', 'gbk', 'shift_jis'])
def test_a_program_keeps_its_separators_decimal_commas_and_encoding(tmp_path, coding):
    """As tables of measurements; they were refused. Words of others became Windows-1252's."""
    path = tmp_path / 'program.csv'
    words = '点一、終' if coding in ('gbk', 'shift_jis') else 'ä, b. c'
    given = f'q1;note;q2\n0,25;{words};1e-05\n-1,5;;2,0\n'
    arm = Chain('arm', 'standard', (Joint('a'), Joint('b')))
    for text in (given.replace('\n', '\r\n'), given):
        path.write_text(text, encoding=coding, newline='')
        source = read_program(path, arm)
        np.testing.assert_array_equal(source.program.positions, [[0.25, 1e-5], [-1.5, 2.0]])
        np.testing.assert_array_equal(read_joints(path, arm), source.program.positions)
        assert source.text_with(source.program).encode(source.coding) == path.read_bytes()
    path.write_text(given.replace('2,0', '1.234'), encoding=coding)
    with pytest.raises(InputError, match=r'line 3: q2 .* without the marks between thousands'):
        read_program(path, arm)


def test_units_are_those_of_the_header(tmp_path):
    path = tmp_path / 'program.csv'
    given = 'a [deg],b / mm,speed [mm]\n90.0,250.0,1\n-45.0,0.5,2\n'
    path.write_text(given)
    arm = Chain('arm', 'standard', (Joint('a'), Joint('b', 'prismatic')))
    source = read_program(path, arm)
    wanted = [[np.pi / 2, 0.25], [-np.pi / 4, 0.0005]]
    np.testing.assert_allclose(source.program.positions, wanted)
    np.testing.assert_array_equal(read_joints(path, arm), source.program.positions)
    further = np.add(source.program.positions, [np.pi, 1.0])
    moved = replace(source.program, positions=further)
    written = [line.split(',') for line in source.text_with(moved).splitlines()]
    assert written[0] == given.splitlines()[0].split(',')
    np.testing.assert_allclose(np.array(written[1:], float), [[270, 1250, 1], [135, 1000.5, 2]])


def test_a_trajectory_may_be_the_program_or_the_candidates(tmp_path):
    """Of verify --commanded, plan --candidates and others; only compensate read one."""
    path = tmp_path / 'path.yaml'
    path.write_text(
        'joint_names: [b, a]\npoints:\n- {positions: [0.5, 0.25]}\n- {positions: [1, 2]}'
    )
    joints = (Joint('a', lower=-2.0, upper=2.0), Joint('b', lower=-1.0, upper=1.0))
    arm = Chain('arm', 'standard', joints)
    np.testing.assert_array_equal(read_joints(path, arm), [[0.25, 0.5], [2.0, 1.0]])
    path.write_text(path.read_text().replace('[1, 2]', '[1, 2.5]'))
    with pytest.raises(InputError, match=r'path.yaml, point 2: 2.5 is beyond the limits of a, '):
        read_joints(path, arm)


def test_line_breaks_in_names_of_columns_are_blanks(tmp_path):
    """As spreadsheets write a unit below a name; the column was not found."""
    path = tmp_path / 'program.csv'
    path.write_text(given := '"a\n[deg]",b\n90.0,0.5\n')
    source = read_program(path, Chain('arm', 'standard', (Joint('a'), Joint('b', 'prismatic'))))
    np.testing.assert_allclose(source.program.positions, [[np.pi / 2, 0.5]])
    assert source.text_with(source.program) == given


@pytest.mark.parametrize('header', ['q1,q2,s1,s2', 'Q1,Q2,S1,S2'])
def test_signs_in_a_table_are_the_approach(tmp_path, header):
    path = tmp_path / 'program.csv'
    path.write_text(f'{header}\n1,2,-0.5,0\n3,4,1,7\n')
    arm = Chain('arm', 'standard', (Joint('a'), Joint('b')))
    program = read_program(path, arm).program
    np.testing.assert_array_equal(program.approach, [[-1.0, 0.0], [1.0, 1.0]])


@pytest.mark.parametrize(('suffix', 'force'), [('.csv', False), ('.yaml', True)])
def test_nothing_is_written_when_a_sample_is_refused(run, tmp_path, suffix, force):
    q = regular(UR, 3)
    q[1, 4] = 0.0
    q[2, 2] = 4.0
    rows = [','.join(map(repr, row)) for row in q.tolist()]
    table = '\n'.join(['q1,q2,q3,q4,q5,q6', '', *rows]) + '\n'
    out = tmp_path / f'out{suffix}'
    if force:
        out.write_text('precious')
    text = table if suffix == '.csv' else trajectory(q)
    status, said, err = run(text, *(['--force'] if force else []), suffix=suffix)
    assert (status, said) == (Status.NOT_ACCEPTED, '')
    first, second, third = err.splitlines()
    assert first.startswith('calib_ros: nothing is written, because not every point can')
    places = ('line 4', 'line 5') if suffix == '.csv' else ('point 2', 'point 3')
    assert second.startswith(f'{places[0]}: near a singularity')
    assert third.startswith(f'{places[1]}: the command 4 of elbow_joint is beyond its limits')
    assert out.read_text() == 'precious' if force else not out.exists()


def test_of_many_refused_points_the_first_are_named(run):
    q = np.tile(regular(UR, 1), (9, 1))
    q[:, 2] = 4.0
    _, _, err = run(joints_csv(q))
    assert len(err.splitlines()) == 7
    assert err.endswith('refused: and 4 more, up to line 10\n')


def test_names_and_units_of_a_program_are_in_its_first_line(run, capsys):
    """Of identify they may be options."""
    with pytest.raises(SystemExit):
        run(TABLE, '--columns', 'q*=J*')
    assert 'in the first line of the file: q1 [deg]\n' in capsys.readouterr().err


def test_options_reach_the_compensator(run):
    q = regular(UR, 1)
    q[0, 4] = 0.0
    text = trajectory(q)
    tolerant = ('--largest-orientation-error', 0.005, '--orientation-weight', 1e-3)
    assert run(text, suffix='.yaml')[0] == Status.NOT_ACCEPTED
    assert run(text, '--largest-turn', 1e-5, *tolerant, suffix='.yaml')[0] == Status.NOT_ACCEPTED
    status, said, err = run(text, '--tool', 0.1, 0.2, 0.3, *tolerant, suffix='.yaml')
    assert (status, err) == (0, '')
    assert '1 corrected in part' in said


def test_an_existing_file_is_kept_unless_forced(run, tmp_path):
    out = tmp_path / 'out.csv'
    out.write_text('precious')
    status, said, err = run(TABLE)
    assert (status, said) == (1, '')
    assert 'out.csv exists already: choose another name or --force' in err
    assert out.read_text() == 'precious'
    assert run(TABLE, '--force')[0] == 0
    assert out.read_text().startswith('label,q6')


def test_a_program_is_not_compensated_in_place(run, tmp_path):
    status, _, err = run(TABLE, '--force', out='program')
    assert status == 1
    assert 'compensating it twice is wrong' in err
    assert (tmp_path / 'program.csv').read_text() == TABLE


ZEROS = np.zeros((2, 6))
WRONG = [
    ('.txt', 'x', 'must be a table'),
    ('.csv', 'q1,q2,q3,q4,q5,q6\n', 'has no rows'),
    ('.csv', 'q1,q2,q3,q4,q5\n1,2,3,4,5\n', 'has no column q6'),
    ('.csv', 'q1,q2,q3,q4,q5,q6,q7\n1,0,0,1,0,1,0\n', 'q7, but the arm has 6 joints only'),
    ('.csv', 'q1,q1,q2,q3,q4,q5,q6\n1,1,2,3,4,5,6\n', 'several columns q1'),
    ('.csv', 'J1,J2,J3,J4,J5,J6\n1,2,3,4,5,6\n', 'J6: name them in the first line; .*q3 = J3'),
    ('.csv', 'q1,q2,q3,q4,q5,q6 [mm]\n1,2,3,4,5,6\n', 'q6 .mm. must be in rad or deg'),
    ('.csv', 'q1 [deg],q2,q3,q4,q5,q6\n1,2,3,4,5,6\n', r'q1 .deg. has: name it in all'),
    ('.csv', 'q1,q2,q3,q4,q5,q6,q6 [deg]\n1,2,3,4,5,6,6\n', 'columns q6, q6 .deg.: keep one'),
    ('.csv', '# picks\nq1,q2,q3,q4,q5,q6\n1,2,3,4,5,6\n', 'header; remove other lines above'),
    ('.csv', 'q1,q2,q3,q4,q5,q6\n1,2,3,4,5\n', 'line 2: q6 must be a finite number, not empty'),
    ('.csv', 'q1,q2,q3,q4,q5,q6\n1,2,3,4,5,x\n', "line 2: q6 must be a finite number, not 'x'"),
    ('.csv', 'q1,q2,q3,q4,q5,q6\n1,2,3,4,5,nan\n', 'q6 must be a finite number'),
    ('.yaml', '[', 'is not valid YAML'),
    ('.yaml', 2 * trajectory(ZEROS), 'must hold one YAML document, not 2'),
    ('.yaml', 'a: 1', 'must be a trajectory_msgs/JointTrajectory'),
    ('.yaml', "joint_names: [a]\npoints: ['...']", 'point 1 .*--full-length'),
    ('.yaml', 'joint_names: [a]\npoints: [{positions: []}]', 'has no positions'),
    ('.yaml', trajectory(np.zeros((2, 5))), 'positions must be a list of 6 numbers'),
    ('.yaml', trajectory(ZEROS, 'abcdef'), 'unknown joint in the program'),
    ('.yaml', trajectory(np.zeros((2, 7)), [*UR.joint_names, 'elbow_joint']), 'comes twice'),
    ('.yaml', trajectory(ZEROS, velocities=[True] * 6), 'finite number, not True'),
    (
        '.yaml',
        trajectory(ZEROS).replace('velocities: []', 'velocities: [0,0,0,0,0,0]', 1),
        'point 2: velocities must be a list of 6 numbers',
    ),
    ('.yaml', trajectory(ZEROS, accelerations=[0.0] * 6), 'needs velocities as well'),
]


@pytest.mark.parametrize(('suffix', 'text', 'complaint'), WRONG)
def test_files_that_are_no_programs_are_refused(run, tmp_path, suffix, text, complaint):
    status, said, err = run(text, suffix=suffix)
    assert (status, said) == (1, '')
    assert err.startswith('calib_ros: ')
    assert re.search(complaint, err)
    assert not (tmp_path / f'out{suffix}').exists()


def test_of_two_columns_of_a_joint_none_is_preferred(tmp_path):
    """Silently those of q1 ... were corrected."""
    path, arm = tmp_path / 'program.csv', Chain('arm', 'standard', (Joint('a'), Joint('b')))
    path.write_text('q1,q2,a,b\n1,2,3,4\n')
    with pytest.raises(InputError, match=r'joint values in q1 \.\.\. and in a \.\.\.: leave out'):
        read_joints(path, arm)
    path.write_text('q1,x,y\n1,2,3\n')  # measured
    assert read_joints(path, Chain('x', 'standard', (Joint('x', 'prismatic'),))) == 1


def test_a_program_that_goes_back_in_time_is_refused(tmp_path):
    path, arm = tmp_path / 'program.csv', Chain('arm', 'standard', (Joint('a'),))
    path.write_text('q1;time_from_start [s]\n1;0,5\n1;0,5\n2;10\n')
    read_program(path, arm)
    path.write_text(path.read_text().replace(';10', ';0,4'))
    with pytest.raises(InputError, match=r'line 4: time_from_start falls from 0.5 to 0.4: put'):
        read_program(path, arm)
    path = tmp_path / 'program.yaml'
    path.write_text(trajectory(np.zeros((3, 1)), 'a').replace('sec: 1', 'sec: 3'))
    with pytest.raises(InputError, match='point 3: time_from_start falls from 3 to 2: put'):
        read_program(path, arm)
