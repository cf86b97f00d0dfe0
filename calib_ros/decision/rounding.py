# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rounded joint values: what they add to errors, and whether they may be all that was corrected.

docs/model.md (Judgement) gives the reasons.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import special

from calib_ros.decision.reasons import Reason, Rule
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.levels import CERTAIN, CLEARLY, CONFIDENT
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.system import row_samples, stacked
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import TWO_TURNS
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.values import ROUNDED, SAME

RESOLUTIONS = (
    *(1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4),
    *np.deg2rad([0.2, 0.1, 0.05, 0.02, 0.01]).tolist(),
)
"""Steps [rad or m] that values are rounded to; finer ones do no harm, wider ones are intended."""


def rounded_joints(problem: Problem) -> dict[Parameter, float]:
    """Return the zeros of joints whose values are multiples of a step [rad or m], with the step.

    Few values may be multiples of a wider step by chance, and two tell no step: then that of other
    joints, or of all together, counts. None if some values are in another unit than rad or m.
    """
    joints = np.concatenate([each.joints for each in problem.sets])
    if np.abs(joints).max() > TWO_TURNS:
        return {}
    own = [resolution_of(q) for q in joints.T]
    steps, found = sorted({*own, resolution_of(joints.ravel())} - {0.0}), {}
    for joint, step, q in zip(problem.chain.joints, own, joints.T, strict=True):
        count = len(np.unique(q))
        by_chance = (s for s in steps if (s / (step or s)) ** count > 1.0 - CERTAIN)
        likely = [s for s in by_chance if count > 1 and _are_multiples(q, s)]
        if likely:
            found[joint.driven] = likely[0]
    return found


def lost_digits(problem: Problem, chain: Chain) -> dict[Parameter, float]:
    """Return the zeros of joints whose values have lost all decimals, with the step [rad or m].

    Whole degrees may be intended, so most residuals of the fitted chain must be turns of the joint
    as large as rounding causes. Half of those in images are by chance, those of distances always.
    """
    sets = [each.spread() for each in problem.sets if each.distances is None]
    found = dict[Parameter, float]()
    if not sets:
        return found
    joints = np.concatenate([each.joints for each in sets]).T
    for joint, q in zip(chain.joints, joints, strict=True):
        for step in (float(np.deg2rad(1.0)), 0.1):
            if resolution_of(q, (step,)):
                rows = problem.system(sets).rows_of(chain, [joint.driven])
                along = np.concatenate([(column * left).sum(axis=0) for column, left in rows])
                squares = np.concatenate([(each**2).sum(axis=1) for each in rows], axis=1)
                column, left = np.maximum(squares, 1e-300)
                turned = np.median(np.abs(along) / column) > step / 8.0  # by rounding: a quarter
                if turned and np.median(along**2 / (column * left)) > 0.75:
                    found[joint.driven] = step
    return found


def with_lost_digits(
    refused: tuple[Reason, ...], lost: Mapping[Parameter, float]
) -> tuple[Reason, ...]:
    """Return the refusals, if any, after the joints that have only whole steps [rad or m] left."""
    each = [f'{n.owner} ({resolution_in_words(size, n.unit)})' for n, size in lost.items()]
    text = (
        f'most errors of the poses are those of {", ".join(each)}, whose values have lost their '
        'decimals: record all digits'
    )
    return (Reason(Rule.MISTAKE, text),) * bool(lost and refused) + refused


def resolution_in_words(step: float, unit: str) -> str:
    """Return a step of rounded values [rad or m] in the unit in which they were written."""
    degrees = round(float(np.rad2deg(step)), 3)
    written = unit == 'rad' and abs(np.deg2rad(degrees) / step - 1.0) < SAME
    return f'{degrees:g}°' if written else f'{1e3 * step:.3g} m{unit}'


def rounding_errors(problem: Problem, coarse: Mapping[Parameter, float]) -> dict[str, float]:
    """Return the error [rad or m] of each joint's zero by rounding, by parameter.

    The RMS of the mean over all values, uniform within a step; a value shared by most poses hardly
    averages out.
    """
    joints = np.concatenate([each.joints for each in problem.sets])
    found = dict[str, float]()
    for joint, values in zip(problem.chain.joints, joints.T, strict=True):
        if joint.driven in coarse:
            shares = np.unique(values, return_counts=True)[1] / len(values)
            found[joint.driven] = coarse[joint.driven] * float(np.sqrt(np.sum(shares**2) / 12.0))
    return found


def error_by_rounding(problem: Problem, chain: Chain) -> float:
    """Return the RMS position error [m] of the fitted flange that rounded joint values cause."""
    joints, squares = np.concatenate([each.spread().joints for each in problem.sets]), 0.0
    for name, step in (rounded_joints(problem) | lost_digits(problem, chain)).items():
        moved = joints + step * (np.array(chain.joint_names) == name.owner)
        shift = (chain.forward(moved) - chain.forward(joints))[:, :3, 3]
        squares += float(np.mean(np.sum(shift**2, axis=-1))) / 12.0
    return float(np.sqrt(squares))


def resolution_of(values: FloatArray, steps: Sequence[float] = RESOLUTIONS) -> float:
    """Return the step [rad or m] of which values (N,) are multiples; 0 for none."""
    few = values[:3, np.newaxis] / steps
    likely = np.compress(np.abs(few - np.round(few)).max(axis=0) < ROUNDED, steps).tolist()
    for step in sorted(likely, reverse=True):
        if _are_multiples(values, step):
            wider = _are_multiples(values, CLEARLY * step)
            return 0.0 if wider or len(np.unique(values)) < 3 else step
    return 0.0


def _are_multiples(values: FloatArray, step: float) -> bool:
    return bool(np.abs(values / step - np.round(values / step)).max() < ROUNDED)


def may_be_rounding(fitted: Fitted, before: Chain, coarse: Mapping[Parameter, float]) -> bool:
    """Tell whether rounding moves the arm by half of the correction or more, over the joint range.

    A fit follows the rounding of values that repeat, and so do poses left out of it; what it can
    not follow shows in the residuals. `before` is the nominal chain with fitted frames, `coarse`
    holds the steps of rounded joint values.
    """
    if not coarse:
        return False
    chain, names = fitted.chain, fitted.names
    sets = fitted.good_sets()
    wanted = list(dict.fromkeys([*names, *(joint.driven for joint in chain.joints)]))
    parts = fitted.problem.system(sets).rows_of(chain, wanted)
    rows, owner = stacked(parts), row_samples(parts)
    own = rows[:, : len(names)]
    inverse = np.linalg.pinv(own.T @ own, hermitian=True)
    followed, shown = np.zeros((len(names), len(names))), 0.0
    values = np.concatenate([each.joints for each in sets]).T
    for joint, q in zip(chain.joints, values, strict=True):
        _, level, count = np.unique(q, return_inverse=True, return_counts=True)
        if joint.driven in coarse:
            step = coarse[joint.driven] * (count > 1)[level[owner], np.newaxis]
            column = rows[:, [wanted.index(joint.driven)]] * step / np.sqrt(12.0)
            along = np.zeros((len(count), len(names)))
            np.add.at(along, level[owner], own * column)
            followed += along.T @ along
            shown += float(np.sum(column**2) - np.sum(along @ inverse * along))
    freedom = max(len(rows) - len(names), 1)
    left = np.sum(rows[:, -1] ** 2) / special.chdtri(freedom, CONFIDENT) - 1.0  # at most
    share = min(1.0, max(left, 0.0) * freedom / max(shown, 1e-300))
    ends = sets[0].base, sets[0].tool
    joints = chain.random_joints(SOME_POSES, np.random.default_rng(0))
    moves = ErrorModel(chain, names, *ends).jacobian(joints)[:, :3]
    moved = share * np.einsum('ncp,pq,ncq->', moves, inverse @ followed @ inverse, moves)
    corrected = chain.forward(joints, None, *ends) - before.forward(joints, None, *ends)
    return bool(4.0 * moved > np.sum(corrected[:, :3, 3] ** 2))
