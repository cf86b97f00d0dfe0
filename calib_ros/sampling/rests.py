# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rests of the joints that pass unseen, because their values are noisier than `still`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_ros.sampling.rows import Stamps

AT_REST = 6.0
"""What `still` must be at least [noise of the joints] for a stop to show as one."""
MOST_RESTS = 1000
"""Rests in which no stop shows that are counted."""


class Rests:
    """How many stops were `sampled`, and the noise of the joints where they rested unseen."""

    def __init__(self) -> None:
        self.sampled = 0
        self._unseen: list[float] = []
        self._resting = False

    def note(self, noise: float | None) -> None:
        """Note the noise of joints that rest though no stop is found, None while they do not."""
        before, self._resting = self._resting, noise is not None
        if noise is not None and not before and len(self._unseen) < MOST_RESTS:
            self._unseen.append(noise)

    def needed(self, still: float) -> float | None:
        """Return what `still` must be at least where more rests passed unseen than not."""
        if len(self._unseen) <= self.sampled:
            return None
        needed = AT_REST * float(np.median(self._unseen))
        return needed if needed > still else None


def seen_stops(
    stands: Stamps, rounds: Sequence[int], settled_ns: int, late_ns: int, shortest_ns: int
) -> list[bool]:
    """Tell of each round whether a stop shows in what the one before has not dealt with.

    Stands (K, 2) of the joints, and stamps of the rounds, of which each deals with what is older
    than it by `late_ns`.
    """
    times = np.array(rounds)[:, np.newaxis]
    settled = np.concatenate([[[settled_ns]], times[:-1] - late_ns])
    lengths = np.minimum(stands[:, 1], times) - stands[:, 0]
    found = ((lengths >= shortest_ns) & (stands[:, 1] > settled)).any(axis=1)
    return [bool(each) for each in found]
