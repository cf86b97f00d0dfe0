# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of the arm that no parameter explains: how far its joints turn and tilt at random.

Play, gear harmonics, wobbling bearings and a rocking base act at the joints, so their errors grow
with the distance of the target from these; the noise of a device does not. That tells them apart
even if the sigmas of the device are unknown. With the columns Q of the posterior, scaled by a root
of its covariance, its residuals r have the covariance B V B + B - B^2, B = I - Q Q^T. In

    V = v_0 I_position + v_1 I_orientation + v_2 K_turns + v_3 K_tilts

K holds the products, stop by stop, of the columns of turns of all joints about their axes, or of
tilts. If a test finds r^T K r larger than white noise allows, sizes v >= 0 equate these forms with
their expected values (MINQUE, Rao 1971).

They move the fitted parameters too. Turns, as of gears, average out like noise. Considered effects
(`evidence.py`) of columns A and expected squares S add H^-1 (J^T A S A^T J) H^-1. So do tilts that
change slowly with the value of their joint, as of bearings: waves (`considered.tilted`) of one
size, the most probable one. In a small region parameters absorb them without a trace in the
residuals, and the typical size counts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from calib_ros.estimation.considered import Tilts, tilted, tilting
from calib_ros.estimation.evidence import Posterior, turns_and_tilts
from calib_ros.estimation.identifiability import covariance
from calib_ros.estimation.leastsquares import System, gram
from calib_ros.estimation.levels import CERTAIN, SEVERAL, TELLING
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.shared_errors import gathered, joints_at, nonnegative
from calib_ros.estimation.sizes import LEAST_SIZE, SPREAD, TYPICAL, Evidence, solved
from calib_ros.kinematics.se3 import FloatArray


def unmodelled_errors(
    posterior: Posterior, factor: FloatArray, system: System
) -> tuple[tuple[float, float], FloatArray, Tilts]:
    """Return the sizes [rad] of random turns and tilts of the joints, zero without evidence.

    Those of a prismatic joint along its axis [m] count as turns. Then follow the expected squares
    (F, F) that considered effects add to the F parameters of the fit with that `factor` (F, F),
    the first of the posterior's names, and the tilts, which add to them too. Parameters held at
    nominal have no prior: the fit includes them already.
    """
    chain, names = posterior.chain, posterior.names
    groups, fitted = turns_and_tilts(chain), np.s_[: len(factor)]
    every = tuple(dict.fromkeys((*names, *groups[0], *tilting(chain))))
    units, share = gathered(chain, every, system, SOME_POSES)
    rest = [k for k, name in enumerate(names) if name in posterior.priors and k >= len(factor)]
    columns = [[every.index(name) for name in group] for group in groups]
    parts, along = [], np.zeros((len(factor), len(rest) + 4 * len(columns[1])))  # 4 waves each
    for part in units.parts:
        waves = tilted(chain, every, joints_at(chain, units.place), part)
        others = np.concatenate([part[rest], waves])
        along += share * np.einsum('pcn,qcn->pq', part[fitted], others)
        parts += [np.concatenate([part[:-1], waves, part[-1:]])] * bool(part.any())
    found = ((0.0, 0.0), TYPICAL['drive'])
    if len(units) >= TELLING:
        found = _found(posterior, parts, columns, len(every))
    own, pushed = np.split(along, [len(rest)], axis=1)
    tilts = Tilts(found[1], covariance(factor) @ pushed)
    moved = covariance(factor, own @ posterior.square[np.ix_(rest, rest)] @ own.T)
    return found[0], moved, tilts


def _found(
    posterior: Posterior, parts: Sequence[FloatArray], groups: Sequence[Sequence[int]], first: int
) -> tuple[tuple[float, float], float]:
    """Return the sizes of turns and tilts, whose columns are the `groups`, and of waves.

    By weighted rows, those of waves from the `first` on.
    """
    count = len(posterior.names)
    found = _explained(posterior, [part[[*range(count), -1]] for part in parts])
    if found is None:
        return (0.0, 0.0), TYPICAL['drive']
    step, root, scales = found
    parts = [part / scale for part, scale in zip(parts, scales, strict=True)]
    wide = np.concatenate(parts, axis=1)
    rows = wide.transpose(2, 1, 0)  # (n, c, P)
    residual = rows[..., -1] + rows[..., :count] @ step
    part_of = np.repeat(np.arange(len(parts)), [part.shape[1] for part in parts])
    whites = rows.any(axis=2) & (part_of == np.arange(len(parts))[:, np.newaxis, np.newaxis])
    kernels = [*whites[..., np.newaxis] * np.eye(len(part_of))]
    kernels += [rows[..., group] @ np.swapaxes(rows[..., group], 1, 2) for group in groups]
    turn, tilt = _sizes(np.array(kernels), rows[..., :count] @ root, residual).tolist()
    return (turn, tilt), _size_of_waves(posterior, wide[[*range(count), *range(first, len(wide))]])


def _size_of_waves(posterior: Posterior, rows: FloatArray) -> float:
    """Return the size [rad] of waves, whose rows (P + T + 1, c, n) follow the posterior's.

    At least the typical one, unless the data rule that out and show none.
    """
    products, count, group = gram(rows), len(posterior.names), 'tilt'
    none = np.zeros(len(products) - 1 - count)
    given = [1.0 / posterior.priors.get(name, np.inf) ** 2 for name in posterior.names]
    matrix, typical = products[:-1, :-1], TYPICAL['drive']
    vector = matrix @ np.append(posterior.offsets, none) + products[:-1, -1]
    groups = [None] * count + [group] * len(none)
    sought = Evidence(matrix, vector, np.append(given, none), groups, {group: typical})
    size = float(np.exp(sought.most_probable({group})[0][0]))
    return max(size, typical) if size > SPREAD * LEAST_SIZE * typical else 0.0


def _explained(
    posterior: Posterior, parts: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return step to the posterior mean (P,), root (P, P) of its covariance, and noise by part.

    From weighted rows (P + 1, c, n) of each part; None if nothing is left to judge by.
    """
    inverse = np.array([1.0 / posterior.priors.get(name, np.inf) for name in posterior.names])
    products = np.array([gram(part) for part in parts])
    counts = np.array([np.count_nonzero(part.any(axis=0)) for part in parts])
    variances = np.ones(len(parts))
    for _ in range(SEVERAL):
        total = np.tensordot(1.0 / variances, products, 1)
        vector = total[:-1, -1] - posterior.offsets * inverse**2
        mean, root = solved(total[:-1, :-1], vector, inverse**2)
        last = np.append(-mean, 1.0)
        taken = ((products[:, :-1, :-1] @ root) * root).sum(axis=(1, 2)) / variances
        left = last @ products @ last
        if not ((left > 0.0) & (taken < counts)).all():
            return None
        variances = left / (counts - taken)
    return -mean, root, np.sqrt(variances)


def _sizes(kernels: FloatArray, basis: FloatArray, residual: FloatArray) -> FloatArray:
    """Return the standard deviations (2,) of the last two kernels (K, n, c, c).

    For the posterior's columns (n, c, P), scaled, and its residuals (n, c).
    """
    spread = kernels @ basis
    taken = np.einsum('kncp,ncp->k', spread, basis, optimize=True)
    values = np.einsum('knij,ni,nj->k', kernels, residual, residual, optimize=True)
    listed = kernels.reshape(len(kernels), -1)
    pairs, white, arm = listed @ listed.T, np.s_[:-2], np.s_[-2:]
    excess = (values + taken - np.einsum('knii->k', kernels))[arm]
    sizes = np.diag(pairs)  # white kernels have nothing in common
    own = sizes[arm] - (pairs[arm, white] ** 2 / sizes[white]).sum(axis=1)
    if not (excess > special.ndtri(0.5 + 0.5 * CERTAIN) * np.sqrt(2.0 * own)).any():
        return np.zeros(2)
    flat, spread = (x.reshape(*x.shape[:-3], -1, x.shape[-1]) for x in (basis, spread))
    inner = flat.T @ spread
    cross, both = (x @ x.T for x in (x.reshape(len(kernels), -1) for x in (spread, inner)))
    values -= taken - np.tensordot(inner, inner[white].sum(axis=0))
    return np.asarray(np.sqrt(nonnegative(pairs - 2.0 * cross + both, values)[arm]))
