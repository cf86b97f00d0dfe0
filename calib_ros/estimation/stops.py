# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stops of a session, and which of them follow or are near each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from calib_ros.estimation.levels import SEVERAL
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.system import System
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray, cos_sin
from calib_ros.values import LARGEST

NEARBY = SEVERAL
"""Neighbours in joint space tested per configuration; benchmarks/drift.py --quick does not tell
them from 1."""
MOST_STOPS = 2 * SOME_POSES
"""Stops used to estimate sizes; of more, every k-th run of a twentieth."""


@dataclass(frozen=True, eq=False)
class Stops:
    """Rows of stops, summed over the samples of each.

    `parts` are (P + 1, c, n), by position and orientation, zero if not measured; `count` (n,)
    samples per stop; `place` (n, D) in joint space, angles on the unit circle, and `time` (n,) the
    stop number; both far apart between sets; `joints` (n, J) their joint values.
    """

    parts: list[FloatArray]
    count: FloatArray
    place: FloatArray
    time: FloatArray
    joints: FloatArray

    def __len__(self) -> int:
        return len(self.count)

    def links(self, kind: str) -> csr_array:
        """Return (n, n): 1 for neighbours."""
        count = len(self)
        if kind == 'successive':
            first = np.flatnonzero(np.diff(self.time) == 1.0)
            second = first + 1
        else:
            far, nearest = cKDTree(self.place).query(self.place, k=NEARBY + 1)
            first, second = np.repeat(np.arange(count), NEARBY + 1), nearest.ravel()
            good = (first != second) & (far.ravel() < ELSEWHERE / 2)
            first, second = first[good], second[good]
        ends = (np.append(first, second), np.append(second, first))
        links = csr_array((np.ones(2 * len(first)), ends), shape=(count, count))
        links.data[:] = 1.0
        return links

    def kernel(self, kind: str, length: float) -> FloatArray:
        """Return (n, n): covariance of the sums over each stop, per root of count."""
        root = np.sqrt(self.count)
        return np.asarray(np.outer(root, root) * np.exp(-self._apart[kind] / length))

    @cached_property
    def _apart(self) -> dict[str, FloatArray]:  # (n, n) by kind
        places = {'successive': self.time[:, np.newaxis], 'near': self.place}
        return {kind: cdist(place, place) for kind, place in places.items()}


def gathered(chain: Chain, names: Sequence[str], system: System, most: int) -> tuple[Stops, int]:
    """Return the stops of all sets, or of every k-th run of `most` / 20 if there are more; k."""
    total = sum(int(samples.observations.stops[-1]) + 1 for samples in system.sets)
    stride = max(1, -(-total // most))
    return gather(chain, names, system, stride, most // 20), stride


def gather(chain: Chain, names: Sequence[str], system: System, stride: int, run: int) -> Stops:
    """Return the stops of all sets; of many, every `stride`-th run of `run` stops."""
    widths = (max(samples.width for samples in system.sets), 3)
    parts: list[list[FloatArray]] = [[], []]
    counts, places, times, joints = [], [], [], []
    circular = np.array([joint.type == 'revolute' for joint in chain.joints])
    for number, samples in enumerate(system.sets):
        numbers = samples.observations.stops
        chosen = numbers // run % stride == 0
        if samples.weights is not None:
            chosen &= samples.weights > 0.0
        if not chosen.any():
            continue
        few, numbers = samples.select(chosen), numbers[chosen]
        begins = np.flatnonzero(np.diff(numbers, prepend=-1))
        count = np.diff([*begins, len(numbers)]).astype(float)
        for part, width in zip(parts, widths, strict=True):
            part.append(np.zeros((len(names) + 1, width, len(begins))))
        for index, block in few.sums(chain, names, numbers):
            first = int(np.searchsorted(numbers[begins], index[0]))  # one stop may span blocks
            stops = slice(first, first + len(index))
            for (*_, rows), added in zip(parts, block, strict=False):  # one part if whitened
                rows[:, : added.shape[1], stops] += added / np.sqrt(count[stops])
        q = few.observations.joints[begins]
        turned = [*cos_sin(q[:, circular]), q[:, ~circular]]
        places.append(np.column_stack([*turned, np.full(len(q), ELSEWHERE * number)]))
        times.append(numbers[begins] + ELSEWHERE * number)
        joints.append(q)
        counts.append(count)
    if not counts:
        return Stops([], np.zeros(0), *np.zeros((3, 0, 0)))
    return Stops(
        [np.concatenate(part, axis=2) for part in parts],
        *(np.concatenate(each) for each in (counts, places, times, joints)),
    )


ELSEWHERE = 4.0 * LARGEST
"""Distance between stops of different sets, which are no neighbours."""
