# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Something moved during the session: one step in time of a base, a tool or a joint's zero.

docs/model.md (Judgement) describes the search. A step adds a group of columns X to the linear
model, switched on at some stop. At the fit, with J the columns of the parameters and r the
residuals, a group explains, of the remaining squares,

    e = v^T S^+ v        v = X^T r - A^T H^+ J^T r    S = X^T X - A^T H^+ A    A = J^T X

Products of all columns are summed from the end of the session and serve every stop; docs/model.md
(Judgement) has the rules of the search. Known distances between sockets say nothing about time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from calib_ros.decision.drift import slow_cosines
from calib_ros.decision.imitations import LEAST, Imitation, clear_size
from calib_ros.decision.movable import Moving, groups_of, of_the_arm
from calib_ros.decision.moved import (
    BEFORE_THAT,
    FROM_THERE,
    IN_THE_CELL,
    ZERO,
    ZEROS,
    Step,
    place_of,
    thing_of,
)
from calib_ros.decision.trials import largest_of
from calib_ros.decision.wires import with_terms
from calib_ros.estimation.configurations import stops
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.fitting import SOME
from calib_ros.estimation.gain import gain_of, inverse_root
from calib_ros.estimation.gross_errors import SUSPICIOUS
from calib_ros.estimation.leastsquares import STEP_TOLERANCE
from calib_ros.estimation.levels import CLEARLY, LEAST_ASIDE, SURE, chance_of
from calib_ros.estimation.pixels import in_view
from calib_ros.estimation.samples import gram
from calib_ros.estimation.system import System
from calib_ros.estimation.weights import weights_of
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, Flags, FloatArray, Index
from calib_ros.settings import EXCEPTION

EXPLAINED = 0.5
"""Share of the squared residuals that an explanation needs: most of them (benchmarks/harm.py)."""


def find_step(fitted: Fitted) -> Step | None:
    """Return the step that explains more than half of the residuals of a fit, if any.

    Of those beside a load from the first pose on, if that alone explains more than the step.
    """
    scan, found = _searched(fitted, loaded=False)
    if found is None:
        bends = fitted.noise.position >= SUSPICIOUS
    else:
        bends = _Scan(fitted, True, scan.gross).variance < found.variance
    if bends:
        scan, found = _searched(fitted, loaded=True)
    if found is not None:
        if found.stop and scan.drifts(found):
            in_cell = found.group.kind in IN_THE_CELL
            if not in_cell or fitted.problem.sets[found.group.sets[0]].socket:
                return None
            found = replace(found, size=2.0 * found.size, slow=True)  # the halves' means differ
        return scan.described(found)
    found = scan.imitated(fitted)
    torn = found is not None and found.group.kind in IN_THE_CELL and scan.torn
    if found is not None and not torn and fitted.robust.outliers.any():
        scan = _Scan(fitted, loaded=bends, gross=False)  # these gross errors are no move
        found = scan.imitated(fitted)
    step = None if found is None else scan.described(found)
    return step if step is not None and step.harmful else None  # else nothing was imitated


def _searched(fitted: Fitted, loaded: bool, gross: bool = True) -> tuple[_Scan, _Found | None]:
    """Return the linear model, with a constant load or without, and its best step.

    Gross errors may be the step, or hide it.
    """
    scan = _Scan(fitted, loaded, gross)
    found = scan.best()
    if gross and fitted.robust.outliers.any() and (found is None or scan.few_gross(found)):
        without = _searched(fitted, loaded, gross=False)
        if found is not None or without[1] is not None:
            return without
    return scan, found


def _some_places(stops: int) -> Index:
    """Return stops for a coarse search: spaced by a tenth of those on the shorter side.

    A step between two of them is still explained to nine tenths.
    """
    every = range(LEAST_ASIDE, stops - LEAST_ASIDE + 1)
    some = [*every[:1]]
    while some and some[-1] < every[-1]:
        aside = min(some[-1], stops - some[-1])
        some.append(min(some[-1] + max(aside // 10, 1), every[-1]))
    return np.array(some, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class _Found:
    """A step: its group, its first stop, and its size by parameter.

    `share` is the explained share of the squares, `variance` the rest per degree of freedom; of a
    move that the arm imitates they are 1 and 0.
    """

    group: Moving
    stop: int
    size: FloatArray
    share: float
    variance: float
    slow: bool = False


class _Scan:
    """The linear model at a fit, with columns of everything that may have moved."""

    def __init__(self, fitted: Fitted, loaded: bool, gross: bool) -> None:
        problem, names, robust = fitted.problem, fitted.names, fitted.robust
        self._problem, self._chain, self.gross = problem, robust.fit.chain, gross
        self._groups = groups_of(problem) + (of_the_arm(problem) if loaded else [])
        constant = [n for g in self._groups if g.kind == 'load' for n in g.names if n not in names]
        self._chain = self._chain.with_effects(constant)
        zeros = [joint.driven for joint in problem.chain.joints]
        constant += [zero for zero in zeros if zero not in problem.free]
        constant += dict.fromkeys(n for g in self._groups if g.kind == ZERO for n in g.names)
        names = (*names, *constant)
        self._fitted = len(names)
        self._added = list(dict.fromkeys(n for group in self._groups for n in group.names))
        self._names = list(dict.fromkeys([*names, *self._added]))
        share = -(-robust.system.count // SOME)
        self._chosen = [np.arange(0, len(each), share) for each in problem.sets]
        far = [d[index] for d, index in zip(robust.distances, self._chosen, strict=True)]
        self._weights = [weights_of(each, robust.loss) for each in far]
        bounded = 'huber' if gross and robust.loss != 'none' else robust.loss
        few = robust.system.select(self._chosen)
        seen = [in_view(self._chain, each.observations) for each in few.sets]
        weights = (weights_of(each, bounded) for each in far)
        few = few.weighted([w * each for w, each in zip(weights, seen, strict=True)])
        self._equations = np.array([float(samples.rows) for samples in few.sets])
        self._rows = _rows_of(few, self._chain, self._names)
        self._sets = sets = [samples.observations for samples in few.sets]
        order = np.argsort(np.concatenate([each.stamps_ns for each in sets]), kind='stable')
        number = np.empty(len(order), dtype=np.intp)
        number[order] = stops(np.concatenate([each.joints for each in sets])[order])
        self._numbers = np.split(number, np.cumsum([len(each) for each in sets])[:-1])
        self._stops = int(number.max(initial=-1)) + 1
        known = replace(few, separations=()).extra_rows(self._chain, fitted.names)
        extra = np.column_stack([np.pad(known[0], ((0, 0), (0, len(constant)))), known[1]])
        held = [k for k, name in enumerate(names) if name in zeros and name in problem.given]
        extra = extra[~extra[:, held].any(axis=1)]  # a step may free a zero held too tightly
        self._given = extra.T @ extra  # products of priors
        whole = np.array([gram(rows) for rows in self._rows])
        self._products = whole.sum(axis=0)[: self._fitted, [*range(self._fitted), -1]]
        matrix = self._products + self._given[:-1]
        self._root = inverse_root(matrix[:, :-1], np.diag(matrix))
        self._known = self._root.T @ matrix[:, -1]
        left = np.zeros(len(self._names) + 1)
        left[: self._fitted], left[-1] = -self._root @ self._known, 1.0
        self._left = np.einsum('i,sij,j->s', left, whole, left)
        back = extra @ left[[*range(self._fitted), -1]]  # a step may spare priors much
        equations = float(self._equations.sum() + extra[:, :-1].any(axis=1).sum())
        self._all = float(self._left.sum() + back @ back), equations - self._fitted
        self.variance = self._all[0] / max(self._all[1], 1.0)
        usual = bool(self._left.sum() < SUSPICIOUS**2 * self._equations.sum())
        self.explained = bool(constant) and usual and fitted.noise.position >= SUSPICIOUS

    def _budget(self, group: Moving) -> tuple[float, float, float]:
        """Return equations, degrees of freedom and remaining squares of a group's sets."""
        sets = list(group.sets)
        equations = float(self._equations[sets].sum())
        freedom = equations * (1.0 - self._fitted / float(self._equations.sum()))
        return equations, freedom, float(self._left[sets].sum())

    def best(self) -> _Found | None:
        """Return the best step, if it explains most of the squares."""
        if self.explained:  # by what is wrong from the first pose on
            return None
        some, products = self._coarse
        near = self._best_of(some, products, 0.5 * EXPLAINED) if len(some) else None
        if near is None or near.stop == 0:
            return near if near is not None and near.share > EXPLAINED else None
        first = some[some < near.stop].max(initial=LEAST_ASIDE)
        last = some[some > near.stop].min(initial=self._stops - LEAST_ASIDE)
        places = np.arange(first, last + 1)
        return self._best_of(places, self._to_the_end(places), EXPLAINED)

    @cached_property
    def _coarse(self) -> tuple[Index, FloatArray]:
        """Return stops for a coarse search, and products from each to the end."""
        some = _some_places(self._stops)
        if any(group.held for group in self._groups):
            some = np.concatenate([[0], some])
        return some, self._to_the_end(some)

    def _best_of(self, places: Index, products: FloatArray, least: float) -> _Found | None:
        """Return the best step at some stops, if it explains that share of the squares."""
        own = products[:, :, [self._names.index(name) for name in self._added]]
        cross = products[:, :, : self._fitted] @ self._root
        matrix = own - cross @ np.swapaxes(cross, 1, 2)
        vector = products[:, :, -1] - cross @ self._known
        lengths = np.einsum('bii->bi', own)
        found: _Found | None = None
        lowest, (total, free) = np.inf, self._all
        count, trials = free + self._fitted, self._stops * len(self._groups)
        for group in self._groups:
            columns = [self._added.index(name) for name in group.names]
            root = inverse_root(matrix[:, columns][:, :, columns], lengths[:, columns])
            rank = root.any(axis=1).sum(axis=1)
            along = np.einsum('bij,bi->bj', root, vector[:, columns])
            equations, freedom, left = self._budget(group)
            if left <= STEP_TOLERANCE**2 * equations or freedom <= rank.max() + 1.0:
                continue
            gains = (along**2).sum(axis=1)
            # a step in some sets spares the others too: steps compete by the squares of all
            rests = np.maximum(total - gains, 1e-12 * total)
            criteria = count * np.log(rests / total) + rank * np.log(count)
            k = int(np.argmin(criteria))
            gain, degrees = float(gains[k]), int(rank[k])
            share = 1.0 - max(1.0 - gain / left, 1e-12) * freedom / (freedom - degrees)
            variance = float(rests[k]) / (free - degrees)
            by_chance = trials * chance_of(gain / variance, degrees, free - degrees)
            if share > least and by_chance < 1.0 - SURE and criteria[k] < lowest:
                lowest = criteria[k] - HALF_THE_DIGITS * count  # of equals the first
                size = clear_size(root[k], along[k], lengths[k, columns])
                found = _Found(group, int(places[k]), size, share, variance)
        return found

    def imitated(self, fitted: Fitted) -> _Found | None:
        """Return the move of a frame, or of a zero, that the arm imitates, if any."""
        some, every = self._coarse
        if not len(some) or all(map(self._chain.owns_frame, fitted.names)):
            return None
        arm = Imitation(fitted, self._names[: self._fitted], self._products)
        highest, found = LEAST, None
        known = {*fitted.problem.given} | {*self._added} - {*fitted.problem.free}
        groups = [g for g in self._groups if g.kind in IN_THE_CELL and not g.held]
        groups += [g for g in self._groups if g.kind == 'joint' and known.isdisjoint(g.names)]
        trials = np.log(self._stops * len(self._groups))
        for group in groups:
            gains = arm.gains(*self._moving(group, every))
            k = int(np.argmax(gains))
            if gains[k] < LEAST + trials:
                continue
            first, last = some[max(k - 1, 0)], some[min(k + 1, len(some) - 1)]
            first = max(first, LEAST_ASIDE)
            rows, own = self._moving(group, self._to_the_end(np.arange(first, last + 1)))
            gains = arm.gains(rows, own)
            k = int(np.argmax(gains))
            odds, size = arm.move_odds(rows[k], own[k])
            if np.isfinite(odds) and first + k in self.torn:
                odds = float(gains[k])
            if odds - trials > highest:
                highest = odds - trials + HALF_THE_DIGITS * abs(odds)
                found = _Found(group, int(first) + k, size, 1.0, 0.0)
        return found

    @cached_property
    def torn(self) -> Sequence[int]:
        """Return the ends of all gross errors if they follow each other: a side is torn off."""
        numbers, weights = np.concatenate(self._numbers), np.concatenate(self._weights)
        gross = np.setdiff1d(numbers, numbers[weights > 0.0])
        alone = len(gross) >= LEAST_ASIDE and np.ptp(gross) < len(gross)
        return (int(gross[0]), int(gross[-1]) + 1) if alone else ()

    def _moving(self, group: Moving, products: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return products (B, K, P + 1) of a group's moves with the fit, and (B, K, K)."""
        own = products[:, [self._added.index(name) for name in group.names]]
        columns = [self._names.index(name) for name in group.names]
        return own[:, :, [*range(self._fitted), -1]], own[:, :, columns]

    def _to_the_end(self, places: Index) -> FloatArray:
        """Return products (B, K, P + 1) of moved columns with all, from each stop to the end."""
        own = [self._names.index(name) for name in self._added]
        found = np.zeros((len(places), len(own), len(self._names) + 1))
        for rows, numbers in zip(self._rows, self._numbers, strict=True):
            part = np.searchsorted(places, numbers, side='right')
            order = np.argsort(part, kind='stable')
            bounds = np.searchsorted(part[order], np.arange(1, len(places) + 2)).tolist()
            ordered = rows[:, :, order]
            for k, (first, last) in enumerate(pairwise(bounds)):
                flat = ordered[:, :, first:last].reshape(len(rows), -1)
                found[k] += flat[own] @ flat.T
        return np.asarray(np.cumsum(found[::-1], axis=0)[::-1])

    def few_gross(self, found: _Found) -> bool:
        """Tell whether gross errors on the shorter side are too few to be a step themselves.

        The freedoms of a frame explain one or two positions whatever their errors.
        """
        sets = found.group.sets
        kept = np.concatenate([self._weights[k] > 0.0 for k in sets])
        numbers = np.concatenate([self._numbers[k] for k in sets])
        gross, every = np.setdiff1d(numbers, numbers[kept]), np.unique(numbers)
        after = 2 * np.count_nonzero(every >= found.stop) < len(every)
        return bool(np.count_nonzero((gross >= found.stop) == after) < LEAST_ASIDE)

    def drifts(self, found: _Found) -> bool:
        """Tell whether a slow drift of the same group explains more than the step."""
        slow = slow_cosines(self._stops)[1:]
        columns = [self._names.index(name) for name in found.group.names]
        matrix = np.zeros((self._fitted + len(columns) * len(slow) + 1,) * 2)
        for rows, numbers in zip(self._rows, self._numbers, strict=True):
            moving = rows[columns][:, np.newaxis] * slow[:, np.newaxis, numbers]
            wide = moving.reshape(-1, *rows.shape[1:])
            matrix += gram(np.concatenate([rows[: self._fitted], wide, rows[-1:]]))
        ends = [*range(self._fitted), -1]
        matrix[np.ix_(ends, ends)] += self._given
        gain, rank, _ = gain_of(matrix, self._fitted)
        total, free = self._all
        return free > rank and (total - gain) / (free - rank) < found.variance

    def described(self, found: _Found) -> Step | None:
        """Return a step with its first sample and its effect, but no far slow motion."""
        group, problem = found.group, self._problem
        sets = [self._sets[k] for k in group.sets]
        after = [self._numbers[k] >= found.stop for k in group.sets]
        stamp, of_set, sample = min(
            (stamp, number, k)
            for number, each, late in zip(group.sets, sets, after, strict=True)
            for stamp, k in zip(each.stamps_ns[late], self._chosen[number][late], strict=True)
        )
        known = [Parameter(name).kind != ZERO for name in group.names]
        names = [name for name, of_arm in zip(group.names, known, strict=True) if of_arm]
        moved = [
            ErrorModel(self._chain, names, each.base, each.tool).jacobian(each.joints[late])
            for each, late in zip(sets, after, strict=True)
        ]
        change = np.sqrt(((np.concatenate(moved) @ found.size[known]) ** 2).mean(axis=0))
        size, turn = float(np.linalg.norm(change[:3])), float(np.linalg.norm(change[3:]))
        unit, oriented = 'm', any(each.turned for each in problem.sets)
        sizes = zip(group.names, found.size.tolist(), strict=True)
        longer = {Parameter(n).owner: zero for n, zero in sizes if Parameter(n).kind == ZERO}
        if group.kind in ZEROS:
            size, unit = float(np.abs(found.size).max()), Parameter(group.names[0]).unit
        elif oriented and turn * problem.sigma_position > size * problem.sigma_orientation:
            size, unit = turn, 'rad'
        weights = np.concatenate([self._weights[k] for k in group.sets])
        later = np.concatenate(after)
        sides = (BEFORE_THAT, ~later), (FROM_THERE, later)
        most = largest_of(problem) if unit == 'm' else problem.largest_angle
        if found.slow and size > CLEARLY * most:
            return None  # any large errors look so where the arm moves slowly
        joints = np.concatenate([each.joints for each in sets])
        unused = [where for where, side in sides if found.stop and not weights[side].any()]
        seen, model = problem.sets[of_set], problem.model
        held = tuple(n for n in group.owners if not found.stop and model.frame(n).fixed)
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
            apart=size <= most and _separable(joints, later),
            held=bool(held),
            slow=found.slow,
            longer=longer,
        )


def _separable(joints: FloatArray, after: Flags) -> bool:
    """Tell whether a plane separates joint values (N, n) by a mask (N,), nearly all of it."""
    centred, side = joints - joints.mean(axis=0), after - after.mean()
    left = side - centred @ np.linalg.lstsq(centred, side, rcond=None)[0]
    freedom = len(joints) - joints.shape[1] - 1
    return bool(left @ left * (len(joints) - 1) < EXCEPTION * freedom * (side @ side))


def _rows_of(system: System, chain: Chain, names: Sequence[str]) -> list[FloatArray]:
    """Return the rows of a system as it does, also by zeros of distances."""
    zeros = [name for name in map(Parameter, names) if name.kind == ZERO]
    others = [name for name in names if name not in zeros]
    order, wires = [[*others, *zeros].index(name) for name in names], [z.owner for z in zeros]
    rows = system.rows_of(chain, others)
    for k, samples in enumerate(system.sets if zeros else ()):
        longer = np.ones((1, len(samples.observations)))
        rows[k] = with_terms(rows[k], samples, wires, longer)[[*order, -1]]
    return rows
