# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Did the arm change between nights, when, and which joint?

Night k brings the arm's parameters x_k with covariance C_k; base and tool frames are left out, the
device may stand elsewhere every night. For each of the last m nights (LAGS) the mean of these m is
compared with the mean of the nights before, both weighted by information:

    d = x_after - x_before,   S = s^2 (C_after + C_before),   u = S^-1 d,   W = S^-1

An arm is bumped at one joint, not at all of them. That joint j alone changed, by

    d_j = W_jj^-1 u_j,   covariance W_jj^-1,

explains g_j = u_j^T W_jj^-1 u_j of the difference, which has an F distribution where nothing
changed: as many degrees of freedom as j has parameters, over those of the noise. s^2 is by how
much the nights so far scatter more than their covariances tell, where they clearly do, or by how
much more j leaves of the difference: what warms up, what the model lacks. `changes.py` names what
changed, and all begins anew.

Neither warmth nor model makes nights scatter CLEARLY more all at once. Where every joint leaves
more, several are different: a mended arm, or measurements of another robot.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
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

LAGS = tuple(2**k for k in range(TELLING.bit_length()))
"""Nights, 1 to TELLING, that a change is looked for in: a large one shows at once, a small one
after some."""


@dataclass(frozen=True, eq=False)
class Change:
    """An arm that is another one than before."""

    time: datetime  # of the first night from which on it is
    seen: datetime  # of the night in which that was found
    reasons: tuple[Explanation, ...]  # the likeliest first; none where several joints changed

    @property
    def joint(self) -> str:
        """Return the joint that changed, most likely; empty where several did."""
        return self.reasons[0].owner if self.reasons else ''

    def __str__(self) -> str:
        """Return it in words."""
        if not self.reasons:
            return (
                'several joints are different: was it mended, or are these the measurements of '
                'another robot?'
            )
        return f'{reason_in_words(self.reasons)}: was it bumped?'


class Night(NamedTuple):
    """A night, and how strongly each joint seems changed: as that of a normal variable."""

    row: Row
    strength: dict[str, float]


@dataclass(frozen=True)
class Watched:
    """What the nights of a robot tell, those that can be compared with the first."""

    nights: tuple[Night, ...] = ()
    changes: tuple[Change, ...] = ()


def watch(rows: Sequence[Row], years: float) -> Watched:
    """Look for changes in accepted identifications, in order, of the parameters of the first."""
    known = [row for row in rows if row.accepted]
    alike = [row for row in known if row.names == known[0].names]
    if not alike:
        return Watched()
    wanted = alike[0].names
    joints = {joint['name'] for joint in json.loads(alike[0].chain)['joints']}
    own = [k for k, name in enumerate(wanted) if Parameter(name).owner in joints]
    names = tuple(Parameter(wanted[k]) for k in own)
    data = _Data(
        names,
        np.array([row.offsets[own] for row in alike]),
        np.linalg.inv(np.array([row.covariance[np.ix_(own, own)] for row in alike])),
        np.array([row.freedom or KNOWN for row in alike]),
    )
    level = 1.0 / (365.25 * years * len(LAGS) * len(data.joints))
    changes: list[Change] = []
    strengths = np.zeros((len(alike), len(data.joints)))
    first = known_up_to = 0
    while True:
        tests = data.tests(first)
        least = tests.chances.min(axis=0)
        fresh = np.arange(len(alike)) >= known_up_to
        strengths[fresh] = -special.ndtri(np.maximum(0.5 * least[fresh], 1e-300))
        several = tests.several.min(axis=0) < level
        alarms = np.flatnonzero(((least.min(axis=1) < level) | several) & fresh)
        if not alarms.size:
            break
        k = int(alarms[0])
        chances = tests.several if several[k] else tests.chances.min(axis=2)
        lag = int(chances[:, k].argmin())
        first, known_up_to = k + 1 - LAGS[lag], k + 1
        reasons: tuple[Explanation, ...] = ()
        if not several[k]:
            columns = Columns(alike[k].corrected(), data.names)
            told = Told(data.names, tests.weight[lag, k], tests.pull[lag, k])
            reasons = likely(explanations(told, columns, float(data.freedom[k])))
        changes.append(Change(alike[first].time, alike[k].time, reasons))
    nights = tuple(
        Night(row, dict(zip(data.joints, values, strict=True)))
        for row, values in zip(alike, strengths.tolist(), strict=True)
    )
    return Watched(nights, tuple(changes))


class _Tests(NamedTuple):
    """Tests of L lags at K nights for J joints."""

    chances: FloatArray  # (L, K, J), 1 where there is no night before
    several: FloatArray  # (L, K), that no joint alone changed
    pull: FloatArray  # (L, K, P), u
    weight: FloatArray  # (L, K, P, P), W


class _Data(NamedTuple):
    """The parameters (K, P) of K nights with their information (K, P, P)."""

    names: tuple[Parameter, ...]
    values: FloatArray
    information: FloatArray
    freedom: FloatArray

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name.owner for name in self.names))

    def tests(self, first: int) -> _Tests:
        """Return the tests of all nights against those before, from the `first` on."""
        count, size = self.values.shape
        owners = np.array([name.owner for name in self.names])
        groups = [np.flatnonzero(owners == joint) for joint in self.joints]
        information, values = self.information[first:], self.values[first:]
        whole = np.cumsum(information, axis=0)
        pulled = np.cumsum(np.einsum('kpr,kr->kp', information, values), axis=0)
        chances = np.ones((len(LAGS), count, len(self.joints)))
        several = np.ones((len(LAGS), count))
        pull = np.zeros((len(LAGS), count, size))
        weight = np.zeros((len(LAGS), count, size, size))
        scatter = np.ones(count)
        for number, lag in enumerate(LAGS):
            ends = np.arange(lag, len(whole))
            if not ends.size:
                continue
            before = np.linalg.inv(whole[ends - lag])
            after = np.linalg.inv(whole[ends] - whole[ends - lag])
            moved = np.einsum('kpr,kr->kp', after, pulled[ends] - pulled[ends - lag])
            moved -= np.einsum('kpr,kr->kp', before, pulled[ends - lag])
            inverse = np.linalg.inv(after + before)
            force = np.einsum('kpr,kr->kp', inverse, moved)
            whole_of = np.einsum('kp,kp->k', moved, force)
            if lag == 1:
                scatter[first + ends] = whole_of / size
            nights = first + ends
            usual = np.array([self._usual(scatter[first + 1 : k + 1 - lag]) for k in nights])
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
                chances[number, nights, j] = special.fdtrc(len(group), self.freedom[nights], gain)
        return _Tests(chances, several, pull, weight)

    def _usual(self, scatter: FloatArray) -> float:
        """Return how much nights scatter, by their covariances; 1 where these may be right."""
        if not scatter.size:
            return 1.0
        return float(_clearly(np.median(scatter), len(self.names) * scatter.size))


def _clearly(ratio: FloatArray | np.floating[Any], freedom: int) -> FloatArray:
    """Return what is clearly more than chance makes of 1 with so many degrees of freedom, or 1."""
    return np.asarray(np.where(ratio > 1.0 + 2.0 * np.sqrt(2.0 / freedom), ratio, 1.0))
