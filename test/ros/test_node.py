# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A real node in real rclpy: what it hears, keeps, answers and publishes."""

import json
import queue
import signal
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import (
    PointStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
)
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.exceptions import ParameterException
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from ros_cell import (
    KINDS,
    STOPS,
    Cell,
    Child,
    assert_same,
    direct,
    joint_messages,
    pose_messages,
    shift,
    stamp_ns,
    topics,
    values_of,
)
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, Range
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool
from visualization_msgs.msg import Marker, MarkerArray

from calib_ros.apply.simulation import Cell as SimulatedCell
from calib_ros.apply.simulation import faulty, measure, random_frame
from calib_ros.cli.main import main
from calib_ros.errors import CalibrationError
from calib_ros.files.archive import Archive
from calib_ros.files.bags import replay
from calib_ros.files.history import History
from calib_ros.files.recording import write_bag
from calib_ros.identification.identification import identify
from calib_ros.kinematics.chain_file import calibration_record, dump_chain, load_chain, parse_chain
from calib_ros.ros import identifying as identifying_module
from calib_ros.ros import node as node_module
from calib_ros.ros.arguments import PARAMETERS, typed
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.topics import outputs
from calib_ros.settings import Settings

SHIPPED = Path(__file__).parents[2] / 'config' / 'calibration_node.yaml'


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
        cell.play(
            {
                'measured_pose': pose_messages(recording.poses),
                'joint_states': joint_messages(recording),
            },
            ReliabilityPolicy.BEST_EFFORT,
        )
        live = cell.node.session
        observations = expected.problem().observations
        assert len(observations) == (STOPS if mode == 'dwell' else len(recording.poses))
        assert_same(observations, replayed.problem().observations)
        assert_same(observations, live.problem().observations)
        assert live.account() == expected.account()
        assert live.delay == expected.delay == replayed.delay
        if mode == 'continuous':
            assert abs(live.delay.seconds - 0.03) < 0.002


def with_a_hole(recording):
    """Return a recording without the joint states of its last seven stops but for the end."""
    stamps = recording.joint_stamps_ns
    begin, end = stamps[0] + 17 * 10**9, stamps[-1] - 5 * 10**8
    kept = (stamps < begin) | (stamps > end)
    return replace(recording, joint_stamps_ns=stamps[kept], joints=recording.joints[kept])


def with_noise(recording):
    """Return a recording with joint values that never stay within `still`."""
    noise = np.random.default_rng(8).normal(scale=3e-4, size=recording.joints.shape)
    return replace(recording, joints=recording.joints + noise)


@pytest.mark.parametrize(
    ('spoilt', 'accepted', 'said', 'status'),
    [
        (with_a_hole, True, 'max_gap (0.1 s): 20 Hz or more are needed', '20 Hz or more'),
        (with_noise, False, 'hardly ever rest within still (0.0005)', 'set still to 0.00'),
    ],
)
def test_what_looks_wrong_is_told_live_and_of_a_bag(
    tmp_path, capfd, recording, spoilt, accepted, said, status
):
    recording = spoilt(recording)
    write_bag(tmp_path / 'bag', recording, 'mcap')
    arguments = ['identify', str(tmp_path / 'bag'), '--chain', 'ur10e', '--json']
    arguments += ['--largest-loss', '1']
    assert (main(arguments) == 0) == accepted
    heard = capfd.readouterr()
    assert said in heard.err
    if accepted:
        assert said in ''.join(json.loads(heard.out)['warnings'])
    with Cell(chain='ur10e', data_dir=str(tmp_path)) as cell:
        words = cell.listen(String, 'calibration_node/status')
        cell.play(topics(recording))
        answer = cell.call('identify')
        assert answer.success == accepted
        assert len(answer.message) <= 200
        assert status in answer.message
        assert said in cell.in_full(answer)
        cell.spin_until(lambda: words and status in words[-1].data)


def test_identify_answers_publishes_and_is_saved(tmp_path, recording, truth):
    target = tmp_path / 'sub' / 'saved.yaml'
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'target_filename': str(target)}
    with Cell(**parameters) as cell:
        refused = cell.call('save')
        assert not refused.success
        assert 'identify' in refused.message
        cell.play(topics(recording))
        answer = cell.call('identify')
        assert answer.success, answer.message
        assert f'{STOPS} samples' in answer.message
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
        saved = cell.call('save')
        assert saved.success
        assert str(target) in saved.message
        assert target.read_text() == texts[0].data
        report = target.with_suffix('.html')
        assert str(report) in saved.message
        assert 'Accepted' in report.read_text()
        assert record['table_sha256'] in report.read_text()
        again = cell.call('save')
        assert not again.success
        assert 'exists already' in again.message
        assert target.read_text() == texts[0].data


def test_live_result_equals_the_one_from_arrays(cell, recording):
    expected = identify(direct(recording).problem()).chain
    cell.play(topics(recording))
    texts = cell.listen(String, 'calibration_node/calibration')
    assert cell.call('identify').success
    cell.spin_until(lambda: texts)
    chain = parse_chain(texts[0].data)
    np.testing.assert_allclose(chain.table, expected.table, rtol=0, atol=1e-9)


# What it hears


@pytest.mark.parametrize(
    'reliability', [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT]
)
def test_every_kind_of_measurement_is_heard(cell, recording, reliability):
    covariance = np.diag([1e-8, 2e-8, 3e-8, 4e-8, 5e-8, 6e-8]).ravel().tolist()
    lengths = np.linalg.norm(recording.poses.positions, axis=1)
    stop = np.arange(len(lengths)) // 4
    streams = {'joint_states': joint_messages(recording)}
    for k, (topic, kind) in enumerate(KINDS.items()):
        some = np.isin(stop, (2 * k, 2 * k + 1))
        streams[topic] = pose_messages(
            *(recording.poses.select(some), kind, covariance),
            child=topic,
            distances=lengths[some],
        )
    cell.play(streams, reliability)
    cell.node.session.problem()  # has taken what was waiting
    assert cell.node.session.account().dropped == {}
    taken = sorted(cell.node.session.samples, key=lambda sample: sample.stamp_ns)
    assert len(taken) == 2 * len(KINDS)
    for k, sample in enumerate(taken):
        kind = list(KINDS.values())[k // 2]
        assert (sample.rotation is None) == (kind in (PointStamped, Range))
        if kind is Range:
            assert sample.device == 'distance'
            assert abs(sample.distance - lengths[stop == k].mean()) < 1e-6
            continue
        mean = recording.poses.positions[stop == k].mean(axis=0)
        np.testing.assert_allclose(sample.position, mean, rtol=0, atol=1e-12)
        named = kind in (TransformStamped, Odometry)
        assert sample.target == (list(KINDS)[k // 2] if named else '')
        if kind in (PoseWithCovarianceStamped, Odometry):
            np.testing.assert_allclose(sample.covariance.ravel(), covariance, rtol=1e-12)
        else:
            assert sample.covariance is None


def test_two_children_of_a_transform_are_two_targets(cell, recording, truth):
    other = replace(truth, tool=random_frame(np.random.default_rng(8), 0.2))
    rng = np.random.default_rng(9)
    poses = recording.poses
    second = measure(other, poses.joints, rng, 2e-5, 1e-4).at(poses.stamps_ns)
    both = pose_messages(poses, TransformStamped, child='left')
    both += pose_messages(second, TransformStamped, child='right')
    cell.play({'joint_states': joint_messages(recording), 'measured_transform': both})
    answer = cell.call('identify')
    assert answer.success, answer.message
    chain = cell.node.session.calibration.chain
    assert {'base', 'tool', 'tool_right'} <= set(chain.frame_names)
    unseen = truth.random_joints(100, rng)
    for tool, true in (('tool', truth), ('tool_right', other)):
        error = (chain.forward(unseen, tool=tool) - true.forward(unseen))[:, :3, 3]
        assert np.linalg.norm(error, axis=1).max() < 1e-4


def test_a_camera_on_the_flange_and_a_draw_wire_as_sources(tmp_path, recording, truth):
    poses = recording.poses
    seen = poses.inverted()
    lengths = np.linalg.norm(poses.positions - [0.5, 0.2, -0.3], axis=1)
    sources = ['camera/target type=PoseStamped eye_in_hand=true target=board', 'wire type=Range']
    noise = {'sigma_position': 2e-5, 'sigma_orientation': 1e-4}
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'sources': sources, **noise}
    with Cell(**parameters) as cell:
        cell.play(
            {
                'joint_states': joint_messages(recording),
                'camera/target': pose_messages(seen, frame_id='camera'),
                'wire': pose_messages(poses, Range, distances=lengths, frame_id='wire'),
            }
        )
        answer = cell.call('identify')
        assert answer.success, answer.message
        kinds = [
            (each.distances is not None, len(each)) for each in cell.node.session.problem().sets
        ]
        assert kinds == [(False, STOPS), (True, STOPS)]
        chain = cell.node.session.calibration.chain
    unseen = truth.random_joints(200, np.random.default_rng(3))
    found, true = chain.forward(unseen), truth.forward(unseen)
    # The board's frame is the world; only what two poses have between them can be compared.
    error = np.linalg.inv(found[0]) @ found[1:] - np.linalg.inv(true[0]) @ true[1:]
    assert np.linalg.norm(error[:, :3, 3], axis=1).max() < 3e-4


def test_joint_states_in_two_parts(tmp_path, recording):
    whole = joint_messages(recording)
    parts = [
        [JointState(header=m.header, name=m.name[some], position=m.position[some]) for m in whole]
        for some in (slice(0, 2), slice(2, 6))
    ]
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path)}
    with Cell(**parameters, joint_topics=['base/joints', 'arm/joints']) as cell:
        cell.play(
            {
                'base/joints': parts[0],
                'arm/joints': parts[1],
                'measured_pose': pose_messages(recording.poses),
            }
        )
        assert_same(
            direct(recording).problem().observations, cell.node.session.problem().observations
        )


def test_validation_topics_are_never_fitted(cell, recording):
    poses = pose_messages(recording.poses)
    last = STOPS - 6
    cell.play(
        topics(recording, measured_pose=poses[: 4 * last], validation_pose=poses[4 * last :])
    )
    answer = cell.call('identify')
    assert answer.success, answer.message
    assert f'{last} samples' in answer.message
    assert '6 held-out samples' in answer.message


# What it answers


def test_errors_are_answers(cell, recording):
    for name, said in (
        ('identify', 'no samples to fit'),
        ('capture', 'no joint states have come'),
        ('remove_last', 'no sample to remove'),
        ('validate', 'identify or load one first'),
        ('load', 'no saved calibration of ur10e'),
    ):
        empty = cell.call(name)
        assert not empty.success
        assert said in empty.message
    some = topics(recording)
    cell.play(
        {'joint_states': some['joint_states'][:120], 'measured_pose': some['measured_pose'][:8]}
    )
    few = cell.call('identify')
    assert not few.success
    assert '2 measured configurations are too few, at least 5' in few.message


def test_answers_are_in_the_log_as_well(cell, recording):
    told = cell.log()

    def said(name, answer, level):
        text = f'~/{name}: {cell.in_full(answer)}'
        cell.spin_until(lambda: (text, level) in [(each.msg, each.level) for each in told])

    for name in ('identify', 'export', 'capture', 'remove_last', 'validate', 'save', 'load'):
        said(name, cell.call(name), Log.WARN)
    said('record', cell.call('record', SetBool.Request(data=True)), Log.INFO)
    cell.play(topics(recording))
    for name in ('identify', 'export', 'save', 'load', 'remove_last', 'clear'):
        said(name, cell.call(name), Log.INFO)


def test_record_remove_last_and_clear(cell, recording):
    joints, poses = topics(recording).values()
    assert cell.call('record', SetBool.Request(data=False)).success
    cell.play({'joint_states': joints[:10], 'measured_pose': poses[:2]})
    account = cell.node.session.account()
    assert account.unused == {'joints: not recording': 10, 'poses: not recording': 2}
    assert cell.call('record', SetBool.Request(data=True)).success
    cell.play({'joint_states': joints[10:300], 'measured_pose': poses[2:20]})
    assert len(cell.node.session.samples) == 5
    removed = cell.call('remove_last')
    assert removed.success
    assert removed.message == 'sample 5 removed'
    assert len(cell.node.session.samples) == 4
    cleared = cell.call('clear')
    assert cleared.success
    assert '4 samples cleared; they stay in' in cleared.message
    assert cell.node.session.account().samples == 0
    assert cell.node.session.account().joint_states == 0


def test_capture_takes_one_sample_when_it_is_asked_to(tmp_path, recording):
    joints, poses = topics(recording).values()
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'mode': 'triggered'}
    with Cell(**parameters) as cell:
        cell.play({'joint_states': joints[:28], 'measured_pose': poses[:4]})
        taken = cell.call('capture')
        assert taken.success, taken.message
        assert taken.message.startswith('sample 1 taken (4 measurements, spread 0.0')
        twice = cell.call('capture')
        assert not twice.success
        assert 'no measurements have come since the last sample' in twice.message
        cell.node.set_parameters([Parameter('socket', value='plate A/1')])
        ball = cell.call('capture')
        assert ball.success, ball.message
        assert ball.message == 'sample 2 taken: ball in socket plate A/1'
        (path,) = tmp_path.glob('*Z.csv')
        assert path.read_text().splitlines()[-1].endswith(',plate A,1,')
        assert cell.call('remove_last').success
        cell.node.set_parameters([Parameter('socket', value='A')])
        assert 'socket must be LOCATION/SOCKET' in cell.call('capture').message
        cell.node.set_parameters([Parameter('socket', value='')])
        cell.play({'joint_states': joints[28:40], 'measured_pose': poses[4:5]})
        moving = cell.call('capture')
        assert not moving.success
        assert 'the arm has not stood for 0.2 s yet' in moving.message
        cell.play({'joint_states': joints[40:], 'measured_pose': poses[5:]})
        assert len(cell.node.session.samples) == 1


def test_a_saved_calibration_is_loaded_and_judged_on_new_samples(tmp_path, recording):
    history = tmp_path / 'history'
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'serial': '7'}
    parameters['history'] = str(history)
    other = tmp_path / 'ur10e_on_linear_axis_20990101T000000000000Z.yaml'
    other.write_text('of another robot, whose name begins alike')
    with Cell(**parameters) as cell:
        cell.play(topics(recording))
        assert cell.call('identify').success
        nothing = cell.call('validate')
        assert not nothing.success
        assert 'measure some new poses' in nothing.message
        assert cell.call('save').success
        chain = cell.node.session.calibration.chain
    with Cell(**parameters) as cell:
        loaded = cell.call('load')
        assert loaded.success, loaded.message
        np.testing.assert_array_equal(cell.node.session.calibration.chain.table, chain.table)
        assert cell.node.session.calibration.world_frame == 'tracker'
        texts = cell.listen(String, 'calibration_node/calibration')
        cell.spin_until(lambda: texts)
        np.testing.assert_array_equal(parse_chain(texts[0].data).table, chain.table)
        cell.play(topics(recording))
        holds = cell.call('validate')
        assert holds.success, holds.message
        assert 'the calibration holds: RMS 0.0' in holds.message
        assert f'{STOPS} samples taken since' in holds.message
        agrees = cell.call('check')
        assert agrees.success, agrees.message
        assert 'agrees with what was measured: RMS 0.0' in agrees.message
        cell.call('clear')
        moved = pose_messages(recording.poses)
        for message in moved:
            message.pose.position.x += 0.003
        cell.play(topics(recording, measured_pose=moved))
        broken = cell.call('validate')
        assert not broken.success
        assert 'does not hold any more' in broken.message
        assert 'RMS 3.0' in broken.message
        bumped = cell.call('check')
        assert not bumped.success
        assert 'does not fit any more, changed: base' in bumped.message
    filed = {(row.kind, row.verdict): row for row in History(history).rows('7')}
    holds, broken = (filed['validate', text] for text in ('holds', 'does not hold'))
    assert set(filed) == {
        ('identify', 'accepted'),
        *((r.kind, r.verdict) for r in (holds, broken)),
    }
    assert broken.rms_mm > 3.0 > holds.rms_mm


def test_the_calibration_of_another_robot_of_the_kind_is_not_loaded(tmp_path, recording):
    saved = tmp_path / 'saved.yaml'
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path)}
    with Cell(**parameters, serial='7', target_filename=str(saved)) as cell:
        cell.play(topics(recording))
        assert cell.call('identify').success
        assert cell.call('save').success
    for serial, loads in (('8', False), ('7', True), ('', True)):
        with Cell(**parameters, serial=serial, calibration_filename=str(saved)) as cell:
            answer = cell.call('load')
            assert answer.success == loads, answer.message
            assert loads or 'the robot with serial "7", this is "8"' in answer.message
            assert (cell.node.session.calibration is not None) == loads


@pytest.fixture(scope='module')
def saved(tmp_path_factory, recording):
    """Return a folder in which two calibrations are saved, and the path of the newest."""
    folder = tmp_path_factory.mktemp('saved')
    with Cell(chain='ur10e', data_dir=str(folder)) as cell:
        cell.play(topics(recording))
        assert cell.call('identify').success
        assert cell.call('save').success
        assert cell.call('save').success
    *_, newest = sorted(folder.glob('*Z.yaml'))
    return folder, newest


@pytest.mark.parametrize('named', [True, False])
def test_the_calibration_is_published_again_after_a_restart(saved, named):
    folder, newest = saved
    path = sorted(folder.glob('*Z.yaml'))[0] if named else newest
    given = {'calibration_filename': path.name} if named else {'autoload': True}
    with Cell() as cell:
        told = cell.log()
        node = cell.start(chain='ur10e', data_dir=str(folder), **given)
        texts = cell.listen(String, 'calibration_node/calibration')
        cell.spin_until(lambda: texts)
        assert texts[0].data == path.read_text()
        assert node.session.calibration.world_frame == 'tracker'
        cell.spin_until(lambda: any(f'loaded {path}' in each.msg for each in told))


def test_a_calibration_that_could_be_loaded_is_named_but_not_published(saved):
    folder, newest = saved
    with Cell() as cell:
        told = cell.log()
        node = cell.start(chain='ur10e', data_dir=str(folder))
        cell.spin_until(lambda: any(str(newest) in each.msg for each in told))
        assert any('~/load' in each.msg for each in told)
        assert node.session.calibration is None


@pytest.mark.parametrize(
    ('content', 'said'),
    [(None, 'there is no file'), ('', 'is not a calibration'), ('puma', 'joints')],
)
def test_what_cannot_be_loaded_at_the_start_is_told_and_costs_nothing_else(
    tmp_path, recording, content, said
):
    """A node that did not start would take no samples, and a respawned one gives up."""
    path = tmp_path / 'of_before.yaml'
    if content is not None:
        path.write_text(content and dump_chain(load_chain('puma560')))
    given = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'calibration_filename': str(path)}
    with Cell() as cell:
        told = cell.log()
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        node = cell.start(**given)
        cell.spin_until(lambda: any(said in m.msg and m.level == m.ERROR for m in told))
        cell.spin_until(lambda: heard and said in values_of(heard[-1])['last identification'])
        assert node.session.calibration is None
        cell.play(topics(recording), node=node)
        assert cell.call('identify').success


def test_the_settings_of_the_identification_are_saved_with_it(tmp_path, recording):
    """Whatever has been changed since."""
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'serial': '7'}
    with Cell(**parameters) as cell:
        cell.play(topics(recording))
        assert cell.set_parameters({'folds': 4})[0].successful
        assert cell.call('identify').success
        assert cell.set_parameters({'folds': 7})[0].successful
        assert cell.call('save').success
        (path,) = tmp_path.glob('*Z.yaml')
        settings = yaml.safe_load(path.with_suffix('.settings.yaml').read_text())
        used = settings['/**']['ros__parameters']
        assert (used['chain'], used['serial'], used['folds']) == ('ur10e', '7', 4)


def test_messages_are_taken_while_an_identification_runs(monkeypatch, tmp_path, recording):
    release, problems = threading.Event(), []

    def slow(problem, model, progress):
        problems.append(problem)
        assert release.wait(20.0)
        return identify(problem)

    monkeypatch.setattr(identifying_module, 'identify_model', slow)
    joints, poses = topics(recording).values()
    with Cell(chain='ur10e', data_dir=str(tmp_path)) as cell:
        cell.play({'joint_states': joints[:1000], 'measured_pose': poses[:80]})
        first = cell.start_call('identify')
        cell.spin_until(lambda: problems)
        second = cell.call('identify')
        assert not second.success
        assert 'running' in second.message
        unsaved = cell.call('save')
        assert not unsaved.success
        assert 'no accepted calibration' in unsaved.message
        cell.play({'joint_states': joints[1000:], 'measured_pose': poses[80:]})
        assert cell.node.session.account().poses == len(poses)
        assert not first.done()
        release.set()
        cell.spin_until(first.done)
        assert first.result().success, first.result().message
        assert len(problems[0].observations) == 20
        # The samples that came meanwhile were not fitted, so they may judge.
        judged = cell.call('validate')
        assert judged.success
        assert '4 samples taken since' in judged.message
        assert cell.call('identify').success


STAGES = ['model geometric', 'effects', 'effects: ratio', 'harmonics of elbow_joint']


@pytest.fixture
def stages(monkeypatch):
    """Let identifications of model auto wait at each stage; return a queue that lets them go."""
    release, reached = queue.Queue(), []
    identify_model = identifying_module.identify_model

    def slow(problem, model, progress):
        def at(stage):
            progress(stage)
            reached.append(stage)
            release.get(timeout=20.0)

        return identify_model(problem, model, at)

    monkeypatch.setattr(identifying_module, 'identify_model', slow)
    return release, reached


def test_the_status_names_the_stage_of_an_identification(tmp_path, recording, stages):
    release, reached = stages
    with Cell(chain='ur10e', data_dir=str(tmp_path), model='auto') as cell:
        words = cell.listen(String, 'calibration_node/status')
        cell.play(topics(recording))
        running = cell.start_call('identify')
        for stage in STAGES[:2]:
            cell.spin_until(lambda now=stage: words and f's ({now}); ' in words[-1].data)
            assert '; identifying for ' in words[-1].data
            release.put(None)
        for _ in range(100):
            release.put(None)
        cell.spin_until(running.done)
        assert running.result().success, running.result().message
        assert set(STAGES) <= set(reached)
        cell.spin_until(lambda: 'identifying' not in words[-1].data)


def test_an_identification_is_cancelled_between_stages(tmp_path, recording, stages):
    release, reached = stages
    with Cell(chain='ur10e', data_dir=str(tmp_path), model='auto') as cell:
        none = cell.call('cancel')
        assert not none.success
        assert 'nothing to cancel' in none.message
        cell.play(topics(recording))
        texts = cell.listen(String, 'calibration_node/calibration')
        for _ in range(100):
            release.put(None)
        assert cell.call('identify').success
        cell.spin_until(lambda: texts)
        good = cell.node.session.calibration
        while not release.empty():
            release.get()
        for stage in (0, 2):
            reached.clear()
            running = cell.start_call('identify')
            for _ in range(stage):
                release.put(None)
            cell.spin_until(lambda last=stage: len(reached) == last + 1)
            answer = cell.call('cancel')
            assert answer.success
            assert f'({reached[-1]})' in answer.message
            release.put(None)
            cell.spin_until(running.done)
            assert not running.result().success
            assert f'cancelled after the stage "{reached[-1]}"' in running.result().message
            assert len(reached) == stage + 1
        assert cell.node.session.calibration is good
        assert len(texts) == 1
        assert len(cell.node.session.samples) == STOPS
        for _ in range(100):
            release.put(None)
        assert cell.call('identify').success


def test_a_result_that_was_cancelled_at_last_is_not_published(monkeypatch, cell, recording):
    release, running = threading.Event(), threading.Event()

    def slow(problem, model, progress):
        result = identify(problem)
        running.set()
        assert release.wait(20.0)
        return result

    monkeypatch.setattr(identifying_module, 'identify_model', slow)
    cell.play(topics(recording))
    answer = cell.start_call('identify')
    cell.spin_until(running.is_set)
    assert cell.call('cancel').success
    release.set()
    cell.spin_until(answer.done)
    assert not answer.result().success
    assert 'cancelled' in answer.result().message
    assert cell.node.session.calibration is None


def test_outliers_are_named_by_number_and_stamp(cell, recording):
    some = pose_messages(recording.poses)
    for message in some[24:28]:
        message.pose.position.z += 0.02
    cell.play(topics(recording, measured_pose=some))
    answer = cell.call('identify')
    assert answer.success, answer.message
    sample = cell.node.session.samples[6]
    stamp = f'{sample.stamp_ns // 10**9}.{sample.stamp_ns % 10**9:09d}'
    assert f'1 outliers carry no weight: sample 7 ({stamp})' in cell.in_full(answer)


def test_clear_while_an_identification_runs(monkeypatch, cell, recording):
    release, problems = threading.Event(), []

    def slow(problem, model, progress):
        problems.append(problem)
        assert release.wait(20.0)
        return identify(problem)

    monkeypatch.setattr(identifying_module, 'identify_model', slow)
    cell.play(topics(recording))
    running = cell.start_call('identify')
    cell.spin_until(lambda: problems)
    assert cell.call('clear').success
    release.set()
    cell.spin_until(running.done)
    assert running.result().success, running.result().message
    cell.play(topics(recording))
    judged = cell.call('validate')
    assert f'{STOPS} samples taken since' in judged.message


def test_a_poor_identification_publishes_nothing_and_keeps_the_last_good_one(cell, recording):
    cell.play(topics(recording))
    texts = cell.listen(String, 'calibration_node/calibration')
    assert cell.call('identify').success
    cell.spin_until(lambda: texts)
    good = cell.node.session.calibration
    assert cell.call('clear').success
    nominal = load_chain('ur10e')
    noisy = measure(nominal, recording.poses.joints, np.random.default_rng(5), 1e-4, 1e-4)
    noisy = noisy.at(recording.poses.stamps_ns)
    cell.play(topics(recording, measured_pose=pose_messages(noisy)))
    answer = cell.call('identify')
    assert not answer.success
    assert 'no gain' in answer.message
    assert 'last good calibration stays' in cell.in_full(answer)
    assert cell.node.session.calibration is good
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    cell.spin_until(lambda: heard)
    assert len(texts) == 1


# What it publishes


def test_diagnostics_status_and_corrected_pose(tmp_path, recording, truth):
    joints = joint_messages(recording)
    twice = joints[:1000] + joints[900:901] + joints[1000:]
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'serial': 'A7'}
    with Cell(**parameters) as cell:
        diagnostics = cell.listen(DiagnosticArray, '/diagnostics', 10)
        corrected = cell.listen(PoseStamped, 'calibration_node/corrected_pose', 10)
        cell.play(topics(recording, joint_states=twice))
        assert cell.call('identify').success
        cell.play({'joint_states': joints[-1:]})
        cell.spin_until(
            lambda: [m for m in corrected if m.header.stamp == joints[-1].header.stamp]
        )
        message = corrected[-1]
        assert message.header.frame_id == 'tracker'
        true = truth.forward(recording.joints[-1:])[0, :3, 3]
        point = message.pose.position
        np.testing.assert_allclose([point.x, point.y, point.z], true, rtol=0, atol=1e-4)
        diagnostics.clear()
        cell.spin_until(lambda: diagnostics)
        status = diagnostics[0].status[0]
        assert (status.name, status.hardware_id) == ('calibration_node: calibration', 'A7')
        values = values_of(diagnostics[0])
        assert values['samples'] == str(STOPS)
        assert values['calibrated'] == 'True'
        assert values['dropped joints: same stamp twice'] == '2'
        assert values['last identification'].startswith('accepted')
        assert float(values['rate of /joint_states [Hz]']) >= 0.0
        assert float(values['age of /measured_pose [s]']) < 20.0
        words = cell.listen(String, 'calibration_node/status')
        cell.spin_until(lambda: words)
        assert words[0].data.startswith('the arm ')
        assert f'; {STOPS} samples, 0.0' in words[0].data
        assert 'enough for the accuracy wanted' in words[0].data


def test_the_status_tells_what_the_arm_does(cell, recording):
    joints = joint_messages(recording)
    session = cell.node.session
    assert session.state == 'waiting for joint states'
    cell.play({'joint_states': joints[:15]})
    assert session.state.startswith('the arm stands for 0.')
    cell.play({'joint_states': joints[15:40]})
    assert session.state == 'the arm is moving'
    few = cell.listen(String, 'calibration_node/status')
    cell.spin_until(lambda: few and 'the arm is moving' in few[-1].data)
    assert few[-1].data == 'the arm is moving; 0 samples'


def test_the_status_is_short_and_its_first_words_are_those_that_matter(
    monkeypatch, cell, recording
):
    """The rest is in the diagnostics; `ros2 topic echo` cuts texts at 128 characters."""
    words = cell.listen(String, 'calibration_node/status')
    long = '; '.join(['the arm is moving', *(f'sample {k} of many words' for k in range(20))])
    monkeypatch.setattr(CalibrationSession, 'status', lambda *arguments: long)
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    cell.spin_until(lambda: words and words[-1].data.startswith('the arm is moving; sample 0'))
    assert 100 < len(words[-1].data) <= 120
    assert words[-1].data.endswith(' ...')
    cell.spin_until(lambda: heard and heard[-1].status[0].message.endswith(long))
    trouble = 'samples are in memory only: ' + 'no space left on a device of a long name ' * 5
    monkeypatch.setattr(Archive, 'trouble', f'{trouble}; ')
    cell.spin_until(lambda: words[-1].data.startswith('samples are in memory only: '))
    assert 100 < len(words[-1].data) <= 120
    assert '...; the arm is moving' in words[-1].data


def test_residual_markers_are_well_formed(cell, recording):
    cell.play(topics(recording))
    assert cell.call('identify').success
    heard = cell.listen(MarkerArray, 'calibration_node/residuals')
    cell.spin_until(lambda: heard)
    (lines,) = heard[0].markers
    assert (lines.type, lines.action) == (Marker.LINE_LIST, Marker.ADD)
    assert lines.header.frame_id == 'tracker'
    assert lines.pose.orientation.w == 1.0
    assert lines.scale.x > 0.0
    assert len(lines.points) == len(lines.colors) == 2 * STOPS
    assert all(color.a == 1.0 and 0.0 <= color.r <= 1.0 for color in lines.colors)
    begins = np.array([[p.x, p.y, p.z] for p in lines.points[::2]])
    ends = np.array([[p.x, p.y, p.z] for p in lines.points[1::2]])
    measured = cell.node.session.problem().observations
    np.testing.assert_allclose(begins, measured.positions, atol=1e-12)
    predicted = cell.node.session.calibration.chain.forward(measured.joints)[:, :3, 3]
    np.testing.assert_allclose(ends - begins, 200.0 * (predicted - measured.positions), atol=1e-9)


def test_residuals_of_all_devices_are_drawn_in_one_frame(tmp_path, recording, truth):
    there = replace(truth, base=random_frame(np.random.default_rng(8), 2.0))
    joints = recording.poses.joints
    other = measure(there, joints, np.random.default_rng(9), 2e-5, 1e-4).at(
        recording.poses.stamps_ns
    )
    sources = ['measured_pose', 'other device=B']
    with Cell(chain='ur10e', data_dir=str(tmp_path), sources=sources) as cell:
        some = pose_messages(other, frame_id='elsewhere')
        cell.play(topics(recording, other=some))
        assert cell.call('identify').success
        heard = cell.listen(MarkerArray, 'calibration_node/residuals')
        cell.spin_until(lambda: heard)
        (lines,) = heard[0].markers
        assert lines.header.frame_id == 'tracker'
        ends = np.array([[p.x, p.y, p.z] for p in lines.points[::2]]).reshape(2, STOPS, 3)
        np.testing.assert_allclose(ends[1], ends[0], atol=5e-4)


# Parameters


def declared(node):
    return {name: parameter.value for name, parameter in node.get_parameters_by_prefix('').items()}


def test_the_parameter_file_holds_every_parameter_with_its_default(cell):
    with open(SHIPPED) as file:
        (content,) = yaml.safe_load(file).values()
    shipped = content['ros__parameters']
    foreign = ('qos_overrides.', 'use_sim_time', 'start_type_description_service')
    plain = {
        name: value for name, value in declared(cell.node).items() if not name.startswith(foreign)
    }
    assert list(shipped) == list(plain)
    of_this_test = {'chain': '', 'data_dir': ''}
    assert shipped == plain | of_this_test


@pytest.mark.parametrize(
    ('name', 'value', 'said'),
    [
        ('model', 'nonsense', 'unknown effect or joint "nonsense"'),
        ('model', 'gear', 'nothing to fit in "gear"'),
        ('loss', 'hubert', 'did you mean "huber"'),
        ('fixed', ['joint_7.a'], 'unknown parameter "joint_7.a"'),
        ('priors', ['*.a=much'], 'must be a finite number'),
        ('sigma_position', -1.0, 'sigma_position'),
        ('sigma_position', 1, "expected 'Type.DOUBLE'"),
        ('folds', 1, 'folds'),
        ('longest_stop', 0.1, 'must be shorter than longest_stop (0.1 s)'),
        ('mode', 'continuous', 'read-only'),
        ('joint_names', ['a'], 'read-only'),
        ('serial', 'A8', 'read-only'),
    ],
)
def test_a_setting_that_cannot_be_is_refused_and_changes_nothing(cell, name, value, said):
    before, settings = declared(cell.node), cell.node.session.settings
    (result,) = cell.set_parameters({name: value})
    assert not result.successful
    assert said in result.reason
    assert declared(cell.node) == before
    assert cell.node.session.settings == settings


def test_settings_change_at_run_time(cell, recording):
    cell.play(topics(recording))
    assert cell.call('identify').success
    before = cell.node.session.calibration.chain
    changes = {
        'model': 'ratio',
        'sigma_position': 2e-4,
        'wanted_accuracy': 1e-6,
        'fixed': ['elbow_joint.a'],
        'marker_scale': 10.0,
        'still': 1e-3,
    }
    results = cell.set_parameters(changes)
    assert all(result.successful for result in results), results
    assert cell.node.session.settings == replace(
        Settings(),
        model='ratio',
        sigma_position=2e-4,
        wanted_accuracy=1e-6,
        still=1e-3,
        fixed=('elbow_joint.a',),
    )
    assert 'more expected for 0.001 mm' in cell.node.session.status()
    answer = cell.call('identify')
    assert answer.success, answer.message
    after = cell.node.session.calibration.chain
    assert after.table[2, 0] == load_chain('ur10e').table[2, 0] != before.table[2, 0]
    assert len(after.effects) == 6


def test_all_of_an_atomic_change_or_nothing(cell):
    settings = cell.node.session.settings
    changes = [Parameter('sigma_position', value=5e-4), Parameter('model', value='nonsense')]
    assert not cell.node.set_parameters_atomically(changes).successful
    assert cell.node.session.settings == settings
    assert cell.node.get_parameter('sigma_position').value == settings.sigma_position


# Names, time, several robots, the end


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
        answer = cell.call('identify', node='/cell_2/arm')
        assert answer.success, answer.message
        texts = cell.listen(String, '/cell_2/arm/calibration')
        cell.spin_until(lambda: texts)
        record = calibration_record(texts[0].data)
        assert record['topics'] == ['/cell_2/ur/joint_states', '/tracker/pose']


def test_stamps_follow_simulated_time(tmp_path):
    with Cell(chain='ur10e', data_dir=str(tmp_path), use_sim_time=True) as cell:
        diagnostics = cell.listen(DiagnosticArray, '/diagnostics', 10)
        cell.spin_until(lambda: diagnostics)  # it speaks although the clock stands still
        assert stamp_ns(diagnostics[0]) == 0
        clock = cell.publisher(Clock, '/clock')
        for seconds in (1000, 2000, 500):  # and when it jumps back
            clock.publish(Clock(clock=Time(sec=seconds)))
            cell.spin_until(lambda now=seconds: stamp_ns(diagnostics[-1]) == now * 10**9)


def test_several_robots_in_one_process(tmp_path, recording, truth):
    rng = np.random.default_rng(12)
    small = faulty(load_chain('meca500'), SimulatedCell(), rng)
    other = shift(small)
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
        for node, true in zip(cell.nodes, (truth, small), strict=True):
            unseen = true.random_joints(100, rng)
            error = node.session.calibration.chain.forward(unseen) - true.forward(unseen)
            assert np.linalg.norm(error[:, :3, 3], axis=1).max() < 1e-4
            assert node.session.account().dropped == {}
        lines = {'a/calibration_node: calibration', 'b/calibration_node: calibration'}
        cell.spin_until(lambda: {report.status[0].name for report in reports} == lines)
    journals = sorted(path.name.partition('_')[0] for path in tmp_path.glob('*Z.csv'))
    assert journals == ['meca500', 'ur10e']


@pytest.mark.parametrize(
    ('parameters', 'said'),
    [
        ({'chain': ''}, 'parameter "chain" is not set'),
        ({'chain': 'ur10f'}, 'did you mean "ur10"?'),
        ({'folds': 1}, 'folds'),
        ({'folds': 5.5}, 'folds'),
        ({'model': 'ration'}, 'did you mean "ratio"'),
        ({'mode': 'dwel'}, 'did you mean "dwell"'),
        ({'fixed': ['joint_2.a']}, 'unknown parameter "joint_2.a"'),
        ({'sources': ['pose typ=Range']}, 'did you mean "type"'),
        ({'sources': ['/pose type=Rangee']}, 'sensor_msgs/msg/Range'),
        ({'sources': ['/pose', '/pose type=Range']}, 'named twice'),
        ({'max_gapp': 1.0}, 'did you mean "max_gap"'),
        ({'delay': 'none'}, 'parameter "delay" must be a number'),
        ({'serial': 12}, 'must be text, not 12: write it in quotes'),
        ({'model': True}, 'parameter "model" must be text, not True'),
        ({'marker_scale': 'large'}, 'parameter "marker_scale" must be a number, not \'large\''),
        ({'resume': 1}, 'parameter "resume" must be true or false, not 1'),
        ({'folds': 5.0}, 'parameter "folds" must be a whole number, not 5.0'),
        ({'folds': True}, 'parameter "folds" must be a whole number, not True'),
        ({'sources': '/tf'}, 'parameter "sources" must be a list of texts such as ['),
        ({'joint_names': [1, 2]}, 'parameter "joint_names" must be a list of texts such as ['),
        ({'shortest_stop': 6.0}, 'shortest_stop (6 s) must be shorter than longest_stop (5 s)'),
        ({'settle': 100.0}, 'settle (100 s) must be shorter than longest_stop (5 s)'),
    ],
)
def test_a_wrong_parameter_is_refused_at_the_start(tmp_path, parameters, said):
    with Cell() as cell, pytest.raises((CalibrationError, ParameterException)) as caught:
        cell.start(**{'chain': 'ur10e', 'data_dir': str(tmp_path)} | parameters)
    assert said in str(caught.value)


def test_whole_numbers_are_numbers(tmp_path):
    with Cell(chain='ur10e', data_dir=str(tmp_path), marker_scale=100, settle=1) as cell:
        assert cell.node.get_parameter('marker_scale').value == 100.0
        assert cell.node.session.settings.settle == 1.0


def test_a_parameter_out_of_range_ends_the_node_with_one_clear_line(capsys, ended_by):
    assert ended_by('chain:=ur10e', 'folds:=1') == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert 'folds' in line


@pytest.mark.parametrize(
    ('words', 'said'),
    [
        (['--params-file', '/nowhere.yaml'], '/nowhere.yaml'),
        (['-p', 'chain'], "parse parameter override rule: '-p chain'"),
        (['-r', '__ns:=bad-name'], '__ns:=bad-name'),
        (['--foo'], "unknown ROS arguments: ['--foo']"),
    ],
)
def test_words_that_ros_cannot_read_are_told(capsys, words, said):
    with pytest.raises(SystemExit) as caught:
        node_module.main(['--ros-args', '-p', 'chain:=ur10e', *words])
    assert caught.value.code == 2
    assert said in capsys.readouterr().err


def test_help_names_every_parameter_and_starts_nothing(capsys):
    with pytest.raises(SystemExit) as caught:
        node_module.main(['--help'])
    assert caught.value.code == 0
    out = capsys.readouterr().out
    for name in PARAMETERS:
        assert f'\n  {name}' in out
    assert '--ros-args -p chain:=ur10e' in out


def test_words_that_are_not_for_ros_are_refused(capsys):
    """ROS ignores them."""
    with pytest.raises(SystemExit) as caught:
        node_module.main(['--serial', '7', '--ros-args', '-p', 'chain:=ur10e'])
    assert caught.value.code == 2
    assert 'unrecognized arguments: --serial 7' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('word', 'meant'),
    [('0012', '0012'), ('"0012"', '0012'), ("'1e5'", '1e5'), ('yes', 'yes'), ('A 7', 'A 7')],
)
def test_a_serial_number_is_text(word, meant):
    words = typed(['node', '--ros-args', '-p', f'serial:={word}', '-p', 'folds:=4'])
    assert words[-1] == 'folds:=4'
    assert yaml.safe_load(words[3].partition(':=')[2]) == meant


def test_the_parameter_file_applies_under_a_namespace(tmp_path):
    with open(SHIPPED) as file:
        text = file.read().replace("chain: ''", 'chain: meca500')
    path = tmp_path / 'parameters.yaml'
    path.write_text(text)
    words = ('--params-file', str(path), '-r', '__ns:=/cell_2', '-r', '__node:=arm')
    with (
        Cell() as cell,
        Child(*words, domain=cell.domain, serial='0012', data_dir=tmp_path) as child,
    ):
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        assert 'cell_2.arm' in child.wait_for('ready to calibrate meca500')
        cell.spin_until(lambda: heard)
        assert heard[0].status[0].hardware_id == '0012'  # text, although ROS makes it 12
        assert child.end(signal.SIGINT) == 0, child.output
        assert 'Traceback' not in child.output


def test_recordings_of_all_topics_tell_what_the_node_published(tmp_path):
    with Cell(chain='ur10e', data_dir=str(tmp_path)) as cell:
        node = cell.start(
            namespace='/hall/left', remap=('__node:=calib',), chain='ur10e', data_dir=str(tmp_path)
        )
        found = cell.peer.get_publisher_names_and_types_by_node
        own = {}
        cell.spin_until(lambda: own.update(found('calib', '/hall/left')) or len(own) > 9)
        assert node.get_fully_qualified_name() == '/hall/left/calib'
    available = {topic: kinds[0] for topic, kinds in own.items()}
    private = {topic for topic in available if topic.startswith('/hall/left/calib/')}
    assert {topic.rpartition('/')[2] for topic in private} >= {'corrected_pose', 'next_pose'}
    assert outputs(available | {'/hall/left/measured_pose': 'x'}) == private
