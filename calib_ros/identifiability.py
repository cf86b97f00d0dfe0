# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which parameters a set of poses determines, and how well.

Works on the triangular factor R of the weighted Jacobian (R^T R = J^T W J), never on the normal
matrix, which squares the condition number.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import linalg

from calib_ros.chain import FRAME_KINDS, Chain
from calib_ros.differential import ErrorModel
from calib_ros.se3 import FloatArray

RANK_TOLERANCE = 1e-8
"""A column is dependent when less than this share of it is left after the columns before it."""


def independent(factor: FloatArray, names: Sequence[str]) -> tuple[str, ...]:
    """Return the parameters whose columns are independent of those before them.

    The order of the names is their priority: of the parameters that trade against each other,
    the last ones are left out (and so stay nominal). With the frames first, theirs are fitted.

    Parameters
    ----------
    factor : (P, P)
        Upper triangular factor of the weighted Jacobian, columns in the order of the names.
    names : sequence of str
        Parameters, the most wanted first.

    """
    basis = np.zeros((len(factor), 0))
    kept = []
    for name, column in zip(names, factor.T, strict=True):
        rest = column - basis @ (basis.T @ column)
        rest -= basis @ (basis.T @ rest)  # once more: Gram-Schmidt loses orthogonality
        size = float(np.linalg.norm(rest))
        if size > RANK_TOLERANCE * float(np.linalg.norm(column)) and size > 0.0:
            basis = np.column_stack([basis, rest / size])
            kept.append(name)
    return tuple(kept)


def structurally_independent(
    chain: Chain, names: Sequence[str], oriented: bool
) -> tuple[str, ...]:
    """Return the parameters that a large number of arbitrary poses would determine.

    What is left out is a gauge freedom of the chain, not a lack of measurements. Frames that are
    not fixed are taken anywhere, because a tool of length zero hides rotations. A complete and
    minimal model of an arm with R revolute and P prismatic joints has 4 R + 2 P + 6 parameters
    by full pose (Everett, Driels and Mooring 1987).
    """
    rng = np.random.default_rng(0)
    joints = chain.random_joints(100, rng)
    anywhere = chain.with_offsets(
        {
            f'{key}.{kind}': rng.uniform(0.1, 0.5)
            for key in ('base', 'tool')
            if not chain.frame(key).fixed
            for kind in FRAME_KINDS
        }
    )
    jacobian = ErrorModel(anywhere, names).jacobian(joints)
    rows: FloatArray = jacobian[:, : 6 if oriented else 3].reshape(-1, len(names))
    factor: FloatArray = np.asarray(linalg.qr(rows, mode='r')[0], dtype=float)[: len(names)]
    return independent(factor, names)


def covariance(factor: FloatArray) -> FloatArray:
    """Return the covariance (P, P) of the parameters from R, for weights in units of sigma.

    For Gaussian noise this is the Cramer-Rao bound.
    """
    scale = 1.0 / np.linalg.norm(factor, axis=0)
    inverse = linalg.solve_triangular(factor * scale, np.eye(len(factor)))
    return np.asarray(np.outer(scale, scale) * (inverse @ inverse.T))
