# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An arm with errors, and tables of what was measured of it."""

import csv

import numpy as np

from calib_ros.apply import simulation
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.se3 import to_quat
from calib_ros.texts import csv_text, dump_yaml

UR = load_chain('ur5e')
CELL = simulation.Cell()
TRUE = simulation.faulty(UR, CELL, np.random.default_rng(11))
TRAIN, TEST = 30, 10
FIGURES = {'rms_mm', 'mean_mm', 'max_mm', 'rms_mrad'}


def measured(chain=TRUE, count=TRAIN + TEST, seed=5, oriented=True):
    rng = np.random.default_rng(seed)
    joints = chain.random_joints(count, rng)
    return simulation.measure(chain, joints, rng, 5e-5, 2e-4, oriented)


def rows_of(observations, held_out=TEST):
    rows, oriented = [], observations.oriented.all()
    quats = to_quat(observations.rotations).tolist() if oriented else []
    for k in range(len(observations)):
        row = {'split': 'test' if k >= len(observations) - held_out else 'train'}
        row |= {f'q{i + 1}': value for i, value in enumerate(observations.joints[k].tolist())}
        row |= dict(zip('xyz', observations.positions[k].tolist(), strict=True))
        if oriented:
            row |= dict(zip(('qx', 'qy', 'qz', 'qw'), quats[k], strict=True))
        rows.append(row)
    return rows


def write_csv(path, rows):
    with path.open('w', newline='') as file:
        writer = csv.DictWriter(file, dict.fromkeys(name for row in rows for name in row))
        writer.writeheader()
        writer.writerows(rows)
    return path


def write_images(folder, seen, lens, square):
    """Write tables of images of a board of 7 x 5 squares [m]: corners, places, board, camera."""
    board = {'type': 'charuco', 'columns': 7, 'rows': 5, 'square': square, 'marker': 0.7 * square}
    (folder / 'board.yaml').write_text(dump_yaml(board | {'dictionary': 'DICT_5X5_250'}))
    fx, fy, cx, cy, *bent = lens.values.values()
    matrix = {'k': [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], 'd': bent}
    (folder / 'camera.yaml').write_text(dump_yaml(matrix))
    pairs = zip(seen.images.tolist(), seen.pixels.tolist(), strict=True)
    rows = [(f'{image}.png', n % 24, u, v) for n, (image, (u, v)) in enumerate(pairs)]
    (folder / 'corners.csv').write_text(csv_text([('image', 'corner', 'u', 'v'), *rows]))
    write_places(folder / 'places.csv', seen.joints[::24])


def write_places(path, joints):
    """Write the joint values (K, n) of the images."""
    rows = [(f'{k}.png', *row) for k, row in enumerate(joints.tolist())]
    path.write_text(csv_text([('image', *(f'q{k + 1}' for k in range(joints.shape[1]))), *rows]))


def bent(places, size, rng):
    """Return places (N, 3) [m] as a device sees them that is off by so much (RMS)."""
    x = (places - places.mean(axis=0)) / np.sqrt(places.var(axis=0).sum())
    powers = [x[:, i] * x[:, k] for i in range(3) for k in range(i, 3)]
    powers += [x[:, i] ** 2 * x[:, k] for i in range(3) for k in range(3)]
    error = np.array(powers).T @ rng.normal(size=(len(powers), 3))
    return places + size * error / np.sqrt((error**2).sum(axis=1).mean())
