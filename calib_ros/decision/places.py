# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Places of balls in sockets, each judged by the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros.decision.comparison import Comparison
from calib_ros.decision.cross_validation import fold_residuals
from calib_ros.estimation.arbitrary import drawn
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.identifiability import independent_in
from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.system import System
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import parameters_of


def places_of(problem: Problem) -> list[set[str]]:
    """Return the bases of each place: sockets with known separations are one place."""
    places = [{base} for base in dict.fromkeys(each.base for each in problem.sets)]
    for first, second, _ in problem.separations:
        one, other = (next(p for p in places if base in p) for base in (first, second))
        if one is not other:
            one |= other
            places.remove(other)
    return places


def leave_one_place_out(
    fitted: Fitted, before: Chain, places: Sequence[set[str]]
) -> tuple[Comparison, str]:
    """Judge both chains on places of sockets that were not fitted.

    The unknown positions of a place's sockets are fitted to its own pairs, with arm and tool of
    the others. Outliers keep their weight of the whole fit.
    """
    problem, names = fitted.problem, fitted.names
    pairs = list(zip(problem.sets, fitted.system.sets, strict=True))

    def part(place: set[str], inside: bool) -> System:
        chosen = [samples for each, samples in pairs if (each.base in place) == inside]
        known = {samples.observations.base for samples in chosen}
        apart = tuple(pair for pair in fitted.system.separations if {*pair[:2]} <= known)
        return replace(fitted.system, sets=tuple(chosen), separations=apart)

    anywhere, rows = drawn(problem.model, names, problem.sets)
    chains: list[list[Chain]] = [[], []]
    for place in places:
        own = [n for base in sorted(place) for n in parameters_of(base)[:3] if n in problem.free]
        others, left = part(place, inside=False), part(place, inside=True)
        rest = [name for name in names if name not in own]
        seen = zip(rows, problem.sets, strict=True)
        which = [names.index(name) for name in rest]
        there = [each[:, which] for each, one in seen if one.base not in place]
        # without this place a gauge may be free; frames come first, so they are the same alone
        known = independent_in([*there, others.separation_rows(anywhere, rest)[0]], rest)
        kept = {*known, *problem.prior_sigmas}
        fits = (before, fitted.frames), (fitted.chain, names)
        for found, (chain, wanted) in zip(chains, fits, strict=True):
            rest = [name for name in wanted if name in kept and name not in own]
            found.append(minimise(minimise(chain, rest, others).chain, own, left).chain)
    number = {base: k for k, place in enumerate(places) for base in place}
    groups = [np.full(len(each), number[each.base]) for each in problem.sets]
    pair = fold_residuals(zip(*chains, strict=True), problem.sets, groups, groups)
    judged = Comparison(*pair, ~fitted.robust.outliers, kind='locations')
    return judged, f'leaving out one of {len(places)} locations at a time{judged.omitted}'
