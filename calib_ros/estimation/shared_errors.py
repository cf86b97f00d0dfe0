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

If the device drifts (`drifting.py`), expected errors of the arm take the sizes from it instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy import special

from calib_ros.estimation.drifting import DRIFT_KERNELS, device_drift, together
from calib_ros.estimation.fading import DECAYS, faded_in_succession, faded_near
from calib_ros.estimation.leastsquares import Fit
from calib_ros.estimation.levels import CERTAIN, TELLING
from calib_ros.estimation.quadratic_forms import QuadraticForms
from calib_ros.estimation.stops import MOST_STOPS, Stops, gather, gathered
from calib_ros.estimation.system import System
from calib_ros.estimation.visits import numbered
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray


@dataclass(frozen=True, eq=False)
class Shared:
    """Correlation of neighbours, and the noise by parts if they share errors.

    `successive` and `near` are the larger correlation of residuals of both parts, `found` the
    kinds of neighbours with shared errors by the test, `middles` J^T V J (P, P) of each part (0
    position, 1 orientation) with shared errors; `drifting` those of the parts whose errors are a
    drift of the device, and `together` how many positions then tell as much of the noise as one.
    """

    successive: float
    near: float
    found: tuple[str, ...]
    middles: dict[int, FloatArray]
    drifting: dict[int, FloatArray] = field(default_factory=dict)
    together: float = 1.0


def shared_errors(fit: Fit, names: Sequence[str], system: System) -> Shared:
    """Return which neighbours share errors, and the resulting noise."""
    kinds = tuple(DECAYS)
    few, stride = gathered(fit.chain, names, system, MOST_STOPS)
    correlations = dict.fromkeys(kinds, 0.0)
    if len(few) < TELLING:
        return Shared(**correlations, found=(), middles={}, drifting={}, together=1.0)
    extra, _ = system.extra_rows(fit.chain, names)
    forms = QuadraticForms(few, extra, _alike(fit.chain, names, extra))
    limit = special.ndtri(1.0 - (1.0 - CERTAIN) / (len(kinds) * len(forms.parts)))
    alike: dict[int, list[str]] = {}
    drifts: dict[int, FloatArray] = {}
    placed = any(samples.observations.socket for samples in system.sets)  # without a device
    for kind in kinds:
        links = few.links(kind)
        for part in forms.parts:
            correlation, score = forms.test(part, links)
            correlations[kind] = max(correlations[kind], correlation)
            if score > limit:
                alike.setdefault(part, []).append(kind)
            if kind == 'successive' and score > 1.0 and not placed:  # by chance one of six
                drift = device_drift(forms.parts[part], few)
                drifts |= {} if drift is None else {part: drift}
    if not (alike or drifts):
        return Shared(**correlations, found=(), middles={}, drifting={}, together=1.0)
    kernels = {
        part: [(kind, length) for kind in kinds if kind in found for length in DECAYS[kind]]
        for part, found in alike.items()
    }
    sizes = forms.sizes(kernels) if alike else {}
    sizes = {part: sizes[part] for part in alike if sizes[part].any()}
    even = few if stride == 1 else gather(fit.chain, names, system, stride, 1)
    squared = partial(_products, fit, names, system, even, stride)
    middles = squared(sizes, kernels)
    drifting = squared(drifts, dict.fromkeys(drifts, DRIFT_KERNELS))
    found = tuple(kind for kind in kinds if any(kind in alike[part] for part in sizes))
    lengths = [int(samples.observations.stops[-1]) + 1 for samples in system.sets]
    alone = together(few, lengths, drifts[0]) if 0 in drifts else 1.0
    return Shared(**correlations, found=found, middles=middles, drifting=drifting, together=alone)


def _products(
    fit: Fit,
    names: Sequence[str],
    system: System,
    even: Stops,
    stride: int,
    sizes: Mapping[int, FloatArray],
    kernels: Mapping[int, Sequence[tuple[str, float]]],
) -> dict[int, FloatArray]:
    """Return J^T V J (P, P) by part, with sizes (1 + K,) of independent errors and of kernels.

    Those near in joint space by `even` stops, every `stride`-th.
    """
    by_kind: dict[str, dict[int, list[tuple[float, float]]]] = {kind: {} for kind in DECAYS}
    for part, (_, *own) in sizes.items():
        for (kind, length), size in zip(kernels[part], own, strict=True):
            if size:
                by_kind[kind].setdefault(part, []).append((length, size))
    found = {part: own[0] * fit.normal.parts[part] for part, own in sizes.items()}
    for part, near in by_kind['near'].items():
        found[part] += faded_near(even, part, near, stride)
    successive = faded_in_succession(fit.chain, names, system, by_kind['successive'])
    for part, middle in successive.items():
        found[part] += middle
    return found


def _alike(chain: Chain, names: Sequence[str], extra: FloatArray) -> list[list[int]]:
    """Return the columns of the effects of one joint with one prior, by the rows (R, P) of all."""
    effects, found = {name for name, _ in chain.effects}, dict[tuple[str, float], list[int]]()
    for k, (name, column) in enumerate(zip(names, extra.T, strict=True)):
        if name in effects and column.any():
            found.setdefault((Parameter(name).owner, float(column.max())), []).append(k)
    return [*found.values()]


def squares_of(chain: Chain, system: System) -> FloatArray:
    """Return by part (4, 2) sums and counts of squared residuals, alone and over configurations.

    If pairs of a configuration, of any targets, share no error, squares of their sums add up to
    the same.
    """
    found = np.zeros((4, 2))
    sums, counts, joint_sums, joint_counts = found  # views
    shared: dict[tuple[int, str, int], FloatArray] = {}
    every = numbered([samples.observations for samples in system.sets])
    count = 1 + max(int(numbers.max(initial=-1)) for numbers in every)
    for samples, numbers in zip(system.sets, every, strict=True):
        seen = samples.observations
        for k, part in enumerate(samples.whitened_residuals(chain)):
            known = np.flatnonzero(~np.isnan(part[:, 0]))
            roots = np.ones(len(known)) if samples.weights is None else samples.weights[known]
            weighted = roots * part.take(known, axis=0).T
            sums[k] += np.sum(weighted**2)
            counts[k] += len(weighted) * (roots @ roots)
            key = k, seen.tool if seen.seen else seen.base, len(weighted)
            together = shared.setdefault(key, np.zeros((len(weighted), count)))
            together += [np.bincount(numbers[known], row, count) for row in weighted]
    for (k, *_), together in shared.items():
        joint_sums[k] += np.sum(together**2)
        joint_counts[k] += len(together) * np.count_nonzero(together.any(axis=0))
    return found
