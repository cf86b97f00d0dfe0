# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import csv
import functools
from argparse import Namespace
from dataclasses import replace

import numpy as np
import pytest

from calib_ros.apply import simulation, workspace
from calib_ros.apply.placement import place, task_of
from calib_ros.apply.workspace import regions, survey
from calib_ros.cli.main import main
from calib_ros.cli.workspace import PLACEMENT_FILES, WORKSPACE_FILES, _task
from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.files.waypoints import csv_of, read_joints, read_poses
from calib_ros.identification.calibration import MODELS, Calibration, load_calibration
from calib_ros.identification.identification import Problem, identify
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import dump_chain, load_chain
from calib_ros.kinematics.se3 import exp_rotation, to_quat, transform

UR = load_chain('ur10e')
DOWN = np.diag([1.0, -1.0, -1.0])
SIGMAS = (1e-4, 3e-4)


@functools.cache
def identified(seed=0, sigmas=SIGMAS):
    """Return the true arm and the result of its identification; the seed is that of the noise."""
    rng = np.random.default_rng(0)
    true = simulation.faulty(UR, simulation.Cell(), rng)
    joints = UR.random_joints(40, rng)
    observations = simulation.measure(true, joints, np.random.default_rng(seed), *sigmas)
    return true, identify(Problem(UR, observations))


@pytest.fixture(scope='module')
def cell():
    return identified()


@pytest.fixture(scope='module')
def task():
    """Return twelve poses on a circle of 0.3 m, tool down."""
    angle = 2.0 * np.pi * np.arange(12) / 12
    circle = np.column_stack([0.15 * np.cos(angle), 0.15 * np.sin(angle), np.zeros(12)])
    return transform(np.tile(DOWN, (12, 1, 1)), circle)


@pytest.fixture(scope='module')
def placed(cell, task):
    """Return the placements of the task by the nominal model."""
    return place(Calibration.of(cell[1]), task, 'mean', 'nominal', cells=6)


def wanted(chain, placements, which, task):
    """Return where the task's poses are in the world, for the chain that commands the arm."""
    turn = exp_rotation(np.array([0.0, 0.0, placements.turns[which]]))
    frame = transform(turn, placements.positions[which])
    return chain.frame('base').matrix @ frame @ task


def true_errors(true, chain, placements, which, task):
    """Return what the real arm misses when it goes to the joint values of a placement."""
    there = true.forward(placements.joints[which])[:, :3, 3]
    return np.linalg.norm(there - wanted(chain, placements, which, task)[:, :3, 3], axis=1)


# What is removed and what remains


def test_what_is_removed_is_what_the_nominal_arm_misses(cell):
    true, result = cell
    arm = Calibration.of(result)
    found = survey(arm, 2000, np.random.default_rng(1))
    missed = (result.before.forward(found.joints) - true.forward(found.joints))[:, :3, 3]
    missed = np.linalg.norm(missed, axis=1)
    assert found.removed.mean() > 1e-3
    assert np.abs(found.removed - missed).max() < 3e-4  # a few sigma
    turn = arm.removed(found.joints)[1]
    np.testing.assert_array_equal(turn, found.turned)
    assert 5e-4 < turn.mean() < 5e-3


def test_sigma_is_the_size_of_what_remains():
    """Over 20 calibrations of one arm: the error of predictions is sigma, on the average."""
    q = UR.random_joints(100, np.random.default_rng(5))
    shares = []
    for seed in range(20):
        true, result = identified(seed)
        left = (result.chain.forward(q) - true.forward(q))[:, :3, 3]
        shares.append((left**2).sum(axis=1) / Calibration.of(result).sigma(q) ** 2)
    assert np.sqrt(np.mean(shares)) == pytest.approx(1.0, abs=0.12)


def test_expected_errors_add_up(cell):
    _, result = cell
    arm = Calibration.of(result)
    q = UR.random_joints(50, np.random.default_rng(1))
    covariance = result.pose_covariance(q)[:, :3, :3]
    variance = np.trace(covariance, axis1=1, axis2=2)
    rms = 1e-3 * result.validation.figures[1].rms_mm
    np.testing.assert_allclose(arm.sigma(q) ** 2, variance, rtol=1e-9)
    np.testing.assert_allclose(arm.expected(q, 'corrected') ** 2, variance + rms**2, rtol=1e-9)
    both = variance + rms**2 + arm.removed(q)[0] ** 2
    np.testing.assert_allclose(arm.expected(q, 'nominal') ** 2, both, rtol=1e-9)
    with pytest.raises(UnknownNameError, match='model "best"'):
        arm.expected(q, 'best')


def test_positions_are_in_the_base_frame(cell):
    _, result = cell
    arm = Calibration.of(result)
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
    _, result = cell
    (tmp_path / 'chain.yaml').write_text(dump_chain(result.chain, {'source': 'a test'}))
    arm = load_calibration(tmp_path / 'chain.yaml', UR)
    found = survey(arm, 100, np.random.default_rng(1))
    assert np.isnan(found.sigma).all()
    assert np.isnan(found.remaining).all()
    assert found.removed.min() > 0.0
    np.testing.assert_allclose(arm.expected(found.joints, 'nominal'), found.removed)
    with pytest.raises(ConfigError, match=r'give the calibration\.yaml'):
        arm.expected(found.joints, 'corrected')


def test_frames_that_are_fixed_stay(cell, tmp_path):
    _, result = cell
    fixed = result.chain.with_frame('base', Frame(result.chain.base.matrix, fixed=True))
    (tmp_path / 'chain.yaml').write_text(dump_chain(fixed, {'source': 'a test'}))
    arm = load_calibration(tmp_path / 'chain.yaml', UR)
    np.testing.assert_allclose(arm.before.base.matrix, result.chain.base.matrix, atol=1e-12)
    assert np.abs(arm.before.tool.matrix - result.chain.tool.matrix).max() > 1e-5


def write_result(folder, result):
    folder.mkdir(exist_ok=True)
    (folder / 'calibration.yaml').write_text(Calibration.of(result).dump())


def test_a_calibration_knows_its_nominal_chain(cell, tmp_path):
    _, result = cell
    write_result(tmp_path, result)
    load_calibration(tmp_path, UR)
    other = UR.with_offsets({'elbow_joint.d': 1e-6})
    with pytest.raises(ConfigError, match=r'another nominal chain, with elbow_joint\.d 0 and'):
        load_calibration(tmp_path, other)


# Where errors are large


def test_the_worst_region_is_found_and_named(rng):
    positions = rng.uniform(-1.0, 1.0, (20_000, 3))
    bad = (positions[:, 0] < -0.6) & (np.abs(positions[:, 1]) < 0.3) & (positions[:, 2] > 0.5)
    found = regions(positions, np.where(bad, 2.0, 0.5))
    worst = found[0]
    assert worst.words in ('far out, high, behind (-x)', 'half way out, high, behind (-x)')
    assert worst.rms > 1.2
    assert [region.rms for region in found] == sorted((r.rms for r in found), reverse=True)
    assert sum(region.poses for region in found) == len(positions)
    radius = np.hypot(positions[:, 0], positions[:, 1])
    azimuth = np.arctan2(positions[:, 1], positions[:, 0]) % (2.0 * np.pi)
    for region in found:
        inside = (region.radius[0] <= radius) & (radius <= region.radius[1])
        inside &= (region.height[0] <= positions[:, 2]) & (positions[:, 2] <= region.height[1])
        middle = np.mean(region.azimuth)
        inside &= np.abs((azimuth - middle + np.pi) % (2.0 * np.pi) - np.pi) <= 0.25 * np.pi
        assert inside.sum() == pytest.approx(region.poses, abs=2)


def test_figures_of_a_spread(rng):
    errors = rng.uniform(0.0, 1.0, 100_000)
    found = workspace.Spread.of(errors)
    assert found.rms == pytest.approx(1.0 / np.sqrt(3.0), abs=0.01)
    assert (found.mean, found.median) == pytest.approx((0.5, 0.5), abs=0.01)
    assert found.percentile_95 == pytest.approx(0.95, abs=0.01)
    assert found.max == errors.max()


def test_a_map_holds_the_rms_of_each_cell(rng):
    x, y = rng.uniform(0.0, 3.0, (2, 5000))
    errors = np.where(x < 1.0, 3.0, 1.0)
    first, second, rms = workspace.rms_map(
        np.append(x, 3.0), np.append(y, 9.0), np.append(errors, 1.0), 3
    )
    assert (len(first), len(second)) == (4, 4)
    np.testing.assert_allclose(rms[:, 0], [3.0, 1.0, 1.0], atol=0.02)
    assert np.isnan(rms[0, 2])


# Where to do a task


@pytest.mark.parametrize('aim', ['mean', 'worst'])
def test_the_best_placement_beats_the_centre_on_the_true_arm(cell, task, placed, aim):
    """Commanded by the nominal model; what is expected comes true."""
    true, result = cell
    arm = Calibration.of(result)
    found = placed if aim == 'mean' else place(arm, task, aim, 'nominal', cells=6)
    over = np.mean if aim == 'mean' else np.max
    best, centre = (
        over(true_errors(true, arm.before, found, which, task))
        for which in (found.best, found.centre)
    )
    assert found.errors[found.best] < 0.7 * found.errors[found.centre]
    assert best < 0.7 * centre
    for which, there in ((found.best, best), (found.centre, centre)):
        expected = np.sqrt(found.errors[which] ** 2 - arm.residual**2)  # the arm has none
        assert there == pytest.approx(expected, rel=0.15)


def test_the_best_placement_of_a_corrected_arm_beats_the_centre(task):
    """On the average over 20 calibrations of one arm, because only chance is left."""
    best, centre = [], []
    _, first = identified(100)
    arm = Calibration.of(first)
    found = place(arm, task, cells=6)
    for seed in range(20):
        true, result = identified(seed)
        for which, errors in ((found.best, best), (found.centre, centre)):
            joints = found.joints[which]
            left = (result.chain.forward(joints) - true.forward(joints))[:, :3, 3]
            errors.append((left**2).sum(axis=1).mean())
    assert np.mean(best) < np.mean(centre)
    for which, errors in ((found.best, best), (found.centre, centre)):
        sigma = np.sqrt(np.mean(arm.sigma(found.joints[which]) ** 2))
        assert np.sqrt(np.mean(errors)) == pytest.approx(sigma, rel=0.2)


def test_the_joint_values_bring_the_arm_to_the_placed_task(cell, task):
    _, result = cell
    task = task[::4]
    arm = Calibration.of(result)
    for model in MODELS:
        found = place(arm, task, 'mean', model, cells=4, turns=3)
        chain = arm.commanded_by(model)
        reached = ~np.isnan(found.errors)
        assert 10 < reached.sum() < len(reached)
        turned = int(np.flatnonzero(reached & (found.turns > 2.0))[0])
        for which in (found.best, found.centre, turned):
            np.testing.assert_allclose(
                chain.forward(found.joints[which]), wanted(chain, found, which, task), atol=1e-8
            )
            again = arm.expected(found.joints[which], model).mean()
            assert found.errors[which] == pytest.approx(again, rel=1e-12)
        assert found.errors[found.best] == np.nanmin(found.errors)
        assert len(np.unique(found.turns)) == 3
        grid = slice(0, 4**3 * 3)  # what comes after it are refinements
        there = found.positions[grid][reached[grid]]
        distance = np.linalg.norm(found.positions[grid] - there.mean(axis=0), axis=1)
        nearest = np.where(reached[grid], distance, np.inf).min()
        assert distance[found.centre] == pytest.approx(nearest)


def test_the_arm_goes_on_from_pose_to_pose(cell):
    """Round its base it turns its first joint and keeps its configuration."""
    _, result = cell
    arm = Calibration.of(result)
    angle = np.radians(np.linspace(-150.0, 150.0, 40))
    arc = np.column_stack([0.6 * np.cos(angle), 0.6 * np.sin(angle), np.zeros(40)])
    turns = exp_rotation(np.column_stack([np.zeros((40, 2)), angle]))
    region = np.array([[-0.05, -0.05, 0.0], [0.05, 0.05, 0.3]])
    found = place(arm, transform(turns @ DOWN, arc), region=region, cells=3)
    reached = ~np.isnan(found.errors)
    moves = np.abs(np.diff(found.joints[reached], axis=1)).max(axis=(1, 2))
    assert reached.mean() > 0.8
    assert np.median(moves) < 0.3


def test_placements_keep_to_the_region(cell, task, placed):
    _, result = cell
    region = np.array([[0.3, -0.4, 0.1], [0.8, 0.4, 0.5]])
    found = place(Calibration.of(result), task, 'mean', 'nominal', region, cells=4)
    assert ((region[0] - 1e-9 <= found.positions) & (found.positions <= region[1] + 1e-9)).all()
    assert (~np.isnan(found.errors)).mean() > 0.8
    distance = np.linalg.norm(found.positions[found.centre] - region.mean(axis=0))
    assert distance < np.linalg.norm(region[1] - region[0]) / 6  # half a step of the grid
    assert placed.errors[placed.best] < found.errors[found.best]


def test_a_finer_search_does_not_find_much_more(cell, task):
    _, result = cell
    arm = Calibration.of(result)
    region = np.array([[0.3, -0.5, -0.3], [1.0, 0.5, 0.5]])
    coarse, fine = (
        place(arm, task[::3], 'mean', 'nominal', region, cells).errors for cells in (4, 8)
    )
    assert np.nanmin(coarse) < 1.1 * np.nanmin(fine)


def test_a_task_out_of_reach_is_refused(cell, task):
    _, result = cell
    arm = Calibration.of(result)
    far = task.copy()
    far[0, 0, 3] = 10.0
    with pytest.raises(InputError, match='reaches all 12 poses of the task at none'):
        place(arm, far, cells=3)
    for upper in ([0.2, 1.0, 1.0], [np.nan, 1.0, 1.0]):
        with pytest.raises(InputError, match='give the lower corner first'):
            place(arm, task, region=np.array([[0.3, -1.0, 0.0], upper]))
    with pytest.raises(UnknownNameError, match='aim "least"'):
        place(arm, task, 'least')


def test_a_task_from_a_box_of_joint_values_is_reached_where_it_came_from(cell):
    _, result = cell
    arm = Calibration.of(result)
    middle = np.array([0.2, -1.4, 1.6, -0.5, 1.0, 0.2])
    q = middle + np.random.default_rng(0).uniform(-0.2, 0.2, (10, 6))
    poses = workspace.in_base(arm.chain, q)
    task = task_of(poses)
    np.testing.assert_allclose(task[:, :3, 3].max(axis=0), -task[:, :3, 3].min(axis=0))
    there = (poses - task)[0, :3, 3]
    found = place(arm, task, region=np.array([there, there + 1e-9]), cells=1)
    np.testing.assert_allclose(arm.chain.forward(found.joints[0]), arm.chain.forward(q), atol=1e-8)


# On the command line


@pytest.fixture
def run(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        status = main(['workspace', *map(str, arguments)])
        out, err = capsys.readouterr()
        return status, out, err

    return run


@pytest.fixture
def folder(cell, tmp_path):
    write_result(tmp_path / 'result', cell[1])
    return 'result'


def test_workspace_writes_tables_words_and_figures(run, folder, tmp_path):
    arguments = (folder, '--chain', 'ur10e', '--out', 'map', '--poses', 500)
    status, out, err = run(*arguments)
    assert (status, err) == (0, '')
    found = {path.name for path in (tmp_path / 'map').iterdir()}
    assert found == set(WORKSPACE_FILES)
    text = (tmp_path / 'map' / 'workspace.md').read_text()
    assert 'Where the most is removed by the calibration' in text
    assert text.count('| expected to remain |') == 1
    with (tmp_path / 'map' / 'workspace.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 500
    assert rows[0].keys() == {'x', 'y', 'z', 'error', 'sigma'}
    rms = 1e3 * np.sqrt(np.mean([float(row['error']) ** 2 for row in rows]))
    assert f'| removed by the calibration | {rms:.4f} |' in text
    assert f'{rms:.4f}' in out
    assert run(*arguments)[0] == 1


def test_workspace_places_a_task(run, folder, tmp_path, task):
    task = task[::4]
    values = np.column_stack([task[:, :3, 3], to_quat(task[:, :3, :3])])
    (tmp_path / 'task.csv').write_text(csv_of(('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'), values))
    np.testing.assert_allclose(read_poses(tmp_path / 'task.csv'), task, atol=1e-8)
    status, out, err = run(
        *(folder, '--chain', 'ur10e', '--out', 'map', '--poses', 500, '--task', 'task.csv'),
        *('--model', 'nominal', '--aim', 'worst', '--cells', 4, '--region', 0, -1, -0.5, 1, 1, 1),
    )
    assert (status, err) == (0, '')
    files = {path.name for path in (tmp_path / 'map').iterdir()}
    assert files == {*WORKSPACE_FILES, *PLACEMENT_FILES}
    joints = read_joints(tmp_path / 'map' / 'placed_task.csv', UR)
    with (tmp_path / 'map' / 'placements.csv').open() as file:
        rows = list(csv.DictReader(file))
    reached = [row for row in rows if row['error']]
    assert 10 < len(reached) < len(rows)
    best = min(reached, key=lambda row: float(row['error']))
    place = [float(best[axis]) for axis in 'xyz']
    assert f'best:   {1e3 * float(best["error"]):.4f} mm at ' in out
    arm = load_calibration(tmp_path / folder, UR)
    poses = workspace.in_base(arm.before, joints)
    np.testing.assert_allclose(poses[:, :3, 3], place + task[:, :3, 3], atol=1e-7)


def test_a_box_of_joint_values_is_a_task(cell):
    arm = Calibration.of(cell[1])
    box = (0, -1.6, 1.4, -0.6, 0.9, 0, 0.3, -1.3, 1.6, -0.4, 1.1, 0.4)
    options = Namespace(task=None, joint_box=box, model='corrected')
    task = _task(options, arm, np.random.default_rng(0))
    assert task.shape == (30, 4, 4)
    np.testing.assert_allclose(task[:, :3, 3].max(axis=0), -task[:, :3, 3].min(axis=0))


@pytest.mark.parametrize(
    ('arguments', 'text'),
    [
        (('--joint-box', 0, 1), '--joint-box: give 6 lower and 6 upper values, not 2'),
        (('--joint-box', *[1.0] * 6, *[-1.0] * 6), '--joint-box: give all lower values first'),
        (('--poses', 1), '--poses must be at least 100'),
        (('--task', 'missing.csv'), 'cannot read missing.csv'),
        (('--task', 'x.csv', '--joint-box', 0), 'either --task or --joint-box'),
    ],
)
def test_workspace_refuses_what_makes_no_sense(run, folder, tmp_path, arguments, text):
    status, out, err = run(folder, '--chain', 'ur10e', '--out', 'map', *arguments)
    assert (status, out) == (1, '')
    assert text in err
    assert not (tmp_path / 'map').exists()


def test_a_program_that_the_calibration_does_not_know_is_told(rng):
    """Positions of a target on the last axis tell next to nothing of the flange's orientation."""
    true = replace(
        simulation.faulty(UR, simulation.Cell(), rng),
        tool=Frame(transform(np.eye(3), np.array([0.0, 0.0, 0.1]))),
    )
    for oriented, known in ((True, True), (False, False)):
        seen = simulation.measure(true, UR.random_joints(60, rng), rng, 5e-5, 2e-4, oriented)
        arm = Calibration.of(identify(Problem(UR, seen)))
        words, warning = arm.knowledge(UR.random_joints(5, rng), np.full(5, 1e-3))
        assert words.startswith('sigma of the calibration at these poses: 0.')
        assert ('does not know the orientation' in warning) is not known
    alone = replace(arm, names=(), covariance=None)
    assert alone.knowledge(UR.random_joints(5, rng), np.full(5, 1e-3)) == ('', '')
