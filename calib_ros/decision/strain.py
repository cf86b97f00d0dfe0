# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A device that stretches space in one direction more than in another.

No arm does, not even one that bends, unless its linear joints, or lengths that are held, are out
of scale. So it shows in the residuals: a volume calibrated badly, a wrong focal length, or a wrong
radius of the reflector. Such a device is hardly true to scale either, which does not show: lengths
of the arm follow it. If its three directions are off independently by s, the scale is off by s /
3^(1/2), and the strain without it, a symmetric matrix, has the length 2^(1/2) s.
"""

from __future__ import annotations

import numpy as np

from calib_ros.decision.scale import percent
from calib_ros.decision.steps import EXPLAINED
from calib_ros.estimation.considered import CONSIDERED, considered, held_frames, travels
from calib_ros.estimation.distortion import device_sigma, shift_rows
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.gain import gain_of
from calib_ros.estimation.levels import SURE, chance_of
from calib_ros.estimation.samples import Samples
from calib_ros.estimation.system import stacked
from calib_ros.kinematics import effects
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray

_PAIRS = ((0, 1), (0, 2), (1, 2))
STRAINS = np.array(
    [
        *(np.diag(each) for each in ((1.0, -1.0, 0.0), (1.0, 1.0, -2.0))),
        *(np.outer(*np.eye(3)[[i, j]]) + np.outer(*np.eye(3)[[j, i]]) for i, j in _PAIRS),
    ]
)
"""Symmetric matrices (5, 3, 3) without trace: the others turn or scale space."""


def strain_of(fitted: Fitted) -> tuple[float, str]:
    """Return the standard deviation of the scale of a strained device, and the strain in words.

    Zero and nothing unless a strain of the only device explains most of the residuals that usual
    eccentricity and a usual sag of the arm leave, with whatever is held and any scale of travel.
    """
    problem, names = fitted.problem, fitted.names
    pairs = zip(problem.sets, fitted.robust.inliers, strict=True)
    sets = [each.select(good).spread() for each, good in pairs]
    devices = {each.tool if each.inverse else each.base for each in sets}
    positions = (
        each.distances is None and each.pixels is None and not each.socket for each in sets
    )
    if len(devices) > 1 or not all(positions):
        return 0.0, ''
    more = _beside(fitted)
    system, columns = problem.system(sets), [*names, *more]
    own = (n for n in more if not (n.of_dh or problem.model.owns_frame(n)))
    chain = fitted.chain.with_effects([*own])
    rows = stacked(list(map(_with_strains, system.rows_of(chain, columns), system.sets)))
    given, back = system.extra_rows(chain, columns)
    usual = np.diag([0.0] * len(names) + [1.0 / size for size in more.values()])
    known = np.zeros((len(given) + len(usual), rows.shape[1]))
    known[:, : len(columns)], known[: len(given), -1] = np.vstack([given, usual]), back
    rows = np.vstack([rows, known])
    squares, rank, left = gain_of(rows.T @ rows, len(columns))
    share = squares / left if left > 0.0 else 0.0
    if not EXPLAINED < share < 1.0:
        return 0.0, ''
    free = np.count_nonzero(rows[:, :-1].any(axis=1)) - np.linalg.matrix_rank(rows[:, :-1])
    if free <= 0 or chance_of(share / (1.0 - share) * free, rank, free) > 1.0 - SURE:
        return 0.0, ''
    found = np.linalg.lstsq(rows[:, :-1], rows[:, -1], HALF_THE_DIGITS)[0][len(columns) :]
    strain = np.tensordot(found, STRAINS, 1)
    size = percent(float(np.ptp(np.linalg.eigvalsh(strain))))
    return float(np.linalg.norm(strain)) / 6.0**0.5, (
        f'in one direction of the measuring device lengths come out {size} % longer than in '
        f'another, which explains {100.0 * share:.0f} % of the residuals: its scale may be off as '
        'well. Calibrate it again (its volume or lens, or the radius of the reflector)'
    )


def _beside(fitted: Fitted) -> dict[Parameter, float]:
    """Return what else may explain residuals, with standard deviations [m, rad]."""
    problem, names = fitted.problem, fitted.names
    members = (name for group in CONSIDERED for name in effects.members(problem.chain, group))
    found = {Parameter(name): effects.expected(name) for name in members if name not in names}
    unknown = {*travels(fitted.chain), *held_frames(fitted.chain)}
    held = map(Parameter, considered(fitted.chain, names, problem.fixed))
    return found | {name: np.inf for name in held if name.of_dh or name in unknown}


def _with_strains(rows: FloatArray, samples: Samples) -> FloatArray:
    """Return rows (P + 1, c, N) with those of strains before the residual."""
    seen = samples.observations
    weights = np.ones(samples.count) if samples.weights is None else samples.weights
    places = weights * (seen.given - seen.given.mean(axis=0)).T / device_sigma(samples)
    along = shift_rows(samples, places).reshape(3, 3, -1, samples.count)
    added = np.zeros((len(STRAINS), *rows.shape[1:]))
    added[:, : along.shape[2]] = np.einsum('kma,macn->kcn', STRAINS, along)
    return np.concatenate([rows[:-1], added, rows[-1:]])
