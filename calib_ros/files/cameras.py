# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Cameras as measurement sources: from images to corners."""

from __future__ import annotations

import bisect
import operator
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from calib_ros.atomic import given_path
from calib_ros.errors import MOST_ENTRIES, CalibrationError, ConfigError
from calib_ros.files.boards import read_board
from calib_ros.files.detector import Detector
from calib_ros.files.images import image_of
from calib_ros.files.lenses import lens_of
from calib_ros.kinematics.lens import Lens
from calib_ros.sampling.messages import head_of
from calib_ros.sampling.sample import Flaw, View
from calib_ros.sampling.source_texts import parse_sources
from calib_ros.sampling.sources import Source


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
