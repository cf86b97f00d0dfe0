# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The linear model at a fit, with columns of everything that may have moved at some stop.

Products of all columns are summed from the end of the session and serve every stop; docs/model.md
(Judgement) has the rules of the search. Known distances between sockets say nothing about time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from calib_ros.decision.imitations import clear_size
from calib_ros.decision.movable import Moving, groups_of, of_the_arm
from calib_ros.decision.moved import ZERO
from calib_ros.decision.wires import with_terms
from calib_ros.estimation.configurations import stops
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.fitting import SOME
from calib_ros.estimation.gain import inverse_root
from calib_ros.estimation.gross_errors import SUSPICIOUS
from calib_ros.estimation.levels import LEAST_ASIDE, NEARER
from calib_ros.estimation.pixels import in_view
from calib_ros.estimation.samples import gram
from calib_ros.estimation.system import System
from calib_ros.estimation.visits import by_set
from calib_ros.estimation.weights import OUTLIER, weights_of
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray, Index


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
class OneMore:
    """What a step at each of B places explains beside others: `gains` (B,) in `rank` (B,) ways.

    The others explain the squares `before` in `ways`. Sizes are by `root` (B, K, D), `along`
    (B, D) and `lengths` (B, K).
    """

    gains: FloatArray
    rank: Index
    root: FloatArray
    along: FloatArray
    lengths: FloatArray
    before: float
    ways: int

    def size(self, number: int) -> FloatArray:
        """Return the size (K,) of the step at a number of places."""
        return clear_size(self.root[number], self.along[number], self.lengths[number])


@dataclass(frozen=True, eq=False)
class Switched:
    """Columns switched on at places (B,), by products (B, K, P + 1) with those of a scan."""

    places: Index
    products: FloatArray
    own: FloatArray
    cross: FloatArray
    vector: FloatArray

    def one_more(self, columns: Sequence[int], beside: Sequence[int] = ()) -> OneMore:
        """Return what a step of some columns explains beside those at numbers of places."""
        own, vector = self.own[:, columns][:, :, columns], self.vector[:, columns]
        cross, lengths = self.cross[:, columns], np.einsum('bii->bi', own)
        before, ways, numbers = 0.0, 0, np.arange(len(own))
        matrix = own - cross @ np.swapaxes(cross, 1, 2)
        for k in beside:
            shared = own[np.maximum(numbers, k)] - cross @ cross[k].T
            root = inverse_root(shared[k], lengths[k])
            along, ways = root.T @ vector[k], ways + int(root.any(axis=0).sum())
            before, more = before + float(along @ along), shared @ root
            matrix, vector = matrix - more @ np.swapaxes(more, 1, 2), vector - more @ along
            cross = np.concatenate([cross, more], axis=2)
        root = inverse_root(matrix, lengths)
        along = np.einsum('bij,bi->bj', root, vector)
        gains, rank = (along**2).sum(axis=1), root.any(axis=1).sum(axis=1)
        return OneMore(gains, rank, root, along, lengths, before, ways)


class Scan:
    """The linear model at a fit, with columns of everything that may have moved.

    `gross` errors count by Huber's weights (2), also none more than the median one (1), or not at
    all (0). `variance` are the squares per degree of freedom.
    """

    def __init__(self, fitted: Fitted, loaded: bool, gross: int) -> None:
        problem, names, robust = fitted.problem, fitted.names, fitted.robust
        self.problem, self.chain, self.gross = problem, robust.fit.chain, gross
        self.groups = groups_of(problem) + (of_the_arm(problem) if loaded else [])
        constant = [n for g in self.groups if g.kind == 'load' for n in g.names if n not in names]
        self.chain = self.chain.with_effects(constant)
        zeros = [joint.driven for joint in problem.chain.joints]
        constant += [zero for zero in zeros if zero not in problem.free]
        constant += dict.fromkeys(n for g in self.groups if g.kind == ZERO for n in g.names)
        names = (*names, *constant)
        self.fitted = len(names)
        self.added = list(dict.fromkeys(n for group in self.groups for n in group.names))
        self.names = list(dict.fromkeys([*names, *self.added]))
        stride = -(-robust.system.count // SOME)
        self.chosen = [np.arange(0, len(each), stride) for each in problem.sets]
        far = [d[index] for d, index in zip(robust.distances, self.chosen, strict=True)]
        self.weights = [weights_of(each, robust.loss) for each in far]
        bounded = 'huber' if gross and robust.loss != 'none' else robust.loss
        few = robust.system.select(self.chosen)
        self._even = few.weighted([None] * len(few.sets))
        seen = [in_view(self.chain, each.observations) for each in few.sets]
        weights = [weights_of(each, bounded) for each in far]
        every = np.concatenate(far)
        if bounded == 'huber' and gross == 1 and (odd := every[every > OUTLIER]).size:
            usual = float(np.median(odd))
            weights = [w * usual / np.maximum(d, usual) for w, d in zip(weights, far, strict=True)]
        weights = [w * each for w, each in zip(weights, seen, strict=True)]
        few = few.weighted(weights)
        counted = zip(few.sets, weights, strict=True)  # a sample without weight tells nothing
        self._equations = np.array([each.rows * float(np.mean(w > 0.0)) for each, w in counted])
        self.rows = _rows_of(few, self.chain, self.names)
        self.sets = sets = [samples.observations for samples in few.sets]
        order = np.argsort(np.concatenate([each.stamps_ns for each in sets]), kind='stable')
        number = np.empty(len(order), dtype=np.intp)
        number[order] = stops(np.concatenate([each.joints for each in sets])[order])
        self.numbers = by_set(number, sets)
        self.stops = int(number.max(initial=-1)) + 1
        known = replace(few, separations=()).extra_rows(self.chain, fitted.names)
        extra = np.column_stack([np.pad(known[0], ((0, 0), (0, len(constant)))), known[1]])
        held = [k for k, name in enumerate(names) if name in zeros and name in problem.given]
        extra = extra[~extra[:, held].any(axis=1)]  # a step may free a zero held too tightly
        self.given = extra.T @ extra  # products of priors
        whole = np.array([gram(rows) for rows in self.rows])
        self.products = whole.sum(axis=0)[: self.fitted, [*range(self.fitted), -1]]
        matrix = self.products + self.given[:-1]
        self._root = inverse_root(matrix[:, :-1], np.diag(matrix))
        self._known = self._root.T @ matrix[:, -1]
        left = np.zeros(len(self.names) + 1)
        left[: self.fitted], left[-1] = -self._root @ self._known, 1.0
        self._left = np.einsum('i,sij,j->s', left, whole, left)
        back = extra @ left[[*range(self.fitted), -1]]  # a step may spare priors much
        equations = float(self._equations.sum() + extra[:, :-1].any(axis=1).sum())
        self.all = float(self._left.sum() + back @ back), equations - self.fitted
        self.variance = self.all[0] / max(self.all[1], 1.0)
        usual = bool(self._left.sum() < SUSPICIOUS**2 * self._equations.sum())
        self.explained = bool(constant) and usual and fitted.noise.position >= SUSPICIOUS

    def budget(self, group: Moving) -> tuple[float, float, float]:
        """Return equations, degrees of freedom and remaining squares of a group's sets."""
        sets = list(group.sets)
        equations = float(self._equations[sets].sum())
        freedom = equations * (1.0 - self.fitted / float(self._equations.sum()))
        return equations, freedom, float(self._left[sets].sum())

    def columns(self, group: Moving) -> list[int]:
        """Return the numbers of a group's columns among those added."""
        return [self.added.index(name) for name in group.names]

    @cached_property
    def coarse(self) -> Switched:
        """Return columns switched on at stops for a coarse search."""
        some = _some_places(self.stops)
        if any(group.held for group in self.groups):
            some = np.concatenate([[0], some])
        return self.switched(some)

    def switched(self, places: Index) -> Switched:
        """Return columns switched on at places (B,)."""
        products = self._to_the_end(places)
        own = products[:, :, [self.names.index(name) for name in self.added]]
        cross = products[:, :, : self.fitted] @ self._root
        return Switched(places, products, own, cross, products[:, :, -1] - cross @ self._known)

    def joints(self, sets: Sequence[int]) -> FloatArray:
        """Return the joint values (N, n) of some sets."""
        return np.concatenate([self.sets[k].joints for k in sets])

    @cached_property
    def torn(self) -> Sequence[int]:
        """Return the ends of all gross errors if they follow each other: a side is torn off.

        Or a few poses beside a move.
        """
        numbers, weights = np.concatenate(self.numbers), np.concatenate(self.weights)
        gross = np.setdiff1d(numbers, numbers[weights > 0.0])
        alone = len(gross) > 0 and np.ptp(gross) < len(gross)
        return (int(gross[0]), int(gross[-1]) + 1) if alone else ()

    def tears(self, group: Moving, size: FloatArray) -> bool:
        """Tell whether a move of that size (K,) is as large as the gross errors `torn` off."""
        first, last = self.torn or (0, 0)
        torn = self._even.select([np.flatnonzero((first <= n) & (n < last)) for n in self.numbers])
        columns, squares = [self.names.index(name) for name in group.names], np.zeros(2)
        for rows in _rows_of(torn, self.chain, self.names):
            moved = np.tensordot(size, rows[columns], 1)
            squares += np.sum(moved**2), np.sum(rows[-1] ** 2)
        return bool(squares[0] > NEARER**2 * squares[1])

    def moving(self, group: Moving, switched: Switched) -> tuple[FloatArray, FloatArray]:
        """Return products (B, K, P + 1) of a group's moves with the fit, and (B, K, K)."""
        own = switched.products[:, self.columns(group)]
        columns = [self.names.index(name) for name in group.names]
        return own[:, :, [*range(self.fitted), -1]], own[:, :, columns]

    def _to_the_end(self, places: Index) -> FloatArray:
        """Return products (B, K, P + 1) of moved columns with all, from each stop to the end."""
        own = [self.names.index(name) for name in self.added]
        found = np.zeros((len(places), len(own), len(self.names) + 1))
        for rows, numbers in zip(self.rows, self.numbers, strict=True):
            part = np.searchsorted(places, numbers, side='right')
            order = np.argsort(part, kind='stable')
            bounds = np.searchsorted(part[order], np.arange(1, len(places) + 2)).tolist()
            ordered = rows[:, :, order]
            for k, (first, last) in enumerate(pairwise(bounds)):
                flat = ordered[:, :, first:last].reshape(len(rows), -1)
                found[k] += flat[own] @ flat.T
        return np.asarray(np.cumsum(found[::-1], axis=0)[::-1])

    def few_gross(self, group: Moving, places: Sequence[int]) -> bool:
        """Tell whether gross errors are too few in each part, or the shorter side, to be a step.

        The freedoms of a frame explain one or two positions whatever their errors.
        """
        kept = np.concatenate([self.weights[k] > 0.0 for k in group.sets])
        numbers = np.concatenate([self.numbers[k] for k in group.sets])
        gross, every = np.setdiff1d(numbers, numbers[kept]), np.unique(numbers)
        parts = (np.searchsorted(places, each, side='right') for each in (gross, every))
        odd, whole = (np.bincount(part, minlength=len(places) + 1)[::-1] for part in parts)
        sides = odd if len(places) > 1 else np.delete(odd, np.argmax(whole))
        return bool((sides < LEAST_ASIDE).all())


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
