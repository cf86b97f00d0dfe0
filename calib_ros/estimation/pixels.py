# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Pixels of known board points, for the solver.

The residual of a point is u_measured - u in pixels. All points of an image see the same pose, so
their rows are

    [ G T | L ]        G (2 K, 6) by the pose's twist, T (6, P) the arm, L (2 K, 9) the lens

and their products follow from those of G with [G | L | residual]: at most (6, 16) for an image,
however many points it shows. Gross errors are detected by point and by image.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib_ros.estimation.levels import MOST_OUTLIERS
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.resection import image_products
from calib_ros.estimation.samples import BLOCK, Both, Samples, cached
from calib_ros.estimation.weights import INNER
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.lens import require_lens
from calib_ros.kinematics.parameter import LENS_KINDS, parameters_of
from calib_ros.kinematics.projection import Projection, view
from calib_ros.kinematics.se3 import Flags, FloatArray, Index, norms
from calib_ros.values import LARGEST


@dataclass(frozen=True, eq=False)
class _Images:
    """A linearised block of images.

    `columns` (6 + K + 1, 2, C) are the derivatives of all points by twist and lens, the residual
    last, times robust weights; `begins` (b,) is the first point of each image, `owner` (C,) the
    image of each point, both within the block; `twist` (P, 6, b) is the pose's derivative by the
    parameters; `lens` are the numbers of the K lens parameters among the P.
    """

    part: slice
    begins: Index
    owner: Index
    columns: FloatArray
    twist: FloatArray
    lens: list[int]
    seen: Projection


class PixelSamples(Samples):
    """One set of pixels laid out for the solver; `sigma_pixel` [px] of each coordinate."""

    def __init__(self, observations: Observations, sigma_pixel: float, *_: float) -> None:
        begins = np.flatnonzero(np.diff(observations.images, prepend=-1))
        super().__init__(observations.select(begins), sigma_pixel, sigma_pixel)
        self.observations, self.count = observations, len(observations)
        self.rows = 2 * self.count
        self._pixels = np.ascontiguousarray(np.asarray(observations.pixels).T)
        self._points = np.ascontiguousarray(np.asarray(observations.points).T)
        self._images, self._begins = observations.images, begins
        self._shifts: FloatArray | None = None

    @property
    def width(self) -> int:
        """Return the number of rows of a sample."""
        return 2

    def products(
        self, chain: Chain, names: Sequence[str], count: int = 1, folds: Index | None = None
    ) -> FloatArray:
        """Return products (K, 2, P + 1, P + 1) of rows by fold (N,) (`products_of`)."""
        size = len(names)
        found = np.zeros((count, 2, size + 1, size + 1))
        for block in self.linearised(chain, names):
            inner = image_products(block.columns, block.begins, 6)
            twist = np.ascontiguousarray(block.twist.T)
            outer = inner[:, :, :6] @ twist
            own = np.array([*block.lens, size])
            fold = np.zeros(len(block.owner), np.intp) if folds is None else folds[block.part]
            for k, (matrix, _) in enumerate(found):
                images, points = fold[block.begins] == k, fold == k
                shape = 6 * np.count_nonzero(images), size  # may be zero
                turned = twist[images].reshape(shape).T
                mixed = turned @ inner[images, :, 6:].reshape(-1, len(own))
                alone = block.columns[6:, :, points].reshape(len(own), -1)
                matrix[:-1, :-1] += turned @ outer[images].reshape(shape)
                matrix[:-1, own] += mixed
                matrix[own, :-1] += mixed.T
                matrix[own[:, np.newaxis], own] += alone @ alone.T
        return found / self.sigmas[0] ** 2

    def parts(self, chain: Chain, names: Sequence[str]) -> Iterator[tuple[FloatArray, ...]]:
        """Yield the rows (P + 1, 2, C) of all points in blocks."""
        shifts = np.empty((self.count, 2, 3))
        if not self.count:  # no images of this set are gross errors
            yield (np.empty((len(names) + 1, 2, 0)),)
        for block in self.linearised(chain, names):
            for k in range(2):
                unit = np.zeros((2, len(block.owner)))
                unit[k] = self.sigmas[0]
                shifts[block.part, k] = block.seen.at_the_board(unit)
            rows = np.empty((len(names) + 1, *block.columns[0].shape))
            twist = block.twist[:, :, block.owner]
            np.einsum('psc,skc->pkc', twist, block.columns[:6], out=rows[:-1])
            rows[[*block.lens, -1]] = block.columns[6:]
            yield (rows / self.sigmas[0],)
        self._shifts = shifts

    def position_errors(self, residuals: FloatArray) -> FloatArray:
        """Return weighted residuals (rows,) as shifts at the board, (N, 3) [m].

        By the chain of the last call for rows; robust weights count as one.
        """
        assert self._shifts is not None
        return np.asarray(np.einsum('kn,nkc->nc', residuals.reshape(2, -1), self._shifts))

    def whitened_residuals(self, chain: Chain) -> tuple[FloatArray, FloatArray]:
        """Return residuals in sigma (N, 2), and NaN (N, 3) for the orientation."""
        pixels, _ = seen_residuals(chain, self.observations)
        return self.in_sigma(pixels, np.full((self.count, 3), np.nan))

    def misfits(self, chain: Chain) -> Iterator[tuple[FloatArray, Index | slice]]:
        """Yield the residuals (M, 2) of all points, then the shared ones of all images.

        Points beyond INNER times the usual residual of their image count as much as that.
        """
        found, _ = self.whitened_residuals(chain)
        yield found, slice(None)
        length = np.linalg.norm(found, axis=1, keepdims=True)
        bounded = np.minimum(1.0, INNER * np.median(length) / np.maximum(length, 1e-300))
        sums = np.add.reduceat(found * bounded, self._begins)
        yield sums / np.sqrt(np.bincount(self._images))[:, np.newaxis], self._images

    def linearised(self, chain: Chain, names: Sequence[str]) -> Iterator[_Images]:
        """Yield blocks of images with about four BLOCKs of points."""
        seen_by = self.observations
        model = ErrorModel(chain, names, seen_by.base, seen_by.tool)
        lens = require_lens(chain.frame(seen_by.camera).lens, seen_by.camera)
        own = [name for name in parameters_of(seen_by.camera, LENS_KINDS) if name in names]
        kinds, numbers = [name.kind for name in own], [names.index(name) for name in own]
        ends, total = np.append(self._begins, self.count), len(self._begins)
        few = max(4 * BLOCK * total // max(self.count, 1), 1)
        for first in range(0, total, few):
            images = slice(first, min(first + few, total))
            part = slice(*ends[[images.start, images.stop]].tolist())
            axes, origin, twist = self._arm(model, images)
            owner, points = self._images[part] - first, self._points[:, part]
            seen = view(lens, axes, origin, owner, points, seen_by.on_flange)
            columns = np.empty((7 + len(own), *seen.pixels.shape))
            seen.by_twist(columns[:6])
            lens.by_lens(seen.points, seen.pixels, kinds, columns[6:-1])
            columns[-1] = self._pixels[:, part] - seen.pixels
            if self.weights is not None:
                columns *= self.weights[part]
            begins = self._begins[images] - part.start
            yield _Images(part, begins, owner, columns, twist, numbers, seen)

    def _arm(self, model: ErrorModel, images: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return axes (3, 3, M) and origin (3, M) of the chain's end, and twists (P, 6, M)."""
        joints, velocity = self.moving(model.chain)
        approach = None if self.approach is None else self.approach[:, images]
        moving = None if velocity is None else velocity[:, images]
        axes, origin, *found = model.linearise(joints[:, images], approach, moving)
        twist = model.twists(*found)
        if self.observations.on_flange:  # in the axes of the camera, which moves the other way
            flat = twist.reshape(len(twist), 2, *axes.shape[1:])
            twist = np.einsum('kcm,pscm->pskm', axes, flat).reshape(twist.shape)
        return axes, origin, twist


@cached
def seen_residuals(chain: Chain, observations: Observations) -> Both:
    """Return measured minus predicted pixels (N, 2), and as shifts at the board (N, 3) [m].

    Clipped to LARGEST: points behind the camera or far away give meaningless values.
    """
    samples = PixelSamples(observations, 1.0)
    pixels, shifts = np.empty((samples.count, 2)), np.empty((samples.count, 3))
    for block in samples.linearised(chain, ()):
        residual = np.clip(block.columns[-1], -LARGEST, LARGEST)
        pixels[block.part], shifts[block.part] = residual.T, block.seen.at_the_board(residual)
    return pixels, np.clip(shifts, -LARGEST, LARGEST)


def in_view(chain: Chain, observations: Observations) -> Flags:
    """Tell (N,) which points a chain sees within a focal length [px] of where they are.

    Columns of others grow without bound towards the plane of the camera and behind it. All are if
    nothing was measured in pixels, or if many are not: then the chain is wrong.
    """
    if observations.pixels is None:
        return np.ones(len(observations), dtype=bool)
    lens = require_lens(chain.frame(observations.camera).lens, observations.camera)
    seen = norms(seen_residuals(chain, observations)[0]) < lens.fx
    return np.asarray(seen | (1.0 - seen.mean() > MOST_OUTLIERS))


def samples_of(
    observations: Observations, sigmas: tuple[float, float], sigma_pixel: float
) -> Samples:
    """Return observations of any kind for the solver; sigmas [m, rad] and [px]."""
    if observations.pixels is not None:
        return PixelSamples(observations, sigma_pixel)
    return Samples(observations, *sigmas)
