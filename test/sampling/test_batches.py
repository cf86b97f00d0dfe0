# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages taken by the batch, as if each were taken by itself."""

from functools import partialmethod

import numpy as np
import pytest
from recorded import TYPESTORE, joint_state, point_stamped, pose_stamped
from streams import hear, stamps, stops

from calib_ros import CalibrationSession, Settings, load_chain
from calib_ros.apply.simulation import Cell, drive, faulty, measure
from calib_ros.kinematics.se3 import to_quat
from calib_ros.sampling.batches import batches, feed
from calib_ros.sampling.collector import ADVANCE_NS
from calib_ros.sampling.messages import JOINT_STATE
from calib_ros.sampling.slices import Part
from calib_ros.sampling.sources import Source
from calib_ros.sampling.streams import Stream

ARM = load_chain('ur10e')
POSE, POINT = 'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/PointStamped'
JOINTS = Stream('joints', JOINT_STATE)
GRIPPER = Stream('gripper', JOINT_STATE)
TRACKER = Stream('tracker', POSE, Source('tracker', POSE))
CAMERA = Stream('camera', POINT, Source('camera', POINT, device='camera'))
START = 1_700_000_000_000_000_000
RARE = 0.003
WHOLE = tuple(range(6))


def written(stream, message):
    return stream, bytes(TYPESTORE.serialize_cdr(message, stream.type))


def joints(stream, stamp_ns, names, values):
    return written(stream, joint_state(stamp_ns, values, names))


def pose(*given):
    return written(TRACKER, pose_stamped(*given))


def point(stamp_ns, position):
    return written(CAMERA, point_stamped(stamp_ns, position))


def shift(rng, stops=3):
    """Return messages of a shift with what may go wrong, in the order in which they come."""
    cell = Cell(joint_rate=64.0, move=0.7, dwell=0.6)
    true = faulty(ARM, Cell(), rng)
    stamps, values, _ = drive(ARM.random_joints(stops, rng), cell, START)
    seen = measure(true, values, rng, 5e-5, 2e-4)
    quats = to_quat(seen.rotations)
    found = []

    def stray(stamp_ns):
        return stamp_ns + (int(rng.choice([-(10**13), -(10**10), 10**10, 10**13])))

    def come(stamp_ns, message):
        late = rng.exponential(0.05) + (rng.random() < 0.02) * rng.uniform(0.0, 3.0)
        found.append((stamp_ns * 1e-9 + late, message))

    for k, stamp in enumerate(stamps.tolist()):
        row = values[k].copy()
        row[2] = np.nan if rng.random() < RARE else row[2]
        given = 0 if rng.random() < RARE else stamp
        given = stray(given) if rng.random() < RARE else given
        order = rng.permutation(6) if rng.random() < RARE else np.arange(6)
        come(stamp, joints(JOINTS, given, [ARM.joint_names[i] for i in order], row[order]))
        if k % 3 == 0:
            others = (['finger'], [0.1]) if k % 2 else (ARM.joint_names[::2], [])
            come(stamp, joints(GRIPPER, stamp, *others))
        frame_id = 'elsewhere' if rng.random() < RARE else 'world'
        place = seen.positions[k] * (np.nan if rng.random() < RARE else 1.0)
        given = stray(stamp) if rng.random() < RARE else stamp
        come(stamp, pose(given + 300_000, place, quats[k], frame_id))
        if k % 2 == 0:
            come(stamp, point(stamp, seen.positions[k]))
    found.sort(key=lambda item: item[0])
    return [message for _, message in found]


def outcome(session):
    """Return all that a session has made of its messages, as plain values.

    What is estimated of the samples is a function of these.
    """
    account = session.account()
    samples = [
        (s.stamp_ns, s.device, s.count, s.joints.tolist(), s.approach.tolist(), s.spread)
        for s in session.samples
    ]
    stamp_ns, values = session.latest or (0, ())
    return account, samples, stamp_ns, list(values), session.delay, session.state, session.warnings


@pytest.mark.parametrize(
    ('mode', 'seed'),
    [('dwell', 0), ('dwell', 1), ('dwell', 4), ('continuous', 2), ('continuous', 3)],
)
def test_a_batch_is_taken_as_its_messages_are(monkeypatch, seed, mode):
    rng = np.random.default_rng(seed)
    if seed == 4:  # the first stream that comes when none is in use takes the only place
        monkeypatch.setattr('calib_ros.sampling.buffers.MOST_NAMES', 1)
    first, second = shift(rng), shift(rng)
    # The clock jumps back when the recording begins again.
    messages = first + (second if seed % 2 else [])
    limits = {'joint_buffer': 150, 'pose_buffer': 40} if seed % 3 == 0 else {}
    settings = Settings(mode=mode, frame_id='' if seed % 3 == 1 else 'world', **limits)
    one, many = CalibrationSession(ARM, settings), CalibrationSession(ARM, settings)
    begin = 0
    while begin < len(messages):
        end = begin + int(rng.choice([1, 10, 100, 400, 3000]))
        one.recording = many.recording = bool(rng.random() < 0.8)
        assert feed(many, messages[begin:end], TYPESTORE.deserialize_cdr) == []
        for message in messages[begin:end]:
            assert feed(one, [message], TYPESTORE.deserialize_cdr) == []
        assert outcome(one) == outcome(many)
        begin = end
    one.finish()
    many.finish()
    assert outcome(one) == outcome(many)
    assert one.samples


def played(come, size):
    """Return what a session makes of (publisher, time [s]) in the order in which they come.

    The publisher names joints by index; none is the tracker.
    """
    session = CalibrationSession(ARM, Settings(mode='continuous', delay=0.001))
    for begin in range(0, len(come), size):
        some, parts = come[begin : begin + size], []
        for publisher in {each for each, _ in some}:
            places = np.array([k for k, each in enumerate(some) if each[0] == publisher])
            times = np.array([some[k][1] for k in places])
            numbers = 0.5 * np.sin(9.0 * times[:, np.newaxis] + np.arange(6.0))
            names, source, columns = ('world',), TRACKER.source, range(3)
            if publisher is not None:
                names, source = ('', *(ARM.joint_names[j] for j in publisher)), None
                columns = publisher
            parts.append(Part(places, source, names, stamps(times), numbers[:, list(columns)]))
        session.take(parts)
    session.finish()
    return outcome(session)


@pytest.mark.parametrize('others', [((0, 1, 2), (3, 4, 5)), ((3, 4, 5), (2, 1, 0))])
def test_a_publisher_that_became_silent_gives_no_cause(others):
    """Live it had been forgotten by then; signs of the last moves were of any publisher."""
    times = np.arange(0.0, 6.0, 0.04)
    come = [
        (publisher, time)
        for time in times.tolist()
        for publisher in (WHOLE, *others, None)
        if time <= 2.0 or publisher is None or (publisher != WHOLE and not 2.42 < time < 2.9)
    ]
    account, *_ = one = played(come, 1)
    assert one == played(come, len(come))
    assert account.dropped['measurements: joint states too far apart'] == 13


def test_a_late_joint_state_changes_nothing_that_is_settled():
    """The one beside it was interpolated anew in a batch, and joint values differed."""
    times = np.arange(0.0, 3.0, 0.04).tolist()
    due = 3 * round(ADVANCE_NS / 4e7 + 0.5)  # a round settles what is older by the lateness
    late = due - round(Settings.lateness / 0.04 - 0.5)
    come = [(WHOLE, time) for time in times if time != times[late]]
    come.insert(due, (WHOLE, times[late]))
    come.insert(late, (None, times[due] - Settings.lateness - 0.0005))
    one = played(come, 1)
    assert one == played(come, len(come))
    assert one[1]


def test_a_clock_that_moves_is_told_alike_however_many_messages_come_at_once(monkeypatch):
    """Live they come by tenths of a second, of a bag by thousands."""
    rng, taken, told = np.random.default_rng(2), CalibrationSession.take, []
    motion = stops(0.5 * ARM.random_joints(40, rng))
    times, measured = np.arange(0.0, 79.0, 0.01), np.arange(0.003, 78.7, 0.02)
    seen = measure(ARM, motion(measured), rng, 2e-5, 1e-4)
    late = measured + np.where(measured > 52.0, 0.15, 0.0)

    def by(session, size, parts):
        for k in range(0, len(times) + len(late), size):
            bits = [part.rows((part.places >= k) & (part.places < k + size)) for part in parts]
            taken(session, [each for each in bits if len(each.places)])

    for size in (100, 12_000):
        monkeypatch.setattr(CalibrationSession, 'take', partialmethod(by, size))
        session = CalibrationSession(ARM, Settings())
        come = late, stamps(late), seen.positions, seen.rotations
        hear(session, (times, stamps(times), motion(times)), come)
        session.finish()
        told.append((session.delay, session.warnings))
    assert told[0] == told[1]
    assert told[0][1]


def test_large_messages_are_batches_of_a_few(monkeypatch):
    """Images by the thousand would fill the memory."""
    monkeypatch.setattr('calib_ros.sampling.batches.LARGEST_TABLE', 100)
    messages = [(TRACKER, bytes(size)) for size in (1, 1, 99, 60, 60, 1, 101, 1)]
    found = list(batches(iter(messages)))
    assert [[len(data) for _, data in batch] for batch, _ in found] == [
        *([1, 1, 99], [60, 60], [1, 101], [1])
    ]
    assert not any(error for _, error in found)


def test_a_damaged_message_is_told_and_the_others_are_taken():
    stamps = [START + k * 10_000_000 for k in range(20)]
    messages = [joints(JOINTS, stamp, ARM.joint_names, np.zeros(6)) for stamp in stamps]
    messages[7] = (JOINTS, messages[7][1][:-60])
    name = ARM.joint_names[0].encode()
    messages[9] = (JOINTS, messages[9][1].replace(name, b'\xff' * len(name)))
    session = CalibrationSession(ARM)
    problems = feed(session, messages, TYPESTORE.deserialize_cdr)
    assert 'a message on joints cannot be decoded: it is cut off' in problems
    assert any("cannot be decoded: 'utf-8' codec" in each for each in problems)
    assert (len(problems), session.received['joints']) == (2, 18)


@pytest.mark.parametrize(('value', 'together'), [(1.79e308, True), (3.4e38, False), (-1e7, True)])
def test_numbers_that_stand_for_nothing_are_dropped(value, together):
    """Some devices send the largest number that there is while they see no target."""
    messages = []
    for k in range(150):
        stamp = START + k * 10_000_000
        lost = k % 5 == 0
        values = np.full(6, value if k % 50 == 1 else 0.3 * np.sin(0.01 * k))
        messages.append(joints(JOINTS, stamp, ARM.joint_names, values))
        place = (0.5, value if lost else 0.4, 0.1)
        messages.append(pose(stamp + 300_000, place, (0.0, 0.0, 0.0, 1.0)))
    session = CalibrationSession(ARM, Settings(mode='continuous', delay=1e-3))
    for begin in range(0, 300, 300 if together else 1):
        part = messages[begin : begin + (300 if together else 1)]
        assert feed(session, part, TYPESTORE.deserialize_cdr) == []
    session.finish()
    dropped = session.account().dropped
    assert dropped['measurements: position beyond 1000 km'] == 30
    assert sum(count for cause, count in dropped.items() if 'joint value' in cause) == 3
    assert len(session.samples) == 120


def test_streams_of_the_same_joints_share_a_buffer():
    """Two drivers name the joints in another order: of equal stamps one sample is kept."""
    row = np.arange(6.0)
    messages = [
        joints(stream, START + k * 1_000_000, ARM.joint_names[::way], row[::way])
        for k in range(60)
        for stream, way in ((JOINTS, 1), (GRIPPER, -1))
    ]
    session = CalibrationSession(ARM, Settings(joint_buffer=150))
    assert feed(session, messages[:2], TYPESTORE.deserialize_cdr) == []
    assert feed(session, messages[2:], TYPESTORE.deserialize_cdr) == []
    session.status()
    assert session.received['joints'] == 120
    assert session.account().unused == {'joints: same stamp twice': 60}
    assert not session.account().dropped
    np.testing.assert_array_equal(session.latest[1], row)


def test_an_error_in_a_batch_costs_no_other_message():
    stamps = [START + k * 10_000_000 for k in range(2000)]
    messages = [
        message
        for stamp in stamps
        for message in (
            joints(JOINTS, stamp, ARM.joint_names, np.zeros(6)),
            pose(stamp, (0.5, 0.5, 0.5), (0.0, 0.0, 0.0, 1.0)),
        )
    ]

    def fail(sample):
        raise RuntimeError('no room for a sample')

    session = CalibrationSession(ARM, on_sample=fail)
    (problem,) = feed(session, messages, TYPESTORE.deserialize_cdr)
    assert 'no room for a sample' in problem
    assert session.received == {'joints': 2000, 'measurements': 2000}
