# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What is wrong with distances, if that explains most of what a fit leaves.

A draw-wire has a zero and a scale. A cable that leaves over a pulley or an edge, or pulls at a
stand, errs by nearly a quadratic form of its direction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib_ros.decision.reasons import Reason, Rule
from calib_ros.estimation.considered import travels
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.fitting import fit
from calib_ros.estimation.levels import ALIKE, SEVERAL, SURE, chance_of
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Learned, Problem
from calib_ros.estimation.samples import Samples
from calib_ros.estimation.system import stacked
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import parameters_of
from calib_ros.kinematics.se3 import ROUNDING, FloatArray, norms

CORRECTABLE = ((0,), (1,), (0, 1))  # by zeros, by scales, by both
DIRECTIONAL = ((2, 3, 4, 5, 6, 7),)
TERMS = 8  # of `_terms`


def wrong_distances(fitted: Fitted) -> tuple[tuple[Reason, ...], Fitted | None]:
    """Return what is wrong with the distances of devices, if that explains a misfit.

    Zeros and scales are found by refits. Distances alone show no scale: the arm's lengths imitate
    it. The fit of corrected distances follows, or None if they cannot be corrected.
    """
    problem, sets = fitted.problem, fitted.problem.sets
    wires = [*dict.fromkeys(each.base for each in sets if each.of_wire)]
    found = np.zeros((len(wires), 2))
    for _ in range(SEVERAL if wires else 0):
        if not (more := _errors(fitted, wires, CORRECTABLE)[:, :2]).any():
            break
        found += more
        fitted = fit(problem.with_sets(_shortened(sets, dict(zip(wires, found, strict=True)))))
    if wires and _errors(fitted, wires, DIRECTIONAL).any():
        what = 'distances depend on the direction of the cable: it leaves over a pulley or an edge'
        remedy = 'Lead it out of a small hole in a firm stand, and measure again'
        return (Reason(Rule.MISTAKE, f'{what}, or its stand yields. {remedy}'),), None
    return ((_corrections(problem, wires, *found.T),) if found.any() else ()), fitted


def _corrections(
    problem: Problem, wires: Sequence[str], zeros: FloatArray, scales: FloatArray
) -> Reason:
    """Return how to correct distances that are too long by zeros (K,) [m] and scales (K,)."""
    kinds = (('zero', 1e3 * zeros, 'mm'), ('scale', 100.0 * scales, '%'))
    off = [(kind, sizes.tolist(), unit) for kind, sizes, unit in kinds if sizes.any()]
    sound = 'if all else is true to scale, ' if scales.any() else ''
    if len(wires) > 1:
        by = ' and '.join(f'{kind}s' for kind, *_ in off)
        every = [[f'{sizes[k]:.3g} {unit}' for _, sizes, unit in off] for k in range(len(wires))]
        each = (f'{w} {" and ".join(parts)}' for w, parts in zip(wires, every, strict=True))
        what = f'distances are too long by the {by} of their devices ({", ".join(each)})'
        return Reason(Rule.MISTAKE, f'{what}: {sound}subtract these')
    (zero,), (scale,) = zeros.tolist(), scales.tolist()
    parts = [
        f'{abs(size):.3g} {unit} too {"long" if size > 0.0 else "short"}, by the {kind}'
        for kind, (size,), unit in off
    ]
    remedy = f'correct the {" and ".join(kind for kind, *_ in off)} where they are published'
    if not problem.of_messages:
        remedy = '--columns distance=distance' + (f'*{1.0 - scale:.5f}' if scale else '')
        remedy += f'{-zero:+.5f} (if in metres)' if zero else ''
    return Reason(Rule.MISTAKE, f'all distances are {", and ".join(parts)}: {sound}{remedy}')


def _errors(fitted: Fitted, wires: Sequence[str], tried: Sequence[tuple[int, ...]]) -> FloatArray:
    """Return the sizes (K, 8) of errors of the devices that explain a misfit best, or zeros.

    `tried` are numbers of `_terms`. Nor must a usual sag of the arm explain as much, or usual
    scales of travel, or another place of frames that are held. What the distances have to spare
    beyond places and terms counts: the rest of the measurements tells nothing of their noise.
    """
    rows, count, sags = _rows(fitted, wires)
    equations = len(rows[0])
    pairs = zip(fitted.problem.sets, fitted.robust.inliers, strict=True)
    spare = sum(int(good.sum()) for each, good in pairs if each.base in wires) - 3 * len(wires)
    factor = np.asarray(np.linalg.qr(np.concatenate(rows), mode='r'))
    best, lowest = np.zeros((len(wires), TERMS)), np.inf
    most = _left(factor, range(count + sags))[1]
    for terms in tried:
        added = [count + sags + TERMS * k + term for k in range(len(wires)) for term in terms]
        found, left = _left(factor, [*range(count), *added])
        free = min(equations - count, spare) - len(added)
        if free <= 0 or most <= ALIKE**2 * left:
            continue
        chance = chance_of((most - left) * free / max(left, ROUNDING), len(added), free)
        worth = left * ALIKE ** (2 * len(terms))
        if chance < 1.0 - SURE and worth < lowest:
            lowest, best = worth, np.zeros_like(best)
            best[:, [*terms]] = found[count:].reshape(len(wires), -1)
    return best


def _left(factor: FloatArray, columns: Sequence[int]) -> tuple[FloatArray, float]:
    """Return the solution of some columns of a factor for its last one, and the squares left."""
    found = np.linalg.lstsq(factor[:, [*columns]], factor[:, -1], rcond=None)[0]
    return np.asarray(found), float(np.sum((factor[:, -1] - factor[:, [*columns]] @ found) ** 2))


def _rows(fitted: Fitted, wires: Sequence[str]) -> tuple[list[FloatArray], int, int]:
    """Return rows of the fit, of sags and travels, of terms of devices, and of residuals.

    Measured ones and known ones; then the numbers of columns of the fit and of sags.
    """
    problem, pairs = fitted.problem, zip(fitted.problem.sets, fitted.robust.inliers, strict=True)
    sets = [each.select(good) for each, good in pairs]
    ends = [end for each in sets if each.base in wires for end in (each.base, each.tool)]
    placed = [name for end in ends for name in parameters_of(end)[:3]]
    names = list(dict.fromkeys([*fitted.names, *placed]))
    may_be = *effects.members(problem.chain, 'gravity'), *travels(problem.chain)
    sags = [n for n in may_be if n not in names]
    sane = {n: problem.common_sense(n) for n in names if not problem.model.owns_frame(n)}
    usual = replace(problem, learned=Learned(sane), effects=(*problem.effects, *sags))
    system, chain = usual.system(sets), fitted.chain
    bent = chain.with_effects(sags)
    rows = system.rows_of(bent, [*names, *sags])
    for k, samples in enumerate(system.sets):
        rows[k] = with_terms(rows[k], samples, wires, _terms(chain, samples.observations))
    given, back = system.extra_rows(bent, [*names, *sags])
    known = np.column_stack([given, np.zeros((len(given), TERMS * len(wires))), back])
    return [stacked(rows), known], len(names), len(sags)


def with_terms(
    rows: FloatArray, samples: Samples, wires: Sequence[str], terms: FloatArray
) -> FloatArray:
    """Return rows (P + 1, c, N) with those of errors (T, N) [m] of K wires before the last."""
    seen, own = samples.observations, np.zeros((len(wires), len(terms), *rows.shape[1:]))
    if seen.of_wire:
        weights = np.ones(len(seen)) if samples.weights is None else samples.weights
        own[wires.index(seen.base)] = (terms * weights / samples.sigmas[0])[:, np.newaxis]
    own = own.reshape(len(wires) * len(terms), *rows.shape[1:])  # of no samples, too
    return np.concatenate([rows[:-1], own, rows[-1:]])


def _terms(chain: Chain, each: Observations) -> FloatArray:
    """Return errors (8, N) of distances: their zero, their scale, and forms of the direction.

    Of predicted ones: by a scale of measured ones all would shrink, and residuals with them.
    """
    cable = chain.forward(each.joints, each.approach, each.base, each.tool)[:, :3, 3]
    far = norms(cable)
    x, y, z = cable.T / np.maximum(far, ROUNDING)
    return np.array([np.ones(len(each)), far, x * x, y * y, z * z, x * y, x * z, y * z])


def _shortened(
    sets: Sequence[Observations], less: Mapping[str, Sequence[float]]
) -> list[Observations]:
    """Return sets with the distances of some devices shorter by a zero [m] and a scale."""
    found = []
    for each in sets:
        if each.distances is not None and each.base in less:
            zero, scale = less[each.base]
            each = replace(each, distances=each.distances * (1.0 - scale) - zero)
        found.append(each)
    return found
