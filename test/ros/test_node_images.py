# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A camera on the flange before a printed board, live: from images to a calibration."""

from array import array
from functools import cache

import numpy as np
import pytest
from ros_cell import START, Cell, header, joint_messages, stamp_ns
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from calib_ros.apply.simulation import Camera, before_camera, drive, faulty, photograph
from calib_ros.apply.simulation import Cell as SimulatedCell
from calib_ros.files.bags import replay
from calib_ros.files.cameras import cameras_of
from calib_ros.files.recording import Recording
from calib_ros.files.tables import read_journal
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import dump_yaml, load_chain
from calib_ros.kinematics.lens import Lens
from calib_ros.sampling import pictures
from calib_ros.sampling.intake import Stream, feed, measured
from calib_ros.sampling.messages import CAMERA_INFO, JOINT_STATE, PICTURES
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.sources import parse_sources
from calib_ros.settings import Settings

cv2 = pytest.importorskip('cv2')
from photographs import CHARUCO, rendered

LENS = Lens(800.0, 810.0, 322.0, 243.0)
VIEW = Camera(LENS, 640, 480, depth=0.5)
STOPS, EACH = 20, 3
SPOILT = {3: 'blurred', 7: 'with too little of the board', 11: 'without the board'}
"""Stops whose images cannot be used."""


@pytest.fixture(scope='module')
def truth():
    rng = np.random.default_rng(4)
    arm = faulty(load_chain('ur10e'), SimulatedCell(), rng)
    return before_camera(arm, VIEW, CHARUCO.corners, True, rng)


@pytest.fixture(scope='module')
def shift(truth):
    """Return joint states, and an image (480, 640) with its stamps for each stop."""
    rng = np.random.default_rng(5)
    seen = photograph(truth, VIEW, CHARUCO.corners, True, STOPS, rng)
    configurations = seen.joints[:: len(CHARUCO.corners)]
    cell = SimulatedCell(joint_rate=50.0, move=0.4, dwell=0.6, poses_per_dwell=EACH)
    stamps, joints, image_stamps = drive(configurations, cell, START)
    poses = se3.invert(truth.forward(configurations))
    shots = []
    for k, pose in enumerate(poses):
        image = rendered(CHARUCO, pose, LENS, (640, 480), blur=6.0 if k == 3 else 0.7, finer=2)[0]
        if k == 7:
            image[:, :] = np.roll(image, 320, axis=1)
            image[:, :560] = 200
        if k == 11:
            image[:] = 200
        shots.append(image)
    recording = Recording(truth.joint_names, stamps, joints, seen, np.zeros(0, bool))
    return joint_messages(recording), shots, image_stamps.reshape(STOPS, EACH).tolist()


@cache
def packed(data):
    ok, found = cv2.imencode('.png', np.frombuffer(data, np.uint8).reshape(480, 640))
    assert ok
    return found.tobytes()


def messages(shift, kind, until=STOPS):
    """Return messages with their topics, by stamps."""
    joints, shots, stamps = shift
    info = CameraInfo(header=header(START, 'camera'), distortion_model='plumb_bob', d=[0.0] * 5)
    info.k = [LENS.fx, 0.0, LENS.cx, 0.0, LENS.fy, LENS.cy, 0.0, 0.0, 1.0]
    found = [('cam/camera_info', info), *(('joint_states', each) for each in joints)]
    for image, times in zip(shots[:until], stamps, strict=False):
        for stamp in times:
            head = header(stamp, 'camera')
            if kind is Image:
                message = Image(header=head, height=480, width=640, step=640, encoding='mono8')
                message.data = array('B', image.tobytes())  # bytes are checked one by one
            else:
                message = CompressedImage(header=head, format='png')
                message.data = array('B', packed(image.tobytes()))
            found.append((TOPICS[kind], message))
    return sorted(found, key=lambda each: stamp_ns(each[1]))


TOPICS = {Image: 'cam/image_raw', CompressedImage: 'cam/image_raw/compressed'}


@pytest.fixture(scope='module')
def board(tmp_path_factory):
    keys = ('type', 'columns', 'rows', 'square', 'marker', 'dictionary')
    path = tmp_path_factory.mktemp('board') / 'board.yaml'
    path.write_text(dump_yaml({key: getattr(CHARUCO, key) for key in keys}))
    return path


def sources(board, kind, more=''):
    return (f'{TOPICS[kind]} board={board} device=camera eye_in_hand=true{more}',)


def directly(come, given):
    session = CalibrationSession(load_chain('ur10e'), Settings(sources=given))
    session.pictures.cameras, session.pictures.patient = cameras_of(given), True
    streams = {each.topic: each for each in measured(parse_sources(given), {})}
    streams['joint_states'] = Stream('joint_states', JOINT_STATE)
    batch = [(streams[topic], message) for topic, message in come]
    assert feed(session, batch, lambda message, kind: message) == []
    return session


def for_bags(message, types):
    """Return a message of rclpy as one of rosbags: rclpy's bytes end in what no bag has."""
    package, kind = type(message).__module__.partition('.')[0], type(message).__name__
    values = []
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        if hasattr(value, 'get_fields_and_field_types'):
            value = for_bags(value, types)
        elif isinstance(value, array | np.ndarray):
            value = np.array(value, dtype=getattr(value, 'typecode', None))
        values.append(value)
    return types[f'{package}/msg/{kind}'](*values)


def bag_of(path, come):
    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = dict(zip((*TOPICS, CameraInfo), (*PICTURES, CAMERA_INFO), strict=True))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        known = {}
        for topic, message in come:
            if topic not in known:
                kind = kinds.get(type(message), JOINT_STATE)
                known[topic] = writer.add_connection(f'/{topic}', kind, typestore=store)
            made = for_bags(message, store.types)
            data = store.serialize_cdr(made, known[topic].msgtype)
            writer.write(known[topic], stamp_ns(message), data)


def assert_same(first, second):
    for name in ('stamps_ns', 'joints', 'pixels', 'points', 'approach', 'delay'):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def by_topic(come):
    found = {}
    for topic, message in come:
        found.setdefault(topic, []).append(message)
    return found


@pytest.mark.parametrize('kind', [Image, CompressedImage])
def test_direct_bag_and_live_give_equal_corners(tmp_path, shift, truth, board, kind):
    come, given = messages(shift, kind), sources(board, kind)
    expected = directly(come, given)
    wanted = expected.problem()
    rooted = tuple(f'/{each}' for each in given)
    replayed = CalibrationSession(load_chain('ur10e'), Settings(sources=rooted))
    bag_of(tmp_path / 'bag', come)
    assert replay(tmp_path / 'bag', replayed).warnings == ()
    assert_same(wanted.observations, replayed.problem().observations)
    with Cell(chain='ur10e', sources=list(given), data_dir=str(tmp_path)) as cell:
        played = by_topic(come)
        cell.publisher(CameraInfo, 'cam/camera_info').publish(played.pop('cam/camera_info')[0])
        camera = cell.node.session.pictures.cameras[TOPICS[kind]]
        cell.spin_until(lambda: not isinstance(camera._lens, pictures.Refusal))
        live = cell.node.session
        live.pictures.patient = True  # played faster than any arm moves
        cell.play(played)
        answer = cell.call('identify')
        assert_same(wanted.observations, live.problem().observations)
        assert live.account() == expected.account()
        assert answer.success, answer.message
        found = live.calibration.chain
    samples = live.samples
    assert len(samples) == STOPS - len(SPOILT)
    assert wanted.observations.on_flange
    dropped = live.account().dropped
    assert dropped == {f'poses: image {cause}': 1 for cause in SPOILT.values()}
    away = found.forward(wanted.observations.joints) - truth.forward(wanted.observations.joints)
    assert 1e3 * np.abs(away[:, :3, 3]).max() < 0.2
    (journal,) = (each for each in tmp_path.glob('*.csv'))
    kept, _ = read_journal(journal, 6)
    assert_same(wanted.observations, live.problem_of(kept).observations)
