# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Search for several simultaneous changes of an arm.

One after the other, each beside those found (`changes.py`). The first was the best single
explanation of all, and may have taken from others: each is looked for again beside the rest. Of
several changed zeros the best single explanation is often another joint or a bent link, so sets of
zeros are tried in place of all changes of joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import TypeAlias

import numpy as np

from calib_ros.decision.changes import (
    LOAD,
    ChangeColumns,
    Explanation,
    Information,
    explanation_of,
)
from calib_ros.estimation.levels import SEVERAL
from calib_ros.kinematics.parameter import Parameter

Changes: TypeAlias = list[tuple[Explanation, ...]]
ALL = 'all joints'  # owner of all zeros


def one_by_one(reasons_beside: Callable[[Changes], tuple[Explanation, ...]]) -> Changes:
    """Return up to SEVERAL changes, each with those indistinguishable from it.

    `reasons_beside` returns the explanations of one more change beside given ones. One of the
    parameters of another is the same change; found again, it is larger than the model holds for.
    """
    found: Changes = []
    while len(found) < SEVERAL and (reasons := reasons_beside(found)):
        if any(_part_of(reasons, other) for other in found):
            break
        found = [each for each in found if not _part_of(each, reasons)] + [reasons]
    for k, given in enumerate(found if len(found) > 1 else ()):
        others = found[:k] + found[k + 1 :]
        again = reasons_beside(others)
        known = any(_part_of(again, each) or _part_of(each, again) for each in others if again)
        found[k] = given if known or not again else again
    return found


def _part_of(one: tuple[Explanation, ...], other: tuple[Explanation, ...]) -> bool:
    return {*one[0].names} <= {*other[0].names}


def likelier(
    information: Information, columns: ChangeColumns, freedom: float, changed: Changes
) -> Changes:
    """Return the changes found, or with a few or all zeros in place of those of joints.

    Each change is chosen from all explanations, a bent link counting once; all zeros count as one
    more than SEVERAL.
    """
    if not changed:
        return changed
    beside = [reasons for reasons in changed if not reasons[0].names[0].of_dh]
    given = [reasons[0].names for reasons in changed]
    kept = [reasons[0].names for reasons in beside]
    single = [(name,) for name in columns.zeros]
    tried = [given]
    for k in range(2, SEVERAL + 1 - len(kept)):
        tried += [[*kept, *some] for some in combinations(single, k)]
    tried += [[*kept, columns.zeros]] * (len(single) > SEVERAL)  # of fewer all are among these
    # a link with parts of a neighbouring joint is the same link
    choices = sum(owner in (LOAD, own[-1].owner) for owner, own in columns.sets)

    def likely(causes: Sequence[Sequence[Parameter]]) -> float:
        count = len(causes) + SEVERAL * (causes[-1] == columns.zeros)
        names = [name for each in causes for name in each]
        return columns.evidence(information, names)[0] - count * float(np.log(choices))

    best = max(tried, key=likely)
    if best is given:
        return changed
    pairs = [(own[0].owner if len(own) == 1 else ALL, own) for own in best[len(kept) :]]
    rough = beside + [(explanation_of(information, columns, freedom, *pair),) for pair in pairs]
    found: Changes = []
    for k, reasons in enumerate(rough):
        alone = information.marginalised(columns.covariance([*rough[:k], *rough[k + 1 :]]))
        sizes = (
            explanation_of(alone, columns, freedom, e.owner, e.names, e.share) for e in reasons
        )
        found.append(tuple(sizes))
    return found


def names_of(changed: Sequence[Sequence[Explanation]]) -> list[Parameter]:
    """Return the parameters that changes change, each by its best explanation."""
    return [name for reasons in changed for name in reasons[0].names]


def question(changed: Sequence[Sequence[Explanation]], *more: str) -> str:
    """Return what to ask about changes: load, zeros, a collision, or `more`."""
    first = [reason for reason, *_ in changed]
    zeros = [each for each in first if [n.kind for n in each.names] in (['theta'], ['d'])]
    if all(each.owner == LOAD for each in first):
        return 'does it carry another one?'
    if len(zeros) >= SEVERAL or ALL in {each.owner for each in first}:
        return 'was it mastered again, or bumped?'
    return f'{", or ".join(("was it bumped", *more))}?'
