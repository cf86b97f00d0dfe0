# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The pose of a flat board in each image, from its points alone (PnP).

A homography from the board to the undistorted image, linear in its nine entries, gives a first
pose (Zhang 2000), refined by Gauss-Newton steps on the pixels. A small or distant board looks much
the same when turned to the other side of the line of sight (Oberkampf et al. 1996), so that pose
is refined as well, and the one with smaller residuals is returned.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_ros.errors import InputError
from calib_ros.estimation.configurations import group_means
from calib_ros.estimation.identifiability import DEGENERATE
from calib_ros.estimation.levels import NEARER
from calib_ros.estimation.observations import Observations
from calib_ros.kinematics import se3
from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.newton import NormalBatch, minimise_batch
from calib_ros.kinematics.projection import Projection, view
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, Flags, FloatArray, Index


def board_poses(observations: Observations, lens: Lens) -> Observations:
    """Return pixels as poses, one for each image that determines one.

    Raises InputError if no image shows enough points, or half of those that do fit no pose of the
    board.
    """
    usable = _solvable_images(observations)
    if not usable.any():
        raise InputError(
            'no image shows 4 board points that are not in line: the camera cannot be located'
        )
    rows = observations.select(usable[observations.images])
    poses, rms = resect(rows, lens)
    _require_fit(rows, rms)
    first = np.flatnonzero(np.diff(rows.images, prepend=-1))
    seen = replace(
        replace(rows, pixels=None, points=None, on_flange=False).select(first),
        positions=poses[:, :3, 3],
        rotations=poses[:, :3, :3],
        oriented=np.ones(len(first), dtype=bool),
    )
    return seen.inverted() if observations.on_flange else seen


def _require_fit(observations: Observations, rms: FloatArray) -> None:
    """Raise unless poses of the board explain the points in most images."""
    index, pixels = observations.images, np.asarray(observations.pixels)
    beside_the_centre = pixels - group_means(pixels, index)[index]
    spread = np.sqrt(group_means((beside_the_centre**2).sum(axis=1), index))
    beside = ~(rms < NEARER * spread)
    if 2 * beside.sum() > len(rms):
        raise InputError(
            f'the corners do not fit the board in {beside.sum()} of {len(rms)} images: check the '
            'columns and rows of the board, the numbers of its corners, and the lens'
        )


def uncertainty(observations: Observations, poses: FloatArray, lens: Lens) -> FloatArray:
    """Return the covariances (M, 6, 6) of board poses (M, 4, 4), for noise of 1 px.

    Of x, y, z [m] and the rotation about the camera's axes [rad], to first order.
    """
    index = observations.images
    rows = np.empty((6, 2, len(index)))
    _seen(lens, poses, index, np.asarray(observations.points).T).by_twist(rows)
    begins = np.flatnonzero(np.diff(index, prepend=-1))
    return np.asarray(np.linalg.inv(image_products(rows, begins)))


def _seen(lens: Lens, poses: FloatArray, index: Index, points: FloatArray) -> Projection:
    """Return the view of points (3, C) at board poses (M, 4, 4)."""
    axes, origin = poses[:, :3, :3].transpose(2, 1, 0), poses[:, :3, 3].T
    return view(lens, axes, origin, index, points, False)


def image_products(rows: FloatArray, begins: Index, first: int | None = None) -> FloatArray:
    """Return products (M, F, S) of the first F rows (S, 2, C) with all, image by image."""
    size, _, count = rows.shape
    points = np.diff(begins, append=count)
    most = int(points.max())
    full = np.zeros((size, 2, len(points), most))
    full[:, :, np.arange(most) < points[:, np.newaxis]] = rows
    parts = full.transpose(1, 2, 0, 3)
    return np.asarray((parts[:, :, :first] @ parts.swapaxes(2, 3)).sum(axis=0))


def resect(observations: Observations, lens: Lens) -> tuple[FloatArray, FloatArray]:
    """Return the poses (M, 4, 4) of the board in the camera, and RMS residuals (M,) [px]."""
    points, pixels = map(np.asarray, (observations.points, observations.pixels))
    index, centre = observations.images, points.mean(axis=0)
    _, size, axes = np.linalg.svd(points - centre, full_matrices=False)
    if size[2] > DEGENERATE * size[0]:
        raise InputError(
            'the points of a board must be in a plane: give each face of a body as a board of '
            'its own'
        )
    axes[2] = np.cross(axes[0], axes[1])
    plane = (points - centre) @ axes.T
    start = _from_homography(plane[:, :2], lens.rays(pixels), index)
    local = plane.T * [[1.0], [1.0], [0.0]]
    best, rms = _refined(start, local, pixels, index, lens)
    mirrored, normal = best.copy(), best[:, :3, 2]
    sight = best[:, :3, 3] / np.linalg.norm(best[:, :3, 3], axis=1, keepdims=True)
    # half a turn about the normal, then one about the line of sight
    halves = [2.0 * v[:, :, np.newaxis] * v[:, np.newaxis] - np.eye(3) for v in (sight, normal)]
    mirrored[:, :3, :3] = halves[0] @ halves[1] @ best[:, :3, :3]
    other, others = _refined(mirrored, local, pixels, index, lens)
    poses = np.where((others < rms)[:, np.newaxis, np.newaxis], other, best)
    board = se3.transform(axes.T, centre)  # T_board_plane
    return poses @ se3.invert(board), np.minimum(rms, others)


def _solvable_images(observations: Observations) -> Flags:
    """Return which images (M,) show enough points, not in line on board or image."""
    index = observations.images
    usable = np.bincount(index) >= 4
    for places in map(np.asarray, (observations.points, observations.pixels)):
        rest = places - group_means(places, index)[index]
        squares = group_means(rest[:, :, np.newaxis] * rest[:, np.newaxis], index)
        spread = np.linalg.eigvalsh(squares)
        usable &= spread[:, -2] > DEGENERATE**2 * spread[:, -1]
    return np.asarray(usable)


def _from_homography(plane: FloatArray, rays: FloatArray, index: Index) -> FloatArray:
    """Return poses (M, 4, 4) from points (N, 2) [m] of the plane and rays (N, 2)."""
    begins = np.flatnonzero(np.diff(index, prepend=-1))
    scale = np.sqrt((plane**2).sum(axis=1).mean())
    centre = group_means(rays, index)
    near = rays - centre[index]
    size = np.sqrt(group_means((near**2).sum(axis=1, keepdims=True), index))
    near = near / size[index]
    point = np.ones((3, len(plane)))
    point[:2] = plane.T / scale
    rows = np.zeros((9, 2, len(plane)))
    rows[:3, 0] = rows[3:6, 1] = point
    rows[6:] = -near.T * point[:, np.newaxis]
    _, vectors = np.linalg.eigh(image_products(rows, begins))
    matrix = vectors[:, :, 0].reshape(-1, 3, 3)
    back = np.zeros((len(begins), 3, 3))
    back[:, 0, 0] = back[:, 1, 1] = size[:, 0]
    back[:, :2, 2], back[:, 2, 2] = centre, 1.0
    matrix = back @ matrix @ np.diag([1.0 / scale, 1.0 / scale, 1.0])
    matrix *= np.sign(matrix[:, 2, 2])[:, np.newaxis, np.newaxis]  # in front of the camera
    length = np.linalg.norm(matrix[:, :, :2], axis=1).mean(axis=1)
    matrix /= np.maximum(length, 1e-300)[:, np.newaxis, np.newaxis]
    place = matrix[:, :, 2].copy()
    matrix[:, :, 2] = np.cross(matrix[:, :, 0], matrix[:, :, 1])
    return se3.transform(se3.nearest_rotation(matrix), place)


def _refined(
    poses: FloatArray, points: FloatArray, pixels: FloatArray, index: Index, lens: Lens
) -> tuple[FloatArray, FloatArray]:
    """Return poses (M, 4, 4) refined on the pixels (N, 2), and RMS residuals (M,) [px]."""
    count = np.bincount(index)

    def linearise(poses: FloatArray, which: Index) -> NormalBatch:
        moving = np.zeros(len(count), dtype=bool)
        moving[which] = True
        these = np.flatnonzero(moving[index])
        owner = (np.cumsum(moving) - 1)[index[these]]
        seen = _seen(lens, poses.transpose(2, 0, 1), owner, points[:, these])
        rows = np.empty((7, *seen.pixels.shape))
        seen.by_twist(rows[:6])
        rows[6] = pixels[these].T - seen.pixels
        found = image_products(rows, np.cumsum(count[which]) - count[which]).transpose(1, 2, 0)
        return NormalBatch(found[:6, :6], found[:6, 6], found[6, 6])

    def move(poses: FloatArray, step: FloatArray) -> FloatArray:
        moved = poses.copy()
        moved[:3, 3] += step[:3]
        turn = se3.exp_rotation(step[3:].T).transpose(1, 2, 0)
        moved[:3, :3] = np.einsum('ijb,jkb->ikb', turn, poses[:3, :3])
        return moved

    found = minimise_batch(linearise, poses.transpose(1, 2, 0), move, fall=HALF_THE_DIGITS)
    return found.x.transpose(2, 0, 1), np.sqrt(found.cost / count)
