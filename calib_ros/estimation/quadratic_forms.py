# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Quadratic forms of residuals and their moments, from which sizes of errors are estimated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from scipy import linalg
from scipy.sparse import csr_array

from calib_ros.estimation.samples import gram
from calib_ros.estimation.stops import Stops
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, ROUNDING, FloatArray

PartRows: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Orthonormal columns (n, c, P), residuals and which are known (n, c), and products (P, P)."""


class QuadraticForms:
    """Quadratic forms of residuals, and their moments.

    Columns with equal priors may be combined at will. Combinations of those `alike` that hardly
    anything but their prior tells are left out: waves of a joint that turns little are many.
    """

    def __init__(
        self, units: Stops, extra: FloatArray, alike: Sequence[Sequence[int]] = ()
    ) -> None:
        self._units = units
        width = extra.shape[1]
        rows = [part.reshape(width + 1, -1).T for part in units.parts]
        stacked = np.concatenate([*rows, np.pad(extra, ((0, 0), (0, 1)))])
        untold, rest = list[int](), len(stacked) - len(extra)
        for own in alike:
            sizes, turned = linalg.eigh(gram(stacked[:rest, own].T))
            stacked[:, own] = stacked[:, own] @ turned
            told = HALF_THE_DIGITS * float(extra[:, own[0]] @ extra[:, own[0]])
            untold += own[: int(np.searchsorted(sizes, told))]
        basis = np.delete(stacked[:, :-1], untold, axis=1)
        basis = linalg.qr(basis, mode='economic', overwrite_a=True, check_finite=False)[0]
        left = stacked[:, -1] - basis @ (basis.T @ stacked[:, -1])
        self.parts: dict[int, PartRows] = {}
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
