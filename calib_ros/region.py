# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Where a calibration may be used: where it is known to bring the arm closer, not only near.

By the posterior of the arm (`evidence.py`) its true offsets from nominal are x ~ N(m, C), those
of the calibration x^. At poses with the Jacobian A, base and tool frames projected out, the errors
are |A x| without and |A (x^ - x)| with the calibration. It makes the arm worse over these poses if

    |A (x^ - x)|^2 > |A x|^2    <=>    (A x^)^T (A x) < |A x^|^2 / 2

whose left side is normal: this *risk* is one value of the normal distribution. The calibration is
used at the poses measured if the risk there is below RISK, and further out, in shells of growing
standard deviation of the predicted position, as far as the risk in each shell is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from calib_ros.chain import FRAME_KINDS, Chain
from calib_ros.differential import ErrorModel
from calib_ros.evidence import Posterior
from calib_ros.observations import Observations
from calib_ros.se3 import FloatArray

RISK = 0.002
"""Probability at which a calibration may make the arm worse over the poses of a shell."""
DRAWN = 200
"""Random configurations that stand for the range of the joints."""
MEASURED = 100
"""Measured configurations that stand for all of them."""
SHELL = 10
"""Random configurations of a shell."""


@dataclass(frozen=True, eq=False)
class Region:
    """The joint values at which a calibration may be used.

    Attributes
    ----------
    chain : Chain
        The calibrated arm, with the effects considered.
    names : tuple of str
        Parameters, (P,) in all.
    shift : (P,)
        By how much the arm is expected to be off the calibrated one.
    covariance : (P, P)
    limit : float
        Standard deviation [m] of predicted positions up to which the calibration is used;
        infinite where it is used over the whole range of the joints.
    share : float
        Of the range of the joints in which it is used.
    base, tool : str
        Frames between which it was measured.

    """

    chain: Chain
    names: tuple[str, ...]
    shift: FloatArray
    covariance: FloatArray
    limit: float
    share: float
    base: str = 'base'
    tool: str = 'tool'

    def sigma(self, joints: FloatArray) -> FloatArray:
        """Return the expected error (N,) [m] of positions predicted at joint values (N, n).

        The root of the expected square, unmodelled effects included.
        """
        rows = ErrorModel(self.chain, self.names, self.base, self.tool).jacobian(joints)[:, :3]
        squares = np.einsum('ncp,pq,ncq->n', rows, self.covariance, rows, optimize=True)
        squares += ((rows @ self.shift) ** 2).sum(axis=1)
        return np.asarray(np.sqrt(np.maximum(squares, 0.0)))

    def covers(self, joints: FloatArray) -> NDArray[np.bool_]:
        """Tell (N,) at which joint values (N, n) the calibration may be used."""
        if np.isinf(self.limit):
            return np.ones(len(joints), dtype=bool)
        return np.asarray(self.sigma(joints) <= self.limit)


def region_of(posterior: Posterior, sets: Sequence[Observations], freedom: float) -> Region | None:
    """Return where a calibration may be used; None where not even at the poses measured.

    `freedom` are the degrees of freedom from which the noise was estimated.
    """
    first = sets[0]
    chain, names = posterior.chain, posterior.names
    whole = Region(
        chain, names, posterior.shift, posterior.covariance, np.inf, 1.0, first.base, first.tool
    )
    measured = np.concatenate([_spread(each) for each in sets])
    drawn = chain.random_joints(DRAWN, np.random.default_rng(0))
    near, far = whole.sigma(measured), whole.sigma(drawn)
    limit = float(near.max())
    order = np.argsort(far)
    inner = int(np.searchsorted(far[order], limit))
    judge = _Judge(posterior, np.concatenate([measured, drawn[order]]), first, freedom)
    within = len(measured) + inner
    if not judge.risk(0, within) < RISK:
        return None
    while within < len(measured) + DRAWN:
        further = min(within + SHELL, len(measured) + DRAWN)
        if not judge.risk(within, further) < RISK:
            break
        within = further
        limit = max(limit, float(far[order[within - len(measured) - 1]]))
    share = (within - len(measured)) / DRAWN
    return replace(whole, limit=np.inf if share == 1.0 else limit, share=share)


def _spread(observations: Observations) -> FloatArray:
    """Return joint values of some of the pairs, evenly over the session."""
    return observations.joints[:: 1 + len(observations) // MEASURED]


class _Judge:
    """Tells how probable it is that a calibration makes the arm worse at some poses."""

    def __init__(
        self, posterior: Posterior, joints: FloatArray, ends: Observations, freedom: float
    ) -> None:
        chain = posterior.chain
        own = [k for k, name in enumerate(posterior.names) if not chain.owns_frame(name)]
        frames = [f'{ends.base}.{kind}' for kind in FRAME_KINDS]
        frames += [f'{ends.tool}.{kind}' for kind in FRAME_KINDS[:3]]
        every = (*frames, *(posterior.names[k] for k in own))
        rows = ErrorModel(chain, every, ends.base, ends.tool).jacobian(joints)[:, :3]
        self._frames, self._rows = rows[:, :, : len(frames)], rows[:, :, len(frames) :]
        self._offsets = posterior.offsets[own]
        self._mean = self._offsets + posterior.shift[own]
        self._covariance = posterior.covariance[np.ix_(own, own)]
        self._freedom = freedom

    def risk(self, first: int, last: int) -> float:
        """Return it for the poses from `first` to `last`, in frames fitted to all up to there."""
        frames, rows = self._frames[:last], self._rows[:last]
        known = frames.reshape(-1, frames.shape[2])
        taken = np.linalg.lstsq(known, rows.reshape(len(known), -1), rcond=1e-9)[0]
        left = (rows[first:] - frames[first:] @ taken).reshape(-1, rows.shape[2])
        gain = left @ self._offsets
        slope = left.T @ gain
        margin = float(slope @ self._mean) - 0.5 * float(gain @ gain)
        spread = float(np.sqrt(max(float(slope @ self._covariance @ slope), 0.0)))
        if spread == 0.0:
            return 0.0 if margin > 0.0 else 1.0
        return float(special.stdtr(self._freedom, -margin / spread))
