# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Photographs as files, read by OpenCV (`pip install calib_ros[camera]`)."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ConfigError, InputError
from calib_ros.files.stored import LARGEST_IMAGE
from calib_ros.sampling.pictures import Refusal

SUFFIXES = ('.png', '.jpg', '.jpeg', '.bmp', '.tif', '.tiff', '.pgm')
Image = NDArray[np.uint8]  # grey


def opencv() -> Any:
    """Return OpenCV with its ArUco module."""
    try:
        import cv2
    except ImportError as err:
        raise ConfigError(
            'boards need OpenCV: sudo apt install python3-opencv, or pip install '
            '"calib_ros[camera]"'
        ) from err
    if not hasattr(cv2, 'aruco'):
        raise ConfigError('this OpenCV has no ArUco module: before 4.7 it is in opencv-contrib')
    return cv2


def files_of(folder: Path) -> list[Path]:
    """Return the images of a folder by name, shorter names first."""
    paths = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES]
    for path in paths:
        if not path.name.isprintable():
            raise InputError(f'the name of {path} cannot stand in a table: rename it')
    return sorted(paths, key=lambda path: (len(path.name), path.name))


def read_image(path: Path) -> Image | Refusal:
    """Return an image in grey, empty if it is none, or why it cannot be read."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # reading a pipe may never end
            return Refusal('that cannot be read', 'it is not a file')
        if path.stat().st_size > LARGEST_IMAGE:
            return Refusal('that cannot be read', f'it has more than {LARGEST_IMAGE / 1e6:.0f} MB')
        return decoded(np.frombuffer(path.read_bytes(), dtype=np.uint8))
    except OSError as err:
        return Refusal('that cannot be read', f'it cannot be read: {err.strerror}')


def decoded(data: NDArray[np.uint8]) -> Image:
    """Return a compressed image of bytes (B,) in grey (H, W); (0, 0) if it is none.

    EXIF rotation is ignored, because the lens is that of the sensor image. Of 10 to 16 bits the
    eight highest used ones are kept.
    """
    cv2 = opencv()
    kind = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(data, kind)
    except cv2.error:
        image = None
    if image is None:
        return np.zeros((0, 0), dtype=np.uint8)
    if image.dtype == np.uint16:
        image = image >> max(int(image.max()).bit_length() - 8, 0)
    return np.asarray(image, dtype=np.uint8)
