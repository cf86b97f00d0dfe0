# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a result tells of the errors that are left."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E, arm, measured_arm
from scipy import stats

from calib_ros import Problem, identify
from calib_ros.apply.simulation import measure
from calib_ros.decision.risk import _Judge, region_of


@pytest.mark.parametrize('level', [0.5, 0.95])
def test_ellipsoids_are_those_of_f_or_of_its_limit(level, unsearched):
    found = identify(Problem(UR10E, measured_arm(0, 30)[2]))
    posterior = replace(found.posterior, shift=np.zeros_like(found.posterior.shift))
    q = UR10E.random_joints(20, np.random.default_rng(1))
    sizes = 3.0 * stats.f.ppf(level, 3, 5), stats.chi2.ppf(level, 3)
    for freedom, size in zip((5.0, np.inf), sizes, strict=True):
        noise = SimpleNamespace(
            parts=found.uncertainty.parts,
            freedom_of=lambda shares, freedom=freedom: np.full(shares.shape[1:], freedom),
        )
        result = replace(found, posterior=posterior, uncertainty=noise)
        axes = result.confidence_ellipsoid(q, level)
        squares = size * result.pose_covariance(q)[:, :3, :3]
        np.testing.assert_allclose(np.swapaxes(axes, 1, 2) @ axes, squares, rtol=1e-6, atol=1e-15)


def test_a_calibration_that_changes_nothing_may_be_used_nowhere(unsearched):
    seen = measured_arm(0, 30)[2]
    posterior = identify(Problem(UR10E, seen)).posterior
    assert region_of(posterior, [seen], np.inf, np.inf)
    assert region_of(posterior, [seen], 2.0, np.inf) is None  # with noise that is hardly known
    none = replace(posterior, offsets=np.zeros_like(posterior.offsets))
    assert region_of(none, [seen], np.inf, np.inf) is None


def test_a_few_poses_do_not_end_the_region(unsearched):
    """The last two of 200 were judged by themselves: near the measured poses, in 99 %."""
    rng = np.random.default_rng(21)
    seen = measure(arm(0), UR10E.random_joints(60, rng), rng, *NOISE)
    assert identify(Problem(UR10E, seen, **SIGMAS)).region.whole


def test_the_risk_is_that_of_each_plausible_arm_in_the_best_frames(rng):
    """By Student's t of the share of a correction that the arm lacks, less one half."""
    judge = _Judge.__new__(_Judge)
    judge._placed, judge._offsets = 1, np.array([1.0, -0.5])
    columns, few = rng.normal(size=(3, 40)), np.s_[:, :10]
    around, which = (each @ each.T for each in (columns, columns[few]))
    frame, arm = columns[0], columns[1:]
    own = arm - np.outer(arm @ frame / (frame @ frame), frame)
    slope = own[few] @ own[few].T @ judge._offsets
    assert judge.correction(around) == pytest.approx(np.linalg.norm(judge._offsets @ own))
    means, roots = np.array([[0.8, -0.3], [0.2, -0.2]]), 0.2 * rng.normal(size=(2, 2, 2))
    spreads = np.linalg.norm(np.swapaxes(roots, 1, 2) @ slope, axis=1)
    margins = means @ slope - 0.5 * judge._offsets @ slope
    assert margins[0] > 0.0 > margins[1]
    for freedom, chance in ((5.0, stats.t(5)), (np.inf, stats.norm)):
        judge._freedom = freedom
        mixture = np.array([0.7, 0.3]), means, roots @ np.swapaxes(roots, 1, 2)
        wanted = np.array([0.7, 0.3]) @ chance.cdf(-margins / spreads)
        assert judge.risk(which, around, mixture) == pytest.approx(wanted, rel=1e-6)
        assert judge.risk(which, around, (*mixture[:2], np.zeros((2, 2, 2)))) == 0.3
