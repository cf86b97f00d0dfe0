# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Does the arm imitate a move of a frame or zero? By the evidence for its errors (`sizes.py`).

If the poses before a move and those after it lie apart, the arm's parameters explain it and leave
no residual, but with offsets much larger than those of this arm without the move.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.gain import about_nominal, inverse_root
from calib_ros.estimation.identifiability import DEGENERATE
from calib_ros.estimation.levels import CLEARLY, NEARER, SURE
from calib_ros.estimation.posterior import size_group
from calib_ros.estimation.sizes import TYPICAL, Evidence
from calib_ros.kinematics.se3 import ROUNDING, FloatArray

LEAST = float(special.logit(SURE))
"""Log odds, for as many possible moves as there are, from which one is named."""


def clear_size(root: FloatArray, along: FloatArray, lengths: FloatArray) -> FloatArray:
    """Return the size (K,) of a move by (K, D) and (D,), without directions that hardly show.

    `root` is that of `inverse_root` by squared `lengths` (K,). Where only errors of the arm tell a
    move from one of another frame, as of a height on a SCARA, its size there means nothing.
    """
    hidden = np.linalg.norm(np.sqrt(lengths)[:, np.newaxis] * root, axis=0)
    return np.asarray(root @ np.where(hidden * CLEARLY * DEGENERATE < 1.0, along, 0.0))


class Imitation:
    """The arm's fit without a move, by products (P, P + 1) of its columns with all and residual.

    `names` are those of the columns: the fitted ones, then some held at nominal.
    """

    def __init__(self, fitted: Fitted, names: Sequence[str], products: FloatArray) -> None:
        chain, known = fitted.chain, fitted.problem.given
        self._groups = [None if n in known else size_group(chain, n) for n in names]
        self._given = np.array([known.get(name, np.inf) for name in names]) ** -2.0
        self._names = np.array(names)
        self._frames = np.array([chain.owns_frame(name) for name in names])
        self._offsets = np.append(fitted.offsets, np.zeros(len(names) - len(fitted.names)))
        noise = fitted.noise  # beside too large a sigma of positions, that of orientations counts
        turned = 0.0 if noise.position > 1.0 else noise.orientation or 0.0
        self._variance = max(fitted.size, turned, ROUNDING) ** 2
        self._matrix, self._vector = about_nominal(products / self._variance, self._offsets)
        typical = np.array([TYPICAL[g] if g else np.inf for g in self._groups])
        matrix = self._matrix + np.diag(self._given + typical**-2.0)
        self._root = inverse_root(matrix, np.diag(matrix))
        self._fit = self._root.T @ self._vector

    def gains(self, products: FloatArray, own: FloatArray) -> FloatArray:
        """Return half the squares (B,) that moves spare an arm with errors of the usual sizes.

        By products (B, K, P + 1) of their columns with the others, and (B, K, K) with each other.
        """
        cross, vector = about_nominal(products / self._variance, self._offsets)
        along = cross @ self._root
        whole = own / self._variance + TYPICAL['frame'] ** -2.0 * np.eye(own.shape[-1])
        left = whole - along @ np.swapaxes(along, 1, 2)
        root = inverse_root(left, np.diagonal(whole, axis1=1, axis2=2))
        spared = np.einsum('bkj,bk->bj', root, vector - along @ self._fit)
        return np.asarray(0.5 * (spared**2).sum(axis=1))

    def move_odds(self, products: FloatArray, own: FloatArray) -> tuple[float, FloatArray]:
        """Return the log odds of one move, and its size (K,); by products without B.

        Nothing speaks for a move that leaves the arm nearly as it is.
        """
        cross, vector = about_nominal(products / self._variance, self._offsets)
        matrix = np.block([[self._matrix, cross.T], [cross, own / self._variance]])
        given = np.append(self._given, np.zeros(len(cross)))
        groups = [*self._groups, *['frame'] * len(cross)]
        still = Evidence(self._matrix, self._vector, self._given, self._groups, TYPICAL)
        moved = Evidence(matrix, np.append(self._vector, vector), given, groups, TYPICAL)
        odds, mean, _ = moved.odds_against(still, still.most_probable(set())[0], set())
        found, size = np.split(mean, [len(self._offsets)])
        return (odds if self.far_from(found) else -np.inf), size

    def far_from(self, true: FloatArray) -> bool:
        """Tell whether the fit is hardly nearer than nominal to an arm of such offsets (P,)."""
        off, far = (self._distance(each) for each in (self._offsets - true, true))
        return off > NEARER * far

    def drifts_far(self, name: str, size: float) -> bool:
        """Tell whether a zero that drifts so far from that fitted, or back, leaves it so.

        Of frames alone a nominal arm is fitted: it corrects nothing.
        """
        ends = (self._offsets + way * size * (self._names == name) for way in (1.0, -1.0))
        return bool(self._offsets[~self._frames].any()) and any(map(self.far_from, ends))

    def _distance(self, offsets: FloatArray) -> float:
        """Return the RMS effect of offsets (P,), in the best frames, but for a factor."""
        arm, frames = ~self._frames, self._frames
        placed = self._matrix[np.ix_(frames, frames)]
        moved = self._matrix[:, arm] @ offsets[arm]
        along = inverse_root(placed, np.diag(placed)).T @ moved[frames]
        return float(np.sqrt(max(offsets[arm] @ moved[arm] - along @ along, 0.0)))
