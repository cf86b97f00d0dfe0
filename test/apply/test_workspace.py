# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import csv
from dataclasses import replace

import numpy as np
import pytest
from test_placement import TASK
from verified import UR

from calib_ros.apply import workspace
from calib_ros.apply.workspace import SIDES, regions, survey
from calib_ros.cli.workspace import PLACEMENT_FILES, WORKSPACE_FILES
from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.files.programs import csv_of, read_joints, read_poses
from calib_ros.identification.calibration import load_calibration
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import dump_chain
from calib_ros.kinematics.se3 import to_quat


def test_what_is_removed_is_what_the_nominal_arm_misses(cell, arm):
    true, result, _ = cell
    found = survey(arm, 2000, np.random.default_rng(1))
    missed = (result.before.forward(found.joints) - true.forward(found.joints))[:, :3, 3]
    missed = np.linalg.norm(missed, axis=1)
    assert found.removed.mean() > 1e-3
    assert np.abs(found.removed - missed).max() < 3e-4  # a few sigma
    turn = arm.removed(found.joints)[1]
    assert 5e-4 < turn.mean() < 5e-3


def test_expected_errors_add_up(cell, arm):
    result = cell[1]
    q = UR.random_joints(50, np.random.default_rng(1))
    covariance = result.pose_covariance(q)[:, :3, :3]
    variance = np.trace(covariance, axis1=1, axis2=2)
    rms = 1e-3 * round(result.validation.figures[1].rms_mm, 6)
    np.testing.assert_allclose(arm.sigma(q) ** 2, variance, rtol=1e-9)
    np.testing.assert_allclose(arm.expected(q, 'corrected') ** 2, variance + rms**2, rtol=1e-9)
    both = variance + rms**2 + arm.removed(q)[0] ** 2
    np.testing.assert_allclose(arm.expected(q, 'nominal') ** 2, both, rtol=1e-9)
    alone = replace(arm, region=None, covariance=None)
    both = arm.residual**2 + arm.removed(q)[0] ** 2
    np.testing.assert_allclose(alone.expected(q, 'nominal') ** 2, both, rtol=1e-9)
    with pytest.raises(ConfigError, match='a chain alone does not predict the error'):
        alone.expected(q, 'corrected')
    with pytest.raises(UnknownNameError, match='model "best"'):
        arm.expected(q, 'best')


def test_positions_are_in_the_base_frame(cell, arm):
    result = cell[1]
    found = survey(arm, 500, np.random.default_rng(1))
    flange = replace(result.chain, base=None, tool=None).forward(found.joints)[:, :3, 3]
    reach = np.linalg.norm(result.chain.tool.matrix[:3, 3])
    distance = np.linalg.norm(found.positions - flange, axis=1)
    np.testing.assert_allclose(distance, reach, atol=1e-9)
    assert found.cloud.shape == (500, 5)
    np.testing.assert_array_equal(found.cloud[:, :3], found.positions)
    np.testing.assert_array_equal(found.cloud[:, 3], found.removed)
    np.testing.assert_array_equal(found.cloud[:, 4], found.sigma)


def test_a_chain_alone_has_no_sigma(cell, tmp_path):
    result = cell[1]
    (tmp_path / 'chain.yaml').write_text(dump_chain(result.chain, {'source': 'a test'}))
    arm = load_calibration(tmp_path / 'chain.yaml', UR)
    found = survey(arm, 100, np.random.default_rng(1))
    assert np.isnan(found.sigma).all()
    assert np.isnan(found.remaining).all()
    np.testing.assert_allclose(arm.expected(found.joints, 'nominal'), found.removed)
    with pytest.raises(ConfigError, match=r'give the calibration\.yaml'):
        arm.expected(found.joints, 'corrected')


def test_frames_that_are_fixed_stay(cell, tmp_path):
    result = cell[1]
    fixed = result.chain.with_frame('base', Frame(result.chain.base.matrix, fixed=True))
    (tmp_path / 'chain.yaml').write_text(dump_chain(fixed, {'source': 'a test'}))
    arm = load_calibration(tmp_path / 'chain.yaml', UR)
    np.testing.assert_allclose(arm.before.base.matrix, result.chain.base.matrix, atol=1e-12)
    assert np.abs(arm.before.tool.matrix - result.chain.tool.matrix).max() > 1e-5


def test_the_worst_region_is_found_and_named(rng):
    positions = rng.uniform(-1.0, 1.0, (20_000, 3))
    bad = (positions[:, 0] < -0.6) & (np.abs(positions[:, 1]) < 0.3) & (positions[:, 2] > 0.5)
    found = regions(positions, np.where(bad, 2.0, 0.5))
    worst = found[0]
    assert worst.words in ('far out, high, behind (-x)', 'halfway out, high, behind (-x)')
    assert worst.rms > 1.2
    assert [region.rms for region in found] == sorted((r.rms for r in found), reverse=True)
    assert sum(region.poses for region in found) == len(positions)
    radius = np.hypot(positions[:, 0], positions[:, 1])
    azimuth = np.arctan2(positions[:, 1], positions[:, 0]) % (2.0 * np.pi)
    for region in found:
        inside = (region.radius[0] <= radius) & (radius <= region.radius[1])
        inside &= (region.height[0] <= positions[:, 2]) & (positions[:, 2] <= region.height[1])
        middle = 0.5 * np.pi * SIDES.index(region.words.split(', ')[2])
        inside &= np.abs((azimuth - middle + np.pi) % (2.0 * np.pi) - np.pi) <= 0.25 * np.pi
        assert inside.sum() == pytest.approx(region.poses, abs=2)


def test_figures_of_a_spread(rng):
    errors = rng.uniform(0.0, 1.0, 100_000)
    found = workspace.spread(errors)
    assert found['RMS'] == pytest.approx(1.0 / np.sqrt(3.0), abs=0.01)
    assert (found['mean'], found['median']) == pytest.approx((0.5, 0.5), abs=0.01)
    assert found['95 % below'] == pytest.approx(0.95, abs=0.01)
    assert found['max'] == errors.max()


def test_a_map_holds_the_rms_of_each_cell(rng):
    x, y = rng.uniform(0.0, 3.0, (2, 5000))
    errors = np.where(x < 1.0, 3.0, 1.0)
    first, second, rms = workspace.rms_map(
        np.append(x, 3.0), np.append(y, 9.0), np.append(errors, 1.0), 3
    )
    assert (len(first), len(second)) == (4, 4)
    np.testing.assert_allclose(rms[:, 0], [3.0, 1.0, 1.0], atol=0.02)
    assert np.isnan(rms[0, 2])


@pytest.fixture
def folder(arm, tmp_path):
    (tmp_path / 'result').mkdir()
    arm = replace(arm, record={'robot_serial': '4711'})
    (tmp_path / 'result' / 'calibration.yaml').write_text(arm.dump())
    return 'result'


def test_the_poses_of_a_task_may_have_units(tmp_path):
    """They were asked for in the header, and refused there."""
    path = tmp_path / 'task.csv'
    path.write_text('x [mm];y [mm];z [cm];qx;qy;qz;qw\n100,5;200;30;0;0;0;1\n')
    np.testing.assert_allclose(read_poses(path)[0, :3, 3], [0.1005, 0.2, 0.3])
    for old, new, told in (
        ('[cm]', '[deg]', r'z .deg. must be in m or cm or mm'),
        (' [deg]', '', r'z has no unit, y .mm. has: name it in all'),
    ):
        path.write_text(path.read_text().replace(old, new))
        with pytest.raises(InputError, match=told):
            read_poses(path)


@pytest.mark.usefixtures('drawn')
def test_workspace_writes_tables_words_and_figures_and_places_a_task(run, folder, tmp_path):
    task = TASK[::2]
    values = np.column_stack([task[:, :3, 3], to_quat(task[:, :3, :3])])
    (tmp_path / 'task.csv').write_text(csv_of(('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'), values))
    np.testing.assert_allclose(read_poses(tmp_path / 'task.csv'), task, atol=1e-8)
    (tmp_path / 'long.csv').write_text('x,y,z,qx,qy,qz,qw\n1,2,3,1,0,0,1\n')
    with pytest.raises(InputError, match='line 2: quaternion'):
        read_poses(tmp_path / 'long.csv')
    given = (
        *('workspace', folder, '--chain', 'ur10e', '--out', 'map', '--poses', 500),
        *('--task', 'task.csv', '--model', 'nominal', '--aim', 'worst', '--cells', 3),
        *('--region', 0, -1, -0.5, 1, 1, 1),
    )
    status, out, err = run(*given)
    assert (status, err) == (0, '')
    files = {path.name for path in (tmp_path / 'map').iterdir()}
    assert files == {*WORKSPACE_FILES, *PLACEMENT_FILES}
    for name in ('workspace.png', 'placements.png'):
        assert (tmp_path / 'map' / name).read_bytes().startswith(b'\x89PNG')
    text = (tmp_path / 'map' / 'workspace.md').read_text()
    assert text.startswith('# Errors over the workspace: ur10e 4711')
    assert 'Where the calibration removes most' in text
    assert text.count('| expected to remain |') == 1
    assert 'Expected to remain: its uncertainty' in text
    with (tmp_path / 'map' / 'workspace.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 500
    assert rows[0].keys() == {'x', 'y', 'z', 'error', 'sigma'}
    rms = 1e3 * np.sqrt(np.mean([float(row['error']) ** 2 for row in rows]))
    assert f'| removed by the calibration | {rms:.3f} |' in text
    assert f'{rms:.3f}' in out
    assert run(*given)[0] == 1
    joints = read_joints(tmp_path / 'map' / 'placed_task.csv', UR)
    with (tmp_path / 'map' / 'placements.csv').open() as file:
        rows = list(csv.DictReader(file))
    reached = [row for row in rows if row['error']]
    assert 10 < len(reached) < len(rows)
    best = min(reached, key=lambda row: float(row['error']))
    place = [float(best[axis]) for axis in 'xyz']
    assert f'about the vertical: {1e3 * float(best["error"]):.3f} mm; ' in ' '.join(out.split())
    arm = load_calibration(tmp_path / folder, UR)
    poses = workspace.in_base(arm.before, joints)
    np.testing.assert_allclose(poses[:, :3, 3], place + task[:, :3, 3], atol=1e-7)


@pytest.mark.parametrize(
    ('arguments', 'text'),
    [
        (('--joint-box', 0, 1), '--joint-box: give 6 lower and 6 upper values, not 2'),
        (('--joint-box', *[1.0] * 6, *[-1.0] * 6), '--joint-box: give all lower values first'),
        (
            ('--joint-box', *[-30.0] * 6, *[30.0] * 6),
            '--joint-box: -30 is beyond the limits of shoulder_pan_joint, -6.28319 to 6.28319 '
            '(rad or m, not degrees)',
        ),
        (('--poses', 1), '--poses must be at least 100'),
        (('--task', 'missing.csv'), 'cannot read missing.csv'),
        (('--task', 'x.csv', '--joint-box', 0), 'either --task or --joint-box'),
    ],
)
def test_workspace_refuses_what_makes_no_sense(run, folder, tmp_path, arguments, text):
    status, out, err = run('workspace', folder, '--chain', 'ur10e', '--out', 'map', *arguments)
    assert (status, out) == (1, '')
    assert text in err
    assert not (tmp_path / 'map').exists()
