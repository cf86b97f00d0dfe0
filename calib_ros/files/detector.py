# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The corners of a board in photographs, by OpenCV (`pip install calib_ros[camera]`).

Images whose corners would harm are refused with the reason: blurred, another board, or too little
of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.files.boards import Board, grid
from calib_ros.files.detections import Detections
from calib_ros.kinematics.parameter import IN_A_FRAME
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.sampling.sample import Flaw
from calib_ros.settings import EXCEPTION

Image = NDArray[np.uint8]  # grey
Corners = tuple[Index, FloatArray]  # numbers (K,) and pixels (K, 2) of a board's corners
Markers = tuple[FloatArray, Index]
"""Corners (K, 4, 2) [px], clockwise from the upper left, and numbers (K,) of markers."""

FEWEST = IN_A_FRAME
"""Corners of a usable image: half of their coordinates determine its pose, half check it."""
WINDOW = 0.6
"""Half window of corner refinement, relative to the nearest marker; measured, as WIDEST, by
benchmarks/images.py."""
WIDEST = 10  # largest half window [px]
SMALLEST_SIDE = 700  # longer side [px] of the smallest image searched for markers


def opencv() -> Any:
    """Return OpenCV with its ArUco module."""
    try:
        import cv2
    except ImportError as err:
        raise ConfigError(
            'boards need OpenCV: apt install python3-opencv or pip install "calib_ros[camera]"'
        ) from err
    if not hasattr(cv2, 'aruco'):
        raise ConfigError('this OpenCV has no ArUco module: before 4.7 it is in opencv-contrib')
    return cv2


def dictionaries() -> tuple[str, ...]:
    """Return the names of the marker dictionaries."""
    return tuple(sorted(name for name in dir(opencv().aruco) if name.startswith('DICT_')))


def _dictionary(name: str) -> Any:
    aruco = opencv().aruco
    if name not in dictionaries():
        raise UnknownNameError('dictionary', name, dictionaries())
    return aruco.getPredefinedDictionary(getattr(aruco, name))


def _halvings(image: Image) -> int:
    return int(np.log2(max(*image.shape[:2], SMALLEST_SIDE) / SMALLEST_SIDE))


def marker_cells(board: Board) -> list[Flags]:
    """Return which cells (B, B) of each marker are black, border included."""
    aruco, dictionary = opencv().aruco, _dictionary(board.dictionary)
    count = len(board.markers)
    if count > len(dictionary.bytesList):
        raise ConfigError(
            f'{board.dictionary} has {len(dictionary.bytesList)} markers, the board needs {count}'
        )
    size = dictionary.markerSize + 2
    draw = getattr(aruco, 'generateImageMarker', None) or aruco.drawMarker
    return [np.asarray(draw(dictionary, k, size)) < 128 for k in range(count)]


def black_of(board: Board) -> FloatArray:
    """Return the black areas as rectangles (K, 4) [m]: left, top, width, height."""
    rows: list[tuple[float, float, float, float]] = []
    if board.type == 'charuco':
        place = grid(board.columns, board.rows)
        black = board.square * place[place.sum(axis=1) % 2 == 0]
        rows += [(x, y, board.square, board.square) for x, y in black.tolist()]
    for cells, (left, top) in zip(marker_cells(board), board.markers.tolist(), strict=True):
        size = board.marker / len(cells)
        for k, row in enumerate(cells):  # runs of black cells: no white lines between them
            edges = np.flatnonzero(np.diff(np.concatenate([[0], row, [0]])))
            for first, last in edges.reshape(-1, 2).tolist():
                rows.append((left + first * size, top + k * size, (last - first) * size, size))
    return np.array(rows)


class Detector:
    """Finds the corners of one board.

    Markers are sought at half the image size or less; missing ones that must be in view, at larger
    sizes. Corners are refined at full size; an image must show the `fewest`.
    """

    def __init__(self, board: Board, fewest: int = FEWEST) -> None:
        self._board, self._fewest = board, fewest
        self._cv2 = cv2 = opencv()
        aruco = cv2.aruco
        self._new = hasattr(aruco, 'ArucoDetector')
        self._count = len(marker_cells(board))
        self._dictionary = _dictionary(board.dictionary)
        made = 'DetectorParameters' if self._new else 'DetectorParameters_create'
        self._parameters = getattr(aruco, made)()
        if board.type == 'markers':
            self._parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
        self._corners = self._charuco() if board.type == 'charuco' else _of_markers

    def of(self, image: Image) -> Corners | Flaw:
        """Return numbers (K,) and pixels (K, 2) of the corners, or why the image is not used."""
        width = _edge_width(self._cv2, image)
        if width > 8.0:
            return Flaw('blurred', f'it is blurred: its sharpest edges are {width:.0f} px wide')
        corners, ids = self._sought(image)
        found = self._judged(image, corners, ids)
        if not isinstance(found, Flaw):
            return found
        coarse = image if len(ids) else self._halved(image, _halvings(image))
        corners, ids = self._markers(coarse, self._dictionary)
        if not len(ids):
            reason = f'it shows no marker of {self._board.dictionary}{self._others(coarse)}'
            return Flaw('without the board', reason)
        own = ids < self._count
        if (~own).sum() > len(ids) // 2:
            number, last = int(ids[~own][0]), self._count - 1
            reason = f'it shows another board: marker {number}, and this board has 0 to {last}'
            return Flaw('of another board', reason)
        return self._judged(image, corners[own], ids[own]) if coarse is image else found

    def _sought(self, image: Image) -> Markers:
        size = np.array(image.shape[1::-1])
        halvings = _halvings(image) if self._board.type == 'charuco' else 0
        steps = [(k, range(13, 14)) for k in range(halvings, -1, -1)]
        corners, ids = np.zeros((0, 4, 2)), np.zeros(0, np.intp)
        missing, first, last = np.arange(self._count), np.zeros(2, np.intp), size
        for k, windows in (*steps, (0, range(3, 24, 20))):
            part = self._halved(image[first[1] : last[1], first[0] : last[0]], k)
            among = _dictionary(self._board.dictionary)
            among.bytesList = among.bytesList[missing]
            more, number = self._markers(part, among, windows, max(last - first) / max(size))
            more = (more + 0.5) * ((last - first) / part.shape[1::-1]) - 0.5 + first
            corners = np.concatenate([corners, more])
            ids = np.concatenate([ids, missing[number]])
            missing, first, last = self._hidden(corners, ids, size)
            if not len(missing):
                break
        return corners, ids

    def _halved(self, image: Image, times: int) -> Image:
        size = tuple(max(side // 2**times, 1) for side in image.shape[1::-1])
        area = self._cv2.INTER_AREA
        return self._cv2.resize(image, size, interpolation=area) if times else image

    def _hidden(self, corners: FloatArray, ids: Index, size: Index) -> tuple[Index, ...]:
        """Return missing markers that must be in an image, and the box (2,), (2,) around them."""
        points = self._board.around_markers
        others = np.setdiff1d(np.arange(self._count), ids)
        placed = None
        if len(ids) and len(others):
            placed = self._placed(points[ids], corners, points[others])
        if placed is None:
            return others, np.zeros(2, np.intp), size
        inside = ((placed >= 0.0) & (placed <= size - 1)).all(axis=(1, 2))
        if not inside.any():
            return others[inside], np.zeros(2, np.intp), size
        box = placed[inside].reshape(-1, 2)
        margin = np.ptp(placed[inside], axis=1).max()
        first = np.maximum(box.min(axis=0) - margin, 0).astype(np.intp)
        return others[inside], first, np.minimum(box.max(axis=0) + margin, size).astype(np.intp)

    def _judged(self, image: Image, corners: FloatArray, ids: Index) -> Corners | Flaw:
        number, pixels = self._corners(image, corners, ids)
        few = len(number) < self._fewest
        if few:  # markers may still tell that it is another board
            points, seen = self._board.around_markers[ids].reshape(-1, 2), corners.reshape(-1, 2)
        else:
            points, seen = self._board.corners[number, :2], pixels
        placed = self._placed(points, seen, points) if len(seen) else seen
        apart = np.inf if placed is None else np.linalg.norm(placed - seen, axis=1).max(initial=0)
        # lens and board may bend it by half a refinement window, or 10 %
        if apart > max(0.5 * WIDEST, EXCEPTION * self._spacing(points, seen)):
            asked = (
                'are type, columns, rows, square, marker and legacy those of this board, and is '
                'it flat?'
            )
            for number in np.flatnonzero(np.bincount(ids) > 1)[:1].tolist():
                asked = f'marker {number} appears twice: show one such board only'
            what = f'its {"markers" if few else "corners"} do not fit the board'
            reason = f'{what} ({apart:.0f} px off): {asked}'
            return Flaw('whose corners do not fit the board', reason)
        if few:
            return Flaw(
                'with too little of the board',
                f'it shows {len(number)} of the {len(self._board.corners)} corners, fewer than '
                f'{self._fewest}, and {len(ids)} markers: is only part of the board visible, or '
                'is it another board?',
            )
        return number, pixels

    def _spacing(self, points: FloatArray, pixels: FloatArray) -> float:
        """Return the usual side [px] of a square of the board."""
        if len(points) < 2:
            return 0.0
        return float(np.sqrt(_area(pixels) / max(_area(points), 1e-300))) * self._board.square

    def _placed(
        self, points: FloatArray, pixels: FloatArray, others: FloatArray
    ) -> FloatArray | None:
        """Return the pixels of points of the plane (..., 2), given those of others (..., 2)."""
        matrix, _ = self._cv2.findHomography(points.reshape(-1, 2), pixels.reshape(-1, 2))
        if matrix is None:
            return None
        flat = self._cv2.perspectiveTransform(others.reshape(1, -1, 2), matrix)
        return np.asarray(flat).reshape(others.shape)

    def _charuco(self) -> Callable[[Image, FloatArray, Index], Corners]:
        board, aruco = self._board, self._cv2.aruco
        size = (board.columns, board.rows)
        if self._new:
            made = aruco.CharucoBoard(size, board.square, board.marker, self._dictionary)
            if hasattr(made, 'setLegacyPattern'):
                made.setLegacyPattern(board.legacy)
            elif board.legacy_pattern:
                raise ConfigError('OpenCV 4.7 knows no legacy boards: take another version')
            detect_board = aruco.CharucoDetector(made).detectBoard
        elif board.rows % 2 == 0 and not board.legacy:
            raise ConfigError(
                'this OpenCV knows boards of an even number of rows with a white square at the '
                'upper left only (legacy: true): take an odd number, or OpenCV 4.7'
            )
        else:
            made = aruco.CharucoBoard_create(*size, board.square, board.marker, self._dictionary)

        def found(image: Image, corners: FloatArray, ids: Index) -> Corners:
            pixels = number = None
            around = [each[np.newaxis] for each in corners.astype(np.float32)]
            shape = ids.astype(np.int32)[:, np.newaxis]
            if self._new and around:
                pixels, number, _, _ = detect_board(image, markerCorners=around, markerIds=shape)
            elif around:
                _, pixels, number = aruco.interpolateCornersCharuco(around, shape, image, made)
            if number is None:
                return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
            flat = np.asarray(pixels, dtype=float).reshape(-1, 2)
            return np.ravel(number).astype(np.intp), self._refined(image, flat, corners)

        return found

    def _refined(self, image: Image, pixels: FloatArray, markers: FloatArray) -> FloatArray:
        """Return corners at the crossing of the edges around them.

        OpenCV refines interpolated corners with a window that reaches into the markers, which
        costs up to a tenth of a pixel, and is half a pixel off before version 5.
        """
        cv2 = self._cv2
        apart = np.linalg.norm(pixels[:, np.newaxis] - markers.reshape(-1, 2), axis=2).min(axis=1)
        windows = np.clip((WINDOW * apart).astype(int), 1, WIDEST)
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
        found = pixels.astype(np.float32)
        for size in np.unique(windows).tolist():
            these = windows == size
            start = found[these, np.newaxis].copy()
            found[these] = cv2.cornerSubPix(image, start, (size, size), (-1, -1), criteria)[:, 0]
        return found.astype(float)

    def _markers(
        self, image: Image, dictionary: Any, windows: range = range(3, 24, 10), share: float = 1.0
    ) -> Markers:
        """Return markers by thresholds over windows [px]; `share` of an image is searched."""
        aruco, given = self._cv2.aruco, self._parameters
        given.minMarkerPerimeterRate = 0.03 / share
        given.adaptiveThreshWinSizeMin, given.adaptiveThreshWinSizeMax = windows[0], windows[-1]
        given.adaptiveThreshWinSizeStep = windows.step
        if self._new:
            corners, ids, _ = aruco.ArucoDetector(dictionary, given).detectMarkers(image)
        else:
            corners, ids, _ = aruco.detectMarkers(image, dictionary, parameters=given)
        numbers = np.zeros(0, np.intp) if ids is None else ids.ravel().astype(np.intp)
        return np.array(corners, dtype=float).reshape(-1, 4, 2), numbers

    def _others(self, image: Image) -> str:
        """Return which other dictionary's markers an image shows, or that it is mirrored.

        Boards number them from 0, and dictionaries of one kind share the first ones.
        """
        mirrored = self._markers(np.ascontiguousarray(image[:, ::-1]), self._dictionary)[1]
        if len(mirrored) >= FEWEST:
            return f', but {len(mirrored)} mirrored: give images as the camera sees them'
        names = sorted(dictionaries(), key=len, reverse=True)
        known = {name: _dictionary(name) for name in names if 'ARUCO_MIP' not in name}
        few = min(len(each.bytesList) for each in known.values())
        kinds = {each.bytesList[:few].tobytes(): name for name, each in known.items()}
        kinds.pop(self._dictionary.bytesList[:few].tobytes(), None)
        for name in sorted(kinds.values()):
            known[name].bytesList = known[name].bytesList[:few]
            found = len(self._markers(image, known[name], range(13, 14))[1])
            if found >= FEWEST:
                return f', but {found} of {name}: is it the right board file?'
        return ': is the board in sight, well lit, and no plain chessboard?'


def detect(
    images: Iterable[tuple[str, Image | Flaw]],
    board: Board,
    fewest: int = FEWEST,
    report: Callable[[str], None] = lambda line: None,
) -> tuple[Detections, int]:
    """Return the corners of a board in named images, and the number of unused images.

    Images of another size than most are not used: their lens would differ.
    """
    detector = Detector(board, fewest)
    used: list[tuple[str, tuple[int, int], Corners]] = []
    refused: list[str] = []

    def refuse(name: str, reason: str) -> None:
        refused.append(f'{name}: {reason}')
        report(f'{name}: not used, {reason}')

    for name, picture in images:
        if isinstance(picture, Flaw):
            refuse(name, picture.reason)
            continue
        found = detector.of(picture)
        if isinstance(found, Flaw):
            refuse(name, found.reason)
            continue
        report(f'{name}: {len(found[0])} corners')
        used.append((name, (picture.shape[1], picture.shape[0]), found))
    if not used:
        first = next(iter(refused), 'there is none')
        raise InputError(f'no image can be used; {first}')
    ((most, _),) = Counter(size for _, size, _ in used).most_common(1)
    for name, size, _ in used:
        if size != most:
            refuse(name, 'it is of {} x {} px, and most are of {} x {}'.format(*size, *most))
    names, _, found_in = zip(*(each for each in used if each[1] == most), strict=True)
    image = np.repeat(np.arange(len(names)), [len(number) for number, _ in found_in])
    corner, pixels = map(np.concatenate, zip(*found_in, strict=True))
    return Detections(names, image, corner, pixels, size=most), len(refused)


def _of_markers(image: Image, corners: FloatArray, ids: Index) -> Corners:
    order = np.argsort(ids)
    number = (4 * ids[order, np.newaxis] + np.arange(4)).ravel()
    return number, corners[order].reshape(-1, 2)


def _edge_width(cv2: Any, image: Image) -> float:
    """Return the width [px] of the sharpest edges: contrast over steepest gradient."""
    half = image[::2, ::2] if image.shape[0] > 2000 else image
    across, down = (np.abs(slope[::3, ::3]).ravel() for slope in cv2.spatialGradient(half))
    steepest = _nth(np.concatenate([across, down]), 99.9) / 8.0  # of a Sobel
    some = half[::7, ::7].ravel()
    return (_nth(some, 99.0) - _nth(some, 1.0)) / max(steepest, 1e-3) * (len(image) / len(half))


def _nth(values: NDArray[Any], percent: float) -> float:
    """Return a percentile of whole numbers from 0."""
    counts = np.cumsum(np.bincount(values))
    return float(np.searchsorted(counts, 0.01 * percent * counts[-1]))


def _area(points: FloatArray) -> float:
    return float(np.sqrt(max(np.linalg.det(np.cov(points.T)), 0.0)))
