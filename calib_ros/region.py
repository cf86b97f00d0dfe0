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
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from calib_ros.chain import FRAME_KINDS
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
KNOWN = 1e9
"""Degrees of freedom that are as good as infinite."""
SHELL = 10
"""Random configurations of a shell."""


@dataclass(frozen=True, eq=False)
class Region:
    """The joint values at which a calibration may be used.

    Attributes
    ----------
    posterior : Posterior
        What is known of the arm.
    limit : float
        Standard deviation [m] of predicted positions up to which the calibration is used;
        infinite where it is used over the whole range of the joints.
    share : float
        Of the range of the joints in which it is used.
    base, tool : str
        Frames between which it was measured.

    """

    posterior: Posterior
    limit: float
    share: float
    base: str = 'base'
    tool: str = 'tool'

    def sigma(self, joints: FloatArray) -> FloatArray:
        """Return the expected error (N,) [m] of positions predicted at joint values (N, n)."""
        known = self.posterior
        rows = ErrorModel(known.chain, known.names, self.base, self.tool).jacobian(joints)[:, :3]
        return _length(rows, known.square)

    def covers(self, joints: FloatArray) -> NDArray[np.bool_]:
        """Tell (N,) at which joint values (N, n) the calibration may be used."""
        if np.isinf(self.limit):
            return np.ones(len(joints), dtype=bool)
        return np.asarray(self.sigma(joints) <= self.limit)


def region_of(posterior: Posterior, sets: Sequence[Observations], freedom: float) -> Region | None:
    """Return where a calibration may be used; None where not even at the poses measured.

    `freedom` are the degrees of freedom from which the noise was estimated.
    """
    ends = sets[0]
    measured = np.concatenate([_spread(each) for each in sets])
    drawn = posterior.chain.random_joints(DRAWN, np.random.default_rng(0))
    judge = _Judge(posterior, np.concatenate([measured, drawn]), ends, freedom)
    near, far = np.split(judge.sigma, [len(measured)])
    limit = float(near.max())
    order = np.argsort(far)
    inner = [*range(len(measured)), *(len(measured) + order[far[order] <= limit]).tolist()]
    if not judge.risk(inner, inner) < RISK:
        return None
    shells = len(measured) + order[far[order] > limit]
    for first in range(0, len(shells), SHELL):
        shell = shells[first : first + SHELL].tolist()
        if not judge.risk(shell, inner + shell) < RISK:
            break
        inner += shell
        limit = float(judge.sigma[shell[-1]])
    share = float(np.mean(far <= limit))
    return Region(posterior, np.inf if share == 1.0 else limit, share, ends.base, ends.tool)


def _length(rows: FloatArray, square: FloatArray) -> FloatArray:
    """Return the roots (N,) of the expected squared lengths of J x, J (N, 3, P)."""
    flat = rows.reshape(-1, rows.shape[2])
    squares = ((flat @ square) * flat).sum(axis=1).reshape(-1, 3).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)))


def _spread(observations: Observations) -> FloatArray:
    """Return joint values of some of the pairs, evenly over the session."""
    return observations.joints[:: 1 + len(observations) // MEASURED]


class _Judge:
    """Tells how probable it is that a calibration makes the arm worse at some poses."""

    def __init__(
        self, posterior: Posterior, joints: FloatArray, ends: Observations, freedom: float
    ) -> None:
        chain, names = posterior.chain, posterior.names
        frames = [f'{ends.base}.{kind}' for kind in FRAME_KINDS]
        frames += [f'{ends.tool}.{kind}' for kind in FRAME_KINDS[:3]]
        every = list(dict.fromkeys([*frames, *names]))
        rows = ErrorModel(chain, every, ends.base, ends.tool).jacobian(joints)[:, :3]
        column = {name: k for k, name in enumerate(every)}
        own = [k for k, name in enumerate(names) if not chain.owns_frame(name)]
        self.sigma = _length(rows[:, :, [column[name] for name in names]], posterior.square)
        self._frames = rows[:, :, : len(frames)]
        self._rows = rows[:, :, [column[names[k]] for k in own]]
        self._offsets = posterior.offsets[own]
        mean, covariance = posterior.doubted
        self._mean, self._covariance = mean[own], covariance[np.ix_(own, own)]
        self._freedom = freedom

    def risk(self, which: Sequence[int], around: Sequence[int]) -> float:
        """Return it for some poses, in frames fitted to those around."""
        frames, rows = self._frames[around], self._rows[around]
        known = frames.reshape(-1, frames.shape[2])
        taken = np.linalg.lstsq(known, rows.reshape(len(known), -1), rcond=1e-9)[0]
        left = (self._rows[which] - self._frames[which] @ taken).reshape(-1, rows.shape[2])
        gain = left @ self._offsets
        slope = left.T @ gain
        margin = float(slope @ self._mean) - 0.5 * float(gain @ gain)
        spread = float(np.sqrt(max(float(slope @ self._covariance @ slope), 0.0)))
        if spread == 0.0:
            return 0.0 if margin > 0.0 else 1.0
        return float(special.stdtr(min(self._freedom, KNOWN), -margin / spread))
