# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors that fade between stops: their products with the Jacobian."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.samples import gram
from calib_ros.estimation.stops import Stops
from calib_ros.estimation.system import System
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray, Index

DECAYS = {'successive': (1.0, 3.0, 10.0, 30.0, 100.0), 'near': (0.3, 1.0, 3.0)}
"""Decay lengths of shared errors: stops, and rad (m) of all joints together."""


def faded_near(
    units: Stops, part: int, kernels: Sequence[tuple[float, float]], stride: int
) -> FloatArray:
    """Return J^T K J of errors fading in joint space, for (length, size) each.

    By every `stride`-th stop: pairs are many.
    """
    kernel = sum(size * units.kernel('near', length) for length, size in kernels)
    own = np.diag(kernel) * (stride - stride**2)
    kernel = stride**2 * kernel + np.diag(own)
    rows = units.parts[part][:-1]
    flat = rows.reshape(-1, len(kernel)) @ kernel
    return flat.reshape(len(rows), -1) @ rows.reshape(len(rows), -1).T


def faded_in_succession(
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
