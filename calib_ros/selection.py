# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which non-geometric effects pay for themselves, by cross-validation.

At the geometric fit every effect is one more column of the linear model, so all candidates are
compared without refitting: the residual of a part left out is r - J_S beta, with beta from the
other parts. Parts are dealt out twice, one by one and in blocks of what was measured in
succession, and both must agree, because neighbours share errors. Groups of effects are added one
by one, the best first, as long as the position error on the configurations left out falls by more
than chance explains. Then the spectrum of what is left is searched, joint by joint, for harmonics
of gears: the one that explains most is added while it pays as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from calib_ros import effects
from calib_ros.effects import Verdict
from calib_ros.identifiability import RANK_TOLERANCE
from calib_ros.identification import Identification, identify
from calib_ros.leastsquares import BLOCK
from calib_ros.problem import Problem
from calib_ros.se3 import FloatArray
from calib_ros.validation import log_gain

PAYS = 0.999
"""One-sided confidence that the gain of a group or harmonic must have."""
LEAST_GAIN = 0.005
"""Least decrease of the RMS error that is worth a group or a harmonic."""
HARMONICS = range(3, 41)
"""Harmonics per turn of a joint that are looked for; 1 and 2 are the group of eccentricities."""
MOST_HARMONICS = 24
SUBSET = 3000


@dataclass(frozen=True)
class Selection:
    """The effects that pay for themselves, and the verdicts on all that were tried."""

    effects: tuple[str, ...]
    verdicts: tuple[Verdict, ...]


def identify_model(problem: Problem, model: str) -> Identification:
    """Identify with the errors that `model` names; `auto` chooses by cross-validation.

    A choice that cannot be fitted leaves the geometric result, with the verdicts.
    """
    result = identify(problem)
    if model != 'auto':
        return result
    selection = choose_effects(problem, result)
    if selection.effects:
        richer = identify(replace(problem, effects=selection.effects))
        if richer.converged:
            result = richer
    return replace(result, verdicts=selection.verdicts)


def choose_effects(problem: Problem, geometric: Identification) -> Selection:
    """Choose the effects for a problem from its geometric result."""
    model = _Linear(problem, geometric)
    chosen: list[str] = []
    verdicts: dict[str, Verdict] = {}
    groups = {name: model.useful(effects.members(problem.chain, name)) for name in effects.GROUPS}
    while True:
        tried = []
        for group, names in groups.items():
            if names and not set(names) <= set(chosen):
                tried.append((model.judge(chosen, names, group), group))
        if not tried:
            break
        for verdict, group in tried:
            verdicts[group] = verdict
        paying = [pair for pair in tried if pair[0].pays]
        if not paying:
            break
        best, group = min(paying, key=lambda pair: pair[0].rms_mm_after)
        verdicts[group] = best
        chosen += groups[group]
    found = list(verdicts.values())
    for _ in range(MOST_HARMONICS):
        harmonic = model.strongest_harmonic(chosen)
        if harmonic is None:
            break
        verdict = model.judge(chosen, harmonic, f'{harmonic[0].replace(".sin_", ", ")} per turn')
        found.append(verdict)
        if not verdict.pays:
            break
        chosen += harmonic
    return Selection(tuple(chosen), tuple(found))


class _Linear:
    """The linear model about the geometric fit, with columns of effects made when asked for."""

    def __init__(self, problem: Problem, geometric: Identification) -> None:
        self._chain = geometric.chain
        self._names = geometric.names
        self._problem = problem
        judged = np.split(
            geometric.fitted.judged, np.cumsum([len(each) for each in problem.sets])[:-1]
        )
        share = max(1, -(-sum(map(len, problem.sets)) // SUBSET))
        sets = [
            each.select(np.flatnonzero(good)[::share])
            for each, good in zip(problem.sets, judged, strict=True)
        ]
        self._system = problem.system(sets)
        groups, first = [], 0
        for each in sets:
            groups.append(each.configurations + first)
            first += int(each.configurations.max(initial=-1)) + 1
        self._groups = np.concatenate(groups)
        count = problem.folds
        self._dealings = (self._groups % count, self._groups * count // (self._groups.max() + 1))
        self._columns: dict[str, FloatArray] = {}
        self._owner, self._component = self._layout()
        self._base, self._residual = self._rows(self._names)

    def useful(self, names: Sequence[str]) -> list[str]:
        """Return those effects whose columns are independent of the geometric model."""
        basis = np.linalg.qr(self._base)[0]
        kept = []
        for name, column in zip(names, self._of(names).T, strict=True):
            rest = column - basis @ (basis.T @ column)
            rest -= basis @ (basis.T @ rest)
            size = float(np.linalg.norm(rest))
            if size > 1e3 * RANK_TOLERANCE * float(np.linalg.norm(column)) and size > 0.0:
                basis = np.column_stack([basis, rest / size])
                kept.append(name)
        return kept

    def judge(self, chosen: Sequence[str], added: Sequence[str], what: str) -> Verdict:
        """Compare the errors on configurations left out, with and without some effects."""
        richer = [*chosen, *(name for name in added if name not in chosen)]
        found, pays = [], True
        for folds in self._dealings:
            before, after = self._left_out(chosen, folds), self._left_out(richer, folds)
            gain, limit = log_gain(before, after, self._groups, PAYS)
            pays = pays and gain > max(limit, LEAST_GAIN)
            found += [1e3 * float(np.sqrt((e**2).sum(axis=1).mean())) for e in (before, after)]
        return Verdict(what, found[0], found[1], bool(pays))

    def strongest_harmonic(self, chosen: Sequence[str]) -> list[str] | None:
        """Return sine and cosine of the harmonic that explains most of what is left."""
        columns = np.column_stack([self._base, self._of(chosen)])
        weighted = np.concatenate([columns, np.diag(self._prior(chosen)[0])])
        basis = np.linalg.qr(weighted)[0]
        basis_rows = basis[: len(columns)]
        residual = self._residual - basis_rows @ (basis_rows.T @ self._residual)
        variance = float(residual @ residual) / max(len(residual) - columns.shape[1], 1)
        best, tried = 0.0, 0
        best_names: list[str] | None = None
        for joint in self._chain.joints:
            if joint.type != 'revolute':
                continue
            for harmonic in HARMONICS:
                names = [f'{joint.name}.{wave}_{harmonic}' for wave in effects.WAVES]
                if names[0] in chosen:
                    continue
                tried += 1
                pair = self._of(names)
                square = pair.T @ pair - (basis_rows.T @ pair).T @ (basis_rows.T @ pair)
                square += np.eye(2) / effects.expected(names[0]) ** 2
                right = pair.T @ residual
                explained = float(right @ np.linalg.solve(square, right))
                if explained > best:
                    best, best_names = explained, names
        chance = stats.chi2.sf(best / variance, 2) * max(tried, 1)
        return best_names if chance < 1.0 - PAYS else None

    def _of(self, names: Sequence[str]) -> FloatArray:
        """Return the weighted columns (rows, E) of effects, made once."""
        missing = [name for name in names if name not in self._columns]
        if missing:
            rows, _ = self._rows(missing)
            self._columns |= dict(zip(missing, rows.T, strict=True))
        if not names:
            return np.zeros((len(self._residual), 0))
        return np.column_stack([self._columns[name] for name in names])

    def _layout(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the sample and the component (0-2 position, 3-5 orientation) of each row."""
        owner, component, first = [], [], 0
        for samples in self._system.sets:
            width = (
                1 if samples.distances is not None else 6 if samples.whitening is not None else 3
            )
            for start in range(0, samples.count, BLOCK):
                block = np.arange(start, min(start + BLOCK, samples.count)) + first
                for part in (range(width), range(3, 6)):
                    if part.start == 3 and (samples.whitening is not None or not samples.oriented):
                        continue
                    owner += [block] * len(part)
                    component += [np.full(len(block), k) for k in part]
            first += samples.count
        return np.concatenate(owner), np.concatenate(component)

    def _rows(self, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Return weighted Jacobian (rows, P) and residual (rows,), in the order of the layout."""
        chain = self._chain.with_effects([name for name in names if name not in self._names])
        found = []
        for samples in self._system.sets:
            for shift, turn, model in samples.blocks(chain, names):
                order = [*model.order, len(names)]
                found.append(shift.reshape(len(shift), -1)[order].T)
                if len(turn):
                    full = np.zeros((len(names) + 1, turn.shape[1]))
                    full[: model.rotations] = turn[:-1]
                    full[-1] = turn[-1]
                    found.append(full[order].T)
        stacked = np.concatenate(found)
        return stacked[:, :-1], stacked[:, -1]

    def _left_out(self, chosen: Sequence[str], dealing: NDArray[np.intp]) -> FloatArray:
        """Return position errors (N, 3) [m] of every sample, predicted from the other folds."""
        columns = np.column_stack([self._base, self._of(chosen)])
        inverse, offset = self._prior(chosen)
        errors = np.empty(len(self._residual))
        whole = columns.T @ columns + np.diag(inverse**2)
        gradient = columns.T @ self._residual + inverse * offset
        folds = dealing[self._owner]
        for fold in range(self._problem.folds):
            inside = folds == fold
            part = columns[inside]
            matrix = whole - part.T @ part
            scale = 1.0 / np.sqrt(np.diag(matrix))
            factor = linalg.cho_factor(matrix * np.outer(scale, scale))
            right = gradient - part.T @ self._residual[inside]
            weights = scale * linalg.cho_solve(factor, scale * right)
            errors[inside] = self._residual[inside] - part @ weights
        positions = np.zeros((len(self._groups), 3))
        rows = self._component < 3
        positions[self._owner[rows], self._component[rows]] = errors[rows]
        return positions * self._problem.sigma_position

    def _prior(self, chosen: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Return 1 / sigma (P,) of the priors, zero without one, and their residuals in sigma."""
        inverse, offset = np.zeros(len(self._names)), np.zeros(len(self._names))
        if self._system.prior is not None:
            inverse, offset = self._system.prior.rows(self._chain, self._names)
        wide = [1.0 / effects.expected(name) for name in chosen]
        return np.append(inverse, wide), np.append(offset, np.zeros(len(chosen)))
