# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The linear model about a geometric fit: predictions with further effects, without refitting.

Every effect adds a column at that fit. The residual of a held-out fold is r - J_S beta, with beta
from the other folds. Folds are dealt in two ways, sample by sample and in blocks of successive
samples; both must agree, because neighbours share errors.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import linalg

from calib_ros.decision.comparison import COUNTS, GroupVerdict, log_gain
from calib_ros.decision.drift import ShiftProducts, Shifts, chance
from calib_ros.decision.result import Identification
from calib_ros.estimation.identifiability import independent
from calib_ros.estimation.levels import CERTAIN, CONFIDENT, SURE
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.posterior import size_group
from calib_ros.estimation.problem import Learned, Problem
from calib_ros.estimation.samples import gram
from calib_ros.estimation.system import row_samples, stacked
from calib_ros.estimation.visits import by_set, numbered
from calib_ros.kinematics import effects
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, ROUNDING, FloatArray
from calib_ros.progress import Notify, quiet

HARMONICS = range(3, 41)
"""Harmonics per turn of a joint to search; 1 and 2 belong to the eccentricities."""
COMPARED = 15 * SOME_POSES
"""Samples that effects are compared on; larger sets are thinned to save time. By 2,000 errors
are the same within 1e-4 (benchmarks/real_robots.py)."""


class LinearModel:
    """The linear model about a geometric fit; columns of effects are computed on demand.

    The first column is the residual. At sockets no device could drift, so residuals are not
    shifted in time and no spectrum is searched.
    """

    def __init__(self, problem: Problem, geometric: Identification) -> None:
        self._chain = geometric.chain
        self._names = geometric.names
        posterior = geometric.posterior
        self._noise, self._sizes = geometric.noise.size, dict(posterior.sizes)
        # couplings may be confused with errors of a joint's own drive
        self._sizes['drive'] = max(self._sizes.get(k, 0.0) for k in ('drive', 'coupling'))
        problem = replace(problem, learned=Learned(posterior.priors, self._noise))
        self._problem = problem
        judged = geometric.fitted.judged
        stride = -(-len(judged) // COMPARED)
        pairs = zip(problem.sets, by_set(judged, problem.sets), strict=True)
        sets = [each.select(np.flatnonzero(good)[::stride]) for each, good in pairs]
        self._system = problem.system(sets)
        numbers = numbered(sets)
        self._groups = np.concatenate(numbers)
        blocks = np.full(int(self._groups.max()) + 1, -1)
        for each in numbers:  # every fold gets some of each set
            new = np.unique(each[blocks[each] < 0])
            blocks[new] = np.arange(len(new)) * problem.folds // len(new)
        rows = self._rows(self._names)
        self._ends = np.cumsum([each[-1].size for each in rows])
        owner = row_samples(rows)
        folds = np.array([self._groups % problem.folds, blocks[self._groups]])[:, owner]
        self._order = np.lexsort(folds)  # of all rows: those of the same folds together
        self._folds = folds[:, self._order]
        *columns, residual = stacked(rows).T
        self._columns = np.zeros((0, len(owner)))
        self._products = [np.zeros((1 + int(each.max(initial=0)), 0, 0)) for each in self._folds]
        self._add(np.array([residual, *columns]))
        self._number = {name: k for k, name in enumerate(self._names, 1)}
        self._pairs = [
            effects.waves(joint.name, harmonic)
            for joint in self._chain.joints
            if joint.type == 'revolute'
            for harmonic in HARMONICS
        ]
        self.harmonics = [name for pair in self._pairs for name in pair]
        self._equations = len(owner)
        self._shifts: Shifts | None = None
        if not any(each.socket for each in sets):
            self._shifts = Shifts(self._system, [each[-1] for each in rows])
        self._errors: dict[tuple[int, ...], FloatArray] = {}
        self._moved: dict[str, int] = {}
        self._seen: ShiftProducts | None = None

    def useful(self, groups: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
        """Return the effects of each group that are independent of the geometric model."""
        known = [*self._names]
        every = list(dict.fromkeys(name for names in groups.values() for name in names))
        which = self._columns_of([*known, *every])
        factor = np.asarray(np.linalg.qr(self._columns[which].T, mode='r'))
        factor = factor / np.maximum(np.linalg.norm(factor, axis=0), 1e-300)  # in any unit
        number = {name: k for k, name in enumerate([*known, *every])}
        found: dict[str, list[str]] = {}
        for group, names in groups.items():
            together = [*known, *names]
            columns = factor[:, [number[name] for name in together]]
            least = np.repeat([0.0, 1e3 * HALF_THE_DIGITS], [len(known), len(names)])
            seen = independent(columns, together, least)
            found[group] = [name for name in seen if name not in known]
        return found

    def judge(self, chosen: Sequence[str], added: Sequence[str], what: str) -> GroupVerdict:
        """Compare held-out errors with and without `added` effects."""
        new = [name for name in added if name not in chosen]
        found = list[float]()
        for dealing in range(len(self._folds)):
            before = self._held_out_errors(dealing, chosen)
            after = self._held_out_errors(dealing, [*chosen, *new])
            gain, limit = log_gain(before, after, self._groups, SURE)
            pays = gain > max(limit, COUNTS)
            found += [1e3 * float(np.sqrt((e**2).sum(axis=1).mean())) for e in (before, after)]
            if not pays:
                break
        if pays and self._shifts is not None:
            pays = chance(self._shares(chosen, [new])[0]) < 1.0 - CERTAIN
        return GroupVerdict(what, found[0], found[1], bool(pays))

    def shrink_noise(self, verdict: GroupVerdict) -> None:
        """Take what is left with chosen effects for the noise that priors are weighed against."""
        self._noise *= verdict.rms_mm_after / max(verdict.rms_mm_before, 1e-300)
        prior = self._system.prior
        if prior is not None:
            self._system = replace(self._system, prior=replace(prior, noise=self._noise))
        self._errors.clear()

    def strongest_harmonic(
        self, chosen: Sequence[str], progress: Notify
    ) -> tuple[Sequence[Parameter], bool]:
        """Return sine and cosine of the strongest harmonic, and whether many explain something.

        None if the strongest one explains time-shifted residuals as well. Many do if the sum of
        their shares is larger than for shifted residuals.
        """
        pairs = [pair for pair in self._pairs if pair[0] not in chosen]
        if self._shifts is None or not pairs:
            return (), False
        shares = self._shares(chosen, pairs, progress)
        several = chance(shares.sum(axis=0)) < 1.0 - CONFIDENT
        several = several and self._equations > len(self.harmonics)
        if chance(shares.max(axis=0)) >= 1.0 - CERTAIN:
            return (), several
        return pairs[int(np.argmax(shares[:, 0]))], several

    def _shares(
        self, chosen: Sequence[str], groups: Sequence[Sequence[str]], progress: Notify = quiet
    ) -> FloatArray:
        """Return the shares (G, S) of shifted residuals explained by groups of effects.

        Columns are computed once, those of all harmonics when one is asked for.
        """
        assert self._shifts is not None
        wanted = {name for group in groups for name in group}
        if not {*wanted, *chosen} <= self._moved.keys():
            lots: list[Sequence[str]] = [[*self._number]]
            if wanted & {name for pair in self._pairs for name in pair}:
                for _, own in itertools.groupby(self._pairs, lambda pair: pair[0].owner):
                    left = [n for pair in own for n in pair if n not in self._number]
                    lots += [left] if left else []
            names = [name for lot in lots for name in lot]
            self._moved = {name: k for k, name in enumerate(names)}
            self._seen = self._shifts.columns(self._lots(lots, progress))
        assert self._seen is not None
        numbers = self._moved
        return self._shifts.shares(
            self._seen,
            self._priors(list(numbers)),
            [numbers[name] for name in (*self._names, *chosen)],
            [[numbers[name] for name in group] for group in groups],
        )

    def _lots(self, lots: Sequence[Sequence[str]], progress: Notify) -> Iterator[list[FloatArray]]:
        for number, names in enumerate(lots):
            if number:
                progress(f'harmonics of {Parameter(names[0]).owner}')
                progress(number / len(lots))
            yield [each[:-1] for each in self._rows(names)]

    def _columns_of(self, names: Sequence[str]) -> list[int]:
        """Return the column numbers of effects, adding missing columns."""
        missing = [name for name in names if name not in self._number]
        if missing:
            self._number |= {name: k for k, name in enumerate(missing, len(self._columns))}
            self._add(stacked(self._rows(missing)).T[:-1])
        return [self._number[name] for name in names]

    def _add(self, columns: FloatArray) -> None:
        """Add columns (K, R) and their products with all, by fold of each dealing."""
        count = len(self._columns)
        self._columns = np.concatenate([self._columns, columns.take(self._order, axis=1)])
        grown = (0, 0), (0, len(columns)), (0, len(columns))
        self._products = [np.pad(each, grown) for each in self._products]
        begins = np.flatnonzero(np.diff(self._folds, prepend=-1).any(axis=0))
        for first, part in zip(begins, np.split(self._columns, begins[1:], axis=1), strict=True):
            found = np.hstack([part[count:] @ part[:count].T, gram(part[count:])])
            for products, fold in zip(self._products, self._folds[:, first], strict=True):
                products[fold, count:] += found
        for products in self._products:
            products[:, :count, count:] = np.swapaxes(products[:, count:, :count], 1, 2)

    def _rows(self, names: Sequence[str]) -> list[FloatArray]:
        added = [name for name in names if name not in self._names]
        return self._system.rows_of(self._chain.with_effects(added), names)

    def _held_out_errors(self, dealing: int, chosen: Sequence[str]) -> FloatArray:
        """Return held-out position errors (N, 3) [m] of every sample, by the other folds."""
        which = [*range(1, 1 + len(self._names)), *self._columns_of(chosen)]
        key = (dealing, *which)
        if key in self._errors:
            return self._errors[key]
        extra, offset = self._system.extra_rows(self._chain, self._names)
        extra = np.column_stack([offset, extra])
        ends = [0, *which]
        parts = np.array([each[np.ix_(ends, ends)] for each in self._products[dealing]])
        rest = parts.sum(axis=0)
        rest[: len(extra.T), : len(extra.T)] += extra.T @ extra
        priors = np.append(np.zeros(len(extra.T)), self._priors(chosen) ** 2)
        rest[np.diag_indices(len(rest))] += priors
        # a fold may hold all of a column
        scale = 1.0 / np.sqrt(np.maximum(np.diag(rest)[1:], 1e-300))
        weights = np.zeros((len(parts), len(self._columns)))
        weights[:, 0] = 1.0
        for fold, part in enumerate(parts):
            left = (rest - part)[1:]
            scaled = left[:, 1:] * np.outer(scale, scale) + ROUNDING * np.eye(len(scale))
            factor = linalg.cho_factor(scaled)
            weights[fold, which] = -scale * linalg.cho_solve(factor, scale * left[:, 0])
        fold_of = self._folds[[dealing]]
        left_out = np.empty(len(self._order))
        left_out[self._order] = np.take_along_axis(weights @ self._columns, fold_of, axis=0)[0]
        pieces = np.split(left_out, self._ends[:-1])
        sets = self._system.sets
        errors = [s.position_errors(p) for s, p in zip(sets, pieces, strict=True)]
        self._errors[key] = np.concatenate(errors)
        return self._errors[key]

    def _priors(self, names: Sequence[str]) -> FloatArray:
        """Return noise / sigma (P,) of the priors, zero without one.

        Effects have the usual size, or that found in the data if larger.
        """
        sigmas = {n: s for n, s in self._problem.prior_sigmas.items() if n in self._names}
        for name in {*names} - {*self._names}:
            group = str(size_group(self._chain, name))
            sigmas[name] = max(effects.expected(name), self._sizes.get(group, 0.0))
        return np.array([self._noise / sigmas[n] if n in sigmas else 0.0 for n in names])
