# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A camera on the flange before a printed board, live: from images to a calibration."""

import sys
import threading
from array import array
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from recorded import TYPES, serialised, write
from ros_cell import LATCHED, PATIENCE, START, Cell, header, joint_messages, stamp_ns
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, RegionOfInterest

from calib_ros.apply.camera import Camera, before_camera, photograph
from calib_ros.apply.simulation import Cell as SimulatedCell, drive, faulty
from calib_ros.errors import CalibrationError, ConfigError
from calib_ros.files.bags import replay
from calib_ros.files.cameras import cameras_of, lens_in
from calib_ros.files.journal import read_journal
from calib_ros.files.recording import Recording
from calib_ros.files.tables import read_table
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.lens import Lens
from calib_ros.ros.inputs import deserialised
from calib_ros.sampling import pictures
from calib_ros.sampling.batches import feed
from calib_ros.sampling.messages import CAMERA_INFO, JOINT_STATE, PICTURES
from calib_ros.sampling.sample import Flaw
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.source_texts import parse_sources
from calib_ros.sampling.streams import Stream, source_streams
from calib_ros.settings import Settings
from calib_ros.texts import dump_yaml

cv2 = pytest.importorskip('cv2')
from photographs import CHARUCO, rendered

LENS = Lens(800.0, 810.0, 322.0, 243.0)
VIEW = Camera(LENS, 640, 480, depth=0.5)
STOPS, EACH = 24, 2
SPOILT = {3: 'blurred', 7: 'with too little of the board'}
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
    cell = SimulatedCell(joint_rate=25.0, move=0.4, dwell=0.6, poses_per_dwell=EACH)
    stamps, joints, image_stamps = drive(configurations, cell, START)
    poses = se3.invert(truth.forward(configurations))
    shots = []
    for k, pose in enumerate(poses):
        image = rendered(CHARUCO, pose, LENS, (640, 480), blur=6.0 if k == 3 else 0.7, finer=2)[0]
        if k == 7:
            image[:, :] = np.roll(image, 320, axis=1)
            image[:, :560] = 200
        shots.append(image)
    recording = Recording(truth.joint_names, stamps, joints, seen, np.zeros(0, bool))
    return joint_messages(recording), shots, image_stamps.reshape(STOPS, EACH).tolist()


@cache
def packed(data):
    _, found = cv2.imencode('.png', np.frombuffer(data, np.uint8).reshape(480, 640))
    return found.tobytes()


def messages(shift, kind, until=STOPS):
    """Return messages with their topics, by stamps."""
    joints, shots, stamps = shift
    info = CameraInfo(header=header(START, 'camera'), distortion_model='plumb_bob', d=[0.0] * 5)
    info.k = [LENS.fx, 0.0, LENS.cx, 0.0, LENS.fy, LENS.cy, 0.0, 0.0, 1.0]
    end = stamps[until - 1][-1] + 600_000_000
    some = (('joint_states', each) for each in joints if stamp_ns(each) < end)
    found = [('cam/camera_info', info), *some]
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


IMAGE_FIELDS = ('height', 'width', 'step', 'encoding', 'data')
TOPICS = {Image: 'cam/image_raw', CompressedImage: 'cam/image_raw/compressed'}


@pytest.fixture(scope='module')
def board(tmp_path_factory):
    keys = ('type', 'columns', 'rows', 'square', 'marker', 'dictionary')
    path = tmp_path_factory.mktemp('board') / 'board.yaml'
    path.write_text(dump_yaml({key: getattr(CHARUCO, key) for key in keys}))
    return path


def sources(board, kind, more=''):
    return (f'{TOPICS[kind]} board={board} device=camera eye_in_hand=true{more}',)


def rooted(given):
    return tuple(f'/{each}' for each in given)


def streams_of(given):
    streams = {each.topic: each for each in source_streams(parse_sources(given), {})}
    return {**streams, 'joint_states': Stream('joint_states', JOINT_STATE)}


def directly(come, given):
    session = CalibrationSession(load_chain('ur10e'), Settings(sources=given))
    session.pictures.cameras, session.pictures.patient = cameras_of(given), True
    streams = streams_of(given)
    batch = [(streams[topic], serialize_message(message)) for topic, message in come]
    assert feed(session, batch, deserialised) == []
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
    kinds = dict(zip((*TOPICS, CameraInfo), (*PICTURES, CAMERA_INFO), strict=True))
    types = {f'/{topic}': kinds.get(type(message), JOINT_STATE) for topic, message in come}
    write(path, types, ((f'/{t}', stamp_ns(m), serialised(for_bags(m, TYPES))) for t, m in come))


def assert_same(first, second):
    for name in ('stamps_ns', 'joints', 'pixels', 'points', 'approach', 'delay'):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_direct_bag_and_live_give_equal_corners(tmp_path, shift, truth, board):
    come, given = messages(shift, Image), sources(board, Image)
    expected = directly(come, given)
    wanted = expected.problem().observations
    replayed = CalibrationSession(load_chain('ur10e'), Settings(sources=rooted(given)))
    bag_of(tmp_path / 'bag', come)
    assert replay(tmp_path / 'bag', replayed).warnings == ()
    assert_same(wanted, replayed.problem().observations)
    with Cell(chain='ur10e', sources=list(given), data_dir=str(tmp_path)) as cell:
        played = {each: [m for topic, m in come if topic == each] for each, _ in come}
        live = cell.node.session
        live.pictures.patient = True  # played faster than any arm moves
        info = cell.publisher(CameraInfo, 'cam/camera_info')
        info.publish(played.pop('cam/camera_info')[0])
        camera = live.pictures.cameras[TOPICS[Image]]
        cell.spin_until(lambda: bool(camera._told))
        cell.play(played)
        answer = cell.call('identify')
        assert_same(wanted, live.problem().observations)
        assert live.account().dropped == expected.account().dropped
        assert live.account().unused == expected.account().unused
        assert answer.success, cell.in_full(answer)
        found = live.calibration.chain
    assert wanted.on_flange
    assert len(live.samples) == STOPS - len(SPOILT)
    dropped = {f'measurements: image {cause}': 1 for cause in SPOILT.values()}
    assert live.account().dropped == dropped
    away = found.forward(wanted.joints) - truth.forward(wanted.joints)
    assert 1e3 * np.abs(away[:, :3, 3]).max() < 0.2
    (journal,) = tmp_path.glob('*.csv')
    kept, _ = read_journal(journal, 6)
    assert_same(wanted, live.problem_of(kept).observations)
    (fitted,) = read_table(journal, 6).fitted
    assert_same(wanted, fitted)


def test_a_latched_camera_info_of_before_the_start_is_heard(tmp_path, shift, board):
    topic, info = messages(shift, Image, 0)[0]
    with Cell() as cell:
        for qos in (LATCHED, 10):  # the first subscription hears the second one
            cell.peer.create_publisher(CameraInfo, topic, qos).publish(info)
        node = cell.start(chain='ur10e', sources=[*sources(board, Image)], data_dir=str(tmp_path))
        camera = node.session.pictures.cameras[TOPICS[Image]]
        cell.spin_until(lambda: camera._told and camera._told[0].lens.fx == LENS.fx)
        assert f'/{topic}' not in {served.topic_name for served in node.subscriptions}
        assert not node._inputs._unheard()


def test_compressed_images_of_a_bag_and_of_messages(tmp_path, shift, board):
    raw = directly(messages(shift, Image, 8), sources(board, Image)).problem().observations
    come, given = messages(shift, CompressedImage, 8), sources(board, CompressedImage)
    assert_same(raw, directly(come, given).problem().observations)
    replayed = CalibrationSession(load_chain('ur10e'), Settings(sources=rooted(given)))
    bag_of(tmp_path / 'bag', come)
    replay(tmp_path / 'bag', replayed)
    assert_same(raw, replayed.problem().observations)


@pytest.mark.parametrize('until', [5, STOPS])
def test_a_lens_that_changed_is_refused_though_it_changed_back(shift, board, until):
    """A bag is read ahead of its images, so that all had the lens of its end."""
    come, given = messages(shift, Image, 8), sources(board, Image)
    info = next(message for _, message in come if isinstance(message, CameraInfo))
    for k, focal in ((4, 1.01 * LENS.fx), (until, LENS.fx)):
        other = CameraInfo(distortion_model='plumb_bob', d=info.d, k=info.k.copy())
        other.header, other.k[0] = header(shift[2][k - 1][-1] + 1, 'camera'), focal
        come.append(('cam/camera_info', other))
    session = directly(sorted(come, key=lambda each: stamp_ns(each[1])), given)
    session.finish()
    with pytest.raises(CalibrationError, match='the CameraInfo of camera has changed'):
        session.problem()
    assert 'the CameraInfo of camera has changed' in session.status()
    assert session.doubtful
    for _ in session.samples[3:]:
        session.remove_last()
    assert 'CameraInfo' not in session.status()


def test_why_stops_have_no_image_is_told_however_many_images_come(shift, board):
    come = messages(shift, Image, 4)
    joints = [each for each in come if each[0] == 'joint_states']
    images = [(topic, m) for topic, m in come if isinstance(m, Image)]
    for topic, message in images[::EACH]:
        for k in range(1, 20):
            more = Image(**{name: getattr(message, name) for name in IMAGE_FIELDS})
            more.header = header(stamp_ns(message) + k * 1_000_000, 'camera')
            joints.append((topic, more))
    session = directly(sorted(joints, key=lambda each: stamp_ns(each[1])), sources(board, Image))
    session.finish()
    assert session.received['measurements'] > 10 * 4
    assert 'at 4 of 4 stops the images are not used' in session.summary
    assert 'no CameraInfo up to its stamp has come on cam/camera_info' in session.summary


@pytest.mark.parametrize('together', [False, True])
def test_images_before_the_first_camera_info_are_not_used(shift, board, together):
    """However many messages are read at once: live it would not have come yet."""
    come, given = messages(shift, Image, 5), sources(board, Image)
    info = next(message for _, message in come if isinstance(message, CameraInfo))
    late = CameraInfo(distortion_model='plumb_bob', d=info.d, k=info.k)
    late.header = header(shift[2][2][0], 'camera')
    come = [each for each in come if each[1] is not info] + [('cam/camera_info', late)]
    come.sort(key=lambda each: stamp_ns(each[1]))
    session = directly(come if together else [], given)
    for topic, message in () if together else come:
        batch = [(streams_of(given)[topic], serialize_message(message))]
        assert feed(session, batch, deserialised) == []
    session.finish()
    assert session.account().samples == 2  # one of the others is blurred
    assert session.account().dropped['measurements: image before any CameraInfo'] == 2


class Slow:
    """A camera that looks until it may go on."""

    def __init__(self):
        self.go_on = threading.Event()

    def look(self, message):
        assert self.go_on.wait(PATIENCE)
        return Flaw('blurred', 'it is blurred')


def test_images_that_come_while_others_are_looked_at_are_counted_and_hold_up_nothing(shift, board):
    given = sources(board, Image)
    session = CalibrationSession(load_chain('ur10e'), Settings(sources=given))
    camera = Slow()
    session.pictures.cameras = {TOPICS[Image]: camera}
    come = [each for each in messages(shift, Image) if not isinstance(each[1], CameraInfo)]
    streams = streams_of(given)
    batch = [(streams[topic], serialize_message(message)) for topic, message in come]
    assert feed(session, batch, deserialised) == []
    assert session.account().joint_states == len(shift[0])  # none has waited
    threading.Timer(0.2, camera.go_on.set).start()
    session.finish()  # waits for them
    dropped = session.account().dropped
    assert dropped['measurements: image while others were processed'] > STOPS // 2
    assert dropped['measurements: image blurred'] >= pictures.MOST_WAITING
    last = '4 others were still processed: stop for longer'
    assert f'the last image is not used: {last}' in session.status()
    assert f'images are not used, the last: {last}' in session.summary


def test_memory_for_what_camera_infos_said_is_bounded(board):
    """Autofocus changes the lens with every image."""
    (camera,) = cameras_of(sources(board, Image)).values()
    for k in range(1, 2500):
        info = CameraInfo(header=header(k, 'camera'))
        info.k = [float(k), 0.0, 320.0, 0.0, 800.0, 240.0, 0.0, 0.0, 1.0]
        camera.learn(info)
    assert len(camera._told) <= 1000
    assert camera._told[-1].stamp_ns == k


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        ({'k': [0.0] * 9}, 'not calibrated'),
        ({'binning_x': 2}, 'without roi and binning'),
        ({'binning_y': 2}, 'without roi and binning'),
        ({'roi': RegionOfInterest(y_offset=8)}, 'without roi and binning'),
        ({'distortion_model': 'equidistant'}, 'as plumb_bob'),
        ({'d': [0.0] * 5 + [0.1] * 3}, 'beyond k3 is not supported'),
    ],
)
def test_a_camera_info_that_cannot_be_used(change, said):
    info = CameraInfo(distortion_model='plumb_bob', d=[0.1, 0.2, 0.3, 0.4, 0.5])
    info.k = [800.0, 0.0, 322.0, 0.0, 810.0, 243.0, 0.0, 0.0, 1.0]
    lens = lens_in(info)
    assert (lens.fx, lens.cy, lens.k1, lens.k3) == (800.0, 243.0, 0.1, 0.5)
    for name, value in change.items():
        setattr(info, name, value)
    with pytest.raises(ConfigError, match=said):
        lens_in(info)
    if {'distortion_model', 'd'} & {*change}:  # only as the start of a fit
        assert lens_in(info, fitted=True) == Lens(800.0, 810.0, 322.0, 243.0)


def test_an_image_that_does_not_fit_its_camera_info_is_refused(shift, board):
    (camera,) = cameras_of(sources(board, Image)).values()
    come = messages(shift, Image, 1)
    info, image = (next(e for _, e in come if isinstance(e, k)) for k in (CameraInfo, Image))
    assert camera.look(image).reason == 'no CameraInfo up to its stamp has come on cam/camera_info'
    camera.learn(CameraInfo())
    assert 'not calibrated' in camera.look(image).reason
    camera.learn(info)
    assert not isinstance(camera.look(image), Flaw)
    info.width, info.height = 640, 480
    camera.learn(info)
    assert not isinstance(camera.look(image), Flaw)
    info.width, info.height = 1280, 960
    camera.learn(info)
    assert camera.look(image).reason.startswith('it and its CameraInfo are of 640 x 480 and 1280')
    given = {each: getattr(image, each) for each in ('header', *IMAGE_FIELDS)}
    for change, said in (
        ({'encoding': 'yuv422'}, 'unknown encoding of images "yuv422"'),
        ({'data': image.data[:-1]}, 'an image of 640 x 480 px holds 307199 bytes only'),
        ({'step': 639}, 'an image of 640 x 480 px'),
    ):
        assert said in camera.look(SimpleNamespace(**given | change)).reason


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('cam/image_raw type=Image', 'needs board=FILE'),
        ('cam/pose type=PoseStamped board=x.yaml', 'needs board=FILE'),
        ('cam/image_raw board=x.yaml lens=thick', 'unknown lens'),
        ('cam/image_raw board=/nowhere.yaml', 'nowhere.yaml'),
        ('cam/image_rect board=BOARD', 'is rectified: give what'),
        ('cam/image_rect_color/compressed board=BOARD', 'is rectified: give what'),
    ],
)
def test_a_source_of_images_that_cannot_be(board, text, said):
    with pytest.raises(CalibrationError, match=said):
        cameras_of([text.replace('BOARD', str(board))])


def test_two_cameras_are_two_devices(board):
    given = [f'{side}/image_raw board={board}' for side in ('left', 'right')]
    with pytest.raises(ConfigError, match='"left/image_raw" needs a device=NAME'):
        cameras_of(given)
    assert len(cameras_of([f'{each} device=camera_{k}' for k, each in enumerate(given)])) == 2


def test_what_images_need_is_told(monkeypatch, board):
    with pytest.raises(ConfigError, match='mode must not be continuous'):
        CalibrationSession(
            load_chain('ur10e'), Settings(mode='continuous', sources=sources(board, Image))
        )
    monkeypatch.setitem(sys.modules, 'cv2', None)
    with pytest.raises(ConfigError, match='boards need OpenCV: apt install'):
        cameras_of(sources(board, Image))
