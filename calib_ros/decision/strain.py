# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A device that stretches space in one direction more than in another.

No arm does, not even one that bends, unless its linear joints, or lengths that are held, are out
of scale. So it shows in the residuals: a volume calibrated badly, a wrong focal length, or a wrong
radius of the reflector. Such a device is hardly true to scale either, which does not show: lengths
of the arm follow it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_ros.decision.scale import percent
from calib_ros.decision.steps import EXPLAINED
from calib_ros.estimation.considered import CONSIDERED, considered, held_frames, travels
from calib_ros.estimation.distortion import STRAINS, differing, strains
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.gain import gain_of, gain_share
from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.levels import OUT_OF_SCALE, SURE, chance_of
from calib_ros.estimation.system import System, stacked
from calib_ros.kinematics import effects
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray


def strain_of(fitted: Fitted) -> tuple[str, float]:
    """Return the strain of the only device in words, and the share of the residuals it explains.

    A strain explains most of the residuals that usual eccentricity and a usual sag of the arm
    leave, with whatever is held and any scale of travel. The share is that of a scale of travel,
    with the strain if there is one, or zero if it is not most or frames are held.
    """
    problem, names = fitted.problem, fitted.names
    learned = problem.learned and replace(problem.learned, noise=1.0)  # of what is not fitted
    own_noise = replace(problem, learned=learned)
    system = own_noise.system(fitted.good_sets())
    strained = strains(system.sets)
    if not (travels(fitted.chain) or any(each.any() for each in strained)):
        return '', 0.0
    more = _beside(fitted)
    columns, count = [*names, *more], len(names) + len(more)
    own = (n for n in more if not (n.of_dh or problem.model.owns_frame(n)))
    chain = fitted.chain.with_effects([*own])
    if held := [name for name in more if problem.model.owns_frame(name)]:  # maybe far off
        system = System(system.sets)  # whose noise was not that of the priors
        chain = minimise(chain, [*names, *held], system).chain
    rows = stacked(list(map(_with_strains, system.rows_of(chain, columns), strained)))
    free = [*range(len(names)), *(k for k, n in enumerate(columns) if n in travels(chain))]
    given, back = system.extra_rows(chain, columns)
    known = np.column_stack([given, np.zeros((len(given), len(STRAINS))), back])
    sane = [1.0 / OUT_OF_SCALE] * len(STRAINS)  # else, beside linear joints, that of noise
    usual = [0.0] * len(names) + [1.0 / size for size in more.values()] + sane
    text = _in_words(np.vstack([rows, known, np.diag([*usual, 0.0])]), count)
    free += range(count, rows.shape[1]) if text else [rows.shape[1] - 1]
    share = gain_share(rows[:, [*dict.fromkeys(free)]], len(names))
    return text, share if EXPLAINED < share < 1.0 and not held else 0.0


def _in_words(rows: FloatArray, count: int) -> str:
    """Return what strains explain beside the first `count` columns, if it is most."""
    squares, rank, left = gain_of(rows.T @ rows, count)
    share = squares / left if left > 0.0 else 0.0
    if not EXPLAINED < share < 1.0:
        return ''
    free = np.count_nonzero(rows[:, :-1].any(axis=1)) - np.linalg.matrix_rank(rows[:, :-1])
    if free <= 0 or chance_of(share / (1.0 - share) * free, rank, free) > 1.0 - SURE:
        return ''
    found = np.linalg.lstsq(rows[:, :-1], rows[:, -1], HALF_THE_DIGITS)[0][count:]
    size = percent(differing(np.asarray(found)))
    return (
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


def _with_strains(rows: FloatArray, strained: FloatArray) -> FloatArray:
    """Return rows (P + 1, c, N) with strains (5, w, N) before the residual."""
    added = np.zeros((len(strained), *rows.shape[1:]))
    added[:, : strained.shape[1]] = strained
    return np.concatenate([rows[:-1], added, rows[-1:]])
