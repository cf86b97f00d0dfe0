# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Robust least squares, and the names of gross errors (docs/model.md, Fit).

A sample's distance is the length of its residual in units of the median length of all, the larger
one of position and orientation, or of a corner and the sum over its image. Fits are repeated with
weights by distance until they converge (Holland and Welsch 1977):

    first        w = min(1, 1 / distance)                  least absolute lengths
    redescending w = 1 below INNER, 0 beyond OUTER, falling in between (Hampel 1974)
    huber        w = min(1, INNER / distance)              (Huber 1964)

Least trimmed squares finds the best half of the samples, if gross errors may agree with each
other. Half means half of every set, and slightly more: with P parameters and R equations
(1 + P / R) / 2 of the samples, which tolerates the most gross errors (Rousseeuw and Leroy 1987).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import special

from calib_ros.estimation.leastsquares import PATIENCE, STEP_TOLERANCE, Fit, System, minimise
from calib_ros.estimation.levels import ALIKE, LEAST_ASIDE, NEARER, SURE
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import (
    HALF_THE_DIGITS,
    ROUNDING,
    ROUNDS,
    Flags,
    FloatArray,
    Index,
    norms,
)

OUTLIER = 6.0
"""Distance [scale] beyond which a sample is named as an outlier, at half its weight; a convention
(Hampel 1974)."""
INNER, OUTER = OUTLIER - 1.0, OUTLIER + 1.0
"""Distances [scale] at which a sample begins to lose weight, and has none left. Of Gaussian
errors in three directions 2 of 100,000 lie beyond the first."""
MANY = 100 * SOME_POSES
"""Samples that suffice to detect gross errors (benchmarks/end_to_end.py)."""
SUSPICIOUS = 1.2
"""Ratio of actual to expected residuals at which gross errors, or errors shared by a
configuration, may hide in them; a convention, which benchmarks/outliers.py does not tell from
1.5."""
STARTS = 500  # as in FAST-LTS
BEST = 10
"""As in FAST-LTS, followed to convergence after two concentration steps from every start."""


@dataclass(frozen=True, eq=False)
class Robust:
    """A robust fit, the weighted system, and the distances (N,) of the samples of each set."""

    fit: Fit
    system: System
    distances: tuple[FloatArray, ...]
    settled: bool
    loss: str

    @property
    def inliers(self) -> tuple[Flags, ...]:
        """Return which samples (N,) of each set are no gross errors."""
        return tuple((each <= OUTLIER) | (self.loss == 'none') for each in self.distances)

    @property
    def outliers(self) -> Flags:
        """Return which samples (N,) of all sets are gross errors."""
        return ~np.concatenate(self.inliers)


def thorough_fit(chain: Chain, names: Sequence[str], system: System, loss: str) -> Robust:
    """Fit as `robust_fit`, then from the best half of the samples if that looks suspicious.

    More than MANY samples are thinned to choose between the two; all are fitted from there.
    """
    if system.count > MANY:
        few = thorough_fit(chain, names, system.spread(MANY), loss)
        return reweighted(few.fit.chain, names, system, loss, tolerance=0.1)
    first = robust_fit(chain, names, system, loss)
    suspicious = first.outliers.any() or first.fit.normal.rms(system) > SUSPICIOUS
    if loss != 'redescending' or not suspicious:
        return first
    second = reweighted(trimmed_start(chain, names, system), names, system, loss)
    sums = [trimmed_sum(robust.fit.chain, system) for robust in (first, second)]
    another = sums[0] > ALIKE**2 * sums[1]
    spare = system.rows - count_free(names, system)
    if another and chance_of_outliers(second, first.fit.chain, names, system, spare) < 1.0 - SURE:
        first = second
    return _with_explained(first, names, system)


def _with_explained(found: Robust, names: Sequence[str], system: System) -> Robust:
    """Return a fit with the samples left out, if that explains most of them at a small price.

    What the model lacks looks like gross errors at the only poses in a part of the joint range, if
    the others decide alone. Gross errors keep their residuals in any fit, or spoil the others':
    an arm that bends made these up to three times as large.
    """
    out = found.outliers
    if out.sum() < LEAST_ASIDE:
        return found
    plain = minimise(found.fit.chain, names, system)
    bounded = reweighted(plain.chain, names, system, 'huber')
    before, after = (_squares(robust.fit.chain, system) for robust in (found, bounded))
    share = max(1.0 - count_free(names, system) / system.rows, ROUNDING)
    price = np.sqrt(after[~out].sum() / max(before[~out].sum(), ROUNDING)) / share
    left = price * np.sqrt(after / np.maximum(before, ROUNDING))
    if price > 1.0 / NEARER or np.median(left[out]) > NEARER:
        return found
    nearer = np.where(out & (left < NEARER), INNER, np.inf)
    return reweighted(
        bounded.fit.chain, names, system, found.loss, np.split(nearer, _ends(system))
    )


def chance_of_outliers(
    robust: Robust, near: Chain, names: Sequence[str], system: System, spare: int
) -> float:
    """Return the probability that a fit leaves so many samples out by chance, at most.

    The F test of a shift of each of them (Cook and Weisberg 1982), times the number of ways to
    choose them, with a tail bound (Chernoff 1952), because it may underflow. The fit to all, found
    from a chain `near` it, has `spare` equations beyond those that the parameters take.
    """
    out = int(robust.outliers.sum())
    if not out:
        return 0.0
    least = minimise(near, names, system, tolerance=1e-3).normal.cost
    share = robust.fit.normal.cost / max(least, 1e-300)
    shifts = 0.5 * system.rows * out / system.count
    left = 0.5 * spare - shifts
    if left <= 0.0 or share >= left / (left + shifts):
        return 1.0
    mean = left / (left + shifts)
    ways = -special.betaln(out + 1.0, system.count - out + 1.0) - np.log(system.count + 1.0)
    tail = left * np.log(max(share, 1e-300) / mean)
    tail += shifts * np.log((1.0 - share) / (1.0 - mean))
    return float(np.exp(min(tail + ways, 0.0)))


def robust_fit(chain: Chain, names: Sequence[str], system: System, loss: str) -> Robust:
    """Fit the named parameters without gross errors."""
    fit = minimise(chain, names, system)
    distances = distances_of(fit.chain, names, system)
    if loss == 'none' or max(d.max(initial=0.0) for d in distances) < INNER:
        return Robust(fit, system, distances, True, loss)
    if trimmed_sum(chain, system) < trimmed_sum(fit.chain, system):  # misled from a good start
        fit = replace(fit, chain=chain)
        distances = distances_of(chain, names, system)
    for _ in range(ROUNDS):
        before = distances
        bounded = system.weighted([1.0 / np.maximum(d, 1.0) for d in distances])
        fit = minimise(fit.chain, names, bounded, iterations=2)
        distances = distances_of(fit.chain, names, system)
        now, then = map(np.concatenate, (distances, before))
        if np.allclose(now, then, rtol=0.1, atol=0.1):
            break
    return reweighted(fit.chain, names, system, loss)


def reweighted(
    chain: Chain,
    names: Sequence[str],
    system: System,
    loss: str,
    simpler: Sequence[FloatArray] | None = None,
    tolerance: float = 1e-3,
) -> Robust:
    """Fit with the weights of a loss, from a start that is good enough to detect gross errors.

    Fits are repeated to a `tolerance` until the weights converge: the more often they swing, the
    smaller their steps, lest they go round for ever. A sample at the edge may lose weight, come
    nearer, regain it, and so on. Weights that creep take the step of the secant. With the
    distances (N,) of all samples by a `simpler` model, samples that it explains are no gross
    errors: a richer model has to explain them too.
    """
    ends = _ends(system)

    def judged(chain: Chain) -> FloatArray:  # over all sets
        found = np.concatenate(distances_of(chain, names, system))
        return found if simpler is None else np.minimum(found, np.concatenate(simpler))

    distances = judged(chain)
    settled, swung = False, 0
    moved: FloatArray | None = None  # the last move of the weights
    due: FloatArray | None = None  # and the one that their fit asked for
    weights: FloatArray | None = None
    for _ in range(ROUNDS):
        found = weights_of(distances, loss)
        if weights is not None:
            settled = np.allclose(found, weights, rtol=0, atol=1e-4)
            if settled:
                break
            before, due = due, found - weights
            swings = moved is not None and float(due @ moved) < 0.0
            swung += swings
            share = min(1.0, PATIENCE / (swung + 1.0)) * (0.5 if swings else 1.0)
            if moved is not None and before is not None and not swings:
                rate = float((before - due) @ moved) / max(float(moved @ moved), 1e-300)
                creeps = np.abs(due).max() < 0.1 * rate < 0.1  # near where the secant leads
                share /= rate if creeps else 1.0
            moved = np.clip(weights + share * due, 0.0, 1.0) - weights
            found = weights + moved
        weights = found
        system = system.weighted(np.split(weights, ends))
        fit = minimise(chain, names, system, tolerance)
        chain = fit.chain
        distances = judged(chain)
        if not fit.converged:
            break
    if not (settled and fit.next_step_rms < STEP_TOLERANCE):
        fit = minimise(chain, names, system)
    return Robust(fit, system, tuple(np.split(distances, ends)), settled, loss)


def weights_of(distance: FloatArray, loss: str) -> FloatArray:
    """Return the weights (N,) of samples at distances (N,)."""
    if loss == 'none':
        return np.ones(len(distance))
    if loss == 'huber':
        return np.minimum(1.0, INNER / np.maximum(distance, 1e-12))
    return np.clip((OUTER - distance) / (OUTER - INNER), 0.0, 1.0)


def distances_of(chain: Chain, names: Sequence[str], system: System) -> tuple[FloatArray, ...]:
    """Return the distance (N,) of every sample, set by set."""
    share = max(1.0 - len(names) / system.rows, 0.1)  # residuals are shorter than errors
    found = []
    for samples in system.sets:
        largest = np.zeros(samples.count)
        for part, row in samples.misfits(chain):
            length = norms(part) / np.sqrt(share)
            known = ~np.isnan(length)
            if known.any():
                usual = np.sqrt(special.chdtri(part.shape[1], 0.5))  # median of standard normals
                scale = np.median(length[known]) / usual
                size = np.where(known, length, 0.0) / max(scale, STEP_TOLERANCE)  # else rounding
                largest = np.maximum(largest, size[row])
        found.append(largest)
    return tuple(found)


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
    sets = np.split(_squares(chain, system), _ends(system))
    return float(sum(np.sort(each)[: (len(each) + 1) // 2].sum() for each in sets))


def _ends(system: System) -> Index:
    """Return where the samples of all sets but the last end."""
    return np.cumsum([samples.count for samples in system.sets])[:-1]


def _squares(chain: Chain, system: System) -> FloatArray:
    """Return the squared residuals (N,) of the samples of all sets, in sigma."""
    found = []
    for samples in system.sets:
        parts = [np.nan_to_num(part) for part in samples.whitened_residuals(chain)]
        found.append(sum((part**2).sum(axis=1) for part in parts))
    return np.concatenate(found)


def count_free(names: Sequence[str], system: System) -> int:
    """Return the number of parameters without a prior."""
    known = {} if system.prior is None else system.prior.sigmas
    return sum(name not in known for name in names)


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
    return float(count_free(names, system) / rows)


class _Halves:
    """Samples of each set to draw and to keep; masks are (S, N) over all sets."""

    def __init__(self, system: System, need: float) -> None:
        ends = np.cumsum([0, *(samples.count for samples in system.sets)]).tolist()
        self.parts = [slice(first, last) for first, last in pairwise(ends)]
        self._groups = [samples.observations.configurations for samples in system.sets]
        self._sizes = [int(np.ceil(0.5 * (1.0 + need) * s.count)) for s in system.sets]

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
        for part, size in zip(self.parts, self._sizes, strict=True):
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
