# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Points of a board in images, as measurements of the arm."""

import json
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fits import rms
from measured import rows_of, write_csv, write_images

from calib_ros import Observations, Problem, identify, load_chain
from calib_ros.apply.camera import Camera, before_camera, photograph
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.decision.mistakes import diagnose
from calib_ros.decision.rounding import lost_digits
from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.normal import products_of
from calib_ros.estimation.pixels import PixelSamples, seen_residuals
from calib_ros.estimation.resection import _from_homography, board_poses, resect
from calib_ros.estimation.system import System, stacked
from calib_ros.identification import identification
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.parameter import Parameter

UR = load_chain('ur5e')
POINTS = np.array([(0.04 * i, 0.04 * j, 0.0) for j in range(4) for i in range(6)])
SIGMA = 0.3
CAMERA = Camera()
JOINTS = UR.random_joints(200, np.random.default_rng(5))


@cache
def scene(seed, on_flange, count=30, noise=SIGMA, exact=False):
    """Return the true chain, and images of the board."""
    rng = np.random.default_rng(seed)
    arm = UR if exact else faulty(UR, Cell(), rng)
    true = before_camera(arm, CAMERA, POINTS, on_flange, rng)
    return true, photograph(true, CAMERA, POINTS, on_flange, count, rng, noise)


def known(on_flange, lens=CAMERA.lens):
    return replace(UR, **{'tool' if on_flange else 'base': Frame(lens=lens)})


@pytest.mark.parametrize(('seed', 'on_flange'), [(1, True), (6, False)])
def test_the_jacobian_is_that_of_differences(on_flange, seed):
    true, seen = scene(seed, on_flange, 3)
    chain = true.with_effects(['elbow_joint.sin_1'])
    names = list(chain.parameter_names)
    weights = np.random.default_rng(seed).uniform(0.1, 1.0, len(seen))
    rows = PixelSamples(seen, 0.5).weighted(weights**2).rows_of(chain, names).T
    weights = weights[:, np.newaxis]
    for k, name in enumerate(names):
        step = 1e-4 if Parameter(name).kind in ('fx', 'fy', 'cx', 'cy') else 1e-6
        more, less = (
            seen_residuals(chain.with_offsets({name: s * step}), seen)[0] for s in (1.0, -1.0)
        )
        change = weights * (less - more) / (2.0 * step * 0.5)
        scale = np.abs(change).max() + 1.0
        np.testing.assert_allclose(rows[..., k], change, atol=1e-6 * scale, err_msg=name)
    residual = weights * seen_residuals(chain, seen)[0] / 0.5
    np.testing.assert_allclose(rows[..., -1], residual, atol=1e-12)


@pytest.mark.parametrize('on_flange', [True, False])
def test_images_between_two_held_frames_are_identified(on_flange):
    true, seen = scene(1, on_flange)
    held = {end: replace(true.frame(end), fixed=True) for end in ('base', 'tool')}
    result = identify(Problem(replace(UR, **held), seen))
    assert result.accepted
    assert not any(true.owns_frame(name) for name in result.names)


@pytest.mark.parametrize('on_flange', [True, False])
def test_products_are_those_of_the_rows(on_flange):
    true, seen = scene(1, on_flange, 5)
    seen = seen.select((np.arange(len(seen)) % 7 != 0) & (np.arange(len(seen)) < 3 * 24 + 2))
    names = true.parameter_names
    folds = np.array([0, 1, 1, 0])[seen.images]
    system = System((PixelSamples(seen, SIGMA),))
    found = products_of(true, names, system, [folds]).sum(axis=1)
    rows = system.sets[0].rows_of(true, names)
    for k, products in enumerate(found):
        few = stacked([rows[..., folds == k]])
        scale = np.sqrt(np.maximum((few**2).sum(axis=0), 1.0))
        both = np.outer(scale, scale)
        np.testing.assert_allclose(products / both, few.T @ few / both, atol=1e-12)
    sums = np.concatenate([each for _, (each,) in system.sets[0].sums(true, names, seen.images)])
    exact = np.add.reduceat(rows, np.flatnonzero(np.diff(seen.images, prepend=-1)), axis=2)
    np.testing.assert_allclose(sums, exact, atol=1e-9 * np.abs(exact).max())
    assert not PixelSamples(seen.select(slice(0)), SIGMA).rows_of(true, names).size  # crashed


@pytest.mark.parametrize(('seed', 'on_flange'), [(0, True), (5, False), (6, True), (7, False)])
def test_an_image_tells_the_pose_of_a_board(seed, on_flange):
    true, seen = scene(seed, on_flange, 4, noise=0.0, exact=True)
    poses = board_poses(seen, CAMERA.lens)
    exact = true.forward(poses.joints)
    np.testing.assert_allclose(poses.positions, exact[:, :3, 3], atol=1e-7)
    np.testing.assert_allclose(poses.rotations, exact[:, :3, :3], atol=1e-7)


def test_of_exact_images_the_homography_alone_is_the_pose():
    _, seen = scene(3, False, 4, noise=0.0, exact=True)
    lens = CAMERA.lens
    found = _from_homography(seen.points[:, :2], lens.rays(seen.pixels), seen.images)
    np.testing.assert_allclose(found, resect(seen, lens)[0], atol=1e-6)


def test_images_that_tell_no_pose_are_left_out():
    _, seen = scene(3, False, 4, noise=0.0, exact=True)
    index, corner = np.divmod(np.arange(len(seen)), len(POINTS))
    line = (index == 1) & (corner // 6 != 1)
    few = (index == 2) & (corner >= 3)
    poses = board_poses(seen.select(~(line | few)), CAMERA.lens)
    first = np.flatnonzero(corner == 0)[[0, 3]]
    np.testing.assert_array_equal(poses.joints, seen.joints[first])
    with pytest.raises(InputError, match='no image shows 4 board points'):
        board_poses(seen.select((index == 1) & ~line), CAMERA.lens)
    bent = replace(seen, points=seen.points + np.array([0.0, 0.0, 0.02]) * (corner % 2)[:, None])
    with pytest.raises(InputError, match='must be in a plane'):
        resect(bent, CAMERA.lens)


def test_a_camera_out_of_reach_is_refused():
    true, _ = scene(1, False)
    away = replace(true, base=replace(true.base, matrix=true.base.matrix + 5.0 * np.eye(4, k=3)))
    with pytest.raises(InputError, match='reaches 0, expected 2: place the camera elsewhere'):
        photograph(away, CAMERA, POINTS, False, 2, np.random.default_rng(0), tries=6)


@pytest.mark.parametrize('on_flange', [True, False])
def test_the_arm_is_found_by_pixels(on_flange):
    true, seen = scene(1, on_flange)
    result = identify(Problem(known(on_flange), seen, sigma_pixel=SIGMA))
    assert result.accepted, result.refusals
    assert result.rank == 30
    assert result.gauges['wrist_3_joint.d']
    before, after = result.validation.figures
    assert after.rms_px == pytest.approx(SIGMA * np.sqrt(2.0), rel=0.1)
    assert after.rms_mm < 0.3 < before.rms_mm
    assert rms(result.chain, true, JOINTS) < 0.3 * rms(result.before, true, JOINTS)
    off = [result.chain.offset(name, true) for name in result.names]
    size = np.abs(off) / np.sqrt(np.diag(result.covariance))
    assert np.median(size) < 1.5
    assert size.max() < 5.0
    assert result.chain.frame('tool' if on_flange else 'base').lens == CAMERA.lens


@pytest.mark.parametrize('on_flange', [True, False])
def test_a_lens_is_fitted_with_the_arm(on_flange):
    true, seen = scene(6, on_flange, 40)
    wrong = replace(CAMERA.lens.moved({'fx': 8.0, 'fy': -6.0, 'cx': 5.0, 'k1': 0.02}), fixed=False)
    result = identify(Problem(known(on_flange, wrong), seen, sigma_pixel=SIGMA))
    assert result.accepted, result.refusals
    assert result.rank == 39
    rows = {p.name.kind: p for p in result.parameters if p.name.count('.f')}
    for p in rows.values():
        exact = getattr(CAMERA.lens, p.name.kind)
        assert abs(p.value - exact) < 4.0 * p.std
    given = identify(Problem(known(on_flange, replace(wrong, fixed=True)), seen, loss='none'))
    assert rms(result.chain, true, JOINTS) < rms(given.chain, true, JOINTS)


@pytest.mark.parametrize('on_flange', [True, False])
def test_a_board_of_another_size_than_stated_does_not_make_the_arm_larger(on_flange):
    _, seen = scene(4, on_flange, 15)
    larger = replace(seen, points=1.01 * seen.points)
    assert not identify(Problem(known(on_flange), larger, sigma_pixel=SIGMA)).accepted
    assert identify(Problem(known(on_flange), seen, sigma_pixel=SIGMA)).accepted


def test_a_prior_holds_a_lens():
    _, seen = scene(2, False, 12)
    wrong = replace(CAMERA.lens.moved({'fx': 8.0}), fixed=False)
    held = identify(
        Problem(known(False, wrong), seen, sigma_pixel=SIGMA, priors={'base.f?': 1e-3})
    )
    assert held.priors == {'base.fx': 1e-3, 'base.fy': 1e-3}
    assert held.chain.value('base.fx') == pytest.approx(wrong.fx, abs=0.1)
    places = ('base.x', 'base.*', '*.z')
    for held_so in ({'priors': {'base.x': 1.0}}, *({'fixed': (p,)} for p in places)):
        with pytest.raises(ConfigError, match='a frame is known or unknown as a whole'):
            Problem(known(False), seen, **held_so)


def test_gross_errors_of_corners_and_images_are_named(rng, unsearched):
    true, seen = scene(4, True)
    pixels = seen.pixels.copy()
    corners = rng.choice(len(seen), 20, replace=False)
    pixels[corners] += rng.choice([-1.0, 1.0], (20, 2)) * rng.uniform(10.0, 200.0, (20, 2))
    image = seen.images == 7
    pixels[image] += 1.2  # below what names a corner, but all alike
    spoilt = replace(seen, pixels=pixels)
    result = identify(Problem(known(True), spoilt, sigma_pixel=SIGMA))
    named = {each.sample for each in result.outliers}
    assert named == set(corners) | set(np.flatnonzero(image))
    clean = identify(Problem(known(True), seen, sigma_pixel=SIGMA))
    assert not clean.outliers
    assert rms(result.chain, true, JOINTS) < 1.5 * rms(clean.chain, true, JOINTS)


@pytest.mark.parametrize(
    ('on_flange', 'named'),
    [
        (True, 'the camera or its lens moved by'),
        (False, "the camera, its lens or the robot's foot"),
    ],
)
def test_a_zoom_in_the_session_is_one_of_the_camera(on_flange, named):
    _, seen = scene(4, on_flange)
    late, centre = seen.images >= 15, np.array([CAMERA.lens.cx, CAMERA.lens.cy])
    pixels = centre + (seen.pixels - centre) * np.where(late, 1.005, 1.0)[:, np.newaxis]
    result = identify(Problem(known(on_flange), replace(seen, pixels=pixels), sigma_pixel=SIGMA))
    assert 'before image 16' in str(result.step)
    assert named in str(result.step)


def test_pixels_and_poses_in_one_fit(rng):
    true, seen = scene(5, False)
    seen = replace(seen, base='base_camera', tool='tool_board')
    true = replace(true, frames=(('base_camera', true.base), ('tool_board', true.tool)))
    tracked = replace(true, base=Frame(), tool=Frame())
    poses = measure(tracked, UR.random_joints(20, rng), rng, 5e-5, 2e-4)
    chain = UR.with_frame('base_camera', Frame(lens=CAMERA.lens))
    both = identify(Problem(chain, poses, more=[seen], sigma_pixel=SIGMA, sigma_position=5e-5))
    alone = identify(Problem(UR, poses, sigma_position=5e-5))
    assert both.accepted, both.refusals
    assert both.rank == 30 + 6 + 6
    assert rms(both.chain, tracked, JOINTS) < rms(alone.chain, tracked, JOINTS)


def test_whole_degrees_that_were_reached_are_no_lost_decimals_in_images():
    true, seen = scene(1, False, noise=1.0)  # half of it is a turn of any joint, by chance
    whole = replace(seen, joints=np.deg2rad(np.round(np.rad2deg(seen.joints))))
    moved = seen_residuals(true, seen)[0] - seen_residuals(true, whole)[0]
    assert not lost_digits(Problem(known(False), replace(whole, pixels=seen.pixels + moved)), true)


def test_held_out_images_judge_in_pixels_and_millimetres():
    _, seen = scene(6, True, 40)
    fitted = seen.images < 30
    result = identify(
        Problem(known(True), seen.select(fitted), held_out=seen.select(~fitted), sigma_pixel=SIGMA)
    )
    figures = result.validation.figures[1]
    assert figures.count == 10 * len(POINTS)
    assert figures.rms_px == pytest.approx(SIGMA * np.sqrt(2.0), rel=0.2)
    depth = CAMERA.depth / CAMERA.lens.fx
    assert figures.rms_mm == pytest.approx(1e3 * depth * figures.rms_px, rel=0.15)


def test_pixels_without_a_lens_are_refused():
    _, seen = scene(1, False, 3)
    with pytest.raises(InputError, match=r'need the intrinsics of their camera \(base\)'):
        Problem(UR, seen)
    with pytest.raises(InputError, match='pixels need the board points'):
        replace(seen, points=None)
    with pytest.raises(InputError, match='points need their pixels'):
        replace(seen, pixels=None)
    with pytest.raises(InputError, match='pixels of 72 observations'):
        Observations.from_pixels(seen.joints, seen.pixels[:, :1], seen.points, seen.images)


def test_corners_and_a_table_by_the_command_line(run, tmp_path, rng):
    """Corners of a board of 7 x 5 squares, alone and beside a tracker's poses."""
    true, seen = scene(5, True, 18)
    write_images(tmp_path, seen, CAMERA.lens, 0.04)
    tracked = replace(true, base=Frame(), tool=Frame())
    poses = measure(tracked, UR.random_joints(20, rng), rng, 5e-5, 2e-4)
    write_csv(tmp_path / 'poses.csv', rows_of(poses, 0))
    words = ('identify', '--detections', 'corners.csv', '--places', 'places.csv', '--json')
    words += ('--intrinsics', 'camera.yaml', '--eye-in-hand', '--chain')
    given = (*words, 'ur5e', '--board', 'board.yaml')
    status, out, _ = run(*given)
    alone = json.loads(out)
    assert (status, alone['rank']) == (0, 30)
    assert alone['samples'] == {'samples': 432, 'held_out': 0, 'sets': 1, 'images': 18}
    assert alone['validation']['after']['rms_px'] < 0.5
    status, out, _ = run(*given, '--csv', 'poses.csv', '--sigma-position', '5e-5')
    both = json.loads(out)
    assert (status, both['rank']) == (0, 42)
    assert both['samples'] == {'samples': 452, 'held_out': 0, 'sets': 2, 'images': 18}
    assert 'tool_camera.x' in both['parameters']
    for more, said in (
        (('ur5e',), 'needs --board'),
        (
            ('flange_pose', '--board', 'board.yaml'),
            'holds joint values: give the chain of the arm',
        ),
    ):
        status, _, err = run(*words, *more)
        assert status == 1
        assert said in err


MISTAKES = {
    'degrees': (lambda s: {'joints': np.degrees(s.joints)}, 'degrees, not radians: correct it in'),
    'sign': (lambda s: {'joints': s.joints * [1, 1, -1, 1, 1, 1]}, 'sign: -1 in the chain file'),
    'shift': (lambda s: {'joints': np.roll(s.joints, len(POINTS), axis=0)}, '1 row below'),
    'board': (lambda s: {'points': 1e3 * s.points}, 'give square and marker in metres'),
    'mirrored': (lambda s: {'pixels': [1600, 0] + s.pixels * [-1, 1]}, 'images are mirrored'),
    'mount': (lambda s: {'on_flange': not s.on_flange}, '--eye-in-hand'),
}


@pytest.mark.parametrize('on_flange', [True, False])
def test_where_nothing_is_wrong_nothing_is_said(on_flange):
    _, seen = scene(4, on_flange, 20)
    assert diagnose(Problem(known(on_flange), seen, sigma_pixel=SIGMA)) is None


@pytest.mark.parametrize(
    ('kind', 'on_flange'),
    [('mount', True), *((kind, k % 2 == 0) for k, kind in enumerate(MISTAKES))],
)
def test_the_usual_mistakes_are_named(kind, on_flange):
    change, words = MISTAKES[kind]
    _, seen = scene(4, on_flange, 20)
    wrong = replace(seen, **change(seen))
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        found = diagnose(Problem(known(wrong.on_flange), wrong, sigma_pixel=SIGMA))
    assert words in str(found)
    if kind in ('board', 'mirrored'):
        assert all(each.published == each.remedy for each in found.suspects)
    if kind == 'mount':
        assert ('leave out' in str(found)) == wrong.on_flange
        live = Problem(known(wrong.on_flange), wrong, sigma_pixel=SIGMA, of_messages=True)
        value = 'false' if wrong.on_flange else 'true'
        assert f'set eye_in_hand={value} in sources' in str(diagnose(live))


def test_the_mistake_comes_first_where_the_fit_does_not_end_well():
    change, words = MISTAKES['board']
    seen = scene(2, False)[1]
    wrong = replace(seen, **change(seen))
    result = identify(Problem(known(False), wrong, sigma_pixel=SIGMA))
    assert words in str(result.refusals[0])


def test_a_fit_that_runs_away_is_told_in_figures(unsearched):
    _, seen = scene(1, False)
    wrong = replace(seen, **MISTAKES['degrees'][0](seen))
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        result = identify(Problem(known(wrong.on_flange), wrong, sigma_pixel=SIGMA))
    assert not result.accepted
    for figures in (*result.validation.figures, *result.fitted.figures):
        assert figures.rms_px < 1.5e6
        assert figures.rms_mm < 2e9


def test_corners_of_another_board_are_named():
    _, seen = scene(4, True, 8)
    other = np.tile(
        POINTS[np.random.default_rng(0).permutation(len(POINTS))], (len(seen) // len(POINTS), 1)
    )
    with pytest.raises(InputError, match='do not fit the board in 8 of 8 images'):
        identify(Problem(known(True), replace(seen, points=other), sigma_pixel=SIGMA))


def test_corners_in_one_place_tell_no_pose():
    _, seen = scene(4, True)
    same = replace(seen, pixels=np.zeros_like(seen.pixels))
    with pytest.raises(InputError, match='not in line'):
        identify(Problem(known(True), same, sigma_pixel=SIGMA))


def test_a_fit_that_runs_away_ends_in_words(monkeypatch):
    def away(*_):
        raise np.linalg.LinAlgError('singular posterior')

    monkeypatch.setattr(identification, 'fit', away)
    _, seen = scene(5, True, 18)
    large = replace(seen, points=1e3 * seen.points)
    one, others = np.split(np.arange(len(seen)), [len(POINTS)])  # one image fits any
    for given, more, words in (
        (seen, (), 'no stable solution: check the arm'),
        (large, (), 'fit the arm: the board is stated 1000 times'),
        (large.select(one), (large.select(others),), 'of 17 poses alone, the board'),
    ):
        with pytest.raises(InputError, match=words):
            identify(Problem(known(True), given, more=more, sigma_pixel=SIGMA))


@pytest.mark.parametrize('on_flange', [True, False])
def test_expected_errors_include_those_of_a_given_lens(on_flange):
    """A focal length 0.3 % off moves positions by 2 mm; 0.2 mm were expected."""
    lens = CAMERA.lens.moved(dict.fromkeys(('fx', 'fy'), 3e-3 * CAMERA.lens.fx))
    for seed in (1, 6):
        true, seen = scene(seed, on_flange)
        result = identify(Problem(known(on_flange, lens), seen, sigma_pixel=SIGMA))
        q = seen.joints[:: len(POINTS)] + np.random.default_rng(seed).normal(0.0, 0.2, (30, 6))
        squares = np.trace(result.pose_covariance(q)[:, :3, :3], axis1=1, axis2=2)
        assert 0.5 < np.sqrt(squares.mean()) / rms(result.chain, true, q) < 2.0
