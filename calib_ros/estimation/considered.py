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

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from scipy import linalg

from calib_ros.estimation.identifiability import DEGENERATE
from calib_ros.estimation.joint_errors import NOTHING, Unmodelled, axis_parameters
from calib_ros.estimation.leastsquares import System, products_of
from calib_ros.estimation.levels import LARGEST_SCALE, OUT_OF_SCALE, PRINTED, SCALE
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.samples import Samples, gram
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import IN_PIXELS, Parameter, parameters_of
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.settings import Settings

CONSIDERED = ('eccentricity', 'gravity')
"""Effects that any arm may have, fitted or not; moves of one joint hardly excite couplings."""


def considered(chain: Chain, names: Sequence[str], fixed: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the effects that an arm may have besides the named ones.

    DH parameters held at nominal by a `fixed` pattern may be off as well, and frames held by the
    chain file. Where eccentricity is fitted, waves of other orders look like it in part of a turn.
    """
    every = [name for group in CONSIDERED for name in effects.members(chain, group)]
    every += effects.couplings([each.name for each in chain.joints if each.type == 'revolute'])
    every += travels(chain)
    fitted = [name for name in effects.members(chain, 'eccentricity') if name in names]
    for owner in dict.fromkeys(name.owner for name in fitted):
        every += [wave for order in (3, 4) for wave in effects.waves(owner, order)]
    held = {n for each in fixed for n in fnmatch.filter(chain.parameter_names, each)}
    every += [name for name in chain.parameter_names if name in held and name.of_dh]
    every += [*lenses(chain), *held_frames(chain)]
    return tuple(name for name in every if name not in names)


def travels(chain: Chain) -> list[Parameter]:
    """Return the ratios of linear joints: their travel may be out of scale."""
    return [Parameter(j.name, 'ratio') for j in chain.joints if j.type == 'prismatic']


def held_frames(chain: Chain) -> list[Parameter]:
    """Return the parameters of the frames that the chain file holds."""
    held = [key for key in chain.frame_names if chain.frame(key).fixed]
    return [name for key in held for name in parameters_of(key)]


def lenses(chain: Chain) -> dict[Parameter, float]:
    """Return the standard deviations [px] of given intrinsics: a calibration has errors too."""
    return {
        name: OUT_OF_SCALE * frame.lens.fx
        for key in chain.frame_names
        if (frame := chain.frame(key)).lens is not None and frame.lens.fixed
        for name in parameters_of(key, IN_PIXELS)
    }


@dataclass(frozen=True, eq=False)
class Nuisances:
    """What else may move the measurements, each with a standard deviation.

    Parameters by `sizes` that something else moves too, all `lengths` together with the scale of
    the device, smooth errors of the device if `by_device`, and `unmodelled` waves beside what the
    parameters follow of them; if `kept`, waves are no nuisances but parameters, in units of their
    size.
    """

    sizes: Mapping[str, float] = field(default_factory=dict)
    lengths: Mapping[str, float] = field(default_factory=dict)
    by_device: bool = False
    unmodelled: Unmodelled = NOTHING
    kept: bool = False


class NuisanceProducts(NamedTuple):
    """Products of columns and residual (Q, Q), and with K doubtful columns (Q, K) and (K, K).

    The columns are those of the parameters, of waves if kept, of the device's scale if there are
    lengths, and of the residual. Doubtful ones are scaled by their standard deviations; their own
    products have 1 added.
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
    share = -(-system.count // most)
    few = system.spread(most)
    products = share * _products(chain, columns, few, nuisances)
    extra = np.column_stack(system.separation_rows(chain, columns))
    own, count = len(columns) + 1, len(names)
    products[:own, :own] += extra.T @ extra
    every = np.eye(len(products))
    row = {str(name): k for k, name in enumerate(columns)}

    def scaled(sizes: Mapping[str, float]) -> FloatArray:
        return every[:, [row[str(name)] for name in sizes]] * [*sizes.values()]

    grown = scaled(nuisances.lengths).sum(axis=1, keepdims=True)[:, : len(nuisances.lengths)]
    end = own + _waves(chain, nuisances) * nuisances.kept
    kept = np.column_stack([every[:, :count], every[:, own:end], grown, every[:, own - 1]])
    mixing = np.column_stack([kept, scaled(nuisances.sizes), every[:, end:]])
    mixed = mixing.T @ (products / noise**2) @ mixing
    first, rest = np.s_[: kept.shape[1]], np.s_[kept.shape[1] :]
    doubtful = mixed[rest, rest]
    return NuisanceProducts(
        mixed[first, first], mixed[first, rest], doubtful + np.eye(len(doubtful))
    )


def lengths_of(chain: Chain, system: System) -> tuple[Chain, dict[str, float], float]:
    """Return all lengths [m] that positions depend on, and the standard deviation of their scale.

    There are none for sockets and planes alone, whose places are fixed, unless a bar is between.
    The travel of a prismatic joint is scaled by its ratio, which is added to the returned chain.
    """
    sets = [samples.observations for samples in system.sets]
    sets = [each for each in sets if not (each.socket or each.plane)]
    if not (sets or system.separations):
        return chain, {}, SCALE
    chain = chain.with_effects(travels(chain))
    names: list[str] = [name for frame in chain.frame_names for name in parameters_of(frame)[:3]]
    names += [name for joint in chain.joints for name in joint.parameters if name.is_length]
    scale = SCALE
    if not sets:
        longest = max(distance for *_, distance in system.separations)
        scale = max(scale, Settings.sigma_position / longest)
    elif all(each.pixels is not None for each in sets):
        scale = PRINTED
    elif all(each.distances is not None for each in sets):
        scale = LARGEST_SCALE
    return chain, {n: chain.value(n) for n in names} | {str(n): 1.0 for n in travels(chain)}, scale


def _waves(chain: Chain, nuisances: Nuisances) -> int:
    return 8 * len(chain.joints) if nuisances.unmodelled.waves else 0


def _products(
    chain: Chain, columns: Sequence[str], system: System, nuisances: Nuisances
) -> FloatArray:
    """Return products of columns, residual, waves and smooth device errors."""
    unmodelled = nuisances.unmodelled
    none = [np.zeros((0, samples.width, samples.count)) for samples in system.sets]
    fields = bends(system.sets) if nuisances.by_device else none
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


def bends(sets: Sequence[Samples]) -> list[FloatArray]:
    """Return the possible device distortions of each set (K, c, N), weighted as position rows.

    Each of the K coefficients has standard deviation 1; together they have the device's sigma in
    each coordinate (RMS over samples). Each device has its own; sockets, planes, distances and
    pixels have none.
    """
    by_device: dict[str, list[int]] = {}
    for number, samples in enumerate(sets):
        seen = samples.observations
        if seen.distances is None and seen.pixels is None and not seen.socket:
            by_device.setdefault(seen.tool if seen.inverse else seen.base, []).append(number)
    found = [np.zeros((0, samples.width, samples.count)) for samples in sets]
    for own in by_device.values():
        device = [sets[number] for number in own]
        weights = [np.ones(s.count) if s.weights is None else s.weights for s in device]
        shown = [samples.observations for samples in device]
        places = [each.given for each in shown]
        waves = _polynomials(np.concatenate(places), np.concatenate(weights))
        ends = np.cumsum([samples.count for samples in device])[:-1]
        parts = dict(zip(own, np.split(waves, ends, axis=1), strict=True))
        for k, samples in enumerate(sets):
            none = np.zeros((3 * len(waves), samples.width, samples.count))
            bent = _rows(samples, parts[k]) if k in parts else none
            found[k] = np.concatenate([found[k], bent])
    return found


def _polynomials(places: FloatArray, weights: FloatArray) -> FloatArray:
    """Return weighted polynomials (M, N), orthogonal, without mean, of total mean square 1."""
    total = max(float(weights @ weights), 1.0)
    centred = places - (weights**2 @ places) / total
    pairs = combinations_with_replacement(centred.T, 2)
    terms = [np.ones(len(places)), *centred.T, *(one * other for one, other in pairs)]
    columns = weights * np.array(terms)
    basis, factor = np.linalg.qr(columns.T)
    used = np.abs(np.diag(factor)) > DEGENERATE * np.linalg.norm(columns, axis=1)[: len(factor)]
    used[0] = False
    return np.asarray(basis.T[used] * np.sqrt(total / max(used.sum(), 1)))


def _rows(samples: Samples, waves: FloatArray) -> FloatArray:
    """Return rows (3 M, c, N) of weighted polynomials (M, N) along each axis of the device."""
    seen = samples.observations
    axes = seen.rotations if seen.inverse else np.eye(3)[np.newaxis]
    bent = np.einsum('mn,nia->main', waves, np.broadcast_to(axes, (samples.count, 3, 3)))
    bent = bent.reshape(-1, 3, samples.count)
    if samples.whitening is None:
        return np.asarray(bent)
    covariance = seen.covariances(samples.sigmas)[:, :3, :3]
    sigma = float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean() / 3.0))
    return np.asarray(np.einsum('rsn,psn->prn', samples.whitening[:, :3], sigma * bent))
