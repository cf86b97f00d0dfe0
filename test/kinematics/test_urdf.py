# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from urdfs import (
    CONVENTIONS,
    EXACT,
    IIWA,
    PANDA,
    PI,
    SCARA,
    SEEDS,
    UR10E,
    ZERO,
    Z,
    numbers,
    poses_of,
    random_arm,
    reference_forward,
    some_joints,
    written,
)

from calib_ros.cli.main import main
from calib_ros.errors import ConfigError, UnknownNameError
from calib_ros.estimation.identifiability import structurally_independent
from calib_ros.kinematics import effects
from calib_ros.kinematics.axes import with_common_normals
from calib_ros.kinematics.chain import PARALLEL_TOLERANCE, Chain, Joint
from calib_ros.kinematics.chain_file import load_chain, parse_chain
from calib_ros.kinematics.corrected_urdf import corrected_urdf
from calib_ros.kinematics.urdf import chain_from_urdf


@pytest.mark.parametrize('convention', CONVENTIONS)
@settings(max_examples=12)
@given(seed=SEEDS)
def test_any_serial_arm_moves_as_its_urdf(convention, seed):
    rng = np.random.default_rng(seed)
    text = random_arm(rng)
    chain = chain_from_urdf(text, convention=convention)
    q = some_joints(chain, rng)
    np.testing.assert_allclose(chain.forward(q), poses_of(text, chain, q), rtol=0.0, atol=EXACT)
    assert chain.convention == convention
    elements = [
        joint
        for joint in ET.fromstring(text)
        if joint.tag == 'joint' and joint.get('type') != 'fixed'
    ]
    assert chain.joint_names == tuple(joint.get('name') for joint in elements)
    for joint, element in zip(chain.joints, elements, strict=True):
        kind = element.get('type')
        assert joint.type == ('prismatic' if kind == 'prismatic' else 'revolute')
        limit = (None, None) if kind == 'continuous' else (-3.0, 2.5)
        assert (joint.lower, joint.upper) == limit
    for none in ('-1e16', '-999999', '-99999'):
        endless = chain_from_urdf(text.replace('lower="-3.0"', f'lower="{none}"'))
        assert {joint.lower for joint in endless.joints} == {None}


@pytest.mark.parametrize('convention', CONVENTIONS)
@pytest.mark.parametrize('text', [UR10E, PANDA, IIWA, SCARA], ids=['ur', 'panda', 'iiwa', 'scara'])
def test_tables_of_known_robots_are_complete(text, convention):
    tip = 'panda_hand' if text is PANDA else None
    chain = chain_from_urdf(text, tip_link=tip, convention=convention)
    revolute = sum(joint.type == 'revolute' for joint in chain.joints)
    free = replace(chain, base=None, tool=None)
    complete = 4 * revolute + 2 * (len(chain.joints) - revolute) + 6
    assert len(structurally_independent(free, free.parameter_names)) == complete


def test_ur10e_has_the_table_of_its_maker():
    chain, shipped = chain_from_urdf(UR10E), load_chain('ur10e')
    # the URDF has pi / 2 to nine digits, and lengths of 2e-11 that make up for them
    np.testing.assert_allclose(chain.table, shipped.table, rtol=0.0, atol=1e-9)
    assert chain.parallel == shipped.parallel
    assert [(j.name, j.lower, j.upper) for j in chain.joints] == [
        (j.name, pytest.approx(j.lower), pytest.approx(j.upper)) for j in shipped.joints
    ]
    np.testing.assert_allclose(chain.base.matrix, np.diag([-1, -1, 1, 1]), atol=1e-15)
    np.testing.assert_allclose(chain.tool.matrix, np.eye(4), atol=1e-9)
    assert chain.gravity == Chain.gravity


def test_panda_has_the_table_of_its_maker():
    chain = chain_from_urdf(PANDA, tip_link='panda_link8', convention='modified')
    assert chain.joints == load_chain('franka_panda').joints
    np.testing.assert_array_equal(chain.base.matrix, np.eye(4))
    np.testing.assert_allclose(chain.tool.matrix, np.eye(4), atol=1e-15)


@given(angle=st.floats(0.0, 0.2), heading=st.floats(-PI, PI), half=st.booleans(), seed=SEEDS)
def test_lengths_stay_small_at_every_angle_between_axes(angle, heading, half, seed):
    rng = np.random.default_rng(seed)
    way = [np.sin(angle) * np.cos(heading), np.sin(angle) * np.sin(heading), np.cos(angle)]
    text = written(
        'two',
        ('j1', 'revolute', 'l0', 'l1', rng.uniform(-1, 1, 3), ZERO, Z),
        ('j2', 'revolute', 'l1', 'l2', rng.uniform(-1, 1, 3), (PI * half, 0, 0), way),
    )
    chain = chain_from_urdf(text)
    assert bool(chain.parallel) or angle > PARALLEL_TOLERANCE
    assert bool(chain.parallel) == (chain.joints[0].d == 0.0)
    largest = 4.0 if chain.parallel else 4.0 / np.sin(angle)
    assert np.abs(chain.table[:, [0, 2]]).max() < largest


@pytest.mark.parametrize(
    ('b', 'beta', 'left'), [(0.1, 0.2, 0.0), (0.1, 0.0, 0.0), (0.3, 1e-3, 1e-3)]
)
@pytest.mark.parametrize('convention', CONVENTIONS)
def test_common_normals_take_in_b_and_beta(convention, b, beta, left):
    rows = (Joint('j1'), Joint('j2', b=b, beta=beta), Joint('j3', alpha=1.1, d=0.1))
    chain = Chain('arm', convention, rows)
    found = with_common_normals(chain)
    q = chain.random_joints(20, np.random.default_rng(0))
    assert found.forward(q) == pytest.approx(chain.forward(q), abs=1e-12)
    assert max(abs(joint.b) for joint in found.joints) == 0.0
    assert max(abs(joint.beta) for joint in found.joints) <= left
    plain = load_chain('kuka_youbot')  # with d between parallel axes
    assert with_common_normals(plain).joints == plain.joints


@pytest.mark.parametrize('convention', CONVENTIONS)
def test_masses_pull_at_the_joints_as_in_the_urdf(convention, rng):
    """The torque of gravity is the slope of the potential energy of all links."""
    text = re.sub(
        '<joint name="j2" type="fixed"', '<joint name="j2" type="prismatic"', SIDE_BRANCH
    )
    chain = chain_from_urdf(text, 'l0', 'l6', convention)
    chain = chain.with_effects([f'{name}.compliance' for name in chain.joint_names])
    links = [
        link
        for link in ET.fromstring(SIDE_BRANCH).findall('link')
        if link.find('inertial') is not None
    ]
    assert len(links) == 5
    still = {'j2': 0.0}

    def energy(q):
        values = still | dict(zip(chain.joint_names, q, strict=True))
        total = 0.0
        for link in links:
            inertial = link.find('inertial')
            centre = inertial.find('origin').get('xyz').split()
            pose = reference_forward(SIDE_BRANCH, values, 'l0', link.get('name'))
            height = (pose @ [*map(float, centre), 1.0])[2]
            total += float(inertial.find('mass').get('value')) * 9.81 * height
        return total

    q = rng.uniform(-2.0, 2.0, len(chain.joints))
    names = [name for name, _ in chain.effects]
    found = effects.basis(chain, names, q[:, np.newaxis], None)[:, 0]
    for k in range(len(q)):
        step = 1e-5 * np.eye(len(q))[k]
        slope = (energy(q + step) - energy(q - step)) / 2e-5
        assert found[k] == pytest.approx(-slope, abs=1e-7)
    total = sum(float(link.find('inertial/mass').get('value')) for link in links)
    assert sum(joint.mass for joint in chain.joints) == pytest.approx(total)


def loaded(name, mass, xyz):
    return (
        f'<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="{numbers(xyz)}" '
        'rpy="1 2 3"/></inertial></link>'
    )


def with_masses(text, masses):
    for name, (mass, xyz) in masses.items():
        text = text.replace(f'<link name="{name}"/>', loaded(name, mass, xyz))
    return text


# an arm that hangs askew, with a fixed and a moving side branch
SIDE_BRANCH = with_masses(
    written(
        'branched',
        ('j0', 'fixed', 'l0', 'l1', (0.1, 0.2, 0.3), (2.0, 0.3, 0.4), ZERO),
        ('j1', 'revolute', 'l1', 'l2', (0, 0, 0.3), (0.1, 0.2, 0.3), (0, -1, 0)),
        ('j2', 'prismatic', 'l2', 'side', (0.3, 0.1, 0), (1, 0, 0), (1, 0, 0)),
        ('j3', 'fixed', 'l2', 'l3', (0, 0.4, 0.1), (0.5, 0, 0), ZERO),
        ('j4', 'continuous', 'l3', 'l4', (0.2, 0, 0), (0, 0.7, 0), (1, 2, 3)),
        ('j5', 'floating', 'l4', 'loose', (0.1, 0.1, 0.1), (0, 0, 1), ZERO),
        ('j6', 'revolute', 'l4', 'l6', (0.3, 0.1, 0.2), (1.57, 0, 0), (0, 0, -1)),
    ),
    {
        'l2': (5.0, (0.1, 0.0, 0.2)),
        'side': (1.5, (0.0, 0.1, 0.0)),
        'l4': (3.0, (0.0, 0.2, 0.1)),
        'loose': (0.25, (0.1, 0.0, 0.0)),
        'l6': (1.0, (0.03, 0.02, 0.01)),
    },
)


# ---- links, and what is refused


def test_links_by_default():
    assert chain_from_urdf(UR10E).joints == chain_from_urdf(UR10E, 'base_link', 'tool0').joints
    bare = UR10E.replace('tool0', 'wrist_camera')
    np.testing.assert_array_equal(
        chain_from_urdf(bare).tool.matrix, chain_from_urdf(bare, tip_link='flange').tool.matrix
    )
    assert chain_from_urdf(SCARA).joint_names == ('lift', 'shoulder', 'elbow', 'wrist')
    part = chain_from_urdf(UR10E, 'upper_arm_link', 'wrist_1_link')
    assert part.joint_names == ('elbow_joint', 'wrist_1_joint')


def edited(text, old, new):
    assert old in text
    return text.replace(old, new)


def test_what_ros_reads_is_read():
    """Attributes of simulators, as drake:acceleration; comments with --, and before <?xml."""
    limited = edited(UR10E, '<limit ', '<limit drake:acceleration="2.5" ')
    chain = chain_from_urdf(limited)
    named = edited(UR10E, '<robot ', '<robot xmlns="http://ros.org" ')
    assert chain.joints == chain_from_urdf(named).joints == chain_from_urdf(UR10E).joints
    assert corrected_urdf(limited, chain) == limited
    noted = edited(UR10E, '<origin ', '<origin drake:note="0" ')
    longer = chain.with_offsets({'elbow_joint.d': 1e-3})
    edits = corrected_urdf(noted, longer).replace('drake:note="0" ', '')
    assert edits == corrected_urdf(UR10E, longer)
    chain_from_urdf(edited(UR10E, '</robot>', '<![CDATA[ <!-- ]]></robot>'))  # all of it
    head = '\n<!-- Größe -- a & b --><?xml version="1.0" encoding="latin-1"?>\n'
    assert corrected_urdf(head + UR10E, longer) == head + corrected_urdf(UR10E, longer)


def elbow(kind, more=''):
    """Return the URDF of a UR10e with an elbow of another type, and with more in it."""
    joint = '<joint name="elbow_joint" type="revolute">'
    return edited(UR10E, joint, joint.replace('revolute', kind) + more)


def pair(*prefixes):
    """Return the URDF of UR10e's with prefixed names on one table."""
    arms = [re.sub('(name|link)="', rf'\1="{prefix}_', UR10E) for prefix in prefixes]
    parts = [arm.partition('>')[2].removesuffix('</robot>\n') for arm in arms]
    mounts = [
        f'<joint name="{prefix}" type="fixed"><parent link="table"/>'
        f'<child link="{prefix}_base_link"/></joint>'
        for prefix in prefixes
    ]
    return ''.join(['<robot name="pair"><link name="table"/>', *parts, *mounts, '</robot>'])


XACRO = '<xacro:x xmlns:xacro="http://www.ros.org/wiki/xacro"/></robot>'
REFUSED = {
    'no XML': ('name: ur10e', 'not valid XML'),
    'a path': ('arm.urdf', 'expected its text: load_chain reads a file'),
    'cut off': (UR10E[:-40], 'not valid XML'),
    'no robot': ('<sdf/>', 'root element <robot>, not <sdf>: convert it'),
    'empty': ('<robot/>', 'one root; roots here: none, it has no links: an SRDF, or a macro'),
    'comment': (edited(UR10E, '</robot>', '<!-- ' * 200_000 + '</robot>'), 'not valid XML'),
    'quaternion': (edited(UR10E, ' rpy="0.0', ' quat_xyzw="0 0 0 1" rpy="0.0'), 'write the rot'),
    'xacro': (edited(UR10E, '</robot>', XACRO), 'run "xacro FILE > robot.urdf" first'),
    'formula': (edited(UR10E, '-0.6127', '${a}'), '"elbow_joint" is a formula'),
    'two numbers': (edited(UR10E, '-0.6127 0.0', '0'), '3 finite numbers, not "0 0.0"'),
    'no number': (edited(UR10E, '-0.6127', 'nan'), 'xyz in the origin of joint "elbow_joint"'),
    **{
        f'axis {axis}': (edited(SCARA, '0.0 0.0 -1.0', axis), 'axis of joint "elbow" has no dir')
        for axis in ('0 0 0', '1e-320 0 0', '1e-10 0 1e-10')
    },
    **{
        head[:9]: (head + SCARA, 'DOCTYPE')
        for head in (
            '<!DOCTYPE robot [<!ENTITY o "<origin xyz=\'1 0 0\'/>">]>',
            '<?xml version="1.0"?>\n<!doctype robot>',
            '  <!DOCTYPE robot [' + '<!ELEMENT a (' * 100_000 + ']>',
        )
    },
    'line break': (edited(SCARA, '<robot name="', '<robot name="a&#10;'), 'be printable'),
    'unknown type': (elbow('hinge'), 'joint "elbow_joint": unknown type "hinge"'),
    'floating': (elbow('floating'), 'joint "elbow_joint" is floating'),
    'planar': (elbow('planar'), 'joint "elbow_joint" is planar'),
    'mimics itself': (elbow('revolute', '<mimic joint="elbow_joint"/>'), 'mimics itself'),
    'mimics nothing': (elbow('revolute', '<mimic joint="elbow"/>'), ': unknown mimicked joint'),
    'stuck': (elbow('revolute', '<limit lower="0" upper="0"/>'), 'are equal'),
    'limits': (edited(UR10E, f'lower="{-PI!r}"', 'lower="9"'), 'limits of joint "elbow'),
    'degrees': (edited(UR10E, 'rpy="1.570796327 ', 'rpy="90 '), 'lift_joint" must be in radians'),
    'mass': (edited(SIDE_BRANCH, 'value="1.5"', 'value="a"'), 'inertial of link "side" must be a'),
    'unknown child': (edited(UR10E, '<link name="tool0"/>', ''), ': unknown link "tool0"'),
    'two joints': (edited(SCARA, '"lift"', '"wrist"'), 'two joints are named "wrist"'),
    'two links': (edited(SCARA, '<link name="hand"/>', '<link name="hand"/>' * 2), 'two links'),
    'two parents': (
        edited(SCARA, '<child link="hand"/>', '<child link="lower"/>'),
        'two joints lead to link "lower" in the URDF: robots with closed loops, such as delta',
    ),
    'two roots': (edited(SCARA, '</robot>', '<link name="x"/></robot>'), 'here: base, x'),
    'loop': (
        edited(SCARA, '<parent link="column"/>', '<parent link="hand"/>'),
        'a loop among joints shoulder, elbow, wrist',
    ),
    'many ends': (
        PANDA,
        'ends in panda_leftfinger, panda_rightfinger, all behind panda_hand: name the tip_link',
    ),
    'two arms': (pair('left', 'right'), 'ends in left_tool0, right_tool0: name the tip_link'),
    'no end': (UR10E, 'moves nothing behind "flange"', {'base_link': 'flange'}),
    'still': (UR10E, 'no joint moves between', {'base_link': 'flange', 'tip_link': 'tool0'}),
    'itself': (UR10E, 'no joint moves between', {'base_link': 'tool0', 'tip_link': 'tool0'}),
    'aside': (UR10E, 'unknown link "elbow_link"', {'base_link': 'elbow_link'}),
    'behind': (
        *(PANDA, 'no joints lead from link "panda_link3" out to link "panda_link1"'),
        {'base_link': 'panda_link3', 'tip_link': 'panda_link1'},
    ),
    'convention': (UR10E, 'unknown convention "craig"', {'convention': 'craig'}),
}


@pytest.mark.parametrize('what', REFUSED)
def test_what_is_no_serial_chain_is_refused(what):
    text, words, *links = REFUSED[what]
    with pytest.raises(ConfigError) as caught:
        chain_from_urdf(text, **(links[0] if links else {}))
    assert words in str(caught.value)


def test_a_tip_of_usual_name_is_found_behind_a_prefix():
    camera = '<link name="c"/><joint name="c" type="fixed"><parent link="{}"/><child link="c"/>'
    text = pair('r1').replace('</robot>', camera.format('r1_wrist_3_link') + '</joint></robot>')
    assert chain_from_urdf(text).tool.matrix == pytest.approx(
        chain_from_urdf(UR10E).tool.matrix, abs=1e-12
    )
    flange = chain_from_urdf(text.replace('r1_tool0', 'r1_end')).tool.matrix  # the next usual one
    assert flange == pytest.approx(chain_from_urdf(UR10E, tip_link='flange').tool.matrix)


def test_a_wrong_link_names_the_right_ones():
    with pytest.raises(UnknownNameError) as caught:
        chain_from_urdf(UR10E, tip_link='tool')
    assert 'did you mean "tool0"?' in str(caught.value)
    assert 'wrist_3_link' in caught.value.alternatives


# ---- as a chain


def test_a_urdf_is_a_chain_file_whose_frames_are_unknown(tmp_path):
    path = tmp_path / 'arm.URDF'
    path.write_text(UR10E)
    chain, whole = load_chain(path), chain_from_urdf(UR10E)
    assert chain.joints == whole.joints
    assert chain.base is None
    assert chain.tool is None
    assert (chain.name, chain.gravity) == (whole.name, whole.gravity)
    path.with_suffix('.xacro').write_text(REFUSED['xacro'][0])
    with pytest.raises(ConfigError, match='run "xacro FILE'):
        load_chain(path.with_suffix('.xacro'))
    with pytest.raises(ConfigError, match='cannot read URDF'):
        load_chain(tmp_path / 'none.urdf')


def test_chain_command(tmp_path, capsys):
    path = tmp_path / 'panda.URDF'
    path.write_text(PANDA)
    links = ['--base-link', 'panda_link0', '--tip-link', 'panda_hand']
    assert main(['chain', str(path), *links, '--convention', 'modified']) == 0
    printed = capsys.readouterr().out
    whole = chain_from_urdf(PANDA, 'panda_link0', 'panda_hand', 'modified')
    chain = parse_chain(printed)
    assert chain.joints == whole.joints
    assert (chain.base, chain.tool) == (None, None)
    known = parse_chain(re.sub('^# (base|tool):', r'\1:', printed, flags=re.MULTILINE))
    assert known.base.fixed
    np.testing.assert_allclose(known.base.matrix, whole.base.matrix, atol=1e-15)
    np.testing.assert_allclose(known.tool.matrix, whole.tool.matrix, atol=1e-15)
    out = tmp_path / 'panda.yaml'
    assert main(['chain', 'ur10e', '--out', str(out)]) == 0
    assert load_chain(out).joints == load_chain('ur10e').joints
    assert main(['chain', 'ur10e', '--out', str(out)]) == 1
    assert 'exists already' in capsys.readouterr().err
    assert main(['chain', 'ur10e', '--tip-link', 'tool0']) == 1
    assert '--tip-link applies only to a URDF' in capsys.readouterr().err
    assert main(['chain', str(path)]) == 1
    assert 'ends in panda_leftfinger, panda_rightfinger' in capsys.readouterr().err
