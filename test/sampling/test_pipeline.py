# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stray stamps told from a clock that was moved."""

import numpy as np
import pytest
from arriving import assert_same
from hypothesis import given, strategies as st
from streams import S, hear, stamps, stops, sweep

from calib_ros import CalibrationSession, load_chain
from calib_ros.sampling.gate import STRAY, Gate
from calib_ros.sampling.slices import JOINTS, NO_ACCIDENT, POSES, Piece, Slice, StreamKey
from calib_ros.settings import Settings

ARM = load_chain('ur5e')
POSE_KEY = StreamKey('', '', False, False, False)


def through(messages, far=1.0):
    """Return what passes of messages (kind, time [s]), in its order, and the gate."""
    gate = Gate(far)
    return [m for found, _ in gate.admit(sliced(messages)) for m in back(found, messages)], gate


def sliced(messages):
    """Return messages (kind, time [s]) as a slice; each has its number for what it says."""
    pieces = []
    for kind, key in ((JOINTS, (0,)), (POSES, POSE_KEY)):
        places = np.array([k for k, each in enumerate(messages) if each[0] == kind], dtype=int)
        times = np.array([round(messages[k][1] * S) for k in places], dtype=np.int64)
        pieces.append(Piece(key, places, times, places[:, np.newaxis].astype(float)))
    return Slice.of(pieces)


def back(found, messages):
    """Return the messages of a slice in their order."""
    if not found.pieces:
        return []
    places = np.concatenate([each.places for each in found.pieces])
    numbers = np.concatenate([each.numbers[:, 0] for each in found.pieces])
    return [messages[int(k)] for k in numbers[np.argsort(places)]]


def both(times):
    return [(kind, time) for time in times for kind in (JOINTS, POSES)]


def count(gate):
    return gate.held(JOINTS) + gate.held(POSES) + sum(gate.dropped.values())


@pytest.mark.parametrize('off', [-1e7, -1e4, -5.0, 5.0, 1e4, 1e7])
def test_a_stray_stamp_of_each_is_dropped(off):
    sane = both(np.arange(100.0, 110.0, 0.1))
    stray = [(JOINTS, 105.0 + off), (POSES, 105.0 + off)]
    passed, gate = through([*sane[:100], *stray, *sane[100:]])
    assert passed == sane
    assert gate.dropped == {f'{kind}: {STRAY}': 1 for kind in (JOINTS, POSES)}


@pytest.mark.parametrize('off', [-1e7, -30.0, 30.0, 1e7])
@pytest.mark.parametrize('rate', [2.0, 10.0, 1000.0])
def test_a_clock_that_was_moved_is_followed(off, rate):
    before = both(100.0 + np.arange(50) * 0.1)
    after = both(100.0 + off + np.arange(50) / rate)
    passed, gate = through([*before, *after])
    given = before + after
    assert passed + [m for held in gate.release() for m in back(held, given)] == given
    assert not gate.dropped


def test_a_stray_stamp_among_those_that_were_moved_holds_nothing_up():
    before, after = both(np.arange(100.0, 105.0, 0.1)), both(np.arange(500.0, 510.0, 0.1))
    passed, gate = through([*before, (JOINTS, 1e6), *after])
    assert [each for each in passed if each != (JOINTS, 1e6)] == before + after
    assert gate.held(JOINTS) == gate.held(POSES) == 0


def test_one_stop_in_minutes_is_measured_at_once():
    """What is far from its own neighbours may be near to those of the other stream."""
    joints = [(JOINTS, time) for time in np.arange(0.0, 900.0, 0.5)]
    poses = [(POSES, time) for time in (10.0, 310.0, 610.0, 890.0)]
    given = sorted([*joints, *poses], key=lambda each: each[1])
    assert through(given)[0] == given


def test_measurements_may_come_long_before_their_joint_states():
    poses = [(POSES, time) for time in (0.0, 5.0, 10.0)]
    joints = [(JOINTS, time) for time in np.arange(0.0, 12.0, 0.1)]
    passed, gate = through([*poses, *joints])
    assert sorted(passed) == sorted([*poses, *joints])
    assert not gate.dropped
    for message in poses[1:]:  # each as soon as the joints are near
        following = passed[passed.index(message) + 1 :]
        assert min(time for _, time in following) == pytest.approx(message[1] - 0.9, abs=0.11)


@given(
    st.lists(
        st.tuples(
            st.sampled_from([JOINTS, POSES]), st.sampled_from([0.0, 0.5, 30.0, 31.0, -70.0, 1e6])
        ),
        max_size=200,
    )
)
def test_every_message_passes_is_held_back_or_is_counted(messages):
    passed, gate = through(messages)
    assert len(passed) + count(gate) == len(messages)
    assert max(gate.held(JOINTS), gate.held(POSES)) < NO_ACCIDENT


@given(
    st.lists(
        st.tuples(
            st.sampled_from([JOINTS, POSES]),
            st.sampled_from([0.0, 0.3, 0.9, 1.2, 30.0, 30.5, -70.0]),
        ),
        max_size=120,
    ),
    st.integers(1, 50),
)
def test_slices_pass_as_single_messages_do(messages, size):
    """Within a second of the one before of its kind a message passes at once, whatever is held."""
    one, many = Gate(1.0), Gate(1.0)
    single = [m for each in messages for m in passing(one, [each])]
    parts = [messages[k : k + size] for k in range(0, len(messages), size)]
    assert [m for part in parts for m in passing(many, part)] == single
    assert (one.dropped, one.held(JOINTS)) == (many.dropped, many.held(JOINTS))


def test_joint_states_far_back_are_stray_though_a_measurement_is_near():
    given = [(POSES, 0.3), (JOINTS, 0.9), (JOINTS, 1.8), (JOINTS, 0.5), (JOINTS, 2.0)]
    passed, gate = through(given, far=1.0)
    assert passed == [*given[:3], given[4]]
    assert gate.dropped == {f'joints: {STRAY}': 1}


def passing(gate, messages):
    return [
        (each.kind, int(each.stamps[0]))
        for found, _ in gate.admit(sliced(messages))
        for k in range(len(found))
        for each in found.between(k, k + 1).pieces
    ]


# In a session

TIMES, MEASURED = np.arange(0.0, 12.0, 0.02), np.arange(0.003, 12.0, 0.15)
MOTION = stops(ARM.random_joints(12, np.random.default_rng(2)), 0.4, 0.6)
SEEN = ARM.forward(MOTION(MEASURED))


def played(session, off=0, came=TIMES, seen=MEASURED, count=None):
    """Let a session hear a recording with stamps some seconds off, or the first of its messages.

    These are `count` of each kind; they come at some times [s].
    """
    shift, some = np.int64(off * S), slice(count)
    joints = came, stamps(TIMES) + shift, MOTION(TIMES)
    poses = seen, stamps(MEASURED) + shift, SEEN[:, :3, 3], SEEN[:, :3, :3]
    hear(session, [each[some] for each in joints], [each[some] for each in poses])
    return session


@pytest.fixture
def alone():
    """Return the samples of the recording that is played once."""
    session = played(CalibrationSession(ARM))
    session.finish()
    assert len(session.samples) == 12
    return session.samples


@pytest.mark.parametrize('off', [10_000, -10_000])
def test_the_first_messages_may_be_the_stray_ones(alone, off):
    found = played(played(CalibrationSession(ARM), off, count=1))
    found.finish()
    assert_same(found.samples, alone)


@pytest.mark.parametrize('off', [-10_000, 10_000])
def test_a_recording_that_is_played_again_later_or_earlier_gives_its_samples_twice(alone, off):
    found = played(played(CalibrationSession(ARM)), off)
    found.finish()
    once = [sample.stamp_ns for sample in alone]
    later = [stamp + off * S for stamp in once]
    assert [sample.stamp_ns for sample in found.samples] == once + later
    assert not found.account().dropped


@pytest.mark.parametrize('seed', range(3))
def test_a_recording_played_again_counts_one_jump_however_it_comes(seed):
    """On a busy machine each topic comes in bursts of its own."""
    rng, session = np.random.default_rng(seed), CalibrationSession(ARM)
    for again, off in enumerate((0, 0, -3600)):
        bursts = [np.cumsum(rng.uniform(0.05, 3.0, 40)) for _ in range(2)]
        came, seen = (
            edges[np.searchsorted(edges, t)]
            for edges, t in zip(bursts, (TIMES, MEASURED), strict=True)
        )
        played(session, off, came, seen)
        assert session.account().notes.get('the clock jumped back', 0) == again


@pytest.mark.parametrize(
    ('mode', 'jump', 'off'),
    [
        *(('continuous', 2.5, -1.6), ('dwell', 6.5, -1.6), ('dwell', 6.95, -1.6)),
        *(('dwell', jump, -1.2) for jump in (6.2, 6.5, 6.8)),
    ],
)
def test_joints_of_before_a_jump_back_do_not_mix_with_those_after_it(mode, jump, off):
    """While the delay was estimated, or if the jump was short, both were on one track."""
    motion = sweep(6, np.random.default_rng(3)) if mode == 'continuous' else MOTION
    session, end = CalibrationSession(ARM, Settings(mode=mode)), 24.0
    times, seen = np.arange(0.0, end, 0.02), np.arange(0.003, end, 0.05)
    clocks = [t + np.where(t < jump, 0.0, off) for t in (times, seen)]
    poses = ARM.forward(motion(seen))
    joints = times, stamps(clocks[0]), motion(times)
    hear(session, joints, (seen, stamps(clocks[1]), poses[:, :3, 3], poses[:, :3, :3]))
    session.finish()
    assert session.account().notes['the clock jumped back'] == 1
    assert not any('different values' in cause for cause in session.account().dropped)
    away = [ARM.forward(s.joints[np.newaxis])[0, :3, 3] - s.position for s in session.samples]
    assert len(away) > (10 if mode == 'dwell' else 300)
    assert np.abs(away).max() < 1e-3
