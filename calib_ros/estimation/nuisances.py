# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors that are considered, not fitted: unmodelled effects and device errors.

Possible effects of an arm and the scale of the device are columns of the posterior with their own
sizes (`evidence.py`). Smooth device errors and rounded joint values have known sizes s. Their
columns N are eliminated from the products of the other columns A: A^T A becomes
A^T A - A^T N (N^T N + s^-2)^-1 N^T A, as if V = 1 + s^2 N N^T were the covariance of the
measurements (Schmidt 1966). docs/model.md (Sizes of errors) gives the reasons.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy import linalg

from calib_ros.estimation.distortion import STRAINS, bends, strains
from calib_ros.estimation.joint_errors import NOTHING, Unmodelled, axis_parameters
from calib_ros.estimation.normal import products_of
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.samples import gram
from calib_ros.estimation.system import System
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray


@dataclass(frozen=True, eq=False)
class Nuisances:
    """What else may move the measurements, each with a standard deviation.

    Parameters by `sizes` that something else moves too, all `lengths` together with the scale of
    the device, smooth errors of the device if `by_device`, and `unmodelled` waves beside what the
    parameters follow of them; if `kept`, waves are no nuisances but parameters, in units of their
    size. So are strains of the device if `strained`.
    """

    sizes: Mapping[str, float] = field(default_factory=dict)
    lengths: Mapping[str, float] = field(default_factory=dict)
    by_device: bool = False
    unmodelled: Unmodelled = NOTHING
    kept: bool = False
    strained: bool = False


class NuisanceProducts(NamedTuple):
    """Products of columns and residual (Q, Q), and with K doubtful columns (Q, K) and (K, K).

    The columns are those of the parameters, of waves if kept, of the device's strains if it may be
    strained, of its scale if there are lengths, and of the residual. Doubtful ones are scaled by
    their standard deviations; their own products have 1 added.
    """

    plain: FloatArray
    cross: FloatArray
    doubtful: FloatArray

    @property
    def reduced(self) -> FloatArray:
        """Return the products (Q, Q) without what the doubtful columns explain."""
        taken = linalg.solve(self.doubtful, self.cross.T, assume_a='pos')
        return np.asarray(self.plain - self.cross @ taken)


def nuisance_products(
    chain: Chain,
    names: Sequence[str],
    system: System,
    nuisances: Nuisances,
    noise: float = 1.0,
    most: int = 10 * SOME_POSES,
) -> NuisanceProducts:
    """Return the products of a system, in units of `noise` [sigma given], without priors.

    Larger systems are thinned to `most` samples.
    """
    waves = axis_parameters(chain) if nuisances.unmodelled.waves else ()
    columns = list(dict.fromkeys([*names, *nuisances.lengths, *waves]))
    stride = -(-system.count // most)
    few = system.spread(most)
    products = stride * _products(chain, columns, few, nuisances)
    own, count = len(columns) + 1, len(names)
    every = np.eye(len(products))
    row = {str(name): k for k, name in enumerate(columns)}

    def scaled(sizes: Mapping[str, float]) -> FloatArray:
        return every[:, [row[str(name)] for name in sizes]] * [*sizes.values()]

    grown = scaled(nuisances.lengths).sum(axis=1, keepdims=True)[:, : len(nuisances.lengths)]
    waved = own + _waves(chain, nuisances)
    bent = waved + len(STRAINS) * nuisances.strained
    arm, _, left, wobble, strain, smooth = np.split(every, [count, own - 1, own, waved, bent], 1)
    end = wobble.shape[1] * nuisances.kept
    kept = np.column_stack([arm, wobble[:, :end], strain, grown, left])
    mixing = np.column_stack([kept, scaled(nuisances.sizes), wobble[:, end:], smooth])
    first, rest = np.s_[: kept.shape[1]], np.s_[kept.shape[1] :]
    bars = np.column_stack(system.separation_rows(chain, columns)) @ mixing[:own]
    if any(not (each.observations.socket or each.observations.plane) for each in system.sets):
        bars[:, kept.shape[1] - 1 - grown.shape[1] : kept.shape[1] - 1] = 0.0  # true lengths
    mixed = (mixing.T @ products @ mixing + bars.T @ bars) / noise**2
    doubtful = mixed[rest, rest]
    return NuisanceProducts(
        mixed[first, first], mixed[first, rest], doubtful + np.eye(len(doubtful))
    )


def _waves(chain: Chain, nuisances: Nuisances) -> int:
    return 8 * len(chain.joints) if nuisances.unmodelled.waves else 0


def _products(
    chain: Chain, columns: Sequence[str], system: System, nuisances: Nuisances
) -> FloatArray:
    """Return products of columns, residual, waves and smooth device errors."""
    unmodelled = nuisances.unmodelled
    none = [np.zeros((0, samples.width, samples.count)) for samples in system.sets]
    fields = bends(system.sets) if nuisances.by_device else none
    if nuisances.strained:
        pairs = zip(strains(system.sets), fields, strict=True)
        fields = [np.concatenate(pair) for pair in pairs]
    waves = _waves(chain, nuisances)
    if not (any(map(len, fields)) or waves):
        return np.asarray(products_of(chain, columns, system)[0].sum(axis=0))
    found = np.zeros((len(columns) + len(fields[0]) + waves + 1,) * 2)
    for samples, bend in zip(system.sets, fields, strict=True):
        first = 0
        for parts in samples.parts(chain, columns):
            block = slice(first, first := first + parts[0].shape[2])
            joints = samples.observations.joints[block]
            for number, rows in enumerate(parts):
                more = [unmodelled.columns(chain, columns, joints, rows)[-waves:]] if waves else []
                bent = [bend[:, :, block]] if number == 0 else []  # distortion does not turn
                products = gram(np.concatenate([rows, *more, *bent]))
                found[: len(products), : len(products)] += products
    return found
