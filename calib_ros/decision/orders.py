# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rows and columns in another order: sorted, measured in turn, or mixed up."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from calib_ros.decision.lost_rows import EXPLAINED_ROWS, FEWEST_ROWS, MOST_SEARCHED, covers
from calib_ros.decision.suspects import reordered
from calib_ros.decision.trials import in_frames
from calib_ros.decision.undoing import Sets, Suspect
from calib_ros.estimation.levels import CLEARLY, NEARER, SEVERAL, TELLING, TRIED
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import IN_A_FRAME
from calib_ros.kinematics.se3 import ROUNDING


def other_order(
    problem: Problem, nominal: Chain, seen: Observations, largest: float
) -> tuple[Suspect, float] | None:
    """Return in which order the rows of joint values stand, as `row_loss`.

    That is the reverse one, or that of numbers as text. If some such order is not clearly worse
    than theirs, a column that goes one way was perhaps sorted alone.
    """
    rows = np.arange(len(seen))
    if problem.of_messages or not FEWEST_ROWS <= len(rows) <= MOST_SEARCHED:
        return None
    what = 'the joint values are in the reverse order of the measurements'
    orders = [('', rows), (what, rows[::-1])]
    for first in (1, 0):
        text = np.array(sorted(rows.tolist(), key=lambda k: str(k + first)))
        by = f'are sorted as text ({", ".join(map(str, (text[:3] + first).tolist()))} ...)'
        orders += [(f'the measurements {by}', text), (f'the joint values {by}', np.argsort(text))]
    sets = (replace(seen, joints=seen.joints[order]) for _, order in orders)
    errors = [in_frames(problem, nominal, (each,)).error for each in sets]
    best = int(np.argmin(errors))
    if errors[best] <= largest:
        remedy = 'sort both alike, or name the poses in both tables (--joints)'
        return (Suspect(orders[best][0], remedy), errors[best]) if best else None
    steps = np.diff(np.column_stack([seen.joints, seen.given]), axis=0)
    one_way = steps.any(axis=0) & ((steps >= 0).all(axis=0) | (steps <= 0).all(axis=0))
    if CLEARLY * errors[0] < min(errors[1:]) or not one_way.any():
        return None
    names = ', '.join(np.array([*nominal.joint_names, *'xyz'])[one_way])
    what = 'the joint values fit the measurements hardly better than in other orders of the rows'
    remedy = 'was one sorted without the others? If so, export them again, and sort whole rows'
    return Suspect(f'{what}, and one way from row to row goes {names}', remedy), np.nan


def in_turn(
    problem: Problem, nominal: Chain, seen: Observations, most: float
) -> tuple[Suspect, float] | None:
    """Return that rows are of targets, devices or arms in turn, as `row_loss`.

    The arm fits each alone within `most` [m]. They are told apart by their places among the rows
    of one stop, else among all. Each visits enough configurations, as far apart as those of all:
    frames explain few of them, or those of one place, whatever is wrong. The chain file holds
    frames of one of them only; if those of all rows would do, it holds wrong ones.
    """
    arm = replace(nominal, base=None, tool=None, frames=())
    images = any(each.pixels is not None for each in problem.sets)
    if images or in_frames(problem, arm, (seen,)).error <= most:
        return None
    rows, least = np.arange(len(seen)), np.ptp(seen.joints, axis=0) / 2.0
    begins = np.flatnonzero(np.diff(seen.stops, prepend=-1))
    for turns in (rows - begins[seen.stops], *(rows % (2 + k) for k in range(SEVERAL))):
        parts = [seen.select(turns == k) for k in range(1 + turns.max(initial=0))]
        parts = [part for part in parts if covers(part, least, 2 * IN_A_FRAME)]
        if len(parts) < 2 or sum(map(len, parts)) < EXPLAINED_ROWS * len(rows):
            continue
        first = in_frames(problem, arm, (parts[0],))
        errors = [first.error, *_errors(problem, arm, parts[1:], most)]
        if max(errors) <= most:
            return _named_in_turn(problem, first.chain, parts, most), max(errors)
    return None


def _errors(
    problem: Problem, arm: Chain, parts: Sequence[Observations], most: float
) -> Iterator[float]:
    """Yield the error [m] of each part alone, up to the first beyond `most`."""
    for part in parts:
        yield (error := in_frames(problem, arm, (part,)).error)
        if error > most:
            return


def _named_in_turn(
    problem: Problem, first: Chain, parts: Sequence[Observations], most: float
) -> Suspect:
    """Return what is measured in turn, by the frame of the first that suits all others."""
    seen = parts[0]
    for kind, shared in (('target', seen.base), ('device', seen.tool)):
        known = replace(first, base=None, tool=None, frames=())
        known = known.with_frame(shared, replace(first.frame(shared), fixed=True))
        if max(_errors(problem, known, parts[1:], most)) <= most:
            return Suspect(
                f'the rows are of {len(parts)} {kind}s in turn',
                f'name them in a column {kind}',
                published=f'give each its own {kind} in sources',
            )
    return Suspect(
        f'the rows are of {len(parts)} arms, devices or targets in turn',
        'name them in a column session, and identify each alone (--session)',
        published='give each its own device in sources',
    )


def in_any_order(chain: Chain, seen: Observations, of_images: bool) -> Iterator[Suspect]:
    """Yield the orders of joints that fit best the distances of positions, tools being short."""
    count = len(chain.joints)
    if not 3 < count < 8 or seen.socket:
        return
    few = seen.select(np.linspace(0, len(seen) - 1, 3 * count).astype(int))
    orders = np.array([*permutations(range(count))])
    arm = replace(chain, base=None, tool=None).forward(few.joints[:, orders].reshape(-1, count))
    reached = arm[:, :3, 3].reshape(len(few), len(orders), 3)
    measured = few.given[:, np.newaxis]
    steps = (np.linalg.norm(np.diff(each, axis=0), axis=2) for each in (reached, measured))
    away = np.median(np.abs(np.subtract(*steps)), axis=0)
    for order in orders[np.argsort(away)[: SEVERAL * TRIED]]:
        given = ', '.join(chain.joint_names[k] for k in np.argsort(order))
        found = reordered(f'the joint values are in the order {given}', order, rank=3)
        yield replace(found, remedy='correct it in --places') if of_images else found


def constant_axes(chain: Chain, sets: Sets) -> Suspect | None:
    """Return position coordinates that are constant although the arm moves.

    A device square to a planar arm measures no more.
    """
    for each in sets:
        if each.socket or len(each) < TELLING:
            continue
        seen = each.given
        held = np.flatnonzero(np.ptp(seen, axis=0) <= ROUNDING * np.abs(seen).max())
        places = replace(chain, tool=None).forward(each.joints)[:, :3, 3]
        spreads = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
        if len(held) and spreads[2] > NEARER**2 * spreads[0]:
            columns = ', '.join('xyz'[k] for k in held)
            return Suspect(
                f'all positions have the same {columns}, though the arm moves in all directions',
                f'give the column {columns} as it was measured, or measure again with it',
                published='check the positions where they are published',
            )
    return None
