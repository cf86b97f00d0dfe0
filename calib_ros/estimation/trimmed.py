# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Least trimmed squares: the best half of the samples, if gross errors may agree with each other.

Half means half of every set, and slightly more: with P parameters and R equations (1 + P / R) / 2
of the samples, which tolerates the most gross errors (Rousseeuw and Leroy 1987).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.system import System
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, ROUNDS, Flags, FloatArray

STARTS = 500  # as in FAST-LTS
BEST = 10
"""As in FAST-LTS, followed to convergence after two concentration steps from every start."""


def trimmed_start(chain: Chain, names: Sequence[str], system: System) -> Chain:
    """Return the chain fitted to the best half of the samples, found from `chain`.

    Weights of the samples are ignored. A system without spare equations returns `chain`.
    """
    few = _thinned(system)
    need = _need(names, few)
    if need >= 1.0:
        return chain
    halves = _Halves(few, need)
    masks = halves.draw(need)
    linear = _Linear(chain, names, few)
    for _ in range(2):
        masks, sums = halves.concentrate(linear.squares(masks))
    masks = masks[np.argsort(sums)[:BEST]]
    half = masks[0]
    for _ in range(ROUNDS):
        for _ in range(ROUNDS):
            before = masks
            masks, sums = halves.concentrate(linear.squares(masks))
            if np.array_equal(masks, before):
                break
        last, half = half, masks[np.argmin(sums)]
        best = few.weighted([half[part].astype(float) for part in halves.parts])
        chain = minimise(chain, names, best, tolerance=1e-3).chain
        if np.array_equal(half, last):
            break
        linear = _Linear(chain, names, few)
    return chain


def trimmed_sum(chain: Chain, system: System) -> float:
    """Return the sum of the shorter half of the squared residuals of every set, in sigma."""
    sets = np.split(squared_residuals(chain, system), system.ends)
    return float(sum(np.sort(each)[: (len(each) + 1) // 2].sum() for each in sets))


def most_left_out(names: Sequence[str], system: System) -> int:
    """Return how many samples the best half leaves out, all parameters being without priors."""
    halves = _Halves(system, min(_need(names, system), 1.0))
    return sum(samples.count for samples in system.sets) - sum(halves.sizes)


def squared_residuals(chain: Chain, system: System) -> FloatArray:
    """Return the squared residuals (N,) of the samples of all sets, in sigma."""
    sets = (map(np.nan_to_num, samples.whitened_residuals(chain)) for samples in system.sets)
    return np.concatenate([sum((part**2).sum(axis=1) for part in parts) for parts in sets])


def _thinned(system: System) -> System:
    """Return SOME_POSES samples evenly spread, at least a tenth of them from each set."""
    most = SOME_POSES // min(len(system.sets), 10)
    return system.select([np.arange(0, s.count, -(-s.count // most)) for s in system.sets])


def _need(names: Sequence[str], system: System) -> float:
    """Return parameters without a prior per equation, with one sample per configuration."""
    rows = sum(
        samples.rows / samples.count * (samples.observations.configurations.max() + 1)
        for samples in system.sets
    )
    return float(system.count_free(names) / rows)


class _Halves:
    """Samples of each set to draw and to keep; masks are (S, N) over all sets."""

    def __init__(self, system: System, need: float) -> None:
        ends = np.cumsum([0, *(samples.count for samples in system.sets)]).tolist()
        self.parts = [slice(first, last) for first, last in pairwise(ends)]
        self._groups = [samples.observations.configurations for samples in system.sets]
        self.sizes = [int(np.ceil(0.5 * (1.0 + need) * s.count)) for s in system.sets]

    def draw(self, need: float) -> Flags:
        """Return seeded starts: of every set half the configurations that all parameters need.

        Fewer make a start without gross errors likelier; priors resolve ties.
        """
        rng = np.random.default_rng(0)
        masks = []
        for group in self._groups:
            count = int(group.max()) + 1
            rank = np.argsort(rng.random((STARTS, count)), axis=1)
            masks.append((rank < np.ceil(0.5 * need * count))[:, group])
        return np.concatenate(masks, axis=1)

    def concentrate(self, squares: FloatArray) -> tuple[Flags, FloatArray]:
        """Return the samples with the shortest residuals, and the sums (S,) of their squares."""
        masks = np.zeros(squares.shape, dtype=bool)
        for part, size in zip(self.parts, self.sizes, strict=True):
            index = np.argpartition(squares[:, part], size - 1, axis=1)[:, :size]
            np.put_along_axis(masks[:, part], index, True, axis=1)
        return masks, (squares * masks).sum(axis=1)


class _Linear:
    """The model linearised at a chain, for fits to many masks (S, N) at once."""

    def __init__(self, chain: Chain, names: Sequence[str], system: System) -> None:
        parts = system.rows_of(chain, names)
        width = max(part.shape[1] for part in parts)
        rows = np.concatenate(
            [np.pad(part, ((0, 0), (0, width - part.shape[1]), (0, 0))) for part in parts], axis=2
        ).transpose(2, 1, 0)
        columns, self._residual = rows[..., :-1], np.ascontiguousarray(rows[..., -1])
        extra, offset = system.extra_rows(chain, names)
        size = np.sqrt((columns**2).sum(axis=(0, 1)) + (extra**2).sum(axis=0))
        scale = 1.0 / np.where(size > 0.0, size, 1.0)
        self._columns, extra = np.ascontiguousarray(columns * scale), extra * scale
        self._matrices = np.einsum('ncp,ncq->npq', self._columns, self._columns, optimize=True)
        self._gradients = np.einsum('ncp,nc->np', self._columns, self._residual)
        self._matrix = extra.T @ extra + HALF_THE_DIGITS * np.eye(len(names))
        self._gradient = extra.T @ offset

    def squares(self, masks: Flags) -> FloatArray:
        """Return the squared residuals (S, N) of all samples after a fit to each mask."""
        count, width, size = self._columns.shape
        chosen = masks.astype(float)
        matrices = (chosen @ self._matrices.reshape(count, -1)).reshape(-1, size, size)
        gradients = chosen @ self._gradients + self._gradient
        steps = np.linalg.solve(matrices + self._matrix, gradients[..., np.newaxis])[..., 0]
        left = self._residual.ravel() - steps @ self._columns.reshape(-1, size).T
        return np.asarray((left.reshape(-1, count, width) ** 2).sum(axis=2))
