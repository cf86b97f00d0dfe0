# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rests of the joints: those sampled as stops, and those that no stop shows."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from calib_ros.estimation.configurations import SCATTER
from calib_ros.sampling.means import SPIKE
from calib_ros.sampling.slices import NO_ACCIDENT


class Rests:
    """Number of stops `sampled`, and joint noise at rests that no stop shows.

    They are missed if the joint values are noisier than `still`. At most `capacity` are counted.
    Values that jump are at no rest, and go on doing so.
    """

    def __init__(self, capacity: int) -> None:
        self.sampled = 0
        self._capacity = capacity
        self._unseen: list[float] = []
        self._resting = False
        self._jumps = deque[float](maxlen=NO_ACCIDENT)  # noise larger than any at rest
        self._swings: list[float] = []
        self.swing = 0.0  # by how much [rad or m] joints at rest jump with each sample

    def note(self, noise: float | None) -> None:
        """Note the noise of joints at an undetected rest, None while they move."""
        before, self._resting = self._resting, noise is not None
        if noise is None or SPIKE * noise <= SCATTER:
            self._jumps.clear()
        else:
            self._jumps.append(noise)
        if noise is not None and not before and len(self._unseen) < self._capacity:
            self._unseen.append(noise)

    def note_swings(self, swings: Sequence[float | None]) -> None:
        """Note by how much joints at rest jump to and fro, None while they move."""
        for swing in swings:
            if swing is not None and not self.swing:
                self._swings = [*self._swings, swing] if swing else []
                if len(self._swings) == NO_ACCIDENT:
                    self.swing = float(np.median(self._swings))

    def needed(self, still: float) -> float | None:
        """Return the least `still` that detects most rests; None if it does already."""
        jumping = len(self._jumps) == NO_ACCIDENT
        if len(self._unseen) <= self.sampled and not jumping:
            return None
        needed = SPIKE * float(np.median(self._jumps if jumping else self._unseen))
        return needed if needed > still else None
