# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a real node offers around an identification: next pose, errors, corrected trajectories."""

import threading
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from ros_cell import PATIENCE, STOPS, Cell, joint_messages, part, pose_messages, topics, values_of
from sensor_msgs.msg import JointState, PointCloud2, Range
from sessions import samples
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from calib_ros.apply.compensation import compensate
from calib_ros.apply.compensator import Compensator
from calib_ros.errors import InputError
from calib_ros.files.programs import joints_csv
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.ros import advisor as guide_module
from calib_ros.sampling.live import LiveEstimate

UR = load_chain('ur10e')
NODE = 'calibration_node'


@pytest.fixture(scope='module')
def calibrated(tmp_path_factory, recording):
    """Return a cell with a node that has identified the arm, which nothing shall change."""
    with Cell(chain='ur10e', data_dir=str(tmp_path_factory.mktemp('calibrated'))) as cell:
        cell.play(topics(recording))
        cell.done('identify')
        yield cell


def test_the_next_pose_follows_the_samples_and_is_latched(cell, recording):
    early = cell.listen(JointState, f'{NODE}/next_pose')
    reports = cell.listen(DiagnosticArray, '/diagnostics', 10)
    cell.play(part(recording, 0.0, 4.0))
    cell.spin_until(lambda: early)
    assert list(early[0].name) == list(UR.joint_names)
    assert np.isfinite(early[0].position).all()
    cell.spin_until(lambda: reports and values_of(reports[-1])['enough samples'] == 'False')
    cell.play(part(recording, 4.0, 25.0))
    cell.spin_until(lambda: values_of(reports[-1])['enough samples'] == 'True')
    assert float(values_of(reports[-1])['expected [mm]']) < 0.1
    cell.spin_until(lambda: len({tuple(message.position) for message in early}) > 1)
    late = cell.listen(JointState, f'{NODE}/next_pose')
    cell.spin_until(lambda: late)
    limits = np.array([[joint.lower, joint.upper] for joint in UR.joints])
    for message in (*early, *late):
        assert (limits[:, 0] <= message.position).all()
        assert (message.position <= limits[:, 1]).all()


@pytest.mark.parametrize('unit', [1.0, 1e3])
def test_no_accuracy_is_expected_in_figures_of_poses_that_fit_no_arm(cell, truth, unit):
    taken = [replace(s, position=unit * s.position) for s in samples(8, true=truth)]
    cell.node.session.restore(taken)
    cell.node.session.status()
    assert ('expected [mm]' in cell.node._guide.figures()) == (unit == 1.0)


def test_an_estimate_that_takes_long_holds_up_nothing(cell, recording, monkeypatch):
    """With fifty targets it takes seconds; calls and the status waited for it."""
    status = cell.listen(String, f'{NODE}/status')
    go_on, update = threading.Event(), LiveEstimate.update

    def slow(self, samples):
        assert go_on.wait(PATIENCE)
        return update(self, samples)

    monkeypatch.setattr(LiveEstimate, 'update', slow)
    cell.play(topics(recording))
    cell.spin_until(lambda: status and '; 22 poses' in status[-1].data)
    cell.done('remove_last')
    cell.spin_until(lambda: status[-1].data.endswith('; 21 poses'))
    go_on.set()
    cell.spin_until(lambda: 'mm expected' in status[-1].data)


def test_the_next_pose_is_one_of_the_candidates_that_was_not_taken(tmp_path, recording):
    stops = recording.poses.joints[:24:4]
    fresh = stops[0] + 0.01
    (tmp_path / 'poses.csv').write_text(joints_csv(np.concatenate([stops, [fresh]])))
    names = [f'axis_{k}' for k in range(6)]
    parameters = {'candidates': str(tmp_path / 'poses.csv'), 'joint_names': names}
    with Cell(chain='ur10e', data_dir=str(tmp_path), **parameters) as cell:
        heard = cell.listen(JointState, f'{NODE}/next_pose')
        messages = topics(recording)
        messages['joint_states'] = joint_messages(recording, names)
        cell.play(messages)
        session, guide = cell.node.session, cell.node._guide
        cell.spin_until(lambda: len(guide._advised) == len(session.samples) > len(stops))
        cell.spin_until(guide._advising.done)
        cell.spin_until(lambda: heard and np.allclose(heard[-1].position, fresh, atol=1e-8))
        assert list(heard[-1].name) == names
        guide._candidates, guide._advised = stops, ()  # the last one stayed, though it was taken
        cell.spin_until(lambda: not heard[-1].name)


def test_candidates_that_are_none_stop_the_start(tmp_path):
    (tmp_path / 'poses.csv').write_text('q1,q2\n0,0\n')
    with Cell() as cell, pytest.raises(InputError, match='has no column q3'):
        cell.start(chain='ur10e', data_dir=str(tmp_path), candidates=str(tmp_path / 'poses.csv'))


def test_nothing_is_planned_for_distances_or_in_motion(tmp_path, recording):
    distances = np.linalg.norm(recording.poses.positions, axis=1)
    wire = pose_messages(recording.poses, Range, distances=distances)
    for more, parameters in (
        ({'measured_distance': wire}, {}),
        ({'measured_pose': pose_messages(recording.poses)}, {'mode': 'continuous'}),
    ):
        with Cell(chain='ur10e', data_dir=str(tmp_path), **parameters) as cell:
            heard = cell.listen(JointState, f'{NODE}/next_pose')
            diagnostics = cell.listen(DiagnosticArray, '/diagnostics', 10)
            cell.play({'joint_states': joint_messages(recording), **more})
            cell.node.session.finish()
            count = len(diagnostics)
            cell.spin_until(lambda d=diagnostics, n=count: len(d) > n + 2)
            assert cell.node.session.samples
            assert not heard


def test_errors_over_the_workspace_come_with_an_accepted_identification(calibrated):
    heard = calibrated.listen(PointCloud2, f'{NODE}/workspace_error')
    calibrated.spin_until(lambda: heard)
    (message,) = heard
    fields = [(field.name, field.offset) for field in message.fields]
    assert fields == [('x', 0), ('y', 4), ('z', 8), ('error', 12), ('sigma', 16)]
    assert message.header.frame_id == 'tracker'
    assert message.is_dense
    assert (message.height, message.point_step) == (1, 20)
    points = np.frombuffer(bytes(message.data), '<f4').reshape(message.width, 5)
    assert len(points) == guide_module.CLOUD
    calibration = calibrated.node.session.calibration
    q = calibration.chain.random_joints(guide_module.CLOUD, np.random.default_rng(0))
    after, before = calibration.chain.forward(q), calibration.before.forward(q)
    np.testing.assert_allclose(points[:, :3], after[:, :3, 3], atol=1e-5)
    removed = np.linalg.norm((after - before)[:, :3, 3], axis=1)
    np.testing.assert_allclose(points[:, 3], removed, rtol=1e-4)
    assert 1e-3 < points[:, 3].mean() < 5e-3
    np.testing.assert_allclose(points[:, 4], calibration.sigma(q), rtol=1e-4)


def path(count=50):
    """Return a smooth path (count, 6) with its velocities and accelerations, and its times."""
    start = np.array([0.3, -1.2, 1.4, -0.5, 0.9, 0.2])
    reach = np.array([0.4, 0.2, -0.3, 0.3, 0.2, -0.5])
    time = np.linspace(0.0, 2.0, count)
    s = 0.5 - 0.5 * np.cos(np.pi * time / 2.0)
    rate = 0.25 * np.pi * np.sin(np.pi * time / 2.0)
    bend = 0.125 * np.pi**2 * np.cos(np.pi * time / 2.0)
    outer = [row[:, None] * reach for row in (s, rate, bend)]
    return start + outer[0], outer[1], outer[2], time


def trajectory(q, velocities=None, accelerations=None, times=None, names=UR.joint_names):
    message = JointTrajectory(joint_names=list(names))
    message.header.frame_id = 'program'
    for k, row in enumerate(q.tolist()):
        point = JointTrajectoryPoint(positions=row, effort=[float(k)] * len(row))
        if velocities is not None:
            point.velocities = velocities[k].tolist()
        if accelerations is not None:
            point.accelerations = accelerations[k].tolist()
        seconds = float(k if times is None else times[k])
        whole = int(seconds)
        point.time_from_start = Duration(sec=whole, nanosec=int((seconds - whole) * 1e9))
        message.points.append(point)
    return message


def send(cell, message):
    """Publish a trajectory; return what the node says of it when it has done with it."""
    diagnostics = cell.listen(DiagnosticArray, '/diagnostics', 10)
    cell.node._guide._last_trajectory = ''
    cell.publisher(JointTrajectory, f'{NODE}/joint_trajectory').publish(message)
    cell.spin_until(lambda: cell.node._guide._last_trajectory)
    said = cell.node._guide._last_trajectory
    cell.spin_until(lambda: diagnostics and values_of(diagnostics[-1])['last trajectory'] == said)
    return said


def corrections(cell):
    """Return the corrected trajectories that will be heard."""
    listeners = cell.node._guide._corrected.get_subscription_count
    before = listeners()
    heard = cell.listen(JointTrajectory, f'{NODE}/compensated_joint_trajectory', 10)
    cell.spin_until(lambda: listeners() > before)
    return heard


def test_a_trajectory_is_corrected(calibrated, monkeypatch):
    corrected = corrections(calibrated)
    q, velocities, accelerations, times = path()
    message = trajectory(q, velocities, accelerations, times)
    said = send(calibrated, message)
    assert said.startswith('50 of 50 points corrected')
    assert 'standard deviation of these poses: at most 0.0' in said
    assert 'does not know the orientation' not in said
    calibrated.spin_until(lambda: corrected)
    (answer,) = corrected
    found = np.array([point.positions for point in answer.points])
    calibration = calibrated.node.session.calibration
    expected = compensate(Compensator(UR, calibration.chain), q)
    np.testing.assert_allclose(found, expected.joints, rtol=0, atol=1e-12)
    assert answer.header.frame_id == 'program'
    assert list(answer.joint_names) == list(UR.joint_names)
    for given, point in zip(message.points, answer.points, strict=True):
        assert given.time_from_start == point.time_from_start
        assert given.effort == point.effort
    rates = np.array([point.velocities for point in answer.points])
    assert 1e-4 < np.abs(rates - velocities).max() < 0.05
    bends = np.array([point.accelerations for point in answer.points])
    assert 1e-5 < np.abs(bends - accelerations).max() < 0.05
    told = calibrated.log()
    monkeypatch.setattr(guide_module, 'knowledge', lambda *_: ('', 'too little'))
    known, _, _ = said.partition('; standard deviation of')
    assert send(calibrated, message) == f'{known}; too little'
    calibrated.spin_until(lambda: any('trajectory: too little' in each.msg for each in told))


def test_other_joints_and_names_of_the_robot_by_the_last_calibration(tmp_path, calibrated):
    names = [f'axis_{k}' for k in range(6)]
    with Cell(chain='ur10e', data_dir=str(tmp_path), joint_names=names) as cell:
        heard = corrections(cell)
        q = path(5)[0]
        wide = np.column_stack([np.arange(5.0), q[:, ::-1]])
        for size in (1e-3, 2e-3):
            chain = UR.with_offsets({'elbow_joint.a': size})
            cell.node.session.adopt(Calibration(chain, UR))
            heard.clear()
            send(cell, trajectory(wide, names=['gripper', *names[::-1]]))
            cell.spin_until(lambda: heard)
            found = np.array([point.positions for point in heard[0].points])
            assert list(heard[0].joint_names) == ['gripper', *names[::-1]]
            np.testing.assert_array_equal(found[:, 0], np.arange(5.0))
            expected = compensate(Compensator(UR, chain), q).joints
            np.testing.assert_allclose(found[:, :0:-1], expected, rtol=0, atol=1e-12)
            assert [len(point.velocities) for point in heard[0].points] == [0] * 5
        narrow = replace(calibrated.node.session.calibration.region, limit=1e-9)
        cell.node.session.adopt(Calibration(chain, UR, region=narrow))
        said = send(cell, trajectory(q, names=names))
        assert 'refused: 0 of 5 points corrected' in said
        assert 'not valid in 100 % of the program' in said


def test_nothing_is_corrected_without_a_calibration(idle):
    corrected, logged = corrections(idle), idle.log()
    said = send(idle, trajectory(path(5)[0]))
    assert 'refused: there is no accepted calibration' in said
    idle.spin_until(lambda: any(f'trajectory {said}' == each.msg for each in logged))
    assert not corrected


def beyond(q):
    q[3, 2] = 4.0
    return trajectory(q)


def singular(q):
    q[2, 4] = 0.0
    return trajectory(q)


WRONG = {
    'point 4: the command 4 of elbow_joint is beyond its limits': beyond,
    'point 3: near a singularity': singular,
    'unknown joint in the program': lambda q: trajectory(q, names='abcdef'),
    '8 points; the limit is 7': lambda q: trajectory(np.repeat(q[:1], 8, axis=0)),
}


def test_trajectories_that_cannot_be_corrected_are_refused(calibrated, monkeypatch):
    corrected = corrections(calibrated)
    monkeypatch.setattr(guide_module, 'MOST_POINTS', 7)
    for reason, make in WRONG.items():
        said = send(calibrated, make(path(5)[0]))
        assert said.startswith('refused: ')
        assert reason in said
    many = path(7)[0]
    many[:, 4] = 0.0
    said = send(calibrated, trajectory(many))
    assert 'and 2 more' in said
    assert not corrected
    send(calibrated, trajectory(path(5)[0]))
    calibrated.spin_until(lambda: corrected)
    assert len(corrected) == 1


@pytest.mark.parametrize(
    ('message', 'said'),
    [
        (JointTrajectory(points=[JointTrajectoryPoint()] * 60_000), '60000 points; the limit'),
        (
            JointTrajectory(points=[JointTrajectoryPoint(effort=[0.0] * 2_600_000)]),
            'bytes; the limit is 20000000',
        ),
        (JointTrajectory(joint_names=['j'] * 20_000), 'refused: 20000 joints; the limit is 1000'),
    ],
    ids=['points', 'bytes', 'joints'],
)
def test_trajectories_that_are_too_large_are_not_even_decoded(idle, monkeypatch, message, said):
    decoded = []
    monkeypatch.setattr(guide_module, 'deserialize_message', lambda *_: decoded.append(1))
    assert said in send(idle, message)
    assert not decoded


def test_messages_are_taken_while_it_computes(cell, recording, monkeypatch):
    """The work waits for the messages here: it could not if they waited for the work."""
    taken, entered = threading.Event(), threading.Event()
    real = guide_module.compensate_program

    def slow(*arguments):
        entered.set()
        assert taken.wait(PATIENCE)
        return real(*arguments)

    monkeypatch.setattr(guide_module, 'compensate_program', slow)
    cell.node.session.adopt(Calibration(UR.with_frame('base', Frame()), UR))
    heard = corrections(cell)
    cell.publisher(JointTrajectory, f'{NODE}/joint_trajectory').publish(trajectory(path(5)[0]))
    cell.spin_until(entered.is_set)
    cell.play(part(recording, 0.0, 10.0))
    assert len(cell.node.session.samples) > STOPS // 4
    assert not heard
    taken.set()
    cell.spin_until(lambda: heard)


def test_the_end_does_not_wait_for_what_has_not_begun(cell, monkeypatch):
    begun, free = threading.Event(), threading.Event()

    def stuck(*arguments):
        begun.set()
        free.wait(PATIENCE)
        raise InputError('too late')

    monkeypatch.setattr(guide_module, 'compensate_program', stuck)
    cell.node.session.adopt(Calibration(UR, UR))
    guide = cell.node._guide
    publisher = cell.publisher(JointTrajectory, f'{NODE}/joint_trajectory')
    for _ in range(3):
        publisher.publish(trajectory(path(5)[0]))
    cell.spin_until(lambda: begun.is_set() and len(guide._pending) == 3)
    monkeypatch.setattr(guide_module, 'MOST_QUEUED', 2)
    assert 'refused: 2 others are already waiting' in send(cell, trajectory(path(5)[0]))
    assert not guide.join(0.05)
    free.set()
    assert guide.join(PATIENCE)


def test_many_candidates_take_no_memory_for_each_pose():
    """50,000 of them and 300 poses took 1.5 GB and twelve seconds after each pose."""
    rng = np.random.default_rng(0)
    candidates = rng.uniform(-3.0, 3.0, (10_000, 6))
    taken = candidates[::50] + rng.uniform(-0.9, 0.9, (200, 6)) * guide_module.STILL
    tracemalloc.start()
    left = guide_module._untaken(candidates, taken)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_array_equal(left, np.delete(candidates, np.s_[::50], axis=0))
    assert most < 10 * candidates.nbytes
