# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Corners in photographs: how fast, how many, how far off, beside OpenCV's own detector.

    python benchmarks/images.py [--images 8]

Rendered images of 1600 x 1200 pixels of ChArUco boards, turned at random, on one core. OpenCV's
detector gets the whole image, the whole dictionary and its own settings. `decode` is what reading
such an image as PNG takes besides.
"""

import sys
import time
from pathlib import Path

import bench
import cv2
import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / 'test')]
from photographs import rendered

from calib_ros.files.boards import Board
from calib_ros.files.detector import Detector
from calib_ros.files.images import decoded
from calib_ros.kinematics import se3
from calib_ros.kinematics.lens import Lens
from calib_ros.sampling.sample import Flaw

LENS = Lens(1350.0, 1350.0, 800.0, 600.0)
SIZE = (1600, 1200)
USUAL = Board('charuco', 9, 7, 0.03, 0.022, 'DICT_5X5_250')
MANY = Board('charuco', 13, 9, 0.02, 0.015, 'DICT_4X4_250')
SCENES = {  # board, distance [m], blur [px], noise [grey levels], how far aside
    '0.4 m': (USUAL, 0.4, 0.7, 2.0, 0.05),
    '0.6 m': (USUAL, 0.6, 0.7, 2.0, 0.15),
    '1.2 m': (USUAL, 1.2, 0.7, 2.0, 0.2),
    '2 m': (USUAL, 2.0, 0.7, 2.0, 0.2),
    '0.6 m, blurred by 2 px': (USUAL, 0.6, 2.0, 2.0, 0.15),
    '0.6 m, blurred by 3 px': (USUAL, 0.6, 3.0, 2.0, 0.15),
    '0.6 m, noise of 20': (USUAL, 0.6, 0.7, 20.0, 0.15),
    '0.45 m, cut off': (USUAL, 0.45, 0.7, 2.0, 0.45),
    '0.6 m, 13 x 9 squares': (MANY, 0.6, 0.7, 2.0, 0.1),
}


def photographs(board, depth, blur, noise, aside, count):
    """Return images and where the corners are in them (M, 2) [px]."""
    rng = np.random.default_rng(1)
    found = []
    for _ in range(count):
        tilt = np.append(rng.uniform(-0.6, 0.6, 2), 0.0)
        rotation = se3.exp_rotation(tilt) @ se3.exp_rotation(rng.uniform(-3, 3, 3) * (0, 0, 1))
        far = depth * rng.uniform(0.85, 1.15)
        middle = far * np.append(rng.uniform(-aside, aside, 2), 1.0)
        pose = se3.transform(rotation, middle - rotation @ board.corners.mean(axis=0))
        found.append(rendered(board, pose, LENS, SIZE, blur, noise))
    return found


def of_opencv(board):
    """Return what finds numbers and pixels of corners by OpenCV alone."""
    aruco = cv2.aruco
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, board.dictionary))
    size = (board.columns, board.rows)
    if hasattr(aruco, 'CharucoDetector'):
        made = aruco.CharucoBoard(size, board.square, board.marker, dictionary)
        detector = aruco.CharucoDetector(made)
        return lambda image: detector.detectBoard(image)[1::-1]
    made = aruco.CharucoBoard_create(*size, board.square, board.marker, dictionary)

    def found(image):
        corners, ids, _ = aruco.detectMarkers(image, dictionary)
        if ids is None:
            return None, None
        return aruco.interpolateCornersCharuco(corners, ids, image, made)[:0:-1]

    return found


def judged(look, pictures):
    """Return the CPU time [s] of an image, how many corners were found, and their RMS error."""
    begin = time.process_time()
    seen = [look(image) for image, _ in pictures]
    taken = (time.process_time() - begin) / len(pictures)
    away = [np.zeros((0, 2))]
    for found, (_, exact) in zip(seen, pictures, strict=True):
        if not isinstance(found, Flaw) and found[0] is not None:
            away.append(np.reshape(found[1], (-1, 2)) - exact[np.ravel(found[0])])
    off = np.concatenate(away)
    off -= np.round(2.0 * np.median(off, axis=0)) / 2.0  # half a pixel before OpenCV 5
    return taken, len(off), np.sqrt((off**2).sum(axis=1).mean())


def main():
    """Print the figures of all scenes."""
    options = bench.options(__doc__, images=8)
    cv2.setNumThreads(1)
    print(
        f'OpenCV {cv2.__version__}, {options.images} images each; the last columns by OpenCV alone'
    )
    print('scene                   images/s  ratio  corners in view  found  px off  found  px off')
    for name, (board, *scene) in SCENES.items():
        pictures = photographs(board, *scene, options.images)
        view = sum(((p > 2) & (p < np.subtract(SIZE, 3))).all(axis=1).sum() for _, p in pictures)
        ours, theirs = judged(Detector(board).of, pictures), judged(of_opencv(board), pictures)
        print(
            f'{name:24}{1.0 / ours[0]:8.1f}{theirs[0] / ours[0]:7.1f}{view:17d}{ours[1]:7d}'
            f'{ours[2]:8.3f}{theirs[1]:7d}{theirs[2]:8.3f}',
            flush=True,
        )
    packed = cv2.imencode('.png', pictures[0][0])[1].ravel()
    begin = time.process_time()
    for _ in range(20):
        decoded(packed)
    print(f'decode {50.0 * (time.process_time() - begin):.1f} ms')


if __name__ == '__main__':
    main()
