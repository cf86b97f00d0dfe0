# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Images in grey, from files and messages, by OpenCV (`pip install calib_ros[camera]`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.files.stored import LARGEST_IMAGE

SUFFIXES = ('.png', '.jpg', '.jpeg', '.bmp', '.tif', '.tiff', '.pgm')
Image = NDArray[np.uint8]
ENCODINGS = {
    'mono8': (1, ''),
    '8UC1': (1, ''),
    'rgb8': (3, 'RGB'),
    'bgr8': (3, 'BGR'),
    '8UC3': (3, 'BGR'),
    'rgba8': (4, 'RGBA'),
    'bgra8': (4, 'BGRA'),
    'bayer_rggb8': (1, 'BayerBG'),
    'bayer_bggr8': (1, 'BayerRG'),
    'bayer_gbrg8': (1, 'BayerGR'),
    'bayer_grbg8': (1, 'BayerGB'),
}
"""Channels, and what OpenCV calls them: a Bayer pattern by its second row."""


def opencv() -> Any:
    """Return OpenCV with its ArUco module."""
    try:
        import cv2
    except ImportError as err:
        raise ConfigError(
            'photographs need OpenCV: sudo apt install python3-opencv, or pip install '
            '"calib_ros[camera]"'
        ) from err
    if not hasattr(cv2, 'aruco'):
        raise ConfigError('this OpenCV has no ArUco module: before 4.7 it is in opencv-contrib')
    return cv2


def files_of(folder: Path) -> list[Path]:
    """Return the images of a folder by name, shorter ones first."""
    paths = (path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    return sorted(paths, key=lambda path: (len(path.name), path.name))


def read_image(path: Path) -> Image:
    """Return an image in grey; without pixels where it cannot be read."""
    if path.stat().st_size > LARGEST_IMAGE:
        return np.zeros((0, 0), dtype=np.uint8)
    return decoded(np.fromfile(path, dtype=np.uint8))


def decoded(data: NDArray[np.uint8]) -> Image:
    """Return a compressed image in grey; without pixels where it is none."""
    cv2 = opencv()
    try:
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        image = None
    return np.zeros((0, 0), dtype=np.uint8) if image is None else np.asarray(image)


def image_of(message: Any) -> Image:
    """Return a sensor_msgs/Image or CompressedImage in grey."""
    data = np.frombuffer(message.data, dtype=np.uint8)
    if hasattr(message, 'format'):
        return decoded(data)
    return grey(data, message.height, message.width, message.step, message.encoding)


def grey(data: NDArray[np.uint8], height: int, width: int, step: int, encoding: str) -> Image:
    """Return the content of a sensor_msgs/Image in grey; refuse unknown encodings and sizes."""
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
