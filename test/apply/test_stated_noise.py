# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The noise of another device: stated or not, and in contradiction to what it measured."""

from dataclasses import replace

import numpy as np
import pytest
from fits import measured_arm
from verified import NOISE, UR, measured

from calib_ros.apply.device_noise import noise_seen
from calib_ros.apply.judgement import judge
from calib_ros.apply.verification import verify
from calib_ros.cli.common import settings_of
from calib_ros.cli.parser import parser_of
from calib_ros.errors import InputError
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.identification import identify
from calib_ros.identification.recalibration import recalibrate
from calib_ros.kinematics.effects import members
from calib_ros.kinematics.joint import Frame
from calib_ros.kinematics.se3 import norms
from calib_ros.report.documents import verification_document
from calib_ros.report.remarks import caveats
from calib_ros.report.standing import standing
from calib_ros.report.words import still_holds
from calib_ros.settings import Settings


def test_a_device_with_more_noise_does_not_condemn_the_arm(cell, arm):
    """Its noise alone is beyond the limit; that of the earlier device is not."""
    noise = 5.0 * NOISE[0]
    seen = measured(cell[0], UR.random_joints(30, np.random.default_rng(3)), 1, (noise, 1e-3))
    for given in ({'sigma_position': noise}, {}):  # unsaid, no change of an arm explains it
        found = verify(arm, [seen], None, **given)
        assert found.verdict == 'UNDECIDED'
        assert standing(found)[0].heading == 'UNDECIDED: the device has too much noise to tell'
    assert verify(arm, [seen], 1e-4, sigma_position=noise).verdict == 'FAIL'  # whatever the cause
    rows = replace(seen, covariance=np.tile(np.diag([noise**2] * 3 + [1e-6] * 3), (30, 1, 1)))
    assert verify(arm, [rows], None).verdict == 'UNDECIDED'
    slipped = cell[0].with_offsets({'elbow_joint.theta': 1.5e-3})
    moved = measured(slipped, seen.joints, 1, (noise, 1e-3))
    for given in ({'sigma_position': noise}, {}):
        found = verify(arm, [moved], None, **given)  # where it decides nothing it is not told
        assert (found.verdict, found.noise) == ('does not hold', 0.0)
    few = measured(cell[0], seen.joints, 1)
    for sigma in (Settings.sigma_position, noise):
        same = verify(arm, [few], None, sigma_position=sigma)
        assert (same.verdict, same.noise) == ('holds', 0.0)


def test_a_stated_noise_may_have_the_value_of_the_default(cell, arm, none_odd):
    """It was taken for that of the earlier device, here a better one."""
    noise, names = (Settings.sigma_position, 4e-4), ('sigma_position', 'sigma_orientation')
    seen = measured(cell[0], UR.random_joints(40, np.random.default_rng(3)), 1, noise)
    was = replace(
        arm.noise, position=1.0, orientation=1.0, given=dict(zip(names, NOISE, strict=True))
    )
    known = replace(arm, noise=was, residual=7e-5)
    assert verify(known, [seen], None, sigma_position=NOISE[0]).verdict == 'does not hold'
    assert verify(known, [seen], None, sigma_position=noise[0]).verdict == 'UNDECIDED'
    found = recalibrate(known, Problem(UR, seen), 0.0)
    assert 'if the device has more noise, state it (--sigma-position)' in found.refusal()[1]
    holds, told = still_holds(found, judge(known, [seen]))  # as `verify`
    assert (holds, 'the device has too much noise to tell' in told) == (False, True)
    assert recalibrate(known, Problem(UR, seen), 0.0, stated=names).accepted


def test_an_option_is_known_to_be_given_though_it_has_the_value_of_the_default():
    given = ['verify', 'new.csv', '--chain', 'ur10e', '--calibration', 'result']
    for more in ([], ['--sigma-position', '0.0001']):
        options = parser_of(given).parse_args([*given, *more])
        assert ('sigma_position' in options) == bool(more)
        assert settings_of(options) == Settings()


@pytest.mark.parametrize(
    ('count', 'worn', 'bent'), [(10, 3e-4, 0.0), (10, 0.0, 2e-4), (20, 2e-4, 2e-4)]
)
def test_an_arm_that_changed_in_more_than_its_shape_is_no_noise_of_the_device(
    cell, arm, count, worn, bent
):
    """Of worn drives, bent links, or both, the device was said to have too much noise."""
    rng = np.random.default_rng(0)
    links = [name for name in UR.parameter_names if name.of_dh]
    changed = {name: worn * rng.choice([-1, 1]) for name in members(UR, 'ratio')}
    true = cell[0].with_effect_values(changed)
    true = true.with_offsets({name: bent * rng.choice([-1, 1]) for name in links})
    q = UR.random_joints(count, np.random.default_rng(3))
    assert verify(arm, [measured(true, q, 1)], None).verdict == 'does not hold'


def test_a_joint_that_slips_more_and_more_is_no_noise_of_the_device(cell, arm):
    rng = np.random.default_rng(1)
    q = UR.random_joints(30, rng)
    slips = 3e-4 * np.cumsum(rng.normal(size=(30, 1)), axis=0) * np.eye(6)[2]
    assert verify(arm, [replace(measured(cell[0], q + slips, 1), joints=q)], None).failed


@pytest.mark.parametrize('refitted', [False, True])
def test_rows_in_another_order_are_no_noise_of_the_device(cell, arm, refitted, unsearched):
    """Errors of 1 m were told as noise of the device, in 17 of 18 cases."""
    seen = measured(cell[0], UR.random_joints(20, np.random.default_rng(3)), 1)
    rows = replace(seen, positions=np.random.default_rng(0).permutation(seen.positions))
    found = verify(arm, [rows], None, new_base=refitted, new_tool=refitted)
    assert found.verdict == 'does not hold'
    assert standing(found)[1][0].startswith('No arm is that far off')


@pytest.mark.parametrize('seed', range(2))
def test_noise_of_positions_alone_is_no_move_amidst_the_poses(cell, arm, seed):
    """A fit of everything imitates such moves: half of healthy arms did not hold."""
    q = UR.random_joints(30, np.random.default_rng(seed))
    found = verify(arm, [measured(cell[0], q, 1, (20.0 * NOISE[0], NOISE[1]), seed)], None)
    assert found.verdict == 'UNDECIDED'
    hit = measured(cell[0], q, 1)
    hit.positions[17:] += [1e-3, 0.0, 0.0]
    assert verify(arm, [hit], None).verdict == 'does not hold'


@pytest.mark.parametrize(
    ('count', 'worse', 'seed'), [(6, 5.0, 0), (6, 5.0, 1), (12, 5.0, 1), (12, 20.0, 0)]
)
def test_few_poses_tell_no_noise_from_a_change(cell, arm, count, worse, seed):
    """Nearly all healthy arms did not hold by 6 poses beside a noisier device, most by 12."""
    q = UR.random_joints(count, np.random.default_rng(seed))
    seen = measured(cell[0], q, 1, (worse * NOISE[0], NOISE[1]), seed)
    found = verify(arm, [seen], None)
    assert found.verdict == 'UNDECIDED'
    assert standing(found)[1][0].startswith('State the noise')
    stated = verify(arm, [seen], None, sigma_position=worse * NOISE[0])
    rows = np.tile(np.diag([(worse * NOISE[0]) ** 2] * 3 + [NOISE[1] ** 2] * 3), (count, 1, 1))
    for told in (stated, verify(arm, [replace(seen, covariance=rows)], None)):
        assert not any('State the noise' in each for each in standing(told)[1])
    rows[count // 2 :] = np.nan  # the others are as noisy, and nobody said so
    assert verify(arm, [replace(seen, covariance=rows)], None).needed is None


@pytest.mark.parametrize('seed', [0, 9])
def test_the_noise_of_few_poses_is_the_most_that_is_likely(cell, seed):
    """The likeliest cause left 0.33 and 0.001 mm of 1 mm, and condemned healthy arms."""
    rng = np.random.default_rng(seed)
    seen = measured(cell[0], UR.random_joints(6, rng), 1, (1e-3, NOISE[1]), seed)
    assert noise_seen(cell[0], [seen]) > 7e-4


def test_links_that_are_all_bent_are_one_cause(cell):
    """Only beside all else that may change, 0.2 to 1 mm of them were taken for noise."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        links = {name: 5e-4 * rng.choice([-1, 1]) for name in UR.parameter_names if name.of_dh}
        seen = measured(cell[0].with_offsets(links), UR.random_joints(8, rng), 1, seed=seed)
        assert noise_seen(cell[0], [seen]) < 2e-4


@pytest.mark.parametrize(
    'offsets',
    [
        {'elbow_joint.theta': 1e-3},
        {'elbow_joint.a': 1e-3, 'elbow_joint.alpha': 1e-3},
        dict(zip((f'{n}.theta' for n in UR.joint_names[1:4]), (1e-3, -1e-3, 1e-3), strict=True)),
    ],
)
def test_few_poses_show_slips_and_a_bent_link(cell, arm, offsets):
    changed = cell[0].with_offsets(offsets)
    q = UR.random_joints(10, np.random.default_rng(0))
    assert verify(arm, [measured(changed, q, 1)], None).verdict == 'does not hold'


def test_noise_of_distances_is_along_the_wires(rng):
    """It counted three times, and hid a slip that was larger than the noise."""

    def distances(arm, noise):
        found = []
        for k, anchor in enumerate(((1.5, 0.4, -0.5), (-1.0, 1.5, 0.2), (0.3, -1.8, 0.9))):
            q = UR.random_joints(40, rng)
            ways = arm.forward(q)[:, :3, 3] - anchor
            lengths = norms(ways) + noise * rng.normal(size=len(q))
            each = Observations.from_arrays(q, ways)
            found.append(replace(each, distances=lengths, base=f'base_{k}'))
        return found

    true = replace(measured_arm(rng, 1)[1], base=Frame())
    first, *more = distances(true, NOISE[0])
    coarse = 5.0 * NOISE[0]
    arm = Calibration.of(identify(Problem(UR, first, more=more, sigma_position=NOISE[0])))
    slipped = true.with_offsets({'elbow_joint.theta': 1e-3})
    for now, verdict in ((true, 'UNDECIDED'), (slipped, 'does not hold')):
        for sigma in (coarse, None):
            assert judge(arm, distances(now, coarse), sigma_position=sigma).verdict == verdict


def test_errors_along_wires_are_one_third_of_their_squares(arm):
    """A slip of 1 mrad beside three wires was within the limit: it was that of all directions."""
    exact, q = replace(arm, residual=0.0), UR.random_joints(5, np.random.default_rng(0))
    points = Observations.from_arrays(q, UR.forward(q)[:, :3, 3])
    wires = replace(points, distances=norms(points.positions))
    assert exact.limit([wires]) == pytest.approx(exact.limit([points]) / np.sqrt(3.0))
    assert exact.limit([wires, wires, points]) < exact.limit([points])


def test_nothing_measured_is_told(cell, arm):
    """It ended in a traceback."""
    none = measured(cell[0], UR.random_joints(2, np.random.default_rng(0)), 1).select(np.arange(0))
    with pytest.raises(InputError, match='no pose was measured'):
        verify(arm, [none], None)


def test_noise_that_is_stated_larger_than_all_errors_is_told(cell, arm, none_odd):
    """~/check said that a slipped arm agrees."""
    slipped = cell[0].with_offsets({'elbow_joint.theta': 1.5e-3})
    seen = measured(slipped, UR.random_joints(30, np.random.default_rng(3)), 1)
    found = verify(arm, [seen], None, sigma_position=0.01)
    assert found.verdict == 'UNDECIDED'
    assert 'contradicts the errors' in standing(found)[1][0]
    update = recalibrate(arm, Problem(UR, seen, sigma_position=0.01, sigma_orientation=0.01), 0.0)
    holds, told = still_holds(update, judge(arm, [seen], sigma_position=0.01))
    assert (holds, 'contradicts the errors' in told) == (False, True)


def test_the_error_that_a_good_verdict_leaves_open_is_told():
    """A slip of 1 mrad hides beside 1 mm of noise."""
    noise = (1e-3, 2e-3)
    _, true, seen = measured_arm(7, 40, noise=noise)
    sigmas = {'sigma_position': noise[0], 'sigma_orientation': noise[1]}
    coarse = Calibration.of(identify(Problem(UR, seen, **sigmas)))
    slipped = true.with_offsets({'shoulder_lift_joint.theta': 1e-3})
    q = UR.random_joints(30, np.random.default_rng(3))
    found = verify(coarse, [measured(slipped, q, 1, noise)], None)
    joints = UR.random_joints(200, np.random.default_rng(0))
    moved = norms((slipped.forward(joints) - true.forward(joints))[:, :3, 3]).max()
    assert found.verdict == 'holds'
    assert moved < found.unseen < 5.0 * moved
    told = f'could go unseen here and move the target by up to {1e3 * found.unseen:.3f} mm where'
    assert any(told in each for each in caveats(found))
    assert not any('unseen' in each for each in caveats(replace(found, limit=found.unseen)))
    assert verification_document(found)['unseen_mm'] == 1e3 * found.unseen
