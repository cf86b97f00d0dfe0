# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What figures show, from values that are known."""

from dataclasses import replace

import numpy as np
import pytest
from measured import TRUE
from pages import page_of, problem_of, report_of
from plotly import graph_objects

from calib_ros import Observations, Settings, identify, load_chain
from calib_ros.apply.camera import Camera, before_camera, photograph
from calib_ros.decision.comparison import GroupVerdict, compare
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Frame
from calib_ros.report.drawing import drawing
from calib_ros.report.figures import against_noise, cumulated, drives, forest, histogram
from calib_ros.report.gathered import poses_to_verify

UR10E = load_chain('ur10e')
WAVES = tuple(f'shoulder_lift_joint.{wave}_17' for wave in ('sin', 'cos'))


def test_errors_of_drives_are_shown_where_they_were_measured(rng):
    values = {WAVES[0]: 3e-4, 'elbow_joint.cos_1': -2e-4, 'elbow_joint.sin_1': 1e-4}
    arm = UR10E.with_effect_values(values)
    q = rng.uniform(-1.0, 1.0, (50, 6))
    q[:, 2] -= 2.0
    figure = drives(arm, q)
    mesh = figure['data'][0]
    assert mesh['y'] == ['shoulder_lift_joint', 'elbow_joint']
    at = np.radians(mesh['x'])
    wanted = [0.3 * np.sin(17 * at), 0.1 * np.sin(at) - 0.2 * np.cos(at)]
    for row, joint, right in zip(mesh['z'], (1, 2), wanted, strict=True):
        found = np.array(row, dtype=float)
        seen = (at >= q[:, joint].min()) & (at <= q[:, joint].max())
        assert 100 < seen.sum() < len(at)
        assert np.isnan(found[~seen]).all()
        assert found[seen] == pytest.approx(right[seen], abs=2e-3)
    graph_objects.Figure(figure)
    assert drawing(figure, 200)


def test_an_arm_without_such_errors_has_no_such_figure(rng):
    arm = UR10E.with_effect_values({'elbow_joint.ratio': 1e-4})
    assert drives(arm, rng.uniform(-1.0, 1.0, (9, 6))) is None


def seen_as(kind, rng, count=400):
    """Return a true arm and what is measured of it, with the noise stated of its kind."""
    true = TRUE.with_frame('base', Frame())  # its axes are those of the device
    joints = true.random_joints(count, rng)
    reached = true.forward(joints)
    places, noise = reached[:, :3, 3], rng.normal(size=(count, 6))
    if kind == 'a wire':
        lengths = np.linalg.norm(places, axis=1) + Settings.sigma_position * noise[:, 0]
        return true, replace(Observations.from_arrays(joints, places), distances=lengths)
    if kind == 'a camera':
        points = np.array([(0.03 * i, 0.03 * j, 0.0) for j in range(4) for i in range(6)])
        true = before_camera(true, Camera(), points, True, rng)
        return true, photograph(true, Camera(), points, True, 20, rng, Settings.sigma_pixel)
    root = np.diag([2e-5, 3e-5, 4e-4, 1e-4, 2e-4, 5e-4])
    root[2, 0], root[4, 3] = 2e-4, 1e-4
    error = noise @ root.T
    turned = se3.exp_rotation(error[:, 3:]) @ reached[:, :3, :3]
    seen = Observations.from_arrays(joints, places + error[:, :3], turned)
    return true, replace(seen, covariance=np.tile(root @ root.T, (count, 1, 1)))


@pytest.mark.parametrize('kind', ['a wire', 'a camera', 'a device with covariances'])
def test_noise_as_stated_is_on_the_line(rng, kind):
    true, seen = seen_as(kind, rng)
    poses = poses_to_verify(true, [seen], compare(true, true, [seen]))
    *drawn, _ = against_noise(poses)['data']
    assert [each['name'] for each in drawn] == ['position', 'orientation'][: len(drawn)]
    assert len(drawn) == (2 if seen.oriented.any() else 1)
    for each in drawn:
        inner = np.abs(each['x']) < 2.0
        expected, found = np.array(each['x'])[inner], np.array(each['y'])[inner]
        assert found == pytest.approx(expected, abs=0.25)
        assert np.polyfit(expected, found, 1)[0] == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(('shown', 'across'), [(True, '0.469'), (False, '0.200')])
def test_what_joints_do_beyond_the_model_is_told_in_all(solved, shown, across):
    """Waves that do not show are assumed."""
    problem, result = solved
    sizes = {'turns': 1e-4, 'tilts': 2e-4, 'waves': 3e-4}
    lacking = result.posterior.unmodelled._replace(**sizes, shown=shown)
    found = replace(result, posterior=replace(result.posterior, unmodelled=lacking))
    said = f'by 0.100 mrad in their values and {across} mrad across their axes'
    assert said in page_of(report_of(problem, found)).text


def test_effects_are_compared_by_changes_in_their_order():
    verdicts = (
        GroupVerdict('ratio', 0.3, 0.3003, pays=False),
        GroupVerdict('eccentricity', 0.4, 0.3, pays=True),
        GroupVerdict('gravity', 0.5, 0.4, pays=True),
    )
    problem = problem_of()
    page = page_of(report_of(problem, replace(identify(problem), verdicts=verdicts)))
    words = ' '.join(page.text.split())
    assert 'gravity -20.0 % yes eccentricity -25.0 % yes ratio +0.1 % no' in words


def test_harmonics_of_gears_are_drawn_and_counted_but_not_listed():
    problem = problem_of(effects=('eccentricity', *WAVES))
    page = page_of(report_of(problem, identify(problem)))
    assert 'drives' in page.data['figures']
    assert 'Drive errors' in page.text
    assert 'the 2 harmonics of gears are in result.json.' in page.text
    assert WAVES[0] not in page.text
    assert 'elbow_joint.sin_1' in page.text


def test_joints_without_limits_are_not_given_any(rng):
    free = replace(UR10E.joints[0], lower=None, upper=None)
    chain = replace(UR10E, joints=(free, *UR10E.joints[1:]))
    joints = chain.random_joints(50, rng)
    figure, rows = histogram(chain, joints)
    assert figure['data'][0]['x'] == pytest.approx(100.0 * np.arange(1, 72, 2) / 72, rel=1e-3)
    assert [row[1] for row in rows[:2]] == ['-180 to 180° (no limits)', '-360 to 360°']
    joints[:, 0] += 2.0  # a turn from where it was measured, not what is between both ranges
    low = np.degrees(joints[:, 0].min())
    assert histogram(chain, joints)[1][0][1] == f'{low:.0f} to {low + 360.0:.0f}° (no limits)'
    joints[:, 0] -= joints[:, 0].min() + 1e-3
    joints[1, 0] = 6.0
    assert histogram(chain, joints)[1][0][1] == '0 to 360° (no limits)'  # not -0


@pytest.mark.parametrize('count', [1, 5, 30, 3001])
def test_the_share_of_poses_within_an_error_is_counted(rng, count):
    before, after = rng.gamma(3.0, size=(2, count))
    figure = cumulated(before, after, 'poses')
    for curve, errors in zip(figure['data'], (before, after), strict=True):
        assert curve['y'][0] == 0.0
        assert curve['y'][-1] == 100.0
        assert curve['line']['shape'] == 'hv'
        for x, y in zip(curve['x'][1:], curve['y'][1:], strict=True):
            within = errors <= x * (1.0 + 1e-4)  # digits shown
            assert y == pytest.approx(100.0 * within.mean(), abs=0.1)
    assert figure['layout']['xaxis']['range'][1] > max(before.max(), after.max())  # not cut
    assert drawing(figure, 200)


@pytest.mark.parametrize(('limit', 'near'), [(1e-3, True), (1.0, False)])
def test_offsets_have_their_intervals_and_a_limit_that_is_near(solved, limit, near):
    arm = [p for p in solved[1].parameters if not UR10E.owns_frame(p.name)]
    lengths = [p for p in arm if p.std is not None and p.name.is_length]
    figure = forest(arm, True, limit)
    (dots,) = figure['data']
    assert dots['x'] == pytest.approx([1e3 * p.offset for p in lengths], rel=1e-3, abs=1e-4)
    widths = [1e3 * p.half_width() for p in lengths]
    assert dots['error_x']['array'] == pytest.approx(widths, rel=1e-3, abs=1e-4)
    shown = [each['x0'] for each in figure['layout']['shapes']]
    assert shown == [0.0, *([-1e3 * limit, 1e3 * limit] if near else [])]
    assert figure['layout']['xaxis']['title']['text'] == 'offset [mm]'
    reach = figure['layout']['xaxis']['range'][1]
    assert max(map(abs, shown)) < reach < 10.0
