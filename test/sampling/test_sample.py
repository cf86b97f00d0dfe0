# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from calib_ros.errors import InputError
from calib_ros.kinematics.chain_file import parse_frames
from calib_ros.kinematics.lens import Lens
from calib_ros.sampling.dataset import dataset_of
from calib_ros.sampling.sample import Frames, Sample, View
from calib_ros.sampling.sample_hints import frozen

SIGMAS = (1e-4, 3e-4)
PLAIN = Sample(1, np.zeros(2), position=np.ones(3), rotation=np.eye(3))
names = st.sampled_from(['', 'A', 'B', 'a.b', 'a-b', '2', 'A_B'])
labels = st.lists(st.tuples(names, names, names, st.booleans()), max_size=12)


def labelled(session, device, target, eye):
    return replace(PLAIN, session=session, device=device, target=target, eye_in_hand=eye)


def test_the_first_that_comes_needs_no_name():
    frames = Frames()
    assert frames.of(labelled('s', 'tracker', 'ball', False)) == ('base', 'tool')
    assert frames.of(labelled('s', 'tracker', 'plate', False)) == ('base', 'tool_plate')
    assert frames.of(labelled('s', 'other', 'ball', False)) == ('base_other', 'tool')
    assert frames.of(labelled('t', 'tracker', 'ball', False)) == ('base_t', 'tool_t')
    assert frames.of(labelled('t', 'other', 'ball', False)) == ('base_t_other', 'tool_t')
    assert frames.of(labelled('s', 'camera', 'board', True)) == ('base_board', 'tool_camera')
    assert frames.of(labelled('s', '', '', False)) == ('base_4', 'tool_4')
    known = Frames(frames.owners)
    assert known.of(labelled('t', 'tracker', 'ball', False)) == ('base_t', 'tool_t')


def test_no_socket_and_no_plane_is_the_first():
    frames = Frames()
    hole = replace(labelled('s', 'hole', '', False), socket=True)
    wall = replace(labelled('s', 'wall', '', False), plane=True)
    assert frames.of(hole) == ('base_hole', 'tool')
    assert frames.of(wall) == ('base_wall', 'tool')
    for known in (Frames(frames.owners), frames):
        assert known.of(labelled('s', 'tracker', '', False)) == ('base', 'tool')
    tip = replace(wall, target='tip')
    assert frames.of(tip) == ('base_wall', 'tool_tip')  # the other target is the first
    assert frames.of(replace(tip, session='t')) == ('base_t_wall', 'tool_t')
    assert frames.of(replace(hole, session='t')) == ('base_t_hole', 'tool_t')


@pytest.mark.parametrize('kind', ['socket', 'plane'])
def test_the_world_is_the_frame_of_the_device_that_has_the_base(kind):
    """After a ball in a socket it had no name: nothing was on /tf_static."""
    hole = Sample(2, np.zeros(2), device='A_1', distance=None if kind == 'socket' else 0.0)
    tracker = replace(PLAIN, frame_id='tracker')
    other = replace(PLAIN, device='other', frame_id='elsewhere')
    samples = [replace(hole, **{kind: True}), tracker, other]
    assert dataset_of(samples, SIGMAS).world_frame == 'tracker'
    assert dataset_of(samples[:1], SIGMAS).world_frame == ''


@given(labels)
def test_frames_are_shared_by_those_that_share_them_and_by_no_others(many):
    """Whatever the names: a session may be called like a device."""
    frames = Frames()
    owners = {}
    for session, device, target, eye in many:
        base, tool = frames.of(labelled(session, device, target, eye))
        ends = (target, device) if eye else (device, target)
        for side, name, end in zip(('base', 'tool'), (base, tool), ends, strict=True):
            assert name.startswith(side)
            assert owners.setdefault(name, (session, eye, end)) == (session, eye, end)
    assert len(owners) == len({(name[:4], *owner) for name, owner in owners.items()})
    further = owners.keys() - {'base', 'tool'}
    kept = parse_frames({'frames': dict.fromkeys(further)}, 'calibration.yaml')
    assert {name for name, _ in kept['frames']} == further


@given(labels.filter(bool))
def test_every_sample_is_in_one_set(many):
    samples = [
        replace(labelled(*label), stamp_ns=k + 1, validation=k % 3 == 0)
        for k, label in enumerate(many)
    ]
    found = dataset_of(samples, SIGMAS)
    fitted, held_out = found.fitted, found.held_out
    found = [int(stamp) for each in (*fitted, *held_out) for stamp in each.stamps_ns]
    assert sorted(found) == [sample.stamp_ns for sample in samples]
    judging = {int(stamp) for each in held_out for stamp in each.stamps_ns}
    assert judging == {sample.stamp_ns for sample in samples if sample.validation}


def test_what_only_some_samples_have_is_zero_or_blank():
    """As after a restart in another mode: samples of stops among those of a motion."""
    covariance = np.eye(6)
    speed = np.ones(2)
    mixed = [
        replace(PLAIN, covariance=covariance, velocity=speed, approach=speed),
        replace(PLAIN, stamp_ns=2, rotation=None, approach=-speed),
    ]
    (both,) = dataset_of(mixed, SIGMAS).fitted
    assert both.oriented.tolist() == [True, False]
    np.testing.assert_array_equal(both.covariance[0], covariance)
    assert np.isnan(both.covariance[1]).all()
    np.testing.assert_array_equal(both.velocity, [speed, 0.0 * speed])
    assert both.acceleration is None
    np.testing.assert_array_equal(both.approach, [speed, -speed])


def test_images_become_corners_unless_the_poses_of_their_boards_are_asked_for():
    """Of each corner: pixels, its point on the board, the image, the joint values; no pose."""
    lens = Lens(900.0, 900.0, 500.0, 400.0)
    images = [
        View(np.arange(3.0 * count).reshape(-1, 3), np.full((count, 2), 10.0 * count), lens)
        for count in (4, 5)
    ]
    samples = [
        replace(PLAIN, stamp_ns=k, joints=np.full(2, k), view=each, eye_in_hand=True, device='eye')
        for k, each in enumerate(images, 1)
    ]
    found = dataset_of(samples, SIGMAS)
    (seen,) = found.fitted
    assert (dict(found.lenses), seen.on_flange) == ({seen.camera: lens}, True)
    which = np.repeat([1, 2], [4, 5])
    np.testing.assert_array_equal(seen.stamps_ns, which)
    np.testing.assert_array_equal(seen.joints, np.outer(which, [1.0, 1.0]))
    np.testing.assert_array_equal(seen.pixels, np.concatenate([each.pixels for each in images]))
    np.testing.assert_array_equal(seen.points, np.concatenate([each.points for each in images]))
    np.testing.assert_array_equal(seen.positions, np.zeros((9, 3)))
    np.testing.assert_array_equal(seen.rotations, np.tile(np.eye(3), (9, 1, 1)))
    assert not seen.oriented.any()
    (posed,) = dataset_of(samples, SIGMAS, posed=True).fitted
    assert (posed.pixels, posed.oriented.tolist()) == (None, [True, True])
    samples[1] = replace(samples[1], view=replace(images[1], lens=replace(lens, k1=0.1)))
    with pytest.raises(InputError, match='CameraInfo of eye has changed'):
        dataset_of(samples, SIGMAS)


@pytest.mark.parametrize(
    ('every', 'digits', 'fewest', 'told'),
    [(1, 9, 9, False), (2, 9, 9, True), (6, 9, 9, False), (2, 5, 9, False), (1, 9, 1, False)],
)
def test_stops_at_which_the_last_place_was_repeated_are_told(every, digits, fewest, told, rng):
    """By a device without a target, another place each time; nothing scatters in a simulation.

    Nor at some stops by a device of few digits, and one measurement shows no scatter.
    """
    places = rng.uniform(size=(30, 3)).round(digits)
    spreads = [1e-5 * (k % every > 0) for k in range(30)]
    counts = [9 - (9 - fewest) * (k % 2) for k in range(30)]
    stops = zip(places, spreads, counts, strict=True)
    given = [replace(PLAIN, position=p, spread=s, count=c) for p, s, c in stops]
    assert (frozen(given) is not None) == told
