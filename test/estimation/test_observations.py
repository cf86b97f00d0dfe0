# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from calib_ros.errors import InputError
from calib_ros.estimation.configurations import SCATTER, STILL, configurations
from calib_ros.estimation.observations import Observations
from calib_ros.kinematics import se3


def test_standing_still_is_one_configuration(rng):
    places = np.repeat([[0.0, 0.0], [0.0, 0.5], [0.3, 0.5], [0.0, 0.0]], [3, 1, 4, 2], axis=0)
    jitter = rng.uniform(-0.4 * STILL, 0.4 * STILL, places.shape)
    expected = [0, 0, 0, 1, 2, 2, 2, 2, 0, 0]  # the first is visited again
    assert configurations(places + jitter).tolist() == expected
    observations = Observations.from_arrays(places + jitter, np.zeros((10, 3)))
    assert observations.configurations.tolist() == expected


@pytest.mark.parametrize(
    ('joints', 'expected'),
    [
        *((STILL * np.array([(0.0, 0.0), to]), [0, new]) for to, new in
          (((0.9, 0.9), 0), ((1.1, 0.0), 1), ((0.0, -1.1), 1))),
        (np.array([[3.14159], [-3.14159], [3.14159], [3.0]]), [0, 0, 0, 1]),  # half a turn
        (np.zeros((1, 6)), [0]),
        (np.zeros((0, 6)), []),
    ],
)  # fmt: skip
def test_the_joint_that_moved_most_makes_a_configuration(joints, expected):
    assert configurations(joints).tolist() == expected


SIX, THREE = np.zeros((3, 6)), np.zeros((3, 3))
MASKED = np.ma.masked_array(THREE, mask=[[0, 0, 0], [0, 1, 0], [0, 0, 0]])


@pytest.mark.parametrize(
    ('arrays', 'complaint'),
    [
        ((SIX, THREE[:2]), r'positions of 3 observations .*\(3, 3\), not \(2, 3\)'),
        ((SIX, THREE, np.zeros((3, 4))), 'rotations of 3 observations'),
        *(((SIX + bad, THREE), 'joints .* NaN or infinite') for bad in (np.nan, np.inf)),
        *(((SIX, THREE + bad), 'positions .* NaN or infinite') for bad in (np.nan, np.inf)),
        ((None, None), 'joints must be real numbers'),
        ((SIX, MASKED), 'positions .* NaN'),
        (([['a'] * 6], [[0.0] * 3]), 'joints must be real numbers'),
        *(
            ((SIX, THREE.astype(kind)), f'real numbers in an array, not {kind}')
            for kind in ('bool', 'complex128', 'datetime64', '<U3')
        ),
        *(
            (arrays, r'joints must have the shape \(N, n\)')
            for arrays in ((1.0, 2.0), ([0.0] * 6, [0.0] * 3), ([], []))
        ),
        *(
            ((SIX, THREE, np.stack([np.eye(3), turn, np.eye(3)])), f'pair 1 .* {words}')
            for turn, words in (
                (np.diag([1.0, 1.0, -1.0]), 'left-handed: 1 of 3'),
                (np.zeros((3, 3)), 'not orthogonal'),
                (1.1 * np.eye(3), 'not orthogonal'),
            )
        ),
    ],
)
def test_arrays_that_cannot_be_are_refused(arrays, complaint):
    with pytest.raises(InputError, match=complaint):
        Observations.from_arrays(*arrays)


def test_speeds_tell_from_which_side_joints_came(rng):
    """Play in motion was not considered without the signs: an arm went from 0.10 to 0.61 mm."""
    seen = Observations.from_arrays(np.zeros((4, 3)), np.zeros((4, 3)))
    speeds, known = rng.normal(size=(2, 4, 3))
    assert seen.approach is None
    assert (replace(seen, velocity=speeds).approach == np.sign(speeds)).all()
    assert (replace(seen, velocity=speeds, approach=known).approach == known).all()
    with pytest.raises(InputError, match=r'^velocity of the observations hold NaN'):
        replace(seen, velocity=np.nan * speeds)


def test_a_plane_needs_heights():
    with pytest.raises(InputError, match='a plane needs the heights over it as distances'):
        replace(Observations.from_arrays(SIX, THREE), plane=True)


def test_observations_do_not_follow_arrays_that_change():
    joints = SIX.copy()
    seen = Observations.from_arrays(joints, THREE)
    joints += 1.0
    assert not np.array_equal(seen.joints, joints)


def test_lists_will_do_as_arrays(rng):
    joints, positions = rng.normal(size=(5, 6)), rng.normal(size=(5, 3))
    rotations = se3.exp_rotation(rng.normal(size=(5, 3)))
    seen = Observations.from_arrays(joints.tolist(), positions.tolist(), rotations.tolist())
    np.testing.assert_array_equal(seen.rotations, rotations)
    np.testing.assert_array_equal(seen.joints, joints)


def test_rotations_rounded_to_two_digits_are_rotations(rng):
    rotations = np.round(se3.exp_rotation(rng.normal(size=(200, 3))), 2)
    seen = Observations.from_arrays(np.zeros((200, 6)), np.zeros((200, 3)), rotations)
    assert seen.oriented.all()


def moving(rng, count=20, order=2):
    """Return observations with joints that follow parabolas, and the parabolas."""
    start, speed, bend = rng.normal(size=(3, count, 2))

    def joints(before):
        return start - before * speed + 0.5 * before**2 * bend

    seen = Observations.from_arrays(joints(0.0), np.zeros((count, 3)))
    optional = {'velocity': speed, 'acceleration': bend} if order == 2 else {'velocity': speed}
    return replace(seen, **optional), joints


def test_earlier_follows_velocity_and_acceleration(rng):
    seen, joints = moving(rng)
    sooner = seen.earlier(0.07)
    np.testing.assert_allclose(sooner.joints, joints(0.07), atol=1e-12)
    np.testing.assert_array_equal(sooner.delay, np.full(20, 0.07))
    np.testing.assert_array_equal(sooner.positions, seen.positions)
    # what has been taken into account is not taken again, and there is a way back
    np.testing.assert_allclose(sooner.earlier(0.1).joints, joints(0.1), atol=1e-12)
    np.testing.assert_allclose(sooner.earlier(0.0).joints, seen.joints, atol=1e-12)
    assert sooner.earlier(0.07) is sooner


def test_an_arm_that_stood_was_nowhere_else_earlier(rng):
    seen = Observations.from_arrays(rng.normal(size=(5, 2)), np.zeros((5, 3)))
    assert seen.earlier(0.5) is seen


@pytest.mark.parametrize('name', ['velocity', 'acceleration', 'delay', 'approach'])
def test_optional_arrays_must_fit_too(rng, name):
    seen, _ = moving(rng)
    with pytest.raises(InputError, match=f'{name} of 20 observations must have the shape'):
        replace(seen, **{name: np.zeros((19, 2))})


@pytest.mark.parametrize('name', ['base', 'tool'])
def test_the_name_of_a_frame_tells_its_side(rng, name):
    """An axis that wobbles counted as random turns: no base was known by its name."""
    seen, _ = moving(rng)
    assert getattr(replace(seen, **{name: f'{name}_2'}), name) == f'{name}_2'
    with pytest.raises(InputError, match=r'begin with base and tool, not as .*"tracker"'):
        replace(seen, **{name: 'tracker'})


def test_select_takes_optional_arrays_along(rng):
    seen, _ = moving(rng)
    seen = replace(seen, delay=rng.normal(size=20))
    part = seen.select(np.array([3, 1]))
    for name in ('velocity', 'acceleration', 'delay'):
        np.testing.assert_array_equal(getattr(part, name), getattr(seen, name)[[3, 1]])


def test_poses_ever_further_apart_are_no_visits_of_one_configuration():
    """No distance tells where those of one end and those of two begin."""
    joints = np.repeat(np.arange(20.0) / 4.0, 2)[:, np.newaxis]
    joints[1::2, 0] += 0.2 * SCATTER * 1.13 ** np.arange(20)  # up to twice SCATTER
    assert len(np.unique(configurations(joints))) == 40


def test_a_part_keeps_the_configurations_of_the_whole(rng):
    """Known or found anew, they are the same, whatever order the part is in."""
    joints = rng.uniform(-3.0, 3.0, (30, 6))[rng.integers(0, 30, 90)]
    whole = Observations.from_arrays(joints, np.zeros((90, 3)))
    for part in (np.arange(90) % 3 == 0, rng.permutation(90)[:40], np.zeros(90, bool)):
        anew = Observations.from_arrays(joints[part], np.zeros((len(joints[part]), 3)))
        assert whole.configurations.max() > 10
        known = whole.select(part).configurations
        same = known[:, np.newaxis] == known
        np.testing.assert_array_equal(
            same, anew.configurations[:, np.newaxis] == anew.configurations
        )
        assert set(known) == set(range(len(set(known))))


def test_frames_of_observations_are_renamed():
    seen = Observations.from_arrays(np.zeros((2, 6)), np.ones((2, 3)))
    seen = seen.changed(base='base_hall', tool='tool_ball')
    for names, ends in (
        ({}, ('base_hall', 'tool_ball')),
        ({'base_hall': 'base'}, ('base', 'tool_ball')),
        ({'tool_ball': 'tool_tip', 'tool': 'tool_x'}, ('base_hall', 'tool_tip')),
    ):
        found = seen.between(names)
        assert (found.base, found.tool) == ends
        np.testing.assert_array_equal(found.joints, seen.joints)
