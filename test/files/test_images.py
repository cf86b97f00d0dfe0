# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Boards in photographs: found, refused with the reason, printed, and identified from."""

import csv
import json
import os
import re
import struct
import zlib

import numpy as np
import pytest
from recorded import TYPES, header, serialised, write
from robots import DATA, needs_data

from calib_ros.cli.main import main
from calib_ros.decision.suspects import NOT_ON_FLANGE
from calib_ros.errors import CalibrationError, ConfigError, InputError
from calib_ros.files import boards, detections, image_places, lenses
from calib_ros.files.detector import Detector, detect
from calib_ros.files.images import decoded, read_image
from calib_ros.files.stored import LARGEST_IMAGE
from calib_ros.kinematics import se3
from calib_ros.kinematics.lens import Lens
from calib_ros.sampling.sample import Flaw

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
    turned = boards.Board('charuco', 7, 5, 0.036, 0.026, 'DICT_6X6_250')
    whole = Detector(CHARUCO)
    small_part = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    twice = np.hstack([small_part, small_part])
    cases = [
        (whole, twice, r'not fit .* off\): marker \d+ appears twice: show one such board only'),
        (whole, photograph(CHARUCO, blur=4.0)[0], r'blurred: its sharpest edges are \d+ px wide'),
        (whole, photograph(CHARUCO, shift=(0.27, 0.2))[0], 'of the 24 corners, fewer than 6'),
        (whole, image[:, ::-1].copy(), r'no marker of DICT_6X6_250, but \d+ mirrored'),
        (whole, np.full((480, 640), 90, np.uint8), 'no marker of DICT_6X6_250: is the board in'),
        (Detector(other), image, r'no marker of DICT_4X4_50, but \d+ of DICT_6X6'),
        (Detector(small), image, r'another board: marker ([4-9]|1\d), and this board has 0 to 3'),
        (Detector(wider), image, r'its corners do not fit the board \(\d+ px off\)'),
        (Detector(turned), image, r'its markers do not fit .*: are type, columns, rows'),
    ]
    for detector, picture, reason in cases:
        found = detector.of(picture)
        assert isinstance(found, Flaw), reason
        assert re.search(reason, found.reason), found


def turned_by_exif(image, orientation):
    """Return an image as JPEG whose EXIF says how to turn it."""
    data = cv2.imencode('.jpg', image)[1].tobytes()
    entry = struct.pack('>IHHHIHHI', 8, 1, 0x112, 3, 1, orientation, 0, 0)
    exif = b'Exif\0\0MM\0*' + entry
    marker = b'\xff\xe1' + struct.pack('>H', len(exif) + 2)
    return np.frombuffer(data[:2] + marker + exif + data[2:], np.uint8)


@pytest.mark.parametrize('orientation', [1, 3, 6, 8])
def test_an_image_is_as_the_sensor_sees_it(orientation):
    image = np.arange(60 * 80, dtype=np.uint16).reshape(60, 80) // 20
    image = image.astype(np.uint8)
    np.testing.assert_allclose(decoded(turned_by_exif(image, orientation)), image, atol=3)


def test_images_of_fractions_are_refused():
    """As whole numbers they would be black."""
    data = cv2.imencode('.tiff', np.full((60, 80), 0.5, np.float32))[1]
    assert decoded(data).reason == 'OpenCV cannot read this image'


def test_images_of_twelve_bits_are_as_bright_as_they_can_be():
    image, _ = photograph(CHARUCO)
    exact = Detector(CHARUCO).of(image)
    for size in (1, 16, 256):
        found = Detector(CHARUCO).of(decoded(cv2.imencode('.png', image.astype('u2') * size)[1]))
        np.testing.assert_array_equal(found[0], exact[0])
        np.testing.assert_allclose(found[1], exact[1], atol=0.01)


def test_images_of_another_size_than_most_are_refused():
    image, _ = photograph(CHARUCO)
    half = cv2.resize(image, (640, 480), interpolation=cv2.INTER_AREA)
    said = []
    found, unused = detect([('a', half), ('b', image), ('c', image)], CHARUCO, report=said.append)
    assert (found.names, found.size, unused) == (('b', 'c'), (1280, 960), 1)
    assert said[-1] == 'a: not used, it is of 640 x 480 px, and most are of 1280 x 960'
    np.testing.assert_array_equal(found.image, np.repeat([0, 1], 24))


def test_what_cannot_be_read_is_not_used(tmp_path):
    (tmp_path / 'folder.png').mkdir()
    os.mkfifo(tmp_path / 'pipe.png')  # which nobody will ever write to
    (tmp_path / 'gone.png').symlink_to(tmp_path / 'nowhere')
    with (tmp_path / 'huge.png').open('wb') as file:
        file.truncate(LARGEST_IMAGE + 1)
    huge = ('huge', 'it has more than')
    other = 'it is not a file'
    gone = ('gone', 'No such file')
    for name, reason in (huge, ('folder', other), ('pipe', other), gone):
        found = read_image(tmp_path / f'{name}.png')
        assert isinstance(found, Flaw)
        assert reason in found.reason
    found, unused = detect([('a', found), ('b', photograph(CHARUCO)[0])], CHARUCO)
    assert (found.names, unused) == (('b',), 1)


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


def test_what_images_cannot_use_is_told_before_any_work(tmp_path, capsys):
    (tmp_path / 'board.yaml').write_text(BOARD.replace('D\n', 'DICT_6X6_250\n'))
    folder = tmp_path / 'photographs'
    folder.mkdir()
    cv2.imwrite(str(folder / 'a.png'), photograph(CHARUCO)[0])
    for given, out, said in (
        (folder / 'a.png', 'x.csv', 'a.png is an image, but images takes a folder of images or'),
        (folder, 'none/x.csv', 'there is no folder'),
    ):
        assert main(['images', str(given), *corners_to(tmp_path, out)]) == 1
        told = capsys.readouterr()
        assert said in told.err
        assert 'corners' not in told.out
    (folder / 'b\udcff.png').write_bytes(b'')
    assert main(['images', str(folder), *corners_to(tmp_path, 'x.csv')]) == 1
    assert 'cannot stand in a table: rename it' in capsys.readouterr().err


BOARD = 'type: charuco\ncolumns: 5\nrows: 7\nsquare: 0.036\nmarker: 0.026\ndictionary: D\n'


@pytest.mark.parametrize(
    ('old', 'new', 'said'),
    [
        ('columns: 5', 'columns: 5.5', 'columns must be a whole number'),
        ('columns: 5', 'columns: 1', 'must have 2 to 1000 columns and rows, not 1'),
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
        ('image,corner,u,v\na,0,1,2\na,0,1,2\n', 'line 3: corner 0 of image a already exists'),
        ('image,corner,u,v\na,0,x,2\n', 'line 2: u'),
        ('image,corner,u,v\n', 'has no rows'),
    ],
)
def test_detections_that_are_none_are_refused(tmp_path, text, said):
    path = tmp_path / 'detections.csv'
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        detections.read_detections(path, CHARUCO)


def test_joints_that_the_arm_does_not_have_are_told(tmp_path):
    path = tmp_path / 'places.csv'
    path.write_text('image,q1,q2,q3\na.png,0.1,0.2,0.3\n')
    for joints, said in (
        (3, ()),
        (2, (f'{path}: the column q3 is left out: the arm has 2 joints',)),
    ):
        places, posed, told = image_places.read_places(path, joints)
        assert (len(places['a.png']), posed, told) == (joints, False, said)


def test_intrinsics_as_camera_calibration_writes_them(tmp_path):
    path = tmp_path / 'camera.yaml'
    path.write_text(INTRINSICS)
    assert lenses.read_lens(path) == Lens(1352.02747, 1356.14287, 789.67065, 627.2995)


def test_intrinsics_of_other_images_are_refused(tmp_path):
    path, table = tmp_path / 'camera.yaml', tmp_path / 'corners.csv'
    for size, beyond, said in (
        (',1600,1200', '1599.4', None),
        ('', '1599.4', None),
        (',3200,2400', '10', 'of 1600 x 1200 px, the corners of images of 3200 x 2400'),
        (',800,600', '10', 'of 1600 x 1200 px, the corners of images of 800 x 600'),
        ('', '1600.2', r'of 1600 x 1200 px, the corners reach 1600.2, 20'),
        (',1600,1200', '1600.2', r'reach 1600.2, 20.0 \(is u to the right, v down\?\)'),
    ):
        path.write_text(INTRINSICS.replace('image_', '' if size else 'image_'))  # plain keys too
        sized = ',width,height' if size else ''
        table.write_text(f'image,corner,u,v{sized}\na,0,{beyond},20{size}\na,1,5,5{size}\n')
        found = detections.read_detections(table, CHARUCO)
        if said is None:
            assert lenses.read_lens(path, found).fx == 1352.02747
            continue
        with pytest.raises(InputError, match=said):
            lenses.read_lens(path, found)
    table.write_text('image,corner,u,v,width,height\na,0,1,2,800,600\nb,0,1,2,640,480\n')
    with pytest.raises(InputError, match='images of 640 x 480 and 800 x 600 px'):
        detections.read_detections(table, CHARUCO)


def test_intrinsics_as_others_write_them(tmp_path):
    path = tmp_path / 'camera.yaml'
    matrix = '   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1350., 0., 795., 0., 1355., 605.,\n'
    matrix = f'%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n{matrix}       0., 0., 1. ]\n'
    nested = 'camera_matrix: [[1350, 0, 795], [0, 1355, 605], [0, 0, 1]]\n'
    for text in (matrix, nested):
        path.write_text(f'{text}distortion_coefficients: [[-0.1, 0.2, 0, 0, 0]]\n')
        lens = lenses.read_lens(path)
        assert (lens.fx, lens.cy, lens.k1, lens.k2) == (1350.0, 605.0, -0.1, 0.2)


def test_the_virtual_arm_is_where_the_flange_is(rng):
    rotations = se3.exp_rotation(rng.normal(size=(50, 3)))
    positions = rng.normal(size=(50, 3))
    found = image_places.posed_arm().forward(image_places.joints_of_poses(positions, rotations))
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
def test_the_real_photographs(photographs, capsys, lens, least, limit, single):
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
    if lens == 'given':
        assert main([*words, '--places', str(REAL / 'poses.csv'), '--eye-in-hand']) == 3
        assert NOT_ON_FLANGE[0] in json.loads(capsys.readouterr().out)['refusals'][0]


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


MATRIX = 'k: [800, 0, 320, 0, 800, 240, 0, 0, 1]'


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        (f'[{MATRIX}]', 'must be a mapping'),
        ('k: [800, 0, 320, 0, 800, 240, 0, 0]', 'must hold 9 numbers, not 8'),
        ('k: 800', 'camera_matrix must be numbers'),
        ('fx: 800\nfy: 800', r'camera_matrix must be numbers: \[fx, 0, cx, 0, fy, cy, 0, 0, 1\]'),
        (f'{MATRIX}\nd: 0', r'distortion_coefficients must be numbers: \[k1, k2, p1, p2, k3\]'),
        (f'{MATRIX}\nd: [0, 0, 0, 0, 0, 1e-3]', 'beyond k3 is not supported'),
        (f'{MATRIX}\nRadialDistortion: [0]', '"RadialDistortion": call it distortion_coef'),
        (f'{MATRIX}\nk1: 0.1', '"k1": call it distortion_coefficients'),
        (f'{MATRIX}\ndistortion_model: equidistant', 'as plumb_bob'),
        ('k: [800, 0, 0, 0, 800, 0, 320, 240, 1]', 'camera_matrix must be'),
        ('k: [800, 0, 320, 0, 800, 240, 0, 0, 2]', 'camera_matrix must be'),
    ],
)
def test_intrinsics_that_are_none_are_refused(tmp_path, text, said):
    path = tmp_path / 'camera.yaml'
    path.write_text(f'{MATRIX}\nworking_distance: 0.4')
    assert lenses.read_lens(path) == Lens(800.0, 800.0, 320.0, 240.0)
    path.write_text(text)
    with pytest.raises(ConfigError, match=said):
        lenses.read_lens(path)
    if 'supported' in said or 'plumb_bob' in said:  # only as the start of a fit
        assert lenses.read_lens(path, fitted=True) == Lens(800.0, 800.0, 320.0, 240.0)


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('image,q1,q2\na,1,2\nb,1,2\nb,3,4\n', 'line 3: image b appears twice'),
        ('image,q1\na,1\n', 'has no column q2: give q1 ... q2, or x y z'),
        ('image,x,y\na,1,2\n', 'has no column z, qx, qy, qz, qw'),
        ('image,q1,q2\nb,1,2\n', "no image has joint values: .*'a' and 'b' do not"),
    ],
)
def test_places_of_images_that_are_none_are_refused(tmp_path, text, said):
    (tmp_path / 'places.csv').write_text(text)
    (tmp_path / 'corners.csv').write_text('image,corner,u,v\na,0,1,2\n')
    found = detections.read_detections(tmp_path / 'corners.csv', CHARUCO)
    with pytest.raises(InputError, match=said):
        detections.observed(
            found, CHARUCO, image_places.read_places(tmp_path / 'places.csv', 2)[0], False
        )
