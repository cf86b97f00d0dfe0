# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of files and messages, and cameras as measurement sources: from images to corners."""

from __future__ import annotations

import bisect
import operator
import stat
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_ros.atomic import given_path
from calib_ros.errors import (
    MOST_ENTRIES,
    CalibrationError,
    ConfigError,
    InputError,
    UnknownNameError,
)
from calib_ros.files.boards import read_board
from calib_ros.files.detector import Detector, Image, opencv
from calib_ros.files.lenses import lens_of
from calib_ros.files.stored import LARGEST_IMAGE
from calib_ros.kinematics.lens import Lens
from calib_ros.sampling.board_finder import Flaw
from calib_ros.sampling.messages import head_of
from calib_ros.sampling.sample import View
from calib_ros.sampling.source_texts import parse_sources
from calib_ros.sampling.sources import Source

SUFFIXES = ('.png', '.jpg', '.jpeg', '.bmp', '.tif', '.tiff', '.pgm')
ENCODINGS = {'mono8': (1, ''), '8UC1': (1, ''), 'rgb8': (3, 'RGB'), 'bgr8': (3, 'BGR')}
ENCODINGS |= {'8UC3': (3, 'BGR'), 'rgba8': (4, 'RGBA'), 'bgra8': (4, 'BGRA')}
ENCODINGS |= {'bayer_rggb8': (1, 'BayerBG'), 'bayer_bggr8': (1, 'BayerRG')}
ENCODINGS |= {'bayer_gbrg8': (1, 'BayerGR'), 'bayer_grbg8': (1, 'BayerGB')}
"""Channels, and what OpenCV calls them: a Bayer pattern by its second row."""


class _CameraInfo(NamedTuple):
    """What a CameraInfo said: the lens, and height and width [px]."""

    stamp_ns: int
    lens: Lens | Flaw
    size: tuple[int, int]


_stamp = operator.attrgetter('stamp_ns')


class BoardCamera:
    """Finds the board of a source in its images."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._board = read_board(given_path(source.board))
        self._detector = Detector(self._board)
        self._told: tuple[_CameraInfo, ...] = ()  # whenever it changed, by stamp

    def learn(self, info: Any) -> None:
        """Take a CameraInfo; an unusable one refuses the images after it."""
        fixed = self._source.lens == 'given'
        lens: Lens | Flaw
        try:
            lens = replace(lens_in(info, not fixed), fixed=fixed)
        except CalibrationError as err:
            lens = Flaw('whose CameraInfo cannot be used', str(err))
        new = _CameraInfo(head_of(info)[0], lens, (info.height, info.width))
        k = bisect.bisect_right(self._told, new.stamp_ns, key=_stamp)
        if not k or self._told[k - 1][1:] != new[1:]:
            self._told = (*self._told[:k], new, *self._told[k:])[-MOST_ENTRIES:]

    def look(self, message: Any) -> View | Flaw:
        """Return the corners in an Image or CompressedImage, or why it is not used.

        Its lens is that at its stamp: recordings are read ahead of their images.
        """
        later = bisect.bisect_right(self._told, head_of(message)[0], key=_stamp)
        if not later:
            reason = f'no CameraInfo up to its stamp has come on {self._source.camera_info}'
            return Flaw('before any CameraInfo', reason)
        _, lens, size = self._told[later - 1]
        if isinstance(lens, Flaw):
            return lens
        image = image_of(message)
        if isinstance(image, Flaw):
            return image
        if all(size) and image.shape != size:
            sizes = ' and '.join(f'{w} x {h}' for h, w in (image.shape, size))
            reason = f'it and its CameraInfo are of {sizes} px: set both alike'
            return Flaw('of another size than its CameraInfo', reason)
        found = self._detector.of(image)
        if isinstance(found, Flaw):
            return found
        number, pixels = found
        return View(self._board.corners[number], np.round(pixels, 4), lens)  # as in a table


def lens_in(info: Any, fitted: bool = False) -> Lens:
    """Return the lens of a CameraInfo, as `lens_of`; refuse regions of interest and binning."""
    matrix, distortion = [[float(x) for x in values] for values in (info.k, info.d)]
    if not any(matrix):
        raise ConfigError('CameraInfo: the camera is not calibrated, k is zero')
    cut = info.roi.x_offset or info.roi.y_offset
    if cut or info.binning_x > 1 or info.binning_y > 1:
        raise ConfigError('CameraInfo: give the whole image, without roi and binning')
    model = info.distortion_model or 'plumb_bob'
    return lens_of(model, matrix, distortion, 'CameraInfo', fitted)


def cameras_of(texts: Sequence[str]) -> Mapping[str, BoardCamera]:
    """Return the cameras among sources by image topic."""
    sources = [source for source in parse_sources(texts) if source.board]
    for source in sources:
        if 'image_rect' in source.raw_topic.rpartition('/')[2]:
            raise ConfigError(
                f'source "{source.topic}" is rectified: give what CameraInfo describes, image_raw'
            )
        if sum(each.device == source.device for each in sources) > 1:
            raise ConfigError(f'source "{source.topic}" needs a device=NAME that no other has')
    return {source.topic: BoardCamera(source) for source in sources}


def image_of(message: Any) -> Image | Flaw:
    """Return a sensor_msgs/Image or CompressedImage in grey, or why it cannot be decoded."""
    data = np.frombuffer(message.data, dtype=np.uint8)
    if hasattr(message, 'format'):
        return decoded(data)
    try:
        return grey(data, message.height, message.width, message.step, message.encoding)
    except CalibrationError as err:
        return Flaw('that cannot be decoded', str(err))


def grey(data: NDArray[np.uint8], height: int, width: int, step: int, encoding: str) -> Image:
    """Return the data (B,) of a sensor_msgs/Image in grey (H, W); refuse encodings and sizes."""
    if encoding not in ENCODINGS:
        raise UnknownNameError('encoding of images', encoding, ENCODINGS)
    channels, kind = ENCODINGS[encoding]
    if step < width * channels or len(data) < height * step or height < 1 or width < 1:
        raise InputError(f'an image of {width} x {height} px holds {len(data)} bytes only')
    rows = data[: height * step].reshape(height, step)[:, : width * channels]
    if not kind:
        return np.ascontiguousarray(rows)
    shape = (height, width) if channels == 1 else (height, width, channels)
    code = getattr(opencv(), f'COLOR_{kind}2GRAY')
    return np.asarray(opencv().cvtColor(np.ascontiguousarray(rows).reshape(shape), code))


def image_files(folder: Path) -> list[Path]:
    """Return the images of a folder by name, shorter names first."""
    paths = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES]
    for path in paths:
        if not path.name.isprintable():
            raise InputError(f'the name of {path} cannot stand in a table: rename it')
    return sorted(paths, key=lambda path: (len(path.name), path.name))


def read_image(path: Path) -> Image | Flaw:
    """Return an image in grey, or why it cannot be read."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # reading a pipe may never end
            return Flaw('that cannot be read', 'it is not a file')
        if path.stat().st_size > LARGEST_IMAGE:
            return Flaw('that cannot be read', f'it has more than {LARGEST_IMAGE / 1e6:.0f} MB')
        return decoded(np.frombuffer(path.read_bytes(), dtype=np.uint8))
    except OSError as err:
        return Flaw('that cannot be read', f'it cannot be read: {err.strerror}')


def decoded(data: NDArray[np.uint8]) -> Image | Flaw:
    """Return a compressed image of bytes (B,) in grey (H, W), or that it is none.

    EXIF rotation is ignored, because the lens is that of the sensor image. Of 10 to 16 bits the
    eight highest used ones are kept.
    """
    cv2 = opencv()
    kind = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(data, kind)
    except cv2.error:
        image = None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        return Flaw('that cannot be decoded', 'OpenCV cannot read this image')
    if image.dtype == np.uint16:
        image = image >> max(int(image.max()).bit_length() - 8, 0)
    return np.asarray(image, dtype=np.uint8)
