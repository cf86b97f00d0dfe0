# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Something moved during the session: steps in time of a base, a tool or a joint's zero.

docs/model.md (Judgement) describes the search. A step adds a group of columns X to the linear
model, switched on at some stop (`scan.py`). At the fit, with J the columns of the parameters and r
the residuals, a group explains, of the remaining squares,

    e = v^T S^+ v        v = X^T r - A^T H^+ J^T r    S = X^T X - A^T H^+ A    A = J^T X

Steps of one group that are known already count among the columns J of another one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros.decision.drift import slow_cosines
from calib_ros.decision.imitations import LEAST, Imitation
from calib_ros.decision.movable import Moving
from calib_ros.decision.moved import (
    ASIDE,
    BEFORE_THAT,
    FROM_THERE,
    IN_THE_CELL,
    OF_THE_ARM,
    ZERO,
    ZEROS,
    Step,
    looks_alike,
    place_of,
    thing_of,
)
from calib_ros.decision.scan import Scan, Switched
from calib_ros.decision.trials import fault_limit
from calib_ros.estimation.configurations import STILL
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.gain import gain_of
from calib_ros.estimation.gross_errors import SUSPICIOUS
from calib_ros.estimation.leastsquares import STEP_TOLERANCE
from calib_ros.estimation.levels import CLEARLY, LEAST_ASIDE, SURE, TRIED, chance_of
from calib_ros.estimation.samples import gram
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, Flags, FloatArray, Index
from calib_ros.settings import EXCEPTION

EXPLAINED = 0.5
"""Share of the squared residuals that an explanation needs: most of them (benchmarks/harm.py)."""


def find_step(fitted: Fitted) -> Step | None:
    """Return the step that explains more than half of the residuals of a fit, if any.

    Or several steps of one thing, each of which explains as much of what the others leave. A load
    from the first pose on is fitted as well if it alone explains more than they do.
    """
    scan, found = _searched(fitted, loaded=False)
    quiet = fitted.noise.position < SUSPICIOUS
    if found is None:
        bends = not quiet
    else:
        bends = Scan(fitted, True, scan.gross).variance < found.variance
    if bends:
        scan, found = _searched(fitted, loaded=True)
    if found is not None:
        if found.stops[0] and _drifts(scan, found):
            if found.group.kind in OF_THE_ARM or fitted.problem.sets[found.group.sets[0]].socket:
                return None
            (half, *_), (zero, *_) = found.sizes, found.group.names  # the halves' means differ
            spoils = found.group.kind == 'joint' and _arm(scan, fitted).drifts_far(zero, half[0])
            found = replace(found, sizes=(2.0 * half,), slow=True, spoils=spoils)
        return _described(scan, found, quiet)
    found = _imitated(scan, fitted)
    if found is not None and fitted.robust.outliers.any():
        torn = found.group.kind in IN_THE_CELL and found.stops[0] in scan.torn
        torn = torn and scan.tears(found.group, found.sizes[0])
        scan = scan if torn else Scan(fitted, loaded=bends, gross=0)  # others are no move
        found = found if torn else _imitated(scan, fitted)
    step = None if found is None else _described(scan, found, quiet)
    return step if step is not None and step.harmful else None  # else nothing was imitated


def _searched(fitted: Fitted, loaded: bool, gross: int = 2) -> tuple[Scan, _Found | None]:
    """Return the linear model, with a constant load or without, and its best steps.

    Gross errors may be the step; the few largest may hide one that is most of them, or all.
    """
    scan = Scan(fitted, loaded, gross)
    found = _best(scan)
    few = found is None or scan.few_gross(found.group, found.stops)
    if gross and few and fitted.robust.outliers.any():
        less = _searched(fitted, loaded, gross - 1)
        if found is not None or less[1] is not None:
            return less
    return scan, found


@dataclass(frozen=True, eq=False)
class _Found:
    """A step, or several: the group, the first stops, and sizes by parameter.

    `share` is the explained share of the squares, `variance` the rest per degree of freedom; of a
    move that the arm imitates they are 1 and 0. Of several causes the least `criterion` is likely.
    """

    group: Moving
    stops: tuple[int, ...]
    sizes: tuple[FloatArray, ...]
    share: float
    variance: float
    criterion: float = 0.0
    slow: bool = False
    spoils: bool = False


def _best(scan: Scan) -> _Found | None:
    """Return the best step or steps that explain most of the squares."""
    if scan.explained or not len(scan.coarse.places):  # by what is wrong from the first pose on
        return None
    found = _best_of(scan, scan.coarse, 0.5 * EXPLAINED)
    if found is not None and found.stops[0]:
        found = _best_of(scan, scan.switched(_around(scan, found.stops)), EXPLAINED)
    elif found is not None and found.share <= EXPLAINED:
        found = None
    return _several(scan, found)


def _around(scan: Scan, places: Sequence[int]) -> Index:
    """Return the stops around places of the coarse search."""
    some, found = scan.coarse.places, list[Index]()
    for place in places:
        first = some[some < place].max(initial=LEAST_ASIDE)
        last = some[some > place].min(initial=scan.stops - LEAST_ASIDE)
        found.append(np.arange(first, last + 1))
    return np.unique(np.concatenate(found))


def _best_of(scan: Scan, switched: Switched, least: float) -> _Found | None:
    """Return the best step at some stops, if it explains that share of the squares."""
    found: _Found | None = None
    lowest, (total, free) = np.inf, scan.all
    count, trials = free + scan.fitted, scan.stops * len(scan.groups)
    for group in scan.groups:
        more = switched.one_more(scan.columns(group))
        equations, freedom, left = scan.budget(group)
        if left <= STEP_TOLERANCE**2 * equations or freedom <= more.rank.max() + 1.0:
            continue
        # a step in some sets spares the others too: steps compete by the squares of all
        rests = np.maximum(total - more.gains, 1e-12 * total)
        criteria = count * np.log(rests / total) + more.rank * np.log(count)
        k = int(np.argmin(criteria))
        gain, degrees = float(more.gains[k]), int(more.rank[k])
        share = 1.0 - max(1.0 - gain / left, 1e-12) * freedom / (freedom - degrees)
        variance = float(rests[k]) / (free - degrees)
        by_chance = trials * chance_of(gain / variance, degrees, free - degrees)
        if share > least and by_chance < 1.0 - SURE and criteria[k] < lowest:
            lowest = criteria[k] - HALF_THE_DIGITS * count  # of equals the first
            place, size = int(switched.places[k]), more.size(k)
            worth = float(criteria[k] + np.log(count))
            found = _Found(group, (place,), (size,), share, variance, worth)
    return found


def _several(scan: Scan, alone: _Found | None) -> _Found | None:
    """Return several steps of one group that explain more than a step `alone`, or that."""
    if (alone.variance if alone else scan.variance) < CLEARLY**2:
        return alone
    every = (_several_of(scan, group) for group in scan.groups if not group.held)
    found = min(filter(None, every), key=lambda each: each.criterion, default=None)
    if found is None or (alone is not None and alone.criterion <= found.criterion):
        return alone
    return alone if _drifts(scan, found) else found


def _several_of(scan: Scan, group: Moving) -> _Found | None:
    """Return several steps of a group, each of which explains most of what the others leave."""
    switched, chosen, steps = scan.coarse, list[int](), list[_Candidate]()
    for _ in range(TRIED):
        steps.append(_beside(scan, switched, group, chosen))
        chosen.append(steps[-1].number)
    if max(each.together for each in steps) <= 0.5 * EXPLAINED:
        return None
    if steps := _settled(scan, switched, group, chosen, 0.0):
        stops = switched.places[[each.number for each in steps]]
        switched = scan.switched(_around(scan, stops.tolist()))
        chosen = np.searchsorted(switched.places, stops).tolist()
        steps = _settled(scan, switched, group, chosen, EXPLAINED)
    if not steps:
        return None
    last, count = steps[-1], scan.all[1] + scan.fitted
    steps.sort(key=lambda each: each.number)
    criterion = count * np.log(last.rest / scan.all[0]) + last.degrees * np.log(count)
    return _Found(
        group,
        tuple(int(switched.places[each.number]) for each in steps),
        tuple(each.size for each in steps),
        last.together,
        last.rest / (scan.all[1] - last.degrees),
        float(criterion),
    )


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A step beside others: the number of its place, its size, its share of what they leave.

    All of them explain a share `together` and leave the squares `rest`, with so many `degrees` of
    freedom, also one for each place.
    """

    number: int
    size: FloatArray
    share: float
    together: float
    rest: float
    degrees: int


def _settled(
    scan: Scan, switched: Switched, group: Moving, chosen: list[int], least: float
) -> list[_Candidate]:
    """Return steps, each in the best place beside the others, that explain a share of the rest.

    Others are left out one by one; none if only one is left.
    """
    while len(chosen) > 1:
        steps = list[_Candidate]()
        for _ in range(2 * len(chosen)):
            steps.append(_beside(scan, switched, group, chosen[1:]))
            chosen = [*chosen[1:], steps[-1].number]
        steps = steps[len(chosen) :]
        worst = min(range(len(steps)), key=lambda k: steps[k].share)
        if steps[worst].share > least:
            return steps
        del chosen[worst]
    return []


def _beside(scan: Scan, switched: Switched, group: Moving, beside: Sequence[int]) -> _Candidate:
    """Return the best step of a group beside others; one by chance or too near has no share."""
    more, places = switched.one_more(scan.columns(group), beside), switched.places
    k = int(np.argmax(np.where(places > 0, more.gains, 0.0)))
    (equations, freedom, left), (total, free) = scan.budget(group), scan.all
    gain, rank, ways = float(more.gains[k]), int(more.rank[k]), more.ways + len(beside)
    every, degrees, share, together = more.before + gain, ways + rank + 1, 0.0, 0.0
    rest, spare = max(total - every, 1e-12 * total), min(freedom, free) - degrees
    if spare > 0.0 and left > STEP_TOLERANCE**2 * equations:
        own = max(left - every, 1e-12 * left) / (freedom - degrees)
        together = 1.0 - own * freedom / left
        chance = chance_of(gain * (free - degrees) / rest, rank, free - degrees)
        clear = scan.stops * len(scan.groups) * chance < 1.0 - SURE
        if clear and (np.abs(places[[*beside]] - places[k]) >= LEAST_ASIDE).all():
            share = 1.0 - own * (freedom - ways) / max(left - more.before, 1e-12 * left)
    return _Candidate(k, more.size(k), share, together, rest, degrees)


def _imitated(scan: Scan, fitted: Fitted) -> _Found | None:
    """Return the move of a frame, or of a zero, that the arm imitates, if any."""
    some = scan.coarse.places
    if not len(some) or all(map(scan.chain.owns_frame, fitted.names)):
        return None
    arm = _arm(scan, fitted)
    highest, found = LEAST, None
    known = {*fitted.problem.given} | {*scan.added} - {*fitted.problem.free}
    groups = [g for g in scan.groups if g.kind in IN_THE_CELL and not g.held]
    groups += [g for g in scan.groups if g.kind == 'joint' and known.isdisjoint(g.names)]
    trials = np.log(scan.stops * len(scan.groups))
    for group in groups:
        gains = arm.gains(*scan.moving(group, scan.coarse))
        k = int(np.argmax(gains))
        if gains[k] < LEAST + trials:
            continue
        first, last = some[max(k - 1, 0)], some[min(k + 1, len(some) - 1)]
        first = max(first, LEAST_ASIDE)
        rows, own = scan.moving(group, scan.switched(np.arange(first, last + 1)))
        gains = arm.gains(rows, own)
        k = int(np.argmax(gains))
        odds, size = arm.move_odds(rows[k], own[k])
        if np.isfinite(odds) and first + k in scan.torn and scan.tears(group, size):
            odds = float(gains[k])
        if odds - trials > highest:
            highest = odds - trials + HALF_THE_DIGITS * abs(odds)
            found = _Found(group, (int(first) + k,), (size,), 1.0, 0.0)
    return found


def _arm(scan: Scan, fitted: Fitted) -> Imitation:
    return Imitation(fitted, scan.names[: scan.fitted], scan.products)


def _drifts(scan: Scan, found: _Found) -> bool:
    """Tell whether a slow drift of the same group explains more than the step."""
    slow = slow_cosines(scan.stops)[1:]
    columns = [scan.names.index(name) for name in found.group.names]
    matrix = np.zeros((scan.fitted + len(columns) * len(slow) + 1,) * 2)
    for rows, numbers in zip(scan.rows, scan.numbers, strict=True):
        moving = rows[columns][:, np.newaxis] * slow[:, np.newaxis, numbers]
        wide = moving.reshape(-1, *rows.shape[1:])
        matrix += gram(np.concatenate([rows[: scan.fitted], wide, rows[-1:]]))
    ends = [*range(scan.fitted), -1]
    matrix[np.ix_(ends, ends)] += scan.given
    gain, rank, _ = gain_of(matrix, scan.fitted)
    total, free = scan.all
    return free > rank and (total - gain) / (free - rank) < found.variance


def _described(scan: Scan, found: _Found, quiet: bool) -> Step | None:
    """Return a step with later ones of the same group, or None if none is to be told.

    Residuals without gross errors are `quiet` if all samples kept are from one place.
    """
    every = (_step_of(scan, found, k) for k in range(len(found.stops)))
    steps = [*filter(None, every)]
    if len(steps) < 2:
        return next(iter(steps), None)
    after, before = FROM_THERE in steps[0].unused, BEFORE_THAT in steps[-1].unused
    unused = FROM_THERE * after or BEFORE_THAT * before or ASIDE * quiet
    return replace(steps[0], later=tuple(steps[1:]), unused=unused)


def _step_of(scan: Scan, found: _Found, number: int) -> Step | None:
    """Return one of the steps with its first sample and effect, or None if it is not told."""
    group, problem = found.group, scan.problem
    place, offsets = found.stops[number], found.sizes[number]
    if not offsets.any() and found.share < 1.0 - EXCEPTION:
        return None  # gross errors tell it, but no move explains those of a frozen device
    sets = [scan.sets[k] for k in group.sets]
    after = [scan.numbers[k] >= place for k in group.sets]
    stamp, of_set, sample = min(
        (stamp, number, k)
        for number, each, late in zip(group.sets, sets, after, strict=True)
        for stamp, k in zip(each.stamps_ns[late], scan.chosen[number][late], strict=True)
    )
    known = [Parameter(name).kind != ZERO for name in group.names]
    names = [name for name, of_arm in zip(group.names, known, strict=True) if of_arm]
    moved = [
        ErrorModel(scan.chain, names, each.base, each.tool).jacobian(each.joints[late])
        for each, late in zip(sets, after, strict=True)
    ]
    change = np.sqrt(((np.concatenate(moved) @ offsets[known]) ** 2).mean(axis=0))
    size, turn = float(np.linalg.norm(change[:3])), float(np.linalg.norm(change[3:]))
    unit, oriented = 'm', any(each.turned for each in problem.sets)
    sizes = zip(group.names, offsets.tolist(), strict=True)
    longer = {Parameter(n).owner: zero for n, zero in sizes if Parameter(n).kind == ZERO}
    if group.kind in ZEROS:
        size, unit = float(max(offsets, key=abs)), Parameter(group.names[0]).unit
    elif oriented and turn * problem.sigma_position > size * problem.sigma_orientation:
        size, unit = turn, 'rad'
    weights = np.concatenate([scan.weights[k] for k in group.sets])
    counts = np.concatenate([scan.numbers[k] for k in group.sets])
    later, near = counts >= place, range(place - LEAST_ASIDE + 1, place + LEAST_ASIDE)
    sides = (BEFORE_THAT, ~later), (FROM_THERE, later)
    most = fault_limit(problem) if unit == 'm' else problem.largest_angle
    if found.slow and abs(size) > CLEARLY * most:
        return None  # any large errors look so where the arm moves slowly
    joints = scan.joints(group.sets)
    unused = [where for where, side in sides if place and not weights[side].any()]
    seen, model = problem.sets[of_set], problem.model
    held = tuple(n for n in group.owners if not place and model.frame(n).fixed)
    return Step(
        owners=held or group.owners,
        kind=group.kind,
        thing=thing_of(group.kind, seen, several=len(group.owners) > 1),
        set=of_set,
        sample=int(sample),
        stamp_ns=int(stamp),
        size=size,
        unit=unit,
        share=found.share,
        unused=''.join(unused),
        where=place_of(problem, of_set, int(sample)),
        apart=abs(size) <= most and any(_separable(joints, counts >= k) for k in near),
        turned=_turned(scan, found.stops) if abs(size) <= most and not found.slow else '',
        instead=looks_alike(problem, group.owners[0]),
        held=bool(held),
        slow=found.slow,
        spoils=found.spoils,
        longer=longer,
    )


def _turned(scan: Scan, places: Sequence[int]) -> str:
    """Return the joint that seldom moves, but did before each of these stops; empty if none."""
    joints, numbers = scan.joints(range(len(scan.sets))), np.concatenate(scan.numbers)
    standing = joints[np.unique(numbers, return_index=True)[1]]
    moves = np.abs(np.diff(standing, axis=0, prepend=standing[:1])) > STILL
    found = moves[list(places)].all(axis=0) & (moves.mean(axis=0) < EXCEPTION)
    return str(scan.chain.joint_names[int(np.argmax(found))]) if found.any() else ''


def _separable(joints: FloatArray, after: Flags) -> bool:
    """Tell whether a plane separates joint values (N, n) by a mask (N,), nearly all of it."""
    centred, side = joints - joints.mean(axis=0), after - after.mean()
    left = side - centred @ np.linalg.lstsq(centred, side, rcond=None)[0]
    freedom = len(joints) - joints.shape[1] - 1
    return bool(left @ left * (len(joints) - 1) < EXCEPTION * freedom * (side @ side))
