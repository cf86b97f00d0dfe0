# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The corners of a board in photographs, by OpenCV (`pip install calib_ros[camera]`).

An image is refused with the reason where its corners would harm: blurred, another board, or too
little of this one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.files.boards import Board, Detections
from calib_ros.files.stored import LARGEST_IMAGE
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.pictures import Refusal

SUFFIXES = ('.png', '.jpg', '.jpeg', '.bmp', '.tif', '.tiff', '.pgm')
FEWEST = 6
"""Corners of an image from which on it is used."""
BLURRED = 8.0
"""Width [px] of the sharpest edges from which on an image is blurred."""
SHARPEST = 99.9
"""Percentile of gradients that is the sharpest edge's."""
BENT = 5.0
"""Distance [px] from where the other corners say up to which lens and board may bend a board."""
BENT_SHARE = 0.1
"""The same as a share of the distance between corners."""
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Refused:
    """An image that is not used, and why."""

    name: str
    reason: str


@dataclass(frozen=True, eq=False)
class Found:
    """What was found in images, and the images that are not used."""

    detections: Detections
    refused: tuple[Refused, ...]


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


def dictionaries() -> tuple[str, ...]:
    """Return the names of the dictionaries of markers."""
    return tuple(sorted(name for name in dir(opencv().aruco) if name.startswith('DICT_')))


def _dictionary(name: str) -> Any:
    aruco = opencv().aruco
    if name not in dictionaries():
        raise UnknownNameError('dictionary', name, dictionaries())
    return aruco.getPredefinedDictionary(getattr(aruco, name))


def marker_cells(board: Board) -> list[NDArray[np.bool_]]:
    """Return which cells (B, B) of each marker are black, its border included."""
    aruco, dictionary = opencv().aruco, _dictionary(board.dictionary)
    count = len(board.markers)
    if count > len(dictionary.bytesList):
        raise ConfigError(
            f'{board.dictionary} has {len(dictionary.bytesList)} markers, the board needs {count}'
        )
    size = dictionary.markerSize + 2
    draw = getattr(aruco, 'generateImageMarker', None) or aruco.drawMarker
    return [np.asarray(draw(dictionary, k, size)) < 128 for k in range(count)]


def files_of(folder: Path) -> Iterator[tuple[str, Image]]:
    """Yield the images of a folder by name, those that cannot be read without pixels."""
    paths = sorted(
        (path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES),
        key=lambda path: (len(path.name), path.name),
    )
    if not paths:
        raise InputError(f'{folder} has no images ({", ".join(SUFFIXES)})')
    for path in paths:
        if path.stat().st_size > LARGEST_IMAGE:
            yield path.name, np.zeros((0, 0), dtype=np.uint8)
        else:
            yield path.name, decoded(np.fromfile(path, dtype=np.uint8))


def decoded(data: NDArray[np.uint8]) -> Image:
    """Return a compressed image in grey; without pixels where it is none."""
    cv2 = opencv()
    try:
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        image = None
    return np.zeros((0, 0), dtype=np.uint8) if image is None else np.asarray(image)


def image_of(message: Any) -> Image:
    """Return a sensor_msgs/Image or CompressedImage in grey.

    Raises
    ------
    InputError
        For an encoding or a size that cannot be used.

    """
    data = np.frombuffer(message.data, dtype=np.uint8)
    if hasattr(message, 'format'):
        return decoded(data)
    return grey(data, message.height, message.width, message.step, message.encoding)


def grey(data: NDArray[np.uint8], height: int, width: int, step: int, encoding: str) -> Image:
    """Return the content of a sensor_msgs/Image in grey.

    Raises
    ------
    InputError
        For an encoding or a size that cannot be used.

    """
    cv2 = opencv()
    known = {  # channels, and how they become grey; OpenCV names a Bayer pattern by its second row
        'mono8': (1, None),
        '8UC1': (1, None),
        'rgb8': (3, cv2.COLOR_RGB2GRAY),
        'bgr8': (3, cv2.COLOR_BGR2GRAY),
        '8UC3': (3, cv2.COLOR_BGR2GRAY),
        'rgba8': (4, cv2.COLOR_RGBA2GRAY),
        'bgra8': (4, cv2.COLOR_BGRA2GRAY),
        'bayer_rggb8': (1, cv2.COLOR_BayerBG2GRAY),
        'bayer_bggr8': (1, cv2.COLOR_BayerRG2GRAY),
        'bayer_gbrg8': (1, cv2.COLOR_BayerGR2GRAY),
        'bayer_grbg8': (1, cv2.COLOR_BayerGB2GRAY),
    }
    if encoding not in known:
        raise UnknownNameError('encoding of images', encoding, known)
    channels, code = known[encoding]
    if step < width * channels or len(data) < height * step or height < 1 or width < 1:
        raise InputError(f'an image of {width} x {height} px holds {len(data)} bytes only')
    rows = data[: height * step].reshape(height, step)[:, : width * channels]
    if code is None:
        return np.ascontiguousarray(rows)
    shape = (height, width) if channels == 1 else (height, width, channels)
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows).reshape(shape), code))


class Detector:
    """Finds the corners of one board.

    Parameters
    ----------
    board : Board
    fewest : int
        Corners that an image must show.

    """

    def __init__(self, board: Board, fewest: int = FEWEST) -> None:
        self._board, self._fewest = board, fewest
        self._cv2 = cv2 = opencv()
        aruco = cv2.aruco
        self._new = hasattr(aruco, 'ArucoDetector')
        self._count = len(marker_cells(board))
        self._dictionary = _dictionary(board.dictionary)
        self._parameters = (
            aruco.DetectorParameters() if self._new else aruco.DetectorParameters_create()
        )
        if board.type == 'markers':
            self._parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
        self._corners: Callable[..., tuple[NDArray[np.intp], FloatArray]] = self._of_markers
        if board.type == 'charuco':
            self._corners = self._charuco()

    def of(self, image: Image) -> tuple[NDArray[np.intp], FloatArray] | Refusal:
        """Return numbers (K,) and pixels (K, 2) of the corners, or why the image is not used."""
        if not image.size:
            return Refusal('that cannot be decoded', 'it is no image that OpenCV can read')
        corners, ids = self._markers(image, self._dictionary)
        width = _edge_width(self._cv2, image)
        if width > BLURRED:
            reason = f'it is blurred: its sharpest edges are {width:.0f} px wide'
            return Refusal('blurred', reason)
        if not len(ids):
            reason = f'it shows no marker of {self._board.dictionary}{self._others(image)}'
            return Refusal('without the board', reason)
        foreign = ids[ids >= self._count]
        if len(foreign) > len(ids) // 2:
            return Refusal(
                'of another board',
                f'it shows another board: marker {int(foreign[0])}, and this board has 0 to '
                f'{self._count - 1}',
            )
        own = ids < self._count
        number, pixels = self._corners(
            image, [c for c, o in zip(corners, own, strict=True) if o], ids[own]
        )
        whole = len(self._board.corners)
        if len(number) < self._fewest:
            return Refusal(
                'with too little of the board',
                f'it shows {len(number)} of the {whole} corners, fewer than {self._fewest}, and '
                f'{len(ids)} markers: is it a part of the board only, or another board?',
            )
        points = self._board.corners[number, :2]
        apart = _off_a_plane(points, pixels)
        spacing = np.sqrt(_area(pixels) / max(_area(points), 1e-300)) * self._board.square
        if apart > max(BENT, BENT_SHARE * spacing):
            return Refusal(
                'whose corners do not fit the board',
                f'its corners do not fit the board ({apart:.0f} px off): are columns, rows, square'
                ' and marker those of this board, and is it flat?',
            )
        return number, pixels

    def _charuco(self) -> Callable[..., tuple[NDArray[np.intp], FloatArray]]:
        board, aruco = self._board, self._cv2.aruco
        size = (board.columns, board.rows)
        if self._new:
            made = aruco.CharucoBoard(size, board.square, board.marker, self._dictionary)
            if hasattr(made, 'setLegacyPattern'):
                made.setLegacyPattern(board.legacy)
            elif board.legacy_pattern:
                raise ConfigError('OpenCV 4.7 knows no legacy boards: take another version')
            detector = aruco.CharucoDetector(made)
            detector.setDetectorParameters(self._parameters)

            def found(image: Image, corners: list[Any], ids: NDArray[np.intp]) -> Any:
                shape = np.asarray(ids, dtype=np.int32)[:, np.newaxis]
                pixels, number, _, _ = detector.detectBoard(
                    image, markerCorners=corners, markerIds=shape
                )
                return self._centred(image, *_flat(number, pixels))

            return found
        if board.rows % 2 == 0 and not board.legacy:
            raise ConfigError(
                'this OpenCV knows boards of an even number of rows with a white square at the '
                'upper left only (legacy: true): take an odd number, or OpenCV 4.7'
            )
        made = aruco.CharucoBoard_create(*size, board.square, board.marker, self._dictionary)

        def found_before(image: Image, corners: list[Any], ids: NDArray[np.intp]) -> Any:
            shape = np.asarray(ids, dtype=np.int32)[:, np.newaxis]
            if not len(shape):
                return _flat(None, None)
            _, pixels, number = aruco.interpolateCornersCharuco(corners, shape, image, made)
            return self._centred(image, *_flat(number, pixels))

        return found_before

    def _centred(
        self, image: Image, number: NDArray[np.intp], pixels: FloatArray
    ) -> tuple[NDArray[np.intp], FloatArray]:
        """Return corners with the centres of pixels at whole numbers.

        Versions before 5 add half a pixel. What the corners are refined to tells.
        """
        if not len(number):
            return number, pixels
        cv2 = self._cv2
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
        again = pixels.astype(np.float32)[:, np.newaxis].copy()
        refined = cv2.cornerSubPix(image, again, (4, 4), (-1, -1), criteria)[:, 0]
        added = np.median(pixels - refined, axis=0).min() > 0.25
        return number, pixels - 0.5 * added

    def _of_markers(
        self, image: Image, corners: list[Any], ids: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], FloatArray]:
        del image
        order = np.argsort(ids)
        number = (4 * ids[order, np.newaxis] + np.arange(4)).ravel()
        pixels = np.array([corners[k] for k in order], dtype=float).reshape(-1, 2)
        return number, pixels

    def _markers(self, image: Image, dictionary: Any) -> tuple[list[Any], NDArray[np.intp]]:
        aruco = self._cv2.aruco
        if self._new:
            corners, ids, _ = aruco.ArucoDetector(dictionary, self._parameters).detectMarkers(
                image
            )
        else:
            corners, ids, _ = aruco.detectMarkers(image, dictionary, parameters=self._parameters)
        return list(corners), np.zeros(0, np.intp) if ids is None else ids.ravel().astype(np.intp)

    def _others(self, image: Image) -> str:
        """Return in words which other dictionary's markers an image shows."""
        for name in dictionaries():
            if name != self._board.dictionary and 'ARUCO_MIP' not in name:
                found = len(self._markers(image, _dictionary(name))[1])
                if found >= FEWEST:
                    return f', but {found} of {name}: is it the right board file?'
        return ': is the board in sight, and well lit?'


def detect(
    images: Iterable[tuple[str, Image]],
    board: Board,
    fewest: int = FEWEST,
    heard: Callable[[str], None] = lambda line: None,
) -> Found:
    """Return the corners of a board in named images."""
    detector = Detector(board, fewest)
    names: list[str] = []
    image, corner, pixels, refused = [], [], [], []
    for name, picture in images:
        found = detector.of(picture)
        if isinstance(found, Refusal):
            refused.append(Refused(name, found.reason))
            heard(f'{name}: not used, {found.reason}')
            continue
        heard(f'{name}: {len(found[0])} corners')
        image.append(np.full(len(found[0]), len(names)))
        names.append(name)
        corner.append(found[0])
        pixels.append(found[1])
    if not names:
        first = refused[0] if refused else Refused('', 'there is none')
        raise InputError(f'no image can be used; {first.name}: {first.reason}')
    detections = Detections(
        tuple(names), np.concatenate(image), np.concatenate(corner), np.concatenate(pixels)
    )
    return Found(detections, tuple(refused))


def _flat(number: Any, pixels: Any) -> tuple[NDArray[np.intp], FloatArray]:
    if number is None or not len(number):
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    return np.ravel(number).astype(np.intp), np.asarray(pixels, dtype=float).reshape(-1, 2)


def _edge_width(cv2: Any, image: Image) -> float:
    """Return how wide [px] the sharpest edges are: the contrast over the steepest gradient."""
    half = image[::2, ::2] if image.shape[0] > 2000 else image
    across = cv2.Sobel(half, cv2.CV_16S, 1, 0)
    down = cv2.Sobel(half, cv2.CV_16S, 0, 1)
    steps = np.concatenate([np.abs(across[::3, ::3]).ravel(), np.abs(down[::3, ::3]).ravel()])
    dark, bright = np.percentile(half[::7, ::7], [1.0, 99.0])
    steepest = float(np.percentile(steps, SHARPEST)) / 8.0
    return (float(bright) - float(dark)) / max(steepest, 1e-3) * (len(image) / len(half))


def _off_a_plane(points: FloatArray, pixels: FloatArray) -> float:
    """Return how far [px] corners are from a homography of the points (K, 2), at most."""
    middle, size = points.mean(axis=0), points.std()
    centre, spread = pixels.mean(axis=0), pixels.std()
    flat = np.column_stack([(points - middle) / size, np.ones(len(points))])
    seen = (pixels - centre) / spread
    rows = np.zeros((len(points), 2, 9))
    rows[:, 0, :3] = rows[:, 1, 3:6] = flat
    rows[:, :, 6:] = -seen[:, :, np.newaxis] * flat[:, np.newaxis]
    matrix = np.linalg.svd(rows.reshape(-1, 9))[2][-1].reshape(3, 3)
    placed = flat @ matrix.T
    away = spread * (placed[:, :2] / placed[:, 2:] - seen)
    return float(np.linalg.norm(away, axis=1).max())


def _area(points: FloatArray) -> float:
    """Return the area that points (K, 2) spread over."""
    return float(np.sqrt(max(np.linalg.det(np.cov(points.T)), 0.0)))
