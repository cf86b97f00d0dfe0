# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of stops: how many are kept, and that their colours do not matter."""

import threading

import numpy as np
import pytest

from calib_ros.files.images import grey
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.lens import Lens
from calib_ros.sampling import pictures
from calib_ros.sampling.sample import Flaw, Sample, View
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.slices import Part
from calib_ros.sampling.source_texts import parse_sources

pytest.importorskip('cv2')


class Blind:
    """A detector that never sees a board, once it is let go."""

    def __init__(self):
        self.release = threading.Event()

    def look(self, message):
        assert self.release.wait(60)
        return Flaw('without board', 'no board in it')


def test_why_an_image_is_not_looked_at_is_told():
    """~/capture told why the image before was not used, or nothing at all."""
    kept, camera = pictures.Pictures(lambda: 0.3), Blind()
    kept.cameras = {'image': camera}

    def sample(number):
        return Sample(number, np.zeros(2), images=(number,))

    assert kept.through([sample(99)], wait=True) == []  # an image that is no more
    assert 'the memory for images was full' in kept.refused == kept.reason
    waiting = [sample(kept.keep('image', 1, lambda: None)) for _ in range(5)]
    assert kept.through(waiting, wait=False) == []
    camera.release.set()
    assert kept.through([], wait=True) == []
    assert kept.refused == '4 others were still processed: stop for longer'
    assert kept.through([sample(kept.keep('image', 1, lambda: None))], wait=True) == []
    assert kept.refused == 'no board in it'
    assert kept.dropped == {
        'measurements: image dropped, memory for images full': 1,
        'measurements: image while others were processed': 1,
        'measurements: image without board': 5,
    }


LENS = Lens(1000.0, 1000.0, 320.0, 240.0)
BOARD = np.array([[0.03 * column, 0.03 * row, 0.0] for row in range(3) for column in range(4)])


class Seeing:
    """A detector that sees some corners of a board, or takes no image at all."""

    def __init__(self, count):
        place = BOARD @ se3.exp_rotation(np.array([0.3, -0.2, 0.1])).T + [0.02, -0.03, 0.5]
        pixels = place[:, :2] / place[:, 2:] * 1000.0 + [320.0, 240.0]
        self.view = View(BOARD[:count], pixels[:count], LENS)

    def look(self, message):
        if message is None:
            raise ValueError('no image')
        return self.view


@pytest.mark.parametrize(
    ('message', 'cause', 'reason'),
    [
        ('three corners', 'that tells no pose of the board', 'no image shows 4 board points'),
        (None, 'that cannot be decoded', "it cannot be decoded: ValueError('no image')"),
    ],
)
def test_an_image_that_tells_nothing_is_counted_with_its_cause(message, cause, reason):
    kept = pictures.Pictures(lambda: 0.3)
    kept.cameras = {'image': Seeing(3)}
    number = kept.keep('image', 1, lambda: message)
    assert kept.through([Sample(0, np.zeros(2), images=(number,))], wait=True) == []
    assert kept.reason.startswith(reason)
    assert kept.dropped == {f'measurements: image {cause}': 1}


def test_an_image_tells_the_pose_of_the_board_and_how_well():
    found = {}
    for sigma in (0.3, 0.6):
        kept = pictures.Pictures(lambda sigma=sigma: sigma)
        kept.cameras = {'image': Seeing(12)}
        numbers = tuple(kept.keep('image', 1, lambda: 'board') for _ in range(3))
        (found[sigma],) = kept.through([Sample(7, np.ones(2), images=numbers)], wait=True)
    fine, coarse = found.values()
    np.testing.assert_allclose(fine.position, [0.02, -0.03, 0.5], atol=1e-9)
    turn = se3.log_rotation(fine.rotation[np.newaxis])[0]
    np.testing.assert_allclose(turn, [0.3, -0.2, 0.1], atol=1e-9)
    np.testing.assert_allclose(coarse.covariance, 4.0 * fine.covariance)
    across, along = np.sqrt(np.diag(fine.covariance)[[0, 2]])
    assert 1.0 < across / (0.3 / 1000.0 * 0.5 / np.sqrt(12)) < 3.0  # turns look like shifts
    assert along > 2.0 * across  # a small board tells less of its distance
    assert (fine.stamp_ns, fine.images) == (7, ())
    np.testing.assert_array_equal(fine.view.pixels, Seeing(12).view.pixels)


def test_memory_for_images_is_bounded(monkeypatch):
    monkeypatch.setattr(pictures, 'MOST_BYTES', 1000)
    kept = pictures.Pictures(lambda: 0.3)
    for _ in range(50):
        newest = kept.keep('image', 100, lambda: None)
    assert newest in kept._kept
    assert 4 < len(kept._kept) <= 10
    assert np.diff([0, *kept._kept]).max() < 40  # old ones are among them


def test_the_first_image_after_a_pause_is_kept_until_its_clock_is_known():
    """Its stamp waits at the gate for joint states, and it was forgotten meanwhile."""
    (camera,) = parse_sources(('/image board=board.yaml',))
    session = CalibrationSession(load_chain('ur10e'))
    names = ('', *session.joint_names)
    session.take([Part(np.array([0]), None, names, np.array([10**18]), np.zeros((1, 6)))])
    number = session.pictures.keep('/image', 1, lambda: None)
    stamps = np.array([10**18 + 10**11])
    session.take([Part(np.array([0]), camera, ('camera',), stamps, np.array([[number * 1.0]]))])
    assert [*session.pictures._kept] == [number]
    stamps = stamps + 10**8 * np.arange(1, 31)
    session.take([Part(np.arange(30), None, names, stamps, np.linspace(0, 1, 180).reshape(-1, 6))])
    assert not session.pictures._kept  # the arm was moving


def test_bayer_patterns_and_colours_become_grey():
    rng = np.random.default_rng(0)
    colours = rng.integers(0, 255, 3)
    for encoding, places in (('bayer_rggb8', 'rggb'), ('bayer_gbrg8', 'gbrg')):
        tile = np.array([colours['rgb'.index(each)] for each in places], np.uint8).reshape(2, 2)
        image = np.tile(tile, (8, 8))
        found = grey(image.ravel(), 16, 16, 16, encoding)[4:-4, 4:-4]
        assert np.abs(found - colours @ (0.299, 0.587, 0.114)).max() < 2.0
    for encoding in ('rgb8', 'bgr8', '8UC3', 'rgba8', 'bgra8'):
        order = encoding.replace('8UC3', 'bgr').strip('8')
        pixel = [0 if each == 'a' else colours['rgb'.index(each)] for each in order]
        image = np.tile(np.array(pixel, np.uint8), (4, 6))
        found = grey(image.ravel(), 4, 6, image.shape[1], encoding)
        assert np.abs(found - colours @ (0.299, 0.587, 0.114)).max() < 2.0
