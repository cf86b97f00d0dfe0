# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of files and messages, in grey."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import CalibrationError, InputError, UnknownNameError
from calib_ros.files.detector import Image, opencv
from calib_ros.files.stored import LARGEST_IMAGE
from calib_ros.sampling.sample import Flaw

SUFFIXES = ('.png', '.jpg', '.jpeg', '.bmp', '.tif', '.tiff', '.pgm')
ENCODINGS = {'mono8': (1, ''), '8UC1': (1, ''), 'rgb8': (3, 'RGB'), 'bgr8': (3, 'BGR')}
ENCODINGS |= {'8UC3': (3, 'BGR'), 'rgba8': (4, 'RGBA'), 'bgra8': (4, 'BGRA')}
ENCODINGS |= {'bayer_rggb8': (1, 'BayerBG'), 'bayer_bggr8': (1, 'BayerRG')}
ENCODINGS |= {'bayer_gbrg8': (1, 'BayerGR'), 'bayer_grbg8': (1, 'BayerGB')}
"""Channels, and what OpenCV calls them: a Bayer pattern by its second row."""


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
