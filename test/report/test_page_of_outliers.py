# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
from measured import TEST, TRAIN, UR, measured
from pages import page_of, problem_of, report_of

from calib_ros import Problem, identify
from calib_ros.report.gathered import poses_of


def test_distances_and_outliers_have_pages():
    rows = measured(count=80)
    far = np.linalg.norm(rows.positions - [1.0, 1.0, 0.5], axis=1)
    wire = replace(rows.at(rows.stamps_ns + 7), distances=far, base='base_wire')
    wire = replace(wire, oriented=np.zeros(80, bool))
    shifted = rows.positions.copy()
    shifted[7] += 0.02
    problem = Problem(UR, replace(rows, positions=shifted), more=(wire,))
    result = identify(problem)
    poses = poses_of(result)
    assert len(poses) == 160
    assert poses.outlier.sum() == len(result.outliers) > 0
    page = page_of(report_of(problem, result))
    assert 'Outliers: ' in page.text
    assert 'touched planes are along one direction' in page.text
    assert '160 poses, 1 of them an outlier with little or no weight' in page.text
    assert poses.source(int(np.flatnonzero(poses.outlier)[0])) in page.text


def test_outliers_held_out_are_listed_too(unsearched):
    """They have no weight to lose; the table had those of the fit only."""
    problem = problem_of()
    problem.judging[0].positions[3] += 0.02
    for fitted in (False, True):
        if fitted:
            problem.sets[0].positions[7] += 0.03
        report = report_of(problem, identify(problem))
        (table,) = (each for each in report.sections if each.name == 'outliers')
        assert table.title == f'Outliers: {1 + fitted} of {TRAIN + TEST} poses'
        assert [row[1] for row in table.rows][fitted:] == ['held out']
        assert table.head[1] == 'residual/typical error'  # along one axis: a usual pose has 1.5
        assert [float(row[2]) > 10.0 for row in table.rows] == [True] * (1 + fitted)
