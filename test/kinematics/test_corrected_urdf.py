# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A calibration written back into the URDF."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from urdfs import (
    CONVENTIONS,
    EXACT,
    IIWA,
    PANDA,
    SCARA,
    SEEDS,
    UR10E,
    UR_JOINTS,
    by_kinpy,
    ends,
    poses_of,
    random_arm,
    random_offsets,
    some_joints,
)

from calib_ros import Problem, chain_from_urdf, corrected_urdf, identify, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.errors import ConfigError


def stripped(text):
    """Return a URDF without the numbers in the origins of its joints."""
    return re.sub(r'(xyz|rpy)="[^"]*"', '', re.sub(r'\s*<origin[^>]*>', '', text))


@pytest.mark.parametrize('convention', CONVENTIONS)
@settings(max_examples=6)
@given(seed=SEEDS)
def test_a_corrected_urdf_moves_as_the_corrected_arm(convention, seed):
    rng = np.random.default_rng(seed)
    text = random_arm(rng)
    nominal = chain_from_urdf(text, convention=convention)
    assert corrected_urdf(text, nominal) == text
    chain = nominal.with_offsets(random_offsets(nominal, rng))
    corrected = corrected_urdf(text, chain)
    q = some_joints(nominal, rng)
    expected = chain.forward(q)
    assert np.abs(expected - nominal.forward(q)).max() > 1e-5
    np.testing.assert_allclose(poses_of(corrected, nominal, q), expected, rtol=0.0, atol=EXACT)
    assert stripped(corrected) == stripped(text)


@pytest.mark.parametrize('text', [UR10E, PANDA, IIWA, SCARA], ids=['ur', 'panda', 'iiwa', 'scara'])
def test_a_public_library_reads_it_back(text, rng):
    tip = 'panda_hand' if text is PANDA else None
    nominal = chain_from_urdf(text, tip_link=tip)
    chain = nominal.with_offsets(random_offsets(nominal, rng))
    corrected = corrected_urdf(text, chain, tip_link=tip)
    q = chain.random_joints(10, rng)
    base, end = ends(text)
    found = by_kinpy(corrected, chain.joint_names, q, base, tip or end)
    np.testing.assert_allclose(found, chain.forward(q), rtol=0.0, atol=EXACT)


HAND_WRITTEN = """<?xml version='1.0' encoding='utf-8'?>\r
<!-- <joint name="j1"><origin xyz="9 9 9"/></joint> -->
<robot name='hand' xmlns:xacro="http://www.ros.org/wiki/xacro">
  <link name="a"><visual><origin xyz="1 1 1"/></visual></link><link name="b"/>
\t<link name="c"/><link name="d"/>
  <joint type="continuous"
         name="j1">
    <!-- Größe: <origin xyz="8 8 8"/> -->
    <parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
  </joint>
  <joint name="j2" type='revolute'><origin
      rpy='0 0 0'   xyz =
      '0.10 0 0.20' ></origin>
    <limit lower="-1" upper="1"/> <parent link="b"/>  <child link="c"/><axis xyz='0 0 1'/></joint>
  <joint name="tip" type="fixed"><parent link="c"/><child link="d"/><origin rpy="0 1.5 0"/></joint>
  <transmission name="t"><joint name="j1"><origin xyz="7 7 7"/></joint></transmission>
  <gazebo><origin xyz="6 6 6"/></gazebo>
</robot>\r
"""


def test_everything_else_stays_byte_for_byte(rng):
    nominal = chain_from_urdf(HAND_WRITTEN)
    j2_only = corrected_urdf(HAND_WRITTEN, nominal.with_offsets({'j2.theta': 0.125}))
    assert j2_only == HAND_WRITTEN.replace("rpy='0 0 0'", "rpy='0.0 0.0 0.125'")
    shorter = corrected_urdf(HAND_WRITTEN, nominal.with_offsets({'j1.a': 0.005}))
    assert shorter == HAND_WRITTEN.replace("'0.10 0 0.20'", "'0.105 0.0 0.2'")
    turned = corrected_urdf(HAND_WRITTEN, nominal.with_offsets({'j1.theta': 0.125}))
    new = '         name="j1">\n    <origin rpy="0.0 0.0 0.125"/>\n    <!-- Größe'
    assert turned == HAND_WRITTEN.replace('         name="j1">\n    <!-- Größe', new)
    bent = corrected_urdf(HAND_WRITTEN, nominal.with_offsets({'j2.alpha': 0.01, 'j2.a': 0.002}))
    assert bent.partition('<joint name="tip"')[0] == HAND_WRITTEN.partition('<joint name="tip"')[0]
    assert '<origin xyz="0.002 0.0 0.0" rpy="' in bent


def test_the_nominal_ends_are_kept(rng):
    """What a calibration cannot tell, joint 1 in the base and the tip in the last link, stays."""
    nominal = chain_from_urdf(UR10E)
    truth = faulty(nominal, Cell(), rng)
    observations = measure(truth, truth.random_joints(60, rng), rng)
    chain = identify(Problem(replace(nominal, base=None, tool=None), observations)).chain
    corrected = corrected_urdf(UR10E, chain)
    assert chain.table[0, 2] == nominal.table[0, 2]
    for joint in ('base_joint', 'shoulder_pan_joint', 'wrist_3-flange', 'flange-tool0'):
        assert origin_of(corrected, joint) == origin_of(UR10E, joint)
    for joint in UR_JOINTS[1:]:
        assert origin_of(corrected, joint) != origin_of(UR10E, joint)
    q = some_joints(chain, rng)
    expected = replace(chain, base=nominal.base, tool=nominal.tool).forward(q)
    np.testing.assert_allclose(poses_of(corrected, chain, q), expected, rtol=0.0, atol=EXACT)


def origin_of(text, joint):
    return ET.fromstring(text).find(f'joint[@name="{joint}"]/origin').attrib


def test_a_chain_of_another_arm_is_refused():
    nominal = chain_from_urdf(UR10E)
    with pytest.raises(ConfigError, match='not the arm of this URDF'):
        corrected_urdf(UR10E, nominal.with_offsets({'elbow_joint.a': 0.5}))
    with pytest.raises(ConfigError, match='not the arm of this URDF'):
        corrected_urdf(UR10E, nominal.with_offsets({'wrist_3_joint.theta': 1.0}))
    with pytest.raises(
        ConfigError, match=r'has the joints panda_joint1 \(revolute\), .*; the URDF'
    ):
        corrected_urdf(UR10E, load_chain('franka_panda'))


def test_effects_do_not_fit_into_a_urdf():
    chain = chain_from_urdf(UR10E)
    still = chain.with_effects(['elbow_joint.ratio'])
    assert corrected_urdf(UR10E, still) == UR10E
    with pytest.raises(ConfigError, match=r'cannot represent the effects elbow_joint\.ratio'):
        corrected_urdf(UR10E, still.with_effect_values({'elbow_joint.ratio': 1e-3}))


@pytest.mark.parametrize('kind', ['a', 'alpha', 'beta'])
def test_the_last_row_needs_a_fixed_joint_behind(kind, rng):
    chain = chain_from_urdf(UR10E, tip_link='wrist_3_link')
    chain = chain.with_offsets({f'wrist_3_joint.{kind}': 1e-3})
    with pytest.raises(ConfigError, match='no fixed joint behind'):
        corrected_urdf(UR10E, chain, tip_link='wrist_3_link')
    q = some_joints(chain, rng)
    nominal = chain_from_urdf(UR10E)
    chain = nominal.with_offsets({f'wrist_3_joint.{kind}': 1e-3})
    found = poses_of(corrected_urdf(UR10E, chain), chain, q)
    np.testing.assert_allclose(found, chain.forward(q), rtol=0.0, atol=EXACT)


@pytest.mark.parametrize('turn', [0.0, np.pi])
@pytest.mark.parametrize('sign', [1, -1])
def test_the_ends_of_a_table_may_be_turned(sign, turn, rng):
    """As those of the Fanuc, ABB and Mecademic supplied: by 3.14 rad they were another arm."""
    chain = load_chain('ur10e').with_offsets({'elbow_joint.theta': 1e-2, 'wrist_2_joint.d': 1e-3})
    *rows, fifth, last = chain.joints
    fifth = replace(fifth, alpha=fifth.alpha + np.pi * (sign < 0))
    last = replace(last, sign=sign, theta=sign * last.theta + turn, d=sign * last.d)
    table = replace(chain, joints=(*rows, fifth, last))
    q = chain.random_joints(10, rng)
    found, wanted = (chain_from_urdf(corrected_urdf(UR10E, each)) for each in (table, chain))
    np.testing.assert_allclose(found.forward(q), wanted.forward(q), rtol=0.0, atol=EXACT)
