# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What figures show, from values that are known."""

from dataclasses import replace

import numpy as np
import pytest
from pages import page_of, problem_of, report_of
from plotly import graph_objects

from calib_ros.identification.identification import identify
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.effects import Verdict
from calib_ros.report.figures import drives
from calib_ros.report.plots import drawing

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


def test_effects_are_compared_by_changes_in_their_order():
    verdicts = (
        Verdict('ratio', 0.3, 0.3003, pays=False),
        Verdict('eccentricity', 0.4, 0.3, pays=True),
        Verdict('gravity', 0.5, 0.4, pays=True),
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
