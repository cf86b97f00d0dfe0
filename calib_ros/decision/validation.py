# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Judging a result on poses that were not fitted: held out, in folds, or place by place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from calib_ros.decision.comparison import Comparison, compare
from calib_ros.decision.cross_validation import cross_validate
from calib_ros.decision.places import leave_one_place_out, places_of
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.levels import ALIKE, SURE
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.posterior import Posterior
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.visits import by_set, stations
from calib_ros.estimation.weights import OUTLIER, distances_of
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.se3 import Flags, FloatArray


def validate(
    fitted: Fitted, before: Chain, explained: Flags | None = None
) -> tuple[Comparison | None, str]:
    """Judge a fitted chain and that before on pairs that were not fitted.

    Held-out pairs are outliers if they are far from the prediction and not `explained` (N,) by a
    simpler model. In cross-validation, configurations are dealt to the folds one by one, so that
    none is on both sides. Outliers keep their weight of the whole fit in the folds; they are
    judged too.
    """
    problem = fitted.problem
    repeated = _repeated(problem)
    if not repeated.all():
        comparison = replace(compare(before, fitted.chain, problem.judging), repeated=repeated)
        if count_distinct(comparison.after.configurations[~repeated]) > 1:
            return _of_held_out(fitted, comparison, explained)
    places = places_of(problem)
    if len(places) > 1 and all(each.socket for each in problem.sets):
        return leave_one_place_out(fitted, before, places)
    note = ', because fewer than two held-out poses are new' if len(repeated) else ''
    return cross_validate(fitted, before, note)


def _of_held_out(
    fitted: Fitted, comparison: Comparison, explained: Flags | None
) -> tuple[Comparison, str]:
    problem = fitted.problem
    if problem.loss != 'none':
        judged, new = ~comparison.counting, comparison.counting
        pairs = zip(problem.judging, by_set(new, problem.judging), strict=True)
        sets = [each.select(rows) for each, rows in pairs if rows.any()]
        far = distances_of(fitted.chain, fitted.names, problem.system(sets))
        judged[new] = np.concatenate(far) <= OUTLIER
        judged |= np.False_ if explained is None else explained
        comparison = replace(comparison, judged=judged)
    text = f'{comparison.counting.sum():,} held-out poses{comparison.omitted}'
    if repeats := int((~comparison.counting).sum()):
        text += f'; not counted because they repeat fitted poses: {repeats}'
    return comparison, text


def _repeated(problem: Problem) -> Flags:  # held-out pairs (N,)
    if not problem.judging:
        return np.zeros(0, dtype=bool)
    numbers = stations(problem.all_sets)
    count = len(problem.sets)
    return np.isin(np.concatenate(numbers[count:]), np.concatenate(numbers[:count]))


def held_out_excess(
    fitted: Fitted, posterior: Posterior, judged: Comparison | None
) -> tuple[float, float]:
    """Return by how much held-out positions are further off than noise and expected errors.

    Then follows the factor by which the expected errors are too small (after Birge 1932). They
    are 0 and 1 unless more than chance (99.9 %) makes them so.
    """
    problem, sets = fitted.problem, fitted.problem.judging
    if judged is None or judged.repeated is None:
        return 0.0, 1.0
    if any(each.distances is not None or each.pixels is not None for each in sets):
        return 0.0, 1.0
    sigmas, found = (problem.sigma_position, problem.sigma_orientation), judged.figures[1].rms_mm
    squares = [_judged(each, each.covariances(sigmas)) for each in sets]
    noise = fitted.noise.position * _rms_mm(squares, judged.deciding)
    if found <= ALIKE * noise:  # noise alone, as nearly always
        return 0.0, 1.0
    squares = [_judged(s, posterior.expected(s.joints, s.base, s.tool, s.approach)) for s in sets]
    expected = _rms_mm(squares, judged.deciding)
    if not expected:  # computed, without noise
        return 0.0, 1.0
    likely, by_arm = float(np.hypot(noise, expected)), expected**2 / (noise**2 + expected**2)
    alone = (1.0 - by_arm**2) / (3.0 * np.count_nonzero(judged.deciding))
    freedom = 1.0 / (alone + by_arm**2 * _alike(posterior, sets))  # Satterthwaite 1946
    if found <= likely * max(ALIKE, np.sqrt(special.chdtri(freedom, 1.0 - SURE) / freedom)):
        return 0.0, 1.0
    return found / likely, float(np.sqrt(found**2 - noise**2)) / expected


def as_at_rest(found: Comparison, fitted: Fitted, posterior: Posterior) -> Comparison:
    """Return residuals as large as those of still poses.

    Without what jitter of stamps explains, errors of arm and device along the motion are hidden,
    too: to the squares, before and after, is added what is expected of those after.
    """
    sets = fitted.problem.sets if found.repeated is None else fitted.problem.judging
    if all(each.punctual is None for each in sets):
        return found
    both = [np.stack([e.position, e.orientation]) for e in (found.before, found.after)]
    for rows, each in zip(by_set(np.arange(len(found.judged)), sets), sets, strict=True):
        few = [part[:, rows[found.deciding[rows]]] ** 2 for part in both]
        count = (few[0] >= 0.0).sum(axis=(1, 2)) / 3.0  # some may lack orientation, or all repeat
        before, after = (np.nansum(part, axis=(1, 2)) / count for part in few)
        hidden = _hidden(each, after, fitted, posterior)
        for part, squares in zip(both, (before, after), strict=True):
            longer = np.where(count > 0.0, np.sqrt(1.0 + hidden / squares), 1.0)
            part[:, rows] *= longer[:, np.newaxis, np.newaxis]
    pairs = zip((found.before, found.after), both, strict=True)
    first, last = (replace(e, position=p[0], orientation=p[1]) for e, p in pairs)
    return replace(found, before=first, after=last)


def _hidden(
    each: Observations, seen: FloatArray, fitted: Fitted, posterior: Posterior
) -> FloatArray:
    """Return the mean squares (2,) of lengths and turns that are hidden beside those `seen`."""
    few, problem = each.spread(), fitted.problem
    if few.punctual is None:
        return np.zeros(2)
    given = few.covariances((problem.sigma_position, problem.sigma_orientation))
    still, size = few.punctual @ given, fitted.noise.position
    arm = posterior.expected(few.joints, few.base, few.tool, few.approach)
    parts = (
        arm + size**2 * still,
        _judged(few, arm + size**2 * given),
        arm + min(size, 1.0) ** 2 * still,
    )
    rest, judged, least = (
        np.einsum('nii->i', squares).reshape(2, 3).sum(axis=1) / len(few) for squares in parts
    )
    return np.asarray(np.maximum(np.fmax(seen * rest / judged, least) - seen, 0.0))


def _judged(each: Observations, squares: FloatArray) -> FloatArray:
    """Return the squares (N, 6, 6) of errors as they are judged."""
    kept = each.punctual
    return squares if kept is None else kept @ squares @ np.swapaxes(kept, 1, 2)


def _alike(posterior: Posterior, sets: Sequence[Observations]) -> float:
    """Return one by the number of positions that the arm's errors make independent: they share."""
    few, seen = [each.spread() for each in sets], []
    for each in few:
        model = ErrorModel(posterior.chain, posterior.names, each.base, each.tool)
        rows = model.jacobian(each.joints, each.approach)[:, :3]
        seen.append(rows.reshape(-1, len(posterior.names)))
    rows = np.concatenate(seen)
    shared = posterior.square @ (rows.T @ rows)
    return float(np.trace(shared @ shared) / np.trace(shared) ** 2)


def _rms_mm(squares: Sequence[FloatArray], which: Flags) -> float:
    """Return the RMS length [mm] of positions with expected squares (N, 6, 6) of their errors."""
    traces = np.trace(np.concatenate(squares)[which, :3, :3], axis1=1, axis2=2)
    return 1e3 * float(np.sqrt(traces.mean()))
