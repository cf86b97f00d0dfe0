# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A real node in real rclpy: what it publishes."""

import time
from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from ros_cell import STOPS, Cell, joint_messages, part, pose_messages, topics, values_of
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import SetBool
from visualization_msgs.msg import Marker, MarkerArray

from calib_ros.apply.simulation import measure, random_frame
from calib_ros.files.archive import Archive
from calib_ros.kinematics import se3
from calib_ros.ros.identifying import ANSWER_LENGTH
from calib_ros.sampling.delay import Delay
from calib_ros.sampling.session import CalibrationSession

JOINT_RATE = 25.0  # they cost more than what is asked


def test_diagnostics_status_and_corrected_pose(tmp_path, recording, truth):
    joints = joint_messages(recording)
    doubled = joints[:500] + joints[450:451] + joints[500:]
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'serial': 'A7'}
    with Cell(**parameters) as cell:
        diagnostics = cell.listen(DiagnosticArray, '/diagnostics', 10)
        heard = cell.listen(PoseStamped, 'calibration_node/corrected_pose', 10)
        begun = time.monotonic()
        cell.play(topics(recording, joint_states=doubled))
        cell.done('identify')
        cell.play({'joint_states': joints[-1:]})
        cell.spin_until(lambda: [m for m in heard if m.header.stamp == joints[-1].header.stamp])
        message = heard[-1]
        assert message.header.frame_id == 'tracker'
        true = truth.forward(recording.joints[-1:])[0]
        point, turn = message.pose.position, message.pose.orientation
        np.testing.assert_allclose([point.x, point.y, point.z], true[:3, 3], rtol=0, atol=1e-4)
        found = se3.from_quat(np.array([turn.x, turn.y, turn.z, turn.w]))
        np.testing.assert_allclose(found, true[:3, :3], rtol=0, atol=1e-3)
        twice = 'not used joints: same stamp twice'  # the last of them is on its way
        cell.spin_until(lambda: diagnostics and values_of(diagnostics[-1]).get(twice) == '2')
        status = diagnostics[-1].status[0]
        assert (status.name, status.hardware_id) == ('calibration_node: calibration', 'A7')
        values = values_of(diagnostics[-1])
        assert values['samples'] == str(STOPS)
        assert values['calibrated'] == 'True'
        assert values['last identification'].startswith('accepted')
        assert 0.0 <= float(values['age of /measured_pose [s]']) <= time.monotonic() - begun + 0.1
        words = cell.listen(String, 'calibration_node/status')
        cell.spin_until(lambda: words and f'; {STOPS} poses, 0.0' in words[-1].data)
        assert words[-1].data.startswith('the arm ')
        assert 'enough for the accuracy wanted' in words[-1].data


def test_a_delay_is_told_no_finer_than_it_is_known(cell, recording, monkeypatch):
    """Of positions at stops it was told as -0.0090 to -0.0160 s, though there was none."""
    diagnostics = cell.listen(DiagnosticArray, '/diagnostics', 10)
    monkeypatch.setattr(CalibrationSession, 'delay', Delay(-0.0049, 0.99))
    cell.play(part(recording, 0.0, 1.0))
    cell.spin_until(lambda: diagnostics and values_of(diagnostics[-1])['delay [s]'] == '0.00')


@pytest.mark.parametrize(
    ('first', 'said'),
    [
        (8, 'base {}; to keep it call ~/save'),
        (12, 'base {}, measure again after ~/clear ... full text'),
        (18, 'base {} and is outdated, measure again after ~/clear; to keep it call ~/save'),
    ],
)
def test_an_answer_says_that_the_device_was_moved_meanwhile(
    cell, recording, first, said, unsearched
):
    """It kept the last clause only: the base published was that of the place before."""
    poses = pose_messages(recording.poses)
    for message in poses[4 * first :]:
        message.pose.position.x += 0.02
    cell.play(topics(recording, measured_pose=poses))
    answer, late = cell.call('identify'), first > STOPS / 2
    assert answer.success == (first != STOPS / 2)
    if answer.success:
        cell.done('save')
        told = '; base moved since: measure again' * late  # a file was published as it was
        assert cell.done('load').message.partition(', made ')[2][10:] == told
        assert cell.node.session.calibration.outdated == ('base',) * late
        cell.node._keeper.publish_pose()
        assert (cell.node._keeper._posed is None) == late
        cell.done('record', SetBool.Request(data=False))
        told = 'measure some new ones; not recording: call ~/record with true'
        assert cell.refused('check').message.endswith(told)
    assert len(answer.message) <= ANSWER_LENGTH
    assert said.format(f'moved by 20 mm before pose {first + 1}') in answer.message
    begin, *_ = answer.message.split(' ... ')  # which was "RMS 1.911"
    assert 'RMS' not in begin or ' mm' in begin


def test_the_status_is_short_and_its_first_words_matter(monkeypatch, cell, recording):
    """The rest is in the diagnostics; `ros2 topic echo` cuts texts at 128 characters."""
    words = cell.listen(String, 'calibration_node/status')
    told = ['the arm is moving', *(f'sample {k} of many words' for k in range(20))]
    monkeypatch.setattr(CalibrationSession, 'told', lambda *_: told)
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    cell.spin_until(lambda: words and words[-1].data.startswith('the arm is moving; sample 0'))
    assert 100 < len(words[-1].data) <= 120
    assert words[-1].data.endswith(' ...')
    cell.spin_until(lambda: heard and heard[-1].status[0].message.endswith('; '.join(told)))
    trouble = 'poses are in memory only: ' + 'no space left on a device of a long name ' * 5
    monkeypatch.setattr(Archive, 'trouble', f'{trouble}; ')
    cell.spin_until(lambda: words[-1].data.startswith('poses are in memory only: '))
    assert 100 < len(words[-1].data) <= 120
    assert '...; the arm is moving' in words[-1].data


def test_why_a_topic_gives_nothing_is_in_the_status_beside_a_long_state(monkeypatch, cell):
    """*set joint_names?* and the names left no room for a publisher that is not heard."""
    said = '/joint_states is published best effort'
    monkeypatch.setattr(cell.node._inputs, 'failures', [said])
    monkeypatch.setattr(cell.node._inputs, 'look', lambda: None)
    monkeypatch.setattr(cell.node.session, 'told', lambda *_: ['waiting ' * 20, '0 poses'])
    status = cell.listen(String, 'calibration_node/status')
    cell.spin_until(lambda: status and said in status[-1].data)


def test_residuals_of_all_devices_are_drawn_in_one_frame(tmp_path, recording, truth):
    there = replace(truth, base=random_frame(np.random.default_rng(8), 2.0))
    poses, rng = recording.poses, np.random.default_rng(9)
    other = measure(there, poses.joints, rng, 2e-5, 1e-4).at(poses.stamps_ns)
    sources = ['measured_pose', 'other device=B']
    with Cell(chain='ur10e', data_dir=str(tmp_path), sources=sources) as cell:
        some = pose_messages(other, frame_id='elsewhere')
        cell.play(topics(recording, other=some))
        cell.done('identify')
        heard = cell.listen(MarkerArray, 'calibration_node/residuals')
        cell.spin_until(lambda: heard)
        (lines,) = heard[0].markers
        assert (lines.type, lines.action) == (Marker.LINE_LIST, Marker.ADD)
        assert lines.header.frame_id == 'tracker'
        assert lines.pose.orientation.w == 1.0
        assert lines.scale.x > 0.0
        assert len(lines.points) == len(lines.colors) == 4 * STOPS
        assert all(color.a == 1.0 and 0.0 <= color.r <= 1.0 for color in lines.colors)
        points = np.array([[p.x, p.y, p.z] for p in lines.points]).reshape(2, STOPS, 2, 3)
        begins, ends = points[:, :, 0], points[:, :, 1]
        measured = cell.node.session.problem().observations
        np.testing.assert_allclose(begins[0], measured.positions, atol=1e-12)
        predicted = cell.node.session.calibration.chain.forward(measured.joints)[:, :3, 3]
        left = predicted - measured.positions
        np.testing.assert_allclose(ends[0] - begins[0], 200.0 * left, atol=1e-9)
        sizes = np.linalg.norm(left, axis=1)
        red = np.minimum(sizes / (3.0 * np.sqrt(np.mean(sizes**2))), 1.0)
        shown = [(color.r, color.g, color.b) for color in lines.colors[: 2 * STOPS : 2]]
        np.testing.assert_allclose(shown, np.column_stack([red, 1.0 - red, 0.0 * red]), atol=1e-6)
        np.testing.assert_allclose(begins[1], begins[0], atol=5e-4)


def test_what_a_camera_on_the_flange_measured_is_drawn_where_its_target_is(tmp_path, recording):
    """Residuals, errors and poses in the frame of the target were said to be in the camera's."""
    poses = recording.poses
    turns = np.swapaxes(poses.rotations, 1, 2)
    places = -(turns @ poses.positions[..., np.newaxis])[..., 0]
    seen = pose_messages(replace(poses, positions=places, rotations=turns), frame_id='camera')
    given = {'sources': ['measured_pose eye_in_hand=true'], 'target_frame': 'board'}
    with Cell(chain='ur10e', data_dir=str(tmp_path), **given) as cell:
        topic = 'calibration_node/corrected_pose'
        poses_heard = cell.listen(PoseStamped, topic, 10)
        cell.play(topics(recording, measured_pose=seen))
        cell.done('identify')
        lines = cell.listen(MarkerArray, 'calibration_node/residuals')
        clouds = cell.listen(PointCloud2, 'calibration_node/workspace_error')
        cell.play({'joint_states': joint_messages(recording)[-1:]})
        cell.spin_until(lambda: lines and clouds and poses_heard)
        marker = lines[0].markers[0]
        for message in (marker, clouds[0], poses_heard[-1]):
            assert message.header.frame_id == 'board'
        at = marker.points[-2]
        place = poses_heard[-1].pose.position
        far = [at.x - place.x, at.y - place.y, at.z - place.z]
        np.testing.assert_allclose(far, 0.0, atol=5e-4)  # of the camera, at the last stop
