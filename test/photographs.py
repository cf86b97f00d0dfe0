# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Boards as a camera sees them, rendered; needs OpenCV."""

from functools import cache

import cv2
import numpy as np

from calib_ros.files import boards
from calib_ros.files.detector import black_of

CHARUCO = boards.Board('charuco', 5, 7, 0.036, 0.026, 'DICT_6X6_250')
SCALE = 5000.0
"""Pixels of a drawn board per metre."""


@cache
def drawn(board):
    """Return a board as it is printed, SCALE pixels a metre."""
    width, height = (round(side * SCALE) for side in board.size)
    page = np.full((height, width), 255, dtype=np.uint8)

    for left, top, wide, high in black_of(board):
        edges = np.array([[top, top + high], [left, left + wide]])
        (begin, end), (first, last) = np.round(SCALE * edges).astype(int)
        page[begin:end, first:last] = 0
    return page


@cache
def noise_of(shape):
    """Return standard normal noise of an image (height, width)."""
    return np.random.default_rng(0).normal(size=shape)


def rendered(board, pose, lens, size, blur=0.7, noise=2.0, finer=4):
    """Return an image (height, width) of a board at a pose (4, 4) in a camera without distortion.

    Also where its corners are in it [px].
    """
    camera = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
    matrix = camera @ np.column_stack([pose[:3, :2], pose[:3, 3]])
    outline = np.array([(x, y, 1.0) for x in (0.0, board.size[0]) for y in (0.0, board.size[1])])
    box = outline @ matrix.T
    box = box[:, :2] / box[:, 2:]
    first = np.clip(np.floor(box.min(axis=0)) - 2, 0, size).astype(int)
    last = np.clip(np.ceil(box.max(axis=0)) + 3, 0, size).astype(int)
    image = np.full(size[::-1], 210, dtype=np.uint8)
    if (last > first).all():
        middle = (finer - 1) / 2 - finer * first
        larger = np.array([[finer, 0.0, middle[0]], [0.0, finer, middle[1]], [0.0, 0.0, 1.0]])
        page = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, SCALE]]) / SCALE
        large = cv2.warpPerspective(
            drawn(board),
            larger @ matrix @ page,
            (finer * (last - first)).tolist(),
            flags=cv2.INTER_AREA,
            borderValue=210,
        )
        small = cv2.resize(large, (last - first).tolist(), interpolation=cv2.INTER_AREA)
        image[first[1] : last[1], first[0] : last[0]] = small
    image = cv2.GaussianBlur(image, (0, 0), blur).astype(float)
    image += noise_of(image.shape) * noise
    seen = np.column_stack([board.corners[:, :2], np.ones(len(board.corners))]) @ matrix.T
    return np.clip(image, 0, 255).astype(np.uint8), seen[:, :2] / seen[:, 2:]
