# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A device that stretches space in one direction is told, and its scale is not trusted."""

from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, SCARA, SIGMAS, UR10E, arm, measured_arm

from calib_ros import Observations, Problem, identify, load_chain
from calib_ros.apply.simulation import measure
from calib_ros.decision.reasons import Rule
from calib_ros.decision.strain import strain_of
from calib_ros.estimation.fitting import fit
from calib_ros.kinematics import effects, se3
from calib_ros.kinematics.chain import Chain, Frame, Joint
from calib_ros.kinematics.parameter import Parameter

TOLD = 'in one direction of the measuring device lengths come out 0.2'
SCALE = 2e-3 / 3.0
DOWN = {'alpha': 0.5 * np.pi, 'theta': 0.5 * np.pi}
GANTRY = Chain(
    'gantry',
    'standard',
    (
        *(Joint(k, 'prismatic', upper=far, **DOWN) for k, far in (('x', 2.0), ('y', 1.5))),
        Joint('z', 'prismatic', upper=0.8),
        Joint('c', alpha=0.5 * np.pi, d=0.1, lower=-2.5, upper=2.5),
        Joint('b', a=0.1, d=0.1, lower=-1.7, upper=1.7),
    ),
)


def stretched(seen, size, axis=2):
    positions = seen.positions.copy()
    positions[:, axis] *= 1.0 + size
    return replace(seen, positions=positions)


def session(name, seed, errors, size=2e-3, **more):
    chain = load_chain(name)
    _, _, seen = measured_arm(seed, 40, chain=chain, errors=errors, **more)
    return Problem(chain, stretched(seen, size), **SIGMAS)


@pytest.mark.parametrize(('name', 'seed', 'errors'), [('abb_irb120', 18, 0.1), ('ur10e', 13, 0.2)])
def test_a_strained_device_that_may_harm_is_refused(name, seed, errors):
    """Its scale is off by 0.07 %, more than the errors of the arm; these were accepted."""
    (refusal,) = identify(session(name, seed, errors)).refusals
    assert refusal.rule is Rule.SCALE
    assert refusal.startswith(TOLD)
    wrong = replace(session(name, seed, errors), sigma_scale=1e-5)  # along one direction
    assert any(TOLD in each for each in identify(wrong).refusals)


def test_a_strain_that_does_no_harm_is_a_remark():
    result = identify(session('abb_irb120', 0, 0.5))
    assert result.accepted
    (remark,) = result.remarks
    assert remark.startswith(TOLD)
    assert result.posterior.strain == pytest.approx(2e-3, rel=0.1)
    assert not identify(session('abb_irb120', 0, 0.5, 0.0)).remarks


@pytest.mark.parametrize(('oriented', 'own'), [(True, False), (False, False), (True, True)])
def test_strain_and_scale_of_the_device_are_told_apart_from_the_arm(oriented, own):
    problem = session('ur10e', 1, 1.0, oriented=oriented)
    if own:
        each = np.diag([2.5e-9] * 3 + [4e-8 * oriented] * 3)
        seen = replace(problem.observations, covariance=each * np.ones((40, 1, 1)))
        problem = replace(problem, observations=seen)
    text, share = strain_of(fit(problem))
    assert text.startswith(TOLD)
    assert 0.9 < share < 1.0
    found = identify(problem).posterior
    assert found.strain == pytest.approx(2e-3, rel=0.1)
    assert found.scale == pytest.approx(0.0, abs=2.0 * SCALE)


def test_a_wrong_focal_length_shows_in_the_poses_of_a_camera():
    """The depth is off; each pose has axes of its own."""
    rng, true, _ = measured_arm(2, 1)
    q = true.random_joints(40, rng)
    pose = np.linalg.inv(true.forward(q))  # of a fixed target before a camera on the flange
    places = pose[:, :3, 3] + rng.normal(scale=5e-5, size=(40, 3))
    seen = stretched(Observations.from_arrays(q, places, pose[:, :3, :3]), 2e-3).inverted()
    assert strain_of(fit(Problem(UR10E, seen, **SIGMAS)))[0].startswith(TOLD)


@pytest.mark.parametrize('seed', range(2))
def test_an_arm_that_bends_strains_nothing(seed):
    rng = np.random.default_rng(seed)
    for group, size in (('gravity', 1e-3), ('eccentricity', 5e-4)):
        values = {n: size * rng.normal() for n in effects.members(UR10E, group)}
        true = arm(seed).with_effect_values(values)
        q = true.random_joints(60, rng)
        pose = true.forward(q)
        seen = Observations.from_arrays(q, pose[:, :3, 3] + rng.normal(scale=5e-5, size=(60, 3)))
        fitted = fit(Problem(UR10E, seen, **SIGMAS))
        assert fitted.noise.position > 2.0
        assert strain_of(fitted) == ('', 0.0)


def test_of_several_devices_none_is_strained_alone():
    problem = session('ur10e', 1, 1.0)
    first, other = problem.observations.select(np.arange(20)), problem.observations
    other = replace(other.select(np.arange(20, 40)), base='base_lab')
    assert strain_of(fit(Problem(UR10E, first, more=[other], **SIGMAS))) == ('', 0.0)


@pytest.mark.parametrize('size', [0.0, 2e-3])
def test_a_linear_axis_out_of_scale_is_no_strain_of_the_device(size):
    """The tracker was to be calibrated: the rack of the axis is 0.05 % too long."""
    chain = load_chain('ur10e_on_linear_axis')
    rng = np.random.default_rng(1)
    true = arm(1, chain=chain).with_effect_values({Parameter('linear_axis_joint', 'ratio'): 5e-4})
    q = chain.random_joints(60, rng)
    places = true.forward(q)[:, :3, 3] + rng.normal(scale=5e-5, size=(60, 3))
    seen = stretched(Observations.from_arrays(q, places), size, axis=1)
    told = strain_of(fit(Problem(chain, seen, **SIGMAS)))[0]
    assert told.startswith(TOLD) if size else told == ''


def test_noise_larger_across_the_line_of_sight_is_no_strain_of_the_device():
    """Linear joints alone imitate any strain, and that of the noise itself, 220 %, was told."""
    axes = Chain('gantry', 'standard', GANTRY.joints[:3])
    rng = np.random.default_rng(0)
    q = axes.random_joints(60, rng)
    seen = arm(0, chain=axes).forward(q)[:, :3, 3] + rng.normal(size=(60, 3)) * [1e-5, 5e-5, 5e-5]
    problem = Problem(axes, Observations.from_arrays(q, seen), sigma_position=1e-4)
    assert strain_of(fit(problem)) == ('', 0.0)


def test_what_a_coupled_quill_leaves_is_no_strain():
    """Lengths were said to come out 140 % longer in one direction than in another."""
    rng = np.random.default_rng(0)
    true, q = arm(rng, chain=SCARA), SCARA.random_joints(40, rng)
    true = true.with_effect_values({'quill.coupling_spindle': 1e-3})
    result = identify(Problem(SCARA, measure(true, q, rng, *NOISE), **SIGMAS))
    assert result.coupled
    assert not any(each.rule is Rule.SCALE for each in result.refusals)


@pytest.mark.parametrize(('seed', 'size'), [(0, 2e-3), (1, 2e-3), (2, 2e-3), (3, 0.0)])
def test_linear_joints_do_not_hide_that_a_strained_device_may_harm(seed, size):
    """It was accepted and made the gantry worse; a pitch that is off was refused."""
    rng, true = np.random.default_rng(seed), arm(seed, 0.3, GANTRY)
    true = true.with_effect_values({Parameter('x', 'ratio'): 0.0 if size else 1e-3})
    seen = measure(true, GANTRY.random_joints(60, rng), rng, *NOISE)
    result = identify(Problem(GANTRY, stretched(seen, size, axis=0), **SIGMAS))
    assert result.accepted != bool(size)
    for refusal in result.refusals:
        assert refusal.rule is Rule.SCALE
        assert refusal.startswith((TOLD[:-3], 'lengths come out 0.'))
        assert 'one direction' in refusal


@pytest.mark.parametrize(
    ('seed', 'scale', 'said'),
    [
        (0, 1.002, 'grow alike, by 0.2'),
        (5, 1.002, 'grow alike, by 0.2'),
        (3, 0.97, 'shrink alike, by 3 %'),
    ],
)
def test_linear_joints_do_not_hide_a_scale_alike_in_all_directions(seed, scale, said):
    """Strains near zero contradicted it: these SCARAs were accepted and got worse."""
    rng, true = np.random.default_rng(seed), arm(seed, chain=SCARA)
    seen = measure(true, SCARA.random_joints(50, rng), rng, *NOISE)
    seen = replace(seen, positions=scale * seen.positions)
    (refusal,) = identify(Problem(SCARA, seen, **SIGMAS)).refusals
    assert refusal.rule is Rule.SCALE
    assert refusal.startswith(f'all lengths of the arm {said}')


@pytest.mark.parametrize(('seed', 'scale'), [(0, 1.0), (1, 1.0), (0, 1.002), (1, 0.998)])
def test_fitted_pitches_of_linear_joints_alone_may_be_the_scale_of_the_device(seed, scale):
    """Nothing else was left to consider, and so the device was not: 0.1 mm became 2 mm."""
    axes, rng = Chain('gantry', 'standard', GANTRY.joints[:3]), np.random.default_rng(seed)
    seen = measure(arm(seed, chain=axes), axes.random_joints(60, rng), rng, 3e-5, oriented=False)
    seen = replace(seen, positions=scale * seen.positions)
    result = identify(Problem(axes, seen, effects=('ratio',), sigma_position=5e-5))
    assert [each.rule for each in result.refusals] == [Rule.SCALE] * (scale != 1.0)


@pytest.mark.parametrize(
    ('fixed', 'seed', 'off'), [('*.a', 1, 0.0), ('base.*', 1, 3e-3), ('base.*', 0, 3e-2)]
)
def test_what_is_held_at_wrong_values_is_no_strain_of_the_device(fixed, seed, off):
    """Its lengths look stretched in the plane of a SCARA, or a base that is tilted."""
    _, true, seen = measured_arm(seed, 40, chain=SCARA, oriented=False)
    chain, held = SCARA, (fixed,)
    if fixed == 'base.*':
        tilted = true.base.matrix.copy()
        tilted[:3, :3] @= se3.exp_rotation(np.full((1, 3), off))[0]
        chain, held = replace(SCARA, base=Frame(tilted, fixed=True)), ()
    assert strain_of(fit(Problem(chain, seen, fixed=held, **SIGMAS))) == ('', 0.0)
    if off:
        problem = Problem(chain, stretched(seen, 2e-3, axis=1), **SIGMAS)
        assert strain_of(fit(problem))[0].startswith(TOLD[:-3])


def test_no_height_of_the_target_is_asked_for_tilts_below_any_device():
    """Tool points were told to be 9.1e-13 mm off."""
    *_, seen = measured_arm(5, 40, (0.0, 0.0), SCARA, errors=0.0)
    assert not any('stays level' in x for x in identify(Problem(SCARA, seen, **SIGMAS)).remarks)
