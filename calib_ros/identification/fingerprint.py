# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The fingerprint of fitted measurements, by which a calibration knows them again.

Each row has a hash; the smallest `KEPT` hashes are a random sample of the rows. A further row with
a hash up to the largest kept one is either among them or was not fitted (Broder 1997). Of updates,
by a few rows each, the latest rows are kept too: a sample of many others may have none of them.

Rows written with fewer digits have other hashes. They are known by their values: nearly every kept
row, at whose joint values there is a new one, equals one within its rounding. Another measurement
there has other noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib_ros.decision.rounding import resolution_of
from calib_ros.errors import ConfigError
from calib_ros.estimation.levels import CERTAIN, FEW, NEARER
from calib_ros.estimation.observations import Observations
from calib_ros.kinematics.se3 import Flags, FloatArray
from calib_ros.settings import EXACT, Settings

Hashes: TypeAlias = NDArray[np.uint64]
KEPT = 256
"""Of 1,000 rows fitted, 12 repeated ones are detected in 95 % of cases: one in four is kept.
Part of the file format, as GRID."""
GRID = 1.618e-6
"""Cell size [rad, m or px] of equal values; no decimal number is near an edge."""


def _values(each: Observations) -> FloatArray:
    """Return the joint values and the measurement of each row, (N, n + 3) of a position."""
    measured = each.given if each.seen else each.positions
    if each.pixels is not None:
        measured = np.concatenate([each.pixels, each.points], axis=1)
    elif each.distances is not None:
        measured = each.distances[:, np.newaxis]
    return np.concatenate([each.joints, measured], axis=1)


def _of_positions(sets: Sequence[Observations]) -> FloatArray:
    """Return the values (N, n + 3) of all rows of positions; those in sockets are alike."""
    every = (each for each in sets if each.distances is None and each.pixels is None)
    found = [_values(each) for each in every if not each.socket]
    return np.concatenate(found) if found else np.zeros((0, 4))


def hashes(sets: Sequence[Observations]) -> Hashes:
    """Return a hash (N,) of the joint values and the measurement of each row."""
    found = [np.zeros(0, dtype=np.uint64)]
    for each in sets:
        mixed = np.zeros(len(each), dtype=np.uint64)
        for column in _values(each).T:  # Fibonacci hashing, folded
            cells = np.round(column / GRID).astype(np.int64).view(np.uint64)
            mixed = (mixed ^ cells) * np.uint64(0x9E3779B97F4A7C15)
            mixed ^= mixed >> np.uint64(29)
        found.append(mixed)
    return np.concatenate(found)


@dataclass(frozen=True, eq=False)
class Fingerprint:
    """The smallest hashes of `count` rows, ascending, and the `latest` of later fits.

    `values` (K, n + 3) are those of kept rows of positions, of later fits first.
    """

    count: int
    least: Hashes
    latest: Hashes = field(default_factory=lambda: np.zeros(0, dtype=np.uint64))
    values: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))

    @classmethod
    def of(cls, sets: Sequence[Observations], earlier: Fingerprint | None = None) -> Fingerprint:
        """Return the fingerprint of rows and of those fitted earlier."""
        new, values = hashes(sets), _of_positions(sets)
        if len(values) > KEPT:
            values = values[np.random.default_rng(0).permutation(len(values))[:KEPT]]
        if earlier is None:
            least, _ = np.unique(new, return_index=True)  # sorts, which is faster than hashing
            return cls(len(new), least[:KEPT], values=values)
        both = np.union1d(earlier.least, earlier.comparable(new))[:KEPT]
        latest = np.concatenate([new, earlier.latest])[:KEPT]
        width = (values if len(values) else earlier.values).shape[1]  # a file may have any
        values = np.concatenate([v for v in (values, earlier.values) if v.shape[1] == width])
        return cls(earlier.count + len(new), both, latest, values[:KEPT])

    def comparable(self, rows: Hashes) -> Hashes:
        """Return which hashes of rows (N,) would be among the smallest if the rows were fitted."""
        every = self.count <= len(self.least)
        return rows if every else rows[rows <= self.least.max(initial=0)]

    @classmethod
    def of_record(cls, record: Mapping[str, Any], where: str) -> Fingerprint | None:
        """Return the fingerprint in the record of a calibration, if any."""
        if 'rows' not in record:
            return None
        try:
            known = {'latest': '', 'values': [], **record['rows']}
            rows = [np.frombuffer(bytes.fromhex(row), '>f4') for row in known['values']]
            values = np.array(rows, dtype=np.float64) if rows else np.zeros((0, 4))
            if not np.isfinite(values).all():
                raise ValueError('values that are no numbers')
            least, latest = (
                np.frombuffer(bytes.fromhex(known[key]), '>u8').astype(np.uint64)
                for key in ('least', 'latest')
            )
            return cls(int(known['count']), least, latest, values)
        except (KeyError, TypeError, ValueError) as err:
            raise ConfigError(f'{where}: calibration.rows is damaged: identify again') from err

    def document(self) -> dict[str, Any]:
        """Return the fingerprint for the record."""
        kept = {'least': self.least, 'latest': self.latest}
        texts = {key: each.astype('>u8').tobytes().hex() for key, each in kept.items()}
        values = [row.astype('>f4').tobytes().hex() for row in self.values]
        return {'count': self.count, **texts, 'values': values}

    def share(self, sets: Sequence[Observations]) -> float:
        """Return the estimated share of rows that were fitted."""
        rows = hashes(sets)
        sample = self.comparable(rows)
        pairs = (sample, self.least), (rows, self.latest)
        same = [float(np.isin(own, kept).mean()) if own.size else 0.0 for own, kept in pairs]
        return max(same) or self._rounded(sets)

    def narrow(self, sets: Sequence[Observations]) -> Flags:
        """Return which joints (n,) move clearly less than in the kept rows of positions."""
        joints = np.concatenate([each.joints for each in sets])
        fitted = self.values[:, :-3]
        if not len(fitted) or fitted.shape[1] != joints.shape[1]:
            return np.zeros(joints.shape[1], dtype=bool)
        spans = np.ptp(fitted, axis=0)
        return np.asarray((spans > Settings.still) & (np.ptp(joints, axis=0) < NEARER * spans))

    def _rounded(self, sets: Sequence[Observations]) -> float:
        """Return the estimated share of rows that were fitted, whose values are rounded."""
        new = _of_positions(sets)
        if not (len(new) and len(self.values) and new.shape[1] == self.values.shape[1]):
            return 0.0
        step, count = max(map(resolution_of, new.T[-3:])), new.shape[1]
        reach = np.full(count, Settings.still)
        reach[-3:] = EXACT + 0.5 * np.clip(step, 10.0 * EXACT, Settings.sigma_position)
        near, same = (
            cKDTree((new / reach)[:, :k]).query((self.values / reach)[:, :k], p=np.inf)[0] <= 1.0
            for k in (count - 3, count)
        )
        if same.sum() < max(FEW, CERTAIN * near.sum()):
            return 0.0
        return min(1.0, float(same.mean()) * self.count / len(new))


def reused_in_words(share: float) -> str:
    """Return a warning about the share of measurements already fitted; empty for none."""
    if not share:
        return ''
    which = 'these' if share > 0.995 else f'{100.0 * share:.0f} % of these'
    return (
        f'the calibration was fitted to {which} measurements, so they prove nothing about other '
        'poses'
    )
