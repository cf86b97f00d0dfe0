# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which parameters a set of poses determines, and how well.

Works on the triangular factor R of the weighted Jacobian (R^T R = J^T W J), not on the normal
matrix, which squares the condition number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from calib_ros.estimation.arbitrary import A_POSE, drawn
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.sizes import TYPICAL
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import FRAME_KINDS, Parameter
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, ROUNDING, FloatArray
from calib_ros.settings import EXCEPTION

DEGENERATE = TYPICAL['angle']
"""Extents below this share of the largest count as zero: of board points, or of the rest of a
frame's column after those before it. Orientations that vary by less than an arm's own angle
errors would put a tool anywhere, even kilometres away."""


def independent(
    factor: FloatArray, names: Sequence[str], tolerance: FloatArray | float = HALF_THE_DIGITS
) -> tuple[str, ...]:
    """Return the parameters whose columns are independent of those before them.

    `factor` (R, P) is the upper triangular factor of the weighted Jacobian, columns in the order
    of the names: of parameters that trade off against each other, the last are left out and stay
    nominal. At least the share `tolerance` (P,) of a column must be left by those before it, and
    of the largest column more than rounding.
    """
    sizes = np.linalg.norm(factor, axis=0)
    least = np.maximum(tolerance * sizes, ROUNDING * sizes.max(initial=0.0))  # less shows nowhere
    if len(factor) == len(names) and (np.abs(np.diag(factor)) > least).all():
        return tuple(names)  # the diagonal holds the rest of each column
    basis = np.zeros(factor.shape)
    kept: list[str] = []
    for name, column, short in zip(names, factor.T, least.tolist(), strict=True):
        known = basis[:, : len(kept)]
        rest = column - known @ (known.T @ column)
        rest -= known @ (known.T @ rest)  # again: Gram-Schmidt loses orthogonality
        size = math.sqrt(rest @ rest)
        if size > short:
            basis[:, len(kept)] = rest / size
            kept.append(name)
    return tuple(kept)


def excited(factor: FloatArray, names: Sequence[str]) -> tuple[str, ...]:
    """Return the parameters that measured poses determine, by their factor R (P, P)."""
    frames = [Parameter(name).kind in FRAME_KINDS for name in names]
    return independent(factor, names, np.where(frames, DEGENERATE, HALF_THE_DIGITS))


def structurally_independent(
    chain: Chain,
    names: Sequence[str],
    sets: Sequence[Observations] = (A_POSE,),
    extra: Callable[[Chain, Sequence[str]], tuple[FloatArray, FloatArray]] | None = None,
) -> tuple[str, ...]:
    """Return the parameters that many arbitrary poses would determine, measured as in the sets.

    The others are gauge freedoms of the chain, not a lack of measurements. Frames that are not
    fixed get arbitrary places, because a tool of length zero hides rotations. A complete and
    minimal model of an arm with R revolute and P prismatic joints has 4 R + 2 P + 6 parameters by
    full pose (Everett, Driels and Mooring 1987). A target in a socket is in one place in all
    poses: turning the whole cell about it only shows in residuals. So does the size of a cell that
    touches only planes, and turning the cell about a point seen from the flange. A board gives its
    pose in a camera, and images from anywhere give the camera's lens (Zhang 2000). `extra` returns
    further equations at a chain.

    Parameters of which those before them leave little come last: with a known tool near the last
    axis a turn would else imitate a length, and end far away; the height of a SCARA's tool would
    take the place of its elbow's zero if pi has five digits in its URDF.
    """
    anywhere, rows = drawn(chain, names, sets)
    if extra is not None:
        rows.append(extra(anywhere, names)[0])
    return independent_in(rows, names)


def independent_in(rows: Sequence[FloatArray], names: Sequence[str]) -> tuple[str, ...]:
    """Return the parameters that rows (R, P) at arbitrary poses determine."""
    lens = [k for k, name in enumerate(names) if Parameter(name).of_lens]
    every = [*map(_compact, rows), np.eye(len(names))[lens]]
    first = np.asarray(np.linalg.qr(np.concatenate(every), mode='r'))
    least = [DEGENERATE if Parameter(n).kind in FRAME_KINDS else EXCEPTION for n in names]
    strong = independent(first, names, np.array(least))
    order = sorted(range(len(names)), key=lambda k: names[k] not in strong)
    factor = np.asarray(np.linalg.qr(first[:, order], mode='r'))
    found = independent(factor, [names[k] for k in order])
    return tuple(name for name in names if name in found)


def _compact(rows: FloatArray) -> FloatArray:
    """Return R (K, P) of rows (R, P) of any unit, of which some columns are zero."""
    used = np.flatnonzero(rows.any(axis=0))
    factor = np.zeros((min(len(rows), len(used)), rows.shape[1]))
    factor[:, used] = np.linalg.qr(rows[:, used], mode='r')
    return factor / (np.abs(factor).max(initial=0.0) or 1.0)
