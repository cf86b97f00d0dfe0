# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import (
    PointStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.qos import ReliabilityPolicy
from ros_cell import Cell, joint_messages, pose_messages
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool

from calib_ros import node as node_module
from calib_ros.config import load_chain, parse_chain
from calib_ros.identification import identify
from calib_ros.replay import Recording, replay, write_bag
from calib_ros.session import CalibrationSession
from calib_ros.simulation import Cell as SimulatedCell
from calib_ros.simulation import drive, faulty, measure


@pytest.fixture(scope='module')
def truth():
    return faulty(load_chain('ur10e'), SimulatedCell(), np.random.default_rng(1))


@pytest.fixture(scope='module')
def recording(truth):
    """Return a short shift: the arm moves to 24 configurations and is measured at each."""
    cell = SimulatedCell(joint_rate=50.0, move=0.4, dwell=0.2, poses_per_dwell=2)
    rng = np.random.default_rng(2)
    configurations = truth.random_joints(24, rng)
    stamps, joints, pose_stamps = drive(configurations, cell, 1_700_000_000_000_000_000)
    poses = measure(truth, np.repeat(configurations, 2, axis=0), rng, 2e-5, 1e-4).at(pose_stamps)
    return Recording(truth.joint_names, stamps, joints, poses, np.zeros(len(poses), bool))


def assert_same(first, second):
    for name in ('stamps_ns', 'joints', 'positions', 'oriented'):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    np.testing.assert_allclose(first.rotations, second.rotations, rtol=0, atol=1e-15)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('executor', [SingleThreadedExecutor, EventsExecutor])
def test_direct_bag_and_live_give_equal_observations(tmp_path, recording, storage, executor):
    joints, poses = joint_messages(recording), pose_messages(recording.poses)
    direct = CalibrationSession(load_chain('ur10e'))
    for message in joints:
        direct.take_joints(message)
    for message in poses:
        direct.take_pose('geometry_msgs/msg/PoseStamped', message)
    replayed = CalibrationSession(load_chain('ur10e'))
    write_bag(tmp_path / 'bag', recording, storage)
    assert replay(tmp_path / 'bag', replayed) == ()
    with Cell(executor, chain='ur10e') as cell:
        cell.publish('measured_pose', poses)
        cell.publish('joint_states', joints, ReliabilityPolicy.BEST_EFFORT)
        live = cell.node.session
        expected = direct.problem().observations
        assert len(expected) == len(recording.poses)
        assert_same(expected, replayed.problem().observations)
        assert_same(expected, live.problem().observations)
        assert live.account() == direct.account() == replayed.account()


@pytest.mark.parametrize('executor', [SingleThreadedExecutor, EventsExecutor])
def test_identify_answers_and_publishes(tmp_path, recording, truth, executor):
    target = tmp_path / 'saved.yaml'
    with Cell(executor, chain='ur10e', target_filename=str(target)) as cell:
        refused = cell.call('save')
        assert not refused.success
        assert 'identify' in refused.message
        cell.publish('joint_states', joint_messages(recording))
        cell.publish('measured_pose', pose_messages(recording.poses))
        answer = cell.call('identify')
        assert answer.success, answer.message
        assert '48 pairs' in answer.message
        assert 'wrist_3_joint.theta' in answer.message
        # Heard although the subscriptions come after the publishing: the topics are latched.
        tables = cell.listen(Float64MultiArray, 'calibration_node/dh_parameters')
        texts = cell.listen(String, 'calibration_node/calibration')
        cell.spin_until(lambda: tables and texts)
        table = tables[0]
        assert [d.label for d in table.layout.dim] == ['joint', 'a,alpha,d,theta,beta']
        assert [d.size for d in table.layout.dim] == [6, 5]
        assert [d.stride for d in table.layout.dim] == [30, 5]
        chain = parse_chain(texts[0].data)
        np.testing.assert_array_equal(np.reshape(table.data, (6, 5)), chain.table)
        unseen = truth.random_joints(200, np.random.default_rng(3))
        error = np.linalg.norm((chain.forward(unseen) - truth.forward(unseen))[:, :3, 3], axis=1)
        assert error.max() < 1e-4
        saved = cell.call('save')
        assert saved.success
        assert str(target) in saved.message
        assert target.read_text() == texts[0].data
        again = cell.call('save')
        assert not again.success
        assert 'exists already' in again.message
        assert target.read_text() == texts[0].data


def test_live_result_equals_the_one_from_arrays(recording):
    expected = identify_arrays(recording)
    with Cell(chain='ur10e') as cell:
        cell.publish('joint_states', joint_messages(recording))
        cell.publish('measured_pose', pose_messages(recording.poses))
        texts = cell.listen(String, 'calibration_node/calibration')
        assert cell.call('identify').success
        cell.spin_until(lambda: texts)
        chain = parse_chain(texts[0].data)
    np.testing.assert_allclose(chain.table, expected.table, rtol=0, atol=1e-9)


def identify_arrays(recording):
    session = CalibrationSession(load_chain('ur10e'))
    for message in joint_messages(recording):
        session.take_joints(message)
    for message in pose_messages(recording.poses):
        session.take_pose('geometry_msgs/msg/PoseStamped', message)
    return identify(session.problem()).chain


@pytest.mark.parametrize(
    'reliability', [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT]
)
@pytest.mark.parametrize(
    ('topic', 'kind'),
    [
        ('measured_pose', PoseStamped),
        ('measured_pose_with_covariance', PoseWithCovarianceStamped),
        ('measured_point', PointStamped),
        ('measured_transform', TransformStamped),
    ],
)
def test_every_kind_of_measurement_is_heard(recording, topic, kind, reliability):
    covariance = np.diag([1e-8, 2e-8, 3e-8, 4e-8, 5e-8, 6e-8]).ravel().tolist()
    with Cell(chain='ur10e') as cell:
        cell.publish('joint_states', joint_messages(recording)[:40], reliability)
        some = recording.poses.select(np.arange(2))
        cell.publish(topic, pose_messages(some, kind, covariance), reliability)
        taken = cell.node.session.problem().observations
    assert len(taken) == 2
    np.testing.assert_array_equal(taken.positions, some.positions)
    assert taken.oriented.all() == (kind is not PointStamped)
    if kind is PoseWithCovarianceStamped:
        np.testing.assert_array_equal(taken.covariance[0].ravel(), covariance)


def test_validation_topics_are_never_fitted(recording):
    with Cell(chain='ur10e') as cell:
        cell.publish('joint_states', joint_messages(recording))
        cell.publish('measured_pose', pose_messages(recording.poses.select(np.arange(40))))
        cell.publish('validation_pose', pose_messages(recording.poses.select(np.arange(40, 48))))
        answer = cell.call('identify')
        assert answer.success, answer.message
        assert '40 pairs' in answer.message
        assert '8 held-out pairs' in answer.message


@pytest.mark.parametrize('executor', [SingleThreadedExecutor, EventsExecutor])
def test_messages_are_taken_while_an_identification_runs(monkeypatch, recording, executor):
    release, problems = threading.Event(), []

    def slow(problem, model):
        problems.append(problem)
        assert release.wait(20.0)
        return identify(problem)

    monkeypatch.setattr(node_module, 'identify_model', slow)
    joints, poses = joint_messages(recording), pose_messages(recording.poses)
    with Cell(executor, chain='ur10e') as cell:
        cell.publish('joint_states', joints)
        cell.publish('measured_pose', poses[:40])
        first = cell.start_call('identify')
        cell.spin_until(lambda: problems)
        second = cell.call('identify')
        assert not second.success
        assert 'running' in second.message
        cell.publish('measured_pose', poses[40:])
        assert cell.node.session.account().pairs == 48
        assert not first.done()
        release.set()
        cell.spin_until(first.done)
        assert first.result().success, first.result().message
        assert len(problems[0].observations) == 40
        assert cell.call('identify').success


def test_a_poor_identification_publishes_nothing_and_keeps_the_last_good_one(recording, truth):
    with Cell(chain='ur10e') as cell:
        joints = joint_messages(recording)
        cell.publish('joint_states', joints)
        cell.publish('measured_pose', pose_messages(recording.poses))
        texts = cell.listen(String, 'calibration_node/calibration')
        assert cell.call('identify').success
        cell.spin_until(lambda: texts)
        good = cell.node.session.calibration
        assert cell.call('clear').success
        nominal = load_chain('ur10e')
        configurations = recording.poses.joints
        noisy = measure(nominal, configurations, np.random.default_rng(5), 1e-4, 1e-4)
        cell.publish('joint_states', joints)
        cell.publish('measured_pose', pose_messages(noisy.at(recording.poses.stamps_ns)))
        answer = cell.call('identify')
        assert not answer.success
        assert 'no gain' in answer.message
        assert 'last good calibration stays' in answer.message
        assert cell.node.session.calibration is good
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        cell.spin_until(lambda: heard)
        assert len(texts) == 1


def test_errors_are_answers(recording):
    with Cell(chain='ur10e') as cell:
        empty = cell.call('identify')
        assert not empty.success
        assert 'no matched pairs' in empty.message
        cell.publish('joint_states', joint_messages(recording))
        cell.publish('measured_pose', pose_messages(recording.poses)[:4])
        few = cell.call('identify')
        assert not few.success
        assert '2 measured configurations are too few, at least 5' in few.message


def test_record_and_clear(recording):
    joints = joint_messages(recording)
    with Cell(chain='ur10e') as cell:
        assert cell.call('record', SetBool.Request(data=False)).success
        cell.publish('joint_states', joints[:10])
        account = cell.node.session.account()
        assert account.dropped == {'joints: not recording': 10}
        assert cell.call('record', SetBool.Request(data=True)).success
        cell.publish('joint_states', joints[:40])
        cell.publish('measured_pose', pose_messages(recording.poses)[:3])
        cleared = cell.call('clear')
        assert cleared.success
        assert '3 pairs' in cleared.message
        assert cell.node.session.account().pairs == 0


def test_diagnostics_and_corrected_pose(recording, truth):
    joints = joint_messages(recording)
    joints.append(joint_messages(recording)[0])
    with Cell(chain='ur10e') as cell:
        diagnostics = cell.listen(DiagnosticArray, '/diagnostics', 10)
        corrected = cell.listen(PoseStamped, 'calibration_node/corrected_pose', 10)
        cell.publish('joint_states', joints)
        cell.publish('measured_pose', pose_messages(recording.poses))
        assert cell.call('identify').success
        cell.publish('joint_states', joints[-1:])
        cell.spin_until(
            lambda: [m for m in corrected if m.header.stamp == joints[-1].header.stamp]
        )
        message = corrected[-1]
        assert message.header.frame_id == 'tracker'
        true = truth.forward(recording.joints[:1])[0, :3, 3]
        point = message.pose.position
        np.testing.assert_allclose([point.x, point.y, point.z], true, rtol=0, atol=1e-4)
        diagnostics.clear()
        cell.spin_until(lambda: diagnostics)
        status = diagnostics[0].status[0]
        values = {item.key: item.value for item in status.values}
        assert values['pairs'] == '48'
        assert values['calibrated'] == 'True'
        assert values['dropped joints: same stamp twice'] == '2'
        assert values['last identification'].startswith('accepted')


def start_node(*arguments):
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ('LD_LIBRARY_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE')
    }
    return subprocess.Popen(
        [sys.executable, '-m', 'calib_ros.node', '--ros-args', *arguments],
        env=environment | {'ROS_DOMAIN_ID': str(1 + os.getpid() % 101)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('executor', ['events', 'single_threaded'])
def test_signals_end_the_node_cleanly(number, executor):
    process = start_node('-p', 'chain:=ur10e', '-p', 'max_gap:=1', '-p', f'executor:={executor}')
    assert 'ready to calibrate ur10e' in process.stdout.readline()
    process.send_signal(number)
    output, _ = process.communicate(timeout=20)
    assert process.returncode == 0, output
    assert 'Traceback' not in output


@pytest.mark.parametrize(
    ('arguments', 'said'),
    [
        ((), 'parameter "chain" is not set'),
        (('-p', 'chain:=ur10f'), 'did you mean "ur10"?'),
        (('-p', 'chain:=ur10e', '-p', 'max_gap:=fast'), 'parameter "max_gap" must be a number'),
        (('-p', 'chain:=ur10e', '-p', 'executor:=fast'), 'must be one of events'),
        (('-p', 'chain:=ur10e', '-p', 'folds:=1'), 'folds'),
        (('-p', 'chain:=ur10e', '-p', 'max_gapp:=1.0'), 'did you mean "max_gap"'),
        (('--params-file', os.devnull + '/none'), 'none'),
    ],
)
def test_a_wrong_parameter_ends_the_node_with_one_clear_line(arguments, said):
    process = start_node(*arguments)
    output, _ = process.communicate(timeout=20)
    assert process.returncode == 1
    assert said in output
    assert 'Traceback' not in output


def test_the_parameter_file_applies_under_a_namespace(tmp_path):
    shipped = os.path.join(os.path.dirname(__file__), '..', 'config', 'calibration_node.yaml')
    with open(shipped) as file:
        text = file.read().replace('# chain: ur10e ', 'chain: meca500')
    path = tmp_path / 'parameters.yaml'
    path.write_text(text)
    process = start_node('--params-file', str(path), '-r', '__ns:=/cell_2', '-r', '__node:=arm')
    line = process.stdout.readline()
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=20)
    assert 'cell_2.arm' in line
    assert 'ready to calibrate meca500' in line
    assert process.returncode == 0, output
