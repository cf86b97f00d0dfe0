# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which topics of a recording are read, where it holds more than measurements."""

import numpy as np
import pytest
from recorded import (
    MS,
    TYPES,
    distance,
    header,
    joint_state,
    observations_of,
    pose,
    pose_stamped,
    record,
    session_of,
    standing,
    storages,
    text_message,
)

from calib_ros.errors import ConfigError, InputError
from calib_ros.sampling.messages import CAMERA_INFO, JOINT_STATE, PICTURES
from calib_ros.sampling.sources import RANGEFINDER
from calib_ros.sampling.topics import Recorded, choose_topics
from calib_ros.settings import Settings


def table():
    layout = TYPES['std_msgs/msg/MultiArrayLayout']([], 0)
    return TYPES['std_msgs/msg/Float64MultiArray'](layout, np.zeros(15))


def outputs(node='/calibration_node'):
    """Return what a node publishes, as `ros2 bag record -a` records it."""
    poses = [(f'{node}/corrected_pose', pose_stamped(k * 100 * MS, (9, 9, 9))) for k in range(9)]
    targets = [
        (f'{node}/next_pose', joint_state(k * 300 * MS + 5 * MS, (9, 9, 9))) for k in (1, 2)
    ]
    return [
        (f'{node}/status', text_message('3 samples')),
        (f'{node}/calibration', text_message('name: arm')),
        (f'{node}/dh_parameters', table()),
        *poses,
        *targets,
    ]


def measured():
    return standing([pose_stamped((100 * k + 5) * MS, (k, 2, 3)) for k in range(1, 9)], '/tracker')


@storages
@pytest.mark.parametrize('nodes', [['/calibration_node'], ['/cell_1/left/calibration', '/c']])
def test_what_a_node_publishes_is_neither_measured_nor_a_joint_state(tmp_path, storage, nodes):
    plain = observations_of(record(tmp_path / 'plain', measured(), storage))
    events = [each for node in nodes for each in outputs(node)]
    path = record(tmp_path / 'all', [*events, *measured()], storage)
    mixed = observations_of(path)
    assert mixed.positions.tolist() == plain.positions.tolist()
    assert mixed.joints.tolist() == plain.joints.tolist()
    assert len(mixed) == 8


def test_topics_of_another_node_with_a_status_are_read(tmp_path):
    events = standing([pose_stamped(105 * MS)], '/tracker/pose')
    events += [('/tracker/status', text_message()), ('/tracker/calibration', text_message())]
    assert len(observations_of(record(tmp_path / 'bag', events))) == 1


IMAGE = TYPES['sensor_msgs/msg/Image'](header(5 * MS), 1, 1, 'mono8', 0, 1, np.zeros(1, np.uint8))
TAGS = TYPES['geometry_msgs/msg/PoseArray'](header(5 * MS), [pose()])


@pytest.mark.parametrize(
    ('events', 'said'),
    [
        (outputs()[:-2], r'/calibration_node/corrected_pose \(own output\)'),
        ([('/camera/image_raw', IMAGE)], '--sources "/camera/image_raw board='),
        ([('/tags', TAGS)], '/tags is not read: record /tf with it'),
    ],
)
def test_a_recording_without_measurements_tells_what_it_holds(tmp_path, events, said):
    path = record(tmp_path / 'bag', [*events, *standing([])])
    with pytest.raises(InputError, match=f'has no pose topic .*{said}'):
        session_of(path)


def test_a_source_without_a_type_has_that_of_its_topic(tmp_path):
    wire = [('/wire', distance((100 * k + 5) * MS, 1.0 + k)) for k in range(1, 9)]
    path = record(tmp_path / 'bag', [*measured(), *wire, ('/camera/image_raw', IMAGE)])
    with pytest.raises(ConfigError, match='"/camera/image_raw" needs board=FILE'):
        session_of(path, sources=('/camera/image_raw eye_in_hand=true',))
    session, _ = session_of(path, sources=('/tracker', '/wire'))
    assert {sample.device for sample in session.samples} == {'', RANGEFINDER}


def test_images_without_their_camera_info_are_refused_with_the_key_for_it():
    available = {'/joint_states': JOINT_STATE, '/cam/image': PICTURES[0], '/info': CAMERA_INFO}
    recorded = Recorded(available, lambda streams: iter(()), lambda data, kind: data)
    source = '/cam/image board=board.yaml'
    with pytest.raises(InputError, match=r'has no "/cam/camera_info" .* sources \(info=TOPIC\)'):
        choose_topics(recorded, Settings(sources=(source,)))
    chosen = choose_topics(recorded, Settings(sources=(f'{source} info=/info',)))
    assert chosen.keys() == available.keys()


@pytest.mark.parametrize(
    'settings',
    [
        {'sources': ('/calibration_node/corrected_pose',)},
        {'joint_topics': ('/calibration_node/next_pose',)},
    ],
)
def test_outputs_are_refused_by_name_too(tmp_path, settings):
    path = record(tmp_path / 'bag', [*outputs(), *measured()])
    with pytest.raises(InputError, match='is an output of the calibration node'):
        session_of(path, **settings)


def desired(offset, topic='/controller/desired', names=('c', 'b', 'a')):
    """Return joint states of the arm beside those of `standing`, away from them by an offset."""
    values = np.array([0.3, 0.2, 0.1])[: len(names)] + offset
    return [(topic, joint_state((10 * k + 5) * MS, values, names)) for k in range(1, 100)]


@storages
def test_a_second_topic_of_the_same_joints_is_named(tmp_path, storage):
    path = record(tmp_path / 'bag', [*measured(), *desired(0.25)], storage)
    with pytest.raises(InputError) as caught:
        session_of(path)
    text = str(caught.value)
    assert 'joints a, b, c come on several topics' in text
    assert 'topics: /controller/desired, /joint_states. Choose' in text
    assert '--joint-topics' in text
    for topic, expected in (('/joint_states', 0.1), ('/controller/desired', 0.35)):
        joints = observations_of(path, joint_topics=(topic,)).joints
        np.testing.assert_allclose(joints[:, 0], expected, atol=1e-12)
    both = observations_of(path, joint_topics=('/joint_states', '/controller/desired'))
    assert len(both) == 8


def test_joints_that_come_twice_are_named(tmp_path):
    others = [*desired(0.1, names=('c',)), ('/goal', joint_state(205 * MS, (9,), ('c',)))]
    said = 'joints c come on several topics: /controller/desired, /goal, /joint_states'
    with pytest.raises(InputError, match=said):
        session_of(record(tmp_path / 'bag', [*measured(), *others]))


def test_a_gripper_is_no_second_arm(tmp_path):
    gripper = [('/gripper', joint_state(k * 10 * MS, (0.5,), ('finger',))) for k in range(1, 100)]
    assert len(observations_of(record(tmp_path / 'bag', [*measured(), *gripper]))) == 8


def test_a_damaged_recording_is_held_to_the_same(tmp_path):
    path = record(tmp_path / 'bag', [*outputs(), *measured(), *desired(0.25)])
    (path / 'metadata.yaml').unlink()
    (file,) = path.iterdir()
    file.write_bytes(file.read_bytes()[:-400])
    with pytest.raises(InputError, match='joints a, b, c come on several topics'):
        session_of(path)
    assert len(observations_of(path, joint_topics=('/joint_states',))) == 8
