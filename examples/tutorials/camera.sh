#!/bin/sh
# From docs/tutorials/camera.md, by extract.py.
set -e
calib_ros board charuco --columns 7 --rows 5 --square 0.03 --marker 0.022 --out board.pdf
python3 - <<'END'
import csv
from pathlib import Path

import numpy as np
from calib_ros import load_chain
from calib_ros.apply.camera import Camera, before_camera, photograph
from calib_ros.apply.simulation import Cell, faulty
from calib_ros.files.boards import read_board

rng = np.random.default_rng(5)
camera, board = Camera(), read_board(Path('board.yaml'))
arm = faulty(load_chain('ur10e'), Cell(), rng)
true = before_camera(arm, camera, board.corners, True, rng)
seen = photograph(true, camera, board.corners, True, 30, rng, noise=0.1)
with (
    open('corners.csv', 'w', newline='') as corners,
    open('places.csv', 'w', newline='') as places,
):
    found, where = csv.writer(corners), csv.writer(places)
    found.writerow(['image', 'corner', 'u', 'v'])
    where.writerow(['image', *(f'q{k}' for k in range(1, 7))])
    for image in range(30):
        rows = np.flatnonzero(np.arange(len(seen)) // len(board.corners) == image)
        where.writerow([f'{image}.png', *seen.joints[rows[0]]])
        for corner, row in enumerate(rows):
            found.writerow([f'{image}.png', corner, *seen.pixels[row]])
lens = camera.lens
matrix = [lens.fx, 0, lens.cx, 0, lens.fy, lens.cy, 0, 0, 1]
Path('camera.yaml').write_text(
    f'image_width: {camera.width}\nimage_height: {camera.height}\n'
    f'camera_matrix: {{rows: 3, cols: 3, data: {matrix}}}\n'
    'distortion_model: plumb_bob\n'
    'distortion_coefficients: {rows: 1, cols: 5, '
    f'data: [{lens.k1}, {lens.k2}, {lens.p1}, {lens.p2}, {lens.k3}]}}\n'
)
END
calib_ros identify --chain ur10e --detections corners.csv --board board.yaml \
    --places places.csv --intrinsics camera.yaml --eye-in-hand --sigma-pixel 0.1 --out result
