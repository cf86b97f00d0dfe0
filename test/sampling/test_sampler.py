# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, strategies as st

from calib_ros.kinematics import se3
from calib_ros.sampling.sampler import ROW_WIDTH, Found, Sampler
from calib_ros.sampling.slices import JOINTS, POSES, Piece, Slice, StreamKey
from calib_ros.sampling.track import Motion

POSE = StreamKey('', '', False, False, False)
NOISE = 5e-5


def samples(rotations, rng, spikes=(), stops=1):
    """Return the samples of stops at which rotations (N, 3, 3) were measured, alike at each.

    And how many are of the first restless stop or later.
    """
    count = len(rotations)
    values = np.full((stops * count, ROW_WIDTH), np.nan)
    values[:, :3] = 0.5 + rng.normal(scale=NOISE, size=(stops * count, 3))
    values[list(spikes), :3] += 0.1
    values[:, 3:7] = np.tile(se3.to_quat(rotations), (stops, 1))
    still = np.zeros((stops * count, 1))
    stamps = 1 + np.arange(stops * count)
    numbers, begins = np.repeat(np.arange(stops), count), count * np.arange(stops)
    made, at_rest = Sampler(np.array([True]), 100), (Motion(still), still[begins], 0.0, NOISE)
    made.add([*made.samples(Found(POSE, numbers, stamps, values, begins, *at_rest))])
    return made.take()


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 3.0, np.pi - 1e-6, np.pi]))
def test_rotations_are_averaged_as_rotations(seed, angle):
    """Also near half a turn, where rotation vectors jump from one sign to the other."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    true = se3.exp_rotation(angle * axis[np.newaxis] / np.linalg.norm(axis))[0]
    count, sigma = 100, 1e-3
    turned = se3.exp_rotation(rng.normal(scale=sigma, size=(count, 3))) @ true
    (sample,), restless = samples(turned, rng)
    assert restless == 0
    found = sample.rotation
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)
    error = se3.log_rotation((found @ true.T)[np.newaxis])[0]
    assert np.linalg.norm(error) < 5.0 * sigma * np.sqrt(3.0 / count)


def test_the_rotation_of_a_spike_does_not_count(rng):
    rotations = np.tile(np.eye(3), (20, 1, 1))
    rotations[7] = se3.exp_rotation(np.array([[0.5, 0.0, 0.0]]))[0]
    found, restless = samples(rotations, rng, (27, 47), stops=3)
    assert [sample.count for sample in found] == [20, 19, 19]
    assert restless == 2
    for sample in found[1:]:
        np.testing.assert_allclose(sample.rotation, np.eye(3), atol=1e-12)


def test_a_mean_between_two_places_is_no_pose(rng):
    """That of two devices or targets by turns was one: the poses fitted, the frames were wrong."""
    rotations = np.tile(np.eye(3), (20, 1, 1))
    found, restless = samples(rotations, rng, range(1, 40, 2), stops=3)
    assert [sample.count for sample in found] == [20]
    assert restless == 1


@pytest.mark.parametrize('kind', ['distance', 'eye_in_hand', 'images'])
def test_only_a_target_seen_from_outside_is_a_place(kind):
    assert POSE.is_place
    assert not POSE._replace(**{kind: True}).is_place


def test_images_of_a_stop_have_the_stamp_of_the_middle_one():
    values = np.full((10, ROW_WIDTH), np.nan)
    values[:, 0] = np.arange(10)
    made, still = Sampler(np.array([True]), 100), np.zeros((10, 1))
    key, stamps, begins = POSE._replace(images=True), 10 + np.arange(10), np.array([0, 3])
    seen = key, np.zeros(10, int), stamps, values, begins
    made.add([*made.samples(Found(*seen, Motion(still), still[begins], 0.0, NOISE))])
    known = [(each.stamp_ns, each.images) for each in made.take()[0]]
    assert known == [(11, (0, 1, 2)), (16, (3, 4, 5, 6, 7, 8, 9))]


def test_a_delay_is_taken_off_the_stamps_of_measurements_alone():
    joints = Piece(('j1',), np.array([0, 4]), np.array([70, 90]), np.zeros((2, 1)))
    poses = Piece(POSE, np.array([1, 2]), np.array([80, 100]), np.zeros((2, ROW_WIDTH)))
    found = Slice.of([poses, joints], 5)
    assert found.times.tolist() == [70, 75, 95, 90]
    assert found.where(JOINTS).tolist() == [0, 3]
    assert found.where(POSES).tolist() == [1, 2]
    later = found.between(2, 4)
    assert later.times.tolist() == [95, 90]
    assert [each.stamps.tolist() for each in later.pieces] == [[100], [90]]
