# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Vendors' files, put into what their descriptions make of them and read by a public library."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from urdfs import PANDA, UR10E, UR10E_ORIGINS, ZERO, Z, arm as serial_arm, by_kinpy, ur10e

from calib_ros.apply.simulation import Cell, faulty
from calib_ros.errors import ConfigError
from calib_ros.files import vendors
from calib_ros.files.export import ExportError, converted
from calib_ros.files.vendor_files import vendor_files
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import dump_chain, load_chain
from calib_ros.kinematics.corrected_urdf import corrected_urdf
from calib_ros.kinematics.urdf import chain_from_urdf
from calib_ros.kinematics.urdf_reader import parse_urdf

URS = ('ur5e', 'ur10', 'ur10e')
FRANKAS = ('franka_panda', 'franka_fr3')
TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])
"""From base_link of ur_description to the base of the controller, and of the table."""
NUMBERS = ('x', 'y', 'z', 'roll', 'pitch', 'yaw')


ASIDE = ((-0.6127, 0, -0.17), ZERO), ((-0.57155, 0, 0.34415), ZERO)
UR10E_ASIDE = ur10e([*UR10E_ORIGINS[:2], *ASIDE, *UR10E_ORIGINS[4:]])
"""With the elbow further along its axis, as older descriptions have it; where no table has it."""


def corrected(nominal, seed=0):
    return faulty(nominal, Cell(), np.random.default_rng(seed))


def arm(chain):
    return replace(chain, base=Frame(), tool=Frame(), frames=(), effects=())


def origins(rows):
    values = ([row[key] for key in NUMBERS] for row in rows)
    return [(each[:3], each[3:]) for each in values]


def ur_description(text):
    """Return the URDF that ur_description makes of a file, without what is drawn."""
    poses = yaml.safe_load(text)['kinematics']
    return ur10e(origins(poses[key] for key in vendors.UR.keys))


def franka_description(text, name):
    poses, links = yaml.safe_load(text), [f'link{k}' for k in range(8)]
    *moving, last = origins(poses[f'joint{k}']['kinematic'] for k in range(1, 9))
    joints, ends = [f'{name}_joint{k}' for k in range(1, 8)], [(-3.0, 3.0)] * 7
    flange = (f'{name}_joint8', 'fixed', 'link7', 'link8', *last, ZERO)
    return serial_arm(name, links, [Z] * 7, moving, joints, ends, flange)


def poses_of(text, names, q):
    """Return the poses of the flange by the description of the vendor."""
    if 'wrist_3_joint' in names[-1]:
        return by_kinpy(ur_description(text), names, q, 'base_link', 'tool0')
    name = names[0].partition('_')[0]
    return by_kinpy(franka_description(text, name), names, q, 'link0', 'link8')


def published(text, vendor):
    """Return the numbers of a file, row by row."""
    document = yaml.safe_load(text)
    if vendor is vendors.UR:
        rows = [document['kinematics'][key] for key in vendor.keys]
    else:
        rows = [document[key]['kinematic'] for key in (*vendor.keys, vendor.end)]
    assert all(tuple(row) == NUMBERS for row in rows)
    return np.array([[row[key] for key in NUMBERS] for row in rows])


@pytest.mark.parametrize('name', [*URS, *FRANKAS])
@pytest.mark.parametrize('convention', ['standard', 'modified'])
def test_the_description_of_the_vendor_makes_the_corrected_arm(name, convention, rng):
    nominal = load_chain(name)
    chain = converted(corrected(nominal), convention)
    record = {'robot_serial': '2019', 'region': {}}  # 100 kB that only we read
    (found,) = vendor_files(chain, converted(nominal, convention), record)
    assert found.error == 0.0
    assert yaml.safe_load(found.content)['calibration'] == {'robot_serial': '2019'}
    q = chain.random_joints(20, rng)
    expected = arm(chain).forward(q)
    if name in URS:
        expected = TURNED @ expected
    poses = poses_of(found.content, chain.joint_names, q)
    np.testing.assert_allclose(poses, expected, rtol=0, atol=1e-9)


def test_nominal_files_are_those_of_the_vendors():
    """The numbers that ur_description has for the UR10e, franka_description for all its arms."""
    (ours,) = vendor_files(load_chain('ur10e'), load_chain('ur10e'))
    assert ours.name == 'ur_kinematics.yaml'
    numbers = published(ours.content, vendors.UR)
    quarter = np.pi / 2
    expected = np.zeros((6, 6))
    expected[0, 2], expected[1, 3], expected[2, 0] = 0.1807, quarter, -0.6127
    expected[3, [0, 2]], expected[4, [1, 3]] = (-0.57155, 0.17415), (-0.11985, quarter)
    expected[5, [1, 3]] = 0.11655, -quarter
    np.testing.assert_allclose(numbers, expected, rtol=0, atol=1e-12)
    for name in FRANKAS:
        (ours,) = vendor_files(load_chain(name), load_chain(name))
        assert ours.name == 'franka_kinematics.yaml'
        expected = np.zeros((8, 6))
        expected[:, 3] = np.array([0, -1, 1, 1, -1, 1, 1, 0]) * quarter
        expected[[0, 3, 4, 6], [2, 0, 0, 0]] = 0.333, 0.0825, -0.0825, 0.088
        expected[[2, 4, 7], [1, 1, 2]] = -0.316, 0.384, 0.107
        np.testing.assert_allclose(
            published(ours.content, vendors.FRANKA), expected, rtol=0, atol=1e-12
        )


@pytest.mark.parametrize(
    ('text', 'ends', 'tip'),
    [
        (UR10E, ('base_link', 'tool0'), None),
        (UR10E_ASIDE, ('base_link', 'tool0'), None),
        (PANDA, ('panda_link0', 'panda_link8'), 'panda_hand'),
    ],
)
def test_frames_are_those_of_the_urdf_if_there_is_one(text, ends, tip, rng):
    nominal = replace(chain_from_urdf(text, tip_link=tip), base=None, tool=None)
    chain = corrected(nominal)
    (found,) = vendor_files(chain, nominal, urdf=text, links={'tip_link': tip})
    q = chain.random_joints(20, rng)
    expected = by_kinpy(corrected_urdf(text, chain, tip_link=tip), chain.joint_names, q, *ends)
    poses = poses_of(found.content, chain.joint_names, q)
    np.testing.assert_allclose(poses, expected, rtol=0, atol=1e-9)
    (unchanged,) = vendor_files(nominal, nominal, urdf=text, links={'tip_link': tip})
    vendor = vendors.FRANKA if text is PANDA else vendors.UR
    described = {each.name: each.origin for each in parse_urdf(text).joints}
    numbers = published(unchanged.content, vendor)
    for name, row in zip(nominal.joint_names, numbers, strict=False):
        np.testing.assert_allclose(row[:3], described[name][:3, 3], rtol=0, atol=1e-9)


def test_arms_that_are_laid_out_otherwise_get_no_file():
    """A tool in the table of a Franka is no flange."""
    nominal = replace(chain_from_urdf(PANDA, tip_link='panda_hand'), base=None, tool=None)
    longer = nominal.with_offsets({'panda_joint7.d': 0.1034})
    assert vendor_files(longer, longer) == ()
    bent = load_chain('ur10e').with_offsets({'elbow_joint.alpha': np.pi / 2})
    for other in (bent, *map(load_chain, ('kuka_iiwa14', 'puma560', 'meca500'))):
        assert vendor_files(other, other) == ()


BRACE = """<link name="brace"/>
  <joint name="brace" type="fixed"><parent link="panda_link2"/><child link="brace"/></joint>
  """


@pytest.mark.parametrize(
    ('given', 'other'),
    [
        ('<axis xyz="0.0 0.0 1.0"', '<axis xyz="0.0 0.0 -1.0"'),
        ('panda_joint8', 'panda_end'),
        ('<parent link="panda_link2"', '<parent link="brace"'),
    ],
)
def test_urdfs_that_are_laid_out_otherwise_get_no_file(given, other):
    text = PANDA.replace(given, other).replace('<joint', f'{BRACE}<joint', 'brace' in other)
    arm = replace(chain_from_urdf(text, tip_link='panda_link8'), base=None, tool=None)
    assert vendor_files(arm, arm, urdf=text, links={'tip_link': 'panda_link8'}) == ()


def test_what_the_file_cannot_hold_is_said():
    nominal = load_chain('ur10e')
    chain = corrected(nominal).with_offsets({'wrist_3_joint.a': 1e-3})
    (found,) = vendor_files(chain, nominal)
    assert found.error == pytest.approx(abs(chain.joints[-1].a - nominal.joints[-1].a), rel=0.5)
    gear = replace(corrected(nominal), effects=(('elbow_joint.ratio', 1e-3),))
    assert vendor_files(gear, nominal)[0].error > 1e-4


def test_the_hash_is_that_of_the_robot_or_of_the_numbers():
    nominal = load_chain('ur10e')

    def checksum(chain, given=''):
        (found,) = vendor_files(chain, nominal, checksum=given)
        return yaml.safe_load(found.content)['kinematics']['hash']

    assert checksum(nominal, 'calib_12788084448423163542') == 'calib_12788084448423163542'
    assert checksum(nominal) == checksum(nominal)
    assert checksum(nominal).removeprefix('calib_').isdigit()
    assert checksum(nominal) != checksum(nominal.with_offsets({'elbow_joint.a': 1e-6}))
    with pytest.raises(ConfigError, match='not a Universal Robots checksum'):
        checksum(nominal, '12788084448423163542')


def test_a_file_that_differs_is_refused(monkeypatch):
    nominal = load_chain('ur10e')
    monkeypatch.setattr(
        'calib_ros.files.export.xyz_rpy', lambda matrix: dict.fromkeys(NUMBERS, 0.0)
    )
    with pytest.raises(ExportError, match=r'ur_kinematics\.yaml, read back, differs'):
        vendor_files(nominal, nominal)


@pytest.mark.parametrize('chain', ['ur10e', 'robot.urdf'])
def test_the_command_line_writes_it(run, tmp_path, chain):
    (tmp_path / 'robot.urdf').write_text(UR10E)
    calibrated = dump_chain(corrected(load_chain(chain)), {'samples': 60})
    (tmp_path / 'calibration.yaml').write_text(calibrated)
    given = ('calibration.yaml', '--chain', chain, '--out', 'out', '--ur-hash', 'calib_42')
    assert run('export', *given)[0] == 0
    document = yaml.safe_load((tmp_path / 'out/ur_kinematics.yaml').read_text())
    assert document['kinematics']['hash'] == 'calib_42'
    assert document['calibration'] == {'samples': 60}


def test_the_command_line_refuses_a_checksum_for_another_arm(run, tmp_path):
    (tmp_path / 'calibration.yaml').write_text(dump_chain(load_chain('puma560'), {'source': 'x'}))
    given = ('calibration.yaml', '--chain', 'puma560', '--out', 'out', '--ur-hash', 'calib_42')
    status, _, err = run('export', *given)
    assert (status, '--ur-hash does not apply to puma560' in err) == (1, True)
    assert not (tmp_path / 'out').exists()
