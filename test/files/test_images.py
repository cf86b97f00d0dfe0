# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Boards in photographs: found, refused with the reason, printed, and identified from."""

import csv
import json
import re
import zlib

import numpy as np
import pytest
from recorded import TYPES, header, serialised, write
from robots import DATA, needs_data

from calib_ros.cli.main import main
from calib_ros.errors import CalibrationError, ConfigError, InputError
from calib_ros.files import boards
from calib_ros.files.detector import Detector
from calib_ros.kinematics import se3
from calib_ros.kinematics.lens import Lens
from calib_ros.sampling.pictures import Refusal

cv2 = pytest.importorskip('cv2')
from photographs import CHARUCO, rendered

REAL = DATA / 'charuco_wrist_camera_fixed'
MARKERS = boards.Board('markers', 4, 5, 0.04, 0.03, 'DICT_APRILTAG_36h11')
LENS = Lens(1300.0, 1300.0, 640.0, 480.0)


def photograph(board, turn=(0.2, 0.3, 0.1), depth=0.5, blur=0.7, shift=(0.0, 0.0)):
    """Return an image of a board, and where its corners are in it [px]."""
    rotation = se3.exp_rotation(np.array(turn))
    middle = np.array([*shift, depth]) - rotation @ board.corners.mean(axis=0)
    return rendered(board, se3.transform(rotation, middle), LENS, (1280, 960), blur)


@pytest.mark.parametrize(
    ('board', 'depth', 'limit'), [(CHARUCO, 0.5, 0.05), (CHARUCO, 1.5, 0.08), (MARKERS, 0.5, 0.4)]
)
def test_corners_are_where_they_are(board, depth, limit):
    image, exact = photograph(board, depth=depth)
    number, pixels = Detector(board).of(image)
    assert number.tolist() == list(range(len(board.corners)))
    away = pixels - exact[number]
    assert np.abs(away.mean(axis=0)).max() < 0.05  # no half pixel
    assert np.sqrt((away**2).sum(axis=1).mean()) < limit


def test_images_are_refused_with_the_reason():
    image, _ = photograph(CHARUCO)
    other = boards.Board('charuco', 5, 7, 0.036, 0.026, 'DICT_4X4_50')
    small = boards.Board('charuco', 3, 3, 0.036, 0.026, 'DICT_6X6_250')
    wider = boards.Board('markers', 3, 6, 0.036, 0.026, 'DICT_6X6_250')
    whole = Detector(CHARUCO)
    cases = [
        (whole, photograph(CHARUCO, blur=4.0)[0], r'blurred: its sharpest edges are \d+ px wide'),
        (whole, photograph(CHARUCO, shift=(0.27, 0.2))[0], 'of the 24 corners, fewer than 6'),
        (whole, np.full((480, 640), 90, np.uint8), 'no marker of DICT_6X6_250: is the board in'),
        (whole, np.zeros((0, 0), np.uint8), 'no image that OpenCV can read'),
        (Detector(other), image, r'no marker of DICT_4X4_50, but \d+ of DICT_6X6'),
        (Detector(small), image, 'another board: marker'),
        (Detector(wider), image, r'do not fit the board \(\d+ px off\)'),
    ]
    for detector, picture, reason in cases:
        found = detector.of(picture)
        assert isinstance(found, Refusal), reason
        assert re.search(reason, found.reason), found


def test_what_opencv_does_not_know_is_refused():
    with pytest.raises(ConfigError, match='unknown dictionary "DICT_6X6_25"'):
        Detector(boards.Board('charuco', 5, 7, 0.03, 0.02, 'DICT_6X6_25'))
    with pytest.raises(ConfigError, match='DICT_4X4_50 has 50 markers, the board needs 60'):
        Detector(boards.Board('markers', 6, 10, 0.03, 0.02, 'DICT_4X4_50'))


def test_a_board_is_printed_in_its_true_size(tmp_path, capsys):
    out = tmp_path / 'board.pdf'
    words = 'board charuco --columns 5 --rows 7 --square 0.036 --marker 0.026 --dictionary'
    assert main([*words.split(), 'DICT_6X6_250', '--out', str(out)]) == 0
    assert '180.00 x 252.00 mm' in capsys.readouterr().out
    assert boards.read_board(out.with_suffix('.yaml')) == CHARUCO
    content = out.read_bytes()
    box = re.search(rb'/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]', content)
    points = [72.0 / 25.4 * side for side in (180.0 + 20.0, 252.0 + 20.0)]
    assert [float(side) for side in box.groups()] == pytest.approx(points, abs=0.01)
    streams = re.findall(rb'stream\r?\n(.*?)endstream', content, re.DOTALL)
    drawing = max((zlib.decompress(each) for each in streams if each[:1] == b'x'), key=len)
    assert drawing.count(b'\nh\n') + drawing.count(b' h\n') > 100  # squares and runs of cells
    assert main([*words.split(), 'DICT_6X6_250', '--out', str(out)]) == 1
    assert 'exists already' in capsys.readouterr().err


BOARD = 'type: charuco\ncolumns: 5\nrows: 7\nsquare: 0.036\nmarker: 0.026\ndictionary: D\n'


@pytest.mark.parametrize(
    ('old', 'new', 'said'),
    [
        ('columns: 5', 'columns: 5.0', 'columns must be a whole number'),
        ('columns: 5', 'columns: 1', 'columns of a board must be from 2 to 1000, not 1'),
        ('marker: 0.026', 'marker: 0.036', 'needs 0 < marker < square'),
        ('square: 0.036', 'square: 36', 'in metres, not 0.026 and 36'),
        ('rows: 7\n', '', 'key "rows" is missing'),
        ('charuco', 'chess', 'unknown type of board "chess"'),
        ('rows', 'lines', 'unknown key'),
    ],
)
def test_boards_that_are_none_are_refused(tmp_path, old, new, said):
    path = tmp_path / 'board.yaml'
    path.write_text(BOARD.replace(old, new))
    with pytest.raises(CalibrationError, match=said):
        boards.read_board(path)


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('image,corner,u\na,0,1\n', 'no column v;'),
        ('image,corner,u,v\na,24,1,2\n', 'line 2: corner must be from 0 to 23 on this board'),
        ('image,corner,u,v\na,0,1,2\na,0,1,2\n', 'line 3: corner 0 of image a is there already'),
        ('image,corner,u,v\na,0,x,2\n', 'line 2: u'),
        ('image,corner,u,v\n', 'has no rows'),
    ],
)
def test_detections_that_are_none_are_refused(tmp_path, text, said):
    path = tmp_path / 'detections.csv'
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        boards.read_detections(path, CHARUCO)


def test_intrinsics_as_camera_calibration_writes_them(tmp_path):
    path = tmp_path / 'camera.yaml'
    path.write_text(INTRINSICS)
    lens = boards.read_lens(path)
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (1352.02747, 1356.14287, 789.67065, 627.2995)
    assert (lens.k1, lens.p2, lens.fixed) == (0.0, 0.0, True)
    path.write_text(INTRINSICS.replace('plumb_bob', 'equidistant'))
    with pytest.raises(ConfigError, match='must be plumb_bob'):
        boards.read_lens(path)
    for matrix in ([800, 0, 0, 0, 800, 0, 320, 240, 1], [800, 0, 320, 0, 800, 240, 0, 0, 2]):
        with pytest.raises(ConfigError, match='camera_matrix must be'):
            boards.lens_of('plumb_bob', matrix, [], 'camera')


def test_the_virtual_arm_is_where_the_flange_is(rng):
    rotations = se3.exp_rotation(rng.normal(size=(50, 3)))
    positions = rng.normal(size=(50, 3))
    found = boards.posed_arm().forward(boards.joints_of_poses(positions, rotations))
    np.testing.assert_allclose(found, se3.transform(rotations, positions), atol=1e-12)


INTRINSICS = """\
image_width: 1600
image_height: 1200
camera_matrix: {rows: 3, cols: 3, data: [1352.02747, 0.0, 789.67065, 0.0, 1356.14287, 627.2995,
  0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.0, 0.0, 0.0, 0.0, 0.0]}
"""
REAL_BOARD = BOARD.replace('0.036', '0.036195').replace('0.026', '0.018256')


@pytest.fixture(scope='module')
def photographs(tmp_path_factory):
    """Return a folder with board, intrinsics and the corners of the real photographs."""
    folder = tmp_path_factory.mktemp('charuco')
    (folder / 'board.yaml').write_text(REAL_BOARD.replace('D\n', 'DICT_6X6_250\n'))
    (folder / 'camera.yaml').write_text(INTRINSICS)
    assert main(['images', str(REAL / 'images'), *corners_to(folder, 'corners.csv')]) == 0
    return folder


def corners_to(folder, name):
    return ['--board', str(folder / 'board.yaml'), '--out', str(folder / name)]


@needs_data
@pytest.mark.parametrize(('lens', 'least', 'limit'), [('given', 2.4, 2.66), ('fitted', 0.5, 1.10)])
def test_the_real_photographs(photographs, capsys, lens, least, limit):
    words = ['identify', '--chain', 'flange_pose', '--json', '--lens', lens]
    for name, file in (('detections', 'corners.csv'), ('board', 'board.yaml')):
        words += [f'--{name}', str(photographs / file)]
    words += ['--intrinsics', str(photographs / 'camera.yaml')]
    assert main([*words, '--places', str(REAL / 'poses.csv')]) == 3  # nothing of an arm
    document = json.loads(capsys.readouterr().out)
    fitted = document['fitted']['after']
    assert fitted['count'] >= 330
    assert least < fitted['rms_px'] <= limit
    assert document['rank'] == (12 if lens == 'given' else 21)
    assert document['parameters']['base.fx']['unit'] == 'px'
    assert document['parameters']['base.fx']['status'] == (
        'fixed' if lens == 'given' else 'fitted'
    )


@needs_data
def test_a_bag_of_the_real_photographs(photographs, capsys):
    bag, kinds = photographs / 'bag', ('Image', 'CompressedImage')
    files = sorted((REAL / 'images').iterdir(), key=lambda path: (len(path.name), path.name))
    content = []
    for k, path in enumerate(files[:4]):
        head = header((k + 1) * 10**9, 'camera')
        data = np.frombuffer(path.read_bytes(), np.uint8)
        image = cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), cv2.COLOR_GRAY2BGR)
        whole = (*image.shape[:2], 'bgr8', 0, 4800, image.ravel())
        for kind, values in zip(kinds, (whole, ('png', data)), strict=True):
            message = TYPES[f'sensor_msgs/msg/{kind}'](head, *values)
            content.append((f'/{kind}', k, serialised(message)))
    write(bag, {f'/{kind}': f'sensor_msgs/msg/{kind}' for kind in kinds}, content)
    assert main(['images', str(bag), *corners_to(photographs, 'none.csv')]) == 1
    assert 'several topics of images, choose one with --topic' in capsys.readouterr().err
    with (photographs / 'corners.csv').open() as file:
        names = [path.name for path in files[:4]]
        wanted = [row for row in csv.DictReader(file) if row['image'] in names]
    for kind in kinds:
        words = ['images', str(bag), '--topic', f'/{kind}']
        assert main([*words, *corners_to(photographs, f'{kind}.csv')]) == 0
        with (photographs / f'{kind}.csv').open() as file:
            found = list(csv.DictReader(file))
        assert [row['u'] for row in found] == [row['u'] for row in wanted]
        assert found[0]['image'] == '1000000000'
