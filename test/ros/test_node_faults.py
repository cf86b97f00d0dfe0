# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A real node in real rclpy when something goes wrong: dead sources, wrong messages."""

from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from ros_cell import Cell, joint_messages, part, pose_messages, topics, values_of
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, Range
from std_msgs.msg import String

from calib_ros.files.archive import Archive
from calib_ros.ros import deferred, inputs as inputs_module, node as node_module
from calib_ros.ros.advisor import Guide
from calib_ros.ros.diagnostics import Diagnostics
from calib_ros.ros.outputs import Keeper
from calib_ros.sampling.live import LiveEstimate
from calib_ros.sampling.session import CalibrationSession

BROKEN = {
    'taking messages': (node_module, 'feed'),
    'the corrected pose': (Keeper, 'publish_pose'),
    'the journal': (Archive, 'write'),
    'the status': (CalibrationSession, 'told'),
    'expected accuracy or next pose': (LiveEstimate, 'update'),
    'the account': (CalibrationSession, 'account'),
    'judging': (Diagnostics, '_judged'),
    'the figures': (Guide, 'figures'),
}


def test_a_part_that_fails_does_not_silence_the_others(monkeypatch, cell, recording):
    """It is told at level ERROR, and everything is as before when it works again."""
    diagnostics = cell.listen(DiagnosticArray, '/diagnostics', 10)
    status = cell.listen(String, '/calibration_node/status')
    logged = cell.log()
    cell.play(part(recording, 0, 10))
    for k, (what, part_of_it) in enumerate(BROKEN.items()):

        def fail(*arguments, what=what, **more):
            raise ZeroDivisionError(f'{what} is broken')

        with monkeypatch.context() as broken:
            broken.setattr(*part_of_it, fail)
            said = f'{what} failed'
            cell.spin_until(lambda s=said: s in ''.join(m.status[0].message for m in diagnostics))
            found = diagnostics[-1].status[0]
            assert found.level == DiagnosticStatus.ERROR
            assert f'{what} is broken' in found.message
            cell.spin_until(lambda s=f'{what} is broken': any(s in m.msg for m in logged))
            assert (what != 'the status') == ('poses' in found.message)
            assert (what in ('the account', 'the figures')) == (not found.values)
            if what not in ('taking messages', 'the status'):
                heard = len(status)
                cell.play(part(recording, 10 + 1.5 * k, 11.5 + 1.5 * k))
                cell.spin_until(lambda n=heard: len(status) > n)
        count = len(diagnostics)
        cell.spin_until(lambda n=count: len(diagnostics) > n + 1)
        found = diagnostics[-1].status[0]
        assert found.level in (DiagnosticStatus.OK, DiagnosticStatus.WARN)
        assert 'failed' not in found.message
        assert 'poses' in found.message
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

    status = cell.listen(String, 'calibration_node/status')
    silent = 'no more messages on /measured_pose'
    rate = 'rate of /measured_pose [Hz]'
    cell.spin_until(lambda: sum(1 < float(values_of(m).get(rate, 0)) < 1000 for m in heard) > 2)
    alive.remove(tracker)
    wait_for(silent)
    cell.spin_until(lambda: f'; {silent}; ' in status[-1].data)  # the operator reads no other
    assert heard[-1].status[0].level == DiagnosticStatus.WARN
    assert '/joint_states' not in heard[-1].status[0].message
    alive.append(tracker)
    wait_for(silent, wanted=False)
    alive.clear()
    wait_for('no more messages on /joint_states')


def test_poses_in_another_frame_than_frame_id_are_dropped(tmp_path, recording):
    few = part(recording, 0.0, 5.0)
    few['measured_pose'][4].header.frame_id = 'camera'
    with Cell(chain='ur10e', data_dir=str(tmp_path), frame_id='tracker') as cell:
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        cell.spin_until(lambda: heard)
        cell.play(few)
        cell.spin_until(lambda: any('messages are dropped' in m.status[0].message for m in heard))
        cell.spin_until(lambda: 'messages are dropped' not in heard[-1].status[0].message)
        said = 'measurements: in frame "camera", not in frame_id "tracker"'
        assert cell.node.session.account().dropped == {said: 1}


@pytest.mark.parametrize('all_renamed', [True, False])
def test_a_renamed_joint_is_named(cell, recording, all_renamed):
    names = [name.replace('_joint', '') for name in recording.joint_names]
    if not all_renamed:
        names = [*recording.joint_names[:5], 'tool0']
    words = cell.listen(String, 'calibration_node/status')
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    joints, poses = joint_messages(recording, names)[:200], pose_messages(recording.poses)[:16]
    cell.play({'joint_states': joints, 'measured_pose': poses})
    answer = cell.refused('identify')
    assert 'set joint_names' in answer.message
    assert names[5] in cell.in_full(answer)
    said = 'waiting for joint states, set joint_names? Received '
    cell.spin_until(lambda: words and words[-1].data.startswith(said))
    whole = f'{said}tool0, not wrist_3_joint; '
    if all_renamed:
        others, missing = ', '.join(sorted(names)[:5]), ', '.join(recording.joint_names[:5])
        whole = f'{said}{others}, and 1 more, not {missing}, and 1 more; '
    cell.spin_until(lambda: heard and whole in heard[-1].status[0].message)


def test_the_diagnostics_warn_of_what_the_status_says(cell, recording):
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    cell.play({'joint_states': joint_messages(recording)[:50]})
    cell.spin_until(lambda: heard and 'no measurements received' in heard[-1].status[0].message)
    assert heard[-1].status[0].level == DiagnosticStatus.WARN
    cell.play({'measured_pose': pose_messages(recording.poses)[:4]})
    cell.spin_until(lambda: heard[-1].status[0].level == DiagnosticStatus.OK)


def test_poses_that_no_identification_takes_are_told_by_the_status(cell, recording):
    """The status ended in an internal error, and nobody was told what was wrong."""
    logged = cell.log()
    distances = 1e3 * np.linalg.norm(recording.poses.positions, axis=1)
    wire = pose_messages(recording.poses, Range, distances=distances)
    cell.play({'joint_states': joint_messages(recording), 'measured_distance': wire})
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    cell.spin_until(lambda: heard and 'are they in metres' in heard[-1].status[0].message)
    assert heard[-1].status[0].level != DiagnosticStatus.ERROR
    assert 'the distances vary by' in str(cell.node.session.told())
    cell.refused('identify')
    count = len(heard)
    cell.spin_until(lambda: len(heard) > count + 1)
    assert not [each.msg for each in logged if 'internal error' in each.msg]


def test_two_nodes_of_one_name_are_told(cell, tmp_path):
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    logged = cell.log()
    said = '2 nodes are named /calibration_node'
    cell.spin_until(lambda: heard)
    assert said not in heard[-1].status[0].message
    other = cell.start(chain='ur10e', data_dir=str(tmp_path / 'other'))
    cell.spin_until(lambda: said in heard[-1].status[0].message)
    assert heard[-1].status[0].level == DiagnosticStatus.WARN
    cell.spin_until(lambda: sum(said in each.status[0].message for each in heard) > 6)
    cell.spin_until(lambda: any(said in each.msg for each in logged))
    assert sum(said in each.msg for each in logged) <= 2  # once by each, not each second
    cell.executor.remove_node(other)
    cell.nodes.remove(other)
    assert other.close()
    count = len(heard)
    cell.spin_until(lambda: len(heard) > count and said not in heard[-1].status[0].message)


def test_a_list_without_end_is_refused(cell):
    for entries, said in (
        ([f'joint_{k}.a' for k in range(100_000)], 'fixed has 100000 entries; the limit is 1000'),
        (['x' * 100_000], 'has 100000 characters in an entry'),
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

        said = 'negative times on /clock are ignored'
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
    node._boundary.guarded(int)('x')
    assert 'internal error' in capfd.readouterr().err


def test_heavy_losses_are_refused_as_in_a_bag_unless_they_are_allowed(cell, recording):
    """The node warned and published what `identify` of the same messages refused."""
    given = topics(recording)
    for message in given['measured_pose'][::4]:
        message.header.stamp = Time()
    cell.play(given)
    answer = cell.refused('identify')
    told = '25 % of the measurements were dropped: '
    told += 'zero stamp (fill header.stamp where it is published)'
    assert f'{told} ... full text: ' in answer.message
    assert f'{told}; remove the cause, or accept the rest with' in cell.in_full(answer)
    assert cell.set_parameters({'largest_loss': 0.26})[0].successful
    cell.done('identify')


def test_without_a_thread_it_is_done_all_the_same(cell, recording, monkeypatch):
    """On a machine with too many processes the call was never answered, nor the node closed."""
    cell.play(topics(recording))
    start = MagicMock(side_effect=RuntimeError("can't start new thread"))
    none = SimpleNamespace(Thread=lambda **_: SimpleNamespace(start=start))
    monkeypatch.setattr(deferred, 'threading', none)
    cell.done('identify')
    cell.done('save')
    assert start.call_count == 2
    monkeypatch.undo()
    cell.done('identify')
