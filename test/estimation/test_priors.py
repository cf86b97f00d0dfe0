# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Priors: tolerances of manufacture where poses are few."""

from dataclasses import replace

import numpy as np
import pytest
from fits import SIGMAS, UR10E, measured_arm, rms

from calib_ros.apply.simulation import Cell
from calib_ros.errors import ConfigError, TooFewObservationsError, UnknownNameError
from calib_ros.estimation.evidence import Inference
from calib_ros.estimation.fitting import fit
from calib_ros.estimation.identifiability import structurally_independent
from calib_ros.estimation.joint_errors import NOTHING
from calib_ros.estimation.problem import Problem
from calib_ros.identification.identification import identify
from calib_ros.kinematics.parameter import Parameter
from calib_ros.report.words import summary


def manufacture(scale=1.0):
    """Return the tolerances by which `faulty` makes arms, for what is no gauge freedom."""
    cell = Cell()
    names = structurally_independent(UR10E, UR10E.parameter_names)
    return {
        name: scale * (cell.length_error if Parameter(name).is_length else cell.angle_error)
        for name in names
        if not name.startswith(('base', 'tool'))
    }


def test_priors_allow_fewer_poses_than_parameters():
    """Four poses have 24 equations for 30 parameters."""
    errors = []
    for seed in range(4):
        rng, true, seen = measured_arm(seed, 4)
        with pytest.raises(TooFewObservationsError):
            identify(Problem(UR10E, seen, **SIGMAS))
        result = identify(Problem(UR10E, seen, priors=manufacture(), **SIGMAS))
        assert result.rank == 30
        unseen = UR10E.random_joints(300, rng)
        errors.append([rms(chain, true, unseen) for chain in (result.before, result.chain)])
    before, after = np.median(errors, axis=0)
    assert after < 0.6 * before


def test_a_prior_on_a_gauge_makes_it_fitted_with_its_own_deviation(rng):
    *_, seen = measured_arm(rng, 60)
    plain = identify(Problem(UR10E, seen, **SIGMAS))
    result = identify(Problem(UR10E, seen, priors={'wrist_3_joint.d': 1e-3}, **SIGMAS))
    row = {p.name: p for p in result.parameters}['wrist_3_joint.d']
    assert 'wrist_3_joint.d' in plain.unidentifiable
    assert row.status == 'fitted'
    assert row.std == pytest.approx(1e-3, rel=1e-3)
    assert row.offset == pytest.approx(0.0, abs=1e-6)
    assert result.rank == plain.rank + 1
    assert 'wrist_3_joint.d' not in result.gauges
    # the poses do not know of it: predictions and their uncertainty stay as they are, but for the
    # size of the noise, which is the median over one parameter more
    unseen = UR10E.random_joints(50, rng)
    np.testing.assert_allclose(
        result.chain.forward(unseen), plain.chain.forward(unseen), rtol=0, atol=1e-8
    )
    sizes = [(each.noise.size / each.noise.position) ** 2 for each in (result, plain)]
    assert sizes[0] == pytest.approx(sizes[1], rel=1e-3)
    certain = [replace(each.posterior, unmodelled=NOTHING) for each in (result, plain)]
    np.testing.assert_allclose(
        certain[0].expected(unseen) / result.noise.size**2,
        certain[1].expected(unseen) / plain.noise.size**2,
        rtol=0,
        atol=1e-13,
    )


def test_the_posterior_of_given_priors_is_that_of_bayes(rng):
    """With noise twice that of the sigmas given."""
    *_, seen = measured_arm(rng, 20)
    fitted = fit(Problem(UR10E, seen, priors=manufacture(), **SIGMAS))
    found = Inference(fitted, 2.0).likeliest()
    assert found.priors == pytest.approx(manufacture())
    precision = [found.priors.get(name, np.inf) ** -2 for name in fitted.names]
    measured = fitted.products[:-1, :-1] / 4.0
    wanted = np.linalg.inv(measured + np.diag(precision))
    np.testing.assert_allclose(found.covariance, wanted, rtol=1e-5, atol=1e-14)


def test_priors_are_off_by_default_and_told_when_on(rng):
    *_, seen = measured_arm(rng, 40)
    without = identify(Problem(UR10E, seen, **SIGMAS))
    assert without.priors == {}
    assert 'prior' not in summary(without)
    priors = {'elbow_joint.a': 1e-5, '*_joint.a': 1e-3}
    result = identify(Problem(UR10E, seen, priors=priors, **SIGMAS))
    assert result.priors == {
        f'{name}.a': 1e-5 if name == 'elbow_joint' else 1e-3 for name in UR10E.joint_names
    }
    assert 'priors on 6 parameters' in summary(result)


def test_a_pattern_may_hold_what_only_other_arms_have(rng):
    """No row of this arm has a shift b; a name of no arm at all is a slip of the pen."""
    *_, seen = measured_arm(rng, 30)
    held = Problem(UR10E, seen, fixed=('*.b', '*.beta'), priors={'*.b': 1e-3})
    assert held.free == Problem(UR10E, seen, fixed=('*.beta',)).free
    for slip in ('*.betta', 'elbow.b'):
        with pytest.raises(UnknownNameError, match='unknown parameter'):
            Problem(UR10E, seen, fixed=(slip,))


@pytest.mark.parametrize('pattern', ['base.*', '*.rx', 'b*', 'tool.z'])
def test_no_pattern_holds_a_part_of_a_frame(pattern, rng):
    """It would stay where the start put it; a prior on all parameters passes frames by."""
    *_, seen = measured_arm(rng, 30)
    with pytest.raises(ConfigError, match='a frame is known or unknown as a whole'):
        Problem(UR10E, seen, fixed=(pattern,))
    assert set(Problem(UR10E, seen, priors={'*': 1e-3}).given) == {
        name for name in Problem(UR10E, seen).free if not UR10E.owns_frame(name)
    }


def test_sigmas_that_are_too_large_do_not_hold_few_poses_near_nominal():
    """Least squares of six poses leaves 6 of 36 equations to tell the noise by."""
    errors = []
    for seed in range(8):
        rng, true, seen = measured_arm(seed, 6)
        unseen = UR10E.random_joints(100, rng)
        told = [{name: times * sigma for name, sigma in SIGMAS.items()} for times in (1.0, 5.0)]
        errors.append([rms(fit(Problem(UR10E, seen, **s)).chain, true, unseen) for s in told])
    known, coarse = np.sqrt(np.mean(np.square(errors), axis=0))
    assert coarse < 1.15 * known
