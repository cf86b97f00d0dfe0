# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import os
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings, strategies as st
from urdfs import ur10e

from calib_ros.errors import ConfigError, UnknownNameError
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Frame, Joint
from calib_ros.kinematics.chain_file import (
    calibration_record,
    dump_chain,
    load_chain,
    parse_chain,
    shipped_robots,
    table_hash,
)

GOLDEN = yaml.safe_load(Path(__file__).with_name('golden_fk.yaml').read_text())
HALF = np.pi / 2
UR = """
name: some_ur
convention: standard
joints:
- {name: joint_1, type: revolute, a: 0.0, alpha: 1.5707963268, d: 0.1273, theta: 0.0, sign: 1}
- {name: joint_2, type: revolute, a: -0.612, alpha: 0.0, d: 0.0, theta: 0.0, sign: 1}
- {name: joint_3, type: revolute, a: -0.5723, alpha: 0.0, d: 0.0, theta: 0.0, sign: 1}
- {name: joint_4, type: revolute, a: 0.0, alpha: 1.5707963268, d: 0.163941, theta: 0.0, sign: 1}
- {name: joint_5, type: revolute, a: 0.0, alpha: -1.5707963268, d: 0.1157, theta: 0.0, sign: 1}
- {name: joint_6, type: revolute, a: 0.0, alpha: 0.0, d: 0.0922, theta: 0.0, sign: 1}
parallel: [joint_2, joint_3]
"""
GANTRY = """
convention: modified
joints:
- name: rail
  type: prismatic
  a: 1e-3
  alpha: 0
  d: 0.5
  theta: .1
  lower: -2
  upper: 3
- name: turn
  a: 2E-1
  alpha: 1.57
  d: -1e-1
  theta: 0
  beta: 1e-2
  sign: -1
base: {xyz: [1, 2, 3e0], quat_xyzw: [0.0, 0.6, 0.0, 0.8], fixed: true}
tool: {xyz: [0.1, 0, 0]}
"""


def assert_same(chain, expected, tolerance=1e-12):
    assert chain.name == expected.name
    assert chain.convention == expected.convention
    assert chain.joints == expected.joints
    assert chain.parallel == expected.parallel
    assert chain.parameter_names == expected.parameter_names
    for key in ('base', 'tool'):
        found, frame = getattr(chain, key), getattr(expected, key)
        assert (found is None) == (frame is None)
        if frame is not None:
            assert found.fixed is frame.fixed
            np.testing.assert_array_equal(found.matrix[:3, 3], frame.matrix[:3, 3])
            np.testing.assert_allclose(found.matrix, frame.matrix, atol=tolerance)


numbers = st.floats(-10.0, 10.0) | st.sampled_from([0.0, 1e-3, 1e-5, 1e-300, HALF, -0.0])


# Names that YAML would read as something else when they are not quoted.
names = st.sampled_from(
    ['yes', 'null', '1', '1e3', '~', 'a: b', 'joint 2', '#3', "it's", '"q"', '[x]', 'Gelenk_ä']
) | st.from_regex(r'[a-z][a-z0-9_]{0,12}', fullmatch=True).filter(
    lambda name: name not in ('base', 'tool')
)


@st.composite
def joints(draw, name):
    limits = draw(st.none() | st.tuples(st.floats(-7.0, -0.1), st.floats(0.1, 7.0)))
    return Joint(
        name,
        draw(st.sampled_from(['revolute', 'prismatic'])),
        *(draw(numbers) for _ in range(5)),
        sign=draw(st.sampled_from([1, -1])),
        lower=limits and limits[0],
        upper=limits and limits[1],
    )


@st.composite
def frames(draw):
    quat = np.array(draw(st.tuples(*[st.floats(-1.0, 1.0)] * 4)))
    if np.linalg.norm(quat) < 1e-3:
        quat = np.array([0.0, 0.0, 1.0, 0.0])
    rotation = se3.from_quat(quat / np.linalg.norm(quat))
    position = np.array(draw(st.tuples(numbers, numbers, numbers)))
    return Frame(se3.transform(rotation, position), draw(st.booleans()))


@st.composite
def chains(draw):
    row = [draw(joints(name)) for name in draw(st.lists(names, min_size=1, max_size=8, unique=1))]
    parallel = st.none() | st.lists(st.sampled_from([j.name for j in row]), unique=True)
    chosen = draw(parallel)
    return Chain(
        draw(names),
        draw(st.sampled_from(['standard', 'modified'])),
        tuple(row),
        None if chosen is None else tuple(chosen),
        draw(st.none() | frames()),
        draw(st.none() | frames()),
    )


@settings(max_examples=12)
@given(chains(), st.integers(0, 1000))
def test_a_dumped_chain_is_read_as_it_was(chain, seed):
    again = parse_chain(dump_chain(chain, {'created': 'today', 'pairs': 3}))
    assert_same(again, chain)
    q = np.random.default_rng(seed).uniform(-3.0, 3.0, (4, len(chain.joints)))
    np.testing.assert_allclose(again.forward(q), chain.forward(q), rtol=1e-12, atol=1e-11)


def test_defaults_and_numbers_without_a_dot():
    chain = parse_chain(GANTRY)
    rail, turn = chain.joints
    assert rail == Joint('rail', 'prismatic', 1e-3, 0.0, 0.5, 0.1, lower=-2.0, upper=3.0)
    assert turn == Joint('turn', 'revolute', 0.2, 1.57, -0.1, 0.0, 0.01, -1)
    np.testing.assert_allclose(chain.base.matrix[:3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(
        chain.base.matrix[:3, :3], [[0.28, 0, 0.96], [0, 1, 0], [-0.96, 0, 0.28]], atol=1e-12
    )
    assert chain.base.fixed
    assert not chain.tool.fixed


BASE = UR + 'base: {xyz: [0, 0, 0], quat_xyzw: [0, 0, 0, 1]}\nframes: {tool_1: null}\n'
MANY = [f'\n- {{name: j{k}, a: 0, alpha: 0, d: 0, theta: 0}}' for k in range(45)]
WRONG = [
    ('alpha:', 'alpha: 0.0, alpha:', 'key "alpha" appears twice'),
    ('theta: 0.0', 'theat: 0.0', 'joint 1: unknown key "theat": did you mean "theta"'),
    ('convention:', 'konvention:', '"konvention": did you mean "convention"'),
    ('quat_xyzw:', 'quat:', 'base: unknown key "quat": did you mean "quat_xyzw"'),
    ('convention: standard', 'convention: standart', '"standart": did you mean "standard"'),
    ('type: revolute', 'type: revolut', '"joint_1": unknown type "revolut": did you'),
    ('a: 0.0', 'a: .nan', 'joint 1: a must be a finite number, not nan'),
    ('d: 0.1273', 'd: twelve', "joint 1: d must be a finite number, not 'twelve'"),
    ('d: 0.1273', 'd: pi/2', "joint 1: d must be .*, not 'pi/2': write it out, such as 1.5708"),
    ('d: 0.1273', 'd: 0,075', 'joint 1: a number has no key: write 0.5, not 0,5'),  # "key 61"
    ('d: 0.1273', 'd: 0,089', 'joint 1: a number has no key: write 0.5, not 0,5'),
    ('name: joint_1', '1: joint_1', 'joint 1: unknown key "1"'),
    ('joints:\n', 'joints:\n\t', 'not valid YAML: .*: indent with blanks, not tabs'),
    ('d: 0.1273', "d: 'nan'", "joint 1: d must be a finite number, not 'nan'$"),
    ('d: 0.1273', 'd: [1]', 'joint 1: d must be a finite number'),
    ('d: 0.1273', 'd: yes', 'joint 1: d must be a finite number, not True'),
    ('d: 0.1273, ', '', 'joint 1: key "d" is missing'),
    ('d: 0.1273', 'd: ', 'joint 1: key "d" is missing'),
    ('name: joint_1', 'name: null', 'joint 1: key "name" is missing'),
    ('convention: standard', '', 'key "convention" is missing: standard or modified'),
    ('convention: standard', 'Units: mm', 'lengths are in metres, angles in radians'),
    ('joints:', 'calibration:', 'key "joints" is missing'),
    ('theta: 0.0', 'theta: 90', 'joint 1: theta must be in radians, not 90: write .* as 1.570796'),
    ('sign: 1', 'sign: 2', 'joint 1: sign must be 1 or -1, not 2'),
    ('sign: 1', 'lower: 2, upper: 1', 'limits of joint "joint_1"'),
    ('name: joint_2', 'name: joint_1', 'two joints named "joint_1"'),
    ('name: joint_2', 'name: base', 'must not be named "base"'),
    ('name: joint_2', 'name: a.b', 'name without dots, not "a.b"'),
    ('[joint_2, joint_3]', '[joint_2, joint3]', '"joint3": did you mean "joint_3"'),
    ('[joint_2, joint_3]', 'joint_2', '"parallel" must be a list of joint names'),
    ('xyz: [0, 0, 0]', 'xyz: [0, 0]', 'base.xyz must be a list of 3 numbers'),
    ('xyz: [0, 0, 0]', 'xyz: [0, 0, .nan]', 'base.xyz must be a finite number, not nan'),
    ('[0, 0, 0, 1]', '[0, 0, 0, 1.01]', r'base.quat_xyzw must have length 1 .* not 1.01'),
    ('[0, 0, 0, 1]', '[0, 0, 0, 0]', 'base.quat_xyzw must have length 1'),
    ('xyz: [0, 0, 0]', 'fixed: 1', 'base.fixed must be true or false, not 1'),
    *(
        ('{tool_1: null}', f'{{{name}: null}}', f'base_... or tool_... without dots, not "{name}"')
        for name in ('base', 'camera', 'tool_a.b')
    ),
    ('name: joint_2', 'name: tool_1', 'must not be named "tool_1"'),
    ('name: some_ur', 'name: [', 'not valid YAML'),
    ('convention: standard', 'convention: [standard]', 'cell'),
    ('convention: standard', 'convention: 1', 'cell'),
    ('convention: standard', 'convention:', 'cell'),
    ('type: revolute', 'type: ~', 'cell'),
    ('type: revolute', 'type: 1', 'cell'),
    ('d: 0.1273', f'd: 1{"0" * 400}', 'cell'),
    ('d: 0.1273', 'd: 2020-13-45', 'cell'),
    *(
        ('theta: 0.0', f'theta: {each}', 'theta must be')
        for each in ('0x' + 'f' * 10**5, '9' * 10**5, '1' + ':59' * 30_000, '1e160', '-1e7')
    ),
    *(
        (f'name: {old}', f'name: {new}', 'must be printable')
        for new in ('"ur\\n10"', '"a\\u2028b"', 'x' * 300)
        for old in ('some_ur', 'joint_1')
    ),
    ('joints:', f'joints:{"".join(MANY)}', '51 joints are more than 50'),
]


@pytest.mark.parametrize(('right', 'wrong', 'complaint'), WRONG, ids=range(len(WRONG)))
def test_a_wrong_chain_file_is_refused_with_the_place(right, wrong, complaint):
    assert right in BASE
    parse_chain(BASE)
    with pytest.raises(ConfigError, match=complaint) as caught:
        parse_chain(BASE.replace(right, wrong, 1), 'cell.yaml')
    assert 'cell.yaml' in str(caught.value)


def test_as_many_joints_as_may_be_are_read():
    assert len(parse_chain(BASE.replace('joints:', f'joints:{"".join(MANY[1:])}')).joints) == 50


OF_3, OF_NONE = (f'convention: standard\njoints: {rows}\n' for rows in ('3', '[]'))


@pytest.mark.parametrize('text', ['', '3', '[]', 'joints', OF_3, OF_NONE])
def test_a_file_that_holds_no_chain_is_refused(text):
    with pytest.raises(ConfigError, match=r'cell\.yaml'):
        parse_chain(text, 'cell.yaml')


def test_a_quaternion_that_was_rounded_is_taken_and_normalised():
    chain = parse_chain(BASE.replace('[0, 0, 0, 1]', '[0.7071, 0, 0, 0.7071]'))
    np.testing.assert_allclose(
        chain.base.matrix[:3, :3] @ chain.base.matrix[:3, :3].T, np.eye(3), atol=1e-14
    )


@pytest.mark.parametrize('robot', sorted(GOLDEN))
def test_a_shipped_robot_stands_where_another_source_says(robot):
    golden, chain = GOLDEN[robot], load_chain(robot)

    def matrix(frame):
        return se3.transform(se3.from_quat(np.array(frame['quat_xyzw'])), np.array(frame['xyz']))

    poses = chain.forward(np.array([pose['q'] for pose in golden['poses']]))
    poses = matrix(golden['base']) @ poses @ matrix(golden['tool'])
    expected = np.array([matrix(pose) for pose in golden['poses']])
    distance = np.linalg.norm(poses[:, :3, 3] - expected[:, :3, 3], axis=1)
    turn = np.linalg.norm(poses[:, :3, :3] - expected[:, :3, :3], axis=(1, 2))
    assert distance.max() <= golden['tolerance']
    assert turn.max() <= 1e-8


def test_every_shipped_robot_is_read(tmp_path, monkeypatch):
    robots = shipped_robots()
    monkeypatch.chdir(tmp_path)  # no prefix is the folder one happens to be in
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'{os.pathsep}{tmp_path / "none"}')
    there = tmp_path / 'share/calib_ros/config/robots'
    there.mkdir(parents=True)
    (there / 'ur10e.yaml').write_text(UR)
    assert shipped_robots() == robots
    assert robots.keys() >= GOLDEN.keys()
    for name in robots:
        chain = load_chain(name)
        assert chain.name == name
        assert all(joint.lower < joint.upper for joint in chain.joints)
        assert_same(parse_chain(dump_chain(chain)), chain)
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    assert shipped_robots().keys() == {'ur10e'}  # those of a workspace come first


def test_an_unknown_robot_lists_those_there_are():
    said = r'"ur5": valid: .*; another arm needs .* \(calib_ros chain ur10e prints'
    with pytest.raises(UnknownNameError, match=said) as caught:
        load_chain('ur5')  # no ur5e
    assert set(caught.value.alternatives) == set(shipped_robots())
    assert all(robot in str(caught.value) for robot in GOLDEN)


def test_a_chain_file_is_read_by_its_path(tmp_path):
    for name in ('cell.yaml', 'cell.yaml.orig', 'cell.json', 'ur10e'):  # before a robot's name
        path = tmp_path / name
        path.write_text(UR)
        assert load_chain(path).name == 'some_ur'
        assert load_chain(str(path)).name == 'some_ur'


@pytest.mark.parametrize('content', [None, b'\xff\xfe\x00'])
def test_a_file_that_cannot_be_read_is_named(tmp_path, content):
    path = tmp_path / 'cell.yaml'
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=r'cell\.yaml'):
        load_chain(path)


def test_a_robot_is_no_path_and_a_path_no_robot(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match='ur10e'):
        load_chain(tmp_path / 'ur10e')
    (tmp_path / 'ur10e').mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_chain('ur10e').name == load_chain('UR10e').name == 'ur10e'


def test_the_hash_of_a_table_stays_what_older_files_hold():
    """Else calibrations of before would count as edited, and exports match no report."""
    joints = (Joint('one', a=0.1, d=0.3, alpha=-0.5), Joint('two', a=0.4, theta=0.2, sign=-1))
    chain = Chain('arm', 'standard', joints)
    chain = chain.with_effect_values({'two.sin_2': 1e-4, 'one.ratio': -2e-4})
    assert table_hash(chain).startswith('a94e4899f2eac75b')


@pytest.mark.parametrize(
    ('name', 'text'),
    [
        ('cell.yaml', BASE.replace('sign: 1', 'lower: -360', 1)),
        ('cell.urdf', ur10e().replace('lower="-6.283185307179586"', 'lower="-360"', 1)),
    ],
)
def test_limits_in_degrees_are_refused(tmp_path, name, text):
    """A program in degrees was between them, and corrected as if in radians."""
    (tmp_path / name).write_text(text)
    with pytest.raises(
        ConfigError, match=r'joint 1: lower must be in radians, not -360: .*-6.283'
    ):
        load_chain(tmp_path / name)


def test_limits_in_millimetres_are_refused(tmp_path):
    """A plan drove the rail to 2,961 m."""
    text = dump_chain(load_chain('ur10e_on_linear_axis')).replace('upper: 3.0', 'upper: 3000.0')
    (tmp_path / 'cell.yaml').write_text(text)
    with pytest.raises(
        ConfigError, match=r'joint 1: upper must be in metres, not 3000: write mm as 3, or'
    ):
        load_chain(tmp_path / 'cell.yaml')


@pytest.mark.parametrize('name', ['cell.yaml', 'cell.urdf'])
def test_lengths_in_millimetres_are_refused(tmp_path, name):
    """A plan for an arm of 1,700 m asked for six poses."""
    text = UR if name == 'cell.yaml' else ur10e()
    length = r'(?<= [ad]: )-?[\d.]+|(?<=xyz=")[^"]+'
    text = re.sub(length, lambda m: ' '.join(f'{1e3 * float(x):g}' for x in m[0].split()), text)
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError, match=r'its links are 1\d\d\d m long: .* 300 mm as 0.3'):
        load_chain(tmp_path / name)


def test_a_large_d_between_parallel_axes_is_no_length_in_millimetres(tmp_path):
    """As in controllers' own calibrations: the arm is as long as ever."""
    text = UR.replace('alpha: 0.0, d: 0.0,', 'alpha: 0.0, d: 439.0,', 1)
    text = text.replace('alpha: 0.0, d: 0.0,', 'alpha: 0.0, d: -308.0,')
    text = text.replace('d: 0.163941', 'd: -130.836059')
    (tmp_path / 'cell.yaml').write_text(text)
    assert load_chain(tmp_path / 'cell.yaml').joints[1].d == 439.0


def test_a_folder_is_no_arm(tmp_path):
    with pytest.raises(ConfigError, match=r'is a folder, no arm: .* the calibration.yaml in it'):
        load_chain(tmp_path)


@pytest.mark.parametrize(
    ('text', 'record'),
    [('calibration: {robot: r7}', {'robot': 'r7'}), ('calibration: 3', {}), ('name: arm', {})],
)
def test_the_record_of_a_chain_file_is_none_or_a_mapping(text, record):
    assert calibration_record(text) == record
