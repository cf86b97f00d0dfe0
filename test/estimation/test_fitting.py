# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a fit does before and after its least squares: priors that guard it, rows, statuses."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E, along_path, arm, measured_arm, rms

from calib_ros.apply.simulation import measure, random_frame
from calib_ros.errors import InputError, TooFewObservationsError
from calib_ros.estimation import fitting
from calib_ros.estimation.fitted import SimplerFit, _value_jacobian, parameter_rows
from calib_ros.estimation.fitting import SOME
from calib_ros.estimation.noise import Noise
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Learned, Problem
from calib_ros.estimation.sizes import LEAST_SIZE
from calib_ros.estimation.uncertainty import Uncertainty
from calib_ros.kinematics import se3
from calib_ros.kinematics.effects import members


def seen(count=12):
    return measured_arm(0, count)[2]


def noise(size, consistent=False, widened=1.0):
    return Noise(size, size, consistent, 0.0, 0.0, (), widened, size)


@pytest.mark.parametrize(
    ('size', 'widened', 'told'), [(6.0, 1.5, 2.0), (3.0, 2.0, 1.0), (0.8, 1.0, 0.8), (1.8, 1.0, 1)]
)
def test_what_the_model_lacks_weighs_priors_in_part(size, widened, told):
    """What neighbours do not share, over two; never below the sigmas given, or the noise found."""
    found = fitting._noise_for_priors(noise(size, widened=widened), richer=False)
    assert found == pytest.approx(told)
    assert fitting._noise_for_priors(noise(size, True, widened), richer=False) == size
    assert fitting._noise_for_priors(noise(size, widened=widened), richer=True) == size


@pytest.mark.parametrize(
    ('position', 'orientation', 'consistent', 'size', 'told'),
    [
        *((3.0, None, False, 8.9, 8.9), (3.0, None, False, 9.1, 4.5)),
        *((1.0, 3.0, False, 8.9, 8.9), (1.0, 3.0, False, 9.1, 4.5)),
        *((0.3, 0.2, False, 1.9, 1.9), (0.3, 0.2, False, 2.1, 1.0)),  # not below those given
        *((1.1, 0.9, True, 1.7, 1.65), (0.6, 0.5, True, 1.7, 1.0)),
    ],
)
def test_residuals_tell_the_noise_of_a_richer_model_with_priors_far_above_it(
    position, orientation, consistent, size, told
):
    found = Noise(position, orientation, consistent, 0.0, 0.0, (), 1.5, size)
    assert fitting._noise_for_priors(found, richer=True) == pytest.approx(told)


def test_only_what_is_told_worse_than_common_sense_is_guarded():
    problem = Problem(UR10E, seen(), priors={'wrist_1_joint.a': 1.0})
    names = ('base.x', 'elbow_joint.a', 'elbow_joint.theta', 'wrist_1_joint.a', 'wrist_1_joint.d')
    length, angle = 0.05 / 3.0, 0.1 / 3.0
    stds = np.array([1.0, 1.1 * length, 0.9 * angle, 1.0, 0.9 * angle])
    found = fitting._guarded(problem, names, np.diag(1.0 / stds), None)
    assert found.learned.noise == 1.0
    assert found.learned.priors == pytest.approx(
        {'elbow_joint.a': length, 'wrist_1_joint.d': length}
    )
    good = np.eye(5) / np.array([1.0, 0.9 * length, 0.9 * angle, 1.0, 0.9 * length])
    assert fitting._guarded(problem, names, good, None) is problem
    simpler = SimplerFit(UR10E, (), noise(4.0))
    assert fitting._guarded(problem, names, good, simpler).learned == Learned({}, 2.0)
    learned = replace(problem, learned=Learned({'base.x': 7.0}, 3.0))
    again = fitting._guarded(learned, names, np.diag(1.0 / stds), None).learned
    assert again.noise == 3.0
    assert set(again.priors) == {'base.x', 'elbow_joint.a', 'wrist_1_joint.d'}
    assert fitting._guarded(learned, names, good, simpler) is learned


def test_fewer_equations_than_parameters_are_refused():
    """Of configurations, not of pairs: twice the same tells no more."""
    twice = seen(4).select(np.repeat(np.arange(4), 2))
    points = replace(twice, oriented=np.zeros(8, dtype=bool), base='base_B')
    problem = Problem(UR10E, twice, more=(points,))
    fitting._require_enough(problem, ['x'] * 36)
    with pytest.raises(TooFewObservationsError) as caught:
        fitting._require_enough(problem, ['x'] * 37)
    said = '3 to 6 equations each for 37 parameters, with frames for 2 sessions'
    assert said in str(caught.value)
    assert (caught.value.configurations, caught.value.needed) == (8, 9)
    touch = Problem(UR10E, Observations.touching(twice.joints))
    told = r'26 needed \(1 equation each for 26 parameters\); measure 52 or more'
    with pytest.raises(TooFewObservationsError, match=told):
        fitting._require_enough(touch, ['x'] * 26)
    empty = replace(problem, more=(points.select(np.zeros(0, dtype=int)),))
    with pytest.raises(InputError, match='no pairs to fit between base_B and tool'):
        fitting._require_enough(empty, [])


@pytest.mark.parametrize(('count', 'share'), [(2 * SOME, 1), (2 * SOME + 1, 2), (5 * SOME, 3)])
def test_of_many_pairs_some_tell_the_priors_of_a_richer_model(count, share):
    first = seen(5).select(np.arange(count - SOME) % 5)
    second = replace(first.select(np.arange(SOME) % 5), base='base_B')
    problem = Problem(UR10E, first, more=(second,))
    simpler = SimplerFit(UR10E, (np.arange(count - SOME), np.arange(SOME)), noise(1.0))
    few, told = fitting._thin_problem(problem, simpler)
    assert [len(each) for each in few.sets] == [-(-len(each) // share) for each in problem.sets]
    for distances, given in zip(told.distances, simpler.distances, strict=True):
        np.testing.assert_array_equal(distances, given[::share])
    np.testing.assert_array_equal(few.sets[0].joints, first.joints[::share])
    assert fitting._thin_problem(problem, None) == (problem, None)


def test_turns_of_frames_become_rotation_vectors():
    """By the central difference of log R; other parameters stay as they are.

    Two turns alone, as at a plane, which is alike all round, become parts of the vector as well.
    """
    chain = UR10E.with_frame('base', random_frame(np.random.default_rng(0), 1.0))
    names = ['tool.rx', 'base.rz', 'base.x', 'base.rx', 'elbow_joint.theta', 'base.ry']
    expected = np.eye(6)
    order = [3, 5, 1]
    for k in order:
        ends = [
            se3.log_rotation(chain.with_offsets({names[k]: step}).base.matrix[:3, :3])
            for step in (-1e-6, 1e-6)
        ]
        expected[order, k] = (ends[1] - ends[0]) / 2e-6
    np.testing.assert_allclose(_value_jacobian(chain, names), expected, atol=1e-8)
    some = [0, 2, 3, 5]
    found = _value_jacobian(chain, [names[k] for k in some])
    np.testing.assert_allclose(found, expected[np.ix_(some, some)], atol=1e-8)


def test_every_parameter_has_a_row_with_what_became_of_it():
    problem = Problem(UR10E, seen(), fixed=('elbow_joint.beta',))
    names = ['base.x', 'elbow_joint.a']
    chain = UR10E.with_offsets({'elbow_joint.a': 2e-3})
    parts = np.array([np.diag([1.0, 4.0]), np.diag([0.0, 12.0])])
    uncertainty = Uncertainty(parts, np.array([10.0, np.inf]))
    known = [*names, 'elbow_joint.theta']
    fitted = SimpleNamespace(problem=problem, structural=known, chain=chain, names=names)
    rows = parameter_rows(fitted, uncertainty)
    assert [row.name for row in rows] == list(chain.parameter_names)
    found = {row.name: row for row in rows}
    assert found['elbow_joint.a'].offset == pytest.approx(2e-3)
    assert found['elbow_joint.a'].value == pytest.approx(chain.value('elbow_joint.a'))
    assert found['elbow_joint.a'].std == pytest.approx(4.0)
    assert found['elbow_joint.a'].freedom == pytest.approx(10.0 * 4.0**2)  # a fourth of it
    assert found['base.x'].std == pytest.approx(1.0)
    assert found['base.x'].freedom == pytest.approx(10.0)
    assert [found[name].status for name in names] == ['fitted', 'fitted']
    for name, status in (('theta', 'not excited'), ('alpha', 'gauge'), ('beta', 'fixed')):
        row = found[f'elbow_joint.{name}']
        assert (row.status, row.std, row.freedom) == (status, None, np.inf)


@pytest.mark.parametrize('count', [120, 600])
def test_parameters_that_some_poses_do_not_excite_may_be_by_all(count, monkeypatch):
    """The elbow moves at one pose that the spread leaves out."""
    monkeypatch.setattr(fitting, 'SOME', 100)
    *_, poses = measured_arm(0, count)
    joints = poses.joints.copy()
    joints[:, 2] = 0.5
    joints[7, 2] = 1.5
    problem = Problem(UR10E, replace(poses, joints=joints))
    wanted = [*problem.free[:12], 'elbow_joint.a', 'elbow_joint.theta', 'wrist_1_joint.theta']
    names, factor = fitting._excited_names(problem, wanted, UR10E)
    assert names == tuple(n for n in problem.free if n in wanted)
    assert factor.shape == (len(names), len(names))


def test_noise_is_searched_as_far_as_the_sizes_of_errors():
    """Measurements without noise, at rounding, leave nothing to find."""
    _, _, exact = measured_arm(0, 8, noise=(0.0, 0.0))
    found = fitting.fit(Problem(UR10E, exact, priors={'*_joint.*': 1e-2}))
    assert fitting._likely_noise(found) == LEAST_SIZE


@pytest.mark.parametrize('seed', range(2))
def test_effects_larger_than_usual_are_fitted_as_large_as_they_are(seed):
    """The poses tell each of them, but priors of the usual size cost 0.4 mm."""
    rng, names = np.random.default_rng(seed), members(UR10E, 'eccentricity')
    sizes = 5e-3 * rng.normal(size=len(names))
    true = arm(rng).with_effects(names).with_offsets(dict(zip(names, sizes, strict=True)))
    seen = measure(true, UR10E.random_joints(40, rng), rng, *NOISE)
    found = fitting.fit(Problem(UR10E.with_effects(names), seen, **SIGMAS))
    assert rms(found.chain, true, UR10E.random_joints(200, rng)) < 1.5e-4


def test_what_harmonics_named_by_the_user_lack_is_noise_to_them():
    """Of an arm that bends along a path: taken for a part of it, it made them as large again."""
    rng, bends = np.random.default_rng(0), members(UR10E, 'gravity')
    true = arm(rng).with_effects(bends)
    true = true.with_offsets({name: 1e-3 * rng.normal() for name in bends})
    seen = measure(true, along_path(60, rng), rng, *NOISE)
    found = fitting.fit(Problem(UR10E, seen, effects=('eccentricity',), **SIGMAS))
    assert found.problem.learned.noise > 0.9 * found.noise.size > 1.0


@pytest.mark.parametrize('seed', [4, 5])
def test_large_harmonics_named_by_the_user_are_no_noise(seed):
    """With priors of the usual size they were noise, and that made the priors weigh more."""
    names, rng = members(UR10E, 'eccentricity'), np.random.default_rng(seed)
    sizes = 1e-3 * rng.normal(size=len(names))
    true = arm(seed).with_effects(names).with_offsets(dict(zip(names, sizes, strict=True)))
    seen = measure(true, rng.uniform(-np.pi, np.pi, (25, 6)), rng, NOISE[0], oriented=False)
    found = fitting.fit(Problem(UR10E, seen, effects=('eccentricity',), **SIGMAS))
    assert found.problem.learned.noise < 1.5
    assert rms(found.chain, true, UR10E.random_joints(200, rng)) < 2e-4
