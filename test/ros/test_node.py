# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A real node in real rclpy: what it hears, keeps, answers and publishes."""

import json
from dataclasses import replace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.qos import ReliabilityPolicy
from ros_cell import (
    KINDS,
    STOPS,
    Cell,
    assert_same,
    direct,
    joint_messages,
    pose_messages,
    shift,
    stamp_ns,
    topics,
)
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, Range
from std_msgs.msg import Float64MultiArray, String

from calib_ros.apply.simulation import Cell as SimulatedCell, faulty, measure
from calib_ros.cli.main import main
from calib_ros.files.bags import replay
from calib_ros.files.recording import write_bag
from calib_ros.kinematics.chain_file import calibration_record, load_chain, parse_chain
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.topics import outputs
from calib_ros.settings import Settings

JOINT_RATE = 25.0  # they cost more than what is asked


@pytest.fixture(scope='module')
def motion(truth, recording):
    """Return the same shift measured all the time, by a device that stamps 30 ms late."""
    rng = np.random.default_rng(6)
    some = slice(5, -5, 2)
    poses = measure(truth, recording.joints[some], rng, 2e-5, 1e-4)
    stamps = recording.joint_stamps_ns[some] + 30_000_000
    none = np.zeros(len(poses), bool)
    return replace(recording, poses=poses.at(stamps), held_out=none)


@pytest.mark.parametrize(('mode', 'storage'), [('dwell', 'mcap'), ('continuous', 'sqlite3')])
def test_direct_bag_and_live_give_equal_observations(request, tmp_path, mode, storage):
    recording = request.getfixturevalue('recording' if mode == 'dwell' else 'motion')
    expected = direct(recording, mode=mode)
    replayed = CalibrationSession(load_chain('ur10e'), Settings(mode=mode))
    write_bag(tmp_path / 'bag', recording, storage)
    assert replay(tmp_path / 'bag', replayed).warnings == ()
    parameters = {'chain': 'ur10e', 'mode': mode, 'data_dir': str(tmp_path)}
    with Cell(**parameters) as cell:
        cell.play(topics(recording), ReliabilityPolicy.BEST_EFFORT)
        live = cell.node.session
        observations = expected.problem().observations
        assert len(observations) == (STOPS if mode == 'dwell' else len(recording.poses))
        assert_same(observations, replayed.problem().observations)
        assert_same(observations, live.problem().observations)
        assert live.account() == expected.account()
        assert live.delay == expected.delay == replayed.delay
        if mode == 'continuous':
            assert abs(live.delay.seconds - 0.03) < 0.002


def test_what_looks_wrong_is_told_live_and_of_a_bag(tmp_path, capfd, recording):
    """The joint states of the last seven stops are missing but for the end."""
    stamps, status = recording.joint_stamps_ns, '20 Hz or more'
    kept = (stamps < stamps[0] + 17 * 10**9) | (stamps > stamps[-1] - 5 * 10**8)
    recording = replace(recording, joint_stamps_ns=stamps[kept], joints=recording.joints[kept])
    said = f'max_gap (0.1 s): {status} of every joint'
    write_bag(tmp_path / 'bag', recording, 'mcap')
    arguments = ['identify', str(tmp_path / 'bag'), '--chain', 'ur10e', '--json']
    arguments += ['--largest-loss', '1']
    assert main(arguments) == 0
    heard = capfd.readouterr()
    assert said in heard.err
    assert said in ''.join(json.loads(heard.out)['warnings'])
    with Cell(chain='ur10e', data_dir=str(tmp_path)) as cell:
        words = cell.listen(String, 'calibration_node/status')
        cell.play(topics(recording))
        answer = cell.done('identify')
        assert len(answer.message) <= 200
        assert status in answer.message
        assert said in cell.in_full(answer)
        cell.spin_until(lambda: words and status in words[-1].data)
        cell.done('save')
    (page,) = tmp_path.glob('*Z.html')
    assert said in page.read_text().replace('\xa0', ' ')


def test_identify_answers_publishes_and_is_saved(tmp_path, recording, truth):
    target = tmp_path / 'sub' / 'saved.yaml'
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'target_filename': str(target)}
    with Cell(**parameters) as cell:
        refused = cell.refused('save')
        assert 'identify' in refused.message
        cell.play(topics(recording))
        answer = cell.done('identify')
        assert f'{STOPS} poses' in answer.message
        assert 'wrist_3_joint.theta' in cell.in_full(answer)
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
        record = calibration_record(texts[0].data)
        assert record['topics'] == ['/joint_states', '/measured_pose']
        assert record['samples'] == STOPS
        saved = cell.done('save')
        assert str(target) in saved.message
        assert target.read_text() == texts[0].data
        report = target.with_suffix('.html')
        assert str(report) in saved.message
        assert 'Accepted' in report.read_text()
        assert record['table_sha256'] in report.read_text()
        again = cell.refused('save')
        assert 'exists already' in again.message
        assert target.read_text() == texts[0].data


def test_every_kind_of_measurement_is_heard(cell, recording):
    covariance = np.diag([1e-8, 2e-8, 3e-8, 4e-8, 5e-8, 6e-8]).ravel().tolist()
    lengths = np.linalg.norm(recording.poses.positions, axis=1)
    stop = np.arange(len(lengths)) // 4
    streams = {'joint_states': joint_messages(recording)}
    for k, (topic, kind) in enumerate(KINDS.items()):
        some = np.isin(stop, (2 * k, 2 * k + 1))
        streams[topic] = pose_messages(
            *(recording.poses.select(some), kind, covariance), child=topic, distances=lengths[some]
        )
    cell.play(streams)
    cell.node.session.problem()  # has taken what was waiting
    assert cell.node.session.account().dropped == {}
    taken = sorted(cell.node.session.samples, key=lambda sample: sample.stamp_ns)
    assert len(taken) == 2 * len(KINDS)
    for k, sample in enumerate(taken):
        topic, kind = list(KINDS.items())[k // 2]
        assert (sample.rotation is None) == (kind in (PointStamped, Range))
        assert (sample.covariance is None) == (kind not in (PoseWithCovarianceStamped, Odometry))
        assert sample.target == (topic if kind in (TransformStamped, Odometry) else '')
        assert sample.device == ('distance' if kind is Range else '')


def test_joint_states_in_two_parts(tmp_path, recording):
    whole = joint_messages(recording)
    parts = [
        [JointState(header=m.header, name=m.name[some], position=m.position[some]) for m in whole]
        for some in (slice(0, 2), slice(2, 6))
    ]
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path)}
    with Cell(**parameters, joint_topics=['base/joints', 'arm/joints']) as cell:
        joints = {'base/joints': parts[0], 'arm/joints': parts[1]}
        cell.play(joints | {'measured_pose': pose_messages(recording.poses)})
        assert_same(*(s.problem().observations for s in (direct(recording), cell.node.session)))


def test_namespace_and_remapping(tmp_path, recording):
    with Cell() as cell:
        node = cell.start(
            ['__node:=arm', 'measured_pose:=/tracker/pose', 'joint_states:=ur/joint_states'],
            namespace='/cell_2',
            chain='ur10e',
            data_dir=str(tmp_path),
        )
        joints, poses = topics(recording).values()
        cell.play({'/cell_2/ur/joint_states': joints, '/tracker/pose': poses}, node=node)
        cell.done('identify', node='/cell_2/arm')
        texts = cell.listen(String, '/cell_2/arm/calibration')
        cell.spin_until(lambda: texts)
        record = calibration_record(texts[0].data)
        assert record['topics'] == ['/cell_2/ur/joint_states', '/tracker/pose']


def test_stamps_follow_simulated_time(tmp_path):
    with Cell(chain='ur10e', data_dir=str(tmp_path), use_sim_time=True) as cell:
        diagnostics = cell.listen(DiagnosticArray, '/diagnostics', 10)
        cell.spin_until(lambda: diagnostics)  # it speaks although the clock stands still
        assert stamp_ns(diagnostics[0]) == 0
        said = 'use_sim_time is set, but /clock gives no time'
        cell.spin_until(lambda: said in diagnostics[-1].status[0].message)
        clock = cell.publisher(Clock, '/clock')
        for seconds in (1000, 2000, 500):  # and when it jumps back
            clock.publish(Clock(clock=Time(sec=seconds)))
            cell.spin_until(lambda now=seconds: stamp_ns(diagnostics[-1]) == now * 10**9)
        cell.spin_until(lambda: said not in diagnostics[-1].status[0].message)
        cell.set_parameters({'use_sim_time': False})
        cell.spin_until(lambda: stamp_ns(diagnostics[-1]) > 10**18)


def test_several_robots_in_one_process(tmp_path, recording):
    rng = np.random.default_rng(12)
    other = shift(faulty(load_chain('meca500'), SimulatedCell(), rng))
    with Cell() as cell:
        reports = cell.listen(DiagnosticArray, '/diagnostics', 10)
        for namespace, chain, played in (('/a', 'ur10e', recording), ('/b', 'meca500', other)):
            node = cell.start(namespace=namespace, chain=chain, data_dir=str(tmp_path))
            messages = {f'{namespace}/{name}': m for name, m in topics(played).items()}
            cell.play(messages, node=node)
        first = cell.start_call('identify', node='/a/calibration_node')
        second = cell.start_call('identify', node='/b/calibration_node')
        cell.spin_until(lambda: first.done() and second.done())
        assert first.result().success, first.result().message
        assert second.result().success, second.result().message
        assert [node.session.chain.name for node in cell.nodes] == ['ur10e', 'meca500']
        assert [node.session.account().dropped for node in cell.nodes] == [{}, {}]
        lines = {'a/calibration_node: calibration', 'b/calibration_node: calibration'}
        cell.spin_until(lambda: {report.status[0].name for report in reports} == lines)
    journals = sorted(path.name.partition('_')[0] for path in tmp_path.glob('*Z.csv'))
    assert journals == ['meca500+b', 'ur10e+a']


def test_recordings_of_all_topics_tell_what_the_node_published(tmp_path):
    given = {'chain': 'ur10e', 'data_dir': str(tmp_path)}
    with Cell(**given) as cell:
        node = cell.start(namespace='/hall/left', remap=('__node:=calib',), **given)
        found = cell.peer.get_publisher_names_and_types_by_node
        own = {}
        cell.spin_until(lambda: own.update(found('calib', '/hall/left')) or len(own) > 9)
        assert node.get_fully_qualified_name() == '/hall/left/calib'
    available = {topic: kinds[0] for topic, kinds in own.items()}
    private = {topic for topic in available if topic.startswith('/hall/left/calib/')}
    assert {topic.rpartition('/')[2] for topic in private} >= {'corrected_pose', 'next_pose'}
    assert outputs(available | {'/hall/left/measured_pose': 'x'}) == private
