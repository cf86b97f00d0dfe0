# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Did the arm change between nights, when, and which joint (docs/fleet.md)?

Night k brings the arm's parameters x_k with covariance C_k, base, tool and warmth free, and how
they follow waves of its wobbling axes, T_k. The usual drift is no change: a random walk that adds
G in a year (`age.py`). The mean of the last m nights (LAGS) is compared with the arm that the
earlier nights tell, the mean y years older (Kalman 1960), both weighted by information:

    d = x_after - x_before,   t = T_after - T_before,   u = S^-1 d,   W = S^-1
    S = s^2 (C_after + C_before + G y + w^2 t t^T)

That j alone, a joint or two, changed by d_j = W_jj^-1 u_j with covariance W_jj^-1 explains
g_j = u_j^T W_jj^-1 u_j of the difference, which has an F distribution if nothing changed: as many
degrees of freedom as j has parameters, over those of the noise, or of s^2 if fewer: those of the
earlier nights and of the rest. s^2 is the scatter of the nights beyond their covariances (warming
up, model error), or of the rest beside j, where clearly larger than 1; w is the median size of the
waves. They are the same in all nights: in the same region they change nothing.

An effect that only some nights fitted is nominal in the others too: with the information matrix I
of all parameters of the arm, a fit of the common ones c alone has I_cc and (I x)_c. That does not
hold for DH parameters, which are far from nominal. Neither warmth nor model error suddenly makes
nights scatter CLEARLY more: if every joint and pair leaves more, several changed. Zeros of SEVERAL
joints, or of all, are told instead if likelier (`several.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import special

from calib_ros.decision.changes import (
    LOAD,
    SCALES,
    ChangeColumns,
    Information,
    explanation_of,
    reasons_of,
)
from calib_ros.decision.several import Changes, likelier, names_of
from calib_ros.errors import InputError
from calib_ros.estimation.levels import CLEARLY, KNOWN, LARGEST_SCALE, SEVERAL, TELLING, chance_of
from calib_ros.files.history import AWAY
from calib_ros.files.rows import Row
from calib_ros.fleet.change import Change
from calib_ros.identification.age import YEAR, drift_of
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import counted, some

LAGS = tuple(2**k for k in range(1 + TELLING))
"""Nights, 1 to 256, in which a change is sought: large ones show at once, small and slow ones
later."""


class Night(NamedTuple):
    """A night, and the evidence for a change of each joint, as a normal variable."""

    row: Row
    strength: dict[str, float]


@dataclass(frozen=True)
class Watched:
    """The nights of a robot, its changes, and remarks on what is not compared."""

    nights: tuple[Night, ...] = ()
    changes: tuple[Change, ...] = ()
    remarks: tuple[str, ...] = ()


_Fitted: TypeAlias = tuple[Row, tuple[Parameter, ...]]
"""A night, and the arm parameters it fitted."""


def watch(rows: Sequence[Row], years: float) -> Watched:
    """Look for changes in accepted identifications, in order."""
    known = [row for row in rows if row.accepted]
    if not known:
        return Watched()
    joints = known[0].corrected().joint_names
    alike: dict[frozenset[Parameter], list[_Fitted]] = {}
    for row in known:
        arm = tuple(name for name in map(Parameter, row.names) if name.owner in joints)
        newest = frozenset(name for name in arm if name.of_dh)
        alike.setdefault(newest, []).append((row, arm))
    nights: list[Night] = []
    changes: list[Change] = []
    remarks: list[str] = []
    for names, fitted in alike.items():
        found = _compare_nights(fitted, years)
        nights += found.nights
        changes += found.changes
        remarks += found.remarks
        if names != newest:
            number, last = len(fitted), fitted[-1][0].time
            these = f'{counted(number, "night")}, the last of {last:%Y-%m-%d}'
            why = _other(names, newest)
            remarks.append(f'{these}, cannot be compared with the newest: {why}')
    nights.sort(key=lambda night: night.row.time)
    changes.sort(key=lambda change: change.seen)
    return Watched(tuple(nights), tuple(changes), tuple(remarks))


def _other(names: frozenset[Parameter], newest: frozenset[Parameter]) -> str:
    alone = {'they alone determine': names - newest, 'it alone determines': newest - names}
    found = ((who, ', '.join(some(sorted(what)))) for who, what in alone.items() if what)
    return '; '.join(map(' '.join, found))


def _compare_nights(fitted: Sequence[_Fitted], years: float) -> Watched:
    rows, arms = [row for row, _ in fitted], [arm for _, arm in fitted]
    bent = [any('.gravity_' in name for name in arm) for arm in arms]
    strengths: list[dict[str, float]] = [{} for _ in rows]
    changes: list[Change] = []
    first = known_up_to = 0
    while known_up_to < len(rows):
        common = set(arms[first]).intersection(*arms[first : known_up_to + 1])
        if not common:
            break
        lacking = (k for k in range(known_up_to, len(rows)) if not common.issubset(arms[k]))
        end = next(lacking, len(rows))
        tests = _tests(fitted[first:end], tuple(name for name in arms[first] if name in common))
        level = 1.0 / (365.25 * years * len(LAGS) * len(tests.groups))
        fresh, joints = known_up_to - first, tests.joints
        least = tests.chances[:, fresh:, : len(joints)].min(axis=0)
        shown = -special.ndtri(np.maximum(0.5 * least, 1e-300))
        strengths[known_up_to:end] = [dict(zip(joints, z, strict=True)) for z in shown.tolist()]
        several = tests.several.min(axis=0) < level
        alarms = np.flatnonzero(((tests.chances.min(axis=(0, 2)) < level) | several)[fresh:])
        if not alarms.size:
            known_up_to = end
            continue
        k = fresh + int(alarms[0])
        row = rows[first + k]
        lag, changed = _cause(tests, k, level, row)
        before, known_up_to = bent[first : first + k + 1 - LAGS[lag]], first + k + 1
        first, loaded = first + len(before), bent[first + k] not in before
        changes.append(Change(rows[first].time, row.time, changed, loaded))
    nights = tuple(Night(row, each) for row, each in zip(rows, strengths, strict=True))
    newest = set(arms[-1])
    left = sorted(newest.union(*arms[first:]) - newest.intersection(*arms[first:]))
    lack = f'{", ".join(some(left))} are not compared: only some nights fitted them'
    remark = f'since {rows[first].time:%Y-%m-%d}, {lack}'
    return Watched(nights, tuple(changes), (remark,) if left else ())


def _cause(tests: _Tests, k: int, level: float, row: Row) -> tuple[int, Changes]:
    """Return the lag of an alarm in night k, and what changed; nothing if several joints did."""
    several = bool(tests.several[:, k].min() < level)
    shown = tests.several[:, k] if several else tests.chances[:, k].min(axis=1)
    lag = int(shown.argmin())
    information = Information(tests.names, tests.weight[lag, k], tests.pull[lag, k])
    columns, freedom = ChangeColumns(row.corrected(), tests.names), float(tests.freedom[k])
    reasons = reasons_of(information, columns, freedom, most=1.0)
    pair = () if several else _pair(tests, lag, k, level, information)
    parts = ((joint, tuple(n for n in tests.names if n.owner == joint)) for joint in pair)
    found: Changes = [(explanation_of(information, columns, freedom, *part),) for part in parts]
    found = found or [reasons]
    one, all_of = (columns.evidence(information, names_of(each))[0] for each in ([reasons], found))
    loaded = reasons[0].owner == LOAD and one >= all_of
    whole = [reasons] if loaded else likelier(information, columns, freedom, found)
    names = names_of(whole)
    if loaded or (len(names) >= SEVERAL and {*names} <= {*columns.zeros}):
        every = np.eye(len(tests.names))
        gain, most = (information.explained(each)[0] for each in (columns.of(names), every))
        if chance_of((most - gain) / CLEARLY**2, len(every) - len(names), freedom) >= level:
            return lag, whole
    return lag, [] if several else found


def _pair(
    tests: _Tests, lag: int, k: int, level: float, information: Information
) -> tuple[str, ...]:
    """Return the two joints that changed in night k; none if one does not explain clearly less.

    Both with the scatter beside the pair: of two scatters only one may exceed chance.
    """
    chances, size = tests.chances[lag, k], len(tests.joints)
    if chances[size:].min(initial=1.0) >= level:
        return ()
    pair = tests.groups[size + int(chances[size:].argmin())]
    if chances[:size].min() >= level:
        return pair
    joint = tests.groups[int(chances[:size].argmin())]
    owners, every = [name.owner for name in tests.names], np.eye(len(tests.names))
    (one, *_, few), (two, *_, more), (whole, *_) = (
        information.explained(every[:, np.isin(owners, group)]) for group in (joint, pair, owners)
    )
    others = len(owners) - more
    gain = (two - one) / float(_above_chance(np.asarray((whole - two) / others), others))
    known = min(float(tests.freedom[k]), others + len(owners) * (k - LAGS[lag]))
    return pair if chance_of(gain, more - few, known) < level else ()


class _Tests(NamedTuple):
    """Tests of L lags at K nights for P parameters, by J joints and pairs of these (`groups`)."""

    names: tuple[Parameter, ...]
    groups: tuple[tuple[str, ...], ...]
    freedom: FloatArray  # (K,)
    chances: FloatArray  # (L, K, J), 1 without earlier nights
    several: FloatArray  # (L, K), that no joint or pair alone changed
    pull: FloatArray  # (L, K, P), u
    weight: FloatArray  # (L, K, P, P), W

    @property
    def joints(self) -> list[str]:
        return [group[0] for group in self.groups if len(group) == 1]


def _tests(fitted: Sequence[_Fitted], names: tuple[Parameter, ...]) -> _Tests:
    information, pulls = _information(fitted, names)
    count, size = pulls.shape[:2]
    groups = _groups(names)
    owners = np.array([name.owner for name in names])
    freedom = np.array([row.freedom or KNOWN for row, _ in fitted])
    waves = np.array([row.tilt for row, _ in fitted if row.tilt is not None])
    up_to = np.cumsum([row.tilt is not None for row, _ in fitted])
    size_of = np.array([np.median(waves[:number]) if number else 0.0 for number in up_to])
    whole, pulled = np.cumsum(information, axis=0), np.cumsum(pulls, axis=0)
    years = np.array([(row.time - fitted[0][0].time) / YEAR for row, _ in fitted])
    drifts = np.diag(drift_of(names))
    covariances, means = _kalman_filter(information, pulls, years, drifts)
    chances = np.ones((len(LAGS), count, len(groups)))
    several = np.ones((len(LAGS), count))
    pull = np.zeros((len(LAGS), count, size))
    weight = np.zeros((len(LAGS), count, size, size))
    scatter = np.ones(count)
    for number, lag in enumerate(lag for lag in LAGS if lag < count):
        nights = np.arange(lag, count)
        last = years[nights - lag]
        passed = sliding_window_view(years, lag)[1:] - last[:, np.newaxis]
        walked = passed @ np.arange(2 * lag - 1, 0, -2) / lag**2  # of the mean of a walk
        before = covariances[nights - lag] + drifts * walked[:, np.newaxis, np.newaxis]
        after = np.linalg.inv(whole[nights] - whole[nights - lag])
        moved = after @ (pulled[nights] - pulled[nights - lag]) - means[nights - lag]
        moved, tilts = moved[..., 0], size_of[nights, np.newaxis, np.newaxis] * moved[..., 1:]
        inverse = np.linalg.inv(after + before + tilts @ np.swapaxes(tilts, 1, 2))
        force = np.einsum('kpr,kr->kp', inverse, moved)
        whole_of = np.einsum('kp,kp->k', moved, force)
        if lag == 1:
            scatter[nights] = whole_of / size
            every = np.array([_usual(scatter[1 : k + 1], size) for k in range(count)])
        usual = every[nights - lag]
        weight[number, nights] = inverse / usual[:, np.newaxis, np.newaxis]
        pull[number, nights] = force / usual[:, np.newaxis]
        several[number, nights] = 0.0
        for j, group in enumerate(groups):
            own = np.flatnonzero(np.isin(owners, group))
            part = inverse[:, own[:, np.newaxis], own]
            found = np.linalg.solve(part, force[:, own, np.newaxis])[..., 0]
            gain = np.einsum('kp,kp->k', found, force[:, own])
            others = max(1, size - len(own))
            left = (whole_of - gain) / others
            beyond = special.fdtrc(others, freedom[nights], left / (CLEARLY**2 * usual))
            several[number, nights] = np.maximum(several[number, nights], beyond)
            left = _above_chance(left, others)
            gain /= np.maximum(usual, left) * len(own)
            known = np.minimum(freedom[nights], others + size * (nights - lag))
            chances[number, nights, j] = special.fdtrc(len(own), known, gain)
    return _Tests(names, groups, freedom, chances, several, pull, weight)


def _information(
    fitted: Sequence[_Fitted], names: tuple[Parameter, ...]
) -> tuple[FloatArray, FloatArray]:
    """Return the information (K, P, P) of nights about parameters, without their tilts.

    And that times values and tilts (K, P, 1 + T). Other arm parameters are nominal, base and tool
    free, and all lengths together: one night is warmer than another.
    """
    information, pulls, grown = [], [], dict[tuple[Parameter, ...], FloatArray]()
    most = max(row.tilts.size // len(row.names) for row, _ in fitted)
    for row, arm in fitted:
        if arm not in grown:
            columns = ChangeColumns(row.corrected(), arm, scaled=True)
            scales = [name for _, (name, *_) in columns.sets if name in SCALES]
            grown[arm] = LARGEST_SCALE * columns.of(scales)
        own = [row.names.index(name) for name in arm]
        which = [arm.index(name) for name in names]
        tilts = row.tilts[own] if row.tilts.size else np.zeros((len(own), most))
        square = row.covariance[np.ix_(own, own)] - (row.tilt or 0.0) ** 2 * tilts @ tilts.T
        square += grown[arm] @ grown[arm].T
        try:
            np.linalg.cholesky(square)
        except np.linalg.LinAlgError as err:
            where = f'the covariance in {row.key}.parquet of the history'
            raise InputError(f'{where} is damaged ({err}): {AWAY}') from err
        whole = np.linalg.inv(square)
        information.append(whole[np.ix_(which, which)])
        pulls.append((whole @ np.column_stack([row.offsets[own], tilts]))[which])
    return np.array(information), np.array(pulls)


def _kalman_filter(
    information: FloatArray, pulls: FloatArray, years: FloatArray, drifts: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return covariance (K, P, P) and mean (K, P, 1 + T) after each night, by all up to it.

    `drifts` (P, P) are added in a year.
    """
    covariance, mean = np.zeros_like(information), np.zeros_like(pulls)
    covariance[0] = np.linalg.inv(information[0])
    mean[0] = covariance[0] @ pulls[0]
    for k in range(1, len(years)):
        known = np.linalg.inv(covariance[k - 1] + drifts * (years[k] - years[k - 1]))
        covariance[k] = np.linalg.inv(known + information[k])
        mean[k] = covariance[k] @ (known @ mean[k - 1] + pulls[k])
    return covariance, mean


def _groups(names: Sequence[Parameter]) -> tuple[tuple[str, ...], ...]:
    """Return joints, and pairs with at most half of all parameters: the rest shows the scatter."""
    known = Counter(name.owner for name in names)
    pairs = combinations(known, 2)
    few = (pair for pair in pairs if 2 * sum(known[joint] for joint in pair) <= len(names))
    return (*((joint,) for joint in known), *few)


def _usual(scatter: FloatArray, size: int) -> float:
    """Return the scatter of nights relative to their covariances; 1 if these may be right."""
    return float(_above_chance(np.median(scatter), size * scatter.size)) if scatter.size else 1.0


def _above_chance(ratio: FloatArray | np.floating[Any], freedom: int) -> FloatArray:
    """Return ratios that clearly exceed chance with so many degrees of freedom, else 1."""
    return np.asarray(np.where(ratio > 1.0 + 2.0 * np.sqrt(2.0 / freedom), ratio, 1.0))
