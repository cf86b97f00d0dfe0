# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors shared by neighbouring poses.

A tracker drifts, and model errors change slowly over the joint space, so neighbours have similar
errors and carry less information than their number. Configurations are neighbours in succession or
in joint space. Residuals r of white noise of unit variance have the covariance B = I - Q Q^T (Q:
orthonormal columns of the Jacobian), so a quadratic form r^T A r has

    mean tr(A B)        covariance with r^T C r: 2 tr(A B C B)

With A the links of neighbours, r^T A r / r^T r is tested against its mean (Moran's I of residuals,
Cliff and Ord 1972; for successive ones that of Durbin and Watson 1950). If the test finds similar
neighbours, the noise is modelled as a sum of independent and fading parts,

    V = v_0 I + sum_k v_k K_k        K_k = exp(-distance / length_k)

where the sizes v_k >= 0 equate the forms r^T K_k r with their expected values (MINQUE, Rao 1971),
which allows for errors absorbed by the fit. The covariance of the parameters is then
H^-1 (J^T V J) H^-1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy import linalg, special
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from calib_ros.estimation.leastsquares import Fit, System
from calib_ros.estimation.levels import CERTAIN, SEVERAL, TELLING
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.samples import gram
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, ROUNDING, FloatArray, Index, cos_sin
from calib_ros.values import LARGEST

DECAYS = {'successive': (1.0, 3.0, 10.0, 30.0, 100.0), 'near': (0.3, 1.0, 3.0)}
"""Decay lengths of shared errors: stops, and rad (m) of all joints together."""
NEARBY = SEVERAL
"""Neighbours in joint space tested per configuration; benchmarks/drift.py --quick does not tell
them from 1."""
MOST_STOPS = 2 * SOME_POSES
"""Stops used to estimate sizes; of more, every k-th run of a twentieth."""
ELSEWHERE = 4.0 * LARGEST
"""Distance between stops of different sets, which are no neighbours."""


@dataclass(frozen=True, eq=False)
class Shared:
    """Correlation of neighbours, and the noise by parts if they share errors.

    `successive` and `near` are the larger correlation of residuals of both parts, `found` the
    kinds of neighbours with shared errors by the test, `middles` J^T V J (P, P) of each part (0
    position, 1 orientation) with shared errors.
    """

    successive: float
    near: float
    found: tuple[str, ...]
    middles: dict[int, FloatArray]


@dataclass(frozen=True, eq=False)
class Stops:
    """Rows of stops, summed over the samples of each.

    `parts` are (P + 1, c, n), by position and orientation, zero if not measured; `count` (n,)
    samples per stop; `place` (n, D) in joint space, angles on the unit circle, and `time` (n,) the
    stop number; both far apart between sets; `joints` (n, J) their joint values.
    """

    parts: list[FloatArray]
    count: FloatArray
    place: FloatArray
    time: FloatArray
    joints: FloatArray

    def __len__(self) -> int:
        return len(self.count)

    def links(self, kind: str) -> csr_array:
        """Return (n, n): 1 for neighbours."""
        count = len(self)
        if kind == 'successive':
            first = np.flatnonzero(np.diff(self.time) == 1.0)
            second = first + 1
        else:
            far, nearest = cKDTree(self.place).query(self.place, k=NEARBY + 1)
            first, second = np.repeat(np.arange(count), NEARBY + 1), nearest.ravel()
            good = (first != second) & (far.ravel() < ELSEWHERE / 2)
            first, second = first[good], second[good]
        ends = (np.append(first, second), np.append(second, first))
        links = csr_array((np.ones(2 * len(first)), ends), shape=(count, count))
        links.data[:] = 1.0
        return links

    def kernel(self, kind: str, length: float) -> FloatArray:
        """Return (n, n): covariance of the sums over each stop, per root of count."""
        root = np.sqrt(self.count)
        return np.asarray(np.outer(root, root) * np.exp(-self._apart[kind] / length))

    @cached_property
    def _apart(self) -> dict[str, FloatArray]:  # (n, n) by kind
        places = {'successive': self.time[:, np.newaxis], 'near': self.place}
        return {kind: cdist(place, place) for kind, place in places.items()}


def shared_errors(fit: Fit, names: Sequence[str], system: System) -> Shared:
    """Return which neighbours share errors, and the resulting noise."""
    kinds = tuple(DECAYS)
    few, share = gathered(fit.chain, names, system, MOST_STOPS)
    correlations = dict.fromkeys(kinds, 0.0)
    if len(few) < TELLING:
        return Shared(**correlations, found=(), middles={})
    extra, _ = system.extra_rows(fit.chain, names)
    forms = _Forms(few, extra)
    limit = special.ndtri(1.0 - (1.0 - CERTAIN) / (len(kinds) * len(forms.parts)))
    alike: dict[int, list[str]] = {}
    for kind in kinds:
        links = few.links(kind)
        for part in forms.parts:
            correlation, score = forms.test(part, links)
            correlations[kind] = max(correlations[kind], correlation)
            if score > limit:
                alike.setdefault(part, []).append(kind)
    if not alike:
        return Shared(**correlations, found=(), middles={})
    kernels = {
        part: [(kind, length) for kind in kinds if kind in found for length in DECAYS[kind]]
        for part, found in alike.items()
    }
    sizes = forms.sizes(kernels)
    alike = {part: found for part, found in alike.items() if sizes[part].any()}
    even = few if share == 1 else _gather(fit.chain, names, system, share, 1)
    middles: dict[int, FloatArray] = {}
    by_kind: dict[str, dict[int, list[tuple[float, float]]]] = {kind: {} for kind in kinds}
    for part in alike:
        white, *rest = sizes[part]
        middles[part] = white * fit.normal.parts[part]
        for (kind, length), size in zip(kernels[part], rest, strict=True):
            if size:
                by_kind[kind].setdefault(part, []).append((length, size))
    for part, own in by_kind['near'].items():
        middles[part] += _near(even, part, own, share)
    for part, middle in _successive(fit.chain, names, system, by_kind['successive']).items():
        middles[part] += middle
    found = tuple(kind for kind in kinds if any(kind in each for each in alike.values()))
    return Shared(**correlations, found=found, middles=middles)


_Part: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Orthonormal columns (n, c, P), residuals and which are known (n, c), and products (P, P)."""


class _Forms:
    """Quadratic forms of residuals, and their moments."""

    def __init__(self, units: Stops, extra: FloatArray) -> None:
        self._units = units
        width = extra.shape[1]
        rows = [part.reshape(width + 1, -1).T for part in units.parts]
        stacked = np.concatenate([*rows, np.pad(extra, ((0, 0), (0, 1)))])
        basis = linalg.qr(stacked[:, :-1], mode='economic', check_finite=False)[0]
        left = stacked[:, -1] - basis @ (basis.T @ stacked[:, -1])
        self.parts: dict[int, _Part] = {}
        first = 0
        for part, each in enumerate(units.parts):
            shape = each.shape[1:]
            block = slice(first, first + shape[0] * shape[1])
            first = block.stop
            if not each.any():
                continue
            turned = basis[block].reshape(*shape, -1).transpose(1, 0, 2)
            self.parts[part] = (
                np.ascontiguousarray(turned),
                left[block].reshape(shape).T,
                each.any(axis=0).T.astype(float),
                gram(basis[block].T),
            )

    def _moments(self, matrices: Mapping[int, FloatArray]) -> FloatArray:
        """Return the traces (F, F) tr(A B C B) of forms with matrices (K, n, n) by part."""
        inner, alone = list[FloatArray](), list[FloatArray]()
        for part, own in matrices.items():
            (basis, _, known, _), count = self.parts[part], len(own)
            crossed, traces = np.zeros((count, basis.shape[2] ** 2)), np.zeros((count, count))
            for seen in np.unique(known, axis=1).T:
                alike = (known == seen[:, np.newaxis]).all(axis=0)
                both = own * np.outer(seen, seen)
                more, common = _crossed(basis[:, alike], own, both)
                crossed += more.reshape(count, -1)
                traces += alike.sum() * gram(both) - 2.0 * common
            inner.append(crossed)
            alone.append(traces)
        return np.asarray(gram(np.concatenate(inner)) + linalg.block_diag(*alone))

    def _values(self, matrices: Mapping[int, FloatArray]) -> FloatArray:
        """Return the forms (F,) r^T A r."""
        pairs = [(self.parts[part][1], own) for part, own in matrices.items()]
        return np.concatenate([(r * (own @ r)).sum(axis=(1, 2)) for r, own in pairs])

    def test(self, part: int, links: csr_array) -> tuple[float, float]:
        """Return the excess correlation of linked residuals and its score, N(0, 1) for none."""
        basis, residual, known, white = self.parts[part]
        product = (links @ basis.reshape(len(basis), -1)).reshape(basis.shape)
        product *= known[:, :, np.newaxis]
        linked = basis.reshape(-1, len(white)).T @ product.reshape(-1, len(white))
        pairs = float((known * (links @ known)).sum())
        size = float((residual**2).sum())
        freedom = float(known.sum() - np.trace(white))
        if not (size > 0.0 and pairs > 0.0 and freedom > 1.5):  # one alone has a constant ratio
            return 0.0, 0.0
        ratio = -float(np.trace(linked)) / freedom
        both = float((linked**2).sum() + pairs - 2.0 * (product**2).sum())
        mixed = float((linked * white).sum() - 2.0 * (product * basis).sum())
        alone = float((white**2).sum() + known.sum() - 2.0 * (basis**2).sum())
        variance = 2.0 * max(both - 2.0 * ratio * mixed + ratio**2 * alone, 1e-300)
        excess = float((residual * (links @ residual)).sum()) * freedom / size - ratio * freedom
        return excess / pairs, excess / float(np.sqrt(variance))

    def sizes(self, kernels: dict[int, list[tuple[str, float]]]) -> dict[int, FloatArray]:
        """Return, by part, the sizes (1 + K,) of the independent part and each kernel."""
        white = np.eye(len(self._units))
        every = dict.fromkeys(kernel for own in kernels.values() for kernel in own)
        known = {kernel: self._units.kernel(*kernel) for kernel in every}
        matrices = {
            part: np.array([white, *(known[kernel] for kernel in kernels.get(part, ()))])
            for part in self.parts
        }
        sizes = nonnegative(self._moments(matrices), self._values(matrices))
        ends = np.cumsum([len(own) for own in matrices.values()])[:-1]
        return dict(zip(self.parts, np.split(sizes, ends), strict=True))


def nonnegative(moments: FloatArray, values: FloatArray) -> FloatArray:
    """Return the sizes (F,) >= 0 that equate forms with their values (F,), by moments (F, F)."""
    from scipy import optimize  # slow to import, rarely needed

    scale = np.sqrt(np.maximum(np.diag(moments), HALF_THE_DIGITS))
    scaled = moments / np.outer(scale, scale)
    # weighted by the covariance of the forms under white noise; those without spread, if hardly
    # more was measured than fitted, carry no information
    squares, directions = linalg.eigh(scaled)
    informative = squares > HALF_THE_DIGITS * squares[-1]
    roots, directions = np.sqrt(squares[informative]), directions[:, informative]
    along = (values / scale) @ directions / roots
    sizes = optimize.nnls(roots[:, np.newaxis] * directions.T, along)[0]
    return np.asarray(sizes / scale)


def _crossed(
    basis: FloatArray, own: FloatArray, both: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return Q^T A Q (K, P, P) of columns Q (n, c, P), and the traces (K, K) tr(A C Q Q^T).

    Of matrices A (K, n, n), the first of which is the identity, and, for the traces, those between
    the rows that were measured.
    """
    columns, rows = basis.reshape(len(basis), -1), basis.reshape(-1, basis.shape[2])
    if columns.shape[1] <= len(columns):
        spread = both @ columns
        return rows.T @ spread.reshape(-1, *rows.shape), gram(spread)
    crossed = [each.T @ each for each in (rows, *(_rooted(basis, each) for each in own[1:]))]
    spread = both @ (columns @ columns.T)
    return np.array(crossed), spread.reshape(len(both), -1) @ both.reshape(len(both), -1).T


def _rooted(basis: FloatArray, matrix: FloatArray) -> FloatArray:
    """Return C^T Q (n c, P) of columns Q (n, c, P), with C C^T the positive matrix (n, n)."""
    size = len(matrix)
    root = np.linalg.cholesky(matrix + ROUNDING * np.diag(np.diag(matrix)))
    turned = linalg.blas.dtrmm(1.0, root.T, basis.reshape(size, -1).T, side=1, trans_a=1)
    return np.asarray(turned.T.reshape(-1, basis.shape[2]))


def gathered(chain: Chain, names: Sequence[str], system: System, most: int) -> tuple[Stops, int]:
    """Return the stops of all sets, or of every k-th run of `most` / 20 if there are more; k."""
    total = sum(int(samples.observations.stops[-1]) + 1 for samples in system.sets)
    share = max(1, -(-total // most))
    return _gather(chain, names, system, share, most // 20), share


def _gather(chain: Chain, names: Sequence[str], system: System, share: int, run: int) -> Stops:
    """Return the stops of all sets; of many, every `share`-th run of `run` stops."""
    widths = (max(samples.width for samples in system.sets), 3)
    parts: list[list[FloatArray]] = [[], []]
    counts, places, times, joints = [], [], [], []
    circular = np.array([joint.type == 'revolute' for joint in chain.joints])
    for number, samples in enumerate(system.sets):
        numbers = samples.observations.stops
        chosen = numbers // run % share == 0
        if samples.weights is not None:
            chosen &= samples.weights > 0.0
        if not chosen.any():
            continue
        few, numbers = samples.select(chosen), numbers[chosen]
        begins = np.flatnonzero(np.diff(numbers, prepend=-1))
        count = np.diff([*begins, len(numbers)]).astype(float)
        for part, width in zip(parts, widths, strict=True):
            part.append(np.zeros((len(names) + 1, width, len(begins))))
        for index, block in few.sums(chain, names, numbers):
            first = int(np.searchsorted(numbers[begins], index[0]))  # one stop may span blocks
            stops = slice(first, first + len(index))
            for (*_, rows), added in zip(parts, block, strict=False):  # one part if whitened
                rows[:, : added.shape[1], stops] += added / np.sqrt(count[stops])
        q = few.observations.joints[begins]
        turned = [*cos_sin(q[:, circular]), q[:, ~circular]]
        places.append(np.column_stack([*turned, np.full(len(q), ELSEWHERE * number)]))
        times.append(numbers[begins] + ELSEWHERE * number)
        joints.append(q)
        counts.append(count)
    if not counts:
        return Stops([], np.zeros(0), *np.zeros((3, 0, 0)))
    return Stops(
        [np.concatenate(part, axis=2) for part in parts],
        *(np.concatenate(each) for each in (counts, places, times, joints)),
    )


def _near(
    units: Stops, part: int, kernels: Sequence[tuple[float, float]], share: int
) -> FloatArray:
    """Return J^T K J of errors fading in joint space, for (length, size) each.

    By every `share`-th stop: pairs are many.
    """
    kernel = sum(size * units.kernel('near', length) for length, size in kernels)
    own = np.diag(kernel) * (share - share**2)
    kernel = share**2 * kernel + np.diag(own)
    rows = units.parts[part][:-1]
    return np.asarray(np.einsum('pcn,rcn->pr', rows @ kernel, rows, optimize=True))


def _successive(
    chain: Chain,
    names: Sequence[str],
    system: System,
    kernels: Mapping[int, Sequence[tuple[float, float]]],
) -> dict[int, FloatArray]:
    """Return by part J^T K J of errors fading in succession, for (length, size) each."""
    found = {part: np.zeros((len(names), len(names))) for part in kernels}
    for samples in system.sets if kernels else ():
        past, last = dict[int, FloatArray](), 0
        for numbers, sums in samples.sums(chain, names, samples.observations.stops):
            for part in kernels.keys() & range(len(sums)):
                rows, own = sums[part][:-1], kernels[part]
                products, past[part] = _fading(rows, numbers - last, own, past.get(part))
                found[part] += products
            last = int(numbers[-1])
    return found


def _fading(
    rows: FloatArray,
    time: Index,
    kernels: Sequence[tuple[float, float]],
    before: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Return J^T K J of rows (P, c, n) of stops at times (n,), and their faded sums (P c, K).

    Runs of stops are multiplied with a root of the sum of K kernels, and with what is left of all
    stops before: their sums, `before` those at time zero.
    """
    lengths, sizes = np.transpose(kernels)
    flat, last = rows.reshape(-1, len(time)), 0
    past = [np.zeros((len(flat), len(sizes))) if before is None else before]
    turned, here = np.empty_like(flat), []
    for first in range(0, len(time), SOME_POSES // 4):
        run = np.s_[first : first + SOME_POSES // 4]
        then, own = time[run, np.newaxis], flat[:, run]
        fade = np.exp(-np.abs(then - time[run])[..., np.newaxis] / lengths)
        turned[:, run] = own @ np.linalg.cholesky(fade @ sizes)
        here.append(own @ (np.exp((last - then) / lengths) * sizes))
        past.append(past[-1] * np.exp((last - then[-1]) / lengths) + own @ fade[-1])
        last = int(then[-1, 0])
    one, other = (np.concatenate(x, axis=1).reshape(len(rows), -1) for x in (here, past[:-1]))
    cross = one @ other.T
    return gram(turned.reshape(len(rows), -1)) + cross + cross.T, past[-1]
