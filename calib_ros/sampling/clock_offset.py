# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How far the stamps of a stream are from those of joint states."""

from __future__ import annotations

import numpy as np

from calib_ros.sampling.slices import NO_ACCIDENT, Stamps


class ClockOffset:
    """How far the stamps of a stream are from those of the joint states that come with them."""

    def __init__(self) -> None:
        self._newest_ns = 0  # the joint state before the last measurement
        self._row = self._live = 0  # far ones in a row, and those with new joint states between
        self._last_ns = self._moved_ns = 0  # the last one, and most ahead while joint states came

    def note(self, stamps: Stamps, newest: Stamps, far_ns: int) -> None:
        """Note measurements (M,), some further than `far_ns` from the `newest` joint states."""
        ahead = stamps - newest
        far = (np.abs(ahead) > far_ns) & (newest != 0)
        if far.any():
            live = np.cumsum(far & (np.diff(newest, prepend=self._newest_ns) != 0))
            live = live + self._live - np.maximum.accumulate(np.where(far, 0, live + self._live))
            near = np.flatnonzero(~far)
            self._row = len(far) - 1 - int(near[-1]) if len(near) else self._row + len(far)
            self._live = int(live[-1])
            if live.max() >= NO_ACCIDENT:
                self._moved_ns = max(self._moved_ns, int(ahead[live.argmax()]), key=abs)
        else:
            self._row = self._live = 0
        self._newest_ns, self._last_ns = int(newest[-1]), int(stamps[-1])

    @property
    def seconds(self) -> float:
        """Return by how much the clocks differed while joint states came [s]."""
        return 1e-9 * self._moved_ns

    def alone(self, newest_ns: int, far_ns: int) -> float:
        """Return for how long measurements have come without joint states [s]."""
        ahead = self._last_ns - newest_ns
        return 1e-9 * ahead if self._row >= NO_ACCIDENT and ahead > far_ns else 0.0
