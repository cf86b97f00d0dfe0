# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import csv
import re
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import yaml
from urdfs import UR10E

from calib_ros.apply.simulation import Cell, faulty
from calib_ros.files import export
from calib_ros.files.export import (
    FILES,
    ExportError,
    converted,
    exports,
    kinematics_yaml,
    pose_matrix,
    urdf_export,
)
from calib_ros.files.programs import joints_csv
from calib_ros.kinematics.chain import Chain, Convention, Frame, Joint
from calib_ros.kinematics.chain_file import (
    dump_chain,
    load_chain,
    parse_chain,
    shipped_robots,
    table_hash,
)
from calib_ros.kinematics.parameter import DH_KINDS
from calib_ros.kinematics.urdf import chain_from_urdf

KEYS = ('x', 'y', 'z', 'roll', 'pitch', 'yaw')
ROBOTS = sorted(shipped_robots())


def corrected(name, seed=0):
    nominal = load_chain(name)
    return nominal, faulty(nominal, Cell(), np.random.default_rng(seed))


def scara():
    rows = (
        Joint('j1', a=0.3, d=0.2),
        Joint('j2', a=0.25, alpha=np.pi, sign=-1),
        Joint('j3', 'prismatic', d=0.1, lower=0.0, upper=0.2),
        Joint('j4', d=0.05),
    )
    return Chain('scara', 'standard', rows)


@pytest.mark.parametrize('name', ROBOTS)
def test_every_form_says_how_far_it_is_from_the_calibration(name):
    nominal, chain = corrected(name)
    by_name = {each.name: each for each in exports(chain, nominal)}
    assert {*by_name} == {*FILES}  # which the command replaces
    assert by_name['dh_standard.csv'].error == by_name['kinematics.yaml'].error == 0.0
    offsets = by_name['joint_offsets.csv']
    assert 1e-4 < offsets.error < 0.02
    told = f'{1e3 * offsets.error:.3f} mm off the calibrated arm at 1,000 random poses'
    assert told in offsets.content.splitlines()[0]
    # Beta can be given up where no axes are parallel, and only there.
    assert (by_name['dh_without_beta.csv'].error < 1e-7) == (not nominal.parallel)


@pytest.mark.parametrize('convention', ['standard', 'modified'])
def test_axes_that_coincide_are_exact_in_every_form_with_b(convention):
    rows = (Joint('table', d=0.3), *load_chain('puma560').joints)
    nominal = replace(converted(Chain('turned', 'standard', rows), convention), tool=None)
    chain = faulty(nominal, Cell(), np.random.default_rng(0))
    assert max(abs(joint.b) for joint in chain.joints) > 1e-5
    by_name = {each.name: each for each in exports(chain, nominal)}
    exact = [name for name in by_name if name not in ('dh_without_beta.csv', 'joint_offsets.csv')]
    assert max(by_name[name].error for name in exact) == 0.0
    assert by_name['dh_standard.csv'].content.splitlines()[1].endswith(',beta,b')
    assert 1e-5 < by_name['dh_without_beta.csv'].error < 0.02


@pytest.mark.parametrize('convention', ['standard', 'modified'])
def test_the_other_convention_has_the_same_parameters(convention):
    rows = (Joint('table', alpha=np.radians(14.97)), *load_chain('puma560').joints)
    nominal = converted(Chain('turned', 'standard', rows), convention)
    chain = nominal.with_offsets({'table.alpha': 1e-3, 'joint_1.alpha': 1e-3})  # 15.03 degrees
    kinds = []
    for each in get_args(Convention):
        form = converted(chain, each)
        kinds.append(sorted(n.kind for n in form.parameter_names if n.of_dh))
    assert kinds[0] == kinds[1]


@pytest.mark.parametrize('convention', ['standard', 'modified'])
def test_the_other_convention_bends_alike(convention):
    """Centres of mass are given in the links' frames, gravity in that before the first row."""
    nominal = converted(load_chain('puma560'), convention)
    rows = (Joint('foot', alpha=np.pi / 3.0, d=-0.3), *nominal.joints)
    loaded = (replace(row, mass=2.0, com=(0.1, 0.2, 0.3)) for row in rows)
    chain = Chain('loaded', convention, tuple(loaded), gravity=(1.0, 2.0, -9.0))
    files = {each.name: each.content for each in exports(chain, chain)}
    bent = []
    for each in (chain, *(parse_chain(files[f'dh_{name}.yaml']) for name in get_args(Convention))):
        q = chain.random_joints(20, np.random.default_rng(1))
        bent.append(each.with_effect_values({'joint_2.compliance': 1e-3}).forward(q))
    np.testing.assert_allclose(bent[1:], [bent[0]] * 2, rtol=0, atol=1e-9)


@pytest.mark.parametrize('convention', ['standard', 'modified'])
def test_axes_six_degrees_from_parallel_need_no_beta(convention):
    rows = load_chain('puma560').with_offsets({'joint_2.beta': 0.1})
    nominal = replace(converted(rows, convention), base=None, tool=None)
    chain = faulty(nominal, Cell(), np.random.default_rng(0))
    by_name = {each.name: each for each in exports(chain, nominal)}
    assert by_name['dh_without_beta.csv'].error < 1e-7


@pytest.mark.filterwarnings('error')  # they would come on the operator's screen
@pytest.mark.parametrize('digits', [6, 7, 8, 9, 16])
def test_right_angles_of_a_few_digits_are_exported(digits):
    """A quarter turn to seven digits is a pitch of 90 degrees but for 1e-7, where Euler angles
    are hard to tell."""
    quarter = round(np.pi / 2.0, digits)
    rows = (
        Joint('j1', alpha=quarter, d=0.3, theta=0.1),
        Joint('j2', alpha=quarter, a=0.2, theta=-quarter),
        Joint('j3', alpha=-quarter, d=0.3, theta=quarter),
    )
    nominal = Chain('digits', 'standard', rows)
    found = exports(nominal.with_offsets({'j1.a': 1e-3}), nominal)
    assert 'kinematics.yaml' in {each.name for each in found}


def tilted():
    """A small arm with axes that are parallel but for a degree, and its calibration."""
    rows = (
        Joint('j1', d=0.05, lower=-2.6, upper=2.6),
        Joint('j2', alpha=np.pi / 2.0, theta=0.1, lower=-2.6, upper=2.6),
        Joint('j3', a=0.1, lower=-2.6, upper=2.6),
        Joint('j4', a=0.08, alpha=0.02, theta=-0.3, lower=-2.6, upper=2.6),
    )
    nominal = Chain('tilted', 'modified', rows)
    off = {'j2.alpha': -4e-4, 'j3.alpha': -3e-4, 'j3.beta': -4e-4, 'j4.alpha': 1e-3}
    return nominal, nominal.with_offsets({**off, 'j4.beta': 1e-3, 'j3.theta': 1e-3})


@pytest.mark.parametrize('name', ['ur10e', 'kuka_youbot', 'tilted'])
@pytest.mark.parametrize('file', ['dh_without_beta.csv', 'joint_offsets.csv'])
def test_a_table_is_as_near_as_it_says_without_frames_that_it_does_not_hold(name, file):
    nominal, chain = tilted() if name == 'tilted' else corrected(name)
    (found,) = (each for each in exports(chain, nominal) if each.name == file)
    rows = list(csv.DictReader(found.content.splitlines()[1:]))
    table = np.array([[float(row[kind]) for kind in DH_KINDS] for row in rows])
    joints = tuple(
        replace(joint, **dict(zip(DH_KINDS, row.tolist(), strict=True)))
        for joint, row in zip(nominal.joints, table, strict=True)
    )
    loaded = replace(chain, joints=joints)
    q = export.anywhere(chain)
    apart = (loaded.forward(q) - chain.forward(q))[:, :3, 3]
    assert np.linalg.norm(apart, axis=1).max() == pytest.approx(found.error, rel=1e-6)
    assert np.abs(table - nominal.table).max() < 0.02  # no absurd d of nearly parallel axes


def test_a_table_without_beta_has_none_of_the_nominal_table_either():
    nominal, _ = tilted()
    nominal = nominal.with_offsets({'j3.beta': 0.01})
    found = exports(nominal.with_offsets({'j3.beta': 1e-3}), nominal, np.eye(4))  # of 4 poses
    (text,) = (each.content for each in found if each.name == 'dh_without_beta.csv')
    assert {float(row['beta']) for row in csv.DictReader(text.splitlines()[1:])} == {0.0}


@pytest.mark.parametrize('name', ['scara', 'kinova'])
def test_a_table_says_what_its_rows_cut_off(name):
    """A flange 0.1 m after the last joint is in no modified table, a base in no standard one."""
    rows = (Joint('j1', alpha=np.pi, d=-0.3), Joint('j2', a=0.2, alpha=np.pi / 2.0, d=0.1))
    arm = Chain('kinova', 'modified', rows)
    if name == 'scara':
        arm = replace(
            scara(), joints=(*scara().joints[:3], Joint('j4', a=0.1, alpha=np.pi, d=0.05))
        )
    other = 'standard' if name == 'kinova' else 'modified'
    chain = replace(faulty(arm, Cell(), np.random.default_rng(1)), base=Frame(), tool=Frame())
    by_name = {each.name: each for each in exports(chain, arm)}
    assert not by_name[f'dh_{chain.convention}.csv'].beyond
    found = by_name[f'dh_{other}.csv']
    first, _, table = found.content.partition('\n')
    words = (
        'from the last row to the flange' if name == 'scara' else 'from the base to the first row'
    )
    place = re.search(rf'\({words}: ((?:[a-z]+ [-+.e0-9]+ ?){{6}})\)', first).group(1).split()
    pose = pose_matrix(dict(zip(place[::2], map(float, place[1::2]), strict=True)))
    joints = tuple(
        Joint(r['joint'], r['type'], *(float(r[kind]) for kind in DH_KINDS), int(r['sign']))
        for r in csv.DictReader(table.splitlines())
    )
    q = chain.random_joints(20, np.random.default_rng(2))
    reached = Chain('', other, joints).forward(q)
    reached = reached @ pose if name == 'scara' else pose @ reached
    np.testing.assert_allclose(reached, chain.forward(q), rtol=0, atol=1e-8)


def test_kinematics_tell_which_joints_slide():
    """Nothing else in the file did."""
    assert yaml.safe_load(kinematics_yaml(scara()))['prismatic'] == ['j3']
    assert 'prismatic' not in yaml.safe_load(kinematics_yaml(load_chain('ur5e')))
    by_name = {each.name: each for each in exports(scara(), scara())}
    assert yaml.safe_load(by_name['kinematics.yaml'].content)['prismatic'] == ['j3']


def test_kinematics_tell_a_changed_robot_by_their_hash():
    _, chain = corrected('ur5e')
    first = yaml.safe_load(kinematics_yaml(chain))
    again = yaml.safe_load(kinematics_yaml(chain, {'robot_serial': '2019', 'region': {}}))
    assert first['hash'] == again['hash']
    assert again['calibration'] == {'robot_serial': '2019'}
    other = chain.with_offsets({'elbow_joint.a': 1e-6})
    assert yaml.safe_load(kinematics_yaml(other))['hash'] != first['hash']


@pytest.mark.parametrize('effect', ['ratio', 'backlash'])
def test_what_a_table_cannot_say_is_said_at_its_head(effect):
    nominal, chain = corrected('ur10e')
    chain = replace(chain, effects=((f'elbow_joint.{effect}', 1e-3),))
    table = next(each for each in exports(chain, nominal) if each.name == 'dh_standard.csv')
    assert table.error > 1e-4
    assert 'off the calibrated arm' in table.content.splitlines()[0]


def test_tables_count_on_effects_that_the_controller_knows():
    """A palletiser's coupled joints: without the coupling each table was up to a metre off."""
    nominal, chain = corrected('kuka_youbot')
    coupled = (('arm_joint_4.coupling_arm_joint_3', -1.0),)
    nominal, chain = (replace(each, effects=coupled) for each in (nominal, chain))
    *exact, without_beta, offsets = exports(chain, nominal)
    assert {each.error for each in exact} == {0.0}
    files = [parse_chain(each.content) for each in exact if each.name.endswith('d.yaml')]
    assert [each.effects for each in files] == [coupled, coupled]
    assert max(without_beta.error, offsets.error) < 0.02
    for table in (exact[0], exact[2], without_beta, offsets):
        assert 'with the effects of the nominal chain' in table.content.splitlines()[0]


def test_chain_files_hold_fitted_couplings():
    nominal, chain = corrected('kuka_youbot')
    name = 'arm_joint_4.coupling_arm_joint_3'
    nominal = replace(nominal, effects=((name, -1.0),))
    chain = replace(chain, effects=((name, -1.002),))
    q = chain.random_joints(20, np.random.default_rng(1))
    for each in exports(chain, nominal):
        in_file = each.name in ('dh_standard.yaml', 'dh_modified.yaml')
        assert (each.error == 0.0) == in_file
        assert ('; exact; ' in each.content.splitlines()[0]) == in_file
        if in_file:
            again = parse_chain(each.content)
            assert again.effects == chain.effects
            np.testing.assert_allclose(again.forward(q), chain.forward(q), rtol=0.0, atol=1e-9)


def test_a_file_that_differs_is_refused(monkeypatch):
    nominal, chain = corrected('ur10e')
    monkeypatch.setattr(export, 'xyz_rpy', lambda matrix: dict.fromkeys(KEYS, 0.0))
    with pytest.raises(ExportError, match=r'kinematics\.yaml, read back, differs'):
        exports(chain, nominal)


def test_a_urdf_corrected_again_names_only_its_own_table():
    once, twice = (
        load_chain('ur10e').with_offsets({'elbow_joint.theta': x}) for x in (1e-3, 2e-3)
    )
    first = urdf_export('a.urdf', UR10E, once, {}).content
    again = urdf_export('b.urdf', first, twice, {}).content
    assert again == urdf_export('b.urdf', UR10E, twice, {}).content
    assert re.findall('calibrated table (.*) of', again) == [table_hash(twice)]


def test_a_urdf_names_the_tables_of_both_its_arms():
    """The second correction took the first one's out."""
    first = urdf_export('a.urdf', UR10E, load_chain('ur10e'), {}).content
    earlier = first.splitlines(keepends=True)[-1]
    other = re.sub('(?<=name=")(?=[^"]*_joint)', 'l_', UR10E) + earlier
    assert earlier in urdf_export('b.urdf', other, chain_from_urdf(other), {}).content


def test_a_joint_may_be_called_flange():
    """Its pose was replaced by that of the last frame, and nothing was exported."""
    chain = load_chain('ur10e')
    last = replace(chain.joints[-1], name='flange')
    named = replace(chain, joints=(*chain.joints[:-1], last))
    by_name = {each.name: each for each in exports(named, named)}
    poses = yaml.safe_load(by_name['kinematics.yaml'].content)['kinematics']
    assert [*poses][-2:] == ['flange', 'flange_']


@pytest.fixture
def files(run, tmp_path):
    """Return a function that exports on the command line and returns the files by name."""
    _, chain = corrected('ur10e', 3)
    (tmp_path / 'calibration.yaml').write_text(dump_chain(chain, {'samples': 60}))

    def files(*more):
        given = ('calibration.yaml', '--chain', 'ur10e', '--out', 'out', '--force', *more)
        assert run('export', *given)[0] == 0
        return {path.name: path.read_text() for path in (tmp_path / 'out').iterdir()}

    return files


def test_the_command_line_hands_on_where_the_numbers_come_from(files):
    for name, text in files().items():
        if name.endswith('.yaml'):
            assert yaml.safe_load(text)['calibration'] == {'samples': 60}


def test_the_command_line_fits_tables_to_the_measured_region(files, tmp_path):
    rng = np.random.default_rng(4)
    region = np.array([0.3, -1.2, 1.4, -0.5, 0.9, 0.2]) + rng.uniform(-0.2, 0.2, (300, 6))
    (tmp_path / 'measured.csv').write_text(joints_csv(region))

    def error(found):
        return float(re.search('up to (.*) mm off', found['dh_without_beta.csv']).group(1))

    near = files('--measured', 'measured.csv')
    assert error(near) < 0.5 * error(files())
    first = near['dh_without_beta.csv'].partition('\n')[0]
    more = re.search('arm at the measured joint values, (.*) mm at 1,000 random poses;', first)
    assert float(more.group(1)) > error(files())
    assert 'measured' not in files()['dh_without_beta.csv']
    rows = csv.DictReader(near['dh_without_beta.csv'].splitlines()[1:])
    assert all(float(row['beta']) == 0.0 for row in rows)


@pytest.mark.parametrize('coupled', [False, True])
def test_the_command_line_tells_what_tables_cannot_hold(run, tmp_path, coupled):
    """A pattern that no effect of the arm has is refused by `identify --fixed`."""
    nominal, chain = corrected('ur10e')
    known = (('elbow_joint.coupling_shoulder_lift_joint', -1.0),) if coupled else ()
    chain = replace(chain, effects=(*known, ('elbow_joint.ratio', 1e-3)))
    (tmp_path / 'nominal.yaml').write_text(dump_chain(replace(nominal, effects=known)))
    (tmp_path / 'calibration.yaml').write_text(dump_chain(chain, {'source': 'simulation'}))
    _, _, said = run('export', 'calibration.yaml', '--chain', 'nominal.yaml', '--out', 'out')
    assert 'tables cannot hold the fitted effects elbow_joint.ratio; for the best' in said
    held = ' --fixed "*.coupling_*"' if coupled else ''
    assert said.endswith(f'without them, identify with --model geometric{held}\n')
