# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A real node in real rclpy when something goes wrong: kills, full disks, dead sources."""

import resource
import signal
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_cell import (
    START,
    STOPS,
    Cell,
    Child,
    assert_same,
    direct,
    joint_messages,
    pose_messages,
    stamp_ns,
    topics,
    values_of,
)
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from calib_ros.errors import ConfigError
from calib_ros.files.archive import Archive
from calib_ros.files.tables import read_journal
from calib_ros.ros import inputs as inputs_module
from calib_ros.ros import node as node_module
from calib_ros.ros.advisor import Guide
from calib_ros.ros.diagnostics import Diagnostics
from calib_ros.ros.outputs import Keeper
from calib_ros.sampling.session import CalibrationSession

BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.fixture
def journal(tmp_path, recording):
    """Return a folder with the journal of a whole shift."""
    archive = Archive(tmp_path, 'ur10e', 6, lambda: '')
    session = direct(recording)
    session.finish()
    for sample in session.samples:
        archive.add(sample)
    archive.close()
    return tmp_path


def part(recording, first, last):
    """Return the messages of a time [s] by topic."""
    return {
        topic: [m for m in messages if first <= (stamp_ns(m) - START) * 1e-9 < last]
        for topic, messages in topics(recording).items()
    }


def begun(folder):
    return any(path.stat().st_size for path in folder.glob('*Z.csv'))


def samples_in(folder):
    (path,) = folder.glob('*Z.csv')
    return read_journal(path, 6)[0]


@contextmanager
def cell_and_child(**parameters):
    """Start a peer and a node in a child process, which misses nothing.

    Each child has a peer and a domain of its own: DDS takes a killed one to be alive for a while.
    """
    reliable = {
        f'qos_overrides./{topic}.subscription.reliability': 'reliable'
        for topic in ('joint_states', 'measured_pose')
    }
    with (
        Cell() as cell,
        Child(domain=cell.domain, chain='ur10e', **reliable, **parameters) as child,
    ):
        reports = cell.listen(DiagnosticArray, '/diagnostics', 10)
        probes = [
            (cell.publisher(JointState, 'joint_states'), JointState()),
            (cell.publisher(PoseStamped, 'measured_pose'), PoseStamped()),
        ]

        def hears():  # that the peer knows of the child does not say that it hears the peer
            for publisher, probe in probes:
                publisher.publish(probe)
            values = {v.key: v.value for r in reports[-1:] for v in r.status[0].values}
            return all(int(values.get(stream, 0)) for stream in ('joint states', 'poses'))

        cell.spin_until(hears)
        yield cell, child


# Killed


def test_a_node_killed_in_its_first_run_goes_on_with_all_its_samples(
    monkeypatch, tmp_path, recording
):
    monkeypatch.setenv('HOME', str(tmp_path))
    monkeypatch.delenv('ROS_HOME', raising=False)
    monkeypatch.delenv('ROS_LOG_DIR', raising=False)
    folder = tmp_path / '.ros' / 'calib_ros'
    with cell_and_child() as (cell, child):
        cell.play(part(recording, 0.0, 12.0))
        cell.spin_until(lambda: begun(folder))
        cell.spin_until(lambda: len(samples_in(folder)) == 10)
        child.kill()
    (path,) = folder.glob('*Z.csv')
    with path.open('a') as file:
        file.write('1700000000,0.1,0.')  # a row that a crash of the machine cut off
    with cell_and_child(resume='true') as (cell, child):
        output = child.wait_for('ready to calibrate')
        assert 'was cut off and is left out' in output
        assert f'resumed 10 samples of {path}' in output
        cell.play(part(recording, 12.0, 24.0))
        cell.spin_until(lambda: len(samples_in(folder)) == 20)
        answer = cell.call('identify')
        assert answer.success, answer.message
        assert '22 samples' in answer.message  # two stops waited when it was killed
    expected = direct(recording)
    expected.finish()
    survived = [s for s in expected.samples if not 10.0 < (s.stamp_ns - START) * 1e-9 < 12.0]
    for kept, sample in zip(samples_in(folder), survived, strict=True):
        assert kept.stamp_ns == sample.stamp_ns
        np.testing.assert_array_equal(kept.joints, sample.joints)
        np.testing.assert_array_equal(kept.position, sample.position)


SLOW_SAVE = """
import os, time
sync = os.fsync
saved = []
def slow(file):
    sync(file)
    name = os.readlink(f'/proc/self/fd/{file}')
    if '.yaml' in name and name.endswith('.partial'):
        saved.append(name)
        if len(saved) > 2:  # the settings and the calibration of the first time
            print('in the middle of saving', flush=True)
            time.sleep(60.0)
os.fsync = slow
"""
SLOW_IDENTIFICATION = """
import time
from calib_ros.ros import identifying, node
def identify_model(problem, model, progress):
    print('identifying', flush=True)
    time.sleep(60.0)
identifying.identify_model = identify_model
close = node.CalibrationNode.close
def noisy(self):
    print('joining', flush=True)
    return close(self)
node.CalibrationNode.close = noisy
"""
RUN = """
import sys
from calib_ros.ros.node import main
sys.exit(main())
"""


def test_killed_while_it_saves(journal):
    command = ('-c', SLOW_SAVE + RUN)
    with cell_and_child(data_dir=journal, resume='true', command=command) as (cell, child):
        assert cell.call('identify').success
        assert cell.call('save').success
        saved = sorted(journal.glob('*Z*.yaml'))
        contents = [path.read_text() for path in saved]
        cell.start_call('save')
        child.wait_for('in the middle of saving')
        child.kill()
    assert sorted(journal.glob('*Z*.yaml')) == saved
    assert [path.read_text() for path in saved] == contents
    with Cell(chain='ur10e', data_dir=str(journal)) as cell:
        loaded = cell.call('load')
        assert loaded.success, loaded.message
        assert str(next(journal.glob('*Z.yaml'))) in loaded.message


def test_ended_while_an_identification_runs(journal):
    command = ('-c', SLOW_IDENTIFICATION + RUN)
    with cell_and_child(data_dir=journal, resume='true', command=command) as (cell, child):
        cell.start_call('identify')
        child.wait_for('identifying')
        child.process.send_signal(signal.SIGTERM)
        child.process.send_signal(signal.SIGINT)  # a second one harms nothing
        child.wait_for('joining')
        child.process.send_signal(signal.SIGINT)
        assert child.end() == 0, child.output
        assert 'Traceback' not in child.output


def test_the_last_stop_is_kept_at_the_end(tmp_path, recording):
    with Cell(chain='ur10e', data_dir=str(tmp_path)) as cell:
        cell.play(topics(recording))
        assert len(cell.node.session.samples) == STOPS - 2
    assert len(samples_in(tmp_path)) == STOPS


def test_a_node_that_could_keep_no_samples_does_not_start(capsys, ended_by):
    folder = '/proc/nope'
    assert ended_by('chain:=ur10e', f'data_dir:={folder}') == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert f'samples cannot be kept in {folder}' in line
    assert 'set data_dir' in line


# A full disk


def test_a_full_disk(tmp_path, recording):
    with cell_and_child(data_dir=tmp_path) as (cell, child):
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        status = cell.listen(String, '/calibration_node/status')
        cell.play(part(recording, 0.0, 6.0))
        cell.spin_until(lambda: begun(tmp_path))
        cell.spin_until(lambda: len(samples_in(tmp_path)) == 4)
        (path,) = tmp_path.glob('*Z.csv')
        _, hard = resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE)
        full = path.stat().st_size + 100  # there is room for a part of the next row
        resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE, (full, hard))
        cell.play(part(recording, 6.0, 24.0))

        def level(wanted, said):
            cell.spin_until(lambda: heard and heard[-1].status[0].level == wanted)
            assert said in heard[-1].status[0].message

        level(DiagnosticStatus.ERROR, 'samples are in memory only')
        cell.spin_until(lambda: status[-1].data.startswith('samples are in memory only: '))
        assert heard[-1].status[0].message.count('in memory only') == 1
        cell.spin_until(lambda: values_of(heard[-1])['samples'] == '22')
        assert len(samples_in(tmp_path)) == 4
        answer = cell.call('clear')
        assert not answer.success
        assert 'samples are in memory only and would be lost' in answer.message
        answer = cell.call('identify')
        assert answer.success, answer.message
        resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE, (100, hard))
        unsaved = cell.call('save')
        assert not unsaved.success
        assert 'File too large' in unsaved.message
        assert unsaved.message.endswith('write to another place')
        assert [each.name for each in tmp_path.iterdir() if 'yaml' in each.name] == [
            path.with_suffix('.settings.yaml').name
        ]
        resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE, (hard, hard))
        level(DiagnosticStatus.OK, 'samples')
        cell.spin_until(lambda: 'memory' not in status[-1].data)
        assert len(samples_in(tmp_path)) == STOPS
        assert cell.call('save').success
        assert child.end(signal.SIGINT) == 0
        assert child.output.count('samples are kept in memory only') == 1


# Sources


BROKEN = {
    'taking messages': (node_module, 'feed'),
    'the corrected pose': (Keeper, 'publish_pose'),
    'the journal': (Archive, 'write'),
    'the status': (CalibrationSession, 'status'),
    'the next pose': (Guide, 'advise'),
    'the account': (CalibrationSession, 'account'),
    'judging': (Diagnostics, '_judged'),
    'the figures': (Guide, 'figures'),
}


@pytest.mark.parametrize('what', BROKEN)
def test_a_part_that_fails_does_not_silence_the_others(monkeypatch, cell, recording, what):
    """It is told at level ERROR, and everything is as before when it works again."""
    diagnostics = cell.listen(DiagnosticArray, '/diagnostics', 10)
    status = cell.listen(String, '/calibration_node/status')
    cell.play(part(recording, 0, 10))

    def fail(*arguments):
        raise ZeroDivisionError(f'{what} is broken')

    with monkeypatch.context() as broken:
        broken.setattr(*BROKEN[what], fail)
        cell.spin_until(lambda: diagnostics and what in diagnostics[-1].status[0].message)
        found = diagnostics[-1].status[0]
        assert found.level == DiagnosticStatus.ERROR
        assert f'{what} failed' in found.message
        assert f'{what} is broken' in found.message
        assert (what != 'the status') == ('samples' in found.message)
        assert (what in ('the account', 'the figures')) == (not found.values)
        if what not in ('taking messages', 'the status'):
            heard = len(status)
            cell.play(part(recording, 10, 13))
            cell.spin_until(lambda: len(status) > heard)
    count = len(diagnostics)
    cell.spin_until(lambda: len(diagnostics) > count + 2)
    found = diagnostics[-1].status[0]
    assert found.level in (DiagnosticStatus.OK, DiagnosticStatus.WARN)
    assert 'failed' not in found.message
    assert 'samples' in found.message
    assert int(values_of(diagnostics[-1])['samples']) >= 8


def test_a_source_that_dies_and_comes_back(monkeypatch, cell, recording):
    monkeypatch.setattr(inputs_module, 'SILENCE', 0.4)
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    joints, poses = topics(recording).values()
    arm = cell.publisher(JointState, 'joint_states')
    tracker = cell.publisher(PoseStamped, 'measured_pose')
    alive = [arm, tracker]

    def publish():
        for publisher, messages in ((arm, joints), (tracker, poses)):
            if publisher in alive:
                publisher.publish(messages[0])

    cell.peer.create_timer(0.05, publish)

    def wait_for(said, wanted=True):
        cell.spin_until(lambda: heard and (said in heard[-1].status[0].message) == wanted)

    silent = 'nothing is heard on /measured_pose any more'
    cell.spin_until(lambda: heard and 'rate of /measured_pose [Hz]' in values_of(heard[-1]))
    alive.remove(tracker)
    wait_for(silent)
    assert heard[-1].status[0].level == DiagnosticStatus.WARN
    assert '/joint_states' not in heard[-1].status[0].message
    alive.append(tracker)
    wait_for(silent, wanted=False)
    alive.clear()
    wait_for('nothing is heard on /joint_states any more')


def test_a_bag_that_is_played_again(cell, recording):
    cell.play(topics(recording))
    cell.node.session.problem()
    before = {sample.stamp_ns for sample in cell.node.session.samples}
    hour = 3_600_000_000_000
    earlier = replace(
        recording,
        joint_stamps_ns=recording.joint_stamps_ns - hour,
        poses=recording.poses.at(recording.poses.stamps_ns - hour),
    )
    for jumps, played, new in ((1, recording, 1), (2, earlier, STOPS)):
        cell.play(topics(played))
        cell.node.session.problem()
        account = cell.node.session.account()
        assert account.notes['the clock jumped back'] == jumps
        fresh = {sample.stamp_ns for sample in cell.node.session.samples} - before
        # The measurements before the jump shows are lost: the first stop gets another stamp.
        assert new - 1 <= len(fresh) <= new
        before |= fresh
    answer = cell.call('identify')
    assert answer.success, answer.message


@pytest.mark.parametrize('mode', ['dwell', 'continuous'])
def test_a_late_tracker_and_messages_out_of_order(tmp_path, recording, mode):
    expected = direct(recording, mode=mode).problem().observations
    parameters = {'chain': 'ur10e', 'mode': mode, 'data_dir': str(tmp_path)}
    with Cell(**parameters) as cell:
        cell.play(topics(recording), late_ns=200_000_000)
        assert_same(expected, cell.node.session.problem().observations)
        account = cell.node.session.account()
        assert (account.dropped, account.notes) == ({}, {})
        assert cell.call('clear').success
        cell.play(topics(recording), jitter=np.random.default_rng(4))
        assert_same(expected, cell.node.session.problem().observations)
        account = cell.node.session.account()
        assert account.dropped == {}
        assert account.notes['joints with a stamp older than the one before'] > 100


def test_a_tracker_that_is_too_late_is_counted(cell, recording):
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    cell.play(topics(recording), late_ns=4_000_000_000)
    account = cell.node.session.account()
    late = account.dropped['poses: later than lateness allows']
    assert late + account.waiting == len(recording.poses)
    said = 'messages are dropped (poses: later than lateness allows)'
    cell.spin_until(lambda: any(said in message.status[0].message for message in heard))


def test_a_target_that_was_moved_shows_in_the_status(cell, recording):
    some = pose_messages(recording.poses)
    for message in some[80:]:
        message.pose.position.z += 0.02
    words = cell.listen(String, 'calibration_node/status')
    cell.play(part(recording, 0.0, 20.0))
    cell.spin_until(lambda: words and '; 18 samples' in words[-1].data)
    assert 'fit' not in words[-1].data
    joints = topics(recording)['joint_states'][1000:]
    cell.play({'joint_states': joints, 'measured_pose': some[80:]})
    said = 'does not fit to the others, was the target moved?'
    cell.spin_until(lambda: said in words[-1].data)


# Messages that do not fit


def test_poses_in_different_frames_are_refused(cell, recording):
    some = pose_messages(recording.poses)
    for message in some[40:70]:
        message.header.frame_id = 'camera'
    words = cell.listen(String, 'calibration_node/status')
    cell.play(topics(recording, measured_pose=some))
    cell.spin_until(lambda: words and 'different frames (camera, tracker)' in words[-1].data)
    answer = cell.call('identify')
    assert not answer.success
    assert 'different frames (camera, tracker)' in answer.message
    assert 'set frame_id' in answer.message
    assert cell.set_parameters({'frame_id': 'tracker'})[0].successful
    answer = cell.call('identify')  # the advice helps, at once
    assert answer.success, answer.message


def test_one_stray_frame_does_not_stop_the_cell(cell, recording):
    some = pose_messages(recording.poses)
    some[40].header.frame_id = 'camera'
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    cell.play(topics(recording, measured_pose=some))
    said = 'poses: in frame "camera", not in "tracker" as others'
    cell.spin_until(lambda: heard and f'dropped {said}' in values_of(heard[-1]))
    answer = cell.call('identify')
    assert answer.success, answer.message


def test_stray_stamps_are_told_and_cost_nothing_else(cell, recording):
    joints, poses = topics(recording).values()
    for messages, where in ((joints, 600), (poses, 40)):
        messages[where].header.stamp.sec += 10_000_000
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    arm = cell.publisher(JointState, 'joint_states')
    cell.play({'joint_states': joints[:600], 'measured_pose': poses[:40]})
    arm.publish(joints[600])
    cell.publisher(PoseStamped, 'measured_pose').publish(poses[40])
    cell.spin_until(lambda: cell.node.session.received == {'joints': 601, 'poses': 41})
    cell.play({'joint_states': joints[601:], 'measured_pose': poses[41:]})
    cause = 'stamp far from those before and after'
    keys = {f'dropped joints: {cause}', f'dropped poses: {cause}'}
    cell.spin_until(lambda: heard and keys <= set(values_of(heard[-1])))
    assert any('messages are dropped' in message.status[0].message for message in heard)
    assert {values_of(heard[-1])[key] for key in keys} == {'1'}
    answer = cell.call('identify')
    assert answer.success, answer.message
    assert len(cell.node.session.samples) == STOPS


def test_poses_in_another_frame_than_frame_id_are_dropped(tmp_path, recording):
    some = pose_messages(recording.poses)
    some[40].header.frame_id = 'camera'
    with Cell(chain='ur10e', data_dir=str(tmp_path), frame_id='tracker') as cell:
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        cell.spin_until(lambda: heard)
        cell.play(topics(recording, measured_pose=some))
        cell.spin_until(lambda: any('messages are dropped' in m.status[0].message for m in heard))
        said = 'poses: in frame "camera", not in frame_id "tracker"'
        assert cell.node.session.account().dropped == {said: 1}
        assert values_of(heard[-1])[f'dropped {said}'] == '1'
        answer = cell.call('identify')
        assert answer.success, answer.message


@pytest.mark.parametrize('all_renamed', [True, False])
def test_a_renamed_joint_is_named(cell, recording, all_renamed):
    names = [name.replace('_joint', '') for name in recording.joint_names]
    if not all_renamed:
        names = [*recording.joint_names[:5], 'tool0']
    words = cell.listen(String, 'calibration_node/status')
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    cell.play(topics(recording, joint_states=joint_messages(recording, names)))
    answer = cell.call('identify')
    assert not answer.success
    assert 'set joint_names' in answer.message
    assert names[5] in cell.in_full(answer)
    said = 'waiting for joint states, set joint_names? Those that come name '
    cell.spin_until(lambda: words and words[-1].data.startswith(said))
    missing = recording.joint_names if all_renamed else recording.joint_names[5:]
    whole = f'{said}{", ".join(sorted(names))}, not {", ".join(missing)}; '
    cell.spin_until(lambda: heard and whole in heard[-1].status[0].message)


def test_broken_messages_are_counted_by_cause(cell, recording):
    joints, poses = topics(recording).values()
    joints[3].position[2] = float('nan')
    joints[4].position.pop()
    joints[5].header.stamp.sec = joints[5].header.stamp.nanosec = 0
    poses[8].pose.position.x = float('inf')
    poses[9].pose.orientation.w = 3.0
    poses[10].pose.orientation.x = float('nan')
    cell.play({'joint_states': joints, 'measured_pose': poses})
    assert cell.node.session.account().dropped == {
        'joints: NaN or infinite joint value': 1,
        'joints: names and positions differ in number': 1,
        'joints: zero stamp': 1,
        'poses: NaN or infinite position': 1,
        'poses: quaternion not of length 1': 2,
    }
    assert cell.call('identify').success


def test_an_overridden_qos(tmp_path, recording):
    override = {'qos_overrides./joint_states.subscription.reliability': 'reliable'}
    with Cell(chain='ur10e', data_dir=str(tmp_path), **override) as cell:
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        deaf = cell.peer.create_publisher(JointState, 'joint_states', BEST_EFFORT)
        cell.spin_until(
            lambda: (
                heard
                and '/joint_states is published best effort, but reliable is asked for'
                in heard[-1].status[0].message
            )
        )
        assert heard[-1].status[0].level == DiagnosticStatus.WARN
        deaf.publish(joint_messages(recording)[0])
        cell.play(topics(recording))
        assert cell.node.session.received['joints'] == len(recording.joints)
        assert cell.call('identify').success
        cell.spin_until(lambda: 'best effort' not in heard[-1].status[0].message)


def test_a_topic_of_another_type_is_told(cell):
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    context = rclpy.Context()  # a participant of its own: one has one type for each topic
    rclpy.init(context=context, args=[], domain_id=cell.domain)
    other = Node('other', context=context)
    other.create_publisher(PointStamped, 'measured_pose', 10)
    said = '/measured_pose is published as geometry_msgs/msg/PointStamped, not as'
    cell.spin_until(lambda: heard and said in heard[-1].status[0].message)
    assert heard[-1].status[0].level == DiagnosticStatus.WARN
    other.destroy_node()
    cell.spin_until(lambda: said not in heard[-1].status[0].message)
    context.try_shutdown()


@pytest.mark.parametrize(
    ('policy', 'value', 'said'),
    [
        ('reliability', 'often', 'often'),
        ('reliability', 'unknown', 'qos_overrides for "joint_states" cannot be'),
        ('history', 'sometimes', 'sometimes'),
        ('history', 'unknown', 'qos_overrides for "joint_states" cannot be'),
        ('depth', 0, 'must be >= 1'),
        ('reliabilty', 'reliable', r'did you mean .*/joint_states.subscription.reliability'),
        ('durability', 'volatile', 'unknown parameter'),
    ],
)
def test_a_qos_that_there_is_not_is_refused(tmp_path, policy, value, said):
    override = {f'qos_overrides./joint_states.subscription.{policy}': value}
    with pytest.raises(ConfigError, match=said), Cell() as cell:
        cell.start(chain='ur10e', data_dir=str(tmp_path), **override)


def test_an_overridden_qos_leaves_other_topics_alone(tmp_path):
    override = {'qos_overrides./joint_states.subscription.reliability': 'reliable'}
    with Cell(chain='ur10e', data_dir=str(tmp_path), **override) as cell:

        def offered(topic):
            return [each.qos_profile.reliability for each in infos(topic)]

        def infos(topic):
            return cell.peer.get_subscriptions_info_by_topic(topic)

        cell.spin_until(lambda: infos('/joint_states') and infos('/measured_pose'))
        assert offered('/joint_states') == [ReliabilityPolicy.RELIABLE]
        assert offered('/measured_pose') == [ReliabilityPolicy.BEST_EFFORT]


def test_a_queue_that_was_full_is_told(tmp_path, recording):
    override = {'qos_overrides./joint_states.subscription.depth': 5}
    with Cell(chain='ur10e', data_dir=str(tmp_path), **override) as cell:
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        publisher = cell.publisher(JointState, 'joint_states')
        for message in joint_messages(recording)[:20]:
            publisher.publish(message)
        cell.spin_until(
            lambda: any('messages get lost on /joint_states' in r.status[0].message for r in heard)
        )
        assert cell.node.session.received['joints'] < 20
        assert int(values_of(heard[-1])['queue of /joint_states full']) > 0
        cell.spin_until(lambda: 'get lost' not in heard[-1].status[0].message)


def test_what_is_lost_while_the_process_stands_still_is_counted(tmp_path, recording):
    with Cell() as cell, Child(domain=cell.domain, chain='ur10e', data_dir=tmp_path) as child:
        reports = cell.listen(DiagnosticArray, '/diagnostics', 10)
        publisher = cell.publisher(JointState, 'joint_states', ReliabilityPolicy.BEST_EFFORT)

        def told():
            values = values_of(reports[-1]) if reports else {}
            names = 'joint states', 'lost on /joint_states'
            return [int(values.get(name, 0)) for name in names]

        sent = 0
        message = joint_messages(recording)[0]

        def heard():
            nonlocal sent
            publisher.publish(message)
            sent += 1
            return told()[0] > 0

        cell.spin_until(heard)
        count = len(reports)
        cell.spin_until(lambda: len(reports) >= count + 2)
        first = sent - sum(told())

        def flood():
            child.process.send_signal(signal.SIGSTOP)
            for _ in range(3000):
                publisher.publish(message)
            child.process.send_signal(signal.SIGCONT)
            publisher.publish(message)

        flood()
        cell.spin_until(lambda: told()[1] > 0)
        count = len(reports)
        cell.spin_until(lambda: len(reports) >= count + 2)
        missing = sent + 3001 - first - told()[0]
        flood()  # DDS may tell the rest of a loss with the next one only
        cell.spin_until(lambda: told()[1] >= missing)


def test_what_dds_tells_of_losses_never_goes_below_zero():
    """A total of -2147483645 came as 18446744071562067971 once."""
    heard = inputs_module.Hearing()
    for total, lost in (
        (3, 3),
        (2**64 - 2147483645, 3),
        (2**64 - 2147483640, 8),
        (5, 8),
        (9, 12),
        (9, 12),
    ):
        heard.note_lost(total)
        assert heard.lost == lost


def test_a_count_of_losses_goes_on_where_it_overflows():
    heard = inputs_module.Hearing()
    for total in (2**29, 2**30, 3 * 2**29, 2**31 - 1, 2**64 - 2**31, 2**64 - 2**31 + 2):
        heard.note_lost(total)
    assert heard.lost == 2**31 + 2


def test_two_nodes_of_one_name_are_told(cell, tmp_path):
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    logged = cell.log()
    said = '2 nodes are called /calibration_node'
    cell.spin_until(lambda: heard)
    assert said not in heard[-1].status[0].message
    other = cell.start(chain='ur10e', data_dir=str(tmp_path / 'other'))
    cell.spin_until(lambda: said in heard[-1].status[0].message)
    assert heard[-1].status[0].level == DiagnosticStatus.WARN
    cell.spin_until(lambda: any(said in each.msg for each in logged))
    cell.executor.remove_node(other)
    cell.nodes.remove(other)
    assert other.close()
    count = len(heard)
    cell.spin_until(lambda: len(heard) > count and said not in heard[-1].status[0].message)


# Requests that are too large


def test_a_list_without_end_is_refused(cell):
    for entries, said in (
        ([f'joint_{k}.a' for k in range(100_000)], 'fixed has 100000 entries, at most 1000'),
        (['x' * 100_000], 'an entry of 100000 characters'),
    ):
        (result,) = cell.set_parameters({'fixed': entries})
        assert not result.successful
        assert said in result.reason
        assert len(result.reason) <= 400
    assert cell.node.session.settings.fixed == ()


def test_a_negative_time_does_not_end_the_node(tmp_path):
    with Cell(chain='ur10e', data_dir=str(tmp_path), use_sim_time=True) as cell:
        clock = cell.publisher(Clock, '/clock')
        stamps = cell.listen(DiagnosticArray, '/diagnostics', 10)
        logged = cell.log()

        def publish_until(seconds, predicate):
            clock.publish(Clock(clock=Time(sec=seconds)))
            cell.spin_until(predicate)

        said = 'negative times on /clock are not used'
        publish_until(-(2**31), lambda: any(said in each.msg for each in logged))
        publish_until(7, lambda: stamps and stamps[-1].header.stamp.sec == 7)
        count = len(stamps)
        publish_until(-3, lambda: len(stamps) > count + 1)
        assert stamps[-1].header.stamp.sec == 7


def test_what_comes_out_after_the_end_is_no_error(tmp_path, capfd):
    with Cell(chain='ur10e', data_dir=str(tmp_path)) as cell:
        node = cell.node
    node._boundary.guarded(node._status.publish)(String())
    assert 'internal error' not in capfd.readouterr().err
