# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Did the arm change between nights, when, and which joint?

Night k brings the arm's parameters x_k with covariance C_k; base and tool frames are left out, the
device may stand elsewhere every night. For each of the last m nights (LAGS) the mean of these m is
compared with the mean of the nights before, both weighted by information:

    d = x_after - x_before,   S = s^2 (C_after + C_before),   u = S^-1 d,   W = S^-1

An arm is bumped at one joint or two, not at all of them. That j alone, a joint or two, changed by

    d_j = W_jj^-1 u_j,   covariance W_jj^-1,

explains g_j = u_j^T W_jj^-1 u_j of the difference, which has an F distribution where nothing
changed: as many degrees of freedom as j has parameters, over those of the noise, or of s^2 if it
has fewer: those of the nights before and of what j leaves. s^2 is by how much the nights so far
scatter more than their covariances tell, where they clearly do, or by how much more j leaves of
the difference: what warms up, what the model lacks. `changes.py` names what changed, and all
begins anew.

Nights are compared by the parameters that they have in common. An effect that only some nights
fitted is taken at its nominal value in the others too: with the information matrix I of all
parameters of the arm, a fit of the common ones c alone has I_cc and (I x)_c. That does not go for
DH parameters, which are far from nominal: nights that determine other ones are compared among
themselves only.

Neither warmth nor model makes nights scatter CLEARLY more all at once. Where every joint and pair
leaves more, several changed: a repaired arm, or measurements of another robot.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from calib_ros.files.history import Row
from calib_ros.identification.changes import (
    Columns,
    Explanation,
    Told,
    explanations,
    likely,
    reason_in_words,
)
from calib_ros.identification.levels import CLEARLY, KNOWN, TELLING
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import some

LAGS = tuple(2**k for k in range(TELLING.bit_length()))
"""Nights, 1 to TELLING, that a change is looked for in: a large one shows at once, a small one
after some."""


@dataclass(frozen=True, eq=False)
class Change:
    """An arm that is another one than before."""

    time: datetime  # of the first night from which on it is
    seen: datetime  # of the night in which that was found
    reasons: tuple[Explanation, ...]  # the likeliest first; none where several joints changed
    pair: tuple[str, ...] = ()  # the joints where two changed

    @property
    def joint(self) -> str:
        """Return the joint that changed, most likely; empty where several did."""
        return self.reasons[0].owner if self.reasons else ''

    def __str__(self) -> str:
        """Return it in words."""
        if self.pair:
            return f'two joints changed: {" and ".join(self.pair)}: was it bumped?'
        if not self.reasons:
            return (
                'several joints changed: was the robot repaired, or are these the measurements of '
                'another robot?'
            )
        return f'{reason_in_words(self.reasons)}: was it bumped?'


class Night(NamedTuple):
    """A night, and how strongly each joint seems changed: as that of a normal variable."""

    row: Row
    strength: dict[str, float]


@dataclass(frozen=True)
class Watched:
    """What the nights of a robot tell, and in words what of them is not compared."""

    nights: tuple[Night, ...] = ()
    changes: tuple[Change, ...] = ()
    remarks: tuple[str, ...] = ()


def watch(rows: Sequence[Row], years: float) -> Watched:
    """Look for changes in accepted identifications, in order."""
    known = [row for row in rows if row.accepted]
    if not known:
        return Watched()
    joints = {joint['name'] for joint in json.loads(known[0].chain)['joints']}
    arms = [[name for name in map(Parameter, row.names) if name.owner in joints] for row in known]
    determined = [frozenset(name for name in arm if name.of_dh) for arm in arms]
    nights: dict[int, Night] = {}
    changes: list[Change] = []
    remarks: list[str] = []
    for each in dict.fromkeys(determined):
        which = [k for k, names in enumerate(determined) if names == each]
        found = _alike([known[k] for k in which], [arms[k] for k in which], years)
        nights |= zip(which, found.nights, strict=True)
        changes += found.changes
        remarks += found.remarks
        if each != determined[-1]:
            remarks.append(
                f'{len(which)} night{"s" * (len(which) > 1)}, the last of '
                f'{known[which[-1]].time:%Y-%m-%d}, cannot be compared with the newest: '
                f'{_other(each, determined[-1])}'
            )
    changes.sort(key=lambda change: change.seen)
    return Watched(tuple(nights[k] for k in sorted(nights)), tuple(changes), tuple(remarks))


def _other(names: frozenset[Parameter], newest: frozenset[Parameter]) -> str:
    """Return in words what some nights determine and the newest does not, and the other way."""
    differences = (
        ('they alone determine', names - newest),
        ('it alone determines', newest - names),
    )
    return '; '.join(f'{who} {", ".join(some(sorted(what)))}' for who, what in differences if what)


def _alike(rows: Sequence[Row], arms: Sequence[Sequence[Parameter]], years: float) -> Watched:
    """Look for changes in nights that determine the same DH parameters.

    `arms` are the parameters of the arm that each night fitted.
    """
    strengths: list[dict[str, float]] = [{} for _ in rows]
    changes: list[Change] = []
    names: Sequence[Parameter] = ()
    first = known_up_to = 0
    while known_up_to < len(rows):
        common = set(arms[first]).intersection(*arms[first : known_up_to + 1])
        names = tuple(name for name in arms[first] if name in common)
        if not names:
            break
        lacking = (k for k in range(known_up_to, len(rows)) if not common.issubset(arms[k]))
        end = next(lacking, len(rows))
        data = _Data.of(rows[first:end], arms[first:end], names)
        level = 1.0 / (365.25 * years * len(LAGS) * len(data.groups))
        tests = data.tests()
        count = len(data.joints)
        least = tests.chances[..., :count].min(axis=0)
        shown = -special.ndtri(np.maximum(0.5 * least, 1e-300))
        for k in range(known_up_to, end):
            strengths[k] = dict(zip(data.joints, shown[k - first].tolist(), strict=True))
        fresh = np.arange(first, end) >= known_up_to
        several = tests.several.min(axis=0) < level
        alarms = np.flatnonzero(((tests.chances.min(axis=(0, 2)) < level) | several) & fresh)
        if not alarms.size:
            known_up_to = end
            continue
        k = int(alarms[0])
        chances = tests.several[:, k] if several[k] else tests.chances[:, k].min(axis=1)
        lag = int(chances.argmin())
        row = rows[first + k]
        reasons: tuple[Explanation, ...] = ()
        pair: tuple[str, ...] = ()
        one = float(tests.chances[lag, k, :count].min())
        two = float(tests.chances[lag, k, count:].min(initial=1.0))
        if not several[k] and two < level * (one if one < level else 1.0):
            pair = data.groups[count + int(tests.chances[lag, k, count:].argmin())]
        elif not several[k]:
            columns = Columns(row.corrected(), data.names)
            told = Told(data.names, tests.weight[lag, k], tests.pull[lag, k])
            reasons = likely(explanations(told, columns, float(data.freedom[k])))
        first, known_up_to = first + k + 1 - LAGS[lag], first + k + 1
        changes.append(Change(rows[first].time, row.time, reasons, pair))
    nights = tuple(Night(row, each) for row, each in zip(rows, strengths, strict=True))
    if not (left := sorted(set().union(*arms[first:]).difference(names))):
        return Watched(nights, tuple(changes))
    remark = (
        f'since {rows[first].time:%Y-%m-%d}, {", ".join(some(left))} are not compared: only some '
        'nights fitted them'
    )
    return Watched(nights, tuple(changes), (remark,))


class _Tests(NamedTuple):
    """Tests of L lags at K nights for J joints and pairs of these."""

    chances: FloatArray  # (L, K, J), 1 where there is no night before
    several: FloatArray  # (L, K), that no joint alone changed
    pull: FloatArray  # (L, K, P), u
    weight: FloatArray  # (L, K, P, P), W


class _Data(NamedTuple):
    """What K nights tell of P parameters: information (K, P, P), and that times values (K, P)."""

    names: tuple[Parameter, ...]
    information: FloatArray
    pulls: FloatArray
    freedom: FloatArray

    @classmethod
    def of(
        cls, rows: Sequence[Row], arms: Sequence[Sequence[Parameter]], names: tuple[Parameter, ...]
    ) -> _Data:
        """Return what nights tell of some parameters of the arm, `arms`, that each fitted.

        Others of the arm are taken at their nominal values, base and tool are free.
        """
        information, pulls = [], []
        for row, arm in zip(rows, arms, strict=True):
            own = [row.names.index(name) for name in arm]
            which = [arm.index(name) for name in names]
            whole = np.linalg.inv(row.covariance[np.ix_(own, own)])
            information.append(whole[np.ix_(which, which)])
            pulls.append((whole @ row.offsets[own])[which])
        freedom = np.array([row.freedom or KNOWN for row in rows])
        return cls(names, np.array(information), np.array(pulls), freedom)

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name.owner for name in self.names))

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """Return what may change at once: joints, then pairs with half of all parameters at most.

        What is left by more than that tells little of how nights scatter.
        """
        known = Counter(name.owner for name in self.names)
        pairs = (
            pair
            for pair in combinations(self.joints, 2)
            if 2 * sum(known[joint] for joint in pair) <= len(self.names)
        )
        return (*((joint,) for joint in self.joints), *pairs)

    def tests(self) -> _Tests:
        """Return the tests of all nights against those before."""
        count, size = self.pulls.shape
        owners = np.array([name.owner for name in self.names])
        groups = [np.flatnonzero(np.isin(owners, group)) for group in self.groups]
        whole, pulled = np.cumsum(self.information, axis=0), np.cumsum(self.pulls, axis=0)
        chances = np.ones((len(LAGS), count, len(groups)))
        several = np.ones((len(LAGS), count))
        pull = np.zeros((len(LAGS), count, size))
        weight = np.zeros((len(LAGS), count, size, size))
        scatter = np.ones(count)
        for number, lag in enumerate(LAGS):
            nights = np.arange(lag, count)
            if not nights.size:
                continue
            before = np.linalg.inv(whole[nights - lag])
            after = np.linalg.inv(whole[nights] - whole[nights - lag])
            moved = np.einsum('kpr,kr->kp', after, pulled[nights] - pulled[nights - lag])
            moved -= np.einsum('kpr,kr->kp', before, pulled[nights - lag])
            inverse = np.linalg.inv(after + before)
            force = np.einsum('kpr,kr->kp', inverse, moved)
            whole_of = np.einsum('kp,kp->k', moved, force)
            if lag == 1:
                scatter[nights] = whole_of / size
            usual = np.array([self._usual(scatter[1 : k + 1 - lag]) for k in nights])
            weight[number, nights] = inverse / usual[:, np.newaxis, np.newaxis]
            pull[number, nights] = force / usual[:, np.newaxis]
            several[number, nights] = 0.0
            for j, group in enumerate(groups):
                part = inverse[:, group[:, np.newaxis], group]
                found = np.linalg.solve(part, force[:, group, np.newaxis])[..., 0]
                gain = np.einsum('kp,kp->k', found, force[:, group])
                others = max(1, size - len(group))
                left = (whole_of - gain) / others
                beyond = special.fdtrc(others, self.freedom[nights], left / (CLEARLY**2 * usual))
                several[number, nights] = np.maximum(several[number, nights], beyond)
                left = _clearly(left, others)
                gain /= np.maximum(usual, left) * len(group)
                known = np.minimum(self.freedom[nights], others + size * (nights - lag))
                chances[number, nights, j] = special.fdtrc(len(group), known, gain)
        return _Tests(chances, several, pull, weight)

    def _usual(self, scatter: FloatArray) -> float:
        """Return how much nights scatter, by their covariances; 1 where these may be right."""
        if not scatter.size:
            return 1.0
        return float(_clearly(np.median(scatter), len(self.names) * scatter.size))


def _clearly(ratio: FloatArray | np.floating[Any], freedom: int) -> FloatArray:
    """Return what is clearly more than chance makes of 1 with so many degrees of freedom, or 1."""
    return np.asarray(np.where(ratio > 1.0 + 2.0 * np.sqrt(2.0 / freedom), ratio, 1.0))
