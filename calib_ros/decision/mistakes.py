# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Usual mistakes, tried out but never corrected: units, conventions, joints, the wrong arm.

If the nominal arm misses the measurements by more than faulty arms do, each suspected mistake is
undone, and base and tool are refitted in closed form (`start.py`); the best few are refined by
least squares. Mistakes are named if undoing them reduces the typical error (distance plus angle
times LEVER, of all but possible gross errors) below NEARER times the original and to that of a
faulty arm, or to a tenth: an arm may be worse than faulty ones. The zero of the first joint is a
rotation of the base, that of the last joint one of the tool, so neither can be detected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, TypeAlias

import numpy as np

from calib_ros.decision import lost_rows, orders
from calib_ros.decision.diagnosis import Diagnosis
from calib_ros.decision.frozen import repeating
from calib_ros.decision.reasons import Rule
from calib_ros.decision.result import Identification
from calib_ros.decision.suspects import FIRST, ORIENTATIONS, hidden, suspects
from calib_ros.decision.trials import (
    Trial,
    as_poses,
    fault_limit,
    fits_each_side,
    in_frames,
    misfit_set,
    position_fault_limit,
    refine_trial,
    sample_errors,
    set_in_words,
    trial_of,
    trials_of,
)
from calib_ros.decision.undoing import Sets, Suspect
from calib_ros.estimation.levels import (
    ALIKE,
    CLEARLY,
    CONFIDENT,
    FEW,
    LEAST_ASIDE,
    MOST_OUTLIERS,
    NEARER,
    SEVERAL,
    TRIED,
)
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.start import flange, reframed
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import IN_A_FRAME
from calib_ros.kinematics.se3 import norms
from calib_ros.settings import EXCEPTION, LEVER
from calib_ros.shown import are_lines, rows_in_words

Tries: TypeAlias = Sequence[tuple[Trial, Suspect]]


def with_mistake(problem: Problem, result: Identification) -> Identification:
    """Return the result with the mistake that explains its errors, if any.

    It becomes the first refusal, in place of those that follow from it with the same advice: a
    held frame found wrong by the misfit, or no gain beyond the uncertainty. Remarks are those of a
    fit that explains nothing: it replaces them, too. But another arm, and orientations that do not
    fit, only give a remark if nothing else refuses the result. A move that leaves one side out
    explains all if the arm fits both: it comes first then.
    """
    found, step = None, result.step
    if _suspicious(problem, result):
        if step and step.unused and fits_each_side(problem, problem.sets[step.set], step.stamp_ns):
            return result
        found = diagnose(problem)
    if found is None or (step and step.held and len(step.owners) > 1 and found.of_frames):
        return result  # the step names all of them
    if result.refusals or found.alone:
        follow = (Rule.MISTAKE, Rule.REGION)
        others = (each for each in result.refusals if each.rule not in follow)
        return replace(result, refusals=(found.reason, *others), remarks=())
    return replace(result, remarks=tuple(dict.fromkeys([str(found), *result.remarks])))


def _suspicious(problem: Problem, result: Identification) -> bool:
    """Tell whether errors, before or after, are larger than those of faulty arms.

    Couplings may explain most of any residuals, and a diverging fit everything.
    """
    if not result.converged or (not result.refusals and result.coupled):
        return True
    judged, most = result.comparison, position_fault_limit(problem)
    for each in (*judged.figures_of_all, result.fitted.figures_of_all[0]):
        error, angle = 1e-3 * each.rms_mm, 1e-3 * (each.rms_mrad or 0.0)
        if error > most or angle > problem.largest_angle:
            return True
    limits = problem.largest_length, problem.largest_angle
    far = any(each.beyond(*limits) for each in result.parameters)
    return far or judged.share_of_outliers > MOST_OUTLIERS


def diagnose(problem: Problem, far: bool = False) -> Diagnosis | None:
    """Return what explains the measurements much better than the given input, if anything.

    With `far` only if the arm as given, in its best frames, is further off than faulty arms. What
    is measured tells more than balls in sockets, which come after it.
    """
    images = _has_images(problem)
    seen = [e for e in problem.sets if e.distances is None and (e.pixels is not None) == images]
    sets = [as_poses(problem, each) for each in seen]
    kinds = ([each for each in sets if each.socket == socket] for socket in (False, True))
    tried = (_diagnosed(problem, tuple(kind), far) for kind in kinds if kind)
    return next(filter(None, tried), None)


def _diagnosed(problem: Problem, sets: Sets, far: bool) -> Diagnosis | None:
    """Return what explains the measurements of some sets, as `diagnose`."""
    if max(map(len, sets)) < IN_A_FRAME:
        return None  # base and tool alone explain nearly all of them
    base, tool = (f if f and f.fixed else None for f in (problem.chain.base, problem.chain.tool))
    chain, where = replace(problem.chain, base=base, tool=tool), ''
    if not sets[0].socket:
        sets, where = misfit_set(problem, chain, sets)
    given = in_frames(problem, chain, sets)
    largest = fault_limit(problem)
    if far and given.error <= largest:
        return None
    missing = None if _has_images(problem) else orders.constant_axes(chain, given.sets)
    found = missing and Diagnosis((missing,), given.error, np.nan)  # no change restores it
    found = found or _of_tables(problem, chain, sets, given, lost_rows.row_loss, largest)
    if not found:
        tried, nearer = _best_trials(problem, chain, sets, given), NEARER * given.error
        found = (
            _named(problem, given, tried)
            or _of_tables(problem, chain, sets, given, orders.in_turn, min(largest, nearer))
            or _of_repeats(problem, given.chain, _shift_joints(problem, sets[0], 0))
            or _wrong_rotations(problem, chain, sets, given, tried)
            or _in_some_rows(problem, chain, sets, given)
            or _beam_search(problem, chain, given)
            or _named(problem, given, tried, inexact=True)
            or _of_tables(problem, chain, sets, given, orders.other_order, largest)
            or _beyond_reach(problem, given)
        )
    return found and _for_messages(problem, replace(found, where=where + found.where))


def _beyond_reach(problem: Problem, given: Trial) -> Diagnosis | None:
    """Return that the positions are in another unit, whatever else is wrong with them."""
    for each in given.sets:
        beyond = '' if each.inverse or each.socket else problem.beyond_reach(each.positions)
        if beyond:
            asked = 'are they in mm{}, with something else wrong as well, or of several devices{}?'
            remedy = asked.format(' (--length mm)', ' (column device)')
            suspect = Suspect(f'the positions {beyond}', remedy, published=asked.format('', ''))
            return Diagnosis((suspect,), given.error, np.nan)
    return None


def _for_messages(problem: Problem, found: Diagnosis) -> Diagnosis:
    """Return what explains the measurements with remedies for messages, if these were some."""
    if not problem.of_messages:
        return found
    named = tuple(replace(each, remedy=each.published) for each in found.suspects)
    return replace(found, suspects=named)


def diagnose_alone(problem: Problem, chain: Chain) -> Diagnosis | None:
    """Return what explains the measurements that a known chain misses by more than faulty arms."""
    sets = [each for each in problem.all_sets if each.distances is None and each.pixels is None]
    for each in sets:
        if found := _of_rows(problem, chain, each) or _of_repeats(problem, chain, each):
            where = set_in_words(sets, each) + found.where
            return _for_messages(problem, replace(found, where=where))
    return None


def _of_rows(problem: Problem, chain: Chain, seen: Observations) -> Diagnosis | None:
    """Return what explains the rows that a chain misses by more than faulty arms.

    Its frames hold for them too, so few rows tell as much as many.
    """
    far = sample_errors(chain, seen, flange(chain, seen)) > fault_limit(problem)
    rows = np.flatnonzero(far)
    if len(rows) < LEAST_ASIDE:
        return None
    chain = reframed(chain, (seen.base, seen.tool), fixed=True)
    given = trial_of(chain, (seen.select(rows).spread(),))
    found = _named(problem, given, _best_trials(problem, chain, given.sets, given, of_rows=True))
    if found is None or len(rows) == len(seen):
        return found
    poses = rows_in_words(rows.tolist(), seen.stamps_ns, problem.of_messages)
    counted = not (problem.of_messages or are_lines(seen.stamps_ns))
    among = f' of {len(seen)}' * counted
    alike = 'write them as the others ({} reads them)'
    named = (replace(each, remedy=alike.format(each.remedy)) for each in found.suspects)
    where = f'in {poses}{among} alone, '
    return replace(found, suspects=tuple(named), where=where)


def _has_images(problem: Problem) -> bool:
    return any(each.pixels is not None for each in problem.sets)


def _best_trials(
    problem: Problem, chain: Chain, sets: Sets, given: Trial, of_rows: bool = False
) -> Tries:
    """Return the arm with the mistakes undone that explain most, the best first.

    With `of_rows` only mistakes made in each row alone.
    """
    tried, of_images = list[tuple[Suspect, Chain, Sets]](), _has_images(problem)
    likely = suspects(chain, given.sets, of_images)
    for each in (*likely, *orders.in_any_order(chain, given.sets[0], of_images)):
        if of_rows and (each.chain is not None or not each.changes):
            continue
        few = given.sets
        if each.rows:
            few = tuple(_shift_joints(problem, one, each.rows).spread() for one in sets)
        tried.append((each, each.chain or chain, each.undo_in(few)))
    rough = zip(trials_of(one[1:] for one in tried), (each for each, *_ in tried), strict=True)
    better = (one for one in rough if one[0].share < given.share)
    best = sorted(better, key=_rounded_share)[:TRIED]
    return sorted(((refine_trial(problem, one), each) for one, each in best), key=_rounded_share)


def _rounded_share(tried: tuple[Trial, Suspect]) -> float:
    """Return the share of a trial that rounding leaves alone: equivalent ones keep their order."""
    return float(f'{tried[0].share:.6g}')


def _named(
    problem: Problem, given: Trial, tried: Tries, inexact: bool = False
) -> Diagnosis | None:
    """Return the mistakes that explain the measurements best.

    Of those that explain a usual share of the samples alike the ones that also explain the rest:
    where one joint moves at a time, few rows show a mistake in it. With `inexact` the arm may be
    worse than faulty ones, if a tenth of the error is left at most.
    """
    most = EXCEPTION * min(given.share, 1.0) if inexact else 0.0
    # an arm in mm fits places in mm, and is off by metres
    good = [x for x in tried if x[0].error <= fault_limit(problem) or x[0].share <= most]
    if not good:
        return None
    best, least = good[0][0], good[0][0].share
    if best.error > NEARER * given.error or least > NEARER * min(given.share, 1.0):
        return None
    alike = [x for x in good if x[0].share <= ALIKE * least]
    all_of_it = ALIKE * min(one.whole for one, _ in alike)
    alike = [x for x in alike if x[0].whole <= all_of_it]
    lowest = min(each.rank for _, each in alike)
    named = [each for _, each in alike if each.rank == lowest]
    named += [each for one, each in good if ALIKE * least < one.share <= least / NEARER]
    unlike = {(each.what, each.remedy): each for each in named}
    return Diagnosis(tuple(unlike.values())[:SEVERAL], given.error, best.error)


def _of_tables(
    problem: Problem,
    chain: Chain,
    sets: Sets,
    given: Trial,
    search: Callable[[Problem, Chain, Observations, float], tuple[Suspect, float] | None],
    most: float,
) -> Diagnosis | None:
    """Return what is wrong with the rows of tables of one set, if that explains all.

    The arm as corrected has errors of up to `most` [m].
    """
    if len(sets) > 1 or sets[0].socket:
        return None
    if (found := search(problem, chain, _shift_joints(problem, sets[0], 0), most)) is None:
        return None
    suspect, error = found
    # the typical error tells nothing if most rows are right
    corrected = error if error < NEARER * given.error else np.nan
    return Diagnosis((suspect,), given.error, corrected)


def _of_repeats(problem: Problem, chain: Chain, seen: Observations) -> Diagnosis | None:
    largest = fault_limit(problem)
    far = sample_errors(chain, seen, flange(chain, seen)) > largest
    odd = repeating(chain, seen, far, largest, problem.of_messages)
    return None if odd is None else Diagnosis(odd[:1], np.nan, np.nan)


def _in_some_rows(problem: Problem, chain: Chain, sets: Sets, given: Trial) -> Diagnosis | None:
    """Return what is wrong with some rows, if the arm explains the others.

    These may be nearly all rows, those clearly nearer than the rest, a third at one end of the
    session, or every second row.
    """
    if len(sets) > 1 or sets[0].socket or _has_images(problem):
        return None
    whole = _shift_joints(problem, sets[0], 0)
    rows, third, sizes = np.arange(len(whole)), len(whole) // 3, norms(whole.given)
    order = np.sort(sizes)
    least = order[:-1].max(initial=0.0, where=order[1:] > CLEARLY * order[:-1])
    parts = [sizes <= least]
    if third >= 2 * IN_A_FRAME:
        parts += [rows < third, rows >= 2 * third, rows % 2 == 0, rows % 2 == 1]
    some = (whole.select(part) for part in parts if part.sum() >= FEW)
    for one in (given, *(in_frames(problem, chain, (each,)) for each in some)):
        if one.error <= fault_limit(problem) and (found := _of_rows(problem, one.chain, whole)):
            return found
    return None


def _wrong_rotations(
    problem: Problem, chain: Chain, sets: Sets, given: Trial, tried: Tries
) -> Diagnosis | None:
    """Return that the orientations are wrong, if the positions are explained."""
    whole = all(each.oriented.all() and not (each.socket or each.inverse) for each in sets)
    if _has_images(problem) or not whole:
        return None
    alone = tuple(each.without_orientations() for each in sets)
    placed = in_frames(problem, chain, alone)
    if placed.error <= min(problem.largest_error, NEARER * given.error):
        known = placed.error + LEVER * problem.sigma_orientation
        enough = known < NEARER * given.error
        return Diagnosis((ORIENTATIONS,), given.error, placed.error) if enough else None
    if _named(problem, given, tried, inexact=True):
        return None  # with their orientations
    found = _named(problem, placed, _best_trials(problem, chain, alone, placed))
    if found is None or len(found.suspects) > 1:
        return None
    what = f'{found.suspects[0].what}, and the orientations do not fit either'
    return replace(found, suspects=(replace(found.suspects[0], what=what),))


def _beam_search(problem: Problem, chain: Chain, given: Trial) -> Diagnosis | None:
    """Return simultaneous mistakes, each of which explains part of the errors.

    Beam search: another mistake is added to each of the best few, until the arm explains the rest
    or another is no better. The first may be no better alone: two mistakes can hide each other. So
    these are tried together (`hidden`).
    """
    if given.error <= position_fault_limit(problem):
        return None
    few = given.sets
    options = [each for each in suspects(chain, few, _has_images(problem)) if each.part]
    largest, least = min(fault_limit(problem), NEARER * given.error), given.share
    share = NEARER * min(least, 1.0)
    kept: list[tuple[Suspect, ...]] = [()]

    @cache
    def undone(these: tuple[Suspect, ...]) -> Sets:
        return these[-1].undo_in(undone(these[:-1])) if these else few

    for number in range(SEVERAL + 1):  # several of joints, one of the poses
        found: dict[float, tuple[Trial, tuple[Suspect, ...]]] = {}
        tried = dict[tuple[Suspect, ...], None]()
        together = [(*these, each) for these in kept for each in options]
        for these in together if number else [*together, *hidden(chain, options)]:
            if len({one.part for one in these}) == len(these):
                more = tuple(sorted(these, key=lambda one: (*FIRST, one.part).index(one.part)))
                tried[more] = None
        trials = trials_of((chain, undone(more)) for more in tried)
        for more, trial in zip(tried, trials, strict=True):
            found.setdefault(round(trial.share, 6), (trial, more))  # first of equivalent ones
        best = [found[key] for key in sorted(found)[:TRIED]]
        if not best or (number and best[0][0].share > CONFIDENT * least):
            return None
        least = best[0][0].share
        polished = refine_trial(problem, best[0][0])
        kept = [these for _, these in best]
        if len(kept[0]) > 1 and polished.error <= largest and polished.share <= share:
            return Diagnosis((_merge_suspects(kept[0]),), given.error, polished.error)
    return None


def _merge_suspects(mistakes: Sequence[Suspect]) -> Suspect:
    of_tables = [f'{e.what} ({e.published if e.in_file else e.remedy})' for e in mistakes]
    published = [f'{e.what} ({e.published})' for e in mistakes]
    what = 'several mistakes at once'
    return Suspect(what, '; '.join(of_tables), published='; '.join(published))


def _shift_joints(problem: Problem, each: Observations, rows: int) -> Observations:
    """Return measurements with the joint values `rows` below, held-out rows included."""
    same = [e for e in problem.judging if (e.base, e.tool) == (each.base, each.tool)]
    parts = [each, *(as_poses(problem, e) for e in same if e.distances is None)]
    order = np.argsort(np.concatenate([e.stamps_ns for e in parts]), kind='stable')
    measured, reported = (slice(max(0, n), min(0, n) or None) for n in (-rows, rows))
    joined: dict[str, Any] = {}
    names = ('stamps_ns', 'joints', 'positions', 'rotations', 'oriented')
    for name in (*names, *(('points',) * each.seen)):
        ordered = np.concatenate([getattr(e, name) for e in parts])[order]
        joined[name] = ordered[reported if name == 'joints' else measured]
    kept = {name: getattr(each, name) for name in ('base', 'tool', 'socket', 'inverse')}
    return Observations(**joined, **kept)
